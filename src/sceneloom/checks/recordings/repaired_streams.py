"""Fixes of streams of numbers: samples that stand there twice, orientations that are not of length 1."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array, read_only
from sceneloom.checks.reordering import chosen_frames
from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import Subject
from sceneloom.geometry.rotations import normalise_quaternion
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.findings import Severity
from sceneloom.scene.motion import GnssSensor, ImuSensor, VectorSamples
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene, Sensor

NORM_TOLERANCE = 1e-3
"""Lengths of quaternions that are off by no more [1] are rounding."""


def without_repetitions(scene: Scene) -> Scene:
    """Leave out samples, fixes and images that state the same as the one before at the same time."""
    sensors = tuple(map(_reported_once, scene.sensors))
    if any(new is not old for new, old in zip(sensors, scene.sensors, strict=True)):
        scene = replace(scene, sensors=sensors)
    return _without_kept_poses(scene)


def _without_kept_poses(scene: Scene) -> Scene:
    """Leave out lines that are kept as text and state a pose once more that a trajectory has."""
    kept = scene.metadata.get("recording")
    texts = kept.get("other_lines") if isinstance(kept, Mapping) else None
    if not isinstance(kept, Mapping) or not isinstance(texts, list):
        return scene
    origins = kept.get("trajectory_origins", {})
    known = {
        tuple(origins.get(name, (name, name))): trajectory for name, trajectory in scene.trajectories.items()
    }
    stay = [k for k, text in enumerate(texts) if not _is_known_pose(text, known)]
    if len(stay) == len(texts):
        return scene
    seconds = kept.get("other_seconds", {})
    anchors = {str(new): seconds[str(old)] for new, old in enumerate(stay) if str(old) in seconds}
    rest = {**kept, "other_lines": [texts[k] for k in stay], "other_seconds": anchors}
    return replace(scene, metadata=MappingProxyType({**scene.metadata, "recording": MappingProxyType(rest)}))


def _is_known_pose(text: str, known: Mapping[tuple[str, ...], Trajectory]) -> bool:
    """Whether a line says nothing but a pose that its trajectory has at that time."""
    try:
        line = msgspec.json.decode(text, type=dict[str, Any])
        seconds = float(line.pop("time"))
        (root, pose), *others = line.items()
    except (msgspec.MsgspecError, KeyError, TypeError, ValueError):
        return False
    trajectory = known.get((root, pose.get("name", root))) if isinstance(pose, dict) and not others else None
    if trajectory is None or not set(pose) <= {"name", "position", "orientation"}:
        return False
    row = int(np.searchsorted(trajectory.timestamps_ns, round(seconds * 1e9)))
    if row == len(trajectory.timestamps_ns) or trajectory.timestamps_ns[row] != round(seconds * 1e9):
        return False
    rotation = None if trajectory.quaternions_xyzw is None else trajectory.quaternions_xyzw[row]
    wanted = dict(zip("xyz", trajectory.positions[row].tolist(), strict=True))
    orientation = None if rotation is None else dict(zip("xyzw", rotation.tolist(), strict=True))
    return bool(pose.get("position") == wanted and pose.get("orientation") == orientation)


def _reported_once(sensor: Sensor) -> Sensor:
    if isinstance(sensor, ImuSensor):
        streams = {name: _samples_once(samples) for name, samples in sensor.streams.items()}
        if all(streams[name] is samples for name, samples in sensor.streams.items()):
            return sensor
        return replace(sensor, streams=MappingProxyType(streams))
    if isinstance(sensor, CameraSensor):
        return _images_once(sensor)
    return _fixes_once(sensor) if isinstance(sensor, GnssSensor) else sensor


def _images_once(camera: CameraSensor) -> CameraSensor:
    """Of entries that mean one image of a video, keep the first."""
    video = camera.video
    if video is None or video.frame_indices is None:
        return camera
    indices = np.array(video.frame_indices, np.float64)[:, None]
    kept = np.flatnonzero(_first_of_equals(camera.images.timestamps_ns, indices))
    if len(kept) == len(indices):
        return camera
    chosen = tuple(video.frame_indices[k] for k in kept.tolist())
    images = chosen_frames(camera.images, kept.astype(np.int64))
    return replace(camera, images=images, video=replace(video, frame_indices=chosen))


def _samples_once(samples: VectorSamples) -> VectorSamples:
    kept = _first_of_equals(samples.timestamps_ns, samples.values)
    if kept.all():
        return samples
    seconds = None if samples.file_seconds is None else read_only(samples.file_seconds[kept])
    return VectorSamples(read_only(samples.timestamps_ns[kept]), read_only(samples.values[kept]), seconds)


def _fixes_once(sensor: GnssSensor) -> GnssSensor:
    values = np.column_stack([sensor.positions_lla, sensor.accuracies, sensor.vertical_accuracies])
    kept = _first_of_equals(sensor.timestamps_ns, values)
    if kept.all():
        return sensor
    return replace(
        sensor,
        timestamps_ns=read_only(sensor.timestamps_ns[kept]),
        positions_lla=read_only(sensor.positions_lla[kept]),
        accuracies=read_only(sensor.accuracies[kept]),
        vertical_accuracies=read_only(sensor.vertical_accuracies[kept]),
        file_seconds=None if sensor.file_seconds is None else read_only(sensor.file_seconds[kept]),
    )


def _first_of_equals(timestamps_ns: Int64Array, values: Float64Array) -> BoolArray:
    """Which rows differ from the one before in time or value, (N,) bool."""
    kept = np.ones(len(timestamps_ns), np.bool_)
    alike = (values[1:] == values[:-1]) | (np.isnan(values[1:]) & np.isnan(values[:-1]))
    kept[1:] = (np.diff(timestamps_ns) != 0) | ~alike.all(axis=1)
    return kept


def _lengths(subject: Subject) -> Iterator[Hit]:
    if subject.recording is None:
        return
    for name, trajectory in subject.scene.trajectories.items():
        if trajectory.quaternions_xyzw is not None:
            errors = _norm_errors(trajectory.quaternions_xyzw)
            off = np.flatnonzero(errors > NORM_TOLERANCE)
            if len(off):
                worst = int(errors.argmax())
                length = float(np.linalg.norm(trajectory.quaternions_xyzw[worst]))
                reported = (
                    f"{len(off)} of {len(errors)} orientations are not of length 1, the worst {length:.5f}"
                )
                yield Hit(
                    f"trajectories[{name}]",
                    f"{reported} at {trajectory.timestamps_ns[worst] / 1e9:.6f} s",
                    len(off),
                )


def _norm_errors(quaternions_xyzw: Float64Array) -> Float64Array:
    errors: Float64Array = np.abs(np.linalg.norm(quaternions_xyzw, axis=1) - 1.0)
    return errors


def with_unit_orientations(scene: Scene) -> Scene:
    """Scale orientations to length 1 that are off by more than rounding; the others stay as they are."""
    trajectories = {
        name: _with_unit_orientations(trajectory) for name, trajectory in scene.trajectories.items()
    }
    if all(trajectories[name] is trajectory for name, trajectory in scene.trajectories.items()):
        return scene
    return replace(scene, trajectories=MappingProxyType(trajectories))


def _with_unit_orientations(trajectory: Trajectory) -> Trajectory:
    quaternions = trajectory.quaternions_xyzw
    if quaternions is None:
        return trajectory
    off = _norm_errors(quaternions) > NORM_TOLERANCE
    if not off.any():
        return trajectory
    units = np.where(off[:, None], normalise_quaternion(quaternions), quaternions)
    return replace(trajectory, quaternions_xyzw=read_only(units))


RULES: tuple[Rule, ...] = (
    Rule(
        "orientation-norm",
        Severity.WARNING,
        f"Orientations of poses have length 1, within {NORM_TOLERANCE:g}; beyond 0.01 they are refused.",
        "Write quaternions with more digits; `--fix` scales them to length 1.",
        find=_lengths,
        fix=with_unit_orientations,
    ),
)
