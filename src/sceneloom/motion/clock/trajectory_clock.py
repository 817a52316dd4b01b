"""The clocks of two streams that report where one body was, or how it moved on the ground."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial.legendre import legvander

from sceneloom.arrays import AnyArray, Float64Array
from sceneloom.motion.clock.estimate import ClockEstimate
from sceneloom.motion.clock.fitting import Fit, Linearised, bare_slopes, fit, misfit_of
from sceneloom.motion.clock.outcome import Candidate, Clocks, concluded, misfit_without_motion
from sceneloom.motion.clock.trajectories import Fixes, SmoothedTrajectory, TrajectorySamples

_LEAST_FIXES = 12
_LEAST_COMMON = 5.0
"""Seconds that two streams need in common."""

_LAG = 0.2
"""Step of the search [s]; from so near the fit finds its trajectory."""

_MOST_SEARCHED = 3000
"""Fixes of a long drive that are looked at in the search, and for the biases of an IMU; the last fit is to all."""

LEVER_SIGMA = 1.0
"""How far from the ego's origin a receiver's antenna may be on each axis, where nothing is stated [m]."""

_LEAST_SHARE = 0.01
"""Where less of the speed reports the offset, errors of the trajectory do that.

On synthetic streets it is a tenth to a half.
"""

_FAR_LESS = 100.0
"""Offsets that are less likely than the best by so much in the logarithm are not looked at any further."""

_FAR = 1.0
"""Longer windows notify an offset better, not another one [s]."""

_MOST_WORSE = 0.15
"""Logarithm of how much more may be left of the fixes over longer windows.

There a bad IMU is not reported by its noise.
"""

_PRIORS = (10.0, 2e-3)
"""How far offset [s] and skew may be from the start."""


def compare_trajectories(
    fixes: Fixes,
    trajectory: SmoothedTrajectory,
    *,
    origin_ns: int,
    fixes_are_reference: bool,
    reach_ns: int,
    lever: Float64Array | None = None,
    lever_sigma: float = LEVER_SIGMA,
) -> ClockEstimate:
    """Find the offset and the skew between fixes and a way of the same body.

    The fixes are the trajectory at their times, shifted by the offset, but for what the trajectory does not know: in
        every window
    of half a minute a rotation and a scale on the ground, and a polynomial in the time. What the body's speed changes
    beyond that reports the offset. The location of the receiver on the body is estimated along; where the body rotates,
    or goes on at one speed, that alone keeps the offset from being known better.

    Args:
        fixes: locations at some times.
        trajectory: what moves between them.
        origin_ns: where the trajectory's seconds count from.
        fixes_are_reference: which of both clocks is taken for the right one.
        reach_ns: offsets up to this are looked for [ns].
        lever: (3,) where on the body of the trajectory the fixes are of [m]; None for its origin.
        lever_sigma: how far from there they may be on each axis [m].

    Source: linear amounts are eliminated as in Golub and Pereyra 1973, "The Differentiation of Pseudo-Inverses and
    Nonlinear Least Squares Problems Whose Variables Separate".
    """
    if len(fixes) < _LEAST_FIXES:
        return ClockEstimate.unknown(f"{len(fixes)} fixes; expected {_LEAST_FIXES} or more")
    model = _TrajectoryModel.of(fixes, trajectory, origin_ns)
    clocks = Clocks(origin_ns, finer_is_stream=fixes_are_reference)
    known = model.known_at(0.0)
    common = float(np.ptp(model.times[known])) if known.any() else 0.0
    if known.sum() < _LEAST_FIXES or common < _LEAST_COMMON:
        return ClockEstimate.unknown(
            f"{int(known.sum())} fixes in {common:.1f} s in common; expected {_LEAST_FIXES} in {_LEAST_COMMON:.0f} s "
            "or more"
        )
    priors = np.array([*_PRIORS, *[max(lever_sigma, 1e-6)] * 3])
    location = np.zeros(3) if lever is None else lever
    reach = min(reach_ns * 1e-9, common / 2)
    part = model.part(_MOST_SEARCHED)
    found = [
        near
        for lag in _lags(part, reach)
        if (near := fit(part, np.array([lag, 0.0, *location]), priors, part.windows)) is not None
        and abs(near.parameters[0]) <= reach + 2 * _LAG
    ]
    if not found:
        return ClockEstimate.unknown(f"no offset up to {reach:.1f} s makes the motions alike")
    best = min(found, key=lambda near: near.level)
    refined = [
        _refined(part, near, fixes, location, priors)
        for near in found
        if best.evidence_against(near) < _FAR_LESS
    ]
    reported = sorted((one for one in refined if one is not None), key=lambda one: one[1].level)
    if reported and _share_reported(*reported[0]) < _LEAST_SHARE:
        return ClockEstimate.unknown(
            "the motion is too even: another offset is like another location and heading"
        )
    return concluded([_candidate(*one, common) for one in reported], clocks)


def _share_reported(model: "_TrajectoryModel", found: Fit) -> float:
    """How much of the speed reports the offset, as nothing else that is free does."""
    reported = bare_slopes(model, found, model.windows)[:, :, 0] ** 2
    length = model.bounds[0][1] - model.bounds[0][0]
    # of an even motion over a window the locations scatter so
    speed = float(np.sqrt(12.0 * (np.abs(model.locations) ** 2).mean())) / length
    return float(np.sqrt(reported.sum(axis=1).mean())) / max(speed, 1e-9)


def _refined(
    part: "_TrajectoryModel", near: Fit, fixes: Fixes, location: Float64Array, priors: Float64Array
) -> tuple["_TrajectoryModel", Fit] | None:
    """Fit the trajectory over longer windows, where it has them and they report the fixes as well as the short ones.

    Args:
        part: the windows that are looked at in the search; which way is taken is decided by so many of them.
        near: the fit to it.
    """
    start = np.array([near.parameters[0], 0.0, *location])
    at, found, begin = part, near, None
    while (trajectory := at.trajectory.finer(at.drifts_of(found.amounts))) is not None:
        longer = _TrajectoryModel.of(fixes, trajectory, part.origin_ns).part(_MOST_SEARCHED)
        better = fit(longer, start, priors, longer.windows, begin=begin)
        if better is None or abs(better.parameters[0] - near.parameters[0]) > _FAR:
            at, found = part, near
            break
        at, found, begin = longer, better, better.parameters
    if float(np.log(found.scales / near.scales).mean()) >= _MOST_WORSE:
        at, found = part, near
    whole = _TrajectoryModel.of(fixes, at.trajectory, part.origin_ns)
    if len(whole.times) == len(at.times):
        return at, found
    last = fit(whole, start, priors, whole.windows, begin=found.parameters)
    return None if last is None else (whole, last)


@dataclass(frozen=True, slots=True, eq=False)
class _TrajectoryModel:
    """Fixes reported by a trajectory: offset, skew, and three numbers of where the one body is on the other."""

    locations: AnyArray
    times: Float64Array
    windows: AnyArray
    bounds: tuple[tuple[float, float], ...]
    polynomials: Float64Array
    trajectory: SmoothedTrajectory
    middle: float
    origin_ns: int

    @classmethod
    def of(cls, fixes: Fixes, trajectory: SmoothedTrajectory, origin_ns: int) -> "_TrajectoryModel":
        """Cut the fixes into windows."""
        times = np.asarray((fixes.timestamps_ns - origin_ns) * 1e-9, np.float64)
        span = float(times[-1] - times[0])
        count = max(1, round(span / trajectory.window))
        length = span / count
        numbers = np.clip(np.floor((times - times[0]) / length), 0, count - 1).astype(np.int64)
        present, windows = np.unique(numbers, return_inverse=True)
        begin = float(times[0])
        bounds = tuple((begin + k * length, begin + (k + 1) * length) for k in present.tolist())
        begins, ends = np.array(bounds)[windows].T
        polynomials = legvander(2 * (times - begins) / (ends - begins) - 1, trajectory.degree)
        # the middle of each window's locations is taken off: kilometres leave no digits for millimetres
        sums = np.zeros(len(bounds), np.complex128)
        np.add.at(sums, windows, fixes.locations)
        locations = fixes.locations - (sums / np.bincount(windows))[windows]
        return cls(
            locations,
            times,
            windows,
            bounds,
            polynomials,
            trajectory,
            0.5 * float(times[0] + times[-1]),
            origin_ns,
        )

    def part(self, most: int) -> "_TrajectoryModel":
        """Some of the windows, spread over the drive, with about so many fixes; all where there are no more."""
        if len(self.times) <= most:
            return self
        every = -(-len(self.times) // most)
        chosen = np.unique(self.windows)[::every]
        rows = np.isin(self.windows, chosen)
        windows = np.searchsorted(chosen, self.windows[rows])
        bounds = tuple(self.bounds[k] for k in chosen.tolist())
        return _TrajectoryModel(
            self.locations[rows],
            self.times[rows],
            windows,
            bounds,
            self.polynomials[rows],
            self.trajectory,
            self.middle,
            self.origin_ns,
        )

    def drifts_of(self, amounts: Float64Array) -> Float64Array:
        """The amounts of the trajectory's drifts (W, E) among those of all nuisances."""
        return amounts[:, 2 * (self.trajectory.degree + 1) : -2]

    def known_at(self, lag: float) -> AnyArray:
        """Which fixes the trajectory reports, (N,) bool."""
        return np.isfinite(self._trajectory(np.full(len(self.times), lag)).locations)

    def _trajectory(self, shifts: Float64Array) -> TrajectorySamples:
        edges = np.searchsorted(self.windows, np.arange(len(self.bounds) + 1))
        parts = [
            self.trajectory.at(self.bounds[k], (self.times + shifts)[edges[k] : edges[k + 1]])
            for k in range(len(self.bounds))
        ]
        return TrajectorySamples(
            np.concatenate([_centred(part.locations) for part in parts]),
            np.concatenate([part.velocities for part in parts]),
            np.concatenate([part.axes for part in parts]),
            np.concatenate([part.drifts for part in parts]),
            np.concatenate([part.drift_velocities for part in parts]),
            parts[0].held,
        )

    def __call__(self, parameters: Float64Array, amounts: Float64Array) -> Linearised:
        offset, skew, lever = parameters[0], parameters[1], parameters[2:5]
        since = self.times - self.middle
        reported = self._trajectory(offset + skew * since)
        known = np.isfinite(reported.locations) & np.isfinite(reported.velocities)
        locations, velocities = (np.where(known, x, 0.0) for x in (reported.locations, reported.velocities))
        axes, drifts = (np.where(known[:, None], x, 0.0) for x in (reported.axes, reported.drifts))
        rotation = np.zeros(len(locations), np.complex128)
        if amounts.shape[1]:
            rotation = (amounts[:, -2] + 1j * amounts[:, -1])[self.windows]
            drifting = np.where(known[:, None], reported.drift_velocities, 0.0)
            velocities = velocities + (drifting * self.drifts_of(amounts)[self.windows]).sum(axis=1)
        moved = locations + axes @ lever
        nuisances = np.concatenate(
            [
                self.polynomials,
                1j * self.polynomials,
                rotation[:, None] * drifts,
                moved[:, None],
                1j * moved[:, None],
            ],
            axis=1,
        )
        slopes = np.concatenate(
            [
                (rotation * velocities)[:, None],
                (rotation * velocities * since)[:, None],
                rotation[:, None] * axes,
            ],
            axis=1,
        )
        free = np.full(2 * (self.trajectory.degree + 1), np.inf)
        expected = np.concatenate([free, reported.held, [np.inf, np.inf]])
        return Linearised(_split(self.locations), _split(slopes), _split(nuisances), known, expected)


def _centred(locations: AnyArray) -> AnyArray:
    known = np.isfinite(locations)
    return locations - locations[known].mean() if known.any() else locations


def _split(values: AnyArray) -> Float64Array:
    """Complex (N, …) as (N, 2, …)."""
    return np.stack([values.real, values.imag], axis=1)


def _lags(part: _TrajectoryModel, reach: float) -> list[float]:
    """The offsets at which a trajectory fits best, to begin with."""
    lags = np.arange(-np.floor(reach / _LAG), np.floor(reach / _LAG) + 1) * _LAG
    costs = np.array([misfit_of(part, np.array([lag, 0, 0, 0, 0]), part.windows) for lag in lags.tolist()])
    padded = np.concatenate([[np.inf], costs, [np.inf]])
    lows = np.flatnonzero((padded[1:-1] <= padded[:-2]) & (padded[1:-1] < padded[2:]))
    return [float(lags[k]) for k in lows[np.argsort(costs[lows])][:3]]


def _candidate(model: _TrajectoryModel, found: Fit, common: float) -> Candidate:
    return Candidate(
        fit=found,
        times=model.times,
        middle=model.middle,
        span=common,
        without_motion=misfit_without_motion(found, model.windows, lambda: _unmoved(model, found)),
        score=None,
        model_sigma=model.trajectory.model_sigma,
    )


def _unmoved(model: _TrajectoryModel, found: Fit) -> Linearised:
    """The same fixes, reported by polynomials alone."""
    at = model(found.parameters, found.amounts[:, :0])
    return replace(at, nuisances=at.nuisances[:, :, :-2], expected=None)
