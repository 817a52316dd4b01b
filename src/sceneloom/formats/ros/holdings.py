"""What a bag of ROS makes of each field of a scene."""

from collections.abc import Mapping
from types import MappingProxyType

from sceneloom.formats.loss import Holding, approximated, converted, dropped
from sceneloom.formats.topics.holdings import TOPIC_HOLDS

HOLDS: Mapping[str, Holding] = MappingProxyType(
    {
        **TOPIC_HOLDS,
        "sensors.camera.video": approximated(
            'pictures become JPEG files, unless foxglove_msgs are asked for (pictures="video")'
        ),
        "sensors.imu.streams.magnetometer.values": converted("tesla in place of µT"),
        "sensors.imu.streams.other": dropped(
            "there are messages for temperatures only, which are converted to °C"
        ),
        "annotations.box_2d.path.values": converted("centre and size are written"),
        "trajectories.covariances": converted("place before turn"),
    }
)
