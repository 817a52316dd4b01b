"""The clocks of two streams that both report how one body rotated."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.geometry.rotations import matrix_from_quaternion, quaternion_from_rotation_vector
from sceneloom.motion.clock.correlation import Peak, correlation_peaks
from sceneloom.motion.clock.drift import Line, robust_line
from sceneloom.motion.clock.estimate import ClockEstimate
from sceneloom.motion.clock.fitting import Fit, Linearised, fit
from sceneloom.motion.clock.outcome import (
    LEAST_MARGIN,
    Candidate,
    Clocks,
    ambiguous,
    concluded,
    misfit_without_motion,
)
from sceneloom.motion.clock.rotating import Rotating, RotationCurve, Steps, finite_rows, rate_noise, steps_of

REACH_NS = 5_000_000_000
"""Offsets up to this are looked for [ns]."""

_LEAST_COMMON = 2.0
"""Seconds that two streams need in common."""

_MOST_COMMON = 86_400.0
"""No drive is longer [s]: wrong times of both are not to be searched in millions of parts."""

_GRID = 0.02
"""Step of the coarse search [s]; rotates of bodies that people and cars carry are slower."""

_PART = 120.0
"""Seconds that are searched at once: a clock that is 200 ppm too fast moves 24 ms on in them."""

_BIAS_WINDOW = 60.0
"""A gyroscope's bias is one constant for so many seconds."""

_STEPS = (0.05, 0.1, 0.2, 0.4)
"""Rotations over at least so many seconds are compared, the shortest that the noise allows [s]."""

_NOISE_SHARE = 0.1
"""Of the rates' changes between start and stop of a rotation at most this share may be noise."""

_FAR_LESS = 4.0
"""Lags whose correlation lacks so many times more of 1 than that of the best are left aside."""

_PRIORS = np.array([10.0, 2e-3, 0.7, 0.7, 0.7])
"""How far offset [s], skew and rotation [rad] may be from the start."""


def compare_turnings(
    reference: Rotating,
    stream: Rotating,
    *,
    reach_ns: int = REACH_NS,
    reference_from_stream: Float64Array | None = None,
) -> ClockEstimate:
    """Find the offset and the skew of a stream's clock from the rotating that two streams report.

    The streams may have any rates and gaps, their bodies any constant rotation between them, and either a constant
    bias. First the lag is searched at which the yaw rates are most alike; then rotates from sample to sample of the
    slower stream are fitted by those of the other one between the same times, with offset, skew, rotation and bias
    free at once.

    Args:
        reference: the stream whose clock is taken for the right one.
        stream: the other one.
        reach_ns: offsets up to this are looked for [ns].
        reference_from_stream: (3, 3), the rotation between the bodies as far as it is known; the motion decides
            where it reports.

    Source: the rate correlation before the fit, and the continuous-time fit of offset with the rotation, are as in
    Furgale, Rehder and Siegwart 2013, "Unified Temporal and Spatial Calibration for Multi-Sensor Systems".
    """
    if min(len(reference), len(stream)) < 8:
        return ClockEstimate.unknown(
            f"{len(reference)} and {len(stream)} samples of rotating; expected 8 or more of each"
        )
    finer_is_stream = stream.step_ns <= reference.step_ns
    coarse, fine = (reference, stream) if finer_is_stream else (stream, reference)
    expected = np.eye(3) if reference_from_stream is None else reference_from_stream
    pair = _Pair.of(coarse, fine, expected if finer_is_stream else expected.T)
    clocks = Clocks(pair.origin_ns, finer_is_stream)
    if not pair.fine or pair.common < _LEAST_COMMON:
        return ClockEstimate.unknown(
            f"{max(pair.common, 0.0):.1f} s in common; expected {_LEAST_COMMON:.0f} s or more without gaps"
        )
    if pair.common > _MOST_COMMON:
        return ClockEstimate.unknown(
            f"{pair.common:.6g} s in common; expected at most {_MOST_COMMON:.0f}: is a time wrong?"
        )
    starts = list(pair.starts(reach_ns * 1e-9))
    if not starts:
        return ClockEstimate.unknown("nothing rotates in both at once")
    if max(peak.margin for _, peak in starts) < LEAST_MARGIN:
        lags = [clocks.sign * line.offset for line, _ in starts]
        return ClockEstimate.unknown(ambiguous(lags), span_ns=round(pair.common * 1e9))
    candidates = [candidate for line, peak in starts if (candidate := pair.fitted(line, peak)) is not None]
    return concluded(candidates, clocks)


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """The slower stream as rotates, the other as a curve, both in seconds after one origin."""

    origin_ns: int
    coarse: Rotating
    fine: RotationCurve
    coarse_curve: RotationCurve
    fine_noise: Float64Array
    expected: Float64Array
    grid: float
    span: tuple[float, float]

    @classmethod
    def of(cls, coarse: Rotating, fine: Rotating, coarse_from_fine: Float64Array) -> "_Pair":
        origin_ns = int(max(coarse.timestamps_ns[0], fine.timestamps_ns[0]))
        grid = max(_GRID, coarse.step_ns * 1e-9)
        curves = RotationCurve(fine, origin_ns), RotationCurve(coarse, origin_ns)
        ends = min(int(coarse.timestamps_ns[-1]), int(fine.timestamps_ns[-1]))
        return cls(
            origin_ns,
            coarse,
            *curves,
            rate_noise(fine),
            coarse_from_fine,
            grid,
            (0.0, (ends - origin_ns) * 1e-9),
        )

    @property
    def common(self) -> float:
        """Seconds in which there are samples of both, by their timestamps."""
        return self.span[1] - self.span[0]

    def starts(self, reach: float) -> Iterator[tuple[Line, Peak]]:
        """Offsets to begin with: the best lags of a short drive, a line through those of the parts of a long one."""
        reach = min(reach, max(self.common / 2, 4 * self.grid))
        if self.common <= 2.5 * _PART:
            peaks = self._peaks(*self.span, reach)
            for peak in peaks:
                # what is far less alike than the best one needs no fit to be distinguished from it
                if 1 - peak.score > _FAR_LESS * (1 - peaks[0].score) + 0.1:
                    break
                yield Line(peak.lag * self.grid, 0.0), peak
            return
        count = int(self.common // _PART)
        edges = np.linspace(*self.span, count + 1)
        found = [
            (0.5 * (a + b), peak)
            for a, b in pairwise(edges.tolist())
            for peak in self._peaks(a, b, reach)[:1]
        ]
        if len(found) >= 2:
            times = np.array([time for time, _ in found]) - 0.5 * self.common
            lags = np.array([peak.lag * self.grid for _, peak in found])
            best = max((peak for _, peak in found), key=lambda peak: peak.margin)
            yield robust_line(times, lags), best

    def _peaks(self, begin: float, end: float, reach: float) -> list[Peak]:
        edges = np.arange(begin, end, self.grid)
        wide = np.arange(begin - np.ceil(reach / self.grid) * self.grid, end + reach, self.grid)
        first = self.coarse_curve.rotations(edges[:-1], edges[1:]) / self.grid
        second = self.fine.rotations(wide[:-1], wide[1:]) / self.grid
        shift = round((begin - wide[0]) / self.grid)
        steps = int(reach / self.grid)
        peaks = correlation_peaks(first, second, steps, centre=shift, expected=self.expected)
        return [replace(peak, lag=peak.lag - shift) for peak in peaks]

    def fitted(self, line: Line, peak: Peak) -> Candidate | None:
        """Refine an offset over rotates that are as short as the noise allows."""
        own = self.coarse.step_ns * 1e-9
        start = np.array([line.offset, line.slope, 0.0, 0.0, 0.0])
        chosen: tuple[_RotatingModel, Fit] | None = None
        for least in (0.0, *(step for step in _STEPS if step > own)):
            steps = steps_of(self.coarse, self.origin_ns, least)
            if len(steps) < 16 and chosen is not None:
                break
            if len(steps) == 0:
                break
            model = _RotatingModel(self, steps, peak.rotation)
            found = fit(model, start, _PRIORS, model.windows, whiten=False)
            if found is None:
                break
            chosen, start = (model, found), found.parameters
            if model.noise_share(found) <= _NOISE_SHARE:
                break
        if chosen is None:
            return None
        model, found = chosen
        whitened = fit(model, found.parameters, _PRIORS, model.windows)
        return None if whitened is None else model.candidate(whitened, peak)


class _RotatingModel:
    """Rotates of the slower stream, reported by the curve of the other one: offset, skew, three of rotation."""

    def __init__(self, pair: _Pair, steps: Steps, coarse_from_fine: Float64Array) -> None:
        self.pair, self.steps, self.rotation = pair, steps, coarse_from_fine
        self.middle = 0.5 * sum(pair.span)
        self.lengths = steps.stops - steps.starts
        self.times = 0.5 * (steps.starts + steps.stops) - self.middle
        self.smoothing = float(np.clip(np.median(self.lengths), 0.02, 0.4))
        self.vectors = steps.mean(steps.vectors)
        self.nuisances = steps.mean(self.lengths)[:, None, None] * np.eye(3)
        self.row_times = steps.mean(self.times) + self.middle
        count = max(1, round(pair.common / _BIAS_WINDOW))
        parts = np.clip((self.row_times / max(pair.common, 1e-9) * count).astype(np.int64), 0, count - 1)
        self.windows = _numbered(parts, steps.chunks)

    def __call__(self, parameters: Float64Array, amounts: Float64Array) -> Linearised:
        del amounts  # the biases are linear
        offset, skew = parameters[:2]
        rotation = self.rotated(parameters)
        shifts = offset + skew * self.times
        starts, stops = self.steps.starts + shifts, self.steps.stops + shifts
        reported = self.pair.fine.rotations(starts, stops)
        before = self.pair.fine.rates(starts, self.smoothing)
        after = self.pair.fine.rates(stops, self.smoothing)
        slope = after - before + 0.5 * np.cross(reported, before + after)
        reported, slope, drift = (self.steps.mean(x) for x in (reported, slope, slope * self.times[:, None]))
        known = finite_rows(np.hstack([reported, slope]))
        moved, slope, drift = (
            np.where(known[:, None], x, 0.0) @ rotation.T for x in (reported, slope, drift)
        )
        jacobian = np.concatenate([slope[:, :, None], drift[:, :, None], -_crossing(moved)], axis=2)
        return Linearised(self.vectors - moved, jacobian, self.nuisances, known)

    def rotated(self, parameters: Float64Array) -> Float64Array:
        """The rotation (3, 3) from the finer stream's body into the other's."""
        rotation = matrix_from_quaternion(quaternion_from_rotation_vector(parameters[2:5]))
        return np.asarray(rotation @ self.rotation, np.float64)

    def noise_share(self, found: Fit) -> float:
        """How much of the rates' changes is noise of the finer stream.

        It is no more than what is left over, and no more than what single samples of the stream jump about.
        """
        at = self(found.parameters, found.amounts)
        if not found.used.any():
            return 0.0
        changes = at.jacobian[found.used, :, 0]
        left = at.residuals[found.used] - np.einsum(
            "nkm,nm->nk", at.nuisances[found.used], found.amounts[self.windows[found.used]]
        )
        of_residuals = (1.4826 * np.median(np.abs(left), axis=0) / self.smoothing) ** 2
        noise = 2.0 * np.minimum(of_residuals, self.pair.fine_noise / self.smoothing)
        return float(noise.sum() / max(float((changes**2).mean(axis=0).sum()), 1e-300))

    def candidate(self, found: Fit, peak: Peak) -> Candidate:
        """The fit with what is needed to judge it."""
        return Candidate(
            fit=found,
            times=self.row_times,
            middle=self.middle,
            span=self.pair.common,
            without_motion=misfit_without_motion(found, self.windows, lambda: self._still(found)),
            score=peak.score,
            margin=peak.margin,
            rotation=self.rotated(found.parameters),
        )

    def _still(self, found: Fit) -> Linearised:
        """The same rotations, reported by biases alone."""
        return replace(self(found.parameters, found.amounts), residuals=self.vectors)


def _numbered(parts: Int64Array, chunks: Int64Array) -> Int64Array:
    """Number windows, a new one wherever the part or the piece changes."""
    changes = np.zeros(len(parts), np.int64)
    changes[1:] = (np.diff(parts) != 0) | (np.diff(chunks) != 0)
    return np.cumsum(changes)


def _crossing(vectors: Float64Array) -> Float64Array:
    """(N, 3, 3) matrices of the cross products with (N, 3) vectors."""
    zero = np.zeros(len(vectors))
    x, y, z = vectors.T
    return np.stack(
        [np.stack([zero, -z, y], 1), np.stack([z, zero, -x], 1), np.stack([-y, x, zero], 1)], axis=1
    )
