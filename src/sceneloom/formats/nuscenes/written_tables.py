"""Tables that are written row by row, and the tokens of rows, which are the same whenever the scene is."""

import json
from collections.abc import Iterable, Mapping
from hashlib import blake2b
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from sceneloom.arrays import Float64Array
from sceneloom.geometry.rigid import RigidTransform

Row = Mapping[str, Any]


def token_of(*parts: object) -> str:
    """A token of 32 hexadecimal digits, as nuScenes has them."""
    return blake2b("\0".join(map(str, parts)).encode(), digest_size=16).hexdigest()


def wxyz(quaternion_xyzw: Float64Array) -> list[float]:
    """A rotation as the tables have it."""
    x, y, z, w = quaternion_xyzw.tolist()
    return [w, x, y, z]


def placed(transform: RigidTransform) -> dict[str, list[float]]:
    """A transform as two fields of a row."""
    return {
        "translation": transform.translation.tolist(),
        "rotation": wxyz(transform.quaternion_xyzw),
    }


class TableWriter:
    """An open table; its rows are on the disk as soon as they are added."""

    def __init__(self, folder: Path, name: str) -> None:
        """Begin a table."""
        self._file = (folder / f"{name}.json").open("x", encoding="utf-8", newline="\n")
        self._file.write("[")
        self._between = "\n"

    def add(self, **row: Any) -> None:
        """Write a row."""
        self._file.write(self._between + json.dumps(row, allow_nan=False))
        self._between = ",\n"

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.write("\n]\n")
        self._file.close()


def write_table(folder: Path, name: str, rows: Iterable[Row]) -> None:
    """Write a whole table."""
    with TableWriter(folder, name) as table:
        for row in rows:
            table.add(**row)
