"""Rules about the fixes of satellite receivers: on the earth, in degrees, as good as they state."""

from collections.abc import Iterator

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.checks.poses import FASTEST
from sceneloom.checks.recordings.streams import Kind, Stream, location, streams_of_kind
from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import Subject
from sceneloom.geometry.geodesy import enu_from_geodetic
from sceneloom.scene.findings import Severity

LOWEST, HIGHEST = -500.0, 10_000.0
"""Altitudes [m] between the Dead Sea's shore and the highest roads, with room for aeroplanes."""

WORST_ACCURACY = 1000.0
"""A fix that is less accurate [m] is of a mobile network, or in another unit."""

UNKNOWN_ACCURACY = 5.0
"""Taken where a fix says none [m]."""

JUMP_SIGMAS = 8.0
HARDEST_ACCELERATION = 10.0
JUMP_MARGIN = 0.5
"""A fix jumps that lies farther off the trajectory between its neighbours than 8 of their accuracies.

What a vehicle can
swerve meanwhile [m/s²], and half a metre."""

LONGEST_STEP = 3.0
"""Between fixes farther apart [s] the trajectory is not known well enough."""

_RADIANS = (np.pi / 2, np.pi)


def _on_earth(stream: Stream) -> BoolArray:
    """Which fixes are on the earth, (N,) bool."""
    latitudes, longitudes = stream.values[:, 0], stream.values[:, 1]
    usable: BoolArray = (np.abs(latitudes) <= 90) & (np.abs(longitudes) <= 180)
    return usable


def _non_finite(stream: Stream) -> BoolArray:
    """Which fixes are exactly at 0, 0, (N,) bool."""
    nowhere: BoolArray = (stream.values[:, :2] == 0).all(axis=1)
    return nowhere


def locations_in_order(stream: Stream) -> Int64Array:
    """Rows of the fixes that are locations, the first of each time, (M,) int64."""
    rows = np.flatnonzero(_on_earth(stream) & ~_non_finite(stream))
    first: Int64Array = rows[np.diff(stream.seconds[rows], prepend=-np.inf) > 0]
    return first


def _notify(
    stream: Stream, wrong: BoolArray, column: str, values: Float64Array, expected: str
) -> Iterator[Hit]:
    rows = np.flatnonzero(wrong)
    if len(rows):
        row = int(rows[0])
        problem = f"{stream.at(row)}: {column} {_shown(values[row])}; expected {expected}"
        yield Hit(location(stream, row), problem, len(rows))


def _shown(value: Float64Array) -> str:
    return ", ".join(f"{number:.9g}" for number in np.atleast_1d(value).tolist())


def _off_the_earth(subject: Subject) -> Iterator[Hit]:
    for stream in streams_of_kind(subject, Kind.GNSS):
        wrong, locations = ~_on_earth(stream), stream.values[:, :2]
        expected = "degrees within 90 and 180"
        if (wrong & (np.abs(locations[:, 0]) <= 180) & (np.abs(locations[:, 1]) <= 90)).any():
            expected += ": are latitude and longitude exchanged?"
        yield from _notify(stream, wrong, "latitude, longitude", locations, expected)


def _at_zero(subject: Subject) -> Iterator[Hit]:
    for stream in streams_of_kind(subject, Kind.GNSS):
        locations, nowhere = stream.values[:, :2], _non_finite(stream)
        expected = "a location: receivers write 0, 0 before they know one"
        yield from _notify(stream, nowhere, "latitude, longitude", locations, expected)
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
        yield from _notify(stream, wrong, "altitude", altitudes, expected)


def _accuracies(subject: Subject) -> Iterator[Hit]:
    for stream in streams_of_kind(subject, Kind.GNSS):
        for column, name in ((3, "accuracy"), (4, "verticalAccuracy")):
            stated = stream.values[:, column]
            wrong = ~np.isnan(stated) & ~((stated > 0) & (stated <= WORST_ACCURACY))
            expected = f"more than 0 and at most {WORST_ACCURACY:g} m, or none where it is not known"
            yield from _notify(stream, wrong, name, stated, expected)


def _jumps(subject: Subject) -> Iterator[Hit]:
    for stream in streams_of_kind(subject, Kind.GNSS):
        rows = locations_in_order(stream)
        if len(rows) < 2:
            continue
        seconds, fixes = stream.seconds[rows], stream.values[rows]
        locations = enu_from_geodetic(
            np.column_stack([fixes[:, :2], np.zeros(len(fixes))]), [*fixes[0, :2], 0.0]
        )
        sigmas = _sigmas(fixes[:, 3])
        off, allowed = _off_the_trajectory(seconds, locations[:, :2], sigmas)
        too_far = _too_far(seconds, locations[:, :2], sigmas)
        peaks = _peaks(off, allowed)
        too_far[1:] &= ~peaks[:-1]
        for k in np.flatnonzero(peaks | too_far).tolist():
            row = int(rows[k])
            yield Hit(location(stream, row), _reported(stream, row, seconds, locations, sigmas, off, k))


def _reported(
    stream: Stream,
    row: int,
    seconds: Float64Array,
    locations: Float64Array,
    sigmas: Float64Array,
    off: Float64Array,
    k: int,
) -> str:
    before = max(k - 1, 0)
    step = float(np.linalg.norm(locations[k] - locations[before]))
    speed = step / (seconds[k] - seconds[before]) if k else 0.0
    lies = f"lies {off[k]:.1f} m off the trajectory between its neighbours, " if off[k] > 0 else "lies "
    there = f"{step:.1f} m from the one before, {speed:.0f} m/s"
    return f"{stream.at(row)} {lies}{there}; its accuracy is {sigmas[k]:.2g} m"


def _sigmas(accuracies: Float64Array) -> Float64Array:
    is_stated = (accuracies > 0) & (accuracies <= WORST_ACCURACY)
    sigmas: Float64Array = np.where(is_stated, accuracies, UNKNOWN_ACCURACY)
    return sigmas


def _off_the_trajectory(
    seconds: Float64Array, locations: Float64Array, sigmas: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """How far each fix lies off the straight trajectory between its neighbours, and how far it may, (N,) [m] each."""
    off, allowed = np.zeros(len(seconds)), np.full(len(seconds), np.inf)
    if len(seconds) < 3:
        return off, allowed
    before, after = seconds[1:-1] - seconds[:-2], seconds[2:] - seconds[1:-1]
    share = (before / (before + after))[:, None]
    off[1:-1] = np.linalg.norm(locations[1:-1] - locations[:-2] * (1 - share) - locations[2:] * share, axis=1)
    worst = np.maximum(sigmas[1:-1], np.maximum(sigmas[:-2], sigmas[2:]))
    swerve = 0.5 * HARDEST_ACCELERATION * before * after
    known = (before <= LONGEST_STEP) & (after <= LONGEST_STEP)
    allowed[1:-1] = np.where(known, JUMP_SIGMAS * worst + swerve + JUMP_MARGIN, np.inf)
    return off, allowed


def _peaks(off: Float64Array, allowed: Float64Array) -> BoolArray:
    """Fixes that are off by too much, and by more than their neighbours, which a wrong fix puts off by half."""
    padded = np.concatenate([[0.0], off, [0.0]])
    peaks: BoolArray = (off > allowed) & (off > padded[:-2]) & (off >= padded[2:])
    return peaks


def _too_far(seconds: Float64Array, locations: Float64Array, sigmas: Float64Array) -> BoolArray:
    """Fixes that nothing on the ground reaches from the one before, nor leaves for the next but one, (N,) bool."""
    steps = np.linalg.norm(np.diff(locations, axis=0), axis=1)
    reach = FASTEST * np.diff(seconds) + JUMP_SIGMAS * np.hypot(sigmas[1:], sigmas[:-1])
    far: BoolArray = np.concatenate([[False], ~(steps <= reach)])
    far[1:] &= ~far[:-1]
    return far


RULES: tuple[Rule, ...] = (
    Rule(
        "fixes-on-earth",
        Severity.ERROR,
        "Latitudes of fixes lie within 90 degrees, longitudes within 180.",
        "See whether they are exchanged, or in another unit than degrees.",
        find=_off_the_earth,
    ),
    Rule(
        "fixes-somewhere",
        Severity.WARNING,
        "No fix is at latitude 0, longitude 0, and not all are within what radians reach.",
        "Leave fixes out that are none; write degrees.",
        find=_at_zero,
    ),
    Rule(
        "fixes-altitude",
        Severity.WARNING,
        "Altitudes of fixes are -500 to 10000 m.",
        "Write metres above the ellipsoid.",
        find=_altitudes,
    ),
    Rule(
        "fixes-accuracy",
        Severity.WARNING,
        "Accuracies of fixes are more than 0 and at most 1000 m, where they are given.",
        "Leave the accuracy out where it is not known: whoever weighs fixes by it trusts one of 0 without end.",
        find=_accuracies,
    ),
    Rule(
        "fixes-jump",
        Severity.WARNING,
        "No fix lies farther off the trajectory between its neighbours than 8 of their accuracies, 10 m/s² and 0.5 m "
        "explain, nor is reached at more than 150 m/s.",
        "Leave the fix out, or give it the accuracy that it has.",
        find=_jumps,
    ),
)
