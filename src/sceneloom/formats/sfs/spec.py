"""The Sensor Fusion Scene format: `.sfs` files, a JSON header and then arrays, read lazily and written as a stream."""

import mmap
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from sceneloom.errors import OptionError
from sceneloom.formats.base.files import open_file
from sceneloom.formats.base.losses import KEPT, converted, dropped
from sceneloom.formats.base.spec import FormatSpec, option
from sceneloom.geometry.euler import ORDERS, AngleUnit
from sceneloom.scene.types import PointsFrame

OPENCV, BROWN = "opencv", "brown"
TANGENTIALS = (OPENCV, BROWN)
"""The two meanings that p1 and p2 have among those who write camera models.

Source: "Distortion coefficients in a file" in docs/CONVENTIONS.md.
"""
PAIRS, TRIPLES = "pairs", "triples"
VERTICES = (PAIRS, TRIPLES)
"""How the vertices of polygons and polylines in space may be written."""

_LOOKED_THROUGH = 64 << 20
"""How far a file without the suffix is searched for the end of a header: logs begin with a brace, too [bytes]."""


@dataclass(frozen=True, slots=True)
class ReadingOptions:
    """What the caller says about a file that the file does not state itself.

    Raises:
        OptionError: a value is not one of those that there are.
    """

    points_frame: PointsFrame | None = option(
        default=None,
        help="Frame of lidar and radar points; by default as recorded, else the one that `coordinates` names.",
    )
    euler_unit: str | None = option(
        default=None, help="Unit of the angles of cuboids; by default as recorded, else degrees."
    )
    euler_order: str | None = option(
        default=None, help="Order of the rotations of cuboids; by default as recorded, else xyz."
    )
    tangential: str | None = option(
        default=None,
        help="What p1 and p2 of `brown_conrady` mean: opencv, or brown, as in Brown's paper, where they stand the "
        "other way round: they are exchanged, unless the file records that they were; by default as recorded, else "
        "opencv.",
    )
    vertices: str | None = option(
        default=None,
        help="How polygons and polylines in space are written: triples x, y, z, or pairs x, y, as the examples of the "
        "description have them, whose z is 0. By default triples where all rows of a path fit them, else pairs.",
    )
    assume_model: bool = option(
        default=False, help="Allow computing with camera models whose formulas nothing confirms."
    )
    lenient: bool = option(
        default=False, help="Leave out sensors and annotations that are at fault, with a warning each."
    )
    storage_options: Mapping[str, Any] | None = option(
        default=None, help="What the fsspec back end of a URL is made with, such as credentials."
    )

    def __post_init__(self) -> None:
        for name, known in (
            ("euler_unit", tuple(AngleUnit)),
            ("euler_order", ORDERS),
            ("tangential", TANGENTIALS),
            ("vertices", VERTICES),
        ):
            if getattr(self, name) not in (None, *known):
                raise OptionError(f"{name} {getattr(self, name)!r}; expected one of {', '.join(known)}")
        frames = [frame.value for frame in PointsFrame]
        if self.points_frame is not None and self.points_frame not in frames:
            raise OptionError(f"points_frame {self.points_frame!r}; expected one of {', '.join(frames)}")


def has_scene_header(path: Path) -> bool:
    """Report whether a file starts with `{` and has a header that ends in a NUL and names `$items`."""
    if not path.is_file():
        return False
    try:
        with open_file(path) as file:
            if not file.read(4096).lstrip(b" \t\r\n").startswith(b"{"):
                return False
            if path.suffix.lower() == ".sfs":
                return True
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as mapped:
                stop = mapped.find(b"\0", 0, _LOOKED_THROUGH)
                return stop > 0 and mapped.find(b'"$items"', 0, stop) > 0
    except (OSError, ValueError):
        return False


FORMAT = FormatSpec(
    name="sfs",
    title="a scene file",
    looks_like="a file that begins with the JSON header of a scene",
    suffixes=(".sfs",),
    sniff=has_scene_header,
    reader="sceneloom.formats.sfs.reader:read_scene",
    read_options=ReadingOptions,
    reads_urls=True,
    examiner="sceneloom.formats.sfs.reader:examine",
    writer="sceneloom.formats.sfs.writer:write_scene",
    write_options=("profile", "time_unit", "time_offset_ns"),
    supports=MappingProxyType(
        {
            "": KEPT,
            "sensors.depth_camera": dropped("the format has no cameras that measure depth"),
            "time_offset_ns": converted("chosen anew, so that small numbers are written; every time stays the same"),
        }
    ),
    holds_corrections=True,
)
