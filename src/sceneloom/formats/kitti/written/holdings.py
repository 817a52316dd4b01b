"""What KITTI's folders make of each field of a scene: what all of them have in common, and what each has besides."""

from collections.abc import Mapping
from types import MappingProxyType

from sceneloom.formats.loss import KEPT, Holding, approximated, converted, dropped

_NO_PLACE = dropped("the folder has no place for it")
_NUMBERED = converted("cameras are numbered 0 to 3, the lidar is `velodyne`")
_BY_NAME = dropped("it is given anew from where files are")
_TEXT = converted("decimals of text, all digits")
_LABEL = approximated("six decimals of text; boxes go with pictures that are resampled")
_FRAMES = approximated("numbers of frames, whose times count")
_ALONG = approximated("along the ego's way with the mounting, at the frames' times")
_FROM_LIDAR = approximated("as seen from the lidar: no file says where the ego is")

_SENSORS: Mapping[str, Holding] = MappingProxyType(
    {
        "": _NO_PLACE,
        "sensors.order": converted("the lidar, then cameras by number"),
        "sensors.lidar.id": _NUMBERED,
        "sensors.lidar.poses": converted("along the ego's way with the mounting"),
        "sensors.lidar.coordinates": converted("poses lead into the world"),
        "sensors.lidar.mount": _TEXT,
        "sensors.lidar.points_frame": converted("points are in the lidar's own frame"),
        "sensors.lidar.frames.timestamp_ns": KEPT,
        "sensors.lidar.frames.points.positions": KEPT,
        "sensors.lidar.frames.points.intensities": converted("reflectance from 0 to 1"),
        "sensors.lidar.frames.points.timestamps_ns": dropped("points have no times"),
        "sensors.lidar.frames.extras": _BY_NAME,
        "sensors.camera.id": _NUMBERED,
        "sensors.camera.poses": converted("along the ego's way with the mounting"),
        "sensors.camera.coordinates": converted("poses lead into the world"),
        "sensors.camera.mount": _TEXT,
        "sensors.camera.camera": approximated("pinholes; pictures of other lenses are resampled"),
        "sensors.camera.video": converted("decoded, a PNG for each picture"),
        "sensors.camera.pictures.timestamp_ns": KEPT,
        "sensors.camera.pictures.rgb": KEPT,
        "sensors.camera.pictures.encoded": converted("decoded, a PNG for each picture"),
        "sensors.camera.pictures.extras": _BY_NAME,
        "metadata": dropped("only what was read from such a folder is written again"),
    }
)

_MOTION: Mapping[str, Holding] = MappingProxyType(
    {
        "sensors.imu.id": converted("it is `imu`"),
        "sensors.imu.streams.accelerometer": approximated("a value for each line"),
        "sensors.imu.streams.gyroscope": approximated("a value for each line"),
        "sensors.imu.streams.other": approximated(
            "those of the OXTS unit, of its own lines; others are dropped"
        ),
        "sensors.imu.streams.other.file_seconds": _NO_PLACE,
        "sensors.imu.streams.accelerometer.file_seconds": _NO_PLACE,
        "sensors.imu.streams.gyroscope.file_seconds": _NO_PLACE,
        "sensors.gnss.id": converted("it is `gnss`"),
        "sensors.gnss.timestamps_ns": approximated("a fix for each line"),
        "sensors.gnss.positions_lla": approximated("the places of the ego's way"),
        "sensors.gnss.accuracies": approximated("an accuracy for each line"),
        "sensors.odometry.poses": approximated("a pose for each line, where no trajectory is told"),
        "trajectories.name": converted("it is `oxts`"),
        "trajectories.timestamps_ns": approximated("a pose for each line"),
        "trajectories.positions": converted("latitude, longitude and altitude"),
        "trajectories.quaternions_xyzw": converted("roll, pitch and yaw"),
    }
)

_BOXES: Mapping[str, Holding] = MappingProxyType(
    {
        "annotations.order": converted("by frame, then as they were"),
        "annotations.cuboid.label": converted("a word without blanks"),
        "annotations.cuboid.path.timestamps_ns": _FRAMES,
        "annotations.cuboid.path.values": approximated("upright boxes in frames whose pictures show them"),
        "annotations.cuboid.attributes": approximated(
            "truncated, occluded, alpha and score; others are dropped"
        ),
        "annotations.cuboid.projections.sensor_id": converted("the reference camera"),
        "annotations.cuboid.projections.timestamps_ns": _FRAMES,
        "annotations.cuboid.projections.boxes": _LABEL,
        "annotations.box_2d.label": converted("a word without blanks"),
        "annotations.box_2d.sensor_id": converted("the reference camera"),
        "annotations.box_2d.path.timestamps_ns": _FRAMES,
        "annotations.box_2d.path.values": _LABEL,
        "annotations.box_2d.attributes": approximated("truncated, occluded and alpha; others are dropped"),
    }
)

_ONE_TIME = approximated("a frame has one time for all sensors")
_NO_TIME = dropped("frames have numbers and no times")

RAW: Mapping[str, Holding] = MappingProxyType(
    {
        **_SENSORS,
        **_MOTION,
        "sensors.lidar.frames.points.timestamps_ns": approximated("told by directions, where that holds"),
        "sensors.camera.camera": approximated("brown_conrady's k1 k2 p1 p2 k3 in `extract`, else pinholes"),
        "annotations.order": KEPT,
        "annotations.cuboid.id": dropped("tracklets have none"),
        "annotations.cuboid.label": KEPT,
        "annotations.cuboid.path.timestamps_ns": _FRAMES,
        "annotations.cuboid.path.values": approximated(
            "one size, in the lidar's frame, in all frames of a run"
        ),
        "annotations.cuboid.attributes": approximated("the states of tracklets; others are dropped"),
    }
)
"""Of a drive of the raw data."""

TRACKING: Mapping[str, Holding] = MappingProxyType(
    {
        **_SENSORS,
        **_MOTION,
        **_BOXES,
        "sensors.lidar.poses": _ALONG,
        "sensors.camera.poses": _ALONG,
        "sensors.lidar.frames.timestamp_ns": _ONE_TIME,
        "sensors.camera.pictures.timestamp_ns": _ONE_TIME,
        "annotations.cuboid.id": converted("numbers of tracks"),
        "annotations.box_2d.id": converted("numbers of tracks"),
    }
)
"""Of a sequence of the tracking benchmark."""

OBJECT: Mapping[str, Holding] = MappingProxyType(
    {
        **_SENSORS,
        **_BOXES,
        "sensors.lidar.mount": _FROM_LIDAR,
        "sensors.camera.mount": _FROM_LIDAR,
        "sensors.lidar.poses": dropped("every frame's world is its own lidar's frame"),
        "sensors.camera.poses": dropped("every frame's world is its own lidar's frame"),
        "sensors.lidar.frames.timestamp_ns": _NO_TIME,
        "sensors.camera.pictures.timestamp_ns": _NO_TIME,
        "sensors.camera.pictures.camera": converted("a calibration for each frame"),
        "sensors.camera.pictures.mount": _FROM_LIDAR,
        "annotations.cuboid.id": dropped("frames know nothing of each other"),
        "annotations.box_2d.id": dropped("frames know nothing of each other"),
    }
)
"""Of frames of the object benchmark."""

ODOMETRY: Mapping[str, Holding] = MappingProxyType(
    {
        **_SENSORS,
        "sensors.lidar.poses": _ALONG,
        "sensors.camera.poses": _ALONG,
        "sensors.lidar.frames.timestamp_ns": _ONE_TIME,
        "sensors.camera.pictures.timestamp_ns": _ONE_TIME,
        "sensors.lidar.mount": _FROM_LIDAR,
        "sensors.camera.mount": _FROM_LIDAR,
        "sensors.odometry.poses": approximated("a pose for each frame, where no trajectory is told"),
        "trajectories.name": converted("it is `groundTruth`"),
        "trajectories.timestamps_ns": approximated("a pose for each frame"),
        "trajectories.positions": converted("of camera 0, seen from its first pose"),
        "trajectories.quaternions_xyzw": converted("rows of a matrix"),
        "annotations.order": converted("by number"),
        "annotations.labeled_points.id": converted("names and numbers of SemanticKITTI"),
        "annotations.labeled_points.label": converted("a number of SemanticKITTI, where it has one"),
        "annotations.labeled_points.is_instance": converted("whether it has a number of its own"),
        "annotations.labeled_points.labeled_points": approximated(
            "points of sweeps whose class has a number"
        ),
        "annotations.labeled_points.labeled_points.sensor_id": _NUMBERED,
        "annotations.labeled_points.labeled_points.extras": _NO_PLACE,
    }
)
"""Of a sequence of the odometry benchmark, with SemanticKITTI's labels."""
