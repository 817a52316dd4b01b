"""What of a scene goes into the tables of nuScenes, decided before anything is written: channels, samples, poses."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import atan2, degrees, remainder
from pathlib import Path
from typing import Any

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.editing.cameras import undistort_scene
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.loss_list import Losses
from sceneloom.formats.base.losses import Loss, Support, field_losses
from sceneloom.formats.base.output import file_stems
from sceneloom.formats.base.poses import each_mounted, ego_in_world, mounting
from sceneloom.formats.base.written_ego import ego_trajectory
from sceneloom.formats.nuscenes.spec import SUPPORTS
from sceneloom.formats.nuscenes.tables import KEY_FRAMES, MICROSECOND, TABLES, microseconds, token_of
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations import CuboidAnnotation, LabeledPointsAnnotation
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.contents import KINDS
from sceneloom.scene.ego import check_one_ego, ego_axes
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene

_Written = LidarSensor | RadarSensor | CameraSensor
_MODALITIES: Mapping[type[Any], str] = {LidarSensor: "lidar", RadarSensor: "radar", CameraSensor: "camera"}
_SECOND = 1_000_000_000

_RATE_HZ = 2.0
"""Samples a second in nuScenes."""

_OF_SENSORS = frozenset({"token", "calibrated_sensor_token", KEY_FRAMES})
_OF_SCENES = frozenset({"nuscenes", "sceneloom"})
"""Extra fields that the tables hold."""

_VERSION = "v1.0-sceneloom"
"""The name of the folder of tables, where the scene was not read from one."""

_LIDAR_TOP = "LIDAR_TOP"
"""The channel of the lidar that the renderers of the development kit ask for."""

_LOOKING: Mapping[float, str] = {
    0.0: "CAM_FRONT",
    55.0: "CAM_FRONT_LEFT",
    -55.0: "CAM_FRONT_RIGHT",
    110.0: "CAM_BACK_LEFT",
    -110.0: "CAM_BACK_RIGHT",
    180.0: "CAM_BACK",
}
"""The cameras of nuScenes by their viewing direction, counter-clockwise from ahead [deg]."""

_NEAR_DEG = 25.0
"""How far a camera's direction may be from one of these for the camera to get its name."""

_STEEP = np.sin(np.pi / 4)
"""A camera pitched by more than 45 degrees has none of these directions."""


def unknown_fields(field: str, names: Iterable[str], known: frozenset[str]) -> Iterator[Loss]:
    """The loss of extra fields of other names than those that are known."""
    others = sorted(set(names) - known)
    if others:
        yield Loss(field=field, what=f"the tables have no field for {', '.join(others)}")


@dataclass(frozen=True, slots=True, eq=False)
class Channel:
    """One sensor of a data set.

    Attributes:
        name: the channel.
        folder: the name of its folders.
        sensor: what is written.
        mount: `ego_from_sensor`; identity where it is not known.
    """

    name: str
    folder: str
    sensor: _Written
    mount: RigidTransform

    @property
    def modality(self) -> str:
        """`lidar`, `radar` or `camera`."""
        return _MODALITIES[type(self.sensor)]

    @property
    def field(self) -> str:
        """The name of the sensor's frames in losses."""
        return f"sensors.{self.modality}.{'images' if self.modality == 'camera' else 'frames'}"

    @property
    def frames(self) -> Any:
        """Sweeps, cycles or images."""
        return self.sensor.images if isinstance(self.sensor, CameraSensor) else self.sensor.frames

    @property
    def token(self) -> str:
        """Of the row in sensor.json."""
        return token_of("sensor", self.name)


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """The samples of a scene.

    Attributes:
        tokens: of each.
        timestamps_ns: (S,) int64 [ns], ascending.
        limit_ns: how far from a sample its frames may be.
    """

    tokens: tuple[str, ...]
    timestamps_ns: Int64Array
    limit_ns: int

    def key_rows(self, channel: Channel) -> BoolArray:
        """(N,) bool: which frames of a sensor are key frames: the nearest one of each sample, at most one each."""
        timestamps = channel.frames.timestamps_ns
        known = channel.sensor.extras.get(KEY_FRAMES)
        if isinstance(known, list | tuple):
            return np.isin(microseconds(timestamps), np.array(known, np.int64))
        chosen = np.zeros(len(timestamps), np.bool_)
        for time in self.timestamps_ns.tolist():
            after = int(np.searchsorted(timestamps, time))
            near = [row for row in (after - 1, after) if 0 <= row < len(timestamps) and not chosen[row]]
            best = min(near, key=lambda row: abs(int(timestamps[row]) - time), default=None)
            if best is not None and abs(int(timestamps[best]) - time) <= self.limit_ns:
                chosen[best] = True
        return chosen

    def numbers(self, timestamps_ns: Int64Array, is_key: BoolArray) -> Int64Array:
        """(N,) int64: the sample that each frame belongs to: of key frames the nearest, else the next one."""
        after = np.minimum(np.searchsorted(self.timestamps_ns, timestamps_ns), len(self.timestamps_ns) - 1)
        before = np.maximum(after - 1, 0)
        nearer = np.abs(timestamps_ns - self.timestamps_ns[before]) < np.abs(timestamps_ns - self.timestamps_ns[after])
        return np.where(is_key & nearer, before, after).astype(np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class WritingPlan:
    """What is written.

    Attributes:
        scene: all of it; camera models are pinholes already.
        version: name of the folder of tables.
        row: of scene.json.
        log: row of log.json.
        channels: the sensors.
        samples: the samples.
        ego_path: `world_from_ego`, or None where it is not known.
        losses: what is known to be lost.
    """

    scene: Scene
    version: str
    row: Any
    log: Any
    channels: tuple[Channel, ...]
    samples: Samples
    ego_path: Poses | None
    losses: Losses

    @classmethod
    def of(
        cls,
        scene: Scene,
        path: Path,
        version: str | None,
        rate_hz: float | None,
        channel: str | Iterable[str] | None,
        trajectory: str | None,
    ) -> "WritingPlan":
        """Decide about a scene; the arguments are those of `write_nuscenes`.

        Raises:
            CalibrationError: a camera model cannot be computed with.
            OptionError: there is no trajectory of that name, or a channel or the version is none.
            PoseError: the trajectory cannot be taken.
            DataError: no sensor has a frame.
        """
        asked = _channels_asked_for(scene, channel)
        losses = Losses(loss for loss in field_losses(scene, SUPPORTS) if loss.support is Support.DROPPED)
        losses.extend(_unknown_fields(scene))
        scene = _with_pinholes(scene, losses)
        ego_path = ego_trajectory(scene) if trajectory is None else None
        if ego_path is None:
            ego, reported = ego_in_world(scene, name=trajectory)
            ego_path = None if ego.path.static else ego.path
            losses.extend(reported)
        check_one_ego(scene, ego_path)
        scene = each_mounted(scene, ego_path)
        others = max(len(scene.trajectories) - 1, 0)
        losses.dropped("trajectories", "left out: the tables hold one ego trajectory", count=others)
        channels = _channels(scene, ego_path, losses, asked)
        if any(ego_path and known.timestamps_ns is ego_path.timestamps_ns for known in scene.trajectories.values()):
            _report_poses(ego_path, channels, losses)
        about = scene.metadata.get("nuscenes")
        about = about if isinstance(about, Mapping) else {}
        row, log = _rows(about, path)
        if version is None:
            read = about.get("version")
            version = read if isinstance(read, str) and _is_version(read) else _VERSION
        if not _is_version(version):
            raise OptionError(f"version {version!r}; expected a name such as v1.0-mini")
        samples = _samples(scene, channels, about, rate_hz, row.name)
        return cls(scene, version, row, log, channels, samples, ego_path, losses)

    def egos_at(self, timestamps_ns: Int64Array) -> list[RigidTransform]:
        """`world_from_ego` at each time; beyond the trajectory its end poses hold."""
        if self.ego_path is None:
            return [RigidTransform.identity()] * len(timestamps_ns)
        held = self.ego_path.held(timestamps_ns)
        return [*map(RigidTransform.from_quaternion, held.positions, held.quaternions_xyzw)]

    def beyond(self, timestamps_ns: Int64Array) -> int:
        """How many times are beyond the ego trajectory."""
        path = self.ego_path
        if path is None or path.static:
            return 0
        return int(((timestamps_ns < path.start_ns) | (timestamps_ns > path.stop_ns)).sum())


def _is_version(name: str) -> bool:
    """Whether a name may be that of a folder of tables."""
    plain = name.replace(".", "").replace("-", "").replace("_", "")
    return name.startswith("v") and name[1:2].isdigit() and plain.isascii() and plain.isalnum()


def _unknown_fields(scene: Scene) -> Iterator[Loss]:
    """Extra fields of sensors, annotations and of the scene that the tables do not hold."""
    for sensor in scene.sensors:
        if isinstance(sensor, _Written):
            yield from unknown_fields(f"{KINDS[type(sensor)]}.extras", sensor.extras, _OF_SENSORS)
    for annotation in scene.annotations:
        kind = KINDS[type(annotation)]
        if isinstance(annotation, CuboidAnnotation):
            yield from unknown_fields(f"{kind}.path.extras", annotation.path.extras, frozenset({"tokens"}))
        elif isinstance(annotation, LabeledPointsAnnotation):
            yield from unknown_fields(f"{kind}.extras", annotation.extras, frozenset({"index"}))
    yield from unknown_fields("metadata", scene.metadata, _OF_SCENES)


def _report_poses(ego_path: Any, channels: Sequence[Channel], losses: Losses) -> None:
    """Report that poses between frames are not in the tables, of a trajectory of the scene."""
    frames = np.concatenate([np.zeros(0, np.int64), *(channel.frames.timestamps_ns for channel in channels)])
    lost = int((~np.isin(ego_path.timestamps_ns, frames)).sum())
    losses.dropped("trajectories.positions", "poses between frames are left out", count=lost)
    new = int((~np.isin(frames, ego_path.timestamps_ns)).sum())
    losses.approximated("trajectories.positions", "poses at frames are interpolated", count=new)


def _with_pinholes(scene: Scene, losses: Losses) -> Scene:
    """Resample the images of other camera models, since all of nuScenes' images are undistorted."""
    distorted = [camera for camera in scene.cameras if camera.camera.model != "pinhole" and len(camera.images)]
    for camera in distorted:
        model = camera.camera.model
        what = f"{camera.id!r}: a {model} camera model replaced by a pinhole, and its images resampled for it"
        for name in ("camera", "images.rgb", "images.encoded"):
            losses.approximated(f"sensors.camera.{name}", what)
    return undistort_scene(scene, cameras=[camera.id for camera in distorted]) if distorted else scene


def _rows(about: Mapping[str, Any], path: Path) -> tuple[Any, Any]:
    """The rows of scene.json and log.json, with what the scene was read with."""
    kept, log = (rows if isinstance(rows := about.get(name), Mapping) else {} for name in ("scene", "log"))
    name = str(kept.get("name") or path.stem)
    row = TABLES["scene"](
        token=str(kept.get("token") or token_of("scene", name)),
        name=name,
        description=str(kept.get("description") or ""),
        log_token=str(log.get("token") or token_of("log", name)),
    )
    fields = {key: str(log.get(key) or "") for key in ("vehicle", "date_captured", "location")}
    return row, TABLES["log"](token=row.log_token, logfile=str(log.get("logfile") or name), **fields)


# channels


def _channels_asked_for(scene: Scene, stated: str | Iterable[str] | None) -> Mapping[str, str]:
    """Read what channels sensors are to have, as `lidar=LIDAR_TOP,camera0=CAM_FRONT`."""
    found: dict[str, str] = {}
    known = [str(sensor.id) for sensor in scene.sensors if isinstance(sensor, _Written)]
    pairs = (stated or "").split(",") if isinstance(stated, str | None) else stated
    for pair in filter(None, pairs):
        sensor, _, name = (part.strip() for part in pair.rpartition("="))
        if not name or sensor not in known:
            raise OptionError(
                f"channel {pair!r}; expected SENSOR=CHANNEL, such as lidar=LIDAR_TOP, with a sensor out of "
                f"{', '.join(known) or 'none'}"
            )
        found[sensor] = name
    return found


def _channels(scene: Scene, ego_path: Poses | None, losses: Losses, asked: Mapping[str, str]) -> tuple[Channel, ...]:
    framed: list[Any] = []
    mounts: list[RigidTransform | None] = []
    for sensor in [sensor for kind in _MODALITIES for sensor in scene.sensors if isinstance(sensor, kind)]:
        kind = KINDS[type(sensor)]
        if not len(Channel("", "", sensor, RigidTransform.identity()).frames):
            losses.dropped(kind, f"{sensor.id!r} has no frame, and is left out")
            continue
        mount, lost = mounting(sensor, ego_path, each=True)
        losses.extend(lost)
        if mount is None:
            what = f"{sensor.id!r}: not known; written as if it were where the ego is"
            losses.approximated(f"{kind}.mount", what)
        framed.append(sensor)
        mounts.append(mount)
    usual = _usual_names(scene, framed, mounts, asked)
    names = [usual.get(k, str(sensor.id)) for k, sensor in enumerate(framed)]
    names = [name if names.index(name) == k else f"{name}~{k}" for k, name in enumerate(names)]
    for one, name in zip(framed, names, strict=True):
        if str(one.id) != name:
            losses.converted(f"{KINDS[type(one)]}.id", f"{one.id!r} becomes channel {name!r}")
    return tuple(
        Channel(name, folder, sensor, mount or RigidTransform.identity())
        for name, folder, sensor, mount in zip(names, file_stems(names), framed, mounts, strict=True)
    )


def _usual_names(
    scene: Scene, sensors: Sequence[Any], mounts: Sequence[RigidTransform | None], asked: Mapping[str, str]
) -> dict[int, str]:
    """Channels other than the ids, by the number of the sensor: those asked for, else those that nuScenes has.

    A lidar becomes LIDAR_TOP, as all renderers of the development kit ask for it; a camera has the name of the
    direction that it alone looks in. Names that a sensor has already are given to no other.
    """
    axes, ids = ego_axes(scene), [str(one.id) for one in sensors]
    names = {k: asked[name] for k, name in enumerate(ids) if name in asked}
    taken = {*names.values(), *ids}
    wanted: dict[int, str] = {}
    lidars = []
    for k, sensor in enumerate(sensors):
        mount = mounts[k]
        if k in names:
            continue
        if isinstance(sensor, LidarSensor) and ids[k] != _LIDAR_TOP:
            lidars.append(k)
        elif isinstance(sensor, CameraSensor) and ids[k] not in _LOOKING.values() and mount is not None and axes.known:
            name = _looking(axes.body_from_ego @ mount.rotation[:, 2])
            wanted |= {} if name is None else {k: name}
    lidars.sort(key=lambda k: "top" not in ids[k].lower())
    wanted |= dict.fromkeys(lidars[:1], _LIDAR_TOP)
    counts = Counter(wanted.values())
    return names | {k: name for k, name in wanted.items() if counts[name] == 1 and name not in taken}


def _looking(axis: Float64Array) -> str | None:
    """The channel of a camera by its optical axis on the vehicle (forward, left, up)."""
    if abs(axis[2]) > _STEEP:
        return None
    angle = degrees(atan2(axis[1], axis[0]))
    return next((name for at, name in _LOOKING.items() if abs(remainder(angle - at, 360)) <= _NEAR_DEG), None)


# samples


def _samples(
    scene: Scene, channels: Sequence[Channel], about: Mapping[str, Any], rate_hz: float | None, name: str
) -> Samples:
    """The samples that the scene was read with, else so many a second of the first lidar's frames."""
    if not channels:
        raise DataError(scene.source, "", "holds no sweep, radar cycle or image that nuScenes could hold")
    reference = next((channel for channel in channels if channel.modality == "lidar"), channels[0])
    timestamps = np.sort(reference.frames.timestamps_ns)
    rows = about.get("samples")
    if rate_hz is None and isinstance(rows, list | tuple):
        there = set(microseconds(timestamps).tolist())
        kept = [(str(token), int(time)) for token, time in rows if int(time) in there]
        if kept:
            times = np.array([time for _, time in kept], np.int64) * MICROSECOND
            return Samples(tuple(token for token, _ in kept), times, round(_SECOND / _RATE_HZ / 2))
    period_ns = _SECOND / (rate_hz or _RATE_HZ)
    slack = float(np.median(np.diff(timestamps))) / 2 if len(timestamps) > 1 else 0.0
    chosen: list[int] = []
    due = float(timestamps[0])
    for time in timestamps.tolist():
        if time >= due - slack and (not chosen or time > chosen[-1]):
            chosen.append(time)
            due = max(due + period_ns, time + period_ns / 2)
    tokens = tuple(token_of("sample", name, time) for time in chosen)
    return Samples(tokens, np.array(chosen, np.int64), round(period_ns / 2))
