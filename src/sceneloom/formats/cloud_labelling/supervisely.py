"""Supervisely: episodes of point clouds and projects of single clouds, read and written.

Source: "Point Cloud Annotation" and "Point Cloud Episode Annotation" of Supervisely's developer portal: a cuboid's x, y
and z are width, length and height, it looks along +y at yaw 0, and `extrinsicMatrix` takes points of the cloud into the
camera. In which order the three angles rotate is not stated there: they are taken as those of three.js, Rx·Ry·Rz.
"""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from uuid import UUID, uuid5
from zlib import crc32

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, UInt32Array
from sceneloom.errors import DataError, check_choice
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.json_files import decode_part, read_json
from sceneloom.formats.base.losses import LossReport
from sceneloom.formats.base.output import FolderKind, file_stem, replacing
from sceneloom.formats.base.spec import choose_drive
from sceneloom.formats.cloud_labelling.spec import SUPERVISELY_SUPPORTS, supervisely_datasets
from sceneloom.formats.cloud_labelling.tasks import (
    SECOND_NS,
    XYZ,
    TaskFrame,
    TaskImage,
    TaskOptions,
    TaskPlan,
    TaskTracks,
    TaskWorld,
    WrittenFrame,
    WrittenImage,
    cameras_of,
    frame_times,
    instance_points,
    lidar_of,
    note_missing_clouds,
    pinhole_of,
    rigid_of_rows,
    task_file,
    task_scene,
    xyz,
)
from sceneloom.formats.points.reader import stem_of
from sceneloom.geometry.euler import AngleUnit, cuboid_angles_from_rotation, rotation_from_cuboid_angles
from sceneloom.geometry.rigid import matrix_from_quaternion, quaternion_from_matrix
from sceneloom.scene.annotations import AttributePath
from sceneloom.scene.annotations_at import attribute_at
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, Key, key_of
from sceneloom.warnings import WarningKind

_EPISODES, _CLOUDS = "point_cloud_episodes", "point_clouds"
_PROJECTS: Mapping[str, str] = {"episodes": _EPISODES, "clouds": _CLOUDS}

_CUBOID, _POINTS, _ANY = "cuboid_3d", "point_cloud", "any"

_ID = "sceneloom:id"
"""The tag of an object that has the id of its annotation, as JSON, where that is no key."""

_KEY = re.compile(r"[0-9a-f]{32}")
_NAMESPACE = UUID("6f1d3d0e-6d38-5d0c-9a60-2c3f4b1f7a55")  # of the keys that are made here

_FORWARD_Y = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Tool's box from ours: their boxes look along y, ours along x."""

_TRUTHS = ("true", "false")
_DATE = re.compile(r"(?P<seconds>\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d)(?:\.(?P<part>\d{1,9})\d*)?(?P<zone>Z|[+-]\d\d:?\d\d)?")
_NEAR_NS = SECOND_NS  # images and clouds that are farther apart have different clocks
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


class _Tag(msgspec.Struct):
    name: str
    value: Any = None
    frameRange: tuple[int, int] | None = None  # noqa: N815 - the format's word


class _Object(msgspec.Struct):
    classTitle: str  # noqa: N815
    key: str = ""
    id: int | None = None
    tags: list[_Tag] = []


class _Figure(msgspec.Struct):
    geometryType: str  # noqa: N815
    geometry: msgspec.Raw
    objectKey: str = ""  # noqa: N815
    objectId: int | None = None  # noqa: N815


class _Frame(msgspec.Struct):
    index: int
    figures: list[_Figure]


class _Episode(msgspec.Struct):
    objects: list[_Object]
    frames: list[_Frame]
    tags: list[_Tag] = []
    description: str = ""


class _CloudLabels(msgspec.Struct):
    objects: list[_Object]
    figures: list[_Figure]
    tags: list[_Tag] = []


class _Class(msgspec.Struct):
    title: str
    shape: str = ""
    color: str = ""


class _TagMeta(msgspec.Struct):
    name: str
    value_type: str = ""
    values: list[str] = []


class _Meta(msgspec.Struct):
    classes: list[_Class]
    tags: list[_TagMeta] = []


class _Cuboid(msgspec.Struct):
    position: XYZ
    rotation: XYZ
    dimensions: XYZ


class _Indices(msgspec.Struct):
    indices: list[int]


class _SensorsData(msgspec.Struct):
    extrinsicMatrix: list[float] | None = None  # noqa: N815
    intrinsicMatrix: list[float] | None = None  # noqa: N815


class _ImageMeta(msgspec.Struct):
    deviceId: str | None = None  # noqa: N815
    timestamp: str | None = None
    sensorsData: _SensorsData | None = None  # noqa: N815


class _ImageFile(msgspec.Struct):
    name: str = ""
    meta: _ImageMeta = msgspec.field(default_factory=_ImageMeta)


def open_supervisely(
    path: Path, *, sequence: str | None = None, rate_hz: float | str | None = None, lenient: bool = False
) -> Scene:
    """Open a dataset of a project; clouds and images are read on demand, labels at once.

    Args:
        path: the project with its `meta.json`, or the folder of a dataset.
        sequence: name of the dataset, where there are several.
        rate_hz: frames a second, where the names of clouds have no times.
        lenient: go without images and figures that are missing or wrong, and count them.

    Raises:
        OptionError: there is no such dataset, none was chosen of several, or the rate is no number above 0.
    """
    expected = "annotation.json and frame_pointcloud_map.json, or ann/ and pointcloud/"
    folder = choose_drive(path, supervisely_datasets(path), sequence, called="dataset", expected=expected)
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        return _Dataset(folder, ledger, rate_hz).scene()


class _Dataset:
    """The files of one dataset."""

    def __init__(self, folder: Path, ledger: Ledger, rate_hz: float | str | None) -> None:
        self.folder, self.ledger = folder, ledger
        self.meta_path = folder.resolve().parent / "meta.json"
        self.meta = read_json(self.meta_path, _Meta)
        self.tag_metas = {meta.name: meta for meta in self.meta.tags}
        self.is_episode = (folder / "annotation.json").is_file()
        names = self._episode_clouds() if self.is_episode else self._single_clouds()
        if not names:
            raise DataError(folder, "", "no cloud; expected frames")
        usual_hz = 10.0 if self.is_episode else 1.0
        stems = [stem_of(name) for name in names]
        times = frame_times(stems, folder / "pointcloud", ledger, rate_hz=rate_hz, usual_hz=usual_hz)
        self.times_ns: Int64Array = times
        self.frames = [self._frame(name, int(time)) for name, time in zip(names, times, strict=True)]
        self.boxes: list[_Box] = []
        self.points: dict[tuple[Identifier, str | None, bool], dict[int, UInt32Array]] = {}
        self.attributes: dict[Key, dict[str, _Timeline]] = {}
        self.scene_tags: dict[str, _Timeline] = {}
        self.description = ""
        self._rows = {k: row for row, k in enumerate(k for k, one in enumerate(self.frames) if one.cloud is not None)}

    def scene(self) -> Scene:
        folder, ledger = self.folder, self.ledger
        note_missing_clouds(self.frames, folder / "pointcloud", ledger)
        if self.is_episode:
            self._read_episode()
        else:
            self._read_single()
        self._note_server_ids(self.meta_path.parent / "key_id_map.json")
        world = TaskWorld.of(self.frames, folder, ledger)
        lidar = lidar_of(self.frames, world, ledger, keep_all=bool(self.points))
        tracks = self._tracks()
        paths = {
            key: [timeline.path(name, self.times_ns) for name, timeline in timelines.items()]
            for key, timelines in self.attributes.items()
        }
        cuboids = tracks.cuboids(self.times_ns, world, lidar_id=None if lidar is None else lidar.id, attributes=paths)
        about = {
            "project_type": _EPISODES if self.is_episode else _CLOUDS,
            "dataset": folder.resolve().name,
            "classes": [msgspec.structs.asdict(one) for one in self.meta.classes],
            **({"description": self.description} if self.description else {}),
        }
        return task_scene(
            [lidar, *cameras_of(self.frames, world, folder, ledger)],
            [*cuboids, *instance_points(self.points)],
            world,
            ledger,
            source=folder,
            format="supervisely",
            about=about,
            attributes=[timeline.path(name, self.times_ns) for name, timeline in self.scene_tags.items()],
        )

    def _note_server_ids(self, path: Path) -> None:
        if path.is_file() and any(
            read_json(path, dict[str, dict[str, int]]).get(kind) for kind in ("videos", "figures")
        ):
            message = "ids of the server are left out; objects keep their keys"
            self.ledger.note(WarningKind.SKIPPED, "server-ids", str(path), message)

    # frames

    def _episode_clouds(self) -> list[str]:
        path = self.folder / "frame_pointcloud_map.json"
        listed = read_json(path, dict[str, str])
        numbers = sorted(listed, key=lambda text: int(text) if text.isascii() and text.isdigit() else -1)
        if numbers != [str(k) for k in range(len(numbers))]:
            raise DataError(path, "", f"frames {', '.join(numbers[:5])} …; expected 0, 1, 2 … each once")
        return [listed[number] for number in numbers]

    def _single_clouds(self) -> list[str]:
        """Names of all clouds that are there or have labels."""
        labels, clouds = self.folder / "ann", self.folder / "pointcloud"
        names = {file.name.removesuffix(".json") for file in labels.glob("*.json")} if labels.is_dir() else set()
        names |= {file.name for file in clouds.iterdir() if file.is_file()} if clouds.is_dir() else set()
        return sorted(names)

    def _frame(self, name: str, time_ns: int) -> TaskFrame:
        cloud = task_file(self.folder / "pointcloud", self.folder, "frame_pointcloud_map.json", name)
        there = cloud if cloud.is_file() else None
        return TaskFrame(name, time_ns, there, images=tuple(self._images(name, time_ns)))

    def _images(self, cloud: str, time_ns: int) -> Iterator[TaskImage]:
        names = (cloud.replace(".", "_"), f"{stem_of(cloud)}_pcd")
        folders = [self.folder / "related_images" / name for name in dict.fromkeys(names)]
        folder = next((folder for folder in folders if folder.is_dir()), None)
        if folder is None:
            return
        for number, path in enumerate(sorted(folder.glob("*.json"))):
            if path.name.endswith(".figures.json"):
                message = "figures in images are left out"
                self.ledger.note(WarningKind.SKIPPED, "image-figures", str(path), message)
                continue
            try:
                image = self._image(path, number, time_ns)
            except DataError as error:
                self.ledger.fault("images", error)
                continue
            if image is not None:
                yield image

    def _image(self, path: Path, number: int, time_ns: int) -> TaskImage | None:
        record = read_json(path, _ImageFile)
        meta = record.meta
        data = meta.sensorsData
        image = path.with_name(path.name.removesuffix(".json"))
        if not image.is_file() and record.name:
            image = task_file(path.parent, path, "name", record.name)
        if not image.is_file():
            raise DataError(image, "", f"is not there; {path.name} states its calibration")
        if data is None or data.extrinsicMatrix is None or data.intrinsicMatrix is None:
            message = "images without extrinsicMatrix and intrinsicMatrix are left out"
            self.ledger.note(WarningKind.SKIPPED, "images-without-calibration", str(path), message)
            return None
        camera = pinhole_of(path, "meta.sensorsData.intrinsicMatrix", image, data.intrinsicMatrix, self.ledger)
        camera_from_cloud = rigid_of_rows(path, "meta.sensorsData.extrinsicMatrix", data.extrinsicMatrix)
        stated = None if meta.timestamp is None else _parse_date(path, meta.timestamp)
        if stated is not None and abs(stated - time_ns) > _NEAR_NS:
            message = "times of images are on another clock than those of clouds, whose times are taken"
            self.ledger.note(WarningKind.ASSUMED, "image-clock", str(path), message)
            stated = None
        return TaskImage(
            meta.deviceId or f"camera{number}",
            image,
            image.relative_to(self.folder).as_posix(),
            time_ns if stated is None else stated,
            camera,
            camera_from_cloud.inverse(),
        )

    # labels

    def _read_episode(self) -> None:
        path = self.folder / "annotation.json"
        found = read_json(path, Any)
        wrapped = isinstance(found, list) and len(found) == 1  # the description shows the file as a list of one
        kind: Any = list[_Episode] if wrapped else _Episode
        read = read_json(path, kind)
        episode: _Episode = read[0] if wrapped else read
        self.description = episode.description
        objects = self._objects(path, episode.objects)
        for identifier, thing in objects.values():
            self._add_tags(path, self.attributes.setdefault(key_of(identifier), {}), thing.tags, None)
        self._add_tags(path, self.scene_tags, episode.tags, None)
        for row, frame in enumerate(episode.frames):
            if not 0 <= frame.index < len(self.frames):
                problem = f"{frame.index}; expected one of the {len(self.frames)} of frame_pointcloud_map.json"
                self.ledger.fault("frames", DataError(path, f"frames[{row}].index", problem))
                continue
            self._add_figures(path, f"frames[{row}]", frame.index, frame.figures, objects)

    def _read_single(self) -> None:
        for number, frame in enumerate(self.frames):
            path = self.folder / "ann" / f"{frame.name}.json"
            if not path.is_file():
                continue
            try:
                labels = read_json(path, _CloudLabels)
                objects = self._objects(path, labels.objects)
                for identifier, thing in objects.values():
                    self._add_tags(path, self.attributes.setdefault(key_of(identifier), {}), thing.tags, number)
                self._add_tags(path, self.scene_tags, labels.tags, number)
                self._add_figures(path, "", number, labels.figures, objects)
            except DataError as error:
                self.ledger.fault("labels", error)

    def _objects(self, path: Path, listed: Sequence[_Object]) -> dict[str | int, tuple[Identifier, _Object]]:
        """Objects by key and by number, with the ids of their annotations."""
        found: dict[str | int, tuple[Identifier, _Object]] = {}
        for row, one in enumerate(listed):
            if not one.key and one.id is None:
                raise DataError(path, f"objects[{row}]", "has neither key nor id")
            identifier = self._identifier(path, f"objects[{row}].tags", one)
            names: list[str | int] = [name for name in (one.key, one.id) if name]
            for name in names:
                if name in found:
                    raise DataError(path, f"objects[{row}]", f"{name!r} is another object's, too; expected it once")
                found[name] = (identifier, one)
        return found

    def _identifier(self, path: Path, location: str, one: _Object) -> Identifier:
        kept = [tag.value for tag in one.tags if tag.name == _ID]
        if kept:
            try:
                return msgspec.json.decode(str(kept[0]), type=int | str)
            except msgspec.MsgspecError as error:
                raise DataError(path, location, f"{_ID} {kept[0]!r}; expected a text or number as JSON") from error
        return one.key or f"object {one.id}"

    def _add_tags(self, path: Path, timelines: "dict[str, _Timeline]", tags: Sequence[_Tag], frame: int | None) -> None:
        """Add tags of an object or of the dataset; in a frame, or in those that they name."""
        for tag in tags:
            if tag.name == _ID:
                continue
            span = (frame, frame) if frame is not None else tag.frameRange
            if span is not None and not 0 <= span[0] <= span[1] < len(self.frames):
                problem = f"tag {tag.name!r} in frames {span[0]} to {span[1]}; expected some of {len(self.frames)}"
                self.ledger.fault("tags", DataError(path, "", problem))
                continue
            timelines.setdefault(tag.name, _Timeline()).spans.append((span, self._value(tag)))

    def _value(self, tag: _Tag) -> Any:
        meta = self.tag_metas.get(tag.name)
        if tag.value is None:
            return True
        if meta is not None and sorted(meta.values) == sorted(_TRUTHS) and tag.value in _TRUTHS:
            return tag.value == _TRUTHS[0]
        return tag.value

    def _add_figures(
        self,
        path: Path,
        location: str,
        frame: int,
        figures: Sequence[_Figure],
        objects: Mapping[str | int, tuple[Identifier, _Object]],
    ) -> None:
        for row, figure in enumerate(figures):
            where = f"{location}.figures[{row}]".removeprefix(".")
            try:
                name = figure.objectKey or figure.objectId
                if name is not None and name in objects:
                    self._add_figure(path, where, frame, figure, *objects[name])
                    continue
                fault = DataError(path, where, f"object {name!r} is none of the listed ones")
            except DataError as error:
                fault = error
            self.ledger.fault("figures", fault)

    def _tracks(self) -> TaskTracks:
        """All cuboids by object."""
        tracks = TaskTracks()
        rotations = np.array([one.box[2] for one in self.boxes]).reshape(-1, 3)
        if (np.abs(rotations[:, :2]) > 1e-6).any():
            message = "cuboids are tilted: their angles are taken in the order Rx·Ry·Rz"
            self.ledger.note(WarningKind.ASSUMED, "angle-order", str(self.folder), message)
        matrices = rotation_from_cuboid_angles(rotations, unit=AngleUnit.RADIANS) @ _FORWARD_Y
        for one, quaternion in zip(self.boxes, quaternion_from_matrix(matrices), strict=True):
            position, dimensions, _ = one.box
            box = (position, dimensions[[1, 0, 2]], quaternion)
            try:
                tracks.add(one.path, one.where, one.identifier, one.frame, one.label, box)
            except DataError as error:
                self.ledger.fault("figures", error)
        return tracks

    def _add_figure(
        self, path: Path, where: str, frame: int, figure: _Figure, identifier: Identifier, thing: _Object
    ) -> None:
        if figure.geometryType == _CUBOID:
            cuboid = decode_part(path, f"{where}.geometry", figure.geometry, _Cuboid)
            position = cuboid.position.array(path, f"{where}.geometry.position")
            rotation = cuboid.rotation.array(path, f"{where}.geometry.rotation")
            dimensions = cuboid.dimensions.array(path, f"{where}.geometry.dimensions")
            box = (position, dimensions, rotation)
            self.boxes.append(_Box(path, where, identifier, frame, thing.classTitle, box))
        elif figure.geometryType == _POINTS:
            indices = decode_part(path, f"{where}.geometry", figure.geometry, _Indices).indices
            if any(not 0 <= index < 1 << 32 for index in indices):
                raise DataError(path, f"{where}.geometry.indices", "expected numbers of points")
            row = self._rows.get(frame)
            if row is None:
                message = "labelled points of frames without a cloud are left out"
                self.ledger.note(WarningKind.SKIPPED, "points-without-cloud", str(path), message)
                return
            entries = self.points.setdefault((identifier, thing.classTitle, True), {})
            new = np.array(indices, np.uint32)
            entries[row] = np.concatenate([entries[row], new]) if row in entries else new
        else:
            message = f"figures of the geometry {figure.geometryType!r} are left out"
            self.ledger.note(WarningKind.SKIPPED, "figures-left-out", str(path), message)


@dataclass(frozen=True, slots=True, eq=False)
class _Box:
    """A cuboid as a figure has it: position, dimensions, rotation."""

    path: Path
    where: str
    identifier: Identifier
    frame: int
    label: str
    box: tuple[Float64Array, Float64Array, Float64Array]


@dataclass(slots=True)
class _Timeline:
    """Values of one tag, in spans of frames, both ends included; None for all frames."""

    spans: list[tuple[tuple[int, int] | None, Any]] = field(default_factory=list)

    def path(self, name: str, times_ns: Int64Array) -> AttributePath:
        """Give the attribute: without times where it holds in all frames, else with None where it does not hold."""
        always = [value for span, value in self.spans if span is None]
        spans = [(span, value) for span, value in self.spans if span is not None]
        if not spans:
            return AttributePath(name, (always[-1],))
        values = [always[-1] if always else None] * len(times_ns)
        for (first, last), value in spans:
            values[first : last + 1] = [value] * (last + 1 - first)
        kept = [k for k, value in enumerate(values) if (value != values[k - 1] if k else value is not None)]
        return AttributePath(name, tuple(values[k] for k in kept), times_ns[kept])


def _parse_date(path: Path, text: str) -> int:
    """Parse a date of ISO 8601 as nanoseconds since 1970; without a zone it is UTC."""
    match = _DATE.fullmatch(text)
    wrong = DataError(path, "meta.timestamp", f"{text[:40]!r}; expected a date as 2019-01-11T03:23:57.602Z")
    if match is None:
        raise wrong
    try:
        zone = (match["zone"] or "Z").replace("Z", "+00:00")
        whole = datetime.fromisoformat(f"{match['seconds']}{zone}") - _EPOCH
    except (ValueError, OverflowError) as error:
        raise wrong from error
    return (whole.days * 86_400 + whole.seconds) * SECOND_NS + int((match["part"] or "").ljust(9, "0"))


def _format_date(time_ns: int) -> str | None:
    """Format nanoseconds since 1970 as a date; None where the calendar does not reach."""
    seconds, part = divmod(time_ns, SECOND_NS)
    try:
        return f"{(_EPOCH + timedelta(seconds=seconds)).strftime('%Y-%m-%dT%H:%M:%S')}.{part:09d}Z"
    except OverflowError:
        return None


# writing

_KIND = FolderKind(
    "project of Supervisely",
    (
        r"(meta|key_id_map)\.json",
        r"(?P<one>.+)/(annotation|frame_pointcloud_map)\.json",
        r"(?P<one>.+)/ann/.+\.pcd\.json",
        r"(?P<one>.+)/pointcloud/.+\.pcd",
        r"(?P<one>.+)/related_images/.+_pcd/.+\.(png|jpg)(\.json)?",
    ),
    "meta\\.json",
)


def write_supervisely(
    scene: Scene,
    path: Path,
    *,
    overwrite: bool = False,
    project: str = "episodes",
    dataset: str | None = None,
    lidar: str | None = None,
    points_frame: str | None = None,
    trajectory: str | None = None,
) -> LossReport:
    """Write a scene as a project with one dataset; frames are read, written and released one by one.

    Args:
        overwrite: replace the folder if it is such a project, or empty.
        project: "episodes", or "clouds" for a project of single clouds.
        dataset: its name; None: that which the scene was read from, else the name of the folder.
        lidar, points_frame, trajectory: as of `TaskOptions`.

    Raises:
        OptionError: an option is none of these, or the scene has no sweep.
        DataError: a frame or image cannot be read.
    """
    check_choice("project", project, _PROJECTS)
    plan = TaskPlan(scene, SUPERVISELY_SUPPORTS, TaskOptions(lidar, points_frame, trajectory), holds_points=True)
    about = scene.metadata.get("supervisely")
    about = about if isinstance(about, Mapping) else {}
    name = file_stem(dataset or str(about.get("dataset") or path.stem))
    with replacing(path, overwrite=overwrite, folder=_KIND) as draft:
        _Writer(plan, draft, name, _PROJECTS[project], about).write()
    return LossReport.of(plan.losses)


@dataclass(slots=True)
class _Thing:
    """An object of a project: its key, class, and tags by name in the frames in which it is."""

    key: str
    label: str
    kept: Identifier | None  # the id of the annotation, where the key is another
    stated: dict[str, dict[int, Any]] = field(default_factory=dict)
    frames: list[int] = field(default_factory=list)


class _Writer:
    """Writes one project."""

    def __init__(self, plan: TaskPlan, root: Path, name: str, kind: str, about: Mapping[str, Any]) -> None:
        self.plan, self.root, self.kind, self.about = plan, root, kind, about
        self.folder = root / name
        self.key = _new_key("dataset", name, *plan.names)
        self.things: dict[str, _Thing] = {}
        self.shapes: dict[str, set[str]] = {}
        self.tag_kinds: dict[str, str] = {}
        self.figures: list[list[dict[str, Any]]] = []
        self.renamed = 0

    def write(self) -> None:
        (self.folder / "pointcloud").mkdir(parents=True)
        clouds = self.plan.clouds()
        for frame in self.plan:
            name = f"{frame.name}.pcd"
            clouds.write_frame(self.plan.lidar, frame.sweep, self.folder / "pointcloud" / name)
            for image in frame.images:
                self._write_image(image, self.folder / "related_images" / f"{frame.name}_pcd")
            self.figures.append([*self._cuboids(frame), *self._points(frame)])
        scene_tags = self._scene_tags()
        if self.kind == _EPISODES:
            self._write_episode(scene_tags)
        else:
            self._write_single(scene_tags)
        numbers = {thing.key: number for number, thing in enumerate(self.things.values(), 1)}
        _dump(self.root / "key_id_map.json", {"tags": {}, "objects": numbers, "figures": {}, "videos": {}})
        _dump(self.root / "meta.json", self._meta())
        what = f"an object has a key of 32 hexadecimal digits; the id is kept as its tag `{_ID}`"
        self.plan.losses.converted("annotations.cuboid.id", what, count=self.renamed)

    def _write_image(self, written: WrittenImage, folder: Path) -> None:
        if written.cloud_from_camera is None:
            what = "images of cameras whose mounting is not known are written without calibration"
            self.plan.losses.dropped("sensors.camera.camera", what)
        path = self.plan.write_image(written, folder)
        camera = written.image.camera
        meta: dict[str, Any] = {"deviceId": str(written.camera_id)}
        date = _format_date(written.image.timestamp_ns)
        if date is not None:
            meta["timestamp"] = date
        if written.cloud_from_camera is not None:
            matrix = written.cloud_from_camera.inverse().matrix
            intrinsics = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
            meta["sensorsData"] = {"extrinsicMatrix": matrix[:3].ravel().tolist(), "intrinsicMatrix": intrinsics}
        _dump(path.with_name(f"{path.name}.json"), {"name": path.name, "meta": meta})

    def _thing(self, identifier: Identifier, label: str | None, shape: str) -> _Thing:
        known = isinstance(identifier, str) and _KEY.fullmatch(identifier) is not None
        key = str(identifier) if known else _new_key("object", type(identifier).__name__, identifier)
        if key not in self.things:
            title = label or "unknown"
            if label is None:
                self.plan.losses.converted("annotations.cuboid.label", "objects without a class become `unknown`")
            self.renamed += not known
            self.things[key] = _Thing(key, title, None if known else identifier)
        self.shapes.setdefault(self.things[key].label, set()).add(shape)
        return self.things[key]

    def _cuboids(self, frame: WrittenFrame) -> Iterator[dict[str, Any]]:
        rotations = matrix_from_quaternion(np.array([box.quaternion_xyzw for box in frame.boxes]).reshape(-1, 4))
        angles = cuboid_angles_from_rotation(rotations @ _FORWARD_Y.T, unit=AngleUnit.RADIANS)
        for box, rotation in zip(frame.boxes, angles, strict=True):
            thing = self._thing(box.cuboid.id, box.cuboid.label, _CUBOID)
            thing.frames.append(frame.number)
            for name, value in box.stated.items():
                if value is not None:
                    thing.stated.setdefault(name, {})[frame.number] = value
            dimensions = xyz(box.size_lwh[[1, 0, 2]])
            geometry = {"position": xyz(box.center), "rotation": xyz(rotation), "dimensions": dimensions}
            yield self._figure(thing, frame.number, _CUBOID, geometry)

    def _points(self, frame: WrittenFrame) -> Iterator[dict[str, Any]]:
        for number, rows in frame.labelled:
            one = self.plan.labelled[number]
            thing = self._thing(one.id, one.label, _POINTS)
            thing.frames.append(frame.number)
            geometry = msgspec.Raw(msgspec.json.encode({"indices": rows.tolist()}))
            yield self._figure(thing, frame.number, _POINTS, geometry)

    def _figure(self, thing: _Thing, frame: int, kind: str, geometry: Any) -> dict[str, Any]:
        key = _new_key("figure", thing.key, frame, kind)
        return {"key": key, "objectKey": thing.key, "geometryType": kind, "geometry": geometry}

    # tags

    def _scene_tags(self) -> dict[str, dict[int, Any]]:
        """Values of the scene's attributes in each frame."""
        found: dict[str, dict[int, Any]] = {}
        for path in self.plan.scene.attributes:
            if path.sensor_id is not None:
                self.plan.losses.dropped("attributes", "attributes of single sensors are left out")
                continue
            values = attribute_at(path, self.plan.times_ns)
            found[path.name] = {k: value for k, value in enumerate(values) if value is not None}
        return found

    def _tags(self, stated: Mapping[str, Mapping[int, Any]], frames: Sequence[int]) -> Iterator[dict[str, Any]]:
        """Tags of an episode: without a range where a value holds in all of an object's frames."""
        for name, values in stated.items():
            texts = {frame: self._tag_value(name, value) for frame, value in values.items()}
            first: int | None = None
            if len(texts) == len(frames) and len(set(map(repr, texts.values()))) == 1:
                yield self._tag(name, next(iter(texts.values())), None)
                continue
            for frame in sorted(texts):
                first = frame if first is None else first
                if frame + 1 not in texts or texts[frame + 1] != texts[frame]:
                    yield self._tag(name, texts[frame], (first, frame))
                    first = None

    def _tag(self, name: str, value: Any, span: tuple[int, int] | None) -> dict[str, Any]:
        tag = {"name": name, "value": value, "key": _new_key("tag", name, value, span)}
        return tag if span is None else {**tag, "frameRange": list(span)}

    def _tag_value(self, name: str, value: Any) -> Any:
        """A value as a tag has it: a number, or a text; the kind of a tag is that of all its values."""
        kind = "bool" if isinstance(value, bool) else "number" if isinstance(value, int | float) else "text"
        known = self.tag_kinds.setdefault(name, kind)
        if known != kind:
            self.tag_kinds[name] = "text"
        if kind == "number":
            return value
        if kind == "bool":
            return _TRUTHS[0] if value else _TRUTHS[1]
        if not isinstance(value, str):
            what = "values that are neither texts nor numbers are written as texts"
            self.plan.losses.converted("annotations.cuboid.attributes", what)
            return ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
        return value

    # files

    def _write_episode(self, scene_tags: Mapping[str, Mapping[int, Any]]) -> None:
        objects = [self._object(thing, self._tags(thing.stated, thing.frames)) for thing in self.things.values()]
        tags = [*self._tags(scene_tags, range(len(self.figures)))]
        frames = [{"index": k, "figures": figures} for k, figures in enumerate(self.figures) if figures]
        self._as_texts([tag for one in objects for tag in one["tags"]] + tags)
        _dump(
            self.folder / "annotation.json",
            {
                "description": str(self.about.get("description") or ""),
                "key": self.key,
                "tags": tags,
                "objects": objects,
                "framesCount": len(self.figures),
                "frames": frames,
            },
        )
        names = {str(k): f"{name}.pcd" for k, name in enumerate(self.plan.names)}
        _dump(self.folder / "frame_pointcloud_map.json", names)

    def _write_single(self, scene_tags: Mapping[str, Mapping[int, Any]]) -> None:
        (self.folder / "ann").mkdir()
        files = []
        for k, figures in enumerate(self.figures):
            here = dict.fromkeys(figure["objectKey"] for figure in figures)
            objects = [self._object(self.things[key], self._tags_in(self.things[key].stated, k)) for key in here]
            files.append((k, objects, [*self._tags_in(scene_tags, k)], figures))
        for _, objects, tags, _ in files:
            self._as_texts([*tags, *(tag for one in objects for tag in one["tags"])])
        for k, objects, tags, figures in files:
            name = f"{self.plan.names[k]}.pcd.json"
            key = _new_key("cloud", self.key, k)
            labels = {"description": "", "key": key, "tags": tags, "objects": objects, "figures": figures}
            _dump(self.folder / "ann" / name, labels)

    def _tags_in(self, stated: Mapping[str, Mapping[int, Any]], frame: int) -> Iterator[dict[str, Any]]:
        for name, values in stated.items():
            if frame in values:
                yield self._tag(name, self._tag_value(name, values[frame]), None)

    def _object(self, thing: _Thing, tags: Iterator[dict[str, Any]]) -> dict[str, Any]:
        own = [*tags]
        if thing.kept is not None:
            self.tag_kinds[_ID] = "text"
            own.append(self._tag(_ID, json.dumps(thing.kept, ensure_ascii=False), None))
        return {"key": thing.key, "classTitle": thing.label, "tags": own}

    def _as_texts(self, tags: Sequence[dict[str, Any]]) -> None:
        """State numbers as texts in tags that have texts, too."""
        for tag in tags:
            if self.tag_kinds[tag["name"]] == "text" and not isinstance(tag["value"], str):
                tag["value"] = str(tag["value"])
                what = "numbers of attributes that have texts, too, are written as texts"
                self.plan.losses.converted("annotations.cuboid.attributes", what)

    def _meta(self) -> dict[str, Any]:
        listed = self.about.get("classes")
        colors = {
            str(one.get("title")): str(one.get("color"))
            for one in (listed if isinstance(listed, list | tuple) else ())
            if isinstance(one, Mapping) and re.fullmatch("#[0-9A-Fa-f]{6}", str(one.get("color")))
        }
        classes = [
            {
                "title": title,
                "shape": next(iter(shapes)) if len(shapes) == 1 else _ANY,
                "color": colors.get(title) or f"#{crc32(title.encode()) & 0xFFFFFF:06X}",
                "geometry_config": {},
                "hotkey": "",
            }
            for title, shapes in self.shapes.items()
        ]
        kinds: Mapping[str, dict[str, Any]] = {
            "number": {"value_type": "any_number"},
            "text": {"value_type": "any_string"},
            "bool": {"value_type": "oneof_string", "values": [*_TRUTHS]},
        }
        tags = [
            {"name": name, "color": f"#{crc32(name.encode()) & 0xFFFFFF:06X}", "hotkey": "", **kinds[kind]}
            for name, kind in self.tag_kinds.items()
        ]
        return {"classes": classes, "tags": tags, "projectType": self.kind}


def _new_key(*parts: object) -> str:
    return uuid5(_NAMESPACE, "\0".join(map(str, parts))).hex


def _dump(path: Path, value: Any) -> None:
    path.write_bytes(msgspec.json.encode(value))
