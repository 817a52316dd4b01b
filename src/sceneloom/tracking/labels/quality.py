"""What a person should look at first: objects whose track, size, heading or points look wrong."""

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from math import pi

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.scene.tracks import Support, Track
from sceneloom.tracking.labels.paths import boxed


class FlagKind(StrEnum):
    """What looks wrong."""

    SHORT = "short"
    """Few boxes of detectors support it."""
    UNSURE = "unsure"
    """It probably does not exist."""
    SPARSE = "sparse support"
    """Much of it rests on no box at all."""
    IMAGE_ONLY = "image only"
    """No sweep ever had a box of it, so that its distance is a guess."""
    JITTER = "jitter"
    """Its location jumps to and fro."""
    JUMP = "jump"
    """It gets from one state to the next faster than its speed says."""
    SIZE = "size change"
    """Its size changes."""
    YAW_FLIP = "yaw flip"
    """Its heading rotates about from one state to the next."""
    YAW_JITTER = "yaw jitter"
    """Its heading jumps to and fro."""
    AGAINST_MOTION = "heads against motion"
    """It drives, but not where it heads."""
    OVERLAP = "overlap"
    """Another object is in the same location."""
    EMPTY = "empty boxes"
    """Sweeps that found it have no points in its cuboid."""
    RADAR = "radar disagrees"
    """A radar measures another speed."""


LIMITS: Mapping[FlagKind, float] = {
    FlagKind.SHORT: 5.0,
    FlagKind.UNSURE: 0.5,
    FlagKind.SPARSE: 0.5,
    FlagKind.IMAGE_ONLY: 0.5,
    FlagKind.JITTER: 0.25,
    FlagKind.JUMP: 1.5,
    FlagKind.SIZE: 0.25,
    FlagKind.YAW_FLIP: pi / 2.0,
    FlagKind.YAW_JITTER: np.radians(10.0),
    FlagKind.AGAINST_MOTION: np.radians(60.0),
    FlagKind.OVERLAP: 0.4,
    FlagKind.EMPTY: 0.3,
    FlagKind.RADAR: 2.0,
}
"""What is beyond these is flagged: boxes, probability, share of states, -, metres, metres, share of the size, radians
(three times), share of the narrower one's width by which centres are nearer, share of the sweeps, metres a second."""

_BELOW = (FlagKind.SHORT, FlagKind.UNSURE)
"""What is flagged below its limit; all else above it."""
_DRIVES = 2.0
"""What is slower has a heading of its own [m/s]."""
_MIDDLING = 0.8
"""Jitter is what this share of the states do not exceed: a single jump is flagged as such."""


@dataclass(frozen=True, slots=True)
class Flag:
    """One thing to look at.

    Attributes:
        track: number of the object.
        kind: what looks wrong.
        timestamp_ns: where to look [ns]: where it is worst.
        value: how much it is, in the unit of `LIMITS`.
    """

    track: int
    kind: FlagKind
    timestamp_ns: int
    value: float

    @property
    def urgency(self) -> float:
        """How many times beyond its limit it is, from 1 on."""
        limit, value = max(LIMITS[self.kind], 1e-3), max(self.value, 1e-3)
        return limit / value if self.kind in _BELOW else value / limit


def flag(track: Track, kind: FlagKind, value: float, row: int) -> Iterator[Flag]:
    """Give a flag if a value is beyond the limit of its kind."""
    beyond = value < LIMITS[kind] if kind in _BELOW else value > LIMITS[kind]
    if beyond:
        yield Flag(track.id, kind, int(track.timestamps_ns[row]), round(float(value), 3))


def flags_of(track: Track) -> list[Flag]:
    """Look at one track: from its first box to its last."""
    rows = np.flatnonzero(boxed(track))
    found = [
        *flag(track, FlagKind.SHORT, len(rows), 0),
        *flag(track, FlagKind.UNSURE, float(track.scores.max()), int(track.scores.argmax())),
        *flag(track, FlagKind.SPARSE, 1.0 - len(rows) / len(track), _longest_gap(rows)),
    ]
    if not np.isin(track.supports, (Support.BOTH, Support.SWEEP)).any():
        found += flag(track, FlagKind.IMAGE_ONLY, 1.0, 0)
    return [*found, *_of_sizes(track), *_of_motion(track), *_of_heading(track)]


def _longest_gap(rows: Int64Array) -> int:
    """The state in the middle of the longest time without a box."""
    steps = np.diff(rows)
    if len(steps) == 0:
        return 0
    k = int(steps.argmax())
    return int(rows[k] + rows[k + 1]) // 2


def _of_sizes(track: Track) -> Iterator[Flag]:
    usual = np.median(track.sizes_lwh, axis=0)
    changes = np.abs(track.sizes_lwh / usual - 1.0).max(axis=1)
    yield from flag(track, FlagKind.SIZE, float(changes.max()), int(changes.argmax()))


def _of_motion(track: Track) -> Iterator[Flag]:
    if len(track) < 3:
        return
    bends = np.linalg.norm(_off_lines(track, track.centers[:, :2]), axis=1)
    yield from flag(track, FlagKind.JITTER, float(np.quantile(bends, _MIDDLING)), int(bends.argmax()) + 1)
    seconds = np.diff(track.timestamps_ns) * 1e-9
    speeds = (track.velocities[1:, :2] + track.velocities[:-1, :2]) / 2.0
    jumps = np.linalg.norm(np.diff(track.centers[:, :2], axis=0) - speeds * seconds[:, None], axis=1)
    yield from flag(track, FlagKind.JUMP, float(jumps.max()), int(jumps.argmax()) + 1)


def _of_heading(track: Track) -> Iterator[Flag]:
    rotations = np.abs(_shortest(np.diff(track.yaws)))
    if len(rotations):
        yield from flag(track, FlagKind.YAW_FLIP, float(rotations.max()), int(rotations.argmax()) + 1)
    if len(rotations) > 1 and rotations.max() <= LIMITS[FlagKind.YAW_FLIP]:
        bends = np.abs(_off_lines(track, np.unwrap(track.yaws)[:, None])[:, 0])
        yield from flag(
            track, FlagKind.YAW_JITTER, float(np.quantile(bends, _MIDDLING)), int(bends.argmax()) + 1
        )
    driving = np.flatnonzero(np.linalg.norm(track.velocities[:, :2], axis=1) > _DRIVES)
    if len(driving):
        courses = np.arctan2(track.velocities[driving, 1], track.velocities[driving, 0])
        off = np.abs(_shortest(courses - track.yaws[driving]))
        yield from flag(track, FlagKind.AGAINST_MOTION, float(np.median(off)), int(driving[off.argmax()]))


def _off_lines(track: Track, values: Float64Array) -> Float64Array:
    """How far each state but the first and the last is from the line between its neighbours, (K - 2, C)."""
    times = track.timestamps_ns.astype(np.float64)
    shares = (times[1:-1] - times[:-2]) / (times[2:] - times[:-2])
    off: Float64Array = values[:-2] + shares[:, None] * (values[2:] - values[:-2]) - values[1:-1]
    return off


def _shortest(angles: Float64Array) -> Float64Array:
    rotated: Float64Array = (angles + pi) % (2.0 * pi) - pi
    return rotated


def overlap_flags(tracks: Iterable[Track], together: Collection[frozenset[int]] = ()) -> list[Flag]:
    """Find objects that are in the same location at the same time: the less sure one of each two is flagged.

    Args:
        tracks: all of them.
        together: numbers of those that may be, such as a rider and what he rides.
    """
    kept = list(tracks)
    times = np.unique(np.concatenate([np.zeros(0, np.int64), *(track.timestamps_ns for track in kept)]))
    worst: dict[int, tuple[float, int]] = {}
    rows = [np.searchsorted(track.timestamps_ns, times) for track in kept]
    for k, time_ns in enumerate(times.tolist()):
        there = [
            (n, int(rows[n][k]))
            for n, track in enumerate(kept)
            if rows[n][k] < len(track) and track.timestamps_ns[rows[n][k]] == time_ns
        ]
        for n, row, share, other in _overlaps(kept, there):
            if share > worst.get(n, (0.0, 0))[0] and frozenset((kept[n].id, kept[other].id)) not in together:
                worst[n] = share, row
    return [one for n, (share, row) in worst.items() for one in flag(kept[n], FlagKind.OVERLAP, share, row)]


def _overlaps(tracks: list[Track], there: list[tuple[int, int]]) -> Iterator[tuple[int, int, float, int]]:
    """Of the objects at one time, by number and row: which of each two that meet is less sure, how near, the other."""
    if len(there) < 2:
        return
    boxes = np.array([(*tracks[n].centers[row], *tracks[n].sizes_lwh[row]) for n, row in there])
    apart = np.linalg.norm(boxes[:, None, :2] - boxes[:, :2], axis=2)
    narrow = np.minimum(boxes[:, None, 4], boxes[:, 4])
    above = np.abs(boxes[:, None, 2] - boxes[:, 2]) < (boxes[:, None, 5] + boxes[:, 5]) / 2.0
    shares = np.where(above, 1.0 - apart / np.maximum(narrow, 1e-6), 0.0)
    for a, b in zip(*np.nonzero(np.triu(shares > 0.0, 1)), strict=True):
        scores = [tracks[there[k][0]].scores[there[k][1]] for k in (a, b)]
        less, more = (b, a) if scores[1] <= scores[0] else (a, b)
        yield (*there[int(less)], float(shares[a, b]), there[int(more)][0])
