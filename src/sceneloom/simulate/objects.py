"""Objects of the simulated street: convex shapes, static objects, moving ones, and road users.

An object's frame has x along its forward axis, y to its left, z up and the origin on the ground under its middle.

A mover's location, heading and gait are one smooth curve over time, so velocity and yaw rate are derivatives and not
differences. Everything but a walker's legs is fixed in the mover's own frame: x forward, y left, z up, the origin on
the ground under the middle of its box. A leg has a frame that swings about the hip's y axis.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from enum import IntEnum

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float64Array, Int64Array, UInt8Array
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.simulate import painting
from sceneloom.simulate import raycast as simulate_raycast
from sceneloom.simulate.raycast import put_parts
from sceneloom.simulate.trajectory import rotation_from_angles, spline_derivatives, spline_grid

_Color = tuple[float, float, float]
"""Red, green, blue in 0..255, as light of full strength would show them."""


class ShapeKind(IntEnum):
    """The unit bodies that the ray caster knows."""

    BOX = simulate_raycast.BOX
    CYLINDER = simulate_raycast.CYLINDER
    ELLIPSOID = simulate_raycast.ELLIPSOID
    GABLE = simulate_raycast.GABLE


class Pattern(IntEnum):
    """How a surface mixes the colours of its palette."""

    PLAIN = painting.PLAIN
    FACADE = painting.FACADE
    BRICK = painting.BRICK
    TILES = painting.TILES
    FOLIAGE = painting.FOLIAGE
    BARK = painting.BARK
    CAR_BODY = painting.CAR_BODY
    CAR_CABIN = painting.CAR_CABIN
    TYRE = painting.TYRE
    BANDS = painting.BANDS


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
            *(
                np.concatenate([getattr(self, part.name), getattr(others, part.name)])
                for part in fields(PackedShapes)
            )
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
        return (
            float(x + self.ahead * np.cos(yaw)),
            float(y + self.ahead * np.sin(yaw)),
            self.size_lwh[2] / 2,
        )

    def plan(self, x: float, y: float, yaw: float) -> Float64Array:
        """Corners and middles of the sides of its ground plan in the world, (8, 2) [m]."""
        around = np.array([[1, 1], [0, 1], [-1, 1], [-1, 0], [-1, -1], [0, -1], [1, -1], [1, 0]])
        plan = around * (0.5 * np.array(self.plan_lw or self.size_lwh[:2]))
        rotation = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        corners: Float64Array = plan @ rotation.T + [x, y]
        return corners

    def placed(self, x: float, y: float, yaw: float) -> tuple[Shape, ...]:
        """Its shapes in the world, stationary at (x, y) [m] and rotated by `yaw` [rad]."""
        rotation = rotation_from_angles(np.zeros(()), np.zeros(()), np.asarray(yaw))
        world_from_object = RigidTransform(rotation, np.array([x, y, 0.0]))
        return tuple(shape.moved(world_from_object) for shape in self.shapes)


def _at(x: float, y: float, z: float) -> RigidTransform:
    return RigidTransform(np.eye(3), np.array([x, y, z]))


def _lying(x: float, y: float, z: float) -> RigidTransform:
    """A cylinder's pose with its axis along y."""
    quarter = rotation_from_angles(np.array(np.pi / 2), np.zeros(()), np.zeros(()))
    return RigidTransform(quarter, np.array([x, y, z]))


def _stationary(
    kind: ShapeKind, half: tuple[float, float, float], foot: Sequence[float], material: Material
) -> Shape:
    """A shape whose lowest point is at `foot`."""
    return Shape(kind, _at(foot[0], foot[1], foot[2] + half[2]), half, material)


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
            ShapeKind.BOX,
            (0.28 * length, 0.46 * width, (height - waist) / 2),
            (-0.06 * length, 0, waist),
            cabin,
        ),
    ]
    wheels = [
        Shape(ShapeKind.CYLINDER, _lying(x, y, 0.32), (0.32, 0.32, 0.11), tyre)
        for x in (0.31 * length, -0.31 * length)
        for y in (width / 2 - 0.09, 0.09 - width / 2)
    ]
    return Design("car", (*shapes, *wheels), (length, width + 0.04, height))


def design_tree(generator: np.random.Generator) -> Design:
    """A trunk and a crown of two overlapping balls of leaves."""
    radius, crown, foot = (
        generator.uniform(0.12, 0.2),
        generator.uniform(1.2, 1.7),
        generator.uniform(2.2, 2.8),
    )
    bark = Material(Pattern.BARK, ((96, 76, 58), (64, 52, 42), (64, 52, 42)), reflectivity=0.4)
    colors = _LEAVES[int(generator.integers(len(_LEAVES)))]
    leaves = Material(Pattern.FOLIAGE, colors, reflectivity=0.55)
    rise = crown * generator.uniform(0.95, 1.35)
    shapes = (
        _stationary(ShapeKind.CYLINDER, (radius, radius, foot / 2 + 0.4), (0, 0, 0), bark),
        _stationary(ShapeKind.ELLIPSOID, (crown, crown, rise), (0, 0, foot), leaves),
        _stationary(
            ShapeKind.ELLIPSOID,
            (0.7 * crown, 0.7 * crown, 0.6 * rise),
            (0.25 * crown, -0.1, foot + 1.1 * rise),
            leaves,
        ),
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


_FASTEST = 40.0
"""No mover is faster [m/s]."""


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
        values, rates = spline_derivatives(
            self.control_points, np.asarray(which), self._along(times_ns), orders=2
        )
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
        states = spline_grid(self.control_points[which], self._along(times_ns)) + self.anchors[which]
        there = self.present(which[None, :], times_ns[:, None])
        frames = np.empty((len(times_ns), len(parts), 3, 4))
        put_parts(
            states, there, mover_of_part, self.hinges[parts], self.swings[parts], self.leads[parts], frames
        )
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

    def _balls(
        self, shapes: Int64Array, low: Float64Array, high: Float64Array, columns: AnyArray
    ) -> Float64Array:
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

    def point_velocities(
        self, shapes: Int64Array, points_world: Float64Array, times_ns: Int64Array
    ) -> Float64Array:
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


NO_MOVERS = pack_movers((), (), np.zeros((0, 6, 4)), start_ns=0, first_knot=0.0, knot_step=1.0)
"""A street where nothing moves."""

_Point = tuple[float, float, float]

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

_STEP = 0.3
"""How far a walker's leg swings to either side [rad]."""


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
        Part(_leg(0.09 * side, hip, trousers), (0, 0.09 * side, hip), _STEP if walks else 0.0, lead)
        for side, lead in ((1.0, 0.0), (-1.0, np.pi))
    ]
    return _designed("pedestrian", (Part(tuple(body)), *legs))


def design_cyclist(generator: np.random.Generator) -> MovingDesign:
    """Someone on a bicycle: two wheels, a frame and its rider."""
    coat, trousers = _cloth(generator, _CLOTHES), _cloth(generator, _TROUSERS)
    skin, helmet, steel = (_cloth(generator, choice) for choice in (_SKIN, _HELMETS, _FRAMES))
    tyre = Material(Pattern.TYRE, ((34, 34, 36), (150, 154, 158), (96, 98, 102)), reflectivity=0.25)
    lying = rotation_from_angles(np.array(np.pi / 2), np.zeros(()), np.zeros(()))
    shapes = [
        Shape(ShapeKind.CYLINDER, RigidTransform(lying, np.array([x, 0.0, 0.34])), (0.34, 0.34, 0.02), tyre)
        for x in (-0.52, 0.52)
    ]
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
    color = choices[int(generator.integers(len(choices)))]
    return Material(Pattern.PLAIN, (color,) * 3, reflectivity=0.55)


def _upright(kind: ShapeKind, center: _Point, half: _Point, material: Material) -> Shape:
    return Shape(kind, RigidTransform(np.eye(3), np.array(center, np.float64)), half, material)


def _limb(start: _Point, end: _Point, radius: float, material: Material) -> Shape:
    """A cylinder from one point to another."""
    a, b = np.array(start, np.float64), np.array(end, np.float64)
    length = float(np.linalg.norm(b - a))
    axis = (b - a) / length
    beside = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.9 else [0.0, 1.0, 0.0])
    beside /= np.linalg.norm(beside)
    rotation = np.column_stack([beside, np.cross(axis, beside), axis])
    return Shape(
        ShapeKind.CYLINDER, RigidTransform(rotation, (a + b) / 2), (radius, radius, length / 2), material
    )


def _designed(label: str, parts: tuple[Part, ...]) -> MovingDesign:
    """Put the box around all that parts do: symmetric about the origin, from the ground up."""
    reach = np.zeros(3)
    for part in parts:
        rotations = np.array([shape.pose.rotation for shape in part.shapes])
        centers = np.array([shape.pose.translation for shape in part.shapes]) - part.hinge
        for angle in np.linspace(-part.swing, part.swing, 9 if part.swing else 1):
            delta_rotation = rotation_from_angles(np.zeros(()), np.array(-angle), np.zeros(()))
            locations = np.abs(centers @ delta_rotation.T + part.hinge)
            for shape, rotation, location in zip(
                part.shapes, delta_rotation @ rotations, locations, strict=True
            ):
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
