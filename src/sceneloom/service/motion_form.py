"""The trajectory of the vehicle as messages, and back."""

import numpy as np

from sceneloom.errors import DataError
from sceneloom.fusion.messages.protobuf_fields import timestamp_from_protobuf, timestamp_to_protobuf
from sceneloom.fusion.messages.timestamps import Timestamp
from sceneloom.fusion.messages.wire import fusion_pb2
from sceneloom.scene.poses import Poses


def motion_request(path: Poses, *, session: str = "") -> fusion_pb2.SendMotionRequest:
    """Give the message of a trajectory.

    Raises:
        DataError: it has no times, or one that a timestamp cannot state.
    """
    if path.static:
        raise DataError("motion", "poses", "a location without times; expected poses with times")
    poses = [
        fusion_pb2.Pose(
            timestamp=timestamp_to_protobuf(Timestamp.of(timestamp_ns)),
            position=position,
            quaternion_xyzw=quaternion,
        )
        for timestamp_ns, position, quaternion in zip(
            path.timestamps_ns.tolist(),
            path.positions.tolist(),
            path.quaternions_xyzw.tolist(),
            strict=True,
        )
    ]
    return fusion_pb2.SendMotionRequest(poses=poses, session=session)


def path_of(request: fusion_pb2.SendMotionRequest) -> Poses:
    """Give the trajectory of a message.

    Raises:
        DataError: a pose has more or fewer numbers.
        ArrayError: the poses are no path.
    """
    poses = request.poses
    for k, pose in enumerate(poses):
        found = len(pose.position), len(pose.quaternion_xyzw)
        if found != (3, 4):
            problem = f"{found[0]} and {found[1]} numbers; expected a position of 3 and a quaternion of 4"
            raise DataError("motion", f"poses[{k}]", problem)
    times = [
        timestamp_from_protobuf(pose.timestamp, "motion", f"poses[{k}].timestamp").nanoseconds
        for k, pose in enumerate(poses)
    ]
    return Poses(
        np.array(times, np.int64),
        np.array([list(pose.position) for pose in poses], np.float64).reshape(-1, 3),
        np.array([list(pose.quaternion_xyzw) for pose in poses], np.float64).reshape(-1, 4),
    )
