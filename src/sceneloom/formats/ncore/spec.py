"""NVIDIA NCore, version 4: recognition, options, and what a sequence can hold.

A sequence is one or several component stores (`NAME.ncore4[-GROUP].zarr.itar`, or folders `….zarr`), and perhaps a JSON
file that lists them.

Source: "Data Formats" and "Sensor Models" of the documentation of NCore.
"""

import re
from pathlib import Path
from types import MappingProxyType

from sceneloom.formats.base.files import read_bytes
from sceneloom.formats.base.losses import KEPT, Supports, approximated, converted, dropped
from sceneloom.formats.base.spec import FormatSpec, first_bytes

_STORE = re.compile(r"(?P<name>.*?)\.?ncore4(-(?P<group>.+))?\.zarr(\.itar)?")
_SEQUENCE = re.compile(rb'\s*\{\s*"sequence_id"\s*:')
_LOOKED_AT = 4096


def _is_store(path: Path) -> bool:
    """Whether a path is a component store, by its name and beginning."""
    if path.is_dir():
        attributes = path / ".zattrs"
        return (
            path.name.endswith(".zarr") and attributes.is_file() and b'"sequence_id"' in first_bytes(attributes, 65536)
        )
    return path.name.endswith(".zarr.itar") and path.is_file()


def is_sequence_file(path: Path) -> bool:
    """Whether a path is a JSON file that lists the stores of a sequence."""
    start = first_bytes(path, _LOOKED_AT)
    return _SEQUENCE.match(start) is not None and b'"component_stores"' in (
        start if len(start) < _LOOKED_AT else read_bytes(path)
    )


def sequences_in(path: Path) -> dict[str, list[Path]]:
    """The stores of a path, by the name of their sequence: those of a folder, or a single one."""
    if _is_store(path):
        return {path.name: [path]}
    found: dict[str, list[Path]] = {}
    for child in sorted(path.iterdir()) if path.is_dir() else ():
        if _is_store(child):
            match = _STORE.fullmatch(child.name)
            found.setdefault(match["name"] if match else child.name, []).append(child)
    return found


def _near_miss(path: Path) -> str | None:
    if path.is_dir() and path.name.endswith(".zarr"):
        return "it is a zarr store, but states no sequence_id as NCore's do"
    return None


_NO_FIELD = dropped("NCore has no component for it")
_MICROSECONDS = converted("whole microseconds")
_POSED = ("sensors.lidar", "sensors.radar", "sensors.camera")
_SWEPT = ("sensors.lidar", "sensors.radar")

SUPPORTS: Supports = MappingProxyType(
    {
        "": _NO_FIELD,
        "sensors.order": converted("cameras, lidars, radars, each by name"),
        **{f"{kind}.id": converted("names are texts") for kind in _POSED},
        **{f"{kind}.poses": converted("the ego's poses over time, and the mounting") for kind in _POSED},
        **{f"{kind}.coordinates": converted("poses lead into the world") for kind in _POSED},
        **{f"{kind}.mount": KEPT for kind in _POSED},
        **{f"{kind}.extras": converted("what was read from NCore is written again") for kind in _POSED},
        **{f"{kind}.points_frame": converted("points are in the sensor's own frame") for kind in _SWEPT},
        **{f"{kind}.frames.timestamp_ns": _MICROSECONDS for kind in _SWEPT},
        **{f"{kind}.frames.points.positions": converted("unit rays and distances, float32") for kind in _SWEPT},
        **{f"{kind}.frames.points.timestamps_ns": _MICROSECONDS for kind in _SWEPT},
        **{f"{kind}.frames.points.extras": converted("generic data of the frame") for kind in _SWEPT},
        "sensors.lidar.frames.points.intensities": converted("as shares of 255"),
        **{
            f"sensors.lidar.frames.points.{name}": converted("generic data of the frame")
            for name in ("rings", "colors", "camera_index")
        },
        **{
            f"sensors.radar.frames.points.{name}": converted("the speed along the ray")
            for name in ("directions", "lengths")
        },
        "sensors.camera.camera": converted("pixels counted from the image's corner"),
        "sensors.camera.video": converted("decoded, an image for each frame"),
        "sensors.camera.images.timestamp_ns": _MICROSECONDS,
        "sensors.camera.images.rgb": KEPT,
        "sensors.camera.images.encoded": KEPT,
        "annotations.order": converted("cuboids by track"),
        "annotations.cuboid.id": converted("names are texts"),
        "annotations.cuboid.label": converted("of objects without a class `unknown`"),
        "annotations.cuboid.path.timestamps_ns": _MICROSECONDS,
        "annotations.cuboid.path.values": approximated("in radians, in the world"),
        "trajectories.name": converted("it is `rig`"),
        "trajectories.timestamps_ns": _MICROSECONDS,
        "trajectories.positions": converted("matrices"),
        "trajectories.quaternions_xyzw": converted("matrices"),
        "metadata": converted("what was read from NCore is written again"),
    }
)

FORMAT = FormatSpec(
    name="ncore",
    title="NCore",
    looks_like="a .zarr.itar file or .zarr folder of NVIDIA NCore v4, a folder of these, or a sequence's JSON file",
    suffixes=(".zarr.itar",),
    sniff=lambda path: bool(sequences_in(path)) or is_sequence_file(path),
    near_miss=_near_miss,
    drives=lambda path: tuple(sequences_in(path)) if path.is_dir() and not _is_store(path) else (),
    reader="sceneloom.formats.ncore.sequences:open_ncore",
    read_options=("lenient", "sequence"),
    writer="sceneloom.formats.ncore.sequences:write_ncore",
    write_options=("images", "trajectory"),
    supports=SUPPORTS,
    along_trajectory=True,
    extra="ncore",
)
