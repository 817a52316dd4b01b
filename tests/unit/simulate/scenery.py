"""Streets of given shapes, paths of given speeds, and the slow but obvious answer to what a ray meets."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from sceneloom.geometry.rigid import RigidTransform
from sceneloom.simulate import street as st
from sceneloom.simulate.street import Material, Pattern, Shape, ShapeKind
from sceneloom.simulate.trajectory import EgoPath

PLAIN = Material(Pattern.PLAIN, ((100.0, 120.0, 140.0),) * 3, reflectivity=0.3)
GROUND, SKY = -1, -2

# Bisection ends below 1e-12 m, float64 resolves 1e-14 m at 100 m; the quadratics of round bodies lose half the digits.
EXACT = 1e-7


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def path_at_speed(speed):
    """An ego that drives along x and is at the origin at time zero."""
    along = speed * (np.arange(40) - 20.0)
    path = EgoPath(0, -17.0, np.column_stack([along, np.zeros(40)]), np.zeros((3, 1, 3)))
    return replace(path, control_points=path.control_points - path.at_seconds(np.zeros(1)).positions[0, :2])


STILL = path_at_speed(1e-6)
"""One micrometre a second gives it a heading."""


def box(center, half, material=PLAIN):
    return Shape(ShapeKind.BOX, RigidTransform(np.eye(3), np.array(center, float)), tuple(map(float, half)), material)


def street_of(shapes=(), path=STILL, *, movers=st.NO_MOVERS, instances=None):
    """A street that holds exactly the given shapes, by default one object each, and movers."""
    instances = range(1, len(shapes) + 1) if instances is None else instances
    return st.Street((), st.PackedShapes.of(list(shapes), list(instances)), st.GroundMap.of(st.Lane.of(path)), movers)


def moving(designs, curves, *, start_ns=0, first_knot=-4.0, spans=None):
    """Movers, numbered from 1, along curves with knots half a second apart."""
    spans = spans or [(-(10**10), 10**10)] * len(designs)
    things = [st.Mover(k + 1, design.label, design.size_lwh, *spans[k], False) for k, design in enumerate(designs)]
    return st.pack_movers(things, designs, np.array(curves), start_ns=start_ns, first_knot=first_knot, knot_step=0.5)


def excess(kind, points):
    """How far outside a unit body (..., 3) points are, as a factor of its size: 1 on the surface."""
    x, y, z = np.moveaxis(np.abs(points), -1, 0)
    height = points[..., 2]
    return {
        ShapeKind.BOX: np.maximum.reduce([x, y, z]),
        ShapeKind.CYLINDER: np.maximum(np.hypot(x, y), z),
        ShapeKind.ELLIPSOID: np.linalg.norm(points, axis=-1),
        # The walls of a roof lean from the full width at its foot (z = -1) to nothing at its ridge (z = 1).
        ShapeKind.GABLE: np.maximum.reduce([x, y + 0.5 * height + 0.5, -height]),
    }[ShapeKind(kind)]


def instances_inside(packed, points):
    """The number of an object that each of (N, 3) world points lies in, 0 for none."""
    found = np.zeros(len(points), np.int64)
    for k in range(len(packed)):
        near = np.flatnonzero(np.linalg.norm(points - packed.spheres[k, :3], axis=1) < packed.spheres[k, 3])
        local = points[near] @ packed.maps[k, :, :3].T + packed.maps[k, :, 3]
        found[near[excess(packed.kinds[k], local) < 1]] = packed.instances[k]
    return found


def surface_points(generator, count):
    """Points on the surface of each kind of unit body, corners and rims among them."""
    ball = unit(generator.normal(size=(count, 3)))
    return {
        ShapeKind.BOX: np.sign(ball),
        ShapeKind.CYLINDER: np.column_stack([unit(ball[:, :2]), np.sign(ball[:, 2])]),
        ShapeKind.ELLIPSOID: ball,
        ShapeKind.GABLE: np.column_stack([np.sign(ball[:, :2]), -np.ones(count)]),
    }


def in_box_axes(points, center, yaw):
    """Points in the axes of upright boxes, of which there may be one for each point."""
    return Rotation.from_euler("z", yaw).inv().apply(points - center) if len(points) else points


def _range_to(shape, origin, direction, reach, *, steps=8000):
    """Walk along a ray until it is inside a shape, then halve the last step 50 times; infinity where it never is."""

    def inside(points):
        return excess(shape.kind, shape.pose.inverse().apply(points) / np.array(shape.half)) < 1

    middle = float((shape.pose.translation - origin) @ direction)
    radius = float(np.linalg.norm(shape.half)) * 1.01
    if np.linalg.norm(origin + middle * direction - shape.pose.translation) > radius:
        return np.inf
    first, last = max(0.0, middle - radius), min(reach, middle + radius)
    ranges = np.linspace(first, last, steps)
    met = inside(origin + ranges[:, None] * direction)
    if last <= first or not met.any() or met[0]:
        return np.inf
    k = int(np.argmax(met))
    outer, inner = ranges[k - 1], ranges[k]
    for _ in range(50):
        half = (outer + inner) / 2
        outer, inner = (outer, half) if inside(origin + half * direction) else (half, inner)
    return inner


def first_hit(shapes, origin, direction, reach):
    """Range and index of the first shape on a ray; index -1 for the ground, -2 for the sky (range 0)."""
    ranges = [_range_to(shape, origin, direction, reach) for shape in shapes]
    down = -origin[2] / direction[2] if direction[2] * origin[2] < 0 else np.inf
    best = min([*ranges, down])
    if best >= reach:
        return 0.0, SKY
    return best, GROUND if best == down else int(np.argmin(ranges))
