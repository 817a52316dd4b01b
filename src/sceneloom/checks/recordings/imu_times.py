"""Rules about when an IMU measured: around the images, at times of its own, and on one clock."""

from collections.abc import Iterator

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.checks.recordings.streams import Kind, Stream, location, streams_of_kind
from sceneloom.checks.recordings.times import APART_SECONDS
from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import Subject
from sceneloom.scene.findings import Severity

FAR_SECONDS = 0.1
FAR_PERIODS = 4.0
"""An image that is farther than both from the nearest sample of the IMU is far."""

SHARE_AT_SAMPLES = 0.5
"""More images than this share with the very times of samples were timestamped by the IMU's clock ticks."""

SHIFT_PERIODS = 1.5
_SAME_SHIFT_PERIODS = 0.5
_SAME_PERIOD = 0.02
_IMU = (Kind.ACCELEROMETER, Kind.GYROSCOPE)


def _distances(seconds: Float64Array, samples: Float64Array) -> Float64Array:
    """How far each time lies from the nearest sample, (N,) [s]; both ascending."""
    after = np.searchsorted(samples, seconds)
    before = np.maximum(after - 1, 0)
    after = np.minimum(after, len(samples) - 1)
    return np.minimum(np.abs(samples[after] - seconds), np.abs(seconds - samples[before]))


def _gyroscope(subject: Subject) -> Stream | None:
    found = {stream.kind: stream for stream in streams_of_kind(subject, *_IMU)}
    return found.get(Kind.GYROSCOPE, found.get(Kind.ACCELEROMETER))


def _far_from_imu(subject: Subject) -> Iterator[Hit]:
    imu = _gyroscope(subject)
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
            yield Hit(location(camera, row), problem)


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
                yield Hit(location(camera, row), problem)
                break


def _shifted(subject: Subject) -> Iterator[Hit]:
    """Accelerometer and gyroscope that begin and end with one and the same shift, as one clock put off does."""
    streams = {stream.kind: stream for stream in streams_of_kind(subject, *_IMU)}
    if len(streams) < 2:
        return
    accelerometer, gyroscope = (streams[kind] for kind in _IMU)
    periods = accelerometer.period, gyroscope.period
    if periods[0] is None or periods[1] is None or abs(len(accelerometer) - len(gyroscope)) > 1:
        return
    period = max(periods[0], periods[1])
    if abs(periods[0] - periods[1]) > _SAME_PERIOD * period:
        return
    at_start = float(accelerometer.seconds[0] - gyroscope.seconds[0])
    at_end = float(accelerometer.seconds[-1] - gyroscope.seconds[-1])
    shift = 0.5 * (at_start + at_end)
    is_steady = abs(at_start - at_end) <= _SAME_SHIFT_PERIODS * period + _between_counts(streams) * period
    if is_steady and SHIFT_PERIODS * period < abs(shift) <= APART_SECONDS:
        later = "after" if shift > 0 else "before"
        problem = (
            f"its {len(accelerometer)} samples begin and end {abs(shift) * 1e3:.1f} ms {later} the "
            f"{len(gyroscope)} of the gyroscope, which has the same rate; expected at most "
            f"{SHIFT_PERIODS:g} intervals of {period * 1e3:.1f} ms"
        )
        yield Hit(accelerometer.whole, problem)


def _between_counts(streams: dict[Kind, Stream]) -> int:
    return abs(len(streams[Kind.ACCELEROMETER]) - len(streams[Kind.GYROSCOPE]))


RULES: tuple[Rule, ...] = (
    Rule(
        "frames-far-from-imu",
        Severity.WARNING,
        "Every image has a sample of the gyroscope within 0.1 s and 4 of its intervals, whichever is longer.",
        "See whether both are on one clock, and whether the IMU was started late or stopped early.",
        find=_far_from_imu,
    ),
    Rule(
        "frames-at-imu-times",
        Severity.HINT,
        "At most half of the images have the very time of a sample of the IMU.",
        "Timestamp images when they are exposed, not with the next sample's time; the vendor's diagnosis warns of it.",
        find=_at_samples,
    ),
    Rule(
        "imu-clocks",
        Severity.WARNING,
        "Accelerometer and gyroscope of one rate and length begin and end within 1.5 intervals of each other.",
        "See whether one of them is timestamped late, and take the shift off its times.",
        find=_shifted,
    ),
)
