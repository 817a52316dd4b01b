"""Drives whose truth is known by formula, as a tracker sees them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sceneloom.cameras.camera import Camera
from sceneloom.detections import FusedBoxes
from sceneloom.detections.projection import project_outlines
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.tracking import Observation, View

Path = Callable[[float], tuple[float, float, float]]
"""Where an object is at a time [s]: x, y [m] and heading [rad] in the world."""

LOOKING = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
FRONT = View(Camera("pinhole", 1200, 400, 700.0, 700.0, 599.5, 199.5), RigidTransform(LOOKING, np.zeros(3)))
SIZES = {"Car": (4.2, 1.8, 1.5), "Pedestrian": (0.8, 0.6, 1.7)}


@dataclass(frozen=True)
class Actor:
    """An object of a drive."""

    path: Path
    label: str = "Car"
    unseen: tuple[float, float] = (0.0, 0.0)  # times [s] at which neither detector finds it: from, to
    only_in_image: tuple[float, float] = (0.0, 0.0)  # times at which the detector of images alone finds it
    score: float = 0.95  # of its boxes


@dataclass(frozen=True)
class Street:
    """A drive."""

    actors: Sequence[Actor]
    ego: Path = lambda seconds: (0.0, 0.0, 0.0)  # where the lidar is
    sigma: float = 0.1  # deviation of the middles of boxes [m]
    rotated: frozenset[int] = frozenset()  # numbers of the frames whose boxes are the wrong way round

    def observe(self, times, *, views=None):
        """What is seen at these times [s]."""
        random = np.random.default_rng(1)
        views = {"front": FRONT} if views is None else views
        return [self._observation(k, seconds, views, random) for k, seconds in enumerate(times)]

    def _observation(self, k, seconds, views, random):
        world_from_lidar = _pose(*self.ego(seconds))
        fused = {name: self._fused(k, seconds, world_from_lidar, view, random) for name, view in views.items()}
        return Observation(round(seconds * 1e9), world_from_lidar, fused, views)

    def _fused(self, k, seconds, world_from_lidar, view, random):
        seen = [a for a in self.actors if not a.unseen[0] <= seconds < a.unseen[1]]
        count, lidar_from_world = len(seen), world_from_lidar.inverse()
        numbers = np.zeros((count, 7))
        for row, actor in enumerate(seen):
            x, y, heading = actor.path(seconds)
            length, width, height = SIZES[actor.label]
            rotation = lidar_from_world.rotate(np.array([np.cos(heading), np.sin(heading), 0.0]))
            numbers[row, :3] = lidar_from_world.apply(np.array([x, y, height / 2.0 - 1.7]))
            numbers[row, 3:] = length, width, height, np.arctan2(rotation[1], rotation[0])
        corners = project_outlines(view.camera, view.camera_from_lidar, numbers).corners_xyxy
        shown = corners[:, 2] > corners[:, 0]
        alone = np.array([a.only_in_image[0] <= seconds < a.only_in_image[1] for a in seen], np.bool_)
        numbers[:, :2] += random.normal(scale=self.sigma, size=(count, 2))
        if k in self.rotated:
            numbers[:, 6] += np.pi
        spread = np.where(alone, 8.0, max(self.sigma, 0.05))
        return FusedBoxes(
            timestamp_ns=round(seconds * 1e9),
            centers=numbers[:, :3],
            center_covariances=np.eye(3) * (spread**2)[:, None, None],
            sizes_lwh=numbers[:, 3:6],
            size_covariances=np.eye(3) * np.full((count, 1, 1), 0.1**2),
            yaws=np.where(alone, 0.0, numbers[:, 6]),
            velocities=None,
            scores=np.array([a.score for a in seen]).reshape(-1),
            labels=tuple(a.label for a in seen),
            corners_xyxy=corners,
            ids=np.arange(count),
            rows_3d=np.where(alone, -1, np.arange(count)),
            rows_2d=np.where(shown, np.arange(count), -1),
        )


def _pose(x, y, heading):
    cosine, sine = np.cos(heading), np.sin(heading)
    rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return RigidTransform(rotation, np.array([x, y, 0.0]))


def seen(times, *actors, **street):
    """What is seen of actors at some times [s]."""
    return Street(actors, **street).observe(times)
