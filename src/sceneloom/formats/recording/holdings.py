"""What a recording holds of a scene; what depends on the scene, such as names and videos, is told while writing."""

from types import MappingProxyType

from sceneloom.formats.holdings import Holds
from sceneloom.formats.loss import KEPT, converted, dropped
from sceneloom.scene.contents import MODEL_FIELDS

_NO_PLACE = dropped("the format has none")

_FILE_SECONDS = tuple(field for field in MODEL_FIELDS if field.endswith(".file_seconds"))

HOLDS: Holds = MappingProxyType(
    {
        "": KEPT,
        "sensors.radar": _NO_PLACE,
        "sensors.points": _NO_PLACE,
        "sensors.plain": _NO_PLACE,
        **{
            f"sensors.{kind}.parent_id": _NO_PLACE
            for kind in ("lidar", "camera", "depth_camera", "odometry", "imu", "gnss")
        },
        "sensors.lidar.frames.points.colors": _NO_PLACE,
        "sensors.lidar.frames.points.camera_index": _NO_PLACE,
        **{
            f"sensors.{kind}.coordinates": converted("places are told by the mounting and the ego's way")
            for kind in ("lidar", "camera", "depth_camera")
        },
        "sensors.camera.video": converted("packets are copied into a file of another kind"),
        "sensors.camera.pictures.encoded": dropped("pictures are written as a video, or as PNG"),
        "sensors.depth_camera.video": converted("encoded anew as FFV1, which loses nothing"),
        **dict.fromkeys(_FILE_SECONDS, converted("written anew where they do not say the exact times")),
        "sensors.odometry.id": converted("the name of a trajectory"),
        "sensors.odometry.poses": converted("written as a trajectory"),
        "annotations": _NO_PLACE,
        "trajectories.covariances": _NO_PLACE,
        "attributes": _NO_PLACE,
        "time_offset_ns": converted("times are written whole"),
    }
)
