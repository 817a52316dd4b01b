"""Labels from tracks: object paths, smoothed sizes and flags for review.

A return has its location, the line of sight d that leads to it, and the speed s along it against the radar itself. With
the radar's own velocity v the object's speed over ground along the same line is s + d · v, which is compared with
d · u of the track's velocity u.

Each object gets an `object` annotation, to which its cuboid and the detector's boxes in images belong; riders are
linked with what they ride. A cuboid has the fewest keyframes whose interpolation, as readers of `.sfs` do it, keeps
within tolerances; what is stationary has one, and holds at all times. What looks wrong is reported in the attribute
`review` and, the worst first, in the scene's metadata.
"""

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from math import degrees, pi, radians
from typing import Any

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.colouring.cuboid_projection import (
    PointCounts,
    count_points,
    project_cuboids,
    with_activations,
    with_counts,
)
from sceneloom.detections.detectors import kind_name
from sceneloom.editing.references import with_ours, with_warnings
from sceneloom.errors import CalibrationError, PoseError
from sceneloom.geometry.rigid import rotate_vectors
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.signatures import inlined, part
from sceneloom.scene.annotations import (
    Annotation,
    AttributePath,
    Box2DAnnotation,
    BoxPath,
    CuboidAnnotation,
    CuboidPath,
    LinkAnnotation,
    ObjectAnnotation,
)
from sceneloom.scene.annotations_at import CuboidAngles, annotations_frame, not_in_world
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import RadarFrame, RadarSensor
from sceneloom.scene.detections import Support, Track, Tracks
from sceneloom.scene.ego import EgoMotion, points_source, sensor_source
from sceneloom.scene.poses import PoseSource
from sceneloom.scene.samples import WORLD, choose_ego
from sceneloom.scene.scene import Scene, scene_period_ns, usual_period_ns
from sceneloom.scene.types import Coordinates, Identifier, Key, key_of
from sceneloom.tracking.settings import LabelSettings
from sceneloom.tracking.tracker import wrapped
from sceneloom.version import __version__
from sceneloom.warnings import DataWarning, skipped

_BOXED = (Support.BOTH, Support.SWEEP, Support.IMAGE)  # states that rest on a box of a detector

_MEASURED = (Support.BOTH, Support.SWEEP)

_ROUNDING = 1e-9
"""Tolerances are kept this share smaller, so that another order of the same sums does not break the promise."""

_MOST_UNSURE = 0.6  # however little is known of a speed, what gets on faster does not stand [m/s]
_LEAST_VARIANCE = 1e-6  # no variance counts as less than this [m²]


@dataclass(frozen=True, slots=True, eq=False)
class _LabelPath:
    """An object over time as it is to be labelled, from the first to the last state that rests on a box."""

    timestamps_ns: Int64Array  # (K,) [ns]
    boxes: Float64Array  # (K, 7), centre and size [m] and heading [rad], which goes on beyond half rotations
    stands: bool

    def keyframes(self, settings: LabelSettings) -> Int64Array:
        """Which states are keyframes: the fewest that give the others within the tolerances; one of what stands."""
        if self.stands:
            return np.zeros(1, np.int64)
        keep = 1.0 - _ROUNDING
        return _fewest_keyframes(
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
    boxed = np.flatnonzero(_boxed(track))
    if len(boxed) == 0:
        return None
    rows = slice(int(boxed[0]), int(boxed[-1]) + 1)
    names = ("timestamps_ns", "centers", "sizes_lwh", "yaws", "velocities", "yaw_rates", "covariances", "scores")
    corners = {camera_id: boxes[rows] for camera_id, boxes in track.corners_xyxy.items()}
    kept = {name: getattr(track, name)[rows] for name in (*names, "supports")}
    return replace(track, corners_xyxy=corners, **kept)


def _boxed(track: Track) -> BoolArray:
    """Which states rest on a box, (K,) bool."""
    return np.isin(track.supports, _BOXED)


def label_path(track: Track, settings: LabelSettings) -> _LabelPath:
    """An object over time as it is to be labelled, from its first box to its last."""
    yaws = np.unwrap(track.yaws)
    boxes = np.column_stack([track.centers, track.sizes_lwh, yaws])
    weights = _weights(track)
    if settings.constant_sizes:
        boxes[:, 3:6] = weighted_medians(track.sizes_lwh, weights[:, 3:6])
    if not (settings.stationary and _stands(track, settings)):
        return _LabelPath(track.timestamps_ns, boxes, stands=False)
    boxes[:, :3] = weighted_medians(track.centers, weights[:, :3])
    boxes[:, 3:6] = weighted_medians(track.sizes_lwh, weights[:, 3:6])
    boxes[:, 6] = usual_heading(yaws, weights[:, 6])
    return _LabelPath(track.timestamps_ns, boxes, stands=True)


def _stands(track: Track, settings: LabelSettings) -> bool:
    """Report whether an object is stationary: never far from its usual location, and not getting on from there."""
    # it may get on as fast as the settings state, or as its speed is uncertain by one deviation
    rows = np.flatnonzero(np.isin(track.supports, _MEASURED))
    if len(rows) < 2:
        return False
    locations, times = track.centers[rows, :2], (track.timestamps_ns[rows] - track.timestamps_ns[rows[0]]) * 1e-9
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
    """Its heading flips from one state to the next."""
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

_BELOW = (FlagKind.SHORT, FlagKind.UNSURE)  # what is flagged below its limit; all else above it
_DRIVES = 2.0  # what is slower has a heading of its own [m/s]
_MIDDLING = 0.8  # jitter is what this share of the states do not exceed: a single jump is flagged as such


@dataclass(frozen=True, slots=True)
class _Flag:
    """One thing to look at."""

    track: int
    kind: FlagKind
    timestamp_ns: int  # where it is worst
    value: float

    @property
    def urgency(self) -> float:
        """How many times beyond its limit it is, from 1 on."""
        limit, value = max(_LIMITS[self.kind], 1e-3), max(self.value, 1e-3)
        return limit / value if self.kind in _BELOW else value / limit


def _flag(track: Track, kind: FlagKind, value: float, row: int) -> Iterator[_Flag]:
    """Give a flag if a value is beyond the limit of its kind."""
    beyond = value < _LIMITS[kind] if kind in _BELOW else value > _LIMITS[kind]
    if beyond:
        yield _Flag(track.id, kind, int(track.timestamps_ns[row]), round(float(value), 3))


def flags_of(track: Track) -> list[_Flag]:
    """Look at one track: from its first box to its last."""
    rows = np.flatnonzero(_boxed(track))
    gaps = np.diff(rows)
    k = int(gaps.argmax()) if len(gaps) else 0
    middle = int(rows[k] + rows[k + 1]) // 2 if len(gaps) else 0  # of the longest time without a box
    changes = np.abs(track.sizes_lwh / np.median(track.sizes_lwh, axis=0) - 1.0).max(axis=1)
    guessed = not np.isin(track.supports, _MEASURED).any()
    return [
        *_flag(track, FlagKind.SHORT, len(rows), 0),
        *_flag(track, FlagKind.UNSURE, float(track.scores.max()), int(track.scores.argmax())),
        *_flag(track, FlagKind.SPARSE, 1.0 - len(rows) / len(track), middle),
        *(_flag(track, FlagKind.IMAGE_ONLY, 1.0, 0) if guessed else ()),
        *_flag(track, FlagKind.SIZE, float(changes.max()), int(changes.argmax())),
        *_of_motion(track),
        *_of_heading(track),
    ]


def _of_motion(track: Track) -> Iterator[_Flag]:
    if len(track) < 3:
        return
    bends = np.linalg.norm(_off_lines(track, track.centers[:, :2]), axis=1)
    yield from _flag(track, FlagKind.JITTER, float(np.quantile(bends, _MIDDLING)), int(bends.argmax()) + 1)
    seconds = np.diff(track.timestamps_ns) * 1e-9
    speeds = (track.velocities[1:, :2] + track.velocities[:-1, :2]) / 2.0
    jumps = np.linalg.norm(np.diff(track.centers[:, :2], axis=0) - speeds * seconds[:, None], axis=1)
    yield from _flag(track, FlagKind.JUMP, float(jumps.max()), int(jumps.argmax()) + 1)


def _of_heading(track: Track) -> Iterator[_Flag]:
    rotations = np.abs(wrapped(np.diff(track.yaws)))
    if len(rotations):
        yield from _flag(track, FlagKind.YAW_FLIP, float(rotations.max()), int(rotations.argmax()) + 1)
    if len(rotations) > 1 and rotations.max() <= _LIMITS[FlagKind.YAW_FLIP]:
        bends = np.abs(_off_lines(track, np.unwrap(track.yaws)[:, None])[:, 0])
        yield from _flag(track, FlagKind.YAW_JITTER, float(np.quantile(bends, _MIDDLING)), int(bends.argmax()) + 1)
    driving = np.flatnonzero(np.linalg.norm(track.velocities[:, :2], axis=1) > _DRIVES)
    if len(driving):
        courses = np.arctan2(track.velocities[driving, 1], track.velocities[driving, 0])
        off = np.abs(wrapped(courses - track.yaws[driving]))
        yield from _flag(track, FlagKind.AGAINST_MOTION, float(np.median(off)), int(driving[off.argmax()]))


def _off_lines(track: Track, values: Float64Array) -> Float64Array:
    """How far each state but the first and the last is from the line between its neighbours, (K - 2, C)."""
    times = track.timestamps_ns.astype(np.float64)
    shares = (times[1:-1] - times[:-2]) / (times[2:] - times[:-2])
    off: Float64Array = values[:-2] + shares[:, None] * (values[2:] - values[:-2]) - values[1:-1]
    return off


def overlap_flags(tracks: Iterable[Track], together: Collection[frozenset[int]] = ()) -> list[_Flag]:
    """Find objects that are in the same location at the same time: the less sure one of each two is flagged.

    Those whose numbers are `together`, such as a rider and what he rides, may be.
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
    return [one for n, (share, row) in worst.items() for one in _flag(kept[n], FlagKind.OVERLAP, share, row)]


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

_MARGIN = np.array([0.4, 0.4, 2.0])  # a return so near outside a box is of it [m]: radars report the height badly
_STEP_NS = 20_000_000  # the radar's own velocity is that of so long before to so long after [ns]


@dataclass(slots=True)
class _Heard:
    """What one radar heard of one object: by frame the time, the count, and measured less expected speed."""

    times_ns: list[int] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)
    speeds: list[float] = field(default_factory=list)
    misfits: list[float] = field(default_factory=list)


_Attributes = Mapping[int, Sequence[AttributePath]]  # by number of the track


def _heard(scene: Scene, radar: RadarSensor, tracks: Sequence[Track], ego: EgoMotion | None) -> dict[int, _Heard]:
    """What a radar heard of tracks in the world, by their place in the list."""
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


def _ask_radars(scene: Scene, tracks: Sequence[Track], ego: EgoMotion | None) -> tuple[_Attributes, list[_Flag]]:
    """What the radars of a scene state of tracks, and those whose speed they contradict."""
    attributes: dict[int, list[AttributePath]] = {}
    flags: list[_Flag] = []
    for radar in scene.sensors:
        if not isinstance(radar, RadarSensor):
            continue
        for number, heard in _heard(scene, radar, tracks, ego).items():
            track, times = tracks[number], np.array(heard.times_ns, np.int64)
            reported = attributes.setdefault(track.id, [])
            reported.append(AttributePath(_RETURNS, tuple(heard.counts), times, sensor_id=radar.id))
            timed = np.flatnonzero(np.isfinite(heard.speeds))
            if len(timed):
                speeds = tuple(round(heard.speeds[k], 2) for k in timed.tolist())
                reported.append(AttributePath(_RADIAL_VELOCITY, speeds, times[timed], sensor_id=radar.id))
            misfits = np.abs(heard.misfits)
            sound = np.flatnonzero(np.isfinite(misfits))
            if len(sound) >= 3:  # fewer frames with returns do not contradict a track
                worst_ns = heard.times_ns[int(sound[misfits[sound].argmax()])]
                row = int(np.abs(track.timestamps_ns - worst_ns).argmin())
                flags += _flag(track, FlagKind.RADAR, float(np.median(misfits[sound])), row)
    return attributes, flags


def _returns(frame: RadarFrame, location: PoseSource, own: PoseSource) -> Float64Array | None:
    """Locations (N, 3), lines of sight (N, 3) and speeds (N,) over ground of returns, world; None: nowhere known."""
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
    along = np.column_stack([cos * apart[:, 0] + sin * apart[:, 1], cos * apart[:, 1] - sin * apart[:, 0], apart[:, 2]])
    inside = returns[(np.abs(along) <= size / 2.0 + _MARGIN).all(axis=1)]
    if len(inside) == 0:
        return
    known = inside[np.isfinite(inside[:, 3:]).all(axis=1)]
    apart = known[:, 6] - known[:, 3:6] @ velocity
    heard.times_ns.append(time_ns)
    heard.counts.append(len(inside))
    heard.speeds.append(float(np.median(known[:, 6])) if len(known) else math.nan)
    heard.misfits.append(float(np.median(apart)) if len(known) else math.nan)


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


_EXISTENCE, _SUPPORT, _SPEED, _POSITION_SIGMA = "existence", "support", "speed", "position_sigma"
"""Names of the attributes that hold over time: probability, a word of `Support`, [m/s], [m]."""

_TRACK, _SOURCE, _REVIEW = "track", "source", "review"
"""Names of those that hold at all times: number of the track, where it comes from, what to look at first."""

_STEPS = {_EXISTENCE: 0.05, _SPEED: 0.5, _POSITION_SIGMA: 0.1}  # a value holds until the true one is so far from it


def _attributes_of(track: Track, source: str, flags: Sequence[str]) -> tuple[AttributePath, ...]:
    """Report of an object what its track knows; what holds over time is reported only where it changes."""
    times, covariances = track.timestamps_ns, track.covariances
    level = np.trace(covariances[:, :2, :2], axis1=1, axis2=2) / 2.0
    numbers = {
        _EXISTENCE: track.scores,
        _SPEED: np.linalg.norm(track.velocities[:, :2], axis=1),
        _POSITION_SIGMA: np.sqrt(np.maximum(level, 0.0)),
    }
    timed = [_stepped(name, times, values, _STEPS[name]) for name, values in numbers.items()]
    words = [Support(k).name.lower() for k in track.supports.tolist()]
    changes = [k for k, word in enumerate(words) if k == 0 or words[k - 1] != word]
    timed.append(AttributePath(_SUPPORT, tuple(words[k] for k in changes), times[changes]))
    still: dict[str, Any] = {_TRACK: track.id, _SOURCE: source}
    if flags:
        still[_REVIEW] = tuple(flags)
    # the timestamp of what holds at all times is for readers that expect one
    return (*timed, *(AttributePath(name, (value,), times[:1], static=True) for name, value in still.items()))


def _stepped(name: str, times_ns: Int64Array, values: Float64Array, step: float) -> AttributePath:
    kept: list[int] = []
    for k, value in enumerate(values.tolist()):
        if not kept or abs(value - values[kept[-1]]) >= step:
            kept.append(k)
    return AttributePath(name, tuple(round(float(values[k]), 3) for k in kept), times_ns[kept])


_RIDDEN = frozenset({"bicycle", "bike", "motorcycle", "motorbike", "scooter", "moped", "cyclist", "motorcyclist"})

_NEAR = 0.8  # a rider's middle is no farther than this from that of what he rides, seen from above [m]

_LEAST_STATES = 3

_SHARE = 0.7  # of the time that both are there, so much they are together


def _letters(label: str) -> str:
    return "".join(letter for letter in label.casefold() if letter.isalnum())


def _is_person(label: str) -> bool:
    return _letters(label) == "rider" or (kind_name(label) == "pedestrian" and _letters(label) not in _RIDDEN)


def riders(tracks: Iterable[Track]) -> Iterator[tuple[Track, Track]]:
    """Give each rider with what he rides; each of both once, the nearest pairs first.

    Words for a rider and what he rides together, such as "cyclist", count as what is ridden: a detector that says so
    has one box for both, and a person beside it is somebody who is there, too.
    """
    kept = list(tracks)
    people = [track for track in kept if _is_person(track.label)]
    ridden = [track for track in kept if _letters(track.label) in _RIDDEN]
    pairs = [
        (distance, person, bike)
        for person in people
        for bike in ridden
        if (distance := _together(person, bike)) is not None
    ]
    taken: set[int] = set()
    for _, person, bike in sorted(pairs, key=lambda pair: (pair[0], pair[1].id, pair[2].id)):
        if not {person.id, bike.id} & taken:
            taken |= {person.id, bike.id}
            yield person, bike


def _together(person: Track, bike: Track) -> float | None:
    """How near two usually are [m]; None if they are not together."""
    _, mine, its = np.intersect1d(person.timestamps_ns, bike.timestamps_ns, return_indices=True)
    if len(mine) < _LEAST_STATES:
        return None
    apart = np.linalg.norm(person.centers[mine, :2] - bike.centers[its, :2], axis=1)
    return float(np.median(apart)) if float((apart < _NEAR).mean()) >= _SHARE else None


def _boxes_in_images(
    scene: Scene, track: Track, parent_id: Identifier, stem: str, *, longest_gap_ns: int
) -> Iterator[Box2DAnnotation]:
    """The detector's boxes of an object, by camera, at its images' times; after longer gaps a new annotation begins."""
    cameras: dict[Key, CameraSensor] = {key_of(camera.id): camera for camera in scene.cameras}
    for camera_id, corners in track.corners_xyxy.items():
        rows = np.flatnonzero(np.isfinite(corners).all(axis=1) & (corners[:, 2:] > corners[:, :2]).all(axis=1))
        if len(rows) == 0 or key_of(camera_id) not in cameras:
            continue
        times, chosen = _at_images(cameras[key_of(camera_id)], track.timestamps_ns[rows])
        breaks = np.flatnonzero(np.diff(times) > longest_gap_ns) + 1
        for part, own in enumerate(np.split(np.arange(len(times)), breaks)):
            name = f"{stem}-{camera_id}" + (f"-{part + 1}" if len(breaks) else "")
            edges = np.round(corners[rows[chosen[own]]], 2)
            path = BoxPath(times[own], np.column_stack([edges[:, :2], edges[:, 2:] - edges[:, :2]]))
            yield Box2DAnnotation(name, camera_id, path, label=track.label, parent_id=parent_id)


def _at_images(camera: CameraSensor, times_ns: Int64Array) -> tuple[Int64Array, Int64Array]:
    """The times of the images nearest to some times, each once, and which of these they are nearest to."""
    timestamps = camera.images.timestamps_ns
    if len(timestamps) == 0:
        return times_ns, np.arange(len(times_ns))
    after = np.clip(np.searchsorted(timestamps, times_ns), 1, max(len(timestamps) - 1, 1))
    after = np.minimum(after, len(timestamps) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(times_ns - timestamps[before] <= timestamps[after] - times_ns, before, after)
    away = np.abs(timestamps[nearest] - times_ns)
    near = np.flatnonzero(away <= max(usual_period_ns(timestamps), 1))
    found, first = np.unique(timestamps[nearest[near]], return_index=True)
    return found, near[first]


DEFAULTS = LabelSettings()

LABELS = "labels"
"""Name of our entry in a scene's metadata that says how labels were made and what to look at first."""


@dataclass(frozen=True, slots=True, eq=False)
class Labelled:
    """A scene with labels.

    Attributes:
        scene: with annotations of the objects behind those that it had.
        flags: what a person should look at, the most urgent first.
        objects, stationary: how many objects are labelled, and how many of them are stationary.
        states, keyframes: how many states their tracks have, and how many keyframes report them.
    """

    scene: Scene
    flags: tuple[_Flag, ...]
    objects: int
    stationary: int
    states: int
    keyframes: int


def label_tracks(
    scene: Scene, tracks: Tracks, *, settings: LabelSettings = DEFAULTS, trajectory: str | EgoMotion | None = None
) -> Labelled:
    """Turn tracks into annotations of a scene, with what its sensors state of them.

    What a scene lacks is left out with a warning: projections without known poses of cameras, points without those of
    lidars, speeds without those of radars.

    Args:
        scene: whose world the tracks are in; one without sensors is enough.
        trajectory: name of the ego trajectory, as for `Scene.samples`.

    Raises:
        OptionError: there is no such trajectory, the scene's annotations are in the ego's frame, or one of them has the
            id of a label.
        DataError: a sensor's frame cannot be read.
    """
    if scene.annotations and annotations_frame(scene) is not Coordinates.WORLD:
        raise not_in_world(scene.source)
    kept = [
        part
        for track in tracks
        if (part := boxed_part(track))
        and int(_boxed(part).sum()) >= settings.least_states
        and float(part.scores.max()) >= settings.least_score
    ]
    ego, warnings, angles = choose_ego(scene, trajectory), list[DataWarning](), CuboidAngles.of(scene)
    pairs = list(riders(kept)) if settings.links else []
    paths = [label_path(track, settings) for track in kept]
    cuboids = [
        CuboidAnnotation(
            cuboid_id(track),
            path.cuboids(path.keyframes(settings), angles),
            label=track.label,
            stationary=path.stands,
            parent_id=object_id(track),
        )
        for track, path in zip(kept, paths, strict=True)
    ]
    seen, counts = _seen_by_sensors(replace(scene, annotations=tuple(cuboids)), settings, ego, warnings)
    heard: _Attributes = {}
    flags = [flag for track in kept for flag in flags_of(track)]
    flags += overlap_flags(kept, {frozenset((person.id, bike.id)) for person, bike in pairs})
    if settings.radar:
        try:
            heard, contradicted = _ask_radars(scene, kept, ego)
            flags += contradicted
        except PoseError as error:
            warnings.append(skipped("labels-not-heard", "annotations", f"radars were not asked: {error}"))
    flags += _empty(kept, counts)
    flags.sort(key=lambda flag: (-flag.urgency, flag.track, flag.kind))
    made: list[Annotation] = []
    for track, cuboid in zip(kept, seen, strict=True):
        reported = _attributes_of(track, settings.source, [str(flag.kind) for flag in flags if flag.track == track.id])
        attributes = (*reported, *heard.get(track.id, ()), *cuboid.attributes)
        made += [ObjectAnnotation(object_id(track), label=track.label), replace(cuboid, attributes=attributes)]
        if settings.boxes_2d:
            gap_ns = round(settings.longest_gap * 1e9)
            made += _boxes_in_images(scene, track, object_id(track), f"box-{track.id}", longest_gap_ns=gap_ns)
    for person, bike in pairs:
        ids = cuboid_id(person), cuboid_id(bike)
        made.append(LinkAnnotation(f"link-{person.id}-{bike.id}", *ids, label="rides", is_bidirectional=False))
    labelled = replace(scene, annotations=(*scene.annotations, *made))
    entries = {
        "euler_unit": str(angles.unit),
        "euler_order": str(angles.order),
        LABELS: {
            "made_by": f"sceneloom {__version__}",
            "source": settings.source,
            "objects": len(kept),
            "tolerance_m": settings.tolerance_m,
            "tolerance_deg": settings.tolerance_deg,
            "constant_sizes": settings.constant_sizes,
            "review": [
                {
                    "annotation": f"cuboid-{flag.track}",
                    "flag": str(flag.kind),
                    "timestamp_ns": flag.timestamp_ns,
                    "value": flag.value,
                    "urgency": round(flag.urgency, 2),
                }
                for flag in flags
            ],
        },
    }
    return Labelled(
        with_warnings(with_ours(labelled, **entries), warnings),
        tuple(flags),
        len(kept),
        sum(path.stands for path in paths),
        sum(len(track) for track in kept),
        sum(len(cuboid.path.timestamps_ns) for cuboid in cuboids),
    )


def object_id(track: Track) -> str:
    """The id of the annotation of a track's object."""
    return f"object-{track.id}"


def cuboid_id(track: Track) -> str:
    """The id of the cuboid of a track's object."""
    return f"cuboid-{track.id}"


def _seen_by_sensors(
    scene: Scene, settings: LabelSettings, ego: EgoMotion | None, warnings: list[DataWarning]
) -> tuple[list[CuboidAnnotation], PointCounts | None]:
    """The cuboids of a scene with what its cameras and lidars state of them, and the points in them."""
    counts = None
    if settings.projections and any(len(camera.images) for camera in scene.cameras):
        try:
            known = len(scene.warnings)
            scene = project_cuboids(scene, trajectory=ego, activations=True)
            warnings += scene.warnings[known:]
        except (PoseError, CalibrationError) as error:
            warnings.append(skipped("labels-not-projected", "annotations", f"cuboids are in no image: {error}"))
    if settings.points and scene.lidars:
        try:
            counts = count_points(scene, moment="points", trajectory=ego, activations=False)
            scene = with_activations(with_counts(scene, counts), counts)
        except PoseError as error:
            warnings.append(skipped("labels-not-counted", "annotations", f"points were not counted: {error}"))
    return [each for each in scene.annotations if isinstance(each, CuboidAnnotation)], counts


def _empty(tracks: Sequence[Track], counts: PointCounts | None) -> list[_Flag]:
    """Flag objects without points in sweeps that have a box of them."""
    if counts is None:
        return []
    found: list[_Flag] = []
    for number, track in enumerate(tracks):
        rows = np.flatnonzero(np.isin(track.supports, (Support.BOTH, Support.SWEEP)))
        points, known = np.zeros(len(rows), np.int64), np.zeros(len(rows), np.bool_)
        for lidar in counts.lidars:
            if not len(lidar.timestamps_ns):
                continue
            frames = np.searchsorted(lidar.timestamps_ns, track.timestamps_ns[rows], side="right") - 1
            there = (frames >= 0) & lidar.there[frames, number]
            points += np.where(there, lidar.counts[frames, number], 0)
            known |= there
        rows, points = rows[known], points[known]
        if len(rows):
            found += _flag(track, FlagKind.EMPTY, float((points == 0).mean()), int(rows[points.argmin()]))
    return found


_NEAR_HALF_ROTATION = math.radians(179.0)  # beyond this, rounding decides which way round is shorter [rad]


@inlined
def _shortest(angle):  # type: ignore[no-untyped-def]
    """The same rotation, from -π to π [rad]."""
    return angle - 2.0 * math.pi * math.floor(angle / (2.0 * math.pi) + 0.5)


@part
def _gives_between(times, boxes, location, turn, a, b):  # type: ignore[no-untyped-def]
    """Whether two keyframes give all rows between them: centre and size linearly, the heading the shorter way round."""
    if b == a + 1:
        return True
    rotated = _shortest(boxes[b, 6] - boxes[a, 6])
    if abs(rotated) > _NEAR_HALF_ROTATION:
        return False
    for k in range(a + 1, b):
        share = (times[k] - times[a]) / (times[b] - times[a])
        away = larger = 0.0
        for c in range(3):
            away += (boxes[a, c] + share * (boxes[b, c] - boxes[a, c]) - boxes[k, c]) ** 2
            larger += (boxes[a, c + 3] + share * (boxes[b, c + 3] - boxes[a, c + 3]) - boxes[k, c + 3]) ** 2
        apart = abs(_shortest(boxes[a, 6] + share * rotated - boxes[k, 6]))
        if not (away <= location * location and larger <= location * location and apart <= turn):
            return False
    return True


@kernel("int64[::1](int64[::1], float64[:,::1], float64, float64)")
def _fewest_keyframes(times: Int64Array, boxes: Float64Array, location: float, turn: float) -> Int64Array:
    """Choose the fewest rows of a box over time from which interpolation gives all others within tolerances.

    The rows are joined wherever two of them report all between them, and the path of the fewest joints from the
    first to the last is taken: a search in breadth, which looks at the farthest row first.

    `times` (K,) int64, rising; `boxes` (K, 7), centre and size [m] and heading [rad]; `location`: largest distance of
    centres, and of sizes as vectors [m]; `turn`: largest difference of headings [rad]. Returns (N,) int64, rising, the
    first and the last row among them.

    Source: Imai and Iri 1988, "Polygonal approximations of a curve", which the shortest path over such joints is.
    """
    count = len(times)
    if count < 3:
        return np.arange(count)
    before, queue = np.full(count, -1), np.zeros(count, np.int64)
    head, tail = 0, 1
    while head < tail and before[count - 1] < 0:
        a = queue[head]
        head += 1
        for b in range(count - 1, a, -1):
            if before[b] < 0 and _gives_between(times, boxes, location, turn, a, b):
                before[b], queue[tail] = a, b
                tail += 1
    kept, row = np.empty(count, np.int64), count - 1
    found = 0
    while row > 0:
        kept[found] = row
        found, row = found + 1, before[row]
    kept[found] = 0
    return kept[: found + 1][::-1].copy()
