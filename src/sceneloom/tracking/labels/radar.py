"""What radars state of labelled objects: how many of their returns come from each, and how fast it comes nearer.

A return has its location, the line of sight d that leads to it, and the speed s along it against the radar itself. With
the radar's own velocity v the object's speed over ground along the same line is s + d · v, which is compared with
d · u of the track's velocity u.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.geometry.rotations import rotate_vectors
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.clouds import RadarFrame, RadarSensor
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.sample_positions import WORLD
from sceneloom.scene.scene import Scene
from sceneloom.scene.sensor_sources import points_source, sensor_source
from sceneloom.scene.span import scene_period_ns
from sceneloom.scene.tracks import Track
from sceneloom.scene.types import Identifier
from sceneloom.tracking.labels.quality import Flag, FlagKind, flag

RETURNS, RADIAL_VELOCITY = "radar_returns", "radial_velocity"
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
    reported = [AttributePath(RETURNS, tuple(heard.counts), times, sensor_id=radar_id)]
    if len(timed):
        speeds = tuple(round(heard.speeds[k], _DECIMALS) for k in timed.tolist())
        reported.append(AttributePath(RADIAL_VELOCITY, speeds, times[timed], sensor_id=radar_id))
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
