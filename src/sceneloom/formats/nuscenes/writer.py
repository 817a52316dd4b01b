"""Write a scene as a data set in the nuScenes schema."""

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import blake2b
from math import atan2, degrees, remainder
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float64Array, Int64Array, UInt32Array, finite_rows
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.images import with_pinholes, write_image
from sceneloom.formats.base.losses import Loss, Losses, LossReport, Support, field_losses
from sceneloom.formats.base.output import FolderKind, file_stem, file_stems, replacing
from sceneloom.formats.base.poses import each_mounted, ego_in_world, mounting
from sceneloom.formats.base.spec import as_positive
from sceneloom.formats.base.written_ego import ego_trajectory, egos_at
from sceneloom.formats.nuscenes.spec import SUPPORTS
from sceneloom.formats.nuscenes.tables import KEY_FRAMES, MICROSECOND, TABLES
from sceneloom.formats.points.cloud import NUSCENES
from sceneloom.geometry.rigid import RigidTransform, conjugate_quaternion, rotate_vectors
from sceneloom.scene.annotations import CuboidAnnotation, LabeledPointsAnnotation
from sceneloom.scene.annotations_at import CuboidAngles, CuboidPoses, attribute_at, cuboid_poses
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor, RadarFrame, RadarSensor
from sceneloom.scene.contents import KINDS
from sceneloom.scene.ego import check_one_ego, ego_axes
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Key, PointsFrame, key_of

_IMAGES = ("copy", "png")  # how images are written

_KIND = FolderKind(
    "data set of nuScenes",
    (
        rf"(?P<one>v\d[\w.-]*)/({'|'.join((*TABLES, 'map'))})\.json",
        r"(samples|sweeps)/.+/.+\.(pcd|bin|jpe?g|png)",
        r"lidarseg/v\d[\w.-]*/\w+_lidarseg\.bin",
        r"maps/none\.png",
    ),
    r"v\d[\w.-]*/sample_data\.json",
)

_MAP = "maps/none.png"  # an empty mask: the development kit wants one for each log

_RADAR = (
    *((name, "F", 4) for name in ("x", "y", "z")),
    *(("dyn_prop", "I", 1), ("id", "I", 2), ("rcs", "F", 4)),
    *((name, "F", 4) for name in ("vx", "vy", "vx_comp", "vy_comp")),
    *((name, "I", 1) for name in ("is_quality_valid", "ambig_state", "x_rms", "y_rms")),
    *((name, "I", 1) for name in ("invalid_state", "pdh0", "vx_rms", "vy_rms")),
)
"""Name, type and size of the columns of radar files. Source: class RadarPointCloud of the development kit."""

_RADAR_ROW = np.dtype([(name, f"<{letter.lower()}{size}") for name, letter, size in _RADAR])

_SHOWN_RETURN = {"is_quality_valid": 1, "ambig_state": 3}
"""What a return has to state for the development kit to show it; all other numbers are 0."""

_VISIBILITIES = {"v0-40": "1", "v40-60": "2", "v60-80": "3", "v80-100": "4"}
"""Tokens of the levels, by name. Source: "visibility" of the schema."""

_UNKNOWN = "unknown"  # the category of objects without a class
_NOISE = "noise"  # the class with the number 0, which points without a class get
_MOST_CLASSES = 255
_COUNTS = {"lidar": "num_lidar_pts", "radar": "num_radar_pts"}
_OF_FRAMES = frozenset({"file", "token", "sample_token", "is_key_frame"})
_CUBOID, _POINTS = "annotations.cuboid", "annotations.labeled_points"

_Written = LidarSensor | RadarSensor | CameraSensor
_MODALITIES: Mapping[type[Any], str] = {LidarSensor: "lidar", RadarSensor: "radar", CameraSensor: "camera"}
_SECOND = 1_000_000_000
_RATE_HZ = 2.0  # samples a second in nuScenes
_OF_SENSORS = frozenset({"token", "calibrated_sensor_token", KEY_FRAMES})
_OF_SCENES = frozenset({"nuscenes", "sceneloom"})  # extra fields that the tables hold
_VERSION = "v1.0-sceneloom"  # the name of the folder of tables, where the scene was not read from one
_LIDAR_TOP = "LIDAR_TOP"  # the channel of the lidar that the renderers of the development kit ask for

_LOOKING: Mapping[float, str] = {
    0.0: "CAM_FRONT",
    55.0: "CAM_FRONT_LEFT",
    -55.0: "CAM_FRONT_RIGHT",
    110.0: "CAM_BACK_LEFT",
    -110.0: "CAM_BACK_RIGHT",
    180.0: "CAM_BACK",
}
"""The cameras of nuScenes by their viewing direction, counter-clockwise from ahead [deg]."""

_NEAR_DEG = 25.0  # how far a camera's direction may be from one of these for the camera to get its name
_STEEP = np.sin(np.pi / 4)  # a camera pitched by more than 45 degrees has none of these directions

_Add = Callable[[Mapping[str, Any]], None]  # adds a row to a table


def write_nuscenes(
    scene: Scene,
    path: Path,
    *,
    overwrite: bool = False,
    version: str | None = None,
    keyframe_rate_hz: float | str | None = None,
    images: str = "copy",
    channel: str | Iterable[str] | None = None,
    trajectory: str | None = None,
) -> LossReport:
    """Write a scene as a data set; frames are read, written and released one by one.

    Args:
        overwrite: replace the folder if it is a data set, or empty; no other folder is ever replaced.
        version: name of the folder of tables; None: that which the scene was read from, else `v1.0-sceneloom`.
        keyframe_rate_hz: samples a second; None: those that the scene was read with, else two a second.
        images: "copy" copies JPEG and PNG files, and writes others as JPEG; "png" writes them as PNG.
        channel: channels of sensors, as `lidar=LIDAR_TOP,camera0=CAM_FRONT` or one text for each; others get the name
            that nuScenes has for the lidar or for the only camera with their viewing direction, else their id.
        trajectory: name of the ego's, as of `ego_in_world`.

    Raises:
        OptionError: an option is none of these.
        PoseError: the trajectory cannot be taken.
        CalibrationError: a camera model cannot be computed with.
        DataError: what the scene is read from is damaged, or has no frame at all.
    """
    if images not in _IMAGES:
        raise OptionError(f"images {images!r}; nuScenes takes {', '.join(_IMAGES)}")
    rate_hz = None if keyframe_rate_hz is None else as_positive("keyframe_rate_hz", keyframe_rate_hz)
    plan = _WritingPlan.of(scene, path, version, rate_hz, channel, trajectory)
    with replacing(path, overwrite=overwrite, folder=_KIND) as draft:
        _Writer(plan, draft, images).write()
    return LossReport.of(plan.losses.all)


# what is decided before anything is written


def _unknown_fields(field: str, names: Iterable[str], known: frozenset[str]) -> Iterator[Loss]:
    """The loss of extra fields of other names than those that are known."""
    others = sorted(set(names) - known)
    if others:
        yield Loss(field=field, what=f"the tables have no field for {', '.join(others)}")


def _token_of(*parts: object) -> str:
    """A token of 32 hexadecimal digits, as nuScenes has them."""
    return blake2b("\0".join(map(str, parts)).encode(), digest_size=16).hexdigest()


def _microseconds(timestamps_ns: Int64Array) -> Int64Array:
    """Times [ns] as the tables have them [µs]; halves go to the even one."""
    whole: Int64Array = np.rint(timestamps_ns % _SECOND / MICROSECOND).astype(np.int64)
    return timestamps_ns // _SECOND * 1_000_000 + whole


@dataclass(frozen=True, slots=True, eq=False)
class _Channel:
    """One sensor of a data set."""

    name: str
    folder: str
    sensor: _Written
    mount: RigidTransform  # `ego_from_sensor`; identity where it is not known

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
        return _token_of("sensor", self.name)


@dataclass(frozen=True, slots=True, eq=False)
class _Samples:
    """The samples of a scene."""

    tokens: tuple[str, ...]
    timestamps_ns: Int64Array  # ascending
    limit_ns: int  # how far from a sample its frames may be

    def key_rows(self, channel: _Channel) -> BoolArray:
        """(N,) bool: which frames of a sensor are key frames: the nearest one of each sample, at most one each."""
        timestamps = channel.frames.timestamps_ns
        known = channel.sensor.extras.get(KEY_FRAMES)
        if isinstance(known, list | tuple):
            return np.isin(_microseconds(timestamps), np.array(known, np.int64))
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
class _WritingPlan:
    """What is written."""

    scene: Scene  # all of it; camera models are pinholes already
    version: str  # name of the folder of tables
    row: Any  # of scene.json
    log: Any  # row of log.json
    channels: tuple[_Channel, ...]
    samples: _Samples
    ego_path: Poses | None  # `world_from_ego`, or None where it is not known
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
    ) -> "_WritingPlan":
        """Decide about a scene; arguments and errors are those of `write_nuscenes`."""
        asked = _channels_asked_for(scene, channel)
        losses = Losses(loss for loss in field_losses(scene, SUPPORTS) if loss.support is Support.DROPPED)
        losses.extend(_all_unknown_fields(scene))
        scene = with_pinholes(scene, losses)
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
        if ego_path and any(known.timestamps_ns is ego_path.timestamps_ns for known in scene.trajectories.values()):
            frames = np.concatenate([np.zeros(0, np.int64), *(channel.frames.timestamps_ns for channel in channels)])
            lost = int((~np.isin(ego_path.timestamps_ns, frames)).sum())
            losses.dropped("trajectories.positions", "poses between frames are left out", count=lost)
            new = int((~np.isin(frames, ego_path.timestamps_ns)).sum())
            losses.approximated("trajectories.positions", "poses at frames are interpolated", count=new)
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


def _all_unknown_fields(scene: Scene) -> Iterator[Loss]:
    """Extra fields of sensors, annotations and of the scene that the tables do not hold."""
    for sensor in scene.sensors:
        if isinstance(sensor, _Written):
            yield from _unknown_fields(f"{KINDS[type(sensor)]}.extras", sensor.extras, _OF_SENSORS)
    for annotation in scene.annotations:
        kind = KINDS[type(annotation)]
        if isinstance(annotation, CuboidAnnotation):
            yield from _unknown_fields(f"{kind}.path.extras", annotation.path.extras, frozenset({"tokens"}))
        elif isinstance(annotation, LabeledPointsAnnotation):
            yield from _unknown_fields(f"{kind}.extras", annotation.extras, frozenset({"index"}))
    yield from _unknown_fields("metadata", scene.metadata, _OF_SCENES)


def _rows(about: Mapping[str, Any], path: Path) -> tuple[Any, Any]:
    """The rows of scene.json and log.json, with what the scene was read with."""
    kept, log = (rows if isinstance(rows := about.get(name), Mapping) else {} for name in ("scene", "log"))
    name = str(kept.get("name") or path.stem)
    row = TABLES["scene"](
        token=str(kept.get("token") or _token_of("scene", name)),
        name=name,
        description=str(kept.get("description") or ""),
        log_token=str(log.get("token") or _token_of("log", name)),
    )
    fields = {key: str(log.get(key) or "") for key in ("vehicle", "location")}
    fields["date_captured"] = str(log.get("date_captured") or log.get("data_captured") or "")
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


def _channels(scene: Scene, ego_path: Poses | None, losses: Losses, asked: Mapping[str, str]) -> tuple[_Channel, ...]:
    framed: list[Any] = []
    mounts: list[RigidTransform | None] = []
    for sensor in [sensor for kind in _MODALITIES for sensor in scene.sensors if isinstance(sensor, kind)]:
        kind = KINDS[type(sensor)]
        if not len(_Channel("", "", sensor, RigidTransform.identity()).frames):
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
        _Channel(name, folder, sensor, mount or RigidTransform.identity())
        for name, folder, sensor, mount in zip(names, file_stems(names), framed, mounts, strict=True)
    )


def _usual_names(
    scene: Scene, sensors: Sequence[Any], mounts: Sequence[RigidTransform | None], asked: Mapping[str, str]
) -> dict[int, str]:
    """Channels other than the ids, by number of the sensor: those asked for, else nuScenes' own that no sensor has."""
    # A lidar becomes LIDAR_TOP, which renderers of the kit ask for; a camera the direction it alone looks in.
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
    scene: Scene, channels: Sequence[_Channel], about: Mapping[str, Any], rate_hz: float | None, name: str
) -> _Samples:
    """The samples that the scene was read with, else so many a second of the first lidar's frames."""
    if not channels:
        raise DataError(scene.source, "", "holds no sweep, radar cycle or image that nuScenes could hold")
    reference = next((channel for channel in channels if channel.modality == "lidar"), channels[0])
    timestamps = np.sort(reference.frames.timestamps_ns)
    rows = about.get("samples")
    if rate_hz is None and isinstance(rows, list | tuple):
        there = set(_microseconds(timestamps).tolist())
        kept = [(str(token), int(time)) for token, time in rows if int(time) in there]
        if kept:
            times = np.array([time for _, time in kept], np.int64) * MICROSECOND
            return _Samples(tuple(token for token, _ in kept), times, round(_SECOND / _RATE_HZ / 2))
    period_ns = _SECOND / (rate_hz or _RATE_HZ)
    slack = float(np.median(np.diff(timestamps))) / 2 if len(timestamps) > 1 else 0.0
    chosen: list[int] = []
    due = float(timestamps[0])
    for time in timestamps.tolist():
        if time >= due - slack and (not chosen or time > chosen[-1]):
            chosen.append(time)
            due = max(due + period_ns, time + period_ns / 2)
    tokens = tuple(_token_of("sample", name, time) for time in chosen)
    return _Samples(tokens, np.array(chosen, np.int64), round(period_ns / 2))


# what is written


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    """A frame that was written: its file, mounting, camera model of images, points of others."""

    path: Path
    mount: RigidTransform
    camera: Camera | None = None
    points_world: AnyArray | None = None


class _Writer:
    """Writes one data set into an empty folder."""

    def __init__(self, plan: _WritingPlan, root: Path, images: str) -> None:
        self.plan, self.root, self.images = plan, root, images
        self.name: str = plan.row.name
        self.tables = root / plan.version
        self.losses = plan.losses
        self.calibrations: dict[str, dict[str, Any]] = {}  # rows of calibrated_sensor.json, by token
        self.class_numbers: dict[str, int] = {}  # of points; empty where none is labelled
        self.classes: dict[tuple[Key, int], list[tuple[int, UInt32Array]]] = {}  # of points, with their rows
        self.lidarseg: list[dict[str, str]] = []
        times = plan.samples.timestamps_ns
        angles = CuboidAngles.of(plan.scene)
        # a box there is one of the sample's sweep: as the lidar sees it
        lidar_id = plan.scene.lidars[0].id if plan.scene.lidars else None
        self.cuboids: list[tuple[CuboidAnnotation, CuboidPoses, dict[str, Int64Array]]] = [
            (
                one,
                cuboid_poses(one, times, angles=angles, sensor_id=lidar_id),
                {name: np.zeros(len(times), np.int64) for name in _COUNTS.values()},
            )
            for one in plan.scene.annotations
            if isinstance(one, CuboidAnnotation)
        ]

    def write(self) -> None:
        """Write all files."""
        self.tables.mkdir()
        self._gather_classes()
        with self._table("sample_data") as rows, self._table("ego_pose") as poses:
            for channel in self.plan.channels:
                self._write_channel(channel, rows, poses)
        self.losses.dropped(_POINTS, "classes of sweeps between samples are left out", count=len(self.classes))
        categories = {one.label or _UNKNOWN: _token_of("category", one.label or _UNKNOWN) for one, _, _ in self.cuboids}
        self._write_boxes(categories)
        self._write_table("category", self._category_rows(categories))
        if self.lidarseg:
            self._write_table("lidarseg", self.lidarseg)
        sensors: Iterable[dict[str, Any]] = (
            {"token": channel.token, "channel": channel.name, "modality": channel.modality}
            | ({} if channel.name == channel.sensor.id else {"sensor_id": channel.sensor.id})
            for channel in self.plan.channels
        )
        self._write_table("sensor", sensors)
        rows_of_mounts = ({"token": token, **row} for token, row in self.calibrations.items())
        self._write_table("calibrated_sensor", rows_of_mounts)
        self._write_samples()
        self._write_map()

    @contextmanager
    def _table(self, name: str) -> Iterator[_Add]:
        """Open a table; yields the function that adds a row, which is on the disk at once."""
        with (self.tables / f"{name}.json").open("x", encoding="utf-8", newline="\n") as file:
            between = "[\n"

            def add(row: Mapping[str, Any]) -> None:
                nonlocal between
                file.write(between + json.dumps(row, allow_nan=False))
                between = ",\n"

            yield add
            file.write("[\n]\n" if between == "[\n" else "\n]\n")

    def _write_table(self, name: str, rows: Iterable[Mapping[str, Any]]) -> None:
        with self._table(name) as add:
            for row in rows:
                add(row)

    # frames

    def _write_channel(self, channel: _Channel, add_row: _Add, add_pose: _Add) -> None:
        plan, timestamps = self.plan, channel.frames.timestamps_ns
        timestamps_us, egos = _microseconds(timestamps), egos_at(plan.ego_path, timestamps)
        is_key = plan.samples.key_rows(channel)
        samples = plan.samples.numbers(timestamps, is_key)
        tokens = [_token_of("sample_data", self.name, channel.name, k) for k in range(len(timestamps))]
        stems = _stems(self.name, channel, timestamps_us.tolist())
        for k, token in enumerate(tokens):
            folder = self.root / ("samples" if is_key[k] else "sweeps") / channel.folder
            folder.mkdir(parents=True, exist_ok=True)
            written = self._write_frame(channel, channel.frames[k], folder / stems[k], egos[k])
            camera = written.camera
            if written.points_world is not None and is_key[k]:
                self._count(_COUNTS[channel.modality], int(samples[k]), written.points_world)
                self._write_classes((key_of(channel.sensor.id), k), token, len(written.points_world))
            add_pose({"token": token, "timestamp": int(timestamps_us[k]), **_placed(egos[k])})
            add_row(
                {
                    "token": token,
                    "sample_token": plan.samples.tokens[int(samples[k])],
                    "ego_pose_token": token,
                    "calibrated_sensor_token": self._calibration(channel, written.mount, camera),
                    "timestamp": int(timestamps_us[k]),
                    "fileformat": "pcd" if camera is None else written.path.suffix[1:],
                    "is_key_frame": bool(is_key[k]),
                    "height": 0 if camera is None else camera.height,
                    "width": 0 if camera is None else camera.width,
                    "filename": written.path.relative_to(self.root).as_posix(),
                    **_chained(tokens, k),
                }
            )
        off_ns = np.abs(timestamps - timestamps_us * MICROSECOND)
        what, error = "rounded to microseconds [ns]", float(off_ns.max(initial=0))
        self.losses.converted(f"{channel.field}.timestamp_ns", what, count=int((off_ns > 0).sum()), error=error)
        what = "frames beyond the ego trajectory have its end poses"
        self.losses.approximated("trajectories.positions", what, count=plan.beyond(timestamps))

    def _write_frame(self, channel: _Channel, frame: Any, stem: Path, ego: RigidTransform) -> _Frame:
        self.losses.extend(_unknown_fields(f"{channel.field}.extras", frame.extras, _OF_FRAMES))
        if isinstance(frame, CameraImage):
            path = write_image(stem, frame, self.losses, png=self.images == "png")
            return _Frame(path, frame.mount or channel.mount, frame.camera)
        points_frame = channel.sensor.points_frame  # type: ignore[union-attr]
        positions = frame.points.positions
        if points_frame is not PointsFrame.SENSOR:
            here = channel.mount if points_frame is PointsFrame.EGO else ego @ channel.mount
            positions = here.inverse().apply(positions)
        write = self._write_sweep if isinstance(frame, LidarFrame) else self._write_cycle
        world = (ego @ channel.mount).apply(np.asarray(positions, np.float32))
        return _Frame(write(stem, frame, positions), channel.mount, points_world=world)

    def _calibration(self, channel: _Channel, mount: RigidTransform, camera: Camera | None) -> str:
        """The token of a mounting and a camera model; their row is kept for later."""
        numbers = [] if camera is None else camera.matrix.tolist()
        token = _token_of("calibrated_sensor", channel.name, mount.matrix.tolist(), numbers)
        row = {"sensor_token": channel.token, **_placed(mount), "camera_intrinsic": numbers}
        self.calibrations.setdefault(token, row)
        return token

    def _write_sweep(self, stem: Path, frame: LidarFrame, positions: AnyArray) -> Path:
        """Write a sweep as rows of x, y, z, intensity and ring."""
        points, path = frame.points, stem.with_name(f"{stem.name}.pcd.bin")
        rows = np.zeros(len(points), NUSCENES.dtype)
        rows["x"], rows["y"], rows["z"] = np.asarray(positions).T
        for name, column in (("intensity", points.intensities), ("ring", points.rings)):
            if column is not None:
                rows[name] = column
        field = "sensors.lidar.frames.points"
        if points.timestamps_ns is not None:
            self.losses.dropped(f"{field}.timestamps_ns", "points have no times", count=len(points))
        for name in ("colors", "camera_index", "extras"):
            value = getattr(points, name)
            if value is not None and (name != "extras" or value):
                self.losses.dropped(f"{field}.{name}", "points have x, y, z, intensity and ring", count=len(points))
        path.write_bytes(rows.tobytes())
        return path

    def _write_cycle(self, stem: Path, frame: RadarFrame, positions: AnyArray) -> Path:
        """Write a radar cycle as a PCD file; one without returns has a single row of NaN, as nuScenes has it."""
        points, path = frame.points, stem.with_name(f"{stem.name}.pcd")
        count, field = len(points), "sensors.radar.frames.points"
        rows = np.zeros(max(count, 1), _RADAR_ROW)
        rows["x"] = np.nan if count == 0 else 0.0
        if count:
            rows["x"], rows["y"], rows["z"] = np.asarray(positions).T
            for name, _, _ in _RADAR[3:]:
                column = points.extras.get(name)
                usable = column is not None and column.shape == rows.shape and column.dtype.kind in "fiub"
                rows[name] = column if usable else _SHOWN_RETURN.get(name, 0)
            if "id" not in points.extras:
                rows["id"] = np.arange(len(rows)) % (1 << 15)
            self._fill_velocities(rows, frame)
        if set(points.extras) - set(_RADAR_ROW.names or ()):
            self.losses.dropped(f"{field}.extras", "returns have the columns of nuScenes' radars", count=count)
        if points.timestamps_ns is not None:
            self.losses.dropped(f"{field}.timestamps_ns", "points have no times", count=count)
        # the development kit wants a byte after the last row, as nuScenes' own files have one
        path.write_bytes(_pcd_head(len(rows)) + rows.tobytes() + b"\n")
        return path

    def _fill_velocities(self, rows: AnyArray, frame: RadarFrame) -> None:
        points = frame.points
        if points.directions is None or points.lengths is None:
            return
        velocities = points.directions * points.lengths[:, None]
        unknown = np.isnan(velocities).any(axis=1)
        if unknown.any():
            # its development kit takes a cloud that begins with NaN for an empty one
            velocities[unknown] = 0.0
            what = "velocities that are not known are written as 0"
            self.losses.dropped("sensors.radar.frames.points.lengths", what, count=int(unknown.sum()))
        if "vx" not in points.extras or "vy" not in points.extras:
            rows["vx"], rows["vy"] = velocities[:, 0], velocities[:, 1]
            upright = np.abs(velocities[:, 2])
            what, error = "the velocity along the sensor's z is left out [m/s]", float(upright.max(initial=0.0))
            field = "sensors.radar.frames.points.directions"
            self.losses.approximated(field, what, count=int((upright > 0).sum()), error=error)
        if "vx_comp" not in points.extras:
            rows["vx_comp"], rows["vy_comp"] = rows["vx"], rows["vy"]

    # boxes

    def _count(self, name: str, sample: int, points_world: AnyArray) -> None:
        """Count points (N, 3) [m] of a key frame in the boxes at its sample."""
        for _, box, counts in self.cuboids:
            if box.there[sample]:
                counts[name][sample] += int(_inside(box, sample, points_world).sum())

    def _write_boxes(self, categories: Mapping[str, str]) -> None:
        """Write the tables instance, sample_annotation, attribute and visibility."""
        known: dict[str, str] = {}
        samples = self.plan.samples
        with self._table("instance") as add_instance, self._table("sample_annotation") as add_row:
            for cuboid, poses, counts in self.cuboids:
                finite = finite_rows(np.hstack([poses.centers_world, poses.sizes_lwh, poses.quaternions_xyzw]))
                what = "boxes that are no finite numbers are left out"
                self.losses.dropped(f"{_CUBOID}.path", what, count=int((poses.there & ~finite).sum()))
                there = np.flatnonzero(poses.there & finite).tolist()
                self._report_losses(cuboid, there)
                if not there:
                    continue
                named = isinstance(cuboid.id, str) and cuboid.id
                token = str(cuboid.id) if named else _token_of("instance", self.name, cuboid.id)
                tokens = [_token_of("sample_annotation", token, samples.tokens[s]) for s in there]
                add_instance(
                    {
                        "token": token,
                        "category_token": categories[cuboid.label or _UNKNOWN],
                        "nbr_annotations": len(there),
                        "first_annotation_token": tokens[0],
                        "last_annotation_token": tokens[-1],
                    }
                )
                times_ns = samples.timestamps_ns[there]
                own = [path for path in cuboid.attributes if path.sensor_id is None]
                stated = {path.name: attribute_at(path, times_ns) for path in own}
                for k, sample in enumerate(there):
                    values = {name: column[k] for name, column in stated.items()}
                    listed = _listed(values.get("attributes"))
                    known |= {name: _token_of("attribute", name) for name in listed}
                    length, width, height = poses.sizes_lwh[sample].tolist()
                    add_row(
                        {
                            "token": tokens[k],
                            "sample_token": samples.tokens[sample],
                            "instance_token": token,
                            "visibility_token": _VISIBILITIES.get(str(values.get("visibility")), ""),
                            "attribute_tokens": [known[name] for name in listed],
                            "translation": poses.centers_world[sample].tolist(),
                            "size": [width, length, height],
                            "rotation": _wxyz(poses.quaternions_xyzw[sample]),
                            **_chained(tokens, k),
                            **{
                                name: values[name] if type(values.get(name)) is int else int(count[sample])
                                for name, count in counts.items()
                            },
                        }
                    )
        self._write_table("attribute", ({"token": t, "name": n, "description": ""} for n, t in known.items()))
        levels = ({"token": t, "level": n, "description": ""} for n, t in _VISIBILITIES.items())
        self._write_table("visibility", levels)

    def _report_losses(self, cuboid: CuboidAnnotation, there: Sequence[int]) -> None:
        what = "when each sensor sees a cuboid is left out"
        self.losses.dropped(f"{_CUBOID}.activations", what, count=len(cuboid.activations))
        if not there:
            self.losses.dropped(_CUBOID, "cuboids that are at no sample are left out")
            return
        own = _microseconds(cuboid.path.timestamps_ns)
        at_samples = _microseconds(self.plan.samples.timestamps_ns[list(there)])
        lost = int((~np.isin(own, at_samples)).sum())
        self.losses.dropped(f"{_CUBOID}.path.values", "boxes between samples are left out", count=lost)
        between = int((~np.isin(at_samples, own)).sum())
        what = "boxes at samples are interpolated"
        self.losses.approximated(f"{_CUBOID}.path.values", what, count=between)
        others = sum(path.name not in {"attributes", "visibility", *_COUNTS.values()} for path in cuboid.attributes)
        self.losses.dropped(f"{_CUBOID}.attributes", "attributes of other names are left out", count=others)
        levels = [v for path in cuboid.attributes if path.name == "visibility" for v in path.values]
        unknown = sum(bool(level) and str(level) not in _VISIBILITIES for level in levels)
        what = f"levels of visibility other than {', '.join(_VISIBILITIES)} are left out"
        self.losses.dropped(f"{_CUBOID}.attributes", what, count=unknown)

    # classes of points

    def _gather_classes(self) -> None:
        """Gather the labelled points that are classes; those of single objects are left out."""
        found = [one for one in self.plan.scene.annotations if isinstance(one, LabeledPointsAnnotation)]
        classes = [one for one in found if one.label is not None and one.is_instance is not True]
        what = "points of single objects, or without a class, are left out"
        self.losses.dropped(_POINTS, what, count=len(found) - len(classes))
        self.class_numbers = _numbers(classes)
        left = {one.label for one in classes} - set(self.class_numbers)
        self.losses.dropped(_POINTS, f"a byte has {_MOST_CLASSES} classes; further ones are left out", count=len(left))
        for one in classes:
            number = self.class_numbers.get(str(one.label))
            for entry in one.labeled_points if number is not None else ():
                if entry.sensor_frame is None:
                    self.losses.dropped(
                        _POINTS, "points of a sensor without frames are left out", count=len(entry.point_ids)
                    )
                else:
                    key = (key_of(entry.sensor_id), entry.sensor_frame)
                    self.classes.setdefault(key, []).append((number or 0, entry.point_ids))

    def _write_classes(self, frame: tuple[Key, int], token: str, count: int) -> None:
        """Write the classes of the points of a key frame, given by its lidar and number, if there are any."""
        entries = self.classes.pop(frame, None)
        if entries is None:
            return
        labels, times_labelled = np.zeros(count, np.uint8), np.zeros(count, np.int64)
        for number, rows in entries:
            inside = rows[rows < count]
            labels[inside] = number
            times_labelled[inside] += 1
        name = f"lidarseg/{self.plan.version}/{token}_lidarseg.bin"
        (self.root / name).parent.mkdir(parents=True, exist_ok=True)
        (self.root / name).write_bytes(labels.tobytes())
        self.lidarseg.append({"token": token, "sample_data_token": token, "filename": name})
        field = f"{_POINTS}.labeled_points.point_ids"
        without, several = int((times_labelled == 0).sum()), int((times_labelled > 1).sum())
        self.losses.approximated(field, "points without a class are written as `noise`", count=without)
        self.losses.approximated(field, "points of several classes have the last one", count=several)

    def _category_rows(self, categories: Mapping[str, str]) -> Iterator[dict[str, str | int]]:
        """Rows of categories: those of boxes and those of points; where points are labelled, each has a number."""
        numbers = self.class_numbers
        names = dict.fromkeys([*categories, *numbers])
        if numbers and 0 not in numbers.values():
            names = {_NOISE: None, **names}
        taken = {**({_NOISE: 0} if _NOISE in names else {}), **numbers}
        number = _MOST_CLASSES
        for name in names:
            number += name not in taken
            token = categories.get(name, _token_of("category", name))
            indexed = {"index": taken.get(name, number)} if numbers else {}
            yield {"token": token, "name": name, "description": "", **indexed}

    # scene

    def _write_samples(self) -> None:
        row, tokens = self.plan.row, self.plan.samples.tokens
        times = _microseconds(self.plan.samples.timestamps_ns).tolist()
        rows = (
            {"token": token, "timestamp": times[k], **_chained(tokens, k), "scene_token": row.token}
            for k, token in enumerate(tokens)
        )
        self._write_table("sample", rows)
        row.nbr_samples, row.first_sample_token, row.last_sample_token = len(tokens), tokens[0], tokens[-1]
        self._write_table("scene", [msgspec.structs.asdict(row)])
        log = msgspec.structs.asdict(self.plan.log)
        self._write_table("log", [{name: value for name, value in log.items() if name != "data_captured"}])

    def _write_map(self) -> None:
        from PIL import Image

        (self.root / _MAP).parent.mkdir()
        Image.new("L", (1, 1)).save(self.root / _MAP)
        row = {"category": "semantic_prior", "token": _token_of("map"), "filename": _MAP}
        self._write_table("map", [{**row, "log_tokens": [self.plan.log.token]}])


def _stems(name: str, channel: _Channel, timestamps_us: Sequence[int]) -> list[str]:
    """Names of files, as nuScenes has them: scene, channel, time; a number where two frames have one time."""
    stems: list[str] = []
    seen: dict[int, int] = {}
    for time in timestamps_us:
        number = seen[time] = seen.get(time, 0) + 1
        again = "" if number == 1 else f"~{number}"
        stems.append(f"{file_stem(name)}__{channel.folder}__{time}{again}")
    return stems


def _chained(tokens: Sequence[str], k: int) -> dict[str, str]:
    return {"prev": tokens[k - 1] if k else "", "next": tokens[k + 1] if k + 1 < len(tokens) else ""}


def _wxyz(quaternion_xyzw: Float64Array) -> list[float]:
    x, y, z, w = quaternion_xyzw.tolist()
    return [w, x, y, z]


def _placed(transform: RigidTransform) -> dict[str, list[float]]:
    """A transform as two fields of a row."""
    return {"translation": transform.translation.tolist(), "rotation": _wxyz(transform.quaternion_xyzw)}


def _pcd_head(count: int) -> bytes:
    names, letters, sizes = zip(*_RADAR, strict=True)
    lines = (
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(names)}",
        f"SIZE {' '.join(map(str, sizes))}",
        f"TYPE {' '.join(letters)}",
        f"COUNT {' '.join('1' for _ in _RADAR)}",
        f"WIDTH {count}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {count}",
        "DATA binary",
    )
    return ("\n".join(lines) + "\n").encode()


def _inside(box: CuboidPoses, sample: int, points_world: AnyArray) -> BoolArray:
    away = points_world - box.centers_world[sample]
    half = box.sizes_lwh[sample] / 2
    near = np.flatnonzero((np.abs(away) <= float(np.linalg.norm(half))).all(axis=1))
    inner = rotate_vectors(conjugate_quaternion(box.quaternions_xyzw[sample]), away[near])
    inside = np.zeros(len(points_world), np.bool_)
    inside[near] = (np.abs(inner) <= half).all(axis=1)
    return inside


def _listed(names: Any) -> list[str]:
    """Names of attributes, of which one may stand alone."""
    if isinstance(names, str):
        return [names] if names else []
    return [str(name) for name in names] if isinstance(names, list | tuple) else []


def _numbers(classes: Iterable[LabeledPointsAnnotation]) -> dict[str, int]:
    """Numbers of classes: those that they were read with, else the free ones, from 1 on."""
    numbers: dict[str, int] = {}
    waiting: list[str] = []
    for annotation in classes:
        label, known = str(annotation.label), annotation.extras.get("index")
        if label in numbers:
            continue
        if type(known) is int and 0 <= known <= _MOST_CLASSES and known not in numbers.values():
            numbers[label] = known
        elif label not in waiting:
            waiting.append(label)
    for label in waiting:
        candidates = range(0 if label == _NOISE else 1, _MOST_CLASSES + 1)
        free = next((number for number in candidates if number not in numbers.values()), None)
        if label not in numbers and free is not None:
            numbers[label] = free
    return numbers
