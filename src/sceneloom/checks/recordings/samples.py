"""Rules about the samples of the IMU and other sensors: units, gravity, noise, stuck values, clocks."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.checks.recordings.times import APART_SECONDS, Kind, Stream, streams_of_kind
from sceneloom.checks.rule import ERROR, HINT, WARNING, Find, Hit, Rule, Subject

FAR_SECONDS, FAR_PERIODS = 0.1, 4.0
"""An image that is farther than both from the nearest sample of the IMU is far."""

SHARE_AT_SAMPLES = 0.5
"""More images than this share with the very times of samples were timestamped by the IMU's clock ticks."""

SHIFT_PERIODS, _SAME_SHIFT_PERIODS, _SAME_PERIOD = 1.5, 0.5, 0.02
LEAST_MEAN_PULL, GREATEST_MEAN_PULL, HARDEST_PULL = 8.0, 20.0, 200.0
"""Average of an accelerometer [m/s²]: gravity is in it, and no vehicle accelerates twice as hard for long; only a
sensor that is hit measures more than the last."""

FASTEST_ROTATION = 20.0
"""Nothing that carries sensors rotates faster [rad/s]."""

LONGEST_FAST_ROTATION, FAST_ROTATION_SHARE = 0.2, 0.001
"""Rotating faster for longer than this [s] and than this part of the time is no shock, but another unit."""

LOUDEST, _FEWEST_FOR_NOISE = 2.5, 20
"""The mean of the accelerations above a quarter of the rate [m/s²]."""

_GAIN = 1.091  # lets as much of white noise pass as the vendor's filter does: third-order Butterworth, there and back
_WEAKEST_FIELD = 5.0  # the earth's field is 22 to 67 µT; a magnetometer far below it counts in another unit

_Guesses = tuple[tuple[float, float, str], ...]  # what a usual value from the first to the second number suggests

_UNITS_OF_PULL: _Guesses = (
    (0.0, 0.7, "is gravity taken off? The format wants it in"),
    (0.7, 1.5, "are these units of g, or is gravity taken off? The format wants m/s² with it"),
    (1.5, LEAST_MEAN_PULL, "is gravity taken off, or is this another unit than m/s²?"),
    (GREATEST_MEAN_PULL, 45.0, "are these feet per second squared? The format wants m/s²"),
    (700.0, 1500.0, "are these thousandths of g, or cm/s²? The format wants m/s²"),
    (7000.0, 15_000.0, "are these mm/s²? The format wants m/s²"),
)

_UNITS_OF_WEAK_FIELDS: _Guesses = ((0.1, 2.0, "gauss"), (1e-6, 1e-3, "tesla"))


@dataclass(frozen=True, slots=True)
class _Range:
    """What a sensor measures: lowest and highest sample, in the unit of the format, and units of other usual ones."""

    lowest: float
    highest: float
    unit: str
    others: _Guesses


_RANGES: Mapping[Kind, _Range] = MappingProxyType(
    {
        Kind.MAGNETOMETER: _Range(
            *(0.0, 1000.0, "µT"),
            ((5000.0, 500_000.0, "nanotesla"), (1000.0, 5000.0, "milligauss, or is there a magnet beside it")),
        ),
        Kind.BAROMETER: _Range(
            *(800.0, 1200.0, "hPa"),
            (
                (30_000.0, 120_000.0, "pascal"),
                (30.0, 120.0, "kilopascal"),
                (0.3, 1.2, "bar"),
                (225.0, 799.9, "millimetres of mercury, or was it higher than 1900 m"),
            ),
        ),
        Kind.TEMPERATURE: _Range(
            *(200.0, 400.0, "K"), ((-60.0, 130.0, "degrees Celsius"), (130.0, 200.0, "degrees Fahrenheit"))
        ),
    }
)

_REPEATING: Mapping[Kind, float] = MappingProxyType(
    {Kind.ACCELEROMETER: 0.01, Kind.GYROSCOPE: 0.01, Kind.MAGNETOMETER: 0.01, Kind.GNSS: 0.01, Kind.BAROMETER: 0.2}
)  # share of samples that may repeat the one before; a barometer's steps are coarse beside its changes

_FEWEST_FOR_A_SHARE = 20
_IMU = (Kind.ACCELEROMETER, Kind.GYROSCOPE)


def _distances(seconds: Float64Array, samples: Float64Array) -> Float64Array:
    """How far each time is from the nearest sample, (N,) [s]; both ascending."""
    after = np.searchsorted(samples, seconds)
    before = np.maximum(after - 1, 0)
    after = np.minimum(after, len(samples) - 1)
    return np.minimum(np.abs(samples[after] - seconds), np.abs(seconds - samples[before]))


def _far_from_imu(subject: Subject) -> Iterator[Hit]:
    streams = {stream.kind: stream for stream in streams_of_kind(subject, *_IMU)}
    imu = streams.get(Kind.GYROSCOPE, streams.get(Kind.ACCELEROMETER))
    if imu is None or imu.period is None:
        return
    limit = max(FAR_SECONDS, FAR_PERIODS * imu.period)
    for camera in streams_of_kind(subject, Kind.CAMERA):
        distances = _distances(camera.seconds, imu.seconds)
        far = np.flatnonzero(distances > limit)
        if len(far):
            row, worst = int(far[0]), float(distances.max())
            problem = (
                f"{camera.at(row)} is {distances[row]:.3f} s from the nearest sample of the {imu.name}; expected at "
                f"most {limit:.3f} s, found up to {worst:.3f} s in {len(far)} of {len(camera)} images"
            )
            yield camera.hit(row, problem)


def _at_samples(subject: Subject) -> Iterator[Hit]:
    for camera in streams_of_kind(subject, Kind.CAMERA):
        for imu in streams_of_kind(subject, *_IMU):
            same = _distances(camera.seconds, imu.seconds) == 0
            share = float(same.mean())
            if share > SHARE_AT_SAMPLES:
                row = int(np.flatnonzero(same)[0])
                problem = (
                    f"{share:.0%} of the images have the very time of a sample of the {imu.name}, "
                    f"the first is {camera.at(row)}"
                )
                yield camera.hit(row, problem)
                break


def _shifted(subject: Subject) -> Iterator[Hit]:
    """Accelerometer and gyroscope that begin and end with the same offset, as by a clock offset."""
    streams = {stream.kind: stream for stream in streams_of_kind(subject, *_IMU)}
    if len(streams) < 2:
        return
    accelerometer, gyroscope = (streams[kind] for kind in _IMU)
    periods, uneven = (accelerometer.period, gyroscope.period), abs(len(accelerometer) - len(gyroscope))
    if periods[0] is None or periods[1] is None or uneven > 1:
        return
    period = max(periods[0], periods[1])
    if abs(periods[0] - periods[1]) > _SAME_PERIOD * period:
        return
    at_start, at_end = (float(accelerometer.seconds[row] - gyroscope.seconds[row]) for row in (0, -1))
    shift = 0.5 * (at_start + at_end)
    is_steady = abs(at_start - at_end) <= _SAME_SHIFT_PERIODS * period + uneven * period
    if is_steady and SHIFT_PERIODS * period < abs(shift) <= APART_SECONDS:
        later = "after" if shift > 0 else "before"
        problem = (
            f"its {len(accelerometer)} samples begin and end {abs(shift) * 1e3:.1f} ms {later} the "
            f"{len(gyroscope)} of the gyroscope, which has the same rate; expected at most "
            f"{SHIFT_PERIODS:g} intervals of {period * 1e3:.1f} ms"
        )
        yield Hit(accelerometer.whole, problem)


def _magnitudes(stream: Stream) -> Float64Array:
    """How long each sample's vector is, (N,)."""
    return np.asarray(np.sqrt(np.einsum("nk,nk->n", stream.values, stream.values)))


def _accelerometers(subject: Subject, *, plausible: bool) -> Iterator[tuple[Stream, float]]:
    """Accelerometers whose mean length is that of gravity, or is not, with it."""
    for stream in streams_of_kind(subject, Kind.ACCELEROMETER):
        mean = float(_magnitudes(stream).mean())
        if (LEAST_MEAN_PULL <= mean <= GREATEST_MEAN_PULL) is plausible:
            yield stream, mean


def _wrong_unit_of_pull(subject: Subject) -> Iterator[Hit]:
    for stream, mean in _accelerometers(subject, plausible=False):
        expected = f"expected about 9.81 m/s², {LEAST_MEAN_PULL:g} to {GREATEST_MEAN_PULL:g}"
        guesses = [guess for low, high, guess in _UNITS_OF_PULL if low <= mean < high]
        yield Hit(stream.whole, ": ".join([f"the mean length is {mean:.4g}; {expected}", *guesses]))


def _hard_pulls(subject: Subject) -> Iterator[Hit]:
    for stream, _ in _accelerometers(subject, plausible=True):
        yield from _beyond(stream, HARDEST_PULL, "m/s²")


def _beyond(stream: Stream, limit: float, unit: str) -> Iterator[Hit]:
    """Report the samples that are longer than a limit, at the line of the first."""
    lengths = _magnitudes(stream)
    rows = np.flatnonzero(~(lengths <= limit))
    if len(rows):
        row = int(rows[0])
        problem = f"{stream.at(row)} is {lengths[row]:.4g} {unit} long; expected at most {limit:g}"
        if len(rows) > 1:
            problem += f"; the longest of {len(rows)} is {lengths.max():.4g}"
        yield stream.hit(row, problem, len(rows))


def _noise(subject: Subject) -> Iterator[Hit]:
    for stream, _ in _accelerometers(subject, plausible=True):
        if len(stream) < _FEWEST_FOR_NOISE:
            continue
        noise = mean_noise(stream.values)
        axis = int(noise.argmax())
        if noise[axis] > LOUDEST:
            problem = (
                f"{'xyz'[axis]} changes from sample to sample by {noise[axis]:.3g} m/s² on average; "
                f"expected at most {LOUDEST:g}"
            )
            yield Hit(stream.whole, problem)


def mean_noise(values: Float64Array) -> Float64Array:
    """The mean of what a high-pass of three taps, which has no phase, leaves of each axis of (N, 3) values, (3,)."""
    left = np.abs(2.0 * values[1:-1] - values[:-2] - values[2:])
    return np.asarray(_GAIN * 0.25 * left.mean(axis=0))


def _rotations(*, in_another_unit: bool) -> Find:
    """Gyroscopes that are too fast for so long that it is another unit, or just for the time of a shock."""

    def find(subject: Subject) -> Iterator[Hit]:
        for stream in streams_of_kind(subject, Kind.GYROSCOPE):
            lengths = _magnitudes(stream)
            fast = int(np.count_nonzero(lengths > FASTEST_ROTATION))
            is_long = fast * (stream.period or 0.0) > LONGEST_FAST_ROTATION
            if (is_long and fast > FAST_ROTATION_SHARE * len(stream)) is not in_another_unit:
                continue
            if not in_another_unit:
                yield from _beyond(stream, FASTEST_ROTATION, "rad/s")
                continue
            problem = (
                f"{fast} samples are faster than {FASTEST_ROTATION:g} rad/s, up to {lengths.max():.4g}: "
                "are these degrees per second? The format wants rad/s"
            )
            yield Hit(stream.whole, problem)

    return find


def _out_of_range(kind: Kind) -> Find:
    def find(subject: Subject) -> Iterator[Hit]:
        limits = _RANGES[kind]
        for stream in streams_of_kind(subject, kind):
            values = _magnitudes(stream) if kind is Kind.MAGNETOMETER else stream.values[:, 0]
            wrong = np.flatnonzero(~((values >= limits.lowest) & (values <= limits.highest)))
            if len(wrong):
                row = int(wrong[0])
                problem = (
                    f"{stream.at(row)} is {values[row]:.6g}; expected "
                    f"{limits.lowest:g} to {limits.highest:g} {limits.unit}"
                )
                guess = _other_unit(float(np.median(values)), limits.others)
                yield stream.hit(row, f"{problem}{guess}", len(wrong))

    return find


def _other_unit(usual: float, others: _Guesses) -> str:
    return next((f": is it in {unit}?" for low, high, unit in others if low <= usual <= high), "")


def _wrong_fields(subject: Subject) -> Iterator[Hit]:
    yield from _out_of_range(Kind.MAGNETOMETER)(subject)
    for stream in streams_of_kind(subject, Kind.MAGNETOMETER):
        usual = float(np.median(_magnitudes(stream)))
        if usual < _WEAKEST_FIELD:
            problem = f"the median length is {usual:.4g}; the earth's field is 22 to 67 µT"
            yield Hit(stream.whole, f"{problem}{_other_unit(usual, _UNITS_OF_WEAK_FIELDS)}")


def _repeated(subject: Subject) -> Iterator[Hit]:
    for stream in streams_of_kind(subject, *_REPEATING):
        if len(stream) < _FEWEST_FOR_A_SHARE:
            continue
        values = stream.values[:, :3]  # of fixes the location counts
        same = np.flatnonzero((values[1:] == values[:-1]).all(axis=1))
        share = same.size / (len(stream) - 1)
        if share > _REPEATING[stream.kind]:
            row = int(same[0]) + 1
            problem = (
                f"{stream.at(row)} has the very values of the sample before, as have {share:.1%} of all; "
                f"expected at most {_REPEATING[stream.kind]:.0%}"
            )
            yield stream.hit(row, problem)


# fmt: off
SAMPLE_RULES: tuple[Rule, ...] = (
    Rule("frames-far-from-imu", WARNING,
         "Every image has a sample of the gyroscope within 0.1 s and 4 of its intervals, whichever is longer.",
         "Check whether both are on one clock, and whether the IMU was started late or stopped early.",
         find=_far_from_imu),
    Rule("frames-at-imu-times", HINT, "At most half of the images have the very time of a sample of the IMU.",
         "Timestamp images when they are exposed, not with the next sample's time; the vendor's diagnosis warns "
         "of it.", find=_at_samples),
    Rule("imu-clocks", WARNING,
         "Accelerometer and gyroscope of one rate and length begin and end within 1.5 intervals of each other.",
         "Check whether one of them is timestamped late, and subtract the offset from its times.", find=_shifted),
    Rule("accelerometer-unit", ERROR, "Accelerations are m/s² with gravity in them: 8 to 20 long on average.",
         "Write what the accelerometer measures, in m/s²: at rest it points up and is 9.81 long.",
         find=_wrong_unit_of_pull),
    Rule("accelerometer-range", WARNING, "No acceleration is longer than 200 m/s².",
         "Check whether the sensor was hit, or its samples are damaged.", find=_hard_pulls),
    Rule("accelerometer-noise", WARNING, "Above a quarter of the rate, accelerations are 2.5 m/s² at most on average.",
         "Mount the sensor where it shakes less, or filter before thinning out its samples.", find=_noise),
    Rule("gyroscope-unit", ERROR,
         "Angular velocities are in rad/s: above 20 for no longer than a shock takes, 0.2 s or 0.1 % of the time.",
         "Write rad/s; degrees per second are 57.3 times as large.", find=_rotations(in_another_unit=True)),
    Rule("gyroscope-range", WARNING, "No angular velocity exceeds 20 rad/s.",
         "Check whether the sensor was hit, or its samples are damaged.", find=_rotations(in_another_unit=False)),
    Rule("magnetometer-unit", WARNING, "The magnetic field is in µT: at most 1000, and its median at least 5.",
         "Write µT: 1000 nanotesla, 10 milligauss or 0.01 gauss each.", find=_wrong_fields),
    Rule("barometer-unit", WARNING, "The pressure of the air is 800 to 1200 hPa.",
         "Write hPa: 100 pascal each.", find=_out_of_range(Kind.BAROMETER)),
    Rule("temperature-unit", WARNING, "The temperature of the IMU is 200 to 400 K.",
         "Write kelvin: degrees Celsius and 273.15.", find=_out_of_range(Kind.TEMPERATURE)),
    Rule("values-repeated", WARNING,
         "At most 1 % of samples of a sensor, and of fixes, have the very values of the one before; of a "
         "barometer's, 20 %.",
         "Check whether the sensor hung, or samples were filled in to reach a rate that it does not have.",
         find=_repeated),
)
# fmt: on
