"""A data set in the nuScenes schema as a scene."""

from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec

from sceneloom.formats.ledger import Ledger
from sceneloom.formats.nuscenes.cuboids import build_cuboids
from sceneloom.formats.nuscenes.lidarseg import build_labelled_points
from sceneloom.formats.nuscenes.selection import SceneTables, find_location, select
from sceneloom.formats.nuscenes.sensors import build_sensors, trajectory_of
from sceneloom.formats.option_values import as_flag
from sceneloom.geometry.euler import AngleUnit
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.scene import Scene
from sceneloom.scene.warnings import WarningKind

_LEFT_OUT = (
    ("map.json", "maps", "maps are left out"),
    ("panoptic.json", "panoptic", "panoptic labels of points are left out"),
)

_EMPTY_TABLE = 4
"""A file of so many bytes holds no row."""


def open_nuscenes(
    path: Path, *, sequence: str | None = None, keyframes: bool | str = False, lenient: bool = False
) -> Scene:
    """Open one scene; images and points are read when asked for, boxes and classes of points at once.

    Args:
        path: the folder of the data set, or that of its tables.
        sequence: name or token of the scene, where the tables have several.
        keyframes: leave out what was taken between the samples.
        lenient: leave out what is at fault and count it.

    Raises:
        DataError: a table or a file is missing or wrong.
        OptionError: there is no such scene, or none was chosen of several.
    """
    location = find_location(path)
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        tables = select(location, sequence, ledger, keyframes=as_flag("keyframes", keyframes))
        trajectory = trajectory_of(tables, ledger)
        sensors = build_sensors(tables, ledger)
        annotations: tuple[Annotation, ...] = (
            *build_cuboids(tables, ledger),
            *build_labelled_points(tables, ledger),
        )
        _note_left_out(tables, ledger)
    return Scene(
        sensors=sensors,
        annotations=annotations,
        trajectories=MappingProxyType({} if trajectory is None else {trajectory.name: trajectory}),
        metadata=_about(tables),
        source=f"{path}/{tables.scene.name}" if tables.others else str(path),
        format="nuscenes",
        warnings=ledger.warnings,
    )


def _note_left_out(tables: SceneTables, ledger: Ledger) -> None:
    for name, code, message in _LEFT_OUT:
        file = tables.location.tables / name
        if file.is_file() and file.stat().st_size > _EMPTY_TABLE:
            ledger.note(WarningKind.SKIPPED, f"{code}-left-out", str(file), message)
    if tables.others:
        location = str(tables.location.tables / "scene.json")
        ledger.note(
            WarningKind.SKIPPED, "other-scenes", location, "further scenes are left out", count=tables.others
        )


def _about(tables: SceneTables) -> MappingProxyType[str, Any]:
    """What the tables state that the model has no other location for, and how the angles of the boxes are meant."""
    rows = {"scene": tables.scene, "log": tables.log}
    about: dict[str, Any] = {
        "version": tables.location.tables.name,
        **{name: msgspec.structs.asdict(row) for name, row in rows.items() if row is not None},
        "samples": [[row.token, row.timestamp] for row in tables.samples.values()],
    }
    angles = {"euler_unit": str(AngleUnit.DEGREES), "euler_order": "xyz"}
    return MappingProxyType({"nuscenes": about, "sceneloom": angles})
