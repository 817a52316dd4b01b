"""A rule about the trajectory that fixes rotate: to the side to which the gyroscope does, or something is mirrored.

Latitude and longitude that are exchanged lie on the earth, too, and so do the locations that they make; but a
trajectory that is mirrored rotates left where the vehicle rotated right.
"""

from collections.abc import Iterator

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.checks.recordings.fixes import locations_in_order
from sceneloom.checks.recordings.streams import Kind, Stream, streams_of_kind
from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import Subject
from sceneloom.geometry.geodesy import enu_from_geodetic
from sceneloom.scene.findings import Severity

LEAST_CORRELATION = -0.8
"""Rotates that correlate worse were taken to the other side."""

_FEWEST_ROTATIONS = 6
_LEAST_ROTATION = 0.1
"""Root mean square of the rotations from leg to leg [rad] that notify a side."""

_SHORTEST_LEG = 5.0
_LEG_SIGMAS = 10.0
"""Legs are longer than this [m], and than so many accuracies of the fixes that bound them."""

_SHARPEST_ROTATION = 1.0
"""Between legs that differ by more [rad] the trajectory is not known: it may have rotated to either side."""

_MOST_FIXES = 4_000


def _mirrored(subject: Subject) -> Iterator[Hit]:
    streams = {stream.kind: stream for stream in streams_of_kind(subject, Kind.GYROSCOPE, Kind.ACCELEROMETER)}
    if len(streams) < 2:
        return
    seconds, rotated = _rotated_left(streams[Kind.GYROSCOPE], streams[Kind.ACCELEROMETER])
    for fixes in streams_of_kind(subject, Kind.GNSS):
        reported = _rotations_of(fixes)
        if len(seconds) < 2 or reported is None:
            continue
        times, rotations = reported
        measured = np.diff(np.interp(times, seconds, rotated))
        known = (
            (np.abs(rotations) < _SHARPEST_ROTATION) & (times[:-1] >= seconds[0]) & (times[1:] <= seconds[-1])
        )
        rotations, measured = rotations[known], measured[known]
        if len(rotations) < _FEWEST_ROTATIONS or np.sqrt((measured * measured).mean()) < _LEAST_ROTATION:
            continue
        length = float(np.sqrt((rotations * rotations).sum() * (measured * measured).sum()))
        found = float((rotations * measured).sum()) / length if length > 0 else 0.0
        if found < LEAST_CORRELATION:
            problem = (
                f"{len(rotations)} rotates of the trajectory correlate by {found:.2f} with those that the gyroscope "
                f"measured about "
                "the accelerometer's up: are latitude and longitude exchanged, or do accelerations point down at rest?"
            )
            yield Hit(fixes.whole, problem)


def _rotated_left(gyroscope: Stream, accelerometer: Stream) -> tuple[Float64Array, Float64Array]:
    """How far the device had rotated about its up at each sample of the gyroscope [rad]."""
    up = accelerometer.values.mean(axis=0)
    length = float(np.linalg.norm(up))
    if not 0 < length < np.inf:
        return np.zeros(0), np.zeros(0)
    rates = gyroscope.values @ (up / length)
    steps = 0.5 * (rates[1:] + rates[:-1]) * np.diff(gyroscope.seconds)
    return gyroscope.seconds, np.concatenate([[0.0], np.cumsum(steps)])


def _rotations_of(fixes: Stream) -> tuple[Float64Array, Float64Array] | None:
    """The times in the middle of each leg, (L,) [s], and the rotations between them to the left, (L - 1,) [rad]."""
    usable = locations_in_order(fixes)
    usable = usable[:: len(usable) // _MOST_FIXES + 1]
    if len(usable) <= _FEWEST_ROTATIONS:
        return None
    lla = np.column_stack([fixes.values[usable, :2], np.zeros(len(usable))])
    locations, seconds = enu_from_geodetic(lla, lla[0])[:, :2], fixes.seconds[usable]
    accuracies = fixes.values[usable, 3]
    stated = accuracies[accuracies > 0]
    ends = _ends_of_legs(
        locations, max(_SHORTEST_LEG, _LEG_SIGMAS * float(np.median(stated)) if len(stated) else 0.0)
    )
    legs = np.diff(locations[ends], axis=0)
    courses = np.unwrap(np.arctan2(legs[:, 1], legs[:, 0]))
    return 0.5 * (seconds[ends[1:]] + seconds[ends[:-1]]), np.diff(courses)


def _ends_of_legs(locations: Float64Array, shortest: float) -> Int64Array:
    """Fixes that each lie so far from the one before, (L + 1,) int64."""
    ends, (east, north) = [0], locations[0].tolist()
    for row, (x, y) in enumerate(locations.tolist()):
        if (x - east) ** 2 + (y - north) ** 2 >= shortest * shortest:
            ends.append(row)
            east, north = x, y
    return np.array(ends, np.int64)


RULES: tuple[Rule, ...] = (
    Rule(
        "fixes-mirrored",
        Severity.WARNING,
        "The trajectory of the fixes rotates to the side to which the gyroscope rotates: they do not correlate by "
        "less than -0.8.",
        "See whether latitude and longitude are exchanged, and whether the accelerometer points up at rest.",
        find=_mirrored,
    ),
)
