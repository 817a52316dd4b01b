"""Segments.ai: releases with point clouds, read and written.

Source: "Sample formats" and "Label formats" of the documentation of Segments.ai, and the models in the module `typing`
of its Python package. Boxes are in the world, look along +x at yaw 0, and have length, width and height as x, y, z;
cameras are placed in the frame of the cloud, by default as OpenGL has them (x right, y up, z backwards).
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, Generic, TypeVar
from urllib.parse import unquote, urlsplit
from uuid import UUID, uuid5

import msgspec
import numpy as np

from sceneloom.arrays import Int64Array, UInt32Array
from sceneloom.cameras.camera import OPENCV_NAMES, Camera
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.json_files import decode_part, read_json
from sceneloom.formats.base.losses import LossReport
from sceneloom.formats.base.output import FolderKind, file_stem, replacing
from sceneloom.formats.cloud_labelling.spec import SEGMENTS_SUPPORTS, segments_release
from sceneloom.formats.cloud_labelling.tasks import (
    XYZ,
    TaskFrame,
    TaskImage,
    TaskOptions,
    TaskPlan,
    TaskTracks,
    TaskWorld,
    WrittenFrame,
    WrittenImage,
    camera_of,
    cameras_of,
    frame_times,
    headings_of,
    instance_points,
    lidar_of,
    note_missing_clouds,
    pinhole_of,
    rigid_of,
    task_scene,
    xyz,
)
from sceneloom.formats.points.reader import stem_of, times_of_names
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations import CuboidAnnotation, LabeledPointsAnnotation
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, Key, key_of
from sceneloom.warnings import WarningKind

_CUBOIDS, _SEGMENTATION = "pointcloud-cuboid", "pointcloud-segmentation"
_SEQUENCE, _MULTISENSOR = "-sequence", "multisensor-sequence"
_TASKS: Mapping[str, str] = {"cuboids": _CUBOIDS, "segmentation": _SEGMENTATION}
_VERSION = "0.2"

_ID = "sceneloom_id"
"""The attribute of an object that has the id of its annotation, as JSON, where that is no number above 0."""

_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])
_DISTORTIONS: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "fisheye": ("fisheye", ("k1", "k2", "k3", "k4")),
    "brown-conrady": ("brown_conrady", OPENCV_NAMES[:5]),
}
"""Camera models by the tool's names, and the order of their coefficients."""

_NAMESPACE = UUID("b7fd0a0c-94a2-5b5e-8a66-5ad1d9a6a0e1")  # of the uuids that are made here


class _Quaternion(msgspec.Struct):
    qx: float
    qy: float
    qz: float
    qw: float

    @property
    def xyzw(self) -> tuple[float, float, float, float]:
        return self.qx, self.qy, self.qz, self.qw

    @classmethod
    def of(cls, quaternion_xyzw: Iterable[float]) -> "_Quaternion":
        return cls(*map(float, quaternion_xyzw))


class _Pcd(msgspec.Struct):
    url: str
    type: str = "pcd"


class _Pose(msgspec.Struct):
    position: XYZ
    heading: _Quaternion


class _Intrinsics(msgspec.Struct):
    intrinsic_matrix: list[list[float]]


class _Extrinsics(msgspec.Struct):
    translation: XYZ
    rotation: _Quaternion


class _Distortion(msgspec.Struct):
    model: str
    coefficients: dict[str, float]


class _Image(msgspec.Struct):
    url: str
    name: str | None = None
    intrinsics: _Intrinsics | None = None
    extrinsics: _Extrinsics | None = None
    distortion: _Distortion | None = None
    camera_convention: str | None = None


class _SampleFrame(msgspec.Struct):
    pcd: _Pcd
    images: list[_Image] | None = None
    ego_pose: _Pose | None = None
    name: str | None = None
    timestamp: int | str | None = None


class _Object(msgspec.Struct):
    category_id: int
    id: int | None = None
    track_id: int | None = None
    type: str = ""
    position: XYZ | None = None
    dimensions: XYZ | None = None
    yaw: float = 0.0
    rotation: _Quaternion | None = None
    attributes: dict[str, Any] | None = None


class _LabelFrame(msgspec.Struct):
    annotations: list[_Object]
    point_annotations: list[int] | None = None


class _Category(msgspec.Struct):
    id: int
    name: str
    has_instances: bool | None = None


class _TaskAttributes(msgspec.Struct):
    categories: list[_Category] | None = None


class _Label(msgspec.Struct):
    attributes: msgspec.Raw = msgspec.Raw(b"null")


class _Sample(msgspec.Struct):
    name: str
    attributes: msgspec.Raw
    labels: dict[str, _Label | None] = {}
    uuid: str = ""


class _Dataset(msgspec.Struct):
    task_type: str
    samples: list[_Sample]
    task_attributes: _TaskAttributes | None = None
    name: str = ""


class _Release(msgspec.Struct):
    dataset: _Dataset
    name: str = ""


def sample_names(path: Path) -> tuple[str, ...]:
    """Names of the samples of a release.

    Raises:
        DataError: it is no release.
    """
    return tuple(sample.name for sample in read_json(_release_path(path), _Release).dataset.samples)


def _release_path(path: Path) -> Path:
    found = segments_release(path)
    if found is None:
        raise DataError(path, "", "no release; expected a JSON file of Segments.ai with point clouds")
    return found


def open_segments(
    path: Path,
    *,
    sequence: str | None = None,
    labelset: str | None = None,
    rate_hz: float | str | None = None,
    lenient: bool = False,
) -> Scene:
    """Open a sample of a release; clouds and images are read on demand, labels at once.

    Args:
        path: the JSON file of a release, or the folder in which it is; files that its URLs name are looked for below
            that folder, and nothing is fetched.
        sequence: name of the sample, where there are several.
        labelset: whose labels; None: "ground-truth" where it is there, else the first one.
        rate_hz: frames a second, where frames have neither times nor names with times.
        lenient: go without frames, images and labels that are wrong, and count them.

    Raises:
        OptionError: there is no such sample or label set, none was chosen of several, or the rate is no number above 0.
    """
    release = _release_path(path)
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        return _Reader(release, ledger, sequence, labelset, rate_hz).scene(path)


class _Reader:
    """One sample of a release."""

    def __init__(
        self, path: Path, ledger: Ledger, sequence: str | None, labelset: str | None, rate_hz: float | str | None
    ) -> None:
        self.path, self.ledger = path, ledger
        dataset = read_json(path, _Release).dataset
        self.dataset = dataset
        names = [sample.name for sample in dataset.samples]
        if not names:
            raise DataError(path, "dataset.samples", "holds no sample; expected at least one")
        if sequence is None and len(names) > 1:
            shown = ", ".join(names[:20])
            raise OptionError(f"{path}: {len(names)} samples; choose one with `--sequence NAME`: {shown}")
        if sequence is not None and sequence not in names:
            raise OptionError(f"{path}: no sample {sequence!r}; it has {', '.join(names[:20])}")
        number = 0 if sequence is None else names.index(sequence)
        self.where = f"dataset.samples[{number}]"
        self.sample = dataset.samples[number]
        self.task = dataset.task_type
        attributes = self._sensor(self.sample.attributes, f"{self.where}.attributes")
        self.listed = self._frames_of(attributes, f"{self.where}.attributes", _SampleFrame)
        if not self.listed:
            raise DataError(path, f"{self.where}.attributes", "holds no frame; expected frames with point clouds")
        self.times_ns = self._times(rate_hz)
        self.frames = [self._frame(k, one) for k, one in enumerate(self.listed)]
        labels = self.sample.labels
        if labelset is not None and labelset not in labels:
            raise OptionError(f"{path}: no label set {labelset!r}; it has {', '.join(labels) or 'none'}")
        chosen = labelset or ("ground-truth" if "ground-truth" in labels else next(iter(labels), None))
        others = [name for name, label in labels.items() if name != chosen and label is not None]
        if others:
            message = f"label sets {', '.join(others)} are left out; `--input-option labelset=NAME` chooses one"
            ledger.note(WarningKind.SKIPPED, "label-sets", f"{path}: {self.where}", message)
        self.labelset = chosen

    def scene(self, source: Path) -> Scene:
        ledger, folder = self.ledger, self.path.parent
        note_missing_clouds(self.frames, self.path, ledger)
        world = TaskWorld.of(self.frames, self.path, ledger)
        listed = self.dataset.task_attributes
        categories = {} if listed is None else {one.id: one for one in listed.categories or ()}
        tracks = TaskTracks()
        points: dict[tuple[Identifier, str | None, bool], dict[int, UInt32Array]] = {}
        for k, (where, label) in enumerate(self._labels()):
            try:
                self._add(k, where, label, categories, tracks, points)
            except DataError as error:
                ledger.fault("labels", error)
        lidar = lidar_of(self.frames, world, ledger, keep_all=bool(points))
        # without poses, the world of the boxes is each cloud's frame
        cuboids = tracks.cuboids(self.times_ns, None, lidar_id=None if lidar is None else lidar.id)
        about = {
            "dataset": self.dataset.name,
            "sample": self.sample.name,
            "task_type": self.task,
            "categories": [msgspec.structs.asdict(one) for one in categories.values()],
        }
        return task_scene(
            [lidar, *cameras_of(self.frames, world, folder, ledger)],
            [*cuboids, *instance_points(points)],
            world,
            ledger,
            source=source,
            format="segments",
            about=about,
        )

    def _sensor(self, raw: msgspec.Raw, where: str) -> msgspec.Raw:
        """The attributes of the clouds among those of several sensors."""
        if self.dataset.task_type != _MULTISENSOR:
            return raw
        found: msgspec.Raw | None = None
        for number, sensor in enumerate(decode_part(self.path, where, raw, _Sensors).sensors):
            if sensor.task_type.startswith("pointcloud-") and found is None:
                found, self.task = sensor.attributes, sensor.task_type
            else:
                message = f"sensors other than the first with point clouds are left out: {sensor.name!r}"
                self.ledger.note(WarningKind.SKIPPED, "other-sensors", f"{where}.sensors[{number}]", message)
        if found is None:
            raise DataError(self.path, f"{where}.sensors", "no sensor with point clouds; expected one")
        return found

    def _frames_of(self, raw: msgspec.Raw, where: str, kind: Any) -> list[Any]:
        """The frames of a sequence, or the only one of a sample that is none."""
        if self.task.endswith(_SEQUENCE):
            holder: Any = _Frames[kind]
            return list(decode_part(self.path, where, raw, holder).frames)
        return [decode_part(self.path, where, raw, kind)]

    def _times(self, rate_hz: float | str | None) -> Int64Array:
        stated = [one.timestamp for one in self.listed]
        numbers = [int(time) for time in stated if isinstance(time, int) or (time is not None and time.isdigit())]
        if rate_hz is None and len(numbers) == len(stated):
            times = np.array([time if abs(time) < 1 << 62 else 1 << 62 for time in numbers], np.int64)
            if (np.diff(times) > 0).all():
                if any(isinstance(time, str) for time in stated):
                    message = "timestamps that are texts are taken for nanoseconds"
                    self.ledger.note(WarningKind.ASSUMED, "timestamps", f"{self.path}: {self.where}", message)
                return times
            message = "timestamps are not in ascending order, and are not used"
            self.ledger.note(WarningKind.SKIPPED, "timestamps", f"{self.path}: {self.where}", message)
        names = [one.name or stem_of(_last_part(one.pcd.url)) for one in self.listed]
        return frame_times(names, self.path, self.ledger, rate_hz=rate_hz)

    def _find(self, url: str, where: str) -> Path | None:
        """The file of a URL below the folder of the release, by its path or last name; None where there is none."""
        folder, parts = self.path.parent, urlsplit(url)
        path = PurePosixPath(unquote(parts.path))
        if not parts.scheme and ("\0" in url or ".." in path.parts):
            raise DataError(self.path, where, f"{url!r}; expected a URL, or the name of a file beside the release")
        named = [folder.joinpath(*path.parts)] if not parts.scheme and not path.is_absolute() else []
        named += [folder / path.name, *(folder / name / path.name for name in ("assets", "pointclouds", "images"))]
        return next((one for one in named if path.name and one.is_file()), None)

    def _frame(self, k: int, one: _SampleFrame) -> TaskFrame:
        where = f"{self.where}.attributes.frames[{k}]"
        cloud = self._find(one.pcd.url, f"{where}.pcd.url")
        if cloud is not None and cloud.suffix.lower() == ".bin" and one.pcd.type not in ("kitti", "binary-xyzi"):
            message = f"clouds of the type {one.pcd.type!r} in files of an unknown layout are left out"
            self.ledger.note(WarningKind.SKIPPED, "cloud-type", f"{self.path}: {where}", message)
            cloud = None
        pose = None
        if one.ego_pose is not None:
            position = one.ego_pose.position.array(self.path, f"{where}.ego_pose.position")
            pose = rigid_of(self.path, f"{where}.ego_pose.heading", position, one.ego_pose.heading.xyzw)
        images = []
        for number, image in enumerate(one.images or ()):
            try:
                found = self._image(k, number, image, f"{where}.images[{number}]")
            except DataError as error:
                self.ledger.fault("images", error)
                continue
            images += [] if found is None else [found]
        return TaskFrame(one.name or str(k), int(self.times_ns[k]), cloud, pose, tuple(images))

    def _image(self, k: int, number: int, image: _Image, where: str) -> TaskImage | None:
        path = self._find(image.url, f"{where}.url")
        if path is None:
            self.ledger.note(WarningKind.SKIPPED, "images-missing", f"{self.path}: {where}", "images are not there")
            return None
        if image.intrinsics is None or image.extrinsics is None:
            message = "images without intrinsics and extrinsics are left out"
            self.ledger.note(WarningKind.SKIPPED, "images-without-calibration", f"{self.path}: {where}", message)
            return None
        matrix = [value for row in image.intrinsics.intrinsic_matrix for value in row]
        camera = pinhole_of(self.path, f"{where}.intrinsics.intrinsic_matrix", path, matrix, self.ledger)
        if image.distortion is not None:
            camera = self._distorted(camera, image.distortion, path, where)
        position = image.extrinsics.translation.array(self.path, f"{where}.extrinsics.translation")
        rotation = image.extrinsics.rotation.xyzw
        pose = rigid_of(self.path, f"{where}.extrinsics.rotation", position, rotation)
        if image.camera_convention != "OpenCV":
            pose = RigidTransform(pose.rotation @ _OPENCV_FROM_OPENGL, pose.translation)
        name = path.relative_to(self.path.parent).as_posix()
        time_ns = int(self.times_ns[k])
        stated = _image_time(path.stem)
        time_ns = stated if stated is not None and abs(stated - time_ns) < 1_000_000_000 else time_ns
        return TaskImage(image.name or f"camera{number}", path, name, time_ns, camera, pose)

    def _distorted(self, camera: Camera, distortion: _Distortion, image: Path, where: str) -> Camera:
        if distortion.model not in _DISTORTIONS:
            problem = f"{distortion.model!r}; expected one of {', '.join(_DISTORTIONS)}"
            raise DataError(self.path, f"{where}.distortion.model", problem)
        model, names = _DISTORTIONS[distortion.model]
        coefficients = [distortion.coefficients.get(name, 0.0) for name in names]
        numbers = (camera.fx, camera.fy, camera.cx, camera.cy)
        return camera_of(self.path, f"{where}.distortion", image, model, numbers, coefficients)

    def _labels(self) -> Iterator[tuple[str, _LabelFrame]]:
        """The labels of each frame, where there are any."""
        label = None if self.labelset is None else self.sample.labels[self.labelset]
        where = f"{self.where}.labels[{self.labelset}].attributes"
        if label is None or bytes(label.attributes) in (b"null", b"[]"):
            message = "the sample has no labels"
            self.ledger.note(WarningKind.SKIPPED, "unlabelled", f"{self.path}: {self.where}", message)
            return
        raw = self._sensor(label.attributes, where)
        found = self._frames_of(raw, where, _LabelFrame)
        if len(found) > len(self.frames):
            problem = f"{len(found)} frames; expected {len(self.frames)}, as many as the sample has"
            self.ledger.fault("label-frames", DataError(self.path, where, problem))
        for k, frame in enumerate(found[: len(self.frames)]):
            yield f"{where}.frames[{k}]", frame

    def _add(
        self,
        k: int,
        where: str,
        label: _LabelFrame,
        categories: Mapping[int, _Category],
        tracks: TaskTracks,
        points: dict[tuple[Identifier, str | None, bool], dict[int, UInt32Array]],
    ) -> None:
        objects: dict[int, tuple[Identifier, str, bool]] = {}
        for row, one in enumerate(label.annotations):
            at = f"{where}.annotations[{row}]"
            number = one.id if one.track_id is None else one.track_id
            if number is None:
                raise DataError(self.path, at, "has neither track_id nor id")
            category = categories.get(one.category_id)
            name = f"category {one.category_id}" if category is None else category.name
            stated = dict(one.attributes or {})
            identifier = self._identifier(at, number, stated)
            objects[number] = (identifier, name, category is None or category.has_instances is not False)
            if one.type.startswith("cuboid") or (one.type == "" and one.position is not None):
                self._add_cuboid(k, at, identifier, name, one, stated, tracks)
            elif one.type:
                message = f"objects of the type {one.type!r} are left out"
                self.ledger.note(WarningKind.SKIPPED, "objects-left-out", f"{self.path}: {at}", message)
        if label.point_annotations is None:
            return
        row = sum(frame.cloud is not None for frame in self.frames[:k])
        if self.frames[k].cloud is None:
            message = "labelled points of frames without a cloud are left out"
            self.ledger.note(WarningKind.SKIPPED, "points-without-cloud", f"{self.path}: {where}", message)
            return
        numbers = np.array(label.point_annotations, np.int64)
        for number in np.unique(numbers).tolist():
            if number in objects:
                rows = np.flatnonzero(numbers == number).astype(np.uint32)
                points.setdefault(objects[number], {})[row] = rows
            elif number != 0:
                raise DataError(self.path, f"{where}.point_annotations", f"{number} is none of the annotations' ids")

    def _identifier(self, where: str, number: int, stated: dict[str, Any]) -> Identifier:
        kept = stated.pop(_ID, None)
        if kept is None:
            return number
        try:
            return msgspec.json.decode(str(kept), type=int | str)
        except msgspec.MsgspecError as error:
            raise DataError(self.path, where, f"{_ID} {kept!r}; expected a text or number as JSON") from error

    def _add_cuboid(
        self,
        k: int,
        where: str,
        identifier: Identifier,
        name: str,
        one: _Object,
        stated: Mapping[str, Any],
        tracks: TaskTracks,
    ) -> None:
        if one.position is None or one.dimensions is None:
            raise DataError(self.path, where, "a cuboid without position and dimensions; expected both")
        half = 0.5 * float(one.yaw)
        quaternion = (0.0, 0.0, np.sin(half), np.cos(half)) if one.rotation is None else one.rotation.xyzw
        rotation = rigid_of(self.path, f"{where}.rotation", np.zeros(3), quaternion).quaternion_xyzw
        position = one.position.array(self.path, f"{where}.position")
        size = one.dimensions.array(self.path, f"{where}.dimensions")
        known = {key: value for key, value in stated.items() if value is not None}
        tracks.add(self.path, where, identifier, k, name, (position, size, rotation), stated=known)


class _Sensor(msgspec.Struct):
    name: str
    task_type: str
    attributes: msgspec.Raw


class _Sensors(msgspec.Struct):
    sensors: list[_Sensor]


_Frame = TypeVar("_Frame", _SampleFrame, _LabelFrame)


class _Frames(msgspec.Struct, Generic[_Frame]):
    frames: list[_Frame]


def _last_part(url: str) -> str:
    return PurePosixPath(unquote(urlsplit(url).path)).name


def _image_time(stem: str) -> int | None:
    """The time that the name of an image ends with, where it does."""
    times = times_of_names([stem])
    return None if times is None else times[0]


# writing

_KIND = FolderKind(
    "release for Segments.ai", (r"release\.json", r"pointclouds/.+\.pcd", r"images/.+/.+\.(jpg|png)"), r"release\.json"
)


def write_segments(
    scene: Scene,
    path: Path,
    *,
    overwrite: bool = False,
    task: str | None = None,
    lidar: str | None = None,
    points_frame: str | None = None,
    trajectory: str | None = None,
) -> LossReport:
    """Write a scene as a release with one sample; frames are read, written and released one by one.

    URLs are paths below the folder: they become those of the assets when these are uploaded.

    Args:
        overwrite: replace the folder if it is such a release, or empty.
        task: "cuboids" or "segmentation"; None: cuboids, unless the scene has labelled points only.
        lidar, points_frame, trajectory: as of `TaskOptions`.

    Raises:
        OptionError: an option is none of these, or the scene has no sweep.
        DataError: a frame or image cannot be read.
    """
    if task is not None and task not in _TASKS:
        raise OptionError(f"task {task!r}; expected one of {', '.join(_TASKS)}")
    kinds = {type(one) for one in scene.annotations}
    if task is None:
        only_points = LabeledPointsAnnotation in kinds and CuboidAnnotation not in kinds
        task = "segmentation" if only_points else "cuboids"
    options = TaskOptions(lidar, points_frame, trajectory)
    models = ("pinhole", *(model for model, _ in _DISTORTIONS.values()))
    plan = TaskPlan(
        scene,
        SEGMENTS_SUPPORTS,
        options,
        boxes_in_world=True,
        camera_models=models,
        holds_points=task == "segmentation",
    )
    what = f"left out: a task of {task} has no others"
    if task == "segmentation":
        plan.losses.dropped("annotations.cuboid", what, count=len(plan.cuboids))
    else:
        others = sum(isinstance(one, LabeledPointsAnnotation) for one in scene.annotations)
        plan.losses.dropped("annotations.labeled_points", what, count=others)
    with replacing(path, overwrite=overwrite, folder=_KIND) as draft:
        _Writer(plan, draft, path.stem, task).write()
    return LossReport.of(plan.losses)


@dataclass(slots=True)
class _Writer:
    """Writes one release."""

    plan: TaskPlan
    root: Path
    name: str
    task: str
    numbers: dict[Key, int] = field(default_factory=dict)
    categories: dict[str, int] = field(default_factory=dict)
    values: dict[str, set[str]] = field(default_factory=dict)  # kinds of the values of attributes, by name

    def write(self) -> None:
        (self.root / "pointclouds").mkdir()
        cuboids, points = self.plan.cuboids, self.plan.labelled
        self.numbers = _numbers([one.id for one in (cuboids if self.task == "cuboids" else points)])
        clouds = self.plan.clouds()
        frames, labels = [], []
        for frame in self.plan:
            name = f"pointclouds/{frame.name}.pcd"
            clouds.write_frame(self.plan.lidar, frame.sweep, self.root / name)
            frames.append(self._frame(frame, name))
            labels.append(msgspec.Raw(msgspec.json.encode(self._label(frame))))  # a number per point, as a text
        kind = f"{_TASKS[self.task]}{_SEQUENCE}"
        sample = {
            "uuid": str(uuid5(_NAMESPACE, "\0".join((self.name, *self.plan.names)))),
            "name": self.name,
            "attributes": {"frames": frames},
            "metadata": {},
            "labels": {
                "ground-truth": {
                    "label_status": "PRELABELED",
                    "attributes": {"format_version": _VERSION, "frames": labels},
                }
            },
        }
        dataset = {
            "name": self.name,
            "task_type": kind,
            "task_attributes": {"format_version": "0.1", "categories": self._categories()},
            "labelsets": [{"name": "ground-truth", "description": "", "is_groundtruth": True}],
            "samples": [sample],
        }
        release = {"name": "sceneloom", "description": "", "dataset": dataset}
        (self.root / "release.json").write_bytes(msgspec.json.encode(release))

    def _categories(self) -> list[dict[str, Any]]:
        attributes = [
            {"name": name, "input_type": "checkbox" if kinds == {"bool"} else "text"}
            for name, kinds in self.values.items()
        ]
        more = {"has_instances": True} if self.task == "segmentation" else {}
        return [
            {"id": number, "name": name, "attributes": attributes, **more} for name, number in self.categories.items()
        ]

    def _frame(self, frame: WrittenFrame, cloud: str) -> dict[str, Any]:
        pose = frame.world_from_cloud
        images = [self._image(number, image) for number, image in enumerate(frame.images)]
        return {
            "pcd": {"url": cloud, "type": "pcd"},
            "images": images,
            "name": frame.name,
            "timestamp": frame.timestamp_ns,
            **({"ego_pose": {"position": xyz(pose.translation), "heading": _q(pose)}} if self.plan.posed else {}),
        }

    def _image(self, number: int, written: WrittenImage) -> dict[str, Any]:
        path = self.plan.write_image(written, self.root / "images" / file_stem(written.camera_id))
        camera, pose = written.image.camera, written.cloud_from_camera
        record: dict[str, Any] = {
            "name": str(written.camera_id),
            "url": path.relative_to(self.root).as_posix(),
            "row": 0,
            "col": number,
            "intrinsics": {"intrinsic_matrix": [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]},
            "camera_convention": "OpenCV",
        }
        if pose is None:
            what = "images of cameras whose mounting is not known are written without extrinsics"
            self.plan.losses.dropped("sensors.camera.camera", what)
        else:
            record["extrinsics"] = {"translation": xyz(pose.translation), "rotation": _q(pose)}
        known = {model: (name, names) for name, (model, names) in _DISTORTIONS.items()}
        if camera.model in known:
            name, names = known[camera.model]
            values = [*camera.coefficients, *[0.0] * len(names)][: len(names)]
            if any(camera.coefficients[len(names) :]):
                what = f"coefficients of brown_conrady beyond {', '.join(names)} are left out"
                self.plan.losses.approximated("sensors.camera.camera", what)
            record["distortion"] = {"model": name, "coefficients": dict(zip(names, map(float, values), strict=True))}
        return record

    def _label(self, frame: WrittenFrame) -> dict[str, Any]:
        label: dict[str, Any] = {"format_version": _VERSION, "timestamp": frame.timestamp_ns}
        if self.task == "cuboids":
            return {**label, "annotations": self._cuboids(frame)}
        numbers = np.zeros(len(frame.sweep.points), np.int64)
        annotations = []
        again = 0
        for row, rows in frame.labelled:
            one = self.plan.labelled[row]
            again += int((numbers[rows] != 0).sum())
            numbers[rows] = self.numbers[key_of(one.id)]
            annotations.append(self._object(one.id, one.label, {}))
        self.plan.losses.approximated(
            "annotations.labeled_points.labeled_points.point_ids",
            "points of several annotations have the last one",
            count=again,
        )
        return {**label, "annotations": annotations, "point_annotations": numbers.tolist()}

    def _cuboids(self, frame: WrittenFrame) -> list[dict[str, Any]]:
        yaws, _ = headings_of(frame.boxes)
        return [
            {
                **self._object(box.cuboid.id, box.cuboid.label, box.stated),
                "type": "cuboid",
                "position": xyz(box.center),
                "dimensions": xyz(box.size_lwh),
                "yaw": float(yaw),
                "rotation": msgspec.structs.asdict(_Quaternion.of(box.quaternion_xyzw.tolist())),
                "is_keyframe": True,
                "index": frame.number,
            }
            for box, yaw in zip(frame.boxes, yaws, strict=True)
        ]

    def _object(self, identifier: Identifier, label: str | None, stated: Mapping[str, Any]) -> dict[str, Any]:
        number = self.numbers[key_of(identifier)]
        if label is None:
            self.plan.losses.converted("annotations.cuboid.label", "objects without a class become `unknown`")
        category = self.categories.setdefault(label or "unknown", len(self.categories) + 1)
        attributes = {name: self._value(name, value) for name, value in stated.items() if value is not None}
        if number != identifier:
            what = f"tracks are called by numbers; the id is kept as the attribute `{_ID}`"
            self.plan.losses.converted("annotations.cuboid.id", what)
            attributes[_ID] = json.dumps(identifier, ensure_ascii=False)
            self.values.setdefault(_ID, set()).add("str")
        return {"id": number, "track_id": number, "category_id": category, "attributes": attributes}

    def _value(self, name: str, value: Any) -> str | bool | int:
        """A value as attributes have it: a text, a whole number, or true or false."""
        held: str | bool | int
        if isinstance(value, str | bool | int):
            held = value
        else:
            what = "values that are neither texts, whole numbers nor true or false are written as texts"
            self.plan.losses.converted("annotations.cuboid.attributes", what)
            held = ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
        self.values.setdefault(name, set()).add(type(held).__name__)
        return held


def _numbers(identifiers: Sequence[Identifier]) -> dict[Key, int]:
    """Numbers of tracks, from 1 on: ids that are such numbers are their own."""
    found = {key_of(one): one for one in identifiers if isinstance(one, int) and 0 < one < 1 << 53}
    taken, free = set(found.values()), 1
    for one in identifiers:
        if key_of(one) in found:
            continue
        while free in taken:
            free += 1
        taken.add(free)
        found[key_of(one)] = free
    return found


def _q(pose: RigidTransform) -> dict[str, float]:
    found: dict[str, float] = msgspec.structs.asdict(_Quaternion.of(pose.quaternion_xyzw.tolist()))
    return found
