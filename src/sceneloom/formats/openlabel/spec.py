"""ASAM OpenLABEL 1.0: annotations, sensors without their frames, and the trajectory of the ego, as JSON."""

import re
from pathlib import Path
from types import MappingProxyType

from sceneloom.formats.base.losses import KEPT, Supports, converted, dropped
from sceneloom.formats.base.spec import FormatSpec, first_bytes

_BEGINNING = 4096
_FIRST = re.compile(rb"(?:\xef\xbb\xbf)?\s*\{\s*\"openlabel\"\s*:")
_OLD = re.compile(rb"\s*\{\s*\"vcd\"\s*:")


def _near_miss(path: Path) -> str | None:
    if _OLD.match(first_bytes(path, _BEGINNING)) is None:
        return None
    return "it is of VCD, which OpenLABEL came from; bring it to OpenLABEL 1.0 with the program `vcd`"


_ELSEWHERE = dropped("left out: OpenLABEL refers to what sensors measured by the names of files, and does not hold it")
_NO_POSITION = dropped("left out: OpenLABEL has no field for it")
_SENSOR: Supports = {
    "id": KEPT,
    "parent_id": _NO_POSITION,
    "extras": dropped("left out but for uri and description"),
    "poses": converted(
        "reported by the mounting and the ego trajectory, else as transforms at the times of the frames"
    ),
    "mount": KEPT,
    "coordinates": converted("reported by the tree of coordinate systems"),
    "points_frame": _ELSEWHERE,
    "model": _NO_POSITION,
    "frames": _ELSEWHERE,
}
_CAMERA: Supports = {
    **{name: _SENSOR[name] for name in ("id", "parent_id", "extras", "poses", "mount", "coordinates")},
    "camera": KEPT,
    "images": _ELSEWHERE,
    "video": _ELSEWHERE,
    "fps": _NO_POSITION,
}
_SAMPLED = converted("transforms of the ego at the times of the frames, which are those of annotations and sweeps")

SUPPORTS: Supports = MappingProxyType(
    {
        "": _NO_POSITION,
        "sensors.order": KEPT,
        **{f"sensors.lidar.{name}": holding for name, holding in _SENSOR.items()},
        **{f"sensors.radar.{name}": holding for name, holding in _SENSOR.items() if name != "model"},
        **{f"sensors.camera.{name}": holding for name, holding in _CAMERA.items()},
        "sensors.imu": _ELSEWHERE,
        "sensors.imu.id": KEPT,
        "sensors.gnss": _ELSEWHERE,
        "sensors.gnss.id": KEPT,
        "sensors.gnss.mount": KEPT,
        "annotations": KEPT,
        "annotations.order": converted("objects come first, then events, then links"),
        "annotations.cuboid.path.values": converted("centre, quaternion and sizes instead of angles"),
        "annotations.cuboid.projections.boxes": converted("centre and size instead of corner and size"),
        "annotations.box_2d.path.values": converted("centre and size instead of corner and size"),
        "annotations.localization_adjustment": _NO_POSITION,
        "annotations.camera_calibration": _NO_POSITION,
        "annotations.plain": _NO_POSITION,
        "trajectories": _SAMPLED,
        "trajectories.name": KEPT,
        "trajectories.order": dropped("left out: the format has one ego trajectory"),
        "trajectories.file_seconds": _NO_POSITION,
        "trajectories.covariances": _NO_POSITION,
        "metadata": KEPT,
    }
)

FORMAT = FormatSpec(
    name="openlabel",
    title="OpenLABEL",
    looks_like='a .json file that begins with {"openlabel": …',
    suffixes=(".json",),
    sniff=lambda path: _FIRST.match(first_bytes(path, _BEGINNING)) is not None,
    near_miss=_near_miss,
    reader="sceneloom.formats.openlabel.reader:read_openlabel",
    read_options=("lenient", "rate_hz"),
    writer="sceneloom.formats.openlabel.writer:write_openlabel",
    supports=SUPPORTS,
)
