"""The simulated ego trajectory: splines, stops, poses that are exact at any time, and sensors mounted on it."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import comb, factorial

import numpy as np
from numpy.polynomial import polynomial

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import RigidTransform, quaternion_from_matrix
from sceneloom.scene.poses import Poses
from sceneloom.simulate.parameters import check_bounds

DEGREE = 5


def _basis_rows() -> Float64Array:
    """Coefficients (6, 6) of the uniform quintic B-spline: row j weighs control point i + j, powers ascending.

    Source: Schoenberg 1946: N(x) = 1/5! Σ (-1)^k C(6, k) max(x - k, 0)^5.
    """
    rows = np.zeros((DEGREE + 1, DEGREE + 1))
    for j in range(DEGREE + 1):
        for k in range(DEGREE - j + 1):
            power = polynomial.polypow([DEGREE - j - k, 1.0], DEGREE)
            rows[j] += (-1) ** k * comb(DEGREE + 1, k) / factorial(DEGREE) * power
    return rows


BASIS = _basis_rows()


def spline_derivatives(
    control_points: Float64Array, which: Int64Array, along: Float64Array, *, orders: int
) -> tuple[Float64Array, ...]:
    """Give splines and their derivatives by the knot number.

    Args:
        control_points: (K, N, C) float64; control point i weighs most at knot number i - 2.
        which: (*S,) int64, which spline.
        along: (*S) float64, knot number; the shapes of `which` and `along` are broadcast.
        orders: how many: 1 for the values alone, 2 with the first derivative.

    Returns:
        `orders` arrays (*S, C) float64.
    """
    which, along = np.broadcast_arrays(which, along)
    piece = np.clip(np.floor(along).astype(np.int64), 0, control_points.shape[1] - DEGREE - 1)
    gathered = control_points[which[..., None], piece[..., None] + np.arange(DEGREE + 1)]
    answers = []
    for order in range(orders):
        coefficients = polynomial.polyder(BASIS, order, axis=1)
        weights = np.moveaxis(polynomial.polyval(along - piece, coefficients.T), 0, -1)
        answers.append(np.einsum("...j,...jc->...c", weights, gathered))
    return tuple(answers)


_RISE = np.array([0.0, 0.0, 0.0, 10.0, -15.0, 6.0])
"""A step from 0 to 1 over [0, 1], flat to the second derivative at both ends.

Source: Hermite interpolation of degree five; 10 x³ - 15 x⁴ + 6 x⁵."""

_AREA = polynomial.polyint(_RISE)
_SLOPE = polynomial.polyder(_RISE)


@dataclass(frozen=True, slots=True)
class Stop:
    """A while in which the car stands.

    Attributes:
        at_s: when it stands [s], after the start of the drive; it brakes before.
        for_s: for how long [s].

    Raises:
        OptionError: a number is not finite, or `for_s` is negative.
    """

    at_s: float
    for_s: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.at_s) and np.isfinite(self.for_s) and self.for_s >= 0):
            raise OptionError(f"stop at {self.at_s} s for {self.for_s} s; expected finite, not negative")


@dataclass(frozen=True, slots=True, eq=False)
class TimeWarp:
    """How far a drive with stops has come, in seconds of the same drive without.

    The pace falls from 1 to 0 over `ramp` seconds before a stop and rises again after it, with two continuous
    derivatives; during a stop the answer is the same to the last bit.

    Attributes:
        begins, ends: (S,) float64 [s], in order, apart by twice the ramp at least.
        ramp: time for braking and for starting [s].
    """

    begins: Float64Array
    ends: Float64Array
    ramp: float

    @classmethod
    def of(cls, stops: Sequence[Stop], *, ramp: float) -> "TimeWarp":
        """Put stops in order.

        Raises:
            OptionError: there is no time to start and to brake between two of them.
        """
        ordered = sorted(stops, key=lambda stop: stop.at_s)
        begins = np.array([stop.at_s for stop in ordered], np.float64)
        ends = np.array([stop.at_s + stop.for_s for stop in ordered], np.float64)
        if (begins[1:] - ends[:-1] < 2 * ramp).any():
            raise OptionError(f"stops at {begins.tolist()} s; expected {2 * ramp} s between two at least")
        return cls(begins, ends, ramp)

    def at(self, seconds: Float64Array) -> tuple[Float64Array, Float64Array, Float64Array]:
        """Give the warped time [s], its pace and the pace's slope [1/s] at (M,) times [s]; time 0 stays 0."""
        seconds = np.asarray(seconds, np.float64)
        return self._time(seconds) - self._time(np.zeros(1)), self._pace(seconds, 0), self._pace(seconds, 1)

    def _time(self, seconds: Float64Array) -> Float64Array:
        """The warped time up to a constant: what is driven at full pace, less what the ramps lose."""
        if not len(self.begins):
            return seconds
        time: Float64Array = np.minimum(seconds, self.begins[0])
        for end, begin in zip(self.ends, [*self.begins[1:], np.inf], strict=True):
            time = time + np.clip(seconds - end, 0.0, begin - end)
        for begin, end in zip(self.begins, self.ends, strict=True):
            braked = np.clip((seconds - begin) / self.ramp + 1.0, 0.0, 1.0)
            started = np.clip((seconds - end) / self.ramp, 0.0, 1.0)
            lost = polynomial.polyval(braked, _AREA) + started - polynomial.polyval(started, _AREA)
            time = time - self.ramp * lost
        return time

    def _pace(self, seconds: Float64Array, order: int) -> Float64Array:
        """The warped time's first derivative or, with order 1, its second."""
        rise = (_RISE, _SLOPE / self.ramp)[order]
        pace = np.full(seconds.shape, 1.0 - order)
        for begin, end in zip(self.begins, self.ends, strict=True):
            braked = np.clip((seconds - begin) / self.ramp + 1.0, 0.0, 1.0)
            started = np.clip((seconds - end) / self.ramp, 0.0, 1.0)
            pace = pace - polynomial.polyval(braked, rise) + polynomial.polyval(started, rise)
        return pace


_LEAD = 16.0  # seconds by which the curve goes on before and after the drive: the street is built along all of it
_AHEAD = 6.0  # seconds after the drive for which the street still rotates
_KNOT_STEP = 1.0
_WIDEST_HEADING = np.radians(55.0)
_GENTLE_ROTATION = 0.21  # up to this rate [rad/s] knots a second apart follow a rotation; faster ones need them closer
_TIGHTEST = 10.4  # no rotation is planned with a smaller radius [m]: where the pavement on the left ends


@dataclass(frozen=True, slots=True, kw_only=True)
class PathSpec:
    """How the ego drives.

    Attributes:
        speeds: slowest and fastest [m/s]. Bends are taken at the slowest speed, or faster where that would make
            them tighter than the street is wide.
        yaw_rate: greatest yaw rate [rad/s].
        stops: when the ego stands truly still, its body included; it neither brakes nor starts in between.
        ramp: time for braking before a stop and for starting after it [s].

    Raises:
        OptionError: a number is out of bounds, or stops lie too near each other.
    """

    speeds: tuple[float, float] = (5.0, 10.5)
    yaw_rate: float = 0.21
    stops: tuple[Stop, ...] = ()
    ramp: float = 4.0

    def __post_init__(self) -> None:
        slowest, fastest = self.speeds
        if not 0.5 <= slowest <= fastest <= 60.0:
            raise OptionError(f"path.speeds: {self.speeds}; expected 0.5 to 60 m/s, the slowest first")
        check_bounds("path", self, yaw_rate=(0.01, 1.5), ramp=(0.5, 60.0))
        TimeWarp.of(self.stops, ramp=self.ramp)

    def plan(self, generator: np.random.Generator, *, start_ns: int, duration: float) -> "EgoPath":
        """Lay out a drive of some seconds: straights and bends, faster and slower, never across itself.

        Stops change nothing of the curve: the ego only comes less far along it.
        """
        step = _KNOT_STEP * min(1.0, _GENTLE_ROTATION / self.yaw_rate)
        knots = np.arange(-_LEAD, duration + _LEAD + step, step)
        headings = _plan_headings(generator, knots, duration, self.yaw_rate)
        speeds = _plan_speeds(generator, knots, headings, self)
        steps = step * speeds[:, None] * np.column_stack([np.cos(headings), np.sin(headings)])
        points = np.cumsum(steps, axis=0)
        path = EgoPath(start_ns, float(knots[0]), points, _plan_waves(generator), step)
        origin = path.at_seconds(np.zeros(1)).positions[0, :2]
        warp = TimeWarp.of(self.stops, ramp=self.ramp)
        return EgoPath(start_ns, float(knots[0]), points - origin, path.waves, step, warp)


@dataclass(frozen=True, slots=True, eq=False)
class EgoStates:
    """Exact motion of the ego at some times.

    Attributes:
        positions: (M, 3) float64 [m], world frame.
        rotations: (M, 3, 3) float64 `world_from_ego`.
        velocities: (M, 3) float64 [m/s], world frame.
        accelerations: (M, 3) float64 [m/s²], world frame, without gravity.
        angular_rates: (M, 3) float64 [rad/s], ego frame.
    """

    positions: Float64Array
    rotations: Float64Array
    velocities: Float64Array
    accelerations: Float64Array
    angular_rates: Float64Array

    @property
    def quaternions_xyzw(self) -> Float64Array:
        """The rotations as (M, 4) unit quaternions."""
        return quaternion_from_matrix(self.rotations)


_NEVER_STOPS = TimeWarp.of((), ramp=1.0)


@dataclass(frozen=True, slots=True, eq=False)
class EgoPath:
    """A smooth trajectory through the world: a quintic spline on the ground, with a little heave, roll and pitch.

    The ego looks along its horizontal velocity; roll, pitch and height are sums of sines. Position has four
    continuous derivatives.

    Attributes:
        start_ns: time zero of the curve [ns].
        first_knot: time of the first knot [s], relative to `start_ns`.
        control_points: (K, 2) float64 [m], one per `knot_step`.
        waves: (3, W, 3) float64: for height [m], roll and pitch [rad] the amplitude, angular frequency [rad/s] and
            phase of W sines.
        knot_step: time between knots [s].
        warp: how far along the curve the ego has come at each time.
    """

    start_ns: int
    first_knot: float
    control_points: Float64Array
    waves: Float64Array
    knot_step: float = _KNOT_STEP
    warp: TimeWarp = _NEVER_STOPS

    @property
    def reach(self) -> tuple[float, float]:
        """First and last parameter at which the curve is defined: seconds of a drive without stops."""
        chunks = len(self.control_points) - DEGREE
        return self.first_knot, self.first_knot + chunks * self.knot_step

    def at(self, timestamps_ns: Int64Array) -> EgoStates:
        """Give the exact motion at (M,) int64 times [ns], which lie within `reach`."""
        seconds = np.asarray(timestamps_ns - self.start_ns, np.float64) * 1e-9
        return self.at_seconds(seconds)

    def at_seconds(self, seconds: Float64Array) -> EgoStates:
        """Give the exact motion at (M,) times [s] relative to `start_ns`."""
        parameters, pace, slope = self.warp.at(seconds)
        on_curve = self.on_curve(parameters)
        pace, slope = pace[:, None], slope[:, None]
        return EgoStates(
            on_curve.positions,
            on_curve.rotations,
            on_curve.velocities * pace,
            on_curve.accelerations * (pace * pace) + on_curve.velocities * slope,
            on_curve.angular_rates * pace,
        )

    def on_curve(self, seconds: Float64Array) -> EgoStates:
        """Give the motion of a drive without stops at (M,) parameters [s] of the curve."""
        plane = [self._plane(seconds, order) for order in range(3)]
        (height, roll, pitch), (climb, roll_rate, pitch_rate), (heave, _, _) = (
            self._wave(seconds, order) for order in range(3)
        )
        (vx, vy), (ax, ay) = plane[1].T, plane[2].T
        yaw, yaw_rate = np.arctan2(vy, vx), (vx * ay - vy * ax) / (vx * vx + vy * vy)
        return EgoStates(
            np.column_stack([plane[0], height]),
            _rotation_from_angles(roll, pitch, yaw),
            np.column_stack([plane[1], climb]),
            np.column_stack([plane[2], heave]),
            # Source: Diebel 2006, "Representing Attitude", section 8, Euler angles (1, 2, 3)
            np.column_stack(
                [
                    roll_rate - yaw_rate * np.sin(pitch),
                    pitch_rate * np.cos(roll) + yaw_rate * np.sin(roll) * np.cos(pitch),
                    yaw_rate * np.cos(roll) * np.cos(pitch) - pitch_rate * np.sin(roll),
                ]
            ),
        )

    def mounted(self, timestamps_ns: Int64Array, mount: RigidTransform) -> tuple[Float64Array, Float64Array]:
        """Give `world_from_sensor` of a mounted sensor at (M,) times [ns]: rotations (M, 3, 3) and positions (M, 3)."""
        ego = self.at(timestamps_ns)
        return ego.rotations @ mount.rotation, ego.positions + ego.rotations @ mount.translation

    def poses(self, timestamps_ns: Int64Array) -> Poses:
        """Sample `world_from_ego` at (M,) int64 times [ns]."""
        states = self.at(timestamps_ns)
        return Poses(np.asarray(timestamps_ns, np.int64), states.positions, states.quaternions_xyzw)

    def _plane(self, seconds: Float64Array, order: int) -> Float64Array:
        """The horizontal position or one of its derivatives, (M, 2)."""
        along = (np.asarray(seconds, np.float64) - self.first_knot) / self.knot_step
        piece = np.clip(np.floor(along).astype(np.int64), 0, len(self.control_points) - DEGREE - 1)
        coefficients = polynomial.polyder(BASIS, order, axis=1) / self.knot_step**order
        weights = polynomial.polyval(along - piece, coefficients.T)
        control = self.control_points[piece[:, None] + np.arange(DEGREE + 1)]
        plane: Float64Array = np.einsum("jm,mji->mi", weights, control)
        return plane

    def _wave(self, seconds: Float64Array, order: int) -> Float64Array:
        """Height, roll and pitch or one of their derivatives, (3, M)."""
        amplitude, frequency, phase = np.moveaxis(self.waves, -1, 0)[..., None]
        swing = np.sin(frequency * np.asarray(seconds) + phase + order * np.pi / 2)
        wave: Float64Array = (amplitude * frequency**order * swing).sum(axis=1)
        return wave


def _rotation_from_angles(roll: Float64Array, pitch: Float64Array, yaw: Float64Array) -> Float64Array:
    """Give Rz(yaw) Ry(pitch) Rx(roll) as (..., 3, 3), angles in radians."""
    (sr, cr), (sp, cp), (sy, cy) = ((np.sin(angle), np.cos(angle)) for angle in (roll, pitch, yaw))
    rows = (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _plan_speeds(
    generator: np.random.Generator, knots: Float64Array, headings: Float64Array, spec: PathSpec
) -> Float64Array:
    """Speed at each knot [m/s]: up and down on the straights, slow in rotations."""
    step = float(knots[1] - knots[0])
    rotating = np.abs(np.gradient(headings, step)) / spec.yaw_rate
    if step < _KNOT_STEP:
        width = round(_KNOT_STEP / step)
        rotating = np.convolve(np.pad(rotating, width, mode="edge"), np.ones(width) / width, "same")[width:-width]
    phase, rate = generator.uniform(0, 2 * np.pi), generator.uniform(0.35, 0.5)
    slowest, fastest = spec.speeds
    wish = 0.5 * (slowest + fastest) + 0.5 * (fastest - slowest) * np.sin(rate * knots + phase)
    in_rotations = max(slowest, _TIGHTEST * spec.yaw_rate)
    speeds: Float64Array = wish + np.minimum(1.0, rotating) * (in_rotations - wish)
    return speeds


def _plan_headings(
    generator: np.random.Generator, knots: Float64Array, duration: float, yaw_rate: float
) -> Float64Array:
    """Heading at each knot [rad]: straight before and after the drive, bends to either side in turn."""
    times, angles = [float(knots[0]), generator.uniform(0.3, 1.0)], [0.0, 0.0]
    side = 1.0 if generator.uniform() < 0.5 else -1.0
    while times[-1] < duration + _AHEAD:
        target = side * generator.uniform(0.4, 1.0) * _WIDEST_HEADING
        times.append(times[-1] + abs(target - angles[-1]) / yaw_rate)
        times.append(times[-1] + generator.uniform(1.0, 4.0))
        angles += [target, target]
        side = -side
    held = np.minimum(knots, duration + _AHEAD)
    headings: Float64Array = np.interp(held, times, angles)
    return headings


def _plan_waves(generator: np.random.Generator) -> Float64Array:
    """Two sines each for height, roll and pitch: 1-2 cm and a few tenths of a degree, slower than 1 Hz."""
    amplitudes = np.array([[0.012, 0.006], [0.006, 0.003], [0.005, 0.0025]])
    frequencies = generator.uniform([[1.5, 3.0]] * 3, [[2.5, 5.0]] * 3)
    return np.stack([amplitudes, frequencies, generator.uniform(0, 2 * np.pi, (3, 2))], axis=-1)


def sensor_mount(
    *, position: tuple[float, float, float], yaw_deg: float = 0.0, pitch_deg: float = 0.0, roll_deg: float = 0.0
) -> RigidTransform:
    """Give `ego_from_sensor` of a lidar or radar, whose own axes are x ahead, y left, z up.

    Args:
        position: in the ego frame [m].
        yaw_deg, pitch_deg, roll_deg: rotations about the z, y and x axis, roll first; a positive pitch looks down.
    """
    roll, pitch, yaw = np.radians([roll_deg, pitch_deg, yaw_deg])
    return RigidTransform(_rotation_from_angles(roll, pitch, yaw), np.array(position, np.float64))
