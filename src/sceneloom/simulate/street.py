"""The simulated street: ground and lanes, objects and traffic by seed, and their true boxes."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import IntEnum
from typing import Any

import numpy as np
from numba import njit
from numpy.polynomial import polynomial

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, Float64Array, Int32Array, Int64Array, UInt8Array
from sceneloom.geometry.euler import rotation_from_cuboid_angles
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.kernels.cache import kernel
from sceneloom.simulate.parameters import check_bounds
from sceneloom.simulate.trajectory import BASIS, DEGREE, EgoPath, spline_derivatives

_Color = tuple[float, float, float]  # red, green, blue in 0..255, as light of full strength would show them
_Point = tuple[float, float, float]
INNER: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"contract", "arcp", "nsz"},
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
}
"""Options of functions that only compiled functions call; without wrappers they compile faster."""


class ShapeKind(IntEnum):
    """The unit bodies that the ray caster knows."""

    BOX = 0
    CYLINDER = 1
    ELLIPSOID = 2
    GABLE = 3


class Pattern(IntEnum):
    """How a surface mixes the colours of its palette."""

    PLAIN = 0
    FACADE = 1
    BRICK = 2
    TILES = 3
    FOLIAGE = 4
    BARK = 5
    CAR_BODY = 6
    CAR_CABIN = 7
    TYRE = 8
    BANDS = 9


@dataclass(frozen=True, slots=True)
class Material:
    """What a surface looks like to cameras and lidars.

    Attributes:
        pattern: how the colours are mixed.
        colors: the palette: first, second and third colour.
        measures: lengths of the pattern [m]: window pitch, storey height, strength of the bricks for a facade; the
            period for bands.
        reflectivity: share of laser light that comes back at square incidence from a white surface.
    """

    pattern: Pattern
    colors: tuple[_Color, _Color, _Color]
    measures: tuple[float, float, float] = (1.0, 1.0, 0.0)
    reflectivity: float = 0.6


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """One convex body.

    Attributes:
        kind: which.
        pose: `parent_from_shape`.
        half: half sizes along the shape's own axes [m]; the cylinder's axis is z, the gable's ridge runs along x.
        material: its surface.
    """

    kind: ShapeKind
    pose: RigidTransform
    half: tuple[float, float, float]
    material: Material

    def moved(self, world_from_parent: RigidTransform) -> "Shape":
        """The same shape in another frame."""
        return replace(self, pose=world_from_parent @ self.pose)

    @property
    def radius(self) -> float:
        """Radius of a ball around the shape's centre that holds it [m]."""
        x, y, z = self.half
        if self.kind is ShapeKind.ELLIPSOID:
            return max(self.half)
        if self.kind is ShapeKind.CYLINDER:
            return float(np.hypot(max(x, y), z))
        return float(np.linalg.norm(self.half))


@dataclass(frozen=True, slots=True, eq=False)
class PackedShapes:
    """P shapes in the world as the kernels take them.

    Attributes:
        kinds: (P,) uint8.
        maps: (P, 3, 4) float64, world to the space of the unit body.
        spheres: (P, 4) float64 [m], centre and radius of a ball around each.
        halves: (P, 3) float64 [m].
        patterns: (P,) uint8.
        palettes: (P, 3, 3) float64.
        measures: (P, 3) float64.
        instances: (P,) int64, the object that a shape belongs to; also what its noise starts from.
        reflectivities: (P,) float64.
    """

    kinds: UInt8Array
    maps: Float64Array
    spheres: Float64Array
    halves: Float64Array
    patterns: UInt8Array
    palettes: Float64Array
    measures: Float64Array
    instances: Int64Array
    reflectivities: Float64Array

    @classmethod
    def of(cls, shapes: Sequence[Shape], instances: Sequence[int]) -> "PackedShapes":
        """Pack shapes given in the world frame, each with the id of its object."""
        rotations = np.array([shape.pose.rotation for shape in shapes]).reshape(-1, 3, 3)
        centers = np.array([shape.pose.translation for shape in shapes]).reshape(-1, 3)
        halves = np.array([shape.half for shape in shapes], np.float64).reshape(-1, 3)
        linear = rotations.transpose(0, 2, 1) / halves[:, :, None]
        offsets = -np.einsum("pij,pj->pi", linear, centers)
        radii = np.array([shape.radius for shape in shapes], np.float64)
        materials = [shape.material for shape in shapes]
        return cls(
            np.array([shape.kind for shape in shapes], np.uint8),
            np.ascontiguousarray(np.concatenate([linear, offsets[:, :, None]], axis=2)),
            np.column_stack([centers, radii]),
            halves,
            np.array([material.pattern for material in materials], np.uint8),
            np.array([material.colors for material in materials], np.float64).reshape(-1, 3, 3),
            np.array([material.measures for material in materials], np.float64).reshape(-1, 3),
            np.asarray(instances, np.int64).reshape(-1),
            np.array([material.reflectivity for material in materials], np.float64),
        )

    def __len__(self) -> int:
        return len(self.kinds)

    def joined(self, others: "PackedShapes") -> "PackedShapes":
        """These shapes, then others."""
        return PackedShapes(
            *(np.concatenate([getattr(self, part.name), getattr(others, part.name)]) for part in fields(PackedShapes))
        )


_WALLS: tuple[_Color, ...] = (
    (226, 205, 170), (204, 152, 124), (236, 226, 206), (178, 190, 196), (214, 178, 112), (190, 122, 100),
    (168, 182, 152), (222, 190, 186), (150, 160, 178), (240, 214, 150),
)  # fmt: skip
_ROOFS: tuple[_Color, ...] = ((162, 78, 58), (120, 66, 56), (92, 92, 100), (140, 88, 66), (78, 84, 92))
_LACQUERS: tuple[_Color, ...] = (
    (188, 40, 38), (42, 86, 164), (232, 232, 232), (60, 64, 70), (44, 122, 84), (224, 176, 50), (150, 156, 164),
    (110, 44, 90), (32, 136, 158), (236, 118, 44),
)  # fmt: skip
_LEAVES: tuple[tuple[_Color, _Color, _Color], ...] = (
    ((62, 110, 48), (104, 150, 62), (172, 196, 104)),
    ((48, 92, 56), (82, 128, 70), (142, 176, 110)),
    ((116, 124, 44), (164, 158, 62), (212, 200, 110)),
)
_BIN_COLORS: tuple[_Color, ...] = ((40, 90, 60), (60, 66, 74), (60, 80, 140), (150, 110, 40))
_WHITE: _Color = (240, 240, 236)
_GLASS: _Color = (66, 84, 104)
_DARK: _Color = (34, 36, 40)
_STEEL: _Color = (150, 156, 160)


@dataclass(frozen=True, slots=True, eq=False)
class Design:
    """An object before it has a location.

    Attributes:
        label: the object's class.
        shapes: in the object's frame.
        size_lwh: length, width and height of the box around it [m].
        ahead: how far before the object's origin the middle of its box lies [m].
        plan_lw: length and width of the ground that it takes, where that is not all under its box [m].
    """

    label: str
    shapes: tuple[Shape, ...]
    size_lwh: tuple[float, float, float]
    ahead: float = 0.0
    plan_lw: tuple[float, float] | None = None

    def center(self, x: float, y: float, yaw: float) -> tuple[float, float, float]:
        """Middle of its box in the world where it stands at (x, y) [m], rotated by `yaw` [rad]."""
        return float(x + self.ahead * np.cos(yaw)), float(y + self.ahead * np.sin(yaw)), self.size_lwh[2] / 2

    def plan(self, x: float, y: float, yaw: float) -> Float64Array:
        """Corners and middles of the sides of its ground plan in the world, (8, 2) [m]."""
        around = np.array([[1, 1], [0, 1], [-1, 1], [-1, 0], [-1, -1], [0, -1], [1, -1], [1, 0]])
        plan = around * (0.5 * np.array(self.plan_lw or self.size_lwh[:2]))
        rotation = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        corners: Float64Array = plan @ rotation.T + [x, y]
        return corners

    def placed(self, x: float, y: float, yaw: float) -> tuple[Shape, ...]:
        """Its shapes in the world, stationary at (x, y) [m] and rotated by `yaw` [rad]."""
        rotation = rotation_from_cuboid_angles((0.0, 0.0, yaw), unit="radians")
        world_from_object = RigidTransform(rotation, np.array([x, y, 0.0]))
        return tuple(shape.moved(world_from_object) for shape in self.shapes)


def _wheel(x: float, y: float, radius: float, half_width: float, material: Material) -> Shape:
    """A cylinder that stands on the ground with its axis along y."""
    quarter = rotation_from_cuboid_angles((np.pi / 2, 0.0, 0.0), unit="radians")
    pose = RigidTransform(quarter, np.array([x, y, radius]))
    return Shape(ShapeKind.CYLINDER, pose, (radius, radius, half_width), material)


def _stationary(kind: ShapeKind, half: _Point, foot: _Point, material: Material) -> Shape:
    """A shape whose lowest point is at `foot`."""
    return _upright(kind, (foot[0], foot[1], foot[2] + half[2]), half, material)


def _upright(kind: ShapeKind, center: _Point, half: _Point, material: Material) -> Shape:
    return Shape(kind, RigidTransform(np.eye(3), np.array(center, np.float64)), half, material)


def _pick(generator: np.random.Generator, choices: Sequence[_Color]) -> _Color:
    return choices[int(generator.integers(len(choices)))]


def _tinted(color: _Color, factor: float) -> _Color:
    red, green, blue = (min(255.0, factor * value) for value in color)
    return red, green, blue


def design_house(generator: np.random.Generator, *, length: float, depth: float, storeys: int) -> Design:
    """A house with rows of windows, plastered or of bricks, under a gabled roof along the street or a flat one."""
    storey = generator.uniform(2.7, 3.1)
    height, wall = storeys * storey + 0.4, _pick(generator, _WALLS)
    bricks = 0.22 if generator.uniform() < 0.4 else 0.0
    pitch = length / max(2, round(length / generator.uniform(2.2, 3.0)))
    facade = Material(Pattern.FACADE, (wall, _GLASS, _WHITE), (pitch, storey, bricks), 0.7)
    body = _stationary(ShapeKind.BOX, (length / 2, depth / 2, height / 2), (0, 0, 0), facade)
    if storeys <= 3 and generator.uniform() < 0.8:
        rise, tile = depth * generator.uniform(0.16, 0.26), _pick(generator, _ROOFS)
        tiles = Material(Pattern.TILES, (tile, _tinted(tile, 0.7), tile), reflectivity=0.45)
        half = (length / 2 + 0.25, depth / 2 + 0.35, rise)
        top = _stationary(ShapeKind.GABLE, half, (0, 0, height), tiles)
    else:
        rise = 0.2
        ledge = Material(Pattern.PLAIN, (_tinted(wall, 0.8),) * 3, reflectivity=0.6)
        top = _stationary(ShapeKind.BOX, (length / 2 + 0.2, depth / 2 + 0.2, rise), (0, 0, height), ledge)
    return Design("building", (body, top), (length + 0.5, depth + 0.7, height + 2 * rise))


def design_car(generator: np.random.Generator) -> Design:
    """A parked car: body, cabin and four wheels."""
    length, width = generator.uniform(3.9, 4.7), generator.uniform(1.7, 1.85)
    waist, height = generator.uniform(0.82, 0.92), generator.uniform(1.42, 1.6)
    lacquer = _pick(generator, _LACQUERS)
    body = Material(Pattern.CAR_BODY, (lacquer, _DARK, (244, 236, 214)), reflectivity=0.65)
    cabin = Material(Pattern.CAR_CABIN, (lacquer, _GLASS, _GLASS), reflectivity=0.5)
    tyre = Material(Pattern.TYRE, (_DARK, (172, 176, 180), (90, 92, 96)), reflectivity=0.25)
    shapes = [
        _stationary(ShapeKind.BOX, (length / 2, width / 2, (waist - 0.22) / 2), (0, 0, 0.22), body),
        _stationary(
            ShapeKind.BOX, (0.28 * length, 0.46 * width, (height - waist) / 2), (-0.06 * length, 0, waist), cabin
        ),
    ]
    wheels = [
        _wheel(x, y, 0.32, 0.11, tyre)
        for x in (0.31 * length, -0.31 * length)
        for y in (width / 2 - 0.09, 0.09 - width / 2)
    ]
    return Design("car", (*shapes, *wheels), (length, width + 0.04, height))


def design_tree(generator: np.random.Generator) -> Design:
    """A trunk and a crown of two overlapping balls of leaves."""
    radius, crown, foot = (generator.uniform(*bounds) for bounds in ((0.12, 0.2), (1.2, 1.7), (2.2, 2.8)))
    bark = Material(Pattern.BARK, ((96, 76, 58), (64, 52, 42), (64, 52, 42)), reflectivity=0.4)
    colors = _LEAVES[int(generator.integers(len(_LEAVES)))]
    leaves = Material(Pattern.FOLIAGE, colors, reflectivity=0.55)
    rise = crown * generator.uniform(0.95, 1.35)
    upper, above = (0.7 * crown, 0.7 * crown, 0.6 * rise), (0.25 * crown, -0.1, foot + 1.1 * rise)
    shapes = (
        _stationary(ShapeKind.CYLINDER, (radius, radius, foot / 2 + 0.4), (0, 0, 0), bark),
        _stationary(ShapeKind.ELLIPSOID, (crown, crown, rise), (0, 0, foot), leaves),
        _stationary(ShapeKind.ELLIPSOID, upper, above, leaves),
    )
    return Design("tree", shapes, (2 * crown, 2 * crown, foot + 2.3 * rise), plan_lw=(2.0, 2.0))


def design_lamp(generator: np.random.Generator) -> Design:
    """A street lamp with its arm forwards."""
    height = generator.uniform(5.4, 6.2)
    steel = Material(Pattern.BANDS, (_STEEL, _tinted(_STEEL, 0.78), _STEEL), (1.0, 0.0, 0.0), 0.6)
    lamp = Material(Pattern.PLAIN, ((250, 246, 224),) * 3, reflectivity=0.8)
    shapes = (
        _stationary(ShapeKind.CYLINDER, (0.08, 0.08, height / 2), (0, 0, 0), steel),
        _stationary(ShapeKind.BOX, (0.7, 0.04, 0.04), (0.62, 0, height - 0.1), steel),
        _stationary(ShapeKind.BOX, (0.28, 0.11, 0.05), (1.35, 0, height - 0.2), lamp),
    )
    return Design("pole", shapes, (1.71, 0.22, height), ahead=0.775, plan_lw=(0.16, 0.16))


def design_sign(generator: np.random.Generator) -> Design:
    """A traffic sign that faces along its forward axis."""
    steel = Material(Pattern.PLAIN, (_STEEL,) * 3, reflectivity=0.6)
    color = _pick(generator, ((200, 36, 36), (30, 84, 170), (232, 190, 40)))
    face = Material(Pattern.BANDS, (color, _WHITE, color), (0.44, 0.0, 0.0), 1.0)
    shapes = (
        _stationary(ShapeKind.CYLINDER, (0.04, 0.04, 1.2), (0, 0, 0), steel),
        _stationary(ShapeKind.BOX, (0.02, 0.33, 0.33), (0.06, 0, 1.85), face),
    )
    return Design("pole", shapes, (0.16, 0.66, 2.51))


def design_bin(generator: np.random.Generator) -> Design:
    """A round waste bin with a lid."""
    color, radius = _pick(generator, _BIN_COLORS), generator.uniform(0.24, 0.3)
    body = Material(Pattern.BANDS, (color, _tinted(color, 1.35), color), (0.4, 0.0, 0.0), 0.5)
    lid = Material(Pattern.PLAIN, (_DARK,) * 3, reflectivity=0.3)
    shapes = (
        _stationary(ShapeKind.CYLINDER, (radius, radius, 0.45), (0, 0, 0), body),
        _stationary(ShapeKind.CYLINDER, (radius + 0.02, radius + 0.02, 0.04), (0, 0, 0.9), lid),
    )
    return Design("bin", shapes, (2 * radius + 0.04, 2 * radius + 0.04, 0.98))


def design_hedge(generator: np.random.Generator, *, length: float) -> Design:
    """A cut hedge, or a low wall of stones."""
    height = generator.uniform(0.9, 1.3)
    leaves = Material(Pattern.FOLIAGE, _LEAVES[int(generator.integers(2))], reflectivity=0.55)
    stones = Material(Pattern.BRICK, ((170, 150, 132), (206, 200, 190), _WHITE), reflectivity=0.6)
    material = leaves if generator.uniform() < 0.65 else stones
    shape = _stationary(ShapeKind.BOX, (length / 2, 0.25, height / 2), (0, 0, 0), material)
    return Design("barrier", (shape,), (length, 0.5, height))


_FASTEST = 40.0  # no mover is faster [m/s]


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """Bodies that are fixed to each other, and how they swing.

    Attributes:
        shapes: in the mover's frame, at rest.
        hinge: a point of the axis that they swing about, which runs along y [m].
        swing: how far they swing to either side [rad], 0 for what does not.
        lead: what is added to the gait for this part [rad]; the angle is `swing` times the sine of the sum, forwards
            positive.
    """

    shapes: tuple[Shape, ...]
    hinge: tuple[float, float, float] = (0.0, 0.0, 0.0)
    swing: float = 0.0
    lead: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class MovingDesign:
    """Something that can move, before it has a location.

    Attributes:
        label: its class: "car", "cyclist", "pedestrian".
        parts: its body, and its legs.
        size_lwh: length, width and height of the box that holds it through all its gait [m].
    """

    label: str
    parts: tuple[Part, ...]
    size_lwh: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Mover:
    """One thing that moves, or could.

    Attributes:
        instance: its number in instance images; those of the objects that stand in the street come first.
        label: its class: "car", "cyclist", "pedestrian".
        size_lwh: length, width, height of its box [m].
        first_ns, last_ns: when it is in the street [ns].
        stands: whether it stays where it is all the time.
    """

    instance: int
    label: str
    size_lwh: tuple[float, float, float]
    first_ns: int
    last_ns: int
    stands: bool


@dataclass(frozen=True, slots=True, eq=False)
class MoverStates:
    """Exact motion of movers; the leading shape S is that of what was asked.

    Attributes:
        positions: (*S, 3) float64 [m], world frame, of the origin: on the ground.
        yaws: (*S,) float64 [rad], counter-clockwise from the world's x, not wrapped.
        velocities: (*S, 3) float64 [m/s], world frame.
        yaw_rates: (*S,) float64 [rad/s].
        gaits, gait_rates: (*S,) float64 [rad], [rad/s]: the angle whose sine swings the legs.
    """

    positions: Float64Array
    yaws: Float64Array
    velocities: Float64Array
    yaw_rates: Float64Array
    gaits: Float64Array
    gait_rates: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class Movers:
    """All that moves, packed for the ray caster.

    Attributes:
        things: what they are, K of them.
        start_ns: time zero of the curves [ns].
        first_knot, knot_step: time of the first knot, and between knots [s].
        anchors: (K, 4) float64: added to the curves: x, y [m], yaw, gait [rad].
        control_points: (K, N, 4) float64, of quintic splines.
        shapes: the bodies, each in the frame of its part.
        part_of_shape: (Q,) int64.
        mover_of_part: (F,) int64.
        hinges: (F, 3) float64 [m]; swings, leads: (F,) float64 [rad]; as in `Part`.
    """

    things: tuple[Mover, ...]
    start_ns: int
    first_knot: float
    knot_step: float
    anchors: Float64Array
    control_points: Float64Array
    shapes: PackedShapes
    part_of_shape: Int64Array
    mover_of_part: Int64Array
    hinges: Float64Array
    swings: Float64Array
    leads: Float64Array

    def __len__(self) -> int:
        return len(self.things)

    @property
    def spans_ns(self) -> Int64Array:
        """When each is in the street, first and last time, (K, 2) int64 [ns]."""
        return np.array([(thing.first_ns, thing.last_ns) for thing in self.things], np.int64).reshape(-1, 2)

    def present(self, which: Int64Array, times_ns: Int64Array) -> BoolArray:
        """Report whether movers are in the street; the shapes of `which` and `times_ns` are broadcast."""
        spans = self.spans_ns[which]
        there: BoolArray = (times_ns >= spans[..., 0]) & (times_ns <= spans[..., 1])
        return there

    def states(self, which: Int64Array, times_ns: Int64Array) -> MoverStates:
        """Give the motion of movers at times; the shapes of `which` and `times_ns` are broadcast.

        Beyond the drive, and where a mover is not in the street, the numbers are only continuous.
        """
        values, rates = spline_derivatives(self.control_points, np.asarray(which), self._along(times_ns), orders=2)
        values = values + self.anchors[which]
        rates = rates / self.knot_step
        level = np.zeros(values.shape[:-1])
        return MoverStates(
            np.stack([values[..., 0], values[..., 1], level], axis=-1),
            values[..., 2],
            np.stack([rates[..., 0], rates[..., 1], level], axis=-1),
            rates[..., 2],
            values[..., 3],
            rates[..., 3],
        )

    def near(self, point: Float64Array, times_ns: Int64Array, *, within: float) -> Int64Array:
        """Number those that could be within a distance [m] of a point (3,) at one of the times."""
        if not len(self):
            return np.zeros(0, np.int64)
        first, last = int(times_ns.min()), int(times_ns.max())
        spans = self.spans_ns
        middle = self.states(np.arange(len(self)), np.full(len(self), (first + last) // 2))
        reach = within + _FASTEST * (last - first) * 1e-9 + 5.0
        close = np.linalg.norm((middle.positions - point)[:, :2], axis=1) < reach
        return np.flatnonzero(close & (spans[:, 0] <= last) & (spans[:, 1] >= first))

    def placed(self, which: Int64Array, times_ns: Int64Array) -> "PlacedMovers":
        """Location the bodies of (K,) movers, given in order, at (M,) times."""
        columns = np.full(len(self), -1, np.int32)
        columns[which] = np.arange(len(which), dtype=np.int32)
        parts = np.flatnonzero(columns[self.mover_of_part] >= 0)
        mover_of_part = columns[self.mover_of_part[parts]]
        states = _spline_grid(self.control_points[which], self._along(times_ns)) + self.anchors[which]
        there = self.present(which[None, :], times_ns[:, None])
        frames = np.empty((len(times_ns), len(parts), 3, 4))
        _put_parts(states, there, mover_of_part, self.hinges[parts], self.swings[parts], self.leads[parts], frames)
        part_columns = np.full(len(self.mover_of_part), -1, np.int32)
        part_columns[parts] = np.arange(len(parts), dtype=np.int32)
        part_of_shape = part_columns[self.part_of_shape]
        shapes = np.flatnonzero(part_of_shape >= 0)
        balls = self._balls(shapes, states.min(axis=0), states.max(axis=0), columns)
        return PlacedMovers(frames, shapes, part_of_shape[shapes], balls)

    def _along(self, times_ns: Int64Array) -> Float64Array:
        """Knot numbers of times."""
        seconds = (np.asarray(times_ns, np.int64) - self.start_ns) * 1e-9
        return np.asarray((seconds - self.first_knot) / self.knot_step, np.float64)

    def _balls(self, shapes: Int64Array, low: Float64Array, high: Float64Array, columns: AnyArray) -> Float64Array:
        """Balls (Q, 4) that hold shapes while x, y, yaw and gait of their movers lie between (K, 4) and (K, 4)."""
        part = self.part_of_shape[shapes]
        column = columns[self.mover_of_part[part]]
        middle, spread = (0.5 * (low + high))[column], (0.5 * (high - low))[column]
        local, swinging = self.shapes.spheres[shapes], self.swings[part] != 0.0
        # A swinging shape stays in the ball about its hinge that it lies in at rest.
        arm = np.linalg.norm(local[:, :3] - self.hinges[part], axis=1)
        centers = np.where(swinging[:, None], self.hinges[part], local[:, :3])
        x, y = centers[:, 0], centers[:, 1]
        cosine, sine = np.cos(middle[:, 2]), np.sin(middle[:, 2])
        radii = local[:, 3] + np.where(swinging, arm, 0.0)
        radii = radii + np.hypot(spread[:, 0], spread[:, 1]) + np.hypot(x, y) * spread[:, 2]
        return np.column_stack(
            [middle[:, 0] + cosine * x - sine * y, middle[:, 1] + sine * x + cosine * y, centers[:, 2], radii]
        )

    def point_velocities(self, shapes: Int64Array, points_world: Float64Array, times_ns: Int64Array) -> Float64Array:
        """Velocity of points (N, 3) of (N,) own shapes at (N,) times, (N, 3) float64 [m/s], world frame."""
        part = self.part_of_shape[shapes]
        states = self.states(self.mover_of_part[part], times_ns)
        apart = points_world - states.positions
        rotating = np.column_stack([-apart[:, 1], apart[:, 0], np.zeros(len(apart))])
        velocities: Float64Array = states.velocities + states.yaw_rates[:, None] * rotating
        gait = states.gaits + self.leads[part]
        # Forwards is a rotation about -y: x gains as z falls below the hip.
        rate = self.swings[part] * np.cos(gait) * states.gait_rates
        cosine, sine = np.cos(states.yaws), np.sin(states.yaws)
        ahead = cosine * apart[:, 0] + sine * apart[:, 1] - self.hinges[part, 0]
        above = apart[:, 2] - self.hinges[part, 2]
        velocities += np.column_stack([-rate * above * cosine, -rate * above * sine, rate * ahead])
        return velocities


@dataclass(frozen=True, slots=True, eq=False)
class PlacedMovers:
    """Bodies of some movers at M times.

    Attributes:
        frames: (M, F, 3, 4) float64 `part_from_world`; out of reach of any ray while it is not in the street.
        shapes: (Q,) int64, which of the movers' shapes.
        frame_of_shape: (Q,) int32, the column of `frames` that each moves with.
        spheres: (Q, 4) float64 [m], balls that hold each at all the times.
    """

    frames: Float64Array
    shapes: Int64Array
    frame_of_shape: AnyArray
    spheres: Float64Array


def pack_movers(
    things: Sequence[Mover],
    designs: Sequence[MovingDesign],
    curves: Float64Array,
    *,
    start_ns: int,
    first_knot: float,
    knot_step: float,
) -> Movers:
    """Pack movers whose control points (K, N, 4) are given."""
    parts = [(k, part) for k, design in enumerate(designs) for part in design.parts]
    shapes = [(f, k, shape) for f, (k, part) in enumerate(parts) for shape in part.shapes]
    anchors = curves[:, 0].copy() if len(curves) else np.zeros((0, 4))
    return Movers(
        tuple(things),
        start_ns,
        first_knot,
        knot_step,
        anchors,
        np.ascontiguousarray(curves - anchors[:, None]) if len(curves) else np.zeros((0, 6, 4)),
        PackedShapes.of([shape for _, _, shape in shapes], [things[k].instance for _, k, _ in shapes]),
        np.array([f for f, _, _ in shapes], np.int64),
        np.array([k for k, _ in parts], np.int64),
        np.array([part.hinge for _, part in parts], np.float64).reshape(-1, 3),
        np.array([part.swing for _, part in parts], np.float64),
        np.array([part.lead for _, part in parts], np.float64),
    )


def _spline_grid(control_points: Float64Array, along: Float64Array) -> Float64Array:
    """Give all of K splines (K, N, C) at all of M knot numbers (M,), (M, K, C) float64, as `spline_derivatives`."""
    splines, count, channels = control_points.shape
    piece = np.clip(np.floor(along).astype(np.int64), 0, count - DEGREE - 1)
    weights = polynomial.polyval(along - piece, BASIS.T).T
    values = np.empty((len(along), splines, channels))
    for first in np.unique(piece):
        rows = piece == first
        control = np.moveaxis(control_points[:, first : first + DEGREE + 1], 1, 0).reshape(DEGREE + 1, -1)
        values[rows] = (weights[rows] @ control).reshape(-1, splines, channels)
    return values


_AWAY = 1e7  # where rays are taken to in the frame of something that is not there [m]: no ray reaches back


@njit(**INNER)
def _swing_back(frame: Float64Array, angle: float, x: float, z: float) -> None:
    """Rotate a frame (3, 4) backwards about an axis along y through (x, z), as a part has swung forwards."""
    cosine, sine = math.cos(angle), math.sin(angle)
    for i in range(4):
        forward, upward = frame[0, i], frame[2, i]
        if i == 3:
            forward, upward = forward - x, upward - z
        frame[0, i] = cosine * forward + sine * upward
        frame[2, i] = cosine * upward - sine * forward
    frame[0, 3] += x
    frame[2, 3] += z


@kernel(
    "void(float64[:,:,::1], boolean[:,::1], int32[::1], float64[:,::1], float64[::1], float64[::1], float64[:,:,:,::1])"
)
def _put_parts(
    states: Float64Array, there: BoolArray, mover_of_part: Int32Array, hinges: Float64Array, swings: Float64Array,
    leads: Float64Array, frames: Float64Array,
) -> None:  # fmt: skip
    """Write `part_from_world` of every part at every time.

    Args:
        states: (M, K, 4) float64, x, y [m], yaw and gait [rad] of K movers at M times.
        there: (M, K) bool; the frames of what is not there lie out of reach of any ray.
        mover_of_part: (F,) int32, column of `states`.
        hinges: (F, 3) float64 [m]; swings, leads: (F,) float64 [rad]: a part swings forwards by its swing times the
            sine of gait and lead, about an axis along y through its hinge.
        frames: (M, F, 3, 4) float64, written.
    """
    for time in range(len(states)):
        for part in range(len(mover_of_part)):
            mover, frame = mover_of_part[part], frames[time, part]
            x, y, yaw = states[time, mover, 0], states[time, mover, 1], states[time, mover, 2]
            cosine, sine = math.cos(yaw), math.sin(yaw)
            if not there[time, mover]:
                x, y, cosine, sine = -_AWAY, -_AWAY, 1.0, 0.0
            frame[0, 0], frame[0, 1], frame[0, 2], frame[0, 3] = cosine, sine, 0.0, -(cosine * x + sine * y)
            frame[1, 0], frame[1, 1], frame[1, 2], frame[1, 3] = -sine, cosine, 0.0, sine * x - cosine * y
            frame[2, 0], frame[2, 1], frame[2, 2], frame[2, 3] = 0.0, 0.0, 1.0, 0.0
            if swings[part] != 0.0 and there[time, mover]:
                angle = swings[part] * math.sin(states[time, mover, 3] + leads[part])
                _swing_back(frame, angle, hinges[part, 0], hinges[part, 2])


NO_MOVERS = pack_movers((), (), np.zeros((0, 6, 4)), start_ns=0, first_knot=0.0, knot_step=1.0)
"""A street where nothing moves."""

_CLOTHES: tuple[_Color, ...] = (
    (178, 42, 46), (38, 72, 140), (228, 226, 220), (46, 48, 54), (52, 118, 82), (226, 178, 62), (120, 66, 126),
    (214, 110, 52), (92, 148, 180), (150, 132, 108),
)  # fmt: skip
_TROUSERS: tuple[_Color, ...] = ((44, 54, 84), (40, 40, 44), (110, 98, 80), (76, 82, 90))
_SKIN: tuple[_Color, ...] = ((232, 190, 160), (198, 150, 116), (140, 98, 72), (92, 64, 48))
_HAIR: tuple[_Color, ...] = ((48, 36, 28), (28, 26, 26), (150, 116, 70), (120, 60, 36), (176, 174, 170))
_HELMETS: tuple[_Color, ...] = ((236, 236, 232), (200, 40, 40), (40, 44, 52), (240, 190, 40))
_FRAMES: tuple[_Color, ...] = ((180, 36, 40), (36, 76, 150), (40, 44, 48), (60, 130, 90), (222, 222, 218))
_SHOES: _Color = (42, 38, 36)
_PACE = 0.3  # how far a walker's leg swings to either side [rad]


def design_pedestrian(generator: np.random.Generator, *, walks: bool = True) -> MovingDesign:
    """Someone on foot: legs that swing where they walk, trunk, arms, head."""
    height = generator.uniform(1.55, 1.92)
    hip = 0.5 * height
    coat, trousers = _cloth(generator, _CLOTHES), _cloth(generator, _TROUSERS)
    skin, hair = _cloth(generator, _SKIN), _cloth(generator, _HAIR)
    body = [
        _upright(ShapeKind.CYLINDER, (0, 0, 0.655 * height), (0.115, 0.165, 0.175 * height), coat),
        _upright(ShapeKind.ELLIPSOID, (0, 0, 0.8 * height), (0.115, 0.215, 0.06 * height), coat),
        _limb((0, 0, 0.8 * height), (0.01, 0, 0.9 * height), 0.055, skin),
        _upright(ShapeKind.ELLIPSOID, (0.015, 0, height - 0.125), (0.1, 0.078, 0.12), skin),
        _upright(ShapeKind.ELLIPSOID, (-0.012, 0, height - 0.09), (0.102, 0.088, 0.09), hair),
    ]
    for side in (-1.0, 1.0):
        body.append(_limb((0, 0.205 * side, 0.8 * height), (0.0, 0.235 * side, 0.6 * height), 0.05, coat))
        body.append(_limb((0, 0.235 * side, 0.6 * height), (0.07, 0.235 * side, 0.45 * height), 0.038, skin))
    legs = [
        Part(_leg(0.09 * side, hip, trousers), (0, 0.09 * side, hip), _PACE if walks else 0.0, lead)
        for side, lead in ((1.0, 0.0), (-1.0, np.pi))
    ]
    return _designed("pedestrian", (Part(tuple(body)), *legs))


def design_cyclist(generator: np.random.Generator) -> MovingDesign:
    """Someone on a bicycle: two wheels, a frame and its rider."""
    coat, trousers = _cloth(generator, _CLOTHES), _cloth(generator, _TROUSERS)
    skin, helmet, steel = (_cloth(generator, choice) for choice in (_SKIN, _HELMETS, _FRAMES))
    tyre = Material(Pattern.TYRE, ((34, 34, 36), (150, 154, 158), (96, 98, 102)), reflectivity=0.25)
    shapes = [_wheel(x, 0.0, 0.34, 0.02, tyre) for x in (-0.52, 0.52)]
    pedals, seat, head = (-0.02, 0.0, 0.3), (-0.18, 0.0, 0.95), (0.37, 0.0, 0.9)
    tubes = [
        (pedals, seat), (pedals, (0.38, 0.0, 0.76)), ((-0.14, 0.0, 0.8), head), (pedals, (-0.52, 0.0, 0.34)),
        ((-0.14, 0.0, 0.8), (-0.52, 0.0, 0.34)), ((0.35, 0.0, 1.0), (0.52, 0.0, 0.34)),
        ((0.36, -0.26, 1.02), (0.36, 0.26, 1.02)),
    ]  # fmt: skip
    shapes += [_limb(start, end, 0.022, steel) for start, end in tubes]
    for side, knee, foot in ((1.0, (0.2, 0.7), (0.03, 0.2)), (-1.0, (0.25, 0.86), (0.06, 0.44))):
        at_knee, at_foot = (knee[0], 0.11 * side, knee[1]), (foot[0], 0.11 * side, foot[1])
        shapes.append(_limb((-0.16, 0.1 * side, 1.0), at_knee, 0.078, trousers))
        shapes.append(_limb(at_knee, at_foot, 0.058, trousers))
        shapes.append(_limb((0.11, 0.19 * side, 1.42), (0.34, 0.24 * side, 1.06), 0.045, coat))
    shapes += [
        _limb((-0.17, 0, 0.96), (0.1, 0, 1.46), 0.145, coat),
        _upright(ShapeKind.ELLIPSOID, (0.1, 0, 1.44), (0.12, 0.215, 0.11), coat),
        _limb((0.1, 0, 1.45), (0.17, 0, 1.6), 0.055, skin),
        _upright(ShapeKind.ELLIPSOID, (0.19, 0, 1.66), (0.1, 0.078, 0.12), skin),
        _upright(ShapeKind.ELLIPSOID, (0.17, 0, 1.71), (0.135, 0.098, 0.085), helmet),
    ]
    return _designed("cyclist", (Part(tuple(shapes)),))


def design_moving_car(generator: np.random.Generator) -> MovingDesign:
    """A car as those that are parked."""
    design = design_car(generator)
    return MovingDesign("car", (Part(design.shapes),), design.size_lwh)


def _leg(left: float, hip: float, cloth: Material) -> tuple[Shape, ...]:
    shoe = Material(Pattern.PLAIN, (_SHOES,) * 3, reflectivity=0.3)
    return (
        _limb((0, left, hip), (0, left, 0.5 * hip), 0.085, cloth),
        _limb((0, left, 0.55 * hip), (0, left, 0.06), 0.066, cloth),
        _upright(ShapeKind.BOX, (0.03, left, 0.045), (0.12, 0.048, 0.045), shoe),
    )


def _cloth(generator: np.random.Generator, choices: Sequence[_Color]) -> Material:
    return Material(Pattern.PLAIN, (_pick(generator, choices),) * 3, reflectivity=0.55)


def _limb(start: _Point, end: _Point, radius: float, material: Material) -> Shape:
    """A cylinder from one point to another."""
    a, b = np.array(start, np.float64), np.array(end, np.float64)
    length = float(np.linalg.norm(b - a))
    axis = (b - a) / length
    beside = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.9 else [0.0, 1.0, 0.0])
    beside /= np.linalg.norm(beside)
    rotation = np.column_stack([beside, np.cross(axis, beside), axis])
    return Shape(ShapeKind.CYLINDER, RigidTransform(rotation, (a + b) / 2), (radius, radius, length / 2), material)


def _designed(label: str, parts: tuple[Part, ...]) -> MovingDesign:
    """Put the box around all that parts do: symmetric about the origin, from the ground up."""
    reach = np.zeros(3)
    for part in parts:
        rotations = np.array([shape.pose.rotation for shape in part.shapes])
        centers = np.array([shape.pose.translation for shape in part.shapes]) - part.hinge
        for angle in np.linspace(-part.swing, part.swing, 9 if part.swing else 1):
            delta_rotation = rotation_from_cuboid_angles((0.0, -angle, 0.0), unit="radians")
            locations = np.abs(centers @ delta_rotation.T + part.hinge)
            for shape, rotation, location in zip(part.shapes, delta_rotation @ rotations, locations, strict=True):
                reach = np.maximum(reach, location + _half_extents(shape, rotation))
    return MovingDesign(label, parts, (float(2 * reach[0]), float(2 * reach[1]), float(reach[2])))


def _half_extents(shape: Shape, rotation: Float64Array) -> Float64Array:
    """How far a rotated shape reaches from its middle along x, y and z [m], (3,)."""
    arms = np.abs(rotation) * np.array(shape.half)
    if shape.kind is ShapeKind.ELLIPSOID:
        return np.asarray(np.linalg.norm(arms, axis=1), np.float64)
    if shape.kind is ShapeKind.CYLINDER:
        return np.asarray(np.hypot(arms[:, 0], arms[:, 1]) + arms[:, 2], np.float64)
    return np.asarray(arms.sum(axis=1), np.float64)


PALETTE = ((104, 105, 110), (238, 238, 228), (172, 166, 158), (196, 194, 188), (112, 136, 74))
"""Asphalt, paint, pavement, kerb, grass."""

GRAIN = 0.55
"""Share of laser light that the ground gives back where it is white."""

_STEP = 0.25
_WIDTH = 14.0
_CELL = 0.5
_FAR = 20.0


@dataclass(frozen=True, slots=True, eq=False)
class Lane:
    """The ego trajectory as a chain of points every 25 cm, which the street follows.

    Attributes:
        points: (L, 2) float64 [m], world frame.
        headings: (L,) float64 [rad].
        curvatures: (L,) float64 [1/m].
        along: (L,) float64 [m], arc length, 0 where the drive begins.
        parameters: (L,) float64 [s], of the path's curve.
    """

    points: Float64Array
    headings: Float64Array
    curvatures: Float64Array
    along: Float64Array
    parameters: Float64Array

    @classmethod
    def of(cls, path: EgoPath) -> "Lane":
        """Follow a path from the beginning to the end of its curve."""
        first, last = path.reach
        fine = np.linspace(first, last, int((last - first) * 100) + 1)[:-1]
        xy = path.on_curve(fine).positions[:, :2]
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
        even = np.arange(0.0, length[-1], _STEP)
        seconds = np.interp(even, length, fine)
        states = path.on_curve(seconds)
        (vx, vy), (ax, ay) = states.velocities[:, :2].T, states.accelerations[:, :2].T
        return cls(
            states.positions[:, :2],
            np.unwrap(np.arctan2(vy, vx)),
            (vx * ay - vy * ax) / np.hypot(vx, vy) ** 3,
            even - np.interp(0.0, fine, length),
            seconds,
        )

    def location(self, along: float, left: float) -> tuple[float, float, float]:
        """World x, y [m] and heading [rad] of a spot `along` the trajectory and `left` of it."""
        x, y = (float(np.interp(along, self.along, self.points[:, axis])) for axis in range(2))
        heading = float(np.interp(along, self.along, self.headings))
        return x - left * np.sin(heading), y + left * np.cos(heading), heading

    def offsets(self, points: Float64Array) -> Float64Array:
        """How far left of the trajectory (M, 2) points lie [m]; negative to the right."""
        apart = points[:, None, :] - self.points[None, ::4, :]
        nearest = np.argmin((apart * apart).sum(axis=2), axis=1)
        dx, dy = apart[np.arange(len(points)), nearest].T
        heading = self.headings[::4][nearest]
        sign = np.sign(np.cos(heading) * dy - np.sin(heading) * dx)
        left: Float64Array = sign * np.hypot(dx, dy)
        return left


@dataclass(frozen=True, slots=True, eq=False)
class GroundMap:
    """Coordinates of the ground around the trajectory, at the nodes of a square grid.

    Attributes:
        nodes: (X, Y, 4) float32: along [m], left [m], cosine and sine of the trajectory's heading.
        corner: (2,) float64 [m], world position of node (0, 0).
        cell: distance of neighbouring nodes [m].
    """

    nodes: Float32Array
    corner: Float64Array
    cell: float = _CELL

    @classmethod
    def of(cls, lane: Lane) -> "GroundMap":
        """Draw a strip along the lane; elsewhere the ground lies far to its left."""
        corner = np.floor(lane.points.min(axis=0)) - _FAR
        size = np.ceil((lane.points.max(axis=0) + _FAR - corner) / _CELL).astype(np.int64) + 1
        nodes = np.zeros((*size, 4), np.float32)
        nodes[..., 1], nodes[..., 2] = _WIDTH, 1.0
        nearest = np.full(size, np.inf)
        # the nodes that lie nearer to a point of the lane than to those before take its coordinates
        for point, heading, curvature, along in zip(
            lane.points, lane.headings, lane.curvatures, lane.along, strict=True
        ):
            low = np.maximum(0, np.floor((point - _WIDTH - corner) / _CELL).astype(np.int64))
            high = np.ceil((point + _WIDTH - corner) / _CELL).astype(np.int64) + 1
            window = (slice(low[0], high[0]), slice(low[1], high[1]))
            columns, rows = nearest[window].shape
            x = (corner[0] + _CELL * (low[0] + np.arange(columns)) - point[0])[:, None]
            y = (corner[1] + _CELL * (low[1] + np.arange(rows)) - point[1])[None, :]
            squared = x * x + y * y
            closer = squared < np.minimum(nearest[window], _WIDTH**2)
            cosine, sine = np.cos(heading), np.sin(heading)
            ahead, left = (cosine * x + sine * y)[closer], (cosine * y - sine * x)[closer]
            stretched = along + ahead / np.maximum(0.2, 1.0 - curvature * left)
            nearest[window][closer] = squared[closer]
            nodes[window][closer] = np.column_stack(np.broadcast_arrays(stretched, left, cosine, sine))
        return cls(nodes, corner)


@dataclass(frozen=True, slots=True)
class StreetObject:
    """One thing of the street.

    Attributes:
        instance: its number in instance images, from 1; 0 is the ground, -1 the sky.
        label: its class: "building", "car", "tree", "pole", "bin", "barrier".
        center_world: middle of its box [m].
        size_lwh: length, width, height of its box [m].
        yaw: direction of its forward axis [rad], counter-clockwise from the world's x.
    """

    instance: int
    label: str
    center_world: tuple[float, float, float]
    size_lwh: tuple[float, float, float]
    yaw: float


@dataclass(frozen=True, slots=True, eq=False)
class Street:
    """All that sensors can meet.

    Attributes:
        objects: what stands on the ground, by instance number - 1.
        shapes: their bodies.
        ground: the map of the plane z = 0.
        movers: what moves.
        bodies: the shapes of the objects, then those of the movers: what the numbers of hits mean.
    """

    objects: tuple[StreetObject, ...]
    shapes: PackedShapes
    ground: GroundMap
    movers: Movers = NO_MOVERS
    bodies: PackedShapes = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "bodies", self.shapes.joined(self.movers.shapes))

    @classmethod
    def of(cls, path: EgoPath, generator: np.random.Generator) -> "Street":
        """Build houses first, then everything between them and the road, along the whole of the ego's curve."""
        lane = Lane.of(path)
        plots = _Plots(lane)
        _close_ends(generator, plots)
        for side in (-1.0, 1.0):
            _build_houses(generator, plots, side)
            _build_back_row(generator, plots, side)
        for row in _ROWS:
            for along in _locations(generator, lane, row.every):
                if generator.uniform() < row.share:
                    left, rotation = generator.uniform(*row.left), generator.uniform(*row.rotation)
                    plots.try_location(row.design(generator), along, left, rotation, row.keep)
        return _street_of(plots, GroundMap.of(lane))


@dataclass(frozen=True, slots=True)
class Row:
    """Things of one kind along the street.

    Attributes:
        left: how far left of the ego trajectory their middles are [m]: from, to.
        every: distance from one to the next [m]: from, to.
        share: how many of the locations are taken.
        design: makes one.
        rotation: added to the street's heading [rad]: from, to.
        keep: how near the trajectory their ground plan may come [m], to the right and to the left.
    """

    left: tuple[float, float]
    every: tuple[float, float]
    share: float
    design: Callable[[np.random.Generator], Design]
    rotation: tuple[float, float] = (-0.03, 0.03)
    keep: tuple[float, float] = (2.0, 5.6)


def _hedge(generator: np.random.Generator) -> Design:
    return design_hedge(generator, length=generator.uniform(3.0, 7.0))


_ROTATED = (np.pi - 0.03, np.pi + 0.03)
_ROWS: tuple[Row, ...] = (
    Row((-3.05, -2.85), (5.6, 9.0), 0.62, design_car),
    Row((6.5, 6.6), (5.6, 9.0), 0.62, design_car, _ROTATED),
    Row((-4.7, -4.6), (24.0, 28.0), 1.0, design_lamp, (np.pi / 2,) * 2),
    Row((8.1, 8.2), (24.0, 28.0), 1.0, design_lamp, (-np.pi / 2,) * 2),
    Row((-5.0, -4.8), (9.0, 16.0), 0.75, design_tree, (0.0, 6.3)),
    Row((8.3, 8.6), (9.0, 16.0), 0.75, design_tree, (0.0, 6.3)),
    Row((-4.7, -4.6), (30.0, 60.0), 1.0, design_sign, _ROTATED),
    Row((8.1, 8.2), (30.0, 60.0), 1.0, design_sign),
    Row((-6.6, -6.3), (8.0, 20.0), 0.8, design_bin, (0.0, 6.3)),
    Row((9.7, 10.0), (8.0, 20.0), 0.8, design_bin, (0.0, 6.3)),
    Row((-7.5, -7.3), (7.2, 12.0), 0.7, _hedge, (0.0, 0.0), (6.8, 10.3)),
    Row((10.9, 11.1), (7.2, 12.0), 0.7, _hedge, (0.0, 0.0), (6.8, 10.3)),
)
"""Everything between the houses."""

_HOUSE_KEEP = (8.0, 11.6)
_SETBACK = (0.2, 3.0)
_BACK_ROW = (16.0, 26.0)


@dataclass(slots=True)
class _Plots:
    """The ground that is taken while a street is laid out."""

    lane: Lane
    centers: list[tuple[float, float]] = field(default_factory=list)
    radii: list[float] = field(default_factory=list)
    plans: list[Float64Array] = field(default_factory=list)
    placed: list[tuple[Design, float, float, float]] = field(default_factory=list)

    def try_location(
        self, design: Design, along: float, left: float, rotation: float, keep: tuple[float, float]
    ) -> bool:
        """Set an object down unless it would come too near the trajectory or stand in another."""
        x, y, heading = self.lane.location(along, left)
        plan = design.plan(x, y, heading + rotation)
        offsets = self.lane.offsets(plan)
        if ((offsets > -keep[0]) & (offsets < keep[1])).any() or np.ptp(np.sign(offsets)) != 0:
            return False
        apart = np.linalg.norm(np.array(self.centers).reshape(-1, 2) - [x, y], axis=1)
        near = np.flatnonzero(apart < np.array(self.radii) + _radius(plan))
        if any(_overlap(plan, self.plans[k]) for k in near):
            return False
        self.put(design, x, y, heading + rotation)
        return True

    def put(self, design: Design, x: float, y: float, yaw: float) -> None:
        """Set an object down at a location of the world [m], rotated by `yaw` [rad]."""
        plan = design.plan(x, y, yaw)
        self.centers.append((x, y))
        self.radii.append(_radius(plan))
        self.plans.append(plan)
        self.placed.append((design, x, y, yaw))


def _radius(plan: Float64Array) -> float:
    """Half the diagonal of a ground plan [m]."""
    return float(np.linalg.norm(plan[0] - plan[4])) / 2


def _overlap(a: Float64Array, b: Float64Array) -> bool:
    """Whether two rectangular ground plans touch: no line along a side of either parts them."""
    for plan in (a, b):
        for axis in (plan[0] - plan[2], plan[2] - plan[4]):
            if (a @ axis).max() < (b @ axis).min() or (b @ axis).max() < (a @ axis).min():
                return False
    return True


def _locations(generator: np.random.Generator, lane: Lane, every: tuple[float, float]) -> Iterator[float]:
    along = float(lane.along[0]) + generator.uniform(*every)
    while along < lane.along[-1]:
        yield along
        along += generator.uniform(*every)


def _build_houses(generator: np.random.Generator, plots: _Plots, side: float) -> None:
    """A row of houses, some wall to wall, some with gardens between."""
    along = float(plots.lane.along[0])
    while along < plots.lane.along[-1]:
        length, depth = generator.uniform(8.0, 15.0), generator.uniform(7.0, 10.0)
        design = design_house(generator, length=length, depth=depth, storeys=int(generator.integers(2, 5)))
        keep = _HOUSE_KEEP[int(side > 0)] + generator.uniform(*_SETBACK)
        left = side * (keep + design.size_lwh[1] / 2 + 0.3)
        fits = plots.try_location(design, along + design.size_lwh[0] / 2, left, 0.0, _HOUSE_KEEP)
        gap = 0.1 if generator.uniform() < 0.4 else generator.uniform(1.5, 6.0)
        along += design.size_lwh[0] + gap if fits else 2.0


def _build_back_row(generator: np.random.Generator, plots: _Plots, side: float) -> None:
    """Taller houses behind, seen through the gaps and above the roofs."""
    for along in _locations(generator, plots.lane, (22.0, 40.0)):
        length, depth = generator.uniform(12.0, 20.0), generator.uniform(10.0, 14.0)
        design = design_house(generator, length=length, depth=depth, storeys=int(generator.integers(4, 8)))
        left = side * (generator.uniform(*_BACK_ROW) + depth)
        plots.try_location(design, along, left, generator.uniform(-0.2, 0.2), _HOUSE_KEEP)


def _close_ends(generator: np.random.Generator, plots: _Plots) -> None:
    """A house across each end of the street, where the ego never comes."""
    lane = plots.lane
    for end, ahead in ((-1, 1.0), (0, -1.0)):
        design = design_house(generator, length=44.0, depth=12.0, storeys=5)
        x, y, heading = lane.location(float(lane.along[end]), 1.75)
        across = heading + np.pi / 2
        plots.put(design, x + ahead * 14.0 * np.cos(heading), y + ahead * 14.0 * np.sin(heading), across)


def _street_of(plots: _Plots, ground: GroundMap) -> Street:
    shapes: list[Shape] = []
    instances: list[int] = []
    objects = []
    for number, (design, x, y, yaw) in enumerate(plots.placed, start=1):
        parts = design.placed(x, y, yaw)
        shapes += parts
        instances += [number] * len(parts)
        objects.append(StreetObject(number, design.label, design.center(x, y, yaw), design.size_lwh, yaw))
    return Street(tuple(objects), PackedShapes.of(shapes, instances), ground)


@dataclass(frozen=True, slots=True, eq=False)
class BoxTruth:
    """Where every object is at T times: first those that stand, then those that move, I of them.

    Attributes:
        timestamps_ns: (T,) int64 [ns].
        instances: (I,) int64, as in instance images.
        labels: I of them.
        sizes_lwh: (I, 3) float64 [m].
        centers_world: (T, I, 3) float64 [m].
        yaws: (T, I) float64 [rad], counter-clockwise from the world's x.
        velocities: (T, I, 3) float64 [m/s], world frame.
        yaw_rates: (T, I) float64 [rad/s].
        present: (T, I) bool, whether it is in the street; elsewhere the numbers mean nothing.
    """

    timestamps_ns: Int64Array
    instances: Int64Array
    labels: tuple[str, ...]
    sizes_lwh: Float64Array
    centers_world: Float64Array
    yaws: Float64Array
    velocities: Float64Array
    yaw_rates: Float64Array
    present: BoolArray


def boxes_of(street: Street, timestamps_ns: Int64Array) -> BoxTruth:
    """Give the boxes of a street at (T,) int64 times [ns]."""
    times = np.asarray(timestamps_ns, np.int64).reshape(-1)
    things: tuple[StreetObject | Mover, ...] = (*street.objects, *street.movers.things)
    sizes = np.array([thing.size_lwh for thing in things], np.float64).reshape(-1, 3)
    count, stationary = len(times), len(street.objects)
    locations = np.array([(*thing.center_world, thing.yaw) for thing in street.objects]).reshape(-1, 4)
    which = np.arange(len(street.movers))[None, :]
    states = street.movers.states(which, times[:, None])
    lifted = states.positions + np.array([0.0, 0.0, 0.5]) * sizes[stationary:]
    still = np.zeros((count, stationary))
    return BoxTruth(
        times,
        np.array([thing.instance for thing in things], np.int64),
        tuple(thing.label for thing in things),
        sizes,
        np.concatenate([np.broadcast_to(locations[:, :3], (count, stationary, 3)), lifted], axis=1),
        np.concatenate([np.broadcast_to(locations[:, 3], (count, stationary)), states.yaws], axis=1),
        np.concatenate([np.zeros((count, stationary, 3)), states.velocities], axis=1),
        np.concatenate([still, states.yaw_rates], axis=1),
        np.concatenate([still == 0.0, street.movers.present(which, times[:, None])], axis=1),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Track:
    """A line at a constant distance beside the trajectory, straight on beyond its ends."""

    points: Float64Array  # (L, 2) float64 [m], world frame
    headings: Float64Array  # (L,) float64 [rad], of the trajectory
    along: Float64Array  # (L,) float64 [m], arc length of this line, from 0
    # (L,) float64, length of this line per length of the trajectory: small on the inside of a bend
    widths: Float64Array
    parameters: Float64Array  # (L,) float64, the ego's curve parameters beside the points

    @classmethod
    def of(cls, lane: Lane, left: float) -> "_Track":
        """Lay a line `left` of the trajectory [m]."""
        normals = np.column_stack([-np.sin(lane.headings), np.cos(lane.headings)])
        points = lane.points + left * normals
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(steps)])
        return cls(points, lane.headings, along, 1.0 - lane.curvatures * left, lane.parameters)

    @property
    def length(self) -> float:
        """Length of the line [m]."""
        return float(self.along[-1])

    def beside(self, parameters: Float64Array) -> Float64Array:
        """How far along it one is beside the ego's curve at (N,) parameters, (N,) [m]."""
        along: Float64Array = np.interp(parameters, self.parameters, self.along)
        return along

    def at(self, along: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Give points (N, 2) [m] and the trajectory's headings (N,) [rad] at arc lengths (N,)."""
        inside = np.clip(along, 0.0, self.length)
        points = np.column_stack([np.interp(inside, self.along, self.points[:, axis]) for axis in range(2)])
        headings = np.interp(inside, self.along, self.headings)
        ahead = np.column_stack([np.cos(headings), np.sin(headings)])
        return points + (along - inside)[:, None] * ahead, headings

    def narrowest(self, first: float, last: float) -> float:
        """The least of `widths` between two arc lengths [m]; below 0 the line runs backwards."""
        low, high = np.searchsorted(self.along, [first, last])
        return float(self.widths[max(0, low - 1) : high + 1].min(initial=1.0))


_HEADROOM = 2.0  # shapes whose lowest point is higher [m] are passed under
_SPARE = np.array([0.4, 0.04])  # how much longer to either end and wider to either side ground plans are taken [m]
_STRETCH = 32  # times of a trajectory that are looked at together


@dataclass(frozen=True, slots=True, eq=False)
class _Plans:
    """Rectangles on the ground, one per time or per thing."""

    centers: Float64Array  # (N, 2) float64 [m], world frame
    yaws: Float64Array  # (N,) float64 [rad], of the side `half[:, 0]`
    half: Float64Array  # (N, 2) float64 [m]
    there: BoolArray  # (N,) bool, whether it counts

    @property
    def radii(self) -> Float64Array:
        """Half the diagonals (N,) [m]."""
        return np.hypot(self.half[:, 0], self.half[:, 1])

    def taken(self, which: AnyArray | slice) -> "_Plans":
        """Some of them, by index or mask."""
        return _Plans(self.centers[which], self.yaws[which], self.half[which], self.there[which])


def _plans_of(shapes: PackedShapes) -> _Plans:
    """Give the ground plans of the shapes that something on the ground can run into."""
    half = shapes.halves
    rotations = np.swapaxes(shapes.maps[:, :, :3] * half[:, :, None], 1, 2)
    yaws = np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0])
    along = np.stack([np.cos(yaws), np.sin(yaws)], axis=1)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    extents = [(np.abs(np.einsum("pi,pij->pj", axis, rotations[:, :2])) * half).sum(axis=1) for axis in (along, across)]
    lowest = shapes.spheres[:, 2] - (np.abs(rotations[:, 2]) * half).sum(axis=1)
    return _Plans(shapes.spheres[:, :2], yaws, np.stack(extents, axis=1), lowest < _HEADROOM)


def _overlapping(a: _Plans, b: _Plans) -> BoolArray:
    """Report pair by pair (N,) whether rectangles that are both there touch: no side's direction parts them."""
    apart = b.centers - a.centers
    touching = a.there & b.there
    rotation = b.yaws - a.yaws
    cosine, sine = np.abs(np.cos(rotation)), np.abs(np.sin(rotation))
    mixed = np.stack([np.stack([cosine, sine], axis=1), np.stack([sine, cosine], axis=1)], axis=1)
    for own, other in ((a, b), (b, a)):
        along = np.stack([np.cos(own.yaws), np.sin(own.yaws)], axis=1)
        across = np.stack([-along[:, 1], along[:, 0]], axis=1)
        reach = own.half + np.einsum("nij,nj->ni", mixed, other.half)
        for k, axis in enumerate((along, across)):
            touching = touching & (np.abs((apart * axis).sum(axis=1)) < reach[:, k])
    return touching


@dataclass(slots=True)
class _Clearance:
    """The ground that is taken at each of T times while movers are planned."""

    stationary: _Plans  # what never moves
    moving: list[_Plans] = field(default_factory=list)  # the plans of each mover, one per time

    def try_add(self, plans: _Plans) -> bool:
        """Take the ground of a mover at all times unless it would come too near something; report whether."""
        wider = _Plans(plans.centers, plans.yaws, plans.half + _SPARE, plans.there)
        if not plans.there.any() or self._hits_stationary(wider) or self._hits_moving(wider):
            return False
        self.moving.append(plans)
        return True

    def _hits_stationary(self, plans: _Plans) -> bool:
        plans = plans.taken(plans.there)
        return any(
            self._hits_near(plans.taken(slice(start, start + _STRETCH)))
            for start in range(0, len(plans.yaws), _STRETCH)
        )

    def _hits_near(self, plans: _Plans) -> bool:
        """The same for a short stretch of a trajectory, where few things stand."""
        reach = self.stationary.radii[:, None] + float(plans.radii.max())
        low, high = plans.centers.min(axis=0) - reach, plans.centers.max(axis=0) + reach
        near = ((self.stationary.centers > low) & (self.stationary.centers < high)).all(axis=1)
        obstacles = self.stationary.taken(near & self.stationary.there)
        apart = plans.centers[:, None] - obstacles.centers[None]
        reach = plans.radii[:, None] + obstacles.radii[None]
        time, which = np.nonzero((apart * apart).sum(axis=2) < reach * reach)
        return len(time) > 0 and bool(_overlapping(plans.taken(time), obstacles.taken(which)).any())

    def _hits_moving(self, plans: _Plans) -> bool:
        for other in self.moving:
            apart, reach = plans.centers - other.centers, plans.radii + other.radii
            near = np.flatnonzero((apart * apart).sum(axis=1) < reach * reach)
            if len(near) and _overlapping(plans.taken(near), other.taken(near)).any():
                return True
        return False


_KNOT_STEP = 0.25
_MARGIN = 1.0  # how far curves reach beyond the drive [s]
_LOOK = 0.05  # movers are kept apart at times this close [s]
_END = 3.0  # nearer to the end of the street than this nobody is there [m]
_EGO_LW = (4.6, 1.86)  # ground that the ego takes [m]
_TRIES = 6
_OWN_LANE, _ONCOMING_LANE = 0.0, 3.5
_EDGES = ((-1.5, 1.0), (5.05, -1.0))
"""Where cyclists ride: metres left of the trajectory, and whether with the ego or against it."""

_PAVEMENTS = (-5.6, 9.1)  # where pedestrians walk between posts, trees and bins: metres left of the trajectory


@dataclass(frozen=True, slots=True, kw_only=True)
class TrafficSpec:
    """How busy the street is.

    Attributes:
        cars: moving cars on 100 m of each lane.
        cyclists: on 100 m of each edge of the road.
        pedestrians: on 100 m of each pavement. They and the cyclists are fewer where there is no room.
        stationary: share of the pedestrians who stand.
        crossing: share of the pedestrians who cross the street.
        oncoming: slowest and fastest speed of oncoming cars [m/s], which all go at one of these.

    Raises:
        OptionError: a number is out of bounds.
    """

    cars: float = 2.0
    cyclists: float = 1.0
    pedestrians: float = 4.0
    stationary: float = 0.2
    crossing: float = 0.3
    oncoming: tuple[float, float] = (6.5, 9.0)

    def __post_init__(self) -> None:
        check_bounds("traffic", self, cars=(0.0, 6.0), cyclists=(0.0, 10.0), pedestrians=(0.0, 20.0))
        check_bounds("traffic", self, stationary=(0.0, 1.0), crossing=(0.0, 1.0 - self.stationary))
        check_bounds("traffic", self, oncoming=((0.0, 60.0), (self.oncoming[0], 60.0)))

    def plan(
        self, generator: np.random.Generator, path: EgoPath, street: "Street", *, span_ns: tuple[int, int]
    ) -> Movers:
        """Put movers into a street for a drive; where there is no room for one it is left out.

        Args:
            street: what stands in it; movers are numbered after it.
            span_ns: first and last time that any sensor needs [ns].
        """
        first, last = ((timestamp - path.start_ns) * 1e-9 for timestamp in span_ns)
        count = int(np.ceil((last - first + 2 * _MARGIN) / _KNOT_STEP)) + DEGREE + 1
        knots: Float64Array = first - _MARGIN + _KNOT_STEP * (np.arange(count, dtype=np.float64) - 2.0)
        looks: Float64Array = np.arange(first, last + _LOOK, _LOOK)
        plan = _Plan(path, Lane.of(path), knots, looks, _Clearance(_plans_of(street.shapes), [_ego_plans(path, looks)]))
        for add in (_add_cars, _add_cyclists, _add_pedestrians):
            add(generator, self, plan)
        things = [_mover(len(street.objects) + 1 + k, plan, k, span_ns=span_ns) for k in range(len(plan.designs))]
        curves = np.array(plan.curves).reshape(-1, count, 4)
        first_knot, start_ns = plan.first_knot, path.start_ns
        return pack_movers(things, plan.designs, curves, start_ns=start_ns, first_knot=first_knot, knot_step=_KNOT_STEP)


@dataclass(slots=True)
class _Plan:
    """The street over the time of a drive, while movers are put into it."""

    path: EgoPath  # of the ego
    lane: Lane  # of the ego
    knots: Float64Array  # (N,) float64 [s], when control points weigh most
    looks: Float64Array  # (T,) float64 [s], when movers are kept apart
    clearance: _Clearance  # the ground that is taken
    designs: list[MovingDesign] = field(default_factory=list)  # of those that found room
    curves: list[Float64Array] = field(default_factory=list)  # (N, 4) control points of each
    there: list[BoolArray] = field(default_factory=list)  # (T,) of each

    @property
    def first_knot(self) -> float:
        """Time of the splines' first knot [s]."""
        return float(self.knots[0]) + 2 * _KNOT_STEP

    def try_add(self, design: MovingDesign, samples: Float64Array, inside: BoolArray | None = None) -> bool:
        """Let someone follow x, y, yaw and gait (N, 4) at the knots, unless that is too near another.

        Args:
            inside: (N,) bool, which samples lie in the street; None for all.
        """
        curve = control_points_through(samples)
        along = (self.looks - self.first_knot) / _KNOT_STEP
        (states,) = spline_derivatives(curve[None], np.zeros(1, np.int64), along, orders=1)
        inside = np.ones(len(samples), np.bool_) if inside is None else inside
        there = np.interp(self.looks, self.knots, inside.astype(np.float64)) >= 1.0
        half = np.tile(np.array(design.size_lwh[:2]) / 2, (len(self.looks), 1))
        if not self.clearance.try_add(_Plans(states[:, :2], states[:, 2], half, there)):
            return False
        self.designs.append(design)
        self.curves.append(curve)
        self.there.append(there)
        return True


def _ego_plans(path: EgoPath, looks: Float64Array) -> _Plans:
    states = path.at_seconds(looks)
    yaws = np.arctan2(states.rotations[:, 1, 0], states.rotations[:, 0, 0])
    half = np.tile(np.array(_EGO_LW) / 2, (len(looks), 1))
    return _Plans(states.positions[:, :2], yaws, half, np.ones(len(looks), np.bool_))


def _mover(instance: int, plan: _Plan, k: int, *, span_ns: tuple[int, int]) -> Mover:
    design, there = plan.designs[k], np.flatnonzero(plan.there[k])
    timestamps = plan.path.start_ns + np.rint(plan.looks[there[[0, -1]]] * 1e9).astype(np.int64)
    first = span_ns[0] if there[0] == 0 else int(timestamps[0])
    last = span_ns[1] if there[-1] == len(plan.looks) - 1 else int(timestamps[1])
    stands = not np.ptp(plan.curves[k], axis=0).any()
    return Mover(instance, design.label, design.size_lwh, first, last, stands)


def _on_track(
    track: _Track, along: Float64Array, *, ahead: float, gait: Float64Array | float = 0.0
) -> tuple[Float64Array, BoolArray]:
    """Samples of someone who follows a track, and which of them lie in the street."""
    points, headings = track.at(along)
    yaws = headings + (0.0 if ahead > 0 else np.pi)
    samples = np.column_stack([points, yaws, np.broadcast_to(gait, len(along))])
    return samples, (along > _END) & (along < track.length - _END)


def _add_cars(generator: np.random.Generator, spec: TrafficSpec, plan: _Plan) -> None:
    """Cars before and behind the ego, which stop and go as it does, and a stream of oncoming ones."""
    if spec.cars == 0:
        return
    spacing = min(100.0 / spec.cars, 1e9)
    parameters, _, _ = plan.path.warp.at(plan.knots)
    for side in (1.0, -1.0):
        track = _Track.of(plan.lane, _OWN_LANE + generator.uniform(-0.08, 0.08))
        ego = track.beside(parameters)
        room = track.length - float(ego.max()) if side > 0 else float(ego.min())
        for gap in _gaps(generator, generator.uniform(14.0, 24.0), spacing, room - 8.0):
            along = ego + side * gap + _wave(generator, 2.0, (0.3, 0.5), parameters)
            plan.try_add(design_moving_car(generator), *_on_track(track, along, ahead=1.0))
    track = _Track.of(plan.lane, _ONCOMING_LANE)
    driven = generator.uniform(*spec.oncoming) * plan.knots + _wave(generator, 3.0, (0.35, 0.45), plan.knots)
    reach = track.length + float(np.ptp(driven))
    for location in _gaps(generator, generator.uniform(0.0, spacing), spacing, reach):
        along = location - (driven - driven[0]) + _wave(generator, 1.0, (0.4, 0.7), plan.knots)
        plan.try_add(design_moving_car(generator), *_on_track(track, along, ahead=-1.0))


def _gaps(generator: np.random.Generator, first: float, spacing: float, last: float) -> Iterator[float]:
    """Locations from `first` to `last` [m], apart by the spacing on average and by a car and its distance at least."""
    location = first
    while location < last:
        yield location
        location += max(13.0, spacing * generator.uniform(0.5, 1.5))


def _wave(
    generator: np.random.Generator, amplitude: float, frequencies: tuple[float, float], seconds: Float64Array
) -> Float64Array:
    """A sine over time: amplitude [m], angular frequency drawn from a range [rad/s]."""
    frequency, phase = generator.uniform(*frequencies), generator.uniform(0, 2 * np.pi)
    return np.asarray(amplitude * np.sin(frequency * seconds + phase), np.float64)


def _add_cyclists(generator: np.random.Generator, spec: TrafficSpec, plan: _Plan) -> None:
    """Cyclists at both edges of the road, each at a speed of its own."""
    for left, ahead in _EDGES:
        track = _Track.of(plan.lane, left)
        flow = 4.5 * float(np.ptp(plan.knots))
        for _ in range(generator.poisson(spec.cyclists / 100.0 * (track.length + flow))):
            design = design_cyclist(generator)
            for _ in range(_TRIES):
                speed, wave = generator.uniform(3.4, 5.6), _wave(generator, 0.8, (0.3, 0.5), plan.knots)
                start = generator.uniform(-flow, track.length)
                driven = start + speed * (plan.knots - plan.knots[0]) + wave
                along = driven if ahead > 0 else track.length - driven
                if plan.try_add(design, *_on_track(track, along, ahead=ahead)):
                    break


def _add_pedestrians(generator: np.random.Generator, spec: TrafficSpec, plan: _Plan) -> None:
    """Some walk along the pavements, some stand there, some cross the street."""
    for left in _PAVEMENTS:
        length = _Track.of(plan.lane, left).length
        for _ in range(generator.poisson(spec.pedestrians / 100.0 * length)):
            kind = generator.uniform()
            add = _try_stand if kind < spec.stationary else _try_walk
            if spec.stationary <= kind < spec.stationary + spec.crossing:
                add = _try_cross
            design = design_pedestrian(generator, walks=add is not _try_stand)
            any(add(generator, plan, design, left) for _ in range(_TRIES))


def _try_walk(generator: np.random.Generator, plan: _Plan, design: MovingDesign, left: float) -> bool:
    track = _Track.of(plan.lane, left)
    ahead = 1.0 if generator.uniform() < 0.5 else -1.0
    speed, wave = generator.uniform(0.95, 1.6), _wave(generator, 0.25, (0.3, 0.5), plan.knots)
    walked = speed * (plan.knots - plan.knots[0]) + wave
    along = generator.uniform(0.0, track.length) + ahead * (walked - generator.uniform() * walked[-1])
    if track.narrowest(float(along.min()), float(along.max())) < 0.25:
        return False
    gait = 2 * np.pi * walked / (0.8 * design.size_lwh[2])
    return plan.try_add(design, *_on_track(track, along, ahead=ahead, gait=gait))


def _try_stand(generator: np.random.Generator, plan: _Plan, design: MovingDesign, left: float) -> bool:
    side = np.sign(left - 1.75)
    spot = _Track.of(plan.lane, left + generator.uniform(-1.2, 0.5) * side)
    point, heading = spot.at(np.array([generator.uniform(_END, spot.length - _END)]))
    sample = np.array([*point[0], heading[0] + generator.uniform(-np.pi, np.pi), 0.0])
    return plan.try_add(design, np.tile(sample, (len(plan.knots), 1)))


def _try_cross(generator: np.random.Generator, plan: _Plan, design: MovingDesign, left: float) -> bool:
    """Stand on the pavement, cross the street squarely near where the ego is by then, stand again."""
    track = _Track.of(plan.lane, left)
    begin = generator.uniform(plan.knots[0] - 6.0, plan.knots[-1])
    parameter, _, _ = plan.path.warp.at(np.array([begin]))
    along = track.beside(parameter)[0] + generator.uniform(-15.0, 60.0)
    if not _END < along < track.length - _END:
        return False
    (near,), (heading,) = track.at(np.array([along]))
    across = (_PAVEMENTS[0] + _PAVEMENTS[1] - left) - left
    speed, strides = generator.uniform(1.1, 1.6), 0.8 * design.size_lwh[2]
    share = _crossing_share(plan.knots, begin, abs(across) / speed)
    side = np.array([-np.sin(heading), np.cos(heading)])
    points = near + across * share[:, None] * side
    gait = 2 * np.pi * round(abs(across) / strides) * share
    yaw = heading + np.sign(across) * np.pi / 2
    return plan.try_add(design, np.column_stack([points, np.full(len(points), yaw), gait]))


def _crossing_share(seconds: Float64Array, begin: float, lasts: float) -> Float64Array:
    """How much of a trajectory is walked, 0 to 1: at a constant speed but for a second at either end."""
    past = np.clip(seconds - begin, 0.0, lasts + 1.0)
    starting, stopping = np.clip(past, 0.0, 1.0), np.clip(past - lasts, 0.0, 1.0)
    share: Float64Array = (0.5 * starting**2 + np.maximum(0.0, past - 1.0) - 0.5 * stopping**2) / lasts
    return share


def control_points_through(samples: Float64Array) -> Float64Array:
    """Give control points (..., N, C) of splines that pass samples (..., N, C) at the knots to fourth order.

    A spline whose control points are the samples lags by a quarter of their second difference: the variance of the
    basis, 6 / 12, halved. The ends keep their samples.
    """
    control = samples.copy()
    control[..., 1:-1, :] -= 0.25 * np.diff(samples, 2, axis=-2)
    return control
