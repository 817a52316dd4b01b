"""What folders of posed pictures make of each field of the scene."""

from types import MappingProxyType

from sceneloom.formats.holdings import Holds
from sceneloom.formats.loss import KEPT, approximated, converted, dropped

_PICTURES_ONLY = dropped("left out: the target holds pictures with lenses and poses, and points")
_THINNED = approximated("one point per cube, in the world as at the time of its sweep")

HOLDS: Holds = MappingProxyType(
    {
        "": _PICTURES_ONLY,
        "sensors.camera.id": converted("the folder of the camera's pictures"),
        "sensors.camera.camera": converted(
            "the target's own model, pixels counted from the picture's corner"
        ),
        "sensors.camera.poses": converted("the pose of each picture in the world"),
        "sensors.camera.mount": converted("the pose of each picture in the world"),
        "sensors.camera.coordinates": converted("the pose of each picture in the world"),
        "sensors.camera.video": approximated("single pictures"),
        "sensors.camera.pictures.timestamp_ns": converted("in the name of the picture's file"),
        "sensors.camera.pictures.camera": KEPT,
        "sensors.camera.pictures.mount": converted("the pose of each picture in the world"),
        "sensors.camera.pictures.rgb": KEPT,
        "sensors.camera.pictures.encoded": KEPT,
        "sensors.lidar.frames.points.positions": _THINNED,
        "sensors.lidar.frames.points.colors": _THINNED,
        "sensors.lidar.frames.points.intensities": approximated("grey, where points have no colours"),
        "sensors.points.positions": _THINNED,
        "sensors.points.colors": _THINNED,
    }
)
