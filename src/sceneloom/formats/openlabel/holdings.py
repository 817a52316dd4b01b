"""What OpenLABEL makes of each field of the scene."""

from collections.abc import Mapping
from types import MappingProxyType

from sceneloom.formats.loss import KEPT, Holding, converted, dropped

_ELSEWHERE = dropped(
    "left out: OpenLABEL refers to what sensors measured by the names of files, and does not hold it"
)
_NO_PLACE = dropped("left out: OpenLABEL has no place for it")
_SENSOR: Mapping[str, Holding] = {
    "id": KEPT,
    "parent_id": _NO_PLACE,
    "extras": dropped("left out but for uri and description"),
    "poses": converted(
        "told by the mounting and the ego's way, else as transforms at the times of the frames"
    ),
    "mount": KEPT,
    "coordinates": converted("told by the tree of coordinate systems"),
    "points_frame": _ELSEWHERE,
    "model": _NO_PLACE,
    "frames": _ELSEWHERE,
}
_CAMERA: Mapping[str, Holding] = {
    **{name: _SENSOR[name] for name in ("id", "parent_id", "extras", "poses", "mount", "coordinates")},
    "camera": KEPT,
    "pictures": _ELSEWHERE,
    "video": _ELSEWHERE,
    "fps": _NO_PLACE,
}
_SAMPLED = converted(
    "transforms of the ego at the times of the frames, which are those of annotations and sweeps"
)

HOLDS: Mapping[str, Holding] = MappingProxyType(
    {
        "": _NO_PLACE,
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
        "annotations.cuboid.path.values": converted("centre, quaternion and sizes in place of angles"),
        "annotations.cuboid.projections.boxes": converted("centre and size in place of corner and size"),
        "annotations.box_2d.path.values": converted("centre and size in place of corner and size"),
        "annotations.localization_adjustment": _NO_PLACE,
        "annotations.camera_calibration": _NO_PLACE,
        "annotations.plain": _NO_PLACE,
        "trajectories": _SAMPLED,
        "trajectories.name": KEPT,
        "trajectories.order": dropped("left out: the format has one way of the ego"),
        "trajectories.file_seconds": _NO_PLACE,
        "trajectories.covariances": _NO_PLACE,
        "metadata": KEPT,
    }
)
