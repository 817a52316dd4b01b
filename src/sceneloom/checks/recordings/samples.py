"""Rules about the samples of the IMU and other sensors, and about satellite fixes: units, noise, clocks, jumps."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.checks.poses import FASTEST
from sceneloom.checks.recordings.times import APART_SECONDS, Kind, Stream, streams_of_kind
from sceneloom.checks.rule import ERROR, HINT, WARNING, Find, Hit, Rule, Subject
from sceneloom.geometry.geodesy import enu_from_geodetic
from sceneloom.motion.ego_trajectory import usable_fixes
from sceneloom.scene.motion import GnssSensor

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


LOWEST, HIGHEST = -500.0, 10_000.0
"""Altitudes [m] between the Dead Sea's shore and the highest roads, with room for aeroplanes."""

WORST_ACCURACY, UNKNOWN_ACCURACY = 1000.0, 5.0
"""A fix that is less accurate [m] is of a mobile network, or in another unit; assumed where a fix has none [m]."""

JUMP_SIGMAS, HARDEST_ACCELERATION, JUMP_MARGIN = 8.0, 10.0, 0.5
"""A fix jumps that is farther off the trajectory between its neighbours than 8 of their accuracies, what a vehicle can
swerve meanwhile [m/s²], and half a metre."""

LONGEST_STEP = 3.0
"""Between fixes farther apart [s] the trajectory is not known well enough."""

_RADIANS = (np.pi / 2, np.pi)
LEAST_CORRELATION = -0.8
"""Rotations that correlate worse have the other sign."""

_FEWEST_ROTATIONS, _LEAST_ROTATION, _SHARPEST_ROTATION = 6, 0.1, 1.0
"""Root mean square of the rotations from leg to leg [rad] that show a side; between legs that differ by more than the
last the trajectory is not known: it may have rotated to either side."""

_SHORTEST_LEG, _LEG_SIGMAS, _MOST_FIXES = 5.0, 10.0, 4_000
"""Legs are longer than this [m], and than so many accuracies of the fixes that bound them."""

NEAREST_REPORTED, _ACCURACIES, _DRIFT = 5.0, 4.0, 0.01
"""Fixes agree with a trajectory within this distance [m], since antennas sit elsewhere, within so many times their
stated accuracy, and within this part of the trajectory, since odometry drifts."""

_FEWEST_FIXES, _LEAST_SPREAD = 10, 5.0
_CLEARLY, _MIRRORED_REPORTED = 0.3, 2.0
"""A mirrored trajectory fits better if it leaves less than this part of the distance; less bent ones [m] have no left
and right."""

_HEIGHTS_REPORT, _ROTATED_HEIGHTS = 3.0, -0.7


def _on_earth(stream: Stream) -> BoolArray:
    """Which fixes are on the earth, (N,) bool."""
    return np.asarray((np.abs(stream.values[:, 0]) <= 90) & (np.abs(stream.values[:, 1]) <= 180))


def _at_origin(stream: Stream) -> BoolArray:
    """Which fixes are exactly at 0, 0, (N,) bool."""
    return np.asarray((stream.values[:, :2] == 0).all(axis=1))


def _fixes_in_order(stream: Stream) -> Int64Array:
    """Rows of the fixes that are positions, the first of each time, (M,) int64."""
    rows = np.flatnonzero(_on_earth(stream) & ~_at_origin(stream))
    first: Int64Array = rows[np.diff(stream.seconds[rows], prepend=-np.inf) > 0]
    return first


def _positions(fixes: Float64Array) -> Float64Array:
    """East and north of latitudes and longitudes (N, 2 or more) from the first, (N, 2) [m]."""
    flat = np.column_stack([fixes[:, :2], np.zeros(len(fixes))])
    return enu_from_geodetic(flat, flat[0])[:, :2]


def _column_hits(stream: Stream, wrong: BoolArray, column: str, values: Float64Array, expected: str) -> Iterator[Hit]:
    rows = np.flatnonzero(wrong)
    if len(rows):
        row = int(rows[0])
        yield stream.hit(row, f"{stream.at(row)}: {column} {_shown(values[row])}; expected {expected}", len(rows))


def _shown(value: Float64Array) -> str:
    return ", ".join(f"{number:.9g}" for number in np.atleast_1d(value).tolist())


def _off_the_earth(subject: Subject) -> Iterator[Hit]:
    for stream in streams_of_kind(subject, Kind.GNSS):
        wrong, locations = ~_on_earth(stream), stream.values[:, :2]
        expected = "degrees within 90 and 180"
        if (wrong & (np.abs(locations[:, 0]) <= 180) & (np.abs(locations[:, 1]) <= 90)).any():
            expected += ": are latitude and longitude exchanged?"
        yield from _column_hits(stream, wrong, "latitude, longitude", locations, expected)


def _at_zero(subject: Subject) -> Iterator[Hit]:
    for stream in streams_of_kind(subject, Kind.GNSS):
        locations, nowhere = stream.values[:, :2], _at_origin(stream)
        expected = "a location: receivers write 0, 0 before they know one"
        yield from _column_hits(stream, nowhere, "latitude, longitude", locations, expected)
        others = locations[~nowhere]
        if len(others) and (np.abs(others) <= _RADIANS).all():
            problem = f"all latitudes and longitudes are {_shown(others[0])} or near it: are these radians?"
            yield Hit(stream.whole, f"{problem} The format wants degrees")


def _altitudes(subject: Subject) -> Iterator[Hit]:
    for stream in streams_of_kind(subject, Kind.GNSS):
        altitudes = stream.values[:, 2]
        wrong = ~((altitudes >= LOWEST) & (altitudes <= HIGHEST))
        expected = f"{LOWEST:g} to {HIGHEST:g} m"
        if len(altitudes) and HIGHEST < abs(float(np.median(altitudes))) <= 1000 * HIGHEST:
            expected += ": is it in millimetres?"
        yield from _column_hits(stream, wrong, "altitude", altitudes, expected)


def _accuracies(subject: Subject) -> Iterator[Hit]:
    for stream in streams_of_kind(subject, Kind.GNSS):
        for column, name in ((3, "accuracy"), (4, "verticalAccuracy")):
            stated = stream.values[:, column]
            wrong = ~np.isnan(stated) & ~((stated > 0) & (stated <= WORST_ACCURACY))
            expected = f"more than 0 and at most {WORST_ACCURACY:g} m, or none where it is not known"
            yield from _column_hits(stream, wrong, name, stated, expected)


def _jumps(subject: Subject) -> Iterator[Hit]:
    for stream in streams_of_kind(subject, Kind.GNSS):
        rows = _fixes_in_order(stream)
        if len(rows) < 2:
            continue
        seconds, positions, stated = stream.seconds[rows], _positions(stream.values[rows]), stream.values[rows, 3]
        sigmas = np.where((stated > 0) & (stated <= WORST_ACCURACY), stated, UNKNOWN_ACCURACY)
        off, allowed = _off_the_trajectory(seconds, positions, sigmas)
        # a wrong fix puts its neighbours off by half
        padded = np.concatenate([[0.0], off, [0.0]])
        peaks = (off > allowed) & (off > padded[:-2]) & (off >= padded[2:])
        # nothing on the ground reaches a fix that far from the one before, nor leaves it for the next but one
        steps = np.linalg.norm(np.diff(positions, axis=0, prepend=positions[:1]), axis=1)
        reach = FASTEST * np.diff(seconds) + JUMP_SIGMAS * np.hypot(sigmas[1:], sigmas[:-1])
        too_far = np.concatenate([[False], ~(steps[1:] <= reach)])
        too_far[1:] &= ~too_far[:-1]
        too_far[1:] &= ~peaks[:-1]
        for k in np.flatnonzero(peaks | too_far).tolist():
            speed = steps[k] / (seconds[k] - seconds[k - 1]) if k else 0.0
            lies = f"lies {off[k]:.1f} m off the trajectory between its neighbours, " if off[k] > 0 else "lies "
            problem = (
                f"{stream.at(int(rows[k]))} {lies}{steps[k]:.1f} m from the one before, {speed:.0f} m/s; its accuracy "
                f"is {sigmas[k]:.2g} m"
            )
            yield stream.hit(int(rows[k]), problem)


def _off_the_trajectory(
    seconds: Float64Array, positions: Float64Array, sigmas: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """How far each fix is off the straight line between its neighbours, and how far it may be, (N,) [m] each."""
    off, allowed = np.zeros(len(seconds)), np.full(len(seconds), np.inf)
    if len(seconds) < 3:
        return off, allowed
    before, after = seconds[1:-1] - seconds[:-2], seconds[2:] - seconds[1:-1]
    share = (before / (before + after))[:, None]
    off[1:-1] = np.linalg.norm(positions[1:-1] - positions[:-2] * (1 - share) - positions[2:] * share, axis=1)
    worst = np.maximum(sigmas[1:-1], np.maximum(sigmas[:-2], sigmas[2:]))
    swerve = 0.5 * HARDEST_ACCELERATION * before * after
    known = (before <= LONGEST_STEP) & (after <= LONGEST_STEP)
    allowed[1:-1] = np.where(known, JUMP_SIGMAS * worst + swerve + JUMP_MARGIN, np.inf)
    return off, allowed


def _mirrored(subject: Subject) -> Iterator[Hit]:
    streams = {stream.kind: stream for stream in streams_of_kind(subject, Kind.GYROSCOPE, Kind.ACCELEROMETER)}
    if len(streams) < 2:
        return
    gyroscope, up = streams[Kind.GYROSCOPE], streams[Kind.ACCELEROMETER].values.mean(axis=0)
    length = float(np.linalg.norm(up))
    if not 0 < length < np.inf or len(gyroscope) < 2:
        return
    # how far the device had rotated to the left about its up at each sample [rad]
    seconds, rates = gyroscope.seconds, gyroscope.values @ (up / length)
    rotated = np.concatenate([[0.0], np.cumsum(0.5 * (rates[1:] + rates[:-1]) * np.diff(seconds))])
    for fixes in streams_of_kind(subject, Kind.GNSS):
        found = _rotations_of(fixes)
        if found is None:
            continue
        times, rotations = found
        measured = np.diff(np.interp(times, seconds, rotated))
        known = (np.abs(rotations) < _SHARPEST_ROTATION) & (times[:-1] >= seconds[0]) & (times[1:] <= seconds[-1])
        rotations, measured = rotations[known], measured[known]
        if len(rotations) < _FEWEST_ROTATIONS or np.sqrt((measured * measured).mean()) < _LEAST_ROTATION:
            continue
        size = float(np.sqrt((rotations * rotations).sum() * (measured * measured).sum()))
        correlation = float((rotations * measured).sum()) / size if size > 0 else 0.0
        if correlation < LEAST_CORRELATION:
            problem = (
                f"{len(rotations)} rotations of the trajectory correlate by {correlation:.2f} with those that the "
                "gyroscope measured about the accelerometer's up: are latitude and longitude exchanged, or do "
                "accelerations point down at rest?"
            )
            yield Hit(fixes.whole, problem)


def _rotations_of(fixes: Stream) -> tuple[Float64Array, Float64Array] | None:
    """The times in the middle of each leg, (L,) [s], and the rotations between them to the left, (L - 1,) [rad]."""
    usable = _fixes_in_order(fixes)
    usable = usable[:: len(usable) // _MOST_FIXES + 1]
    if len(usable) <= _FEWEST_ROTATIONS:
        return None
    positions, seconds, accuracies = _positions(fixes.values[usable]), fixes.seconds[usable], fixes.values[usable, 3]
    stated = accuracies[accuracies > 0]
    shortest = max(_SHORTEST_LEG, _LEG_SIGMAS * float(np.median(stated)) if len(stated) else 0.0)
    ends, (east, north) = [0], positions[0].tolist()
    for row, (x, y) in enumerate(positions.tolist()):
        if (x - east) ** 2 + (y - north) ** 2 >= shortest * shortest:
            ends.append(row)
            east, north = x, y
    legs = np.diff(positions[ends], axis=0)
    courses = np.unwrap(np.arctan2(legs[:, 1], legs[:, 0]))
    return 0.5 * (seconds[ends[1:]] + seconds[ends[:-1]]), np.diff(courses)


_Complex = np.ndarray[tuple[int], np.dtype[np.complex128]]


@dataclass(frozen=True, slots=True, eq=False)
class _Case:
    """A trajectory and the fixes during it, positions on the ground as complex numbers, east + i north [m]."""

    name: str  # of the trajectory
    fixes: _Complex  # (M,)
    trajectory: _Complex  # (M,), at the fixes' times
    ups: Float64Array  # (M,) heights of the fixes
    heights: Float64Array  # (M,) of the trajectory
    tolerance: float  # so far apart they still agree
    vertical: float  # accuracy of the heights


def _cases(subject: Subject) -> Iterator[_Case]:
    receiver = next((s for s in subject.scene.sensors if isinstance(s, GnssSensor)), None)
    if receiver is None or not len(receiver.timestamps_ns):
        return
    # a fix at 0, 0 before reception would else be the position from which all are seen
    usable = usable_fixes(receiver) & np.isfinite(receiver.positions_lla).all(axis=1)
    for trajectory in subject.scene.trajectories.values():
        times_ns = trajectory.timestamps_ns
        during = usable & (receiver.timestamps_ns >= times_ns[0]) & (receiver.timestamps_ns <= times_ns[-1])
        rows = np.flatnonzero(during)
        if len(rows) < _FEWEST_FIXES:
            continue
        enu = enu_from_geodetic(receiver.positions_lla[rows], receiver.positions_lla[rows[0]])
        fixes = np.asarray(enu[:, 0] + 1j * enu[:, 1])
        own, at = (times_ns - times_ns[0]) / 1e9, (receiver.timestamps_ns[rows] - times_ns[0]) / 1e9
        x, y, z = (np.interp(at, own, axis) for axis in trajectory.positions.T)
        length = float(np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1).sum())
        near = max(NEAREST_REPORTED, _ACCURACIES * _usual(receiver.accuracies[rows]))
        tolerance = near + _DRIFT * min(length, float(np.abs(np.diff(fixes)).sum()))
        vertical = _usual(receiver.vertical_accuracies[rows])
        yield _Case(trajectory.name, fixes, np.asarray(x + 1j * y), enu[:, 2], z, tolerance, vertical)


def _usual(accuracies: Float64Array) -> float:
    known = accuracies[np.isfinite(accuracies)]
    return float(np.median(known)) if len(known) else UNKNOWN_ACCURACY


def _fit(fixes: _Complex, positions: _Complex) -> float:
    """Distance [m] of half of the fixes once the trajectory is aligned by rotation and translation."""
    # it is aligned once more without the farthest ones
    kept = np.ones(len(positions), np.bool_)
    for _ in range(2):
        wanted, given = fixes - fixes[kept].mean(), positions - positions[kept].mean()
        product = np.vdot(given[kept], wanted[kept])
        rotation = product / np.abs(product) if product else 1.0
        away = np.abs(wanted - rotation * given)
        kept = away <= 3.0 * np.median(away) + 1e-9
    return float(np.median(away))


def _far_apart(subject: Subject) -> Iterator[Hit]:
    for case in _cases(subject):
        spread = float(min(np.abs(case.fixes - case.fixes.mean()).max(), np.inf))
        moved = float(np.abs(case.trajectory - case.trajectory.mean()).max())
        if max(spread, moved) < max(_LEAST_SPREAD, 2.0 * case.tolerance):
            continue
        away, mirrored = (_fit(case.fixes, positions) for positions in (case.trajectory, np.conj(case.trajectory)))
        # so much better that no drift explains it, though both may be near
        is_mirrored = mirrored < _CLEARLY * away and away > _MIRRORED_REPORTED
        if away <= case.tolerance and not is_mirrored:
            continue
        problem = (
            f"rotated and shifted as well as can be, half of the fixes lie more than {away:.1f} m off; "
            f"expected {case.tolerance:.1f} m at most"
        )
        if is_mirrored:
            problem += f", and it is {mirrored:.1f} m if x and y are exchanged, or one is negated (mirrored)"
        yield Hit(f"trajectories[{case.name}]", problem)


def _upside_down(subject: Subject) -> Iterator[Hit]:
    for case in _cases(subject):
        ups, heights = case.ups - case.ups.mean(), case.heights - case.heights.mean()
        if ups.std() < max(_HEIGHTS_REPORT * case.vertical, _LEAST_SPREAD) or heights.std() == 0:
            continue
        correlation = float((ups * heights).mean() / (ups.std() * heights.std()))
        if correlation < _ROTATED_HEIGHTS:
            problem = (
                f"z falls where the fixes climb (correlation {correlation:.2f}): probably z of the world points down"
            )
            yield Hit(f"trajectories[{case.name}]", problem)


# fmt: off
FIX_RULES: tuple[Rule, ...] = (
    Rule("fixes-on-earth", ERROR, "Latitudes of fixes lie within 90 degrees, longitudes within 180.",
         "Check whether they are exchanged, or in another unit than degrees.", find=_off_the_earth),
    Rule("fixes-somewhere", WARNING, "No fix is at latitude 0, longitude 0, and not all are within what radians reach.",
         "Leave fixes out that are none; write degrees.", find=_at_zero),
    Rule("fixes-altitude", WARNING, "Altitudes of fixes are -500 to 10000 m.",
         "Write metres above the ellipsoid.", find=_altitudes),
    Rule("fixes-accuracy", WARNING, "Accuracies of fixes are more than 0 and at most 1000 m, where they are given.",
         "Leave the accuracy out where it is not known: an accuracy of 0 gets infinite weight.", find=_accuracies),
    Rule("fixes-jump", WARNING,
         "No fix is farther off the trajectory between its neighbours than 8 of their accuracies, 10 m/s² and "
         "0.5 m explain, nor is reached at more than 150 m/s.",
         "Leave the fix out, or give it the accuracy that it has.", find=_jumps),
    Rule("fixes-mirrored", WARNING,
         "The trajectory of the fixes rotates to the side to which the gyroscope rotates: they do not correlate "
         "by less than -0.8.",
         "Check whether latitude and longitude are exchanged, and whether the accelerometer points up at rest.",
         find=_mirrored),
)

POSES_AND_GNSS_RULES: tuple[Rule, ...] = (
    Rule("poses-against-gnss", WARNING,
         f"Trajectories follow the satellite fixes, within {NEAREST_REPORTED:g} m or {_ACCURACIES:g} times their "
         f"accuracy, and {_DRIFT:.0%} of the trajectory.",
         "Write positions in metres, in a right-handed world whose z points up, on the clock of the fixes.",
         find=_far_apart),
    Rule("heights-against-gnss", WARNING, "Trajectories climb where the altitudes of the fixes do.",
         "Write positions in a world whose z points up.", find=_upside_down),
)
# fmt: on
