"""Drives and streets that several tests look at, and the slow but obvious answer to what a ray meets."""

from dataclasses import dataclass

import numpy as np
import pytest

from sceneloom.geometry.rigid import RigidTransform
from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street
from sceneloom.simulate.street import GroundMap, Lane, Material, PackedShapes, Pattern, Shape, ShapeKind, Street
from sceneloom.simulate.trajectory import EgoPath

GREY = Material(Pattern.PLAIN, ((128.0, 128.0, 128.0),) * 3)


def inside_unit_body(kind, unit):
    """Which of (..., 3) points lie strictly inside a unit body, written from its description."""
    x, y, z = np.moveaxis(np.abs(unit), -1, 0)
    height = unit[..., 2]
    rules = {
        ShapeKind.BOX: (x < 1) & (y < 1) & (z < 1),
        ShapeKind.CYLINDER: (x**2 + y**2 < 1) & (z < 1),
        ShapeKind.ELLIPSOID: x**2 + y**2 + z**2 < 1,
        # The walls of a roof lean from the full width at its foot (z = -1) to nothing at its ridge (z = 1).
        ShapeKind.GABLE: (x < 1) & (height > -1) & (height < 1) & (y < (1 - height) / 2),
    }
    return rules[kind]


def inside_shape(shape, points_world):
    """Which of (..., 3) points lie strictly inside a shape."""
    return inside_unit_body(shape.kind, shape.pose.inverse().apply(points_world) / np.array(shape.half))


@dataclass(frozen=True)
class SlowCaster:
    """Walks along a ray in small steps until it is inside a shape, then halves the last step 50 times."""

    steps: int = 8000

    def range_to(self, shape, origin, direction, reach):
        """Range [m] at which a ray enters a shape, or infinity."""
        middle = float((shape.pose.translation - origin) @ direction)
        radius = float(np.linalg.norm(shape.half)) * 1.01
        if np.linalg.norm(origin + middle * direction - shape.pose.translation) > radius:
            return np.inf
        first, last = max(0.0, middle - radius), min(reach, middle + radius)
        ranges = np.linspace(first, last, self.steps)
        inside = inside_shape(shape, origin + ranges[:, None] * direction)
        if last <= first or not inside.any() or inside[0]:
            return np.inf
        k = int(np.argmax(inside))
        outer, inner = ranges[k - 1], ranges[k]
        for _ in range(50):
            half = (outer + inner) / 2
            outer, inner = (outer, half) if inside_shape(shape, origin + half * direction) else (half, inner)
        return inner

    def first_hit(self, shapes, origin, direction, reach):
        """Range and index of the first shape on a ray; index -1 for the ground, -2 for the sky (range 0)."""
        ranges = [self.range_to(shape, origin, direction, reach) for shape in shapes]
        down = -origin[2] / direction[2] if direction[2] * origin[2] < 0 else np.inf
        best = min([*ranges, down])
        if best >= reach:
            return 0.0, -2
        return best, -1 if best == down else int(np.argmin(ranges))


@pytest.fixture(scope="session")
def slow_caster():
    return SlowCaster()


@pytest.fixture(scope="session")
def inside():
    """`inside(shape, points_world)` reports which points lie strictly inside."""
    return inside_shape


@pytest.fixture(scope="session")
def stationary_path():
    """An ego that all but stands at the origin, looking along x: one micrometre a second gives it a heading."""
    along = 1e-6 * (np.arange(40) - 20.0)
    return EgoPath(0, -17.0, np.column_stack([along, np.zeros(40)]), np.zeros((3, 1, 3)))


@pytest.fixture(scope="session")
def street_of():
    """Build a street that holds exactly the given shapes."""

    def build(shapes, path):
        return Street((), PackedShapes.of(shapes, range(1, len(shapes) + 1)), GroundMap.of(Lane.of(path)))

    return build


@pytest.fixture(scope="session")
def box():
    """Make an upright box from its middle and half sizes."""

    def build(center, half, material=GREY, yaw=0.0):
        rotation = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1.0]])
        pose = RigidTransform(rotation, np.asarray(center, np.float64))
        return Shape(ShapeKind.BOX, pose, tuple(map(float, half)), material)

    return build


@pytest.fixture(scope="session")
def drive():
    """A drive of eight sweeps with a coarse lidar and the default camera."""
    return simulate_street(3, frames=8, lidar=LidarSpec(beams=32, steps=600))


@pytest.fixture(scope="session")
def exact_drive():
    """The same street seen by a lidar without noise or losses."""
    exact = LidarSpec(beams=32, steps=600, range_sigma=0.0, drop_rate=0.0)
    return simulate_street(3, frames=8, lidar=exact, cameras=(CameraSpec(),))
