"""What data sets in the nuScenes schema make of each field of a scene."""

from types import MappingProxyType

from sceneloom.formats.holdings import Holds
from sceneloom.formats.loss import KEPT, converted, dropped

_NO_PLACE = dropped("the tables have no place for it")
_NEW = converted("the tables say it anew, what nuScenes has no such fields for is dropped")
_MICROSECONDS = converted("whole microseconds, halves to the even one")
_POSES = converted("the ego's pose at each frame, and the mounting")
_WORLD = converted("poses lead into the world")
_OWN_FRAME = converted("points are in the sensor's own frame")

_POSED = ("sensors.lidar", "sensors.radar", "sensors.camera")
_SWEPT = ("sensors.lidar", "sensors.radar")

HOLDS: Holds = MappingProxyType(
    {
        "": _NO_PLACE,
        "sensors.order": converted("lidars, radars, cameras, each by name"),
        **{f"{kind}.id": converted("names are texts") for kind in _POSED},
        **{f"{kind}.poses": _POSES for kind in _POSED},
        **{f"{kind}.coordinates": _WORLD for kind in _POSED},
        **{f"{kind}.mount": converted("quaternion and translation") for kind in _POSED},
        **{f"{kind}.extras": _NEW for kind in _POSED},
        **{f"{kind}.points_frame": _OWN_FRAME for kind in _SWEPT},
        **{f"{kind}.frames.timestamp_ns": _MICROSECONDS for kind in _SWEPT},
        **{f"{kind}.frames.extras": _NEW for kind in _SWEPT},
        **{
            f"{kind}.frames.points.positions": converted("in the sensor's own frame, float32")
            for kind in _SWEPT
        },
        "sensors.lidar.frames.points.intensities": KEPT,
        "sensors.lidar.frames.points.rings": KEPT,
        "sensors.radar.frames.points.directions": converted("with the lengths, as vx and vy"),
        "sensors.radar.frames.points.lengths": converted("with the directions, as vx and vy"),
        "sensors.radar.frames.points.extras": converted("the columns of nuScenes' radars, in their types"),
        "sensors.camera.camera": KEPT,
        "sensors.camera.video": converted("decoded, a file for each picture"),
        "sensors.camera.pictures.timestamp_ns": _MICROSECONDS,
        "sensors.camera.pictures.camera": converted("a row of lens and mounting for each that a picture has"),
        "sensors.camera.pictures.mount": converted("quaternion and translation"),
        "sensors.camera.pictures.rgb": KEPT,
        "sensors.camera.pictures.encoded": KEPT,
        "sensors.camera.pictures.extras": _NEW,
        "annotations.order": converted("cuboids, then classes of points"),
        "annotations.cuboid.id": converted("tokens are texts"),
        "annotations.cuboid.label": converted("a category; of objects without a class `unknown`"),
        "annotations.cuboid.path.timestamps_ns": converted("boxes are told at the samples"),
        "annotations.cuboid.path.values": converted("boxes at the samples, turned by quaternions"),
        "annotations.cuboid.path.extras": _NEW,
        "annotations.cuboid.attributes": converted(
            "names, visibility and numbers of points, told at the samples"
        ),
        "annotations.labeled_points": converted("a file of classes for each key frame"),
        "annotations.labeled_points.id": converted("`lidarseg:` and the name of the class"),
        "annotations.labeled_points.label": converted("a category"),
        "annotations.labeled_points.extras": converted("the number of the class"),
        "annotations.labeled_points.attributes": _NO_PLACE,
        "annotations.labeled_points.parent_id": _NO_PLACE,
        "annotations.labeled_points.type": converted("`labeled_points`"),
        "trajectories.name": converted("it is `pose`"),
        "trajectories.timestamps_ns": converted("a pose at each frame"),
        "trajectories.positions": converted("a pose at each frame"),
        "trajectories.quaternions_xyzw": converted("a pose at each frame"),
        "metadata": converted("what was read from such tables is written again"),
    }
)
"""What becomes of each field."""
