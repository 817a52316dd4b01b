"""Write a scene as a data set in the nuScenes schema."""

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec
import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float64Array, Int64Array, UInt32Array, finite_rows
from sceneloom.cameras.camera import Camera
from sceneloom.errors import OptionError
from sceneloom.formats.base.images import ImageFile
from sceneloom.formats.base.losses import Loss, LossReport, Support
from sceneloom.formats.base.output import FolderKind, replacing
from sceneloom.formats.base.spec import as_positive
from sceneloom.formats.nuscenes.plan import OF_FRAMES, Channel, WritingPlan, channels_of, is_version, reported
from sceneloom.formats.nuscenes.tables import TABLES, Samples, Written, microseconds, timestamps_of, token_of
from sceneloom.formats.points.cloud import NUSCENES
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import conjugate_quaternion, rotate_vectors
from sceneloom.scene.annotations import CuboidAnnotation, LabeledPointsAnnotation
from sceneloom.scene.annotations_at import CuboidAngles, CuboidPoses, attribute_at, cuboid_poses
from sceneloom.scene.cameras import CameraImage
from sceneloom.scene.clouds import LidarFrame, LidarSensor, RadarFrame
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Key, PointsFrame, key_of

_Row = Mapping[str, Any]


class _TableWriter:
    """An open table; its rows are on the disk as soon as they are added."""

    def __init__(self, folder: Path, name: str) -> None:
        """Begin a table."""
        self._file = (folder / f"{name}.json").open("x", encoding="utf-8", newline="\n")
        self._file.write("[")
        self._between = "\n"

    def add(self, **row: Any) -> None:
        """Write a row."""
        self._file.write(self._between + json.dumps(row, allow_nan=False))
        self._between = ",\n"

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.write("\n]\n")
        self._file.close()


_JPEG_QUALITY = 95
"""Of images that come from a video or from memory."""


_RADAR = (
    *((name, "F", 4) for name in ("x", "y", "z")),
    *(("dyn_prop", "I", 1), ("id", "I", 2), ("rcs", "F", 4)),
    *((name, "F", 4) for name in ("vx", "vy", "vx_comp", "vy_comp")),
    *((name, "I", 1) for name in ("is_quality_valid", "ambig_state", "x_rms", "y_rms")),
    *((name, "I", 1) for name in ("invalid_state", "pdh0", "vx_rms", "vy_rms")),
)
"""Name, type and size of the columns of radar files. Source: class RadarPointCloud of the development kit."""


_RADAR_ROW = np.dtype([(name, f"<{letter.lower()}{size}") for name, letter, size in _RADAR])


_USUAL = {"is_quality_valid": 1, "ambig_state": 3}
"""What a return has to state for the development kit to show it; all other numbers are 0."""


@dataclass(slots=True)
class _FrameLosses:
    """What is lost of frames, counted."""

    counts: Counter[tuple[str, str, Support]] = field(default_factory=Counter)
    largest: dict[tuple[str, str, Support], float] = field(default_factory=dict)

    def add(
        self,
        name: str,
        what: str,
        count: int,
        support: Support = Support.DROPPED,
        *,
        error: float | None = None,
    ) -> None:
        """Count a loss; a count of 0 is none."""
        if count:
            self.counts[name, what, support] += count
            if error is not None:
                self.largest[name, what, support] = max(error, self.largest.get((name, what, support), 0.0))

    def __iter__(self) -> Iterator[Loss]:
        for (name, what, support), count in self.counts.items():
            worst = self.largest.get((name, what, support))
            yield Loss(field=name, what=what, count=count, support=support, largest_error=worst)


_VISIBILITIES = {"v0-40": "1", "v40-60": "2", "v60-80": "3", "v80-100": "4"}
"""Tokens of the levels, by name. Source: "visibility" of the schema."""

_UNKNOWN = "unknown"
"""The category of objects without a class."""

_COUNTS = ("num_lidar_pts", "num_radar_pts")


@dataclass(slots=True)
class _Boxes:
    """The boxes of all cuboids at all samples.

    Attributes:
        cuboids: in order.
        poses: of each, at the samples.
        counts: `num_lidar_pts` and `num_radar_pts` counted, (A, S) int64 each.
    """

    cuboids: tuple[CuboidAnnotation, ...]
    poses: tuple[CuboidPoses, ...]
    counts: Mapping[str, Int64Array] = field(default_factory=dict)

    @classmethod
    def of(cls, scene: Scene, samples: Samples) -> "_Boxes":
        """Find the boxes of a scene's cuboids."""
        cuboids = tuple(a for a in scene.annotations if isinstance(a, CuboidAnnotation))
        angles = CuboidAngles.of(scene)
        times = samples.timestamps_ns
        # a box there is one of the sample's sweep: as the lidar sees it
        lidar_id = scene.lidars[0].id if scene.lidars else None
        poses = tuple(cuboid_poses(cuboid, times, angles=angles, sensor_id=lidar_id) for cuboid in cuboids)
        shape = (len(cuboids), len(times))
        return cls(cuboids, poses, {name: np.zeros(shape, np.int64) for name in _COUNTS})

    def count(self, name: str, sample: int, points_world: AnyArray) -> None:
        """Count points (N, 3) [m] in the boxes at a sample.

        Args:
            name: "num_lidar_pts" or "num_radar_pts".
            sample: its number.
            points_world: a frame's points.
        """
        for row, box in enumerate(self.poses):
            if box.there[sample]:
                self.counts[name][row, sample] += int(_inside(box, sample, points_world).sum())


def _inside(box: CuboidPoses, sample: int, points_world: AnyArray) -> BoolArray:
    away = points_world - box.centers_world[sample]
    half = box.sizes_lwh[sample] / 2
    reach = float(np.linalg.norm(half))
    near = np.flatnonzero((np.abs(away) <= reach).all(axis=1))
    inner = rotate_vectors(conjugate_quaternion(box.quaternions_xyzw[sample]), away[near])
    inside = np.zeros(len(points_world), np.bool_)
    inside[near] = (np.abs(inner) <= half).all(axis=1)
    return inside


def _categories_of(scene: Scene) -> dict[str, str]:
    """Tokens of the categories of all cuboids, by name."""
    labels = [a.label or _UNKNOWN for a in scene.annotations if isinstance(a, CuboidAnnotation)]
    return {name: token_of("category", name) for name in dict.fromkeys(labels)}


def _write_boxes(
    folder: Path,
    name: str,
    boxes: _Boxes,
    samples: Samples,
    categories: Mapping[str, str],
    losses: _FrameLosses,
) -> None:
    """Write the tables instance, sample_annotation, attribute and visibility."""
    known: dict[str, str] = {}
    with _TableWriter(folder, "instance") as instances, _TableWriter(folder, "sample_annotation") as rows:
        for number, cuboid in enumerate(boxes.cuboids):
            poses = boxes.poses[number]
            finite = finite_rows(np.hstack([poses.centers_world, poses.sizes_lwh, poses.quaternions_xyzw]))
            nowhere = int((poses.there & ~finite).sum())
            if nowhere:
                losses.add("annotations.cuboid.path", "boxes that are no finite numbers are left out", nowhere)
            there = np.flatnonzero(poses.there & finite).tolist()
            token = _instance_token(cuboid, name)
            _report_losses(cuboid, samples, there, losses)
            if not there:
                continue
            tokens = [token_of("sample_annotation", token, samples.tokens[s]) for s in there]
            instances.add(
                token=token,
                category_token=categories[cuboid.label or _UNKNOWN],
                nbr_annotations=len(there),
                first_annotation_token=tokens[0],
                last_annotation_token=tokens[-1],
            )
            stated = _stated(cuboid, samples.timestamps_ns[there])
            for k, sample in enumerate(there):
                rows.add(**_row(boxes, number, sample, samples, token, tokens, k, stated[k], known))
    _write_table(folder, "attribute", ({"token": t, "name": n, "description": ""} for n, t in known.items()))
    levels = ({"token": t, "level": n, "description": ""} for n, t in _VISIBILITIES.items())
    _write_table(folder, "visibility", levels)


def _instance_token(cuboid: CuboidAnnotation, name: str) -> str:
    """The id of a cuboid, where it is a text; else a token that is made of it."""
    identifier = cuboid.id
    return identifier if isinstance(identifier, str) and identifier else token_of("instance", name, identifier)


def _stated(cuboid: CuboidAnnotation, times_ns: Int64Array) -> list[dict[str, Any]]:
    """What is stated about a cuboid at times (M,) [ns]."""
    columns = {path.name: attribute_at(path, times_ns) for path in cuboid.attributes if path.sensor_id is None}
    return [{name: values[k] for name, values in columns.items()} for k in range(len(times_ns))]


def _row(
    boxes: _Boxes,
    number: int,
    sample: int,
    samples: Samples,
    token: str,
    tokens: Sequence[str],
    k: int,
    stated: Mapping[str, Any],
    known: dict[str, str],
) -> dict[str, Any]:
    box = boxes.poses[number]
    length, width, height = box.sizes_lwh[sample].tolist()
    listed = _listed(stated.get("attributes"))
    for name in listed:
        known.setdefault(name, token_of("attribute", name))
    counts = {
        name: stated[name] if type(stated.get(name)) is int else int(boxes.counts[name][number, sample])
        for name in _COUNTS
    }
    return {
        "token": tokens[k],
        "sample_token": samples.tokens[sample],
        "instance_token": token,
        "visibility_token": _VISIBILITIES.get(str(stated.get("visibility")), ""),
        "attribute_tokens": [known[name] for name in listed],
        "translation": box.centers_world[sample].tolist(),
        "size": [width, length, height],
        "rotation": _wxyz(box.quaternions_xyzw[sample]),
        "prev": tokens[k - 1] if k else "",
        "next": tokens[k + 1] if k + 1 < len(tokens) else "",
        **counts,
    }


def _listed(names: Any) -> list[str]:
    """Names of attributes, of which one may stand alone."""
    if isinstance(names, str):
        return [names] if names else []
    return [str(name) for name in names] if isinstance(names, list | tuple) else []


def _report_losses(cuboid: CuboidAnnotation, samples: Samples, there: Sequence[int], losses: _FrameLosses) -> None:
    location = "annotations.cuboid"
    losses.add(f"{location}.activations", "when each sensor sees a cuboid is left out", len(cuboid.activations))
    if not there:
        losses.add(location, "cuboids that are at no sample are left out", 1)
        return
    own = microseconds(cuboid.path.timestamps_ns)
    at_samples = microseconds(samples.timestamps_ns[list(there)])
    lost = int((~np.isin(own, at_samples)).sum())
    losses.add(f"{location}.path.values", "boxes between samples are left out", lost)
    between = int((~np.isin(at_samples, own)).sum())
    what = "boxes at samples are found between those of the path"
    losses.add(f"{location}.path.values", what, between, Support.APPROXIMATED)
    reported = {"attributes", "visibility", *_COUNTS}
    others = sum(path.name not in reported for path in cuboid.attributes)
    losses.add(f"{location}.attributes", "attributes of other names are left out", others)
    levels = [v for path in cuboid.attributes if path.name == "visibility" for v in path.values]
    unknown = sum(bool(level) and str(level) not in _VISIBILITIES for level in levels)
    what = f"levels of visibility other than {', '.join(_VISIBILITIES)} are left out"
    losses.add(f"{location}.attributes", what, unknown)


_NOISE = "noise"
"""The class with the number 0, which points without a class get."""

_MOST = 255
_LOCATION = "annotations.labeled_points"


@dataclass(slots=True)
class _PointClasses:
    """The classes of points, by lidar and frame.

    Attributes:
        numbers: of the classes, by name; empty where the scene labels no points.
        entries: class and rows of points, by lidar and number of the frame.
        rows: of the table lidarseg.
    """

    numbers: Mapping[str, int] = field(default_factory=dict)
    entries: dict[tuple[Key, int], list[tuple[int, UInt32Array]]] = field(default_factory=dict)
    rows: list[dict[str, str]] = field(default_factory=list)

    @classmethod
    def of(cls, scene: Scene, losses: _FrameLosses) -> "_PointClasses":
        """Gather the labelled points that are classes; those of single objects are left out."""
        found = [a for a in scene.annotations if isinstance(a, LabeledPointsAnnotation)]
        classes = [a for a in found if a.label is not None and a.is_instance is not True]
        losses.add(_LOCATION, "points of single objects, or without a class, are left out", len(found) - len(classes))
        numbers = _numbers(classes)
        left = {a.label for a in classes} - set(numbers)
        losses.add(_LOCATION, f"a byte has {_MOST} classes; further ones are left out", len(left))
        made = cls(numbers)
        for annotation in classes:
            if annotation.label in numbers:
                made._add(annotation, numbers[str(annotation.label)], losses)
        return made

    def _add(self, annotation: LabeledPointsAnnotation, number: int, losses: _FrameLosses) -> None:
        for entry in annotation.labeled_points:
            if entry.sensor_frame is None:
                losses.add(_LOCATION, "points of a sensor without frames are left out", len(entry.point_ids))
                continue
            key = (key_of(entry.sensor_id), entry.sensor_frame)
            self.entries.setdefault(key, []).append((number, entry.point_ids))

    def write(
        self, root: Path, version: str, token: str, frame: tuple[Key, int], count: int, losses: _FrameLosses
    ) -> None:
        """Write the classes of a key frame, if there are any.

        Args:
            root: the data set.
            version: name of the folder of tables.
            token: of the key frame.
            frame: its lidar and its number.
            count: its points.
            losses: takes points without a class and with several.
        """
        entries = self.entries.pop(frame, None)
        if entries is None:
            return
        labels, reported = np.zeros(count, np.uint8), np.zeros(count, np.int64)
        for number, rows in entries:
            inside = rows[rows < count]
            labels[inside] = number
            reported[inside] += 1
        name = f"lidarseg/{version}/{token}_lidarseg.bin"
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(labels.tobytes())
        self.rows.append({"token": token, "sample_data_token": token, "filename": name})
        location = f"{_LOCATION}.labeled_points.point_ids"
        for what, lost in (
            ("points without a class are written as `noise`", int((reported == 0).sum())),
            ("points of several classes have the last one", int((reported > 1).sum())),
        ):
            losses.add(location, what, lost, Support.APPROXIMATED)

    def left(self) -> int:
        """How many frames with classes were no key frames."""
        return len(self.entries)


def _numbers(classes: Iterable[LabeledPointsAnnotation]) -> dict[str, int]:
    """Numbers of classes: those that they were read with, else the free ones, from 1 on."""
    numbers: dict[str, int] = {}
    waiting: list[str] = []
    for annotation in classes:
        label, known = str(annotation.label), annotation.extras.get("index")
        if label in numbers:
            continue
        if type(known) is int and 0 <= known <= _MOST and known not in numbers.values():
            numbers[label] = known
        elif label not in waiting:
            waiting.append(label)
    for label in waiting:
        if label not in numbers:
            free = 0 if label == _NOISE and 0 not in numbers.values() else _free(numbers)
            if free is not None:
                numbers[label] = free
    return numbers


def _free(numbers: Mapping[str, int]) -> int | None:
    return next((k for k in range(1, _MOST + 1) if k not in numbers.values()), None)


def _category_rows(categories: Mapping[str, str], classes: _PointClasses) -> list[dict[str, str | int]]:
    """Rows of categories: those of boxes and those of points; where points are labelled, each has a number."""
    names = dict.fromkeys([*categories, *classes.numbers])
    if classes.numbers and 0 not in classes.numbers.values():
        names = {_NOISE: None, **names}
    taken = {**({_NOISE: 0} if _NOISE in names else {}), **classes.numbers}
    rows: list[dict[str, str | int]] = []
    number = _MOST
    for name in names:
        row: dict[str, str | int] = {
            "token": categories.get(name, token_of("category", name)),
            "name": name,
            "description": "",
        }
        if classes.numbers:
            number += name not in taken
            row["index"] = taken.get(name, number)
        rows.append(row)
    return rows


_IMAGES = ("copy", "png")
"""How images are written."""

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

_MAP = "maps/none.png"
"""A mask without anything on it: the development kit wants one for each log."""


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
    """Write a scene as a data set; frames are read, written and let go one by one.

    Args:
        scene: what to write.
        path: the folder that is made.
        overwrite: replace the folder if it is a data set, or empty; nobody else's folder is ever replaced.
        version: name of the folder of tables; None: that which the scene was read from, else `v1.0-sceneloom`.
        keyframe_rate_hz: samples a second; None: those that the scene was read with, else two a second.
        images: "copy" copies JPEG and PNG files, and writes others as JPEG; "png" writes them as PNG.
        channel: channels of sensors, as `lidar=LIDAR_TOP,camera0=CAM_FRONT` or one text for each; others get the name
            that nuScenes has for the lidar or for the only camera that with their viewing direction, else their id.
        trajectory: name of the ego's, as of `ego_in_world`.

    Returns:
        What the tables could not hold.

    Raises:
        OptionError: an option is none of these.
        PoseError: the trajectory cannot be taken.
        OutputError: the path exists, or cannot be written.
        CalibrationError: a camera model cannot be computed with.
        DataError: what the scene is read from is damaged, or has no frame at all.
    """
    if images not in _IMAGES:
        raise OptionError(f"images {images!r}; nuScenes takes {', '.join(_IMAGES)}")
    if version is not None and not is_version(version):
        raise OptionError(f"version {version!r}; expected a name such as v1.0-mini")
    rate_hz = None if keyframe_rate_hz is None else as_positive("keyframe_rate_hz", keyframe_rate_hz)
    plan = WritingPlan.of(scene, path, version, rate_hz, channels_of(scene, channel), trajectory)
    with replacing(path, overwrite=overwrite, folder=_KIND) as draft:
        losses = _Writer(plan, draft, images).write()
    return LossReport.of([*plan.losses, *losses])


@dataclass(slots=True)
class _Writer:
    """Writes one data set into an empty folder."""

    plan: WritingPlan
    root: Path
    images: str
    losses: _FrameLosses = field(default_factory=_FrameLosses)
    calibrations: dict[str, dict[str, Any]] = field(default_factory=dict)

    @property
    def tables(self) -> Path:
        return self.root / self.plan.version

    def write(self) -> _FrameLosses:
        """Write all files; give what was lost."""
        plan = self.plan
        self.tables.mkdir()
        boxes = _Boxes.of(plan.scene, plan.samples)
        classes = _PointClasses.of(plan.scene, self.losses)
        with _TableWriter(self.tables, "sample_data") as rows, _TableWriter(self.tables, "ego_pose") as poses:
            for channel in plan.channels:
                self._write_channel(channel, rows, poses, boxes, classes)
        self.losses.add("annotations.labeled_points", "classes of sweeps between samples are left out", classes.left())
        categories = _categories_of(plan.scene)
        _write_boxes(self.tables, plan.about[0].name, boxes, plan.samples, categories, self.losses)
        _write_table(self.tables, "category", _category_rows(categories, classes))
        if classes.rows:
            _write_table(self.tables, "lidarseg", classes.rows)
        self._write_sensors()
        self._write_samples()
        return self.losses

    def _write_channel(
        self, channel: Channel, rows: _TableWriter, poses: _TableWriter, boxes: _Boxes, classes: _PointClasses
    ) -> None:
        plan, sensor = self.plan, channel.sensor
        timestamps = timestamps_of(sensor)
        timestamps_us, egos = microseconds(timestamps), plan.egos_at(timestamps)
        is_key = plan.samples.key_rows(sensor)
        samples = plan.samples.numbers(sensor, is_key)
        tokens = [token_of("sample_data", plan.about[0].name, channel.name, k) for k in range(len(timestamps))]
        stems = _stems(plan.about[0].name, channel, timestamps_us.tolist())
        for k, token in enumerate(tokens):
            folder = self.root / ("samples" if is_key[k] else "sweeps") / channel.folder
            folder.mkdir(parents=True, exist_ok=True)
            written = self._write_frame(channel, k, folder / stems[k], egos[k])
            if written.points_world is not None and is_key[k]:
                name = "num_lidar_pts" if isinstance(sensor, LidarSensor) else "num_radar_pts"
                boxes.count(name, int(samples[k]), written.points_world)
                if isinstance(sensor, LidarSensor):
                    self._write_classes(classes, channel, k, token, len(written.points_world))
            poses.add(token=token, timestamp=int(timestamps_us[k]), **_placed(egos[k]))
            rows.add(
                token=token,
                sample_token=plan.samples.tokens[int(samples[k])],
                ego_pose_token=token,
                calibrated_sensor_token=self._calibration(channel, written.mount, written.camera_model),
                timestamp=int(timestamps_us[k]),
                fileformat=written.path.suffix[1:] if written.camera_model is not None else "pcd",
                is_key_frame=bool(is_key[k]),
                height=0 if written.camera_model is None else written.camera_model.height,
                width=0 if written.camera_model is None else written.camera_model.width,
                filename=written.path.relative_to(self.root).as_posix(),
                prev=tokens[k - 1] if k else "",
                next=tokens[k + 1] if k + 1 < len(tokens) else "",
            )
        self._report_times(channel, timestamps, timestamps_us)

    def _write_frame(self, channel: Channel, k: int, stem: Path, ego: RigidTransform) -> "_Frame":
        sensor = channel.sensor
        frame: Any = sensor.images[k] if channel.modality == "camera" else sensor.frames[k]  # type: ignore[union-attr]
        for loss in reported(_extras_of(channel), frame.extras, OF_FRAMES):
            self.losses.add(loss.field, loss.what, 1)
        if isinstance(frame, CameraImage):
            path = _write_image(stem, frame, self.images, self.losses)
            return _Frame(path, frame.mount or channel.mount, frame.camera)
        return self._write_points(channel, frame, stem, ego, sensor.points_frame)  # type: ignore[union-attr]

    def _write_points(
        self,
        channel: Channel,
        frame: LidarFrame | RadarFrame,
        stem: Path,
        ego: RigidTransform,
        points_frame: PointsFrame,
    ) -> "_Frame":
        positions = _in_sensor_frame(frame.points.positions, points_frame, channel.mount, ego)
        if isinstance(frame, LidarFrame):
            path = stem.with_name(f"{stem.name}.pcd.bin")
            _write_sweep(path, frame, positions, self.losses)
        else:
            path = stem.with_name(f"{stem.name}.pcd")
            _write_cycle(path, frame, positions, self.losses)
        world = (ego @ channel.mount).apply(np.asarray(positions, np.float32))
        return _Frame(path, channel.mount, points_world=world)

    def _write_classes(self, classes: _PointClasses, channel: Channel, k: int, token: str, count: int) -> None:
        frame = (_sensor_key(channel.sensor), k)
        classes.write(self.root, self.plan.version, token, frame, count, self.losses)

    def _calibration(self, channel: Channel, mount: RigidTransform, camera_model: Camera | None) -> str:
        """The token of a mounting and a camera model; their row is kept for later."""
        numbers = [] if camera_model is None else camera_model.matrix.tolist()
        token = token_of("calibrated_sensor", channel.name, mount.matrix.tolist(), numbers)
        if token not in self.calibrations:
            row = {"sensor_token": channel.token, **_placed(mount), "camera_intrinsic": numbers}
            self.calibrations[token] = row
        return token

    def _report_times(self, channel: Channel, timestamps: AnyArray, timestamps_us: AnyArray) -> None:
        off = _differences_us(timestamps, timestamps_us)
        location = f"sensors.{channel.modality}.{'images' if channel.modality == 'camera' else 'frames'}"
        count = int((timestamps != timestamps_us * 1000).sum())
        what = "rounded to microseconds [ns]"
        self.losses.add(f"{location}.timestamp_ns", what, count, Support.CONVERTED, error=off)
        beyond = self.plan.beyond(timestamps)
        what = "frames beyond the ego trajectory have its end poses"
        self.losses.add("trajectories.positions", what, beyond, Support.APPROXIMATED)

    def _write_sensors(self) -> None:
        sensors: Iterable[_Row] = (
            {"token": channel.token, "channel": channel.name, "modality": channel.modality}
            | ({} if channel.name == channel.sensor.id else {"sensor_id": channel.sensor.id})
            for channel in self.plan.channels
        )
        _write_table(self.tables, "sensor", sensors)
        rows = ({"token": token, **row} for token, row in self.calibrations.items())
        _write_table(self.tables, "calibrated_sensor", rows)

    def _write_samples(self) -> None:
        scene, log = self.plan.about
        tokens, times = self.plan.samples.tokens, microseconds(self.plan.samples.timestamps_ns).tolist()
        with _TableWriter(self.tables, "sample") as table:
            for k, token in enumerate(tokens):
                table.add(
                    token=token,
                    timestamp=times[k],
                    prev=tokens[k - 1] if k else "",
                    next=tokens[k + 1] if k + 1 < len(tokens) else "",
                    scene_token=scene.token,
                )
        scene.nbr_samples, scene.first_sample_token, scene.last_sample_token = (
            len(tokens),
            tokens[0],
            tokens[-1],
        )
        _write_table(self.tables, "scene", [msgspec.structs.asdict(scene)])
        _write_table(self.tables, "log", [msgspec.structs.asdict(log)])
        self._write_map(log.token)

    def _write_map(self, log_token: str) -> None:
        from PIL import Image

        (self.root / _MAP).parent.mkdir()
        Image.new("L", (1, 1)).save(self.root / _MAP)
        row = {
            "category": "semantic_prior",
            "token": token_of("map"),
            "filename": _MAP,
            "log_tokens": [log_token],
        }
        _write_table(self.tables, "map", [row])


def _extras_of(channel: Channel) -> str:
    """The field of the further fields of a channel's frames."""
    return f"sensors.{channel.modality}.{'images' if channel.modality == 'camera' else 'frames'}.extras"


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    """A frame that was written: its file, mounting, camera model of images, points of others."""

    path: Path
    mount: RigidTransform
    camera_model: Camera | None = None
    points_world: AnyArray | None = None


def _stems(name: str, channel: Channel, timestamps_us: Sequence[int]) -> list[str]:
    """Names of files, as nuScenes has them: scene, channel, time; a number where two frames have one time."""
    from sceneloom.formats.base.output import file_stem

    stems: list[str] = []
    seen: dict[int, int] = {}
    for time in timestamps_us:
        number = seen[time] = seen.get(time, 0) + 1
        again = "" if number == 1 else f"~{number}"
        stems.append(f"{file_stem(name)}__{channel.folder}__{time}{again}")
    return stems


def _in_sensor_frame(
    positions: AnyArray, points_frame: PointsFrame, mount: RigidTransform, world_from_ego: RigidTransform
) -> Float64Array | AnyArray:
    """Points (N, 3) [m] in the sensor's frame, by the pose and mounting that are written beside them."""
    if points_frame is PointsFrame.SENSOR:
        return positions
    here = mount if points_frame is PointsFrame.EGO else world_from_ego @ mount
    return here.inverse().apply(positions)


def _write_sweep(path: Path, frame: LidarFrame, positions: AnyArray, losses: _FrameLosses) -> None:
    """Write a sweep as rows of x, y, z, intensity and ring."""
    points = frame.points
    rows = np.zeros(len(points), NUSCENES.dtype)
    rows["x"], rows["y"], rows["z"] = np.asarray(positions).T
    for name, column in (("intensity", points.intensities), ("ring", points.rings)):
        if column is not None:
            rows[name] = column
    location = "sensors.lidar.frames.points"
    count = len(points)
    if points.timestamps_ns is not None:
        losses.add(f"{location}.timestamps_ns", "points have no times", count)
    for name in ("colors", "camera_index"):
        if getattr(points, name) is not None:
            losses.add(f"{location}.{name}", "points have x, y, z, intensity and ring", count)
    if points.extras:
        losses.add(f"{location}.extras", "points have x, y, z, intensity and ring", count)
    path.write_bytes(rows.tobytes())


def _write_cycle(path: Path, frame: RadarFrame, positions: AnyArray, losses: _FrameLosses) -> None:
    """Write a radar cycle as a PCD file; one without returns has a return that is no number, as nuScenes has it."""
    points = frame.points
    count = len(points)
    rows = np.zeros(max(count, 1), _RADAR_ROW)
    rows["x"] = np.nan if count == 0 else 0.0
    location = "sensors.radar.frames.points"
    if count:
        for axis, column in zip("xyz", np.asarray(positions).T, strict=True):
            rows[axis] = column
        _fill_radar(rows, points.extras)
        _fill_velocities(rows, frame, losses)
    known = set(_RADAR_ROW.names or ())
    if set(points.extras) - known:
        losses.add(f"{location}.extras", "returns have the columns of nuScenes' radars", count)
    if points.timestamps_ns is not None:
        losses.add(f"{location}.timestamps_ns", "points have no times", count)
    # the development kit wants a byte after the last row, as nuScenes' own files have one
    path.write_bytes(_pcd_head(len(rows)) + rows.tobytes() + b"\n")


def _fill_radar(rows: AnyArray, extras: Any) -> None:
    for name, _, _ in _RADAR[3:]:
        column = extras.get(name)
        usable = column is not None and column.shape == rows.shape and column.dtype.kind in "fiub"
        rows[name] = column if usable else _USUAL.get(name, 0)
    if "id" not in extras:
        rows["id"] = np.arange(len(rows)) % (1 << 15)


def _fill_velocities(rows: AnyArray, frame: RadarFrame, losses: _FrameLosses) -> None:
    points, location = frame.points, "sensors.radar.frames.points"
    if points.directions is None or points.lengths is None:
        return
    velocities = points.directions * points.lengths[:, None]
    if "vx" not in points.extras or "vy" not in points.extras:
        rows["vx"], rows["vy"] = velocities[:, 0], velocities[:, 1]
        upright = np.abs(velocities[:, 2])
        what = "the part of the speed along the sensor's z is left out [m/s]"
        error = float(upright.max(initial=0.0))
        losses.add(f"{location}.directions", what, int((upright > 0).sum()), Support.APPROXIMATED, error=error)
    if "vx_comp" not in points.extras:
        rows["vx_comp"], rows["vy_comp"] = rows["vx"], rows["vy"]


def _pcd_head(count: int) -> bytes:
    lines = (
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(name for name, _, _ in _RADAR)}",
        f"SIZE {' '.join(str(size) for _, _, size in _RADAR)}",
        f"TYPE {' '.join(letter for _, letter, _ in _RADAR)}",
        f"COUNT {' '.join('1' for _ in _RADAR)}",
        f"WIDTH {count}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {count}",
        "DATA binary",
    )
    return ("\n".join(lines) + "\n").encode()


def _write_image(stem: Path, image: CameraImage, form: str, losses: _FrameLosses) -> Path:
    """Write an image: a JPEG or PNG file as it is, else anew; gives its path, with its suffix.

    Args:
        stem: the path without suffix.
        image: what is written.
        form: "copy" writes anew what is no such file as JPEG, "png" everything that is no PNG as PNG.
        losses: takes what is lost.

    Raises:
        DataError: it cannot be decoded.
    """
    source = image.decode
    is_png = isinstance(source, ImageFile) and source.path.suffix.lower() == ".png"
    if is_png or form == "png":
        path = stem.with_name(f"{stem.name}.png")
        path.write_bytes(source.encoded() if isinstance(source, ImageFile) and is_png else _png(image))
        return path
    path = stem.with_name(f"{stem.name}.jpg")
    if image.encoded is not None:
        path.write_bytes(image.encoded())
        return path
    from simplejpeg import encode_jpeg

    rgb = np.ascontiguousarray(image.rgb)
    path.write_bytes(encode_jpeg(rgb, _JPEG_QUALITY, "RGB", colorsubsampling="444"))
    what = f"encoded as JPEG of quality {_JPEG_QUALITY}"
    losses.add("sensors.camera.images.rgb", what, 1, Support.APPROXIMATED)
    return path


def _png(image: CameraImage) -> bytes:
    from io import BytesIO

    from PIL import Image

    content = BytesIO()
    Image.fromarray(image.rgb).save(content, "PNG", compress_level=1)
    return content.getvalue()


def _wxyz(quaternion_xyzw: Float64Array) -> list[float]:
    """A rotation as the tables have it."""
    x, y, z, w = quaternion_xyzw.tolist()
    return [w, x, y, z]


def _placed(transform: RigidTransform) -> dict[str, list[float]]:
    """A transform as two fields of a row."""
    return {
        "translation": transform.translation.tolist(),
        "rotation": _wxyz(transform.quaternion_xyzw),
    }


def _write_table(folder: Path, name: str, rows: Iterable[_Row]) -> None:
    """Write a whole table."""
    with _TableWriter(folder, name) as table:
        for row in rows:
            table.add(**row)


def _sensor_key(sensor: Written) -> Any:
    """What labelled points call a sensor by."""
    return key_of(sensor.id)


def _differences_us(timestamps_ns: Int64Array, timestamps_us: Int64Array) -> float:
    """How far times are off by being whole microseconds, at most [ns]."""
    return float(np.abs(timestamps_ns - timestamps_us * 1000).max(initial=0))
