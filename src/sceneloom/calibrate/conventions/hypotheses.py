"""What an extrinsic may mean: every form, direction and choice of axes, and the transform that follows from each."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.calibrate.conventions.forms import FORMS
from sceneloom.geometry.euler import rotation_from_cuboid_angles

TO_CAMERA, FROM_CAMERA = "camera from lidar", "lidar from camera"
"""Which way a transform takes points."""

CAMERA_AXES: Mapping[str, Float64Array] = MappingProxyType(
    {
        "x right, y down, z forward": np.eye(3),
        "x right, y up, z backward": np.diag([1.0, -1.0, -1.0]),
        "x forward, y left, z up": np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]),
        "x forward, y right, z down": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
    }
)
"""Axes of the camera's frame, and the rotation from them into x right, y down, z forward."""

LIDAR_AXES: Mapping[str, Float64Array] = MappingProxyType(
    {
        "those of the points": np.eye(3),
        "x, y along the points' -y, x": rotation_from_cuboid_angles((0, 0, 90)),
        "x, y along the points' y, -x": rotation_from_cuboid_angles((0, 0, -90)),
        "x, y along the points' -x, -y": rotation_from_cuboid_angles((0, 0, 180)),
    }
)
"""Axes of the lidar's frame beside those that its points have, and the rotation out of these into them."""

CHOICES = (
    "layout", "order of parts", "quaternion", "angles", "order of angles", "direction", "camera axes", "lidar axes",
)  # fmt: skip
"""What a hypothesis decides, in the order in which it is told."""


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """One way to read an extrinsic.

    Attributes:
        choices: each of `CHOICES` that its form leaves open, and what it is taken to be.
        camera_from_points: (4, 4) float64, from the frame of the points into x right, y down, z forward.
    """

    choices: Mapping[str, str]
    camera_from_points: Float64Array


def hypotheses(
    numbers: Sequence[float], known: Mapping[str, str] | None = None, *, apart: bool = False
) -> tuple[Hypothesis, ...]:
    """List all ways to read some numbers.

    Args:
        numbers: of the extrinsic, 6, 7, 9, 12 or 16.
        known: choices that are certain, such as those that named numbers leave no doubt of.
        apart: twelve numbers are the nine of a rotation, then a translation that stood beside it.
    """
    given = np.asarray(numbers, np.float64)
    found = _all(given, apart=apart) if np.isfinite(given).all() else ()
    wanted = known or {}
    return tuple(
        hypothesis
        for hypothesis in found
        if all(hypothesis.choices.get(name, value) == value for name, value in wanted.items())
    )


def _all(numbers: Float64Array, *, apart: bool) -> Iterator[Hypothesis]:
    for form in FORMS:
        built = form.build(numbers) if (form.count, form.apart) == (numbers.size, apart) else None
        if built is None:
            continue
        stated = np.eye(4)
        stated[:3, :3], stated[:3, 3] = built
        inverse = np.asarray(np.linalg.inv(stated), np.float64)
        for direction, matrix in ((TO_CAMERA, stated), (FROM_CAMERA, inverse)):
            for camera_axes, optical_from_camera in CAMERA_AXES.items():
                for lidar_axes, lidar_from_points in LIDAR_AXES.items():
                    choices = {
                        **form.choices,
                        "direction": direction,
                        "camera axes": camera_axes,
                        "lidar axes": lidar_axes,
                    }
                    yield Hypothesis(
                        MappingProxyType(choices), _between(optical_from_camera, matrix, lidar_from_points)
                    )


def _between(left: Float64Array, matrix: Float64Array, right: Float64Array) -> Float64Array:
    """Turn the frames on both sides of a transform."""
    turned = np.eye(4)
    turned[:3, :3] = left @ matrix[:3, :3] @ right
    turned[:3, 3] = left @ matrix[:3, 3]
    return turned


def groups(
    found: Sequence[Hypothesis], *, turn_deg: float = 0.2, shift: float = 0.02
) -> list[list[Hypothesis]]:
    """Put together hypotheses of the same transform, within an angle [deg] and a distance [m] nobody could tell."""
    result: list[list[Hypothesis]] = []
    for hypothesis in found:
        for group in result:
            if _alike(hypothesis.camera_from_points, group[0].camera_from_points, turn_deg, shift):
                group.append(hypothesis)
                break
        else:
            result.append([hypothesis])
    return result


def _alike(a: Float64Array, b: Float64Array, turn_deg: float, shift: float) -> bool:
    between = a[:3, :3].T @ b[:3, :3]
    # of a small angle the sine is exact, where the cosine has lost it
    sine = np.linalg.norm(between - between.T) / np.sqrt(8.0)
    near = sine <= np.sin(np.radians(turn_deg)) and np.trace(between) > 1.0
    return bool(near and np.linalg.norm(a[:3, 3] - b[:3, 3]) <= shift)
