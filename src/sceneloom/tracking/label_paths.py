"""The cuboid path of a track in few keyframes, radar evidence for it, and flags for what a person should review first.

A return has its location, the line of sight d that leads to it, and the speed s along it against the radar itself. With
the radar's own velocity v the object's speed over ground along the same line is s + d · v, which is compared with
d · u of the track's velocity u.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from math import degrees, pi, radians

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.geometry.rotations import rotate_vectors
from sceneloom.kernels.tracking import fewest_keyframes
from sceneloom.scene.annotations import AttributePath, CuboidPath
from sceneloom.scene.annotations_at import CuboidAngles
from sceneloom.scene.clouds import RadarFrame, RadarSensor
from sceneloom.scene.detections import Support, Track
from sceneloom.scene.ego import EgoMotion, points_source, sensor_source
from sceneloom.scene.poses import PoseSource
from sceneloom.scene.sampling import WORLD
from sceneloom.scene.scene import Scene, scene_period_ns
from sceneloom.scene.types import Identifier
from sceneloom.tracking.settings import LabelSettings

_BOXED = (Support.BOTH, Support.SWEEP, Support.IMAGE)
"""States that rest on a box of a detector."""

_MEASURED = (Support.BOTH, Support.SWEEP)

_ROUNDING = 1e-9
"""Tolerances are kept this share smaller, so that another order of the same sums does not break the promise."""

_MOST_UNSURE = 0.6
"""However little is known of a speed, what gets on faster does not stand [m/s]."""

_LEAST_VARIANCE = 1e-6
"""No variance counts as less than this [m²]."""


@dataclass(frozen=True, slots=True, eq=False)
class LabelPath:
    """An object over time as it is to be labelled.

    Attributes:
        timestamps_ns: (K,) int64 [ns], of the track's states from the first to the last that rests on a box.
        boxes: (K, 7) float64, centre and size [m] and heading [rad], which goes on beyond half rotations.
        stands: whether it is stationary.
    """

    timestamps_ns: Int64Array
    boxes: Float64Array
    stands: bool

    def keyframes(self, settings: LabelSettings) -> Int64Array:
        """Which states are keyframes: the fewest that give the others within the tolerances; one of what stands."""
        if self.stands:
            return np.zeros(1, np.int64)
        keep = 1.0 - _ROUNDING
        return fewest_keyframes(
            np.array(self.timestamps_ns),
            np.array(self.boxes),
            settings.tolerance_m * keep,
            radians(settings.tolerance_deg) * keep,
        )

    def cuboids(self, rows: Int64Array, angles: CuboidAngles) -> CuboidPath:
        """The path of a cuboid through some states, its angles as the scene means them."""
        boxes = self.boxes[rows]
        values = np.zeros((len(rows), 9))
        values[:, :3], values[:, 3:6] = boxes[:, 3:6], boxes[:, :3]
        unit = degrees(1.0) if angles.unit == CuboidAngles().unit else 1.0
        # of boxes that are rotated about z alone, the order of the rotations does not matter
        values[:, 8] = boxes[:, 6] * unit
        return CuboidPath(self.timestamps_ns[rows], values)


def boxed_part(track: Track) -> Track | None:
    """The states of a track from the first that rests on a box to the last that does; None where none does."""
    rows = np.flatnonzero(boxed(track))
    return None if len(rows) == 0 else _part_of(track, slice(int(rows[0]), int(rows[-1]) + 1))


def boxed(track: Track) -> BoolArray:
    """Which states rest on a box, (K,) bool."""
    return np.isin(track.supports, _BOXED)


def _part_of(track: Track, rows: slice) -> Track:
    """Some states of a track."""
    names = (
        "timestamps_ns",
        "centers",
        "sizes_lwh",
        "yaws",
        "velocities",
        "yaw_rates",
        "covariances",
        "scores",
    )
    corners = {camera_id: boxes[rows] for camera_id, boxes in track.corners_xyxy.items()}
    kept = {name: getattr(track, name)[rows] for name in (*names, "supports")}
    return replace(track, corners_xyxy=corners, **kept)


def label_path(track: Track, settings: LabelSettings) -> LabelPath:
    """Give an object over time as it is to be labelled.

    Args:
        track: from its first box to its last.
        settings: whether sizes are made constant and stationary objects found.
    """
    yaws = np.unwrap(track.yaws)
    boxes = np.column_stack([track.centers, track.sizes_lwh, yaws])
    weights = _weights(track)
    if settings.constant_sizes:
        boxes[:, 3:6] = weighted_medians(track.sizes_lwh, weights[:, 3:6])
    if not (settings.stationary and _stands(track, settings)):
        return LabelPath(track.timestamps_ns, boxes, stands=False)
    boxes[:, :3] = weighted_medians(track.centers, weights[:, :3])
    boxes[:, 3:6] = weighted_medians(track.sizes_lwh, weights[:, 3:6])
    boxes[:, 6] = usual_heading(yaws, weights[:, 6])
    return LabelPath(track.timestamps_ns, boxes, stands=True)


def _stands(track: Track, settings: LabelSettings) -> bool:
    """Report whether an object is stationary: never far from its usual location, and not getting on from there.

    It may get on as fast as the settings state, or as its speed is uncertain by one deviation.
    """
    rows = np.flatnonzero(np.isin(track.supports, _MEASURED))
    if len(rows) < 2:
        return False
    locations, times = (
        track.centers[rows, :2],
        (track.timestamps_ns[rows] - track.timestamps_ns[rows[0]]) * 1e-9,
    )
    away = np.linalg.norm(locations - np.median(locations, axis=0), axis=1)
    if float(away.max()) > settings.stationary_spread:
        return False
    slopes = np.polynomial.polynomial.polyfit(times, locations, 1)[1]
    known = np.trace(track.covariances[rows, 7:9, 7:9], axis1=1, axis2=2) / 2.0
    unsure = min(float(np.sqrt(max(float(np.median(known)), 0.0))), _MOST_UNSURE)
    return float(np.hypot(*slopes)) <= max(settings.stationary_speed, unsure)


def _weights(track: Track) -> Float64Array:
    """What each number of each state is worth, (K, 7): the inverse of its variance; least without a box of a sweep."""
    variances = np.diagonal(track.covariances[:, :7, :7], axis1=1, axis2=2)
    sound = np.isfinite(variances) & (variances >= 0.0)
    weights: Float64Array = 1.0 / np.maximum(np.where(sound, variances, 1.0), _LEAST_VARIANCE)
    measured = np.isin(track.supports, _MEASURED)
    return np.where(measured[:, None], weights, weights * _LEAST_VARIANCE) if measured.any() else weights


def weighted_medians(values: Float64Array, weights: Float64Array) -> Float64Array:
    """The median of each column of (K, C) values, (C,): as much weight below it as above."""
    order = np.argsort(values, axis=0, kind="stable")
    heaped = np.cumsum(np.take_along_axis(weights, order, axis=0), axis=0)
    middles = (heaped >= heaped[-1] / 2.0).argmax(axis=0)
    medians: Float64Array = values[order[middles, np.arange(values.shape[1])], np.arange(values.shape[1])]
    return medians


def usual_heading(yaws: Float64Array, weights: Float64Array) -> float:
    """The heading that most of (K,) headings [rad] agree with, those that are half a switch off counting against it.

    The axis is the mean of doubled angles, for which a heading and its opposite are the same; the trajectory along it
    is what the larger weight says.

    Source: Mardia and Jupp 2000, "Directional Statistics", ch. 2, for means of axes.
    """
    axis = 0.5 * float(np.angle((weights * np.exp(2j * yaws)).sum()))
    along = float((weights * np.cos(yaws - axis)).sum())
    return axis if along >= 0.0 else axis - pi * np.sign(axis or 1.0)


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


_LIMITS: Mapping[FlagKind, float] = {
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
        value: how much it is, in the unit of `_LIMITS`.
    """

    track: int
    kind: FlagKind
    timestamp_ns: int
    value: float

    @property
    def urgency(self) -> float:
        """How many times beyond its limit it is, from 1 on."""
        limit, value = max(_LIMITS[self.kind], 1e-3), max(self.value, 1e-3)
        return limit / value if self.kind in _BELOW else value / limit


def flag(track: Track, kind: FlagKind, value: float, row: int) -> Iterator[Flag]:
    """Give a flag if a value is beyond the limit of its kind."""
    beyond = value < _LIMITS[kind] if kind in _BELOW else value > _LIMITS[kind]
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
    if len(rotations) > 1 and rotations.max() <= _LIMITS[FlagKind.YAW_FLIP]:
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


_RETURNS, _RADIAL_VELOCITY = "radar_returns", "radial_velocity"
"""Names of attributes: how many returns of a frame come from it; its speed over ground away from the radar [m/s]."""

_MARGIN = np.array([0.4, 0.4, 2.0])
"""A return so near outside a box is of it [m]: radars report the height badly."""

_STEP_NS = 20_000_000
"""The radar's own velocity is that of so long before to so long after [ns]."""

_DECIMALS = 2

_LEAST_FRAMES = 3
"""Fewer frames with returns do not contradict a track."""


@dataclass(slots=True)
class _Heard:
    """What one radar heard of one object: by frame the time, the count, and measured less expected speed."""

    times_ns: list[int] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)
    speeds: list[float] = field(default_factory=list)
    misfits: list[float] = field(default_factory=list)


@dataclass(frozen=True, slots=True, eq=False)
class RadarEvidence:
    """What radars heard of the objects of some tracks.

    Attributes:
        attributes: by number of the track.
        flags: of objects whose speed they contradict.
    """

    attributes: Mapping[int, tuple[AttributePath, ...]]
    flags: tuple[Flag, ...]


def hear(scene: Scene, tracks: Sequence[Track], ego: EgoMotion | None) -> RadarEvidence:
    """Ask the radars of a scene about tracks in its world.

    Raises:
        PoseError: it is not known where a radar was.
        DataError: a frame cannot be read.
    """
    attributes: dict[int, list[AttributePath]] = {}
    flags: list[Flag] = []
    for radar in scene.sensors:
        if isinstance(radar, RadarSensor):
            for number, heard in _heard(scene, radar, tracks, ego).items():
                attributes.setdefault(tracks[number].id, []).extend(_attributes(radar.id, heard))
                flags += _contradiction(tracks[number], heard)
    return RadarEvidence({number: tuple(reported) for number, reported in attributes.items()}, tuple(flags))


def _attributes(radar_id: Identifier, heard: _Heard) -> list[AttributePath]:
    times = np.array(heard.times_ns, np.int64)
    timed = np.flatnonzero(np.isfinite(heard.speeds))
    reported = [AttributePath(_RETURNS, tuple(heard.counts), times, sensor_id=radar_id)]
    if len(timed):
        speeds = tuple(round(heard.speeds[k], _DECIMALS) for k in timed.tolist())
        reported.append(AttributePath(_RADIAL_VELOCITY, speeds, times[timed], sensor_id=radar_id))
    return reported


def _contradiction(track: Track, heard: _Heard) -> list[Flag]:
    misfits = np.abs(heard.misfits)
    reported = np.flatnonzero(np.isfinite(misfits))
    if len(reported) < _LEAST_FRAMES:
        return []
    worst = heard.times_ns[int(reported[misfits[reported].argmax()])]
    row = int(np.abs(track.timestamps_ns - worst).argmin())
    return list(flag(track, FlagKind.RADAR, float(np.median(misfits[reported])), row))


def _heard(
    scene: Scene, radar: RadarSensor, tracks: Sequence[Track], ego: EgoMotion | None
) -> dict[int, _Heard]:
    reach_ns = scene_period_ns(scene)
    location = points_source(scene, radar, ego, reach_ns=reach_ns) or WORLD
    own = sensor_source(scene, radar, ego, reach_ns=reach_ns)
    spans = np.array([track.timestamps_ns[[0, -1]] for track in tracks], np.int64).reshape(-1, 2)
    found: dict[int, _Heard] = {}
    for frame in radar.frames:
        there = np.flatnonzero((spans[:, 0] <= frame.timestamp_ns) & (frame.timestamp_ns <= spans[:, 1]))
        returns = _returns(frame, location, own) if len(there) else None
        if returns is not None:
            for number in there.tolist():
                _listen(found.setdefault(number, _Heard()), tracks[number], frame.timestamp_ns, returns)
    return {number: heard for number, heard in found.items() if heard.times_ns}


def _returns(frame: RadarFrame, location: PoseSource, own: PoseSource) -> Float64Array | None:
    """Location (N, 3), line of sight (N, 3) and speed over ground (N,) of the returns in the world, side by side.

    Speeds are NaN where the radar gives none; None where it is not known where it was.
    """
    time_ns, points = frame.timestamp_ns, frame.points
    pose = location.at(np.array([time_ns], np.int64))
    around = own.at(np.array([time_ns - _STEP_NS, time_ns, time_ns + _STEP_NS], np.int64)).positions
    if not (np.isfinite(pose.positions).all() and np.isfinite(around[1]).all()):
        return None
    ends = [k for k in range(3) if np.isfinite(around[k]).all()]
    if len(ends) < 2:
        return None
    velocity = (around[ends[-1]] - around[ends[0]]) / ((ends[-1] - ends[0]) * _STEP_NS * 1e-9)
    rotation = pose.quaternions_xyzw[0]
    locations = rotate_vectors(rotation, points.positions.astype(np.float64)) + pose.positions[0]
    if points.directions is None or points.lengths is None:
        return np.column_stack([locations, np.full((len(locations), 4), np.nan)])
    lines = rotate_vectors(rotation, points.directions.astype(np.float64))
    return np.column_stack([locations, lines, points.lengths + lines @ velocity])


def _listen(heard: _Heard, track: Track, time_ns: int, returns: Float64Array) -> None:
    """Take the returns that come from a track's object."""
    state = _state_at(track, time_ns)
    center, size, yaw, velocity = state[:3], state[3:6], state[6], state[7:]
    apart = returns[:, :3] - center
    cos, sin = np.cos(yaw), np.sin(yaw)
    along = np.column_stack(
        [cos * apart[:, 0] + sin * apart[:, 1], cos * apart[:, 1] - sin * apart[:, 0], apart[:, 2]]
    )
    inside = returns[(np.abs(along) <= size / 2.0 + _MARGIN).all(axis=1)]
    if len(inside) == 0:
        return
    expected = inside[:, 3:6] @ velocity
    heard.times_ns.append(time_ns)
    heard.counts.append(len(inside))
    heard.speeds.append(float(np.median(inside[:, 6])))
    heard.misfits.append(float(np.median(inside[:, 6] - expected)))


def _state_at(track: Track, time_ns: int) -> Float64Array:
    """Centre, size, heading and velocity (10,) between the states before and after a time."""
    times: Int64Array = track.timestamps_ns
    after = min(max(int(np.searchsorted(times, time_ns)), 1), len(times) - 1) if len(times) > 1 else 0
    before = max(after - 1, 0)
    share = 0.0 if after == before else (time_ns - times[before]) / (times[after] - times[before])
    yaws = np.unwrap(track.yaws[[before, after]])
    rows = [
        np.concatenate([track.centers[k], track.sizes_lwh[k], [yaw], track.velocities[k]])
        for k, yaw in ((before, yaws[0]), (after, yaws[1]))
    ]
    state: Float64Array = rows[0] + share * (rows[1] - rows[0])
    return state
