"""What files of points make of each field of the scene."""

from collections.abc import Mapping
from types import MappingProxyType

from sceneloom.formats.holdings import Holds
from sceneloom.formats.loss import KEPT, Holding, approximated, converted, dropped

_POINTS_ONLY = dropped("left out: files of points hold the frames of lidars only")
_LIDAR: Mapping[str, Holding] = {
    "sensors.lidar": KEPT,
    "sensors.lidar.id": converted("the name of the lidar's folder, as text; one lidar alone is read back as 'lidar'"),
    "sensors.lidar.poses": converted("a file of poses beside the clouds, at the times of the frames"),
    "sensors.lidar.mount": converted("part of the poses beside the clouds; without them only the identity is kept"),
    "sensors.lidar.coordinates": converted("the file of poses leads into the world"),
    "sensors.lidar.points_frame": converted("told by the name of the file of poses beside the clouds, if there is one"),
    "sensors.lidar.model": dropped("left out: files of points say nothing of the device"),
    "sensors.lidar.parent_id": dropped("left out: files of points say nothing of the device"),
    "sensors.lidar.extras": converted("the scale of the brightness is seen in the files; others are dropped"),
    "sensors.lidar.frames.timestamp_ns": converted("the name of the file, in nanoseconds"),
    "sensors.lidar.frames.extras": converted("names of files are given anew; others are dropped"),
    "sensors.lidar.frames.points.timestamps_ns": converted("a column of nanoseconds from the frame's time on"),
    "sensors.lidar.frames.points.extras": converted("columns, if they are numbers with a row per point"),
}  # fmt: skip
_STEPS = approximated("rounded to steps of 0.01 mm, or 1 mm where points are more than 20 km apart")
_NONE = dropped("left out: such files have x y z and intensity only, nuScenes' the laser, too")
_OF_KIND: Mapping[str, Mapping[str, Holding]] = {
    "las": {"sensors.lidar.frames.points.positions": _STEPS},
    "laz": {"sensors.lidar.frames.points.positions": _STEPS},
    "kitti-bin": {
        f"sensors.lidar.frames.points.{name}": _NONE
        for name in ("timestamps_ns", "colors", "rings", "camera_index", "extras")
    },
    "nuscenes-bin": {
        f"sensors.lidar.frames.points.{name}": _NONE
        for name in ("timestamps_ns", "colors", "camera_index", "extras")
    },
}


def holds_of(kind: str) -> Holds:
    """The table of a kind."""
    return MappingProxyType({"": _POINTS_ONLY, **_LIDAR, **_OF_KIND.get(kind, {})})
