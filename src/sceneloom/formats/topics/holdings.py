"""What logs of messages make of each field of a scene, whatever their format."""

from collections.abc import Mapping
from types import MappingProxyType

from sceneloom.formats.loss import KEPT, Holding, converted, dropped

_NO_MESSAGE = "there are no messages for it"
_SOURCE_STAMPS = "stamps of the source are not written beside our own"
_JSON = converted("written as JSON; values that JSON cannot say are dropped, which is told")

dropped_here = dropped

_ALONG = converted("told by the mounting and the ego's way where these say the same, within their rounding")
_QUATERNION = converted("rotations become unit quaternions")


def _swept(kind: str) -> dict[str, Holding]:
    return {
        f"{kind}.mount": _QUATERNION,
        f"{kind}.poses": _ALONG,
        f"{kind}.extras": _JSON,
        f"{kind}.frames.extras": dropped(_NO_MESSAGE),
        f"{kind}.frames.points.extras": converted(
            "fields of 32 bits, and floats of 64; whole numbers of 64 bits become floats, others than one number for "
            "each point are dropped, which is told"
        ),
    }


def _seeing(kind: str, frames: str) -> dict[str, Holding]:
    return {
        f"{kind}.mount": _QUATERNION,
        f"{kind}.poses": _ALONG,
        f"{kind}.extras": _JSON,
        f"{kind}.camera": converted(
            "lenses that other programs do not know are written as only we read them"
        ),
        f"{kind}.{frames}.mount": converted(
            "transforms, at the times of pictures where they are not all the same"
        ),
        f"{kind}.{frames}.extras": dropped(_NO_MESSAGE),
    }


TOPIC_HOLDS: Mapping[str, Holding] = MappingProxyType(
    {
        "": KEPT,
        **_swept("sensors.lidar"),
        **_swept("sensors.radar"),
        **_seeing("sensors.camera", "pictures"),
        **_seeing("sensors.depth_camera", "frames"),
        "sensors.points.extras": _JSON,
        "sensors.odometry.extras": _JSON,
        "sensors.imu.extras": _JSON,
        "sensors.gnss.extras": _JSON,
        "sensors.gnss.mount": _QUATERNION,
        "sensors.camera.pictures.encoded": converted("JPEG files are copied"),
        "sensors.camera.video": converted(
            "H.264 and HEVC are copied packet by packet, others become JPEG files"
        ),
        "sensors.depth_camera.video": dropped("depth images are written one by one"),
        "sensors.depth_camera.frames.scale": converted(
            "millimetres are kept; other steps become floats of metres"
        ),
        "sensors.imu.streams.accelerometer.file_seconds": dropped(_SOURCE_STAMPS),
        "sensors.imu.streams.gyroscope.file_seconds": dropped(_SOURCE_STAMPS),
        "sensors.imu.streams.magnetometer.file_seconds": dropped(_SOURCE_STAMPS),
        "sensors.imu.streams.other.file_seconds": dropped(_SOURCE_STAMPS),
        "sensors.gnss.accuracies": converted("variances are written, as large to the east as to the north"),
        "sensors.gnss.vertical_accuracies": converted("variances are written"),
        "sensors.gnss.file_seconds": dropped(_SOURCE_STAMPS),
        "sensors.plain": dropped(_NO_MESSAGE),
        "sensors.order": KEPT,
        "trajectories.file_seconds": dropped(_SOURCE_STAMPS),
        "annotations": dropped("there are drawings of cuboids and of boxes in pictures only"),
        "annotations.order": KEPT,
        "annotations.cuboid": KEPT,
        "annotations.cuboid.path.values": converted(
            "angles become unit quaternions, which do not tell whole turns"
        ),
        "annotations.cuboid.path.extras": dropped(_NO_MESSAGE),
        "annotations.cuboid.extras": _JSON,
        "annotations.cuboid.attributes": _JSON,
        "annotations.cuboid.activations": dropped(_NO_MESSAGE),
        "annotations.cuboid.projections": dropped(_NO_MESSAGE),
        "annotations.box_2d": KEPT,
        "annotations.box_2d.path.extras": dropped(_NO_MESSAGE),
        "annotations.box_2d.path.values": converted("corners are written, whose differences are the size"),
        "annotations.box_2d.extras": _JSON,
        "annotations.box_2d.attributes": _JSON,
        "attributes": _JSON,
        "metadata": _JSON,
        "extras": _JSON,
    }
)
