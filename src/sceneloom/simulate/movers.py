"""What moves in the street: splines over time for location and heading, and frames that bodies move with.

A mover's location, heading and gait are one smooth curve over time, so velocity and yaw rate are derivatives and not
differences. Everything but a walker's legs is fixed in the mover's own frame: x forward, y left, z up, the origin on
the ground under the middle of its box. A leg has a frame that swings about the hip's y axis.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float64Array, Int64Array
from sceneloom.kernels.part_frames import put_parts
from sceneloom.simulate.shapes import PackedShapes, Shape
from sceneloom.simulate.splines import spline_derivatives, spline_grid

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
