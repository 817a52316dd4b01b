"""Trajectories and paths of poses as messages."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from sceneloom.formats.topics.dialect import Dialect, Losses
from sceneloom.formats.topics.names import unique_parts
from sceneloom.formats.topics.records import PoseRecord
from sceneloom.formats.topics.streams import Said, Stream
from sceneloom.scene.poses import PosePath, Trajectory
from sceneloom.scene.scene import Scene

_PLACE_FIRST = np.array([3, 4, 5, 0, 1, 2])
"""Trajectories have covariances of turn, then place; messages of place, then turn."""


def way_of(scene: Scene) -> PosePath | None:
    """The way of the ego by which sensors on it are placed: the default trajectory, if it has orientations."""
    default = next(iter(scene.trajectories.values()), None)
    if default is None or default.quaternions_xyzw is None or len(default.timestamps_ns) == 0:
        return None
    return default.poses


def trajectory_streams(
    scene: Scene, dialect: Dialect, losses: Losses
) -> tuple[list[Stream], list[dict[str, Any]]]:
    """Say each trajectory on a topic of its own; give the streams and the notes of them."""
    parts = unique_parts([dialect.part(name) for name in scene.trajectories])
    streams, notes = [], []
    for (name, way), part in zip(scene.trajectories.items(), parts, strict=True):
        topic = f"/trajectories/{part}"
        if len(way.timestamps_ns) == 0:
            losses.dropped("trajectories", f"trajectory {name!r} without a pose")
            continue
        streams.append(Stream(way.timestamps_ns, _poses(topic, way, dialect)))
        notes.append({"name": name, "topic": topic})
        losses.dropped(
            f"trajectories[{name}].file_seconds", "stamps of the source", count=way.file_seconds is not None
        )
        if way.covariances is not None and not (dialect.covariances and way.quaternions_xyzw is not None):
            losses.dropped(f"trajectories[{name}].covariances", "messages of poses have none")
    return streams, notes


def _poses(topic: str, way: Trajectory, dialect: Dialect) -> Callable[[int], Iterator[Said]]:
    def make(k: int) -> Iterator[Said]:
        turn = None if way.quaternions_xyzw is None else way.quaternions_xyzw[k]
        spread = None
        if dialect.covariances and way.covariances is not None:
            spread = way.covariances[k][_PLACE_FIRST][:, _PLACE_FIRST]
        stamp_ns = int(way.timestamps_ns[k])
        yield topic, PoseRecord(stamp_ns, dialect.world, way.positions[k], turn, dialect.ego, spread)

    return make


def path_stream(path: PosePath, topic: str, parent: str, body: str) -> Stream:
    """Say the poses of a path."""

    def make(k: int) -> Iterator[Said]:
        stamp_ns = int(path.timestamps_ns[k])
        yield topic, PoseRecord(stamp_ns, parent, path.positions[k], path.quaternions_xyzw[k], body)

    return Stream(path.timestamps_ns, make)
