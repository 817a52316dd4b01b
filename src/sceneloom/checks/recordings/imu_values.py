"""Rules about what an IMU measured: in the units of the format, with gravity, not hung, not only noise."""

from collections.abc import Iterator

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.checks.recordings.streams import Kind, Stream, location, streams_of_kind
from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import Subject
from sceneloom.scene.findings import Severity

LEAST_MEAN_PULL, GREATEST_MEAN_PULL = 8.0, 20.0
"""What an accelerometer measures on average [m/s²]: gravity is in it, and no vehicle pulls twice as much for long."""

HARDEST_PULL = 200.0
"""No vehicle is pulled harder, only one that is hit [m/s²]."""

FASTEST_ROTATION = 20.0
"""Nothing that carries sensors rotates faster [rad/s]."""

LONGEST_FAST_ROTATION = 0.2
FAST_ROTATION_SHARE = 0.001
"""Rotating faster for longer than this [s] and than this part of the time is no shock, but another unit."""

LOUDEST = 2.5
"""The mean of what is left of the accelerations above a quarter of the rate [m/s²]."""

_GAIN = 1.091
"""Lets as much of white noise pass as the vendor's filter does: third-order Butterworth, there and back."""

_FEWEST_FOR_NOISE = 20

_UNITS_OF_PULL: tuple[tuple[float, float, str], ...] = (
    (0.0, 0.7, "is gravity taken off? The format wants it in"),
    (0.7, 1.5, "are these units of g, or is gravity taken off? The format wants m/s² with it"),
    (1.5, LEAST_MEAN_PULL, "is gravity taken off, or is this another unit than m/s²?"),
    (GREATEST_MEAN_PULL, 45.0, "are these feet per second squared? The format wants m/s²"),
    (700.0, 1500.0, "are these thousandths of g, or cm/s²? The format wants m/s²"),
    (7000.0, 15_000.0, "are these mm/s²? The format wants m/s²"),
)


def magnitudes(stream: Stream) -> Float64Array:
    """How long each sample's vector is, (N,)."""
    lengths: Float64Array = np.sqrt(np.einsum("nk,nk->n", stream.values, stream.values))
    return lengths


def _mean_pull(stream: Stream) -> float:
    return float(magnitudes(stream).mean())


def _pull_is_plausible(mean: float) -> bool:
    return LEAST_MEAN_PULL <= mean <= GREATEST_MEAN_PULL


def _wrong_unit_of_pull(subject: Subject) -> Iterator[Hit]:
    for stream in streams_of_kind(subject, Kind.ACCELEROMETER):
        mean = _mean_pull(stream)
        if not _pull_is_plausible(mean):
            expected = f"expected about 9.81 m/s², {LEAST_MEAN_PULL:g} to {GREATEST_MEAN_PULL:g}"
            guesses = [guess for low, high, guess in _UNITS_OF_PULL if low <= mean < high]
            problem = f"the mean length is {mean:.4g}; {expected}"
            yield Hit(stream.whole, ": ".join([problem, *guesses]))


def _hard_pulls(subject: Subject) -> Iterator[Hit]:
    for stream in streams_of_kind(subject, Kind.ACCELEROMETER):
        if _pull_is_plausible(_mean_pull(stream)):
            yield from _beyond(stream, HARDEST_PULL, "m/s²")


def _beyond(stream: Stream, limit: float, unit: str) -> Iterator[Hit]:
    """Report the samples that are longer than a limit, in the position of the first."""
    lengths = magnitudes(stream)
    rows = np.flatnonzero(~(lengths <= limit))
    if len(rows):
        row = int(rows[0])
        problem = f"{stream.at(row)} is {lengths[row]:.4g} {unit} long; expected at most {limit:g}"
        if len(rows) > 1:
            problem += f"; the longest of {len(rows)} is {lengths.max():.4g}"
        yield Hit(location(stream, row), problem, len(rows))


def _noise(subject: Subject) -> Iterator[Hit]:
    for stream in streams_of_kind(subject, Kind.ACCELEROMETER):
        values = stream.values
        if len(values) < _FEWEST_FOR_NOISE or not _pull_is_plausible(_mean_pull(stream)):
            continue
        noise = _mean_noise(values)
        axis = int(noise.argmax())
        if noise[axis] > LOUDEST:
            problem = (
                f"{'xyz'[axis]} changes from sample to sample by {noise[axis]:.3g} m/s² on average; "
                f"expected at most {LOUDEST:g}"
            )
            yield Hit(stream.whole, problem)


def _mean_noise(values: Float64Array) -> Float64Array:
    """The mean of what a high-pass leaves of each axis, (3,); the one of three taps, which has no phase."""
    left = np.abs(2.0 * values[1:-1] - values[:-2] - values[2:])
    means: Float64Array = _GAIN * 0.25 * left.mean(axis=0)
    return means


def rotations_too_long(stream: Stream) -> bool:
    """Whether a gyroscope is faster than anything rotates for so long that it is no shock."""
    fast = int(np.count_nonzero(magnitudes(stream) > FASTEST_ROTATION))
    seconds = fast * (stream.period or 0.0)
    return seconds > LONGEST_FAST_ROTATION and fast > FAST_ROTATION_SHARE * len(stream)


def _wrong_unit_of_rotations(subject: Subject) -> Iterator[Hit]:
    for stream in streams_of_kind(subject, Kind.GYROSCOPE):
        if rotations_too_long(stream):
            lengths = magnitudes(stream)
            fast = int(np.count_nonzero(lengths > FASTEST_ROTATION))
            problem = (
                f"{fast} samples are faster than {FASTEST_ROTATION:g} rad/s, up to {lengths.max():.4g}: "
                "are these degrees per second? The format wants rad/s"
            )
            yield Hit(stream.whole, problem)


def _fast_rotations(subject: Subject) -> Iterator[Hit]:
    for stream in streams_of_kind(subject, Kind.GYROSCOPE):
        if not rotations_too_long(stream):
            yield from _beyond(stream, FASTEST_ROTATION, "rad/s")


RULES: tuple[Rule, ...] = (
    Rule(
        "accelerometer-unit",
        Severity.ERROR,
        "Accelerations are m/s² with gravity in them: 8 to 20 long on average.",
        "Write what the accelerometer measures, in m/s²: at rest it points up and is 9.81 long.",
        find=_wrong_unit_of_pull,
    ),
    Rule(
        "accelerometer-range",
        Severity.WARNING,
        "No acceleration is longer than 200 m/s².",
        "See whether the sensor was hit, or its samples are torn.",
        find=_hard_pulls,
    ),
    Rule(
        "accelerometer-noise",
        Severity.WARNING,
        "Above a quarter of the rate, accelerations are 2.5 m/s² at most on average.",
        "Mount the sensor where it shakes less, or filter before thinning out its samples.",
        find=_noise,
    ),
    Rule(
        "gyroscope-unit",
        Severity.ERROR,
        "Rotate rates are rad/s: faster than 20 for no longer than a shock takes, 0.2 s or 0.1 % of the time.",
        "Write rad/s; degrees per second are 57.3 times as large.",
        find=_wrong_unit_of_rotations,
    ),
    Rule(
        "gyroscope-range",
        Severity.WARNING,
        "No yaw rate is faster than 20 rad/s.",
        "See whether the sensor was hit, or its samples are torn.",
        find=_fast_rotations,
    ),
)
