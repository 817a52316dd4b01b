"""Types of ROS messages: as a bag defines them, else as a distribution of ROS does."""

from collections.abc import Mapping
from functools import cache
from types import MappingProxyType
from typing import Any

from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore

from sceneloom.errors import OptionError
from sceneloom.formats.ros.bags import Connection

DEFINITIONS: Mapping[str, str] = MappingProxyType(
    {
        "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformTimestamped[] transforms\n",
        "vision_msgs/msg/Point2D": "float64 x\nfloat64 y\n",
        "vision_msgs/msg/Pose2D": "vision_msgs/Point2D position\nfloat64 theta\n",
        "vision_msgs/msg/BoundingBox2D": "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n",
        "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
        "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
        "vision_msgs/msg/ObjectHypothesisWithPose": (
            "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n"
        ),
        "vision_msgs/msg/Detection2D": (
            "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
            "vision_msgs/BoundingBox2D bbox\nstring id\n"
        ),
        "vision_msgs/msg/Detection2DArray": "std_msgs/Header header\nvision_msgs/Detection2D[] detections\n",
        "vision_msgs/msg/Detection3D": (
            "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
            "vision_msgs/BoundingBox3D bbox\nstring id\n"
        ),
        "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n",
        "foxglove_msgs/msg/CompressedVideo": (
            "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n"
        ),
    }
)
"""Definitions of types that rosbags does not have, by name; those that others use come before them.

Source: packages vision_msgs (4.0), tf2_msgs and foxglove_msgs of ROS 2.
"""

USUAL_DISTRO = {"ros1": "noetic", "cdr": "humble"}
"""The distribution whose types are taken where nothing is stated, by the encoding of messages."""


def distros() -> tuple[str, ...]:
    """The distributions whose types are known."""
    return tuple(store.value.partition("_")[2] for store in Stores if "_" in store.value)


@cache
def distro_store(distro: str) -> Any:
    """Give the types of a distribution, and those that it lacks.

    Raises:
        OptionError: there is no such distribution.
    """
    found = [store for store in Stores if store.value.partition("_")[2] == distro]
    if not found:
        raise OptionError(f"distro {distro!r}; expected one of {', '.join(distros())}")
    store = get_typestore(found[0])
    for name, text in DEFINITIONS.items():
        if name not in store.fielddefs:
            store.register(get_types_from_msg(text, name))
    return store


def store_of(connection: Connection, distro: str | None) -> Any:
    """Give the types that a connection's messages are read with: the bag's own definition counts.

    Raises:
        ValueError: the bag has no definition of the type, and the distribution does not know it either.
        OptionError: there is no such distribution.
    """
    if connection.definition:
        return _defined(connection.type, connection.definition, connection.form)
    store = distro_store(distro or USUAL_DISTRO[connection.encoding])
    if connection.type not in store.fielddefs:
        raise ValueError(
            f"the bag does not define {connection.type}, and neither does ROS {distro or 'by itself'}"
        )
    return store


@cache
def _defined(name: str, definition: str, form: str) -> Any:
    """The types that a text defines."""
    store = get_typestore(Stores.EMPTY)
    try:
        if form == "ros2idl":
            store.register(get_types_from_idl(definition))
        else:
            store.register(get_types_from_msg(definition, name))
    except (TypesysError, KeyError, ValueError) as error:
        raise ValueError(f"a definition of {name} that cannot be read: {error}") from error
    if name not in store.fielddefs:
        raise ValueError(f"the bag's definition of {name} does not define it")
    return store
