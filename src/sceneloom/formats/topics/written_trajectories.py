"""Trajectories and paths of poses as messages."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from sceneloom.formats.topics.dialect import Dialect, Losses
from sceneloom.formats.topics.names import unique_parts
from sceneloom.formats.topics.records import PoseRecord
from sceneloom.formats.topics.streams import Stated, Stream
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Scene

_LOCATION_FIRST = np.array([3, 4, 5, 0, 1, 2])
"""Trajectories have covariances of rotation, then location; messages of location, then rotate."""


def trajectory_of(scene: Scene) -> Poses | None:
    """The ego trajectory by which sensors on it are placed: the default trajectory, if it has orientations."""
    default = next(iter(scene.trajectories.values()), None)
    if default is None or default.quaternions_xyzw is None or len(default.timestamps_ns) == 0:
        return None
    return default.poses


def trajectory_streams(
    scene: Scene, dialect: Dialect, losses: Losses
) -> tuple[list[Stream], list[dict[str, Any]]]:
    """Report each trajectory on a topic of its own; give the streams and the notes of them."""
    parts = unique_parts([dialect.part(name) for name in scene.trajectories])
    streams, notes = [], []
    for (name, trajectory), part in zip(scene.trajectories.items(), parts, strict=True):
        topic = f"/trajectories/{part}"
        if len(trajectory.timestamps_ns) == 0:
            losses.dropped("trajectories", f"trajectory {name!r} without a pose")
            continue
        streams.append(Stream(trajectory.timestamps_ns, _poses(topic, trajectory, dialect)))
        notes.append({"name": name, "topic": topic})
        losses.dropped(
            f"trajectories[{name}].file_seconds",
            "timestamps of the source",
            count=trajectory.file_seconds is not None,
        )
        if trajectory.covariances is not None and not (
            dialect.covariances and trajectory.quaternions_xyzw is not None
        ):
            losses.dropped(f"trajectories[{name}].covariances", "messages of poses have none")
    return streams, notes


def _poses(topic: str, trajectory: Trajectory, dialect: Dialect) -> Callable[[int], Iterator[Stated]]:
    def make(k: int) -> Iterator[Stated]:
        rotation = None if trajectory.quaternions_xyzw is None else trajectory.quaternions_xyzw[k]
        spread = None
        if dialect.covariances and trajectory.covariances is not None:
            spread = trajectory.covariances[k][_LOCATION_FIRST][:, _LOCATION_FIRST]
        timestamp_ns = int(trajectory.timestamps_ns[k])
        yield (
            topic,
            PoseRecord(timestamp_ns, dialect.world, trajectory.positions[k], rotation, dialect.ego, spread),
        )

    return make


def path_stream(path: Poses, topic: str, parent: str, body: str) -> Stream:
    """Report the poses of a path."""

    def make(k: int) -> Iterator[Stated]:
        timestamp_ns = int(path.timestamps_ns[k])
        yield topic, PoseRecord(timestamp_ns, parent, path.positions[k], path.quaternions_xyzw[k], body)

    return Stream(path.timestamps_ns, make)
