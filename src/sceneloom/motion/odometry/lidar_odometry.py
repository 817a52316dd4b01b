"""The ego's motion from lidar sweeps alone, sweep by sweep."""

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from sceneloom.arrays import Float64Array, FloatArray, Int64Array
from sceneloom.errors import ArrayError
from sceneloom.motion.odometry.registration import (
    ROTATION,
    SHIFT,
    SPEEDS,
    VELOCITY,
    YAW_RATE,
    Fit,
    LocalMap,
    MotionState,
    OdometryConfiguration,
    Sweep,
    fit_sweep,
    guess_motion,
    rotation_vector,
    usable_sweep,
)

_UNKNOWN_ROTATION_RATE, _UNKNOWN_SPEED = 0.5, 20.0
_GUESSED_ROTATION_RATE, _GUESSED_SPEED = 0.1, 1.0
"""Standard deviations [rad/s], [m/s] before and after a first guess."""
_STANDSTILL_ROTATION, _STANDSTILL_SHIFT = 1e-4, 1e-3
"""How well a pose is known that is so by definition [rad], [m]."""
_STARTING_ROUNDS = 3
_LEAST_MATCHED, _LEAST_AGREEING = 0.3, 0.5
_GAP_PERIODS, _LEAST_GAP = 5.0, 0.5
_LONGEST_PREDICTION = 2.0
_MOST_FAILURES = 5
_DROP_EVERY = 10.0
_RENEWAL_TRAJECTORY = 15.0


class Outcome(StrEnum):
    """How a pose came about."""

    STARTED = "started"
    """The first sweep of a map."""
    FITTED = "fitted"
    """The sweep was fitted onto the map."""
    TOO_FEW = "too-few-points"
    """The sweep holds too few usable points: predicted."""
    MISFIT = "misfit"
    """The sweep does not fit onto the map: predicted."""
    RESTARTED = "restarted"
    """A new map was begun at the predicted pose: after a gap in time, or where sweeps kept misfitting."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseEstimate:
    """What one sweep reported.

    Attributes:
        state: pose and motion in the middle of the sweep, in a world that is the ego's pose at the first sweep.
        covariance: (6, 6) of a small rotation, then a small shift along the world's axes, relative to the first pose.
        outcome: how it came about.
        first_ns, last_ns: the span of the sweep's points [ns].
        first_state: pose and motion of the sweep that the map began with, where this sweep reported it; else None.
    """

    state: MotionState
    covariance: Float64Array
    outcome: Outcome
    first_ns: int
    last_ns: int
    first_state: MotionState | None = None


class LidarOdometry:
    """Follows the ego by its sweeps; memory does not grow with the drive, equal sweeps give equal poses."""

    def __init__(self, configuration: OdometryConfiguration | None = None) -> None:
        """Start without a map."""
        self.configuration = configuration or OdometryConfiguration()
        self._map = self._new_map()
        self._state: MotionState | None = None
        self._anchor: Sweep | None = None
        """The sweep that the map began with, until a second one reports how the ego moved during it."""
        self._last_good: tuple[Sweep, MotionState] | None = None
        self._drift = np.zeros((6, 6))
        self._periods: list[float] = []
        self._failures = 0
        self._cleaned_at = np.zeros(3)

    def add(
        self, timestamp_ns: int, positions_ego: FloatArray, timestamps_ns: Int64Array | None = None
    ) -> PoseEstimate | None:
        """Take the next sweep.

        Args:
            timestamp_ns: start of the sweep [ns].
            positions_ego: (N, 3) float [m], ego frame, each point as measured at its own time; what is not finite is
                left out.
            timestamps_ns: (N,) int64 [ns], or None where not known: then all are taken as measured at once.

        Returns:
            The ego's pose in the middle of the sweep; None for a sweep whose middle is not later than that of the one
            before, which changes nothing.

        Raises:
            ArrayError: shapes do not fit.
        """
        if positions_ego.ndim != 2 or positions_ego.shape[1] != 3:
            raise ArrayError(f"positions_ego: {positions_ego.shape}; expected (N, 3)")
        if timestamps_ns is not None and timestamps_ns.shape != positions_ego.shape[:1]:
            raise ArrayError(f"timestamps_ns: {timestamps_ns.shape}; expected ({len(positions_ego)},)")
        sweep = usable_sweep(timestamp_ns, positions_ego, timestamps_ns, self.configuration)
        if self._state is not None and sweep.timestamp_ns <= self._state.timestamp_ns:
            return None
        if self._state is None or self._map.is_empty:
            return self._begin(sweep)
        seconds = (sweep.timestamp_ns - self._state.timestamp_ns) * 1e-9
        gap = self._is_gap(seconds)
        prior = self._predict(self._state, sweep.timestamp_ns)
        if not gap:
            self._periods = [*self._periods[-20:], seconds]
        if len(sweep.chosen) < self.configuration.least_points:
            return self._predicted(sweep, prior, Outcome.TOO_FEW)
        if gap:
            return self._restart(sweep, prior)
        if self._anchor is not None:
            return self._second(sweep, self._state, self._anchor)
        return self._follow(sweep, prior)

    def _new_map(self) -> LocalMap:
        return LocalMap(self.configuration.cube, self.configuration.range_noise)

    def _is_gap(self, seconds: float) -> bool:
        usual = float(np.median(self._periods)) if self._periods else seconds
        return seconds > max(_GAP_PERIODS * usual, _LEAST_GAP)

    def _predict(self, state: MotionState, timestamp_ns: int) -> MotionState:
        """Go on with the last motion; over long gaps the ego stays where it was after two seconds."""
        settings = self.configuration
        reach_ns = state.timestamp_ns + int(_LONGEST_PREDICTION * 1e9)
        if timestamp_ns <= reach_ns:
            return state.predicted(timestamp_ns, settings.acceleration, settings.yaw_acceleration)
        stopped = state.predicted(reach_ns, settings.acceleration, settings.yaw_acceleration)
        grown = state.predicted(timestamp_ns, settings.acceleration, settings.yaw_acceleration).covariance
        return replace(stopped, timestamp_ns=timestamp_ns, covariance=grown)

    def _begin(self, sweep: Sweep) -> PoseEstimate:
        """The first sweep with enough points defines the world; until it comes, all poses are the identity."""
        state = MotionState(
            sweep.timestamp_ns, np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3), _unknown_motion()
        )
        self._state = state
        if len(sweep.chosen) < self.configuration.least_points:
            return PoseEstimate(state, self._drift.copy(), Outcome.TOO_FEW, sweep.first_ns, sweep.last_ns)
        self._start_map(sweep, state)
        return PoseEstimate(state, self._drift.copy(), Outcome.STARTED, sweep.first_ns, sweep.last_ns)

    def _start_map(self, sweep: Sweep, state: MotionState) -> None:
        self._map = self._new_map()
        self._map.insert(_to_world(sweep, state))
        self._anchor, self._last_good, self._failures = sweep, (sweep, state), 0
        self._cleaned_at = state.position

    def _restart(self, sweep: Sweep, prior: MotionState) -> PoseEstimate:
        """Begin a new map where the ego should be by now; all that is not known of that is drift from here on."""
        self._drift = self._carried_drift(prior) + prior.covariance[:6, :6]
        state = replace(prior, covariance=_unknown_motion())
        self._start_map(sweep, state)
        self._state = state
        return PoseEstimate(state, self._drift.copy(), Outcome.RESTARTED, sweep.first_ns, sweep.last_ns)

    def _predicted(self, sweep: Sweep, prior: MotionState, outcome: Outcome) -> PoseEstimate:
        self._drift = self._carried_drift(prior)
        self._state = prior
        covariance = self._drift + prior.covariance[:6, :6]
        return PoseEstimate(prior, covariance, outcome, sweep.first_ns, sweep.last_ns)

    def _second(self, sweep: Sweep, state: MotionState, anchor: Sweep) -> PoseEstimate:
        """Find the motion by the first two sweeps; deskew the first by it, begin the map anew, and find it again."""
        before = self._last_good[1] if self._last_good else state
        seconds = (sweep.timestamp_ns - before.timestamp_ns) * 1e-9
        motions = self._first_motions(anchor, sweep, before, seconds)
        fits = [self._fit_first(anchor, sweep, before, motion) for motion in motions]
        fit, first = max(fits, key=lambda entry: entry[0].matched * entry[0].agreeing)
        self._map = self._new_map()
        self._map.insert(_to_world(anchor, first))
        self._anchor = None
        self._drift = self._drift + fit.state.covariance[:6, :6]
        return replace(self._accept(sweep, fit), first_state=first)

    def _fit_first(
        self, anchor: Sweep, sweep: Sweep, before: MotionState, first: MotionState
    ) -> tuple[Fit, MotionState]:
        """Fit the second sweep onto the first, which is deskewed better each time."""
        for _ in range(_STARTING_ROUNDS):
            self._map = self._new_map()
            self._map.insert(_to_world(anchor, first))
            fit = self._fit(sweep, self._predict(first, sweep.timestamp_ns))
            first = _moved_between(before, fit.state)
        return fit, first

    def _first_motions(
        self, anchor: Sweep, sweep: Sweep, before: MotionState, seconds: float
    ) -> list[MotionState]:
        """What the motion may be: as it was before the start, and what matching the two sweeps says."""
        motions = [before]
        guesses = guess_motion(
            anchor.points_ego[anchor.chosen], sweep.points_ego[sweep.chosen], seconds, speeds=SPEEDS
        )
        for guess in guesses[:1]:
            later = replace(
                before,
                timestamp_ns=sweep.timestamp_ns,
                rotation=before.rotation @ guess.rotation,
                position=before.position + before.rotation @ guess.translation,
            )
            motions.append(_moved_between(before, later))
        return motions

    def _fit(self, sweep: Sweep, prior: MotionState) -> Fit:
        return fit_sweep(sweep.points_ego[sweep.chosen], sweep.seconds[sweep.chosen], prior, self._map)

    def _follow(self, sweep: Sweep, prior: MotionState) -> PoseEstimate:
        fit = self._fit(sweep, prior)
        if not _is_good(fit) and self._last_good is not None:
            fit = self._fit_from_guess(sweep, prior, fit, *self._last_good)
        if _is_good(fit):
            return self._accept(sweep, fit)
        self._failures += 1
        if self._failures > _MOST_FAILURES:
            return self._restart(sweep, prior)
        return self._predicted(sweep, prior, Outcome.MISFIT)

    def _fit_from_guess(
        self, sweep: Sweep, prior: MotionState, fit: Fit, last: Sweep, state: MotionState
    ) -> Fit:
        """Fit again from where matching with the last good sweep puts the ego, if that is better."""
        seconds = (sweep.timestamp_ns - state.timestamp_ns) * 1e-9
        speed = float(prior.rotation[:, 0] @ prior.velocity)
        guesses = guess_motion(
            last.points_ego[last.chosen], sweep.points_ego[sweep.chosen], seconds, speeds=(speed,)
        )
        for guess in guesses[:1]:
            moved = replace(
                prior,
                rotation=state.rotation @ guess.rotation,
                position=state.position + state.rotation @ guess.translation,
            )
            other = self._fit(sweep, moved)
            if other.matched * other.agreeing > fit.matched * fit.agreeing:
                return other
        return fit

    def _accept(self, sweep: Sweep, fit: Fit) -> PoseEstimate:
        """Go on from a good fit, and add the sweep to the map."""
        state = fit.state
        before = self._state or state
        trajectory = float(np.linalg.norm(state.position - before.position))
        self._drift = self._carried_drift(state)
        self._drift += fit.state.covariance[:6, :6] * min(1.0, trajectory / _RENEWAL_TRAJECTORY)
        self._state, self._last_good, self._failures = state, (sweep, state), 0
        self._map.insert(_to_world(sweep, state))
        if np.linalg.norm(state.position - self._cleaned_at) > _DROP_EVERY:
            self._map.drop_beyond(state.position, self.configuration.map_reach)
            self._cleaned_at = state.position
        covariance = self._drift + state.covariance[:6, :6]
        return PoseEstimate(state, covariance, Outcome.FITTED, sweep.first_ns, sweep.last_ns)

    def _carried_drift(self, state: MotionState) -> Float64Array:
        """The drift so far, seen from a new position: an error of the orientation moves what lies farther on."""
        before = self._state.position if self._state is not None else state.position
        return carried_covariance(self._drift, state.position - before)


def carried_covariance(covariance: Float64Array, trajectory: Float64Array) -> Float64Array:
    """The covariance (6, 6) of a rotation and a shift, seen from a location that lies (3,) [m] farther on."""
    x, y, z = trajectory
    lever = np.eye(6)
    lever[SHIFT, ROTATION] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    carried: Float64Array = lever @ covariance @ lever.T
    return carried


def _to_world(sweep: Sweep, state: MotionState) -> Float64Array:
    points_world, arms = np.empty_like(sweep.points_ego), np.empty_like(sweep.points_ego)
    state.move(sweep.points_ego, sweep.seconds, points_world, arms)
    return points_world


def _is_good(fit: Fit) -> bool:
    return fit.matched >= _LEAST_MATCHED and fit.agreeing >= _LEAST_AGREEING


def _unknown_motion() -> Float64Array:
    return _motion_covariance(_UNKNOWN_ROTATION_RATE, _UNKNOWN_SPEED)


def _motion_covariance(yaw_rate: float, speed: float) -> Float64Array:
    deviations = np.empty(12)
    deviations[ROTATION], deviations[SHIFT] = _STANDSTILL_ROTATION, _STANDSTILL_SHIFT
    deviations[YAW_RATE], deviations[VELOCITY] = yaw_rate, speed
    return np.diag(deviations**2)


def _moved_between(first: MotionState, second: MotionState) -> MotionState:
    """The first state with the constant motion that leads to the second one's pose.

    What the skew of the sweeps says is left aside: two sweeps that are skewed alike fit well.
    """
    seconds = (second.timestamp_ns - first.timestamp_ns) * 1e-9
    yaw_rate = rotation_vector(second.rotation @ first.rotation.T) / seconds
    chord = (second.position - first.position) / seconds
    velocity = chord - 0.5 * seconds * np.cross(yaw_rate, chord)
    covariance = _motion_covariance(_GUESSED_ROTATION_RATE, _GUESSED_SPEED)
    return replace(first, yaw_rate=yaw_rate, velocity=velocity, covariance=covariance)
