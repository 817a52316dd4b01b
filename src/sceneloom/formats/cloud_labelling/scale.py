"""Scale's lidar tasks: frames of points in the world as JSON, and cuboids as the response of a task; read and written.

Source: "Data Types and the Frame Objects" and "Callback Format" of Scale's documentation: points, device and cameras
are in one world with z up, headings are quaternions, a camera's z axis is its optical axis; a cuboid's x, y and z are
width, length and height, and it looks along +y at yaw 0, counter-clockwise. That a camera's x is right and y down is
taken for granted, as in the folders of Scale's lidar toolkit.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import floor, isfinite
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import Any
from urllib.parse import unquote, urlsplit
from uuid import UUID, uuid5

import msgspec
import numpy as np

from sceneloom.arrays import Int64Array, finite_rows, read_only
from sceneloom.cameras.camera import OPENCV_NAMES
from sceneloom.errors import DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.json_files import read_json
from sceneloom.formats.base.losses import LossReport
from sceneloom.formats.base.output import FolderKind, file_stem, replacing
from sceneloom.formats.cloud_labelling.spec import SCALE_SUPPORTS, scale_frames
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
    camera_of,
    cameras_of,
    frame_times,
    headings_of,
    identifier_of,
    posed_lidar,
    rigid_of,
    task_scene,
    unique_text,
    xyz,
)
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.clouds import LidarFrame, LidarPoints, RadarFrame, RadarPoints, RadarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import PointsFrame
from sceneloom.warnings import WarningKind

_FARTHEST = 1e7  # no point is farther from the world's origin [m]
_LATEST_NS = 1 << 62
_NEAR_NS = 10 * SECOND_NS
_COEFFICIENTS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {"brown_conrady": OPENCV_NAMES[:8], "fisheye": ("k1", "k2", "k3", "k4")}
)
"""Camera models and the order of their coefficients."""

_BESIDE = ("camera_used", "numberOfPoints", "distance_to_device", "stationary")
"""What cuboids state beside their attributes."""

_TASK_TYPES = ("lidarannotation",)
_NAMESPACE = UUID("3f8e3c55-2f6c-5f5d-9f3c-0a9a6f0a7d10")


class _XYZW(msgspec.Struct):
    x: float
    y: float
    z: float
    w: float

    @property
    def xyzw(self) -> tuple[float, float, float, float]:
        return self.x, self.y, self.z, self.w


class _Image(msgspec.Struct):
    image_url: str
    position: XYZ
    heading: _XYZW
    fx: float
    fy: float
    cx: float
    cy: float
    timestamp: int | float | None = None
    camera_index: int | None = None
    camera_model: str | None = None
    scale_factor: float | None = None
    skew: float | None = None
    k1: float | None = None
    k2: float | None = None
    k3: float | None = None
    k4: float | None = None
    k5: float | None = None
    k6: float | None = None
    p1: float | None = None
    p2: float | None = None


class _RadarPoint(msgspec.Struct):
    position: XYZ
    direction: XYZ | None = None
    size: float | None = None


class _Frame(msgspec.Struct):
    device_position: XYZ
    device_heading: _XYZW | None = None
    images: list[_Image] = []
    timestamp: int | float | None = None
    radar_points: list[_RadarPoint] = []


class _Point(msgspec.Struct, omit_defaults=True):
    x: float
    y: float
    z: float
    i: float | None = None
    d: int | None = None
    t: int | float | None = None


class _Points(msgspec.Struct):
    points: list[_Point]


class _Cuboid(msgspec.Struct):
    uuid: str
    label: str
    position: XYZ
    dimensions: XYZ
    yaw: float
    pitch: float | None = None
    roll: float | None = None
    attributes: dict[str, Any] | None = None
    camera_used: Any = None
    numberOfPoints: int | None = None  # noqa: N815 - the format's word
    distance_to_device: float | None = None
    stationary: bool | None = None


class _LabelFrame(msgspec.Struct):
    cuboids: list[_Cuboid] | None = None


class _Url(msgspec.Struct):
    url: str = ""


class _Response(msgspec.Struct):
    annotations: _Url | None = None


class _Params(msgspec.Struct):
    attachments: list[str] = []


class _Task(msgspec.Struct):
    type: str = "lidarannotation"
    task_id: str = ""
    params: _Params = msgspec.field(default_factory=_Params)
    response: _Response | None = None


def open_scale_task(path: Path, *, rate_hz: float | str | None = None, lenient: bool = False) -> Scene:
    """Open a task; points and images are read on demand, labels at once.

    Args:
        path: the folder of a task: frames as `frames/*.json`, and `task.json`, `annotations.json` as far as there are.
        rate_hz: frames a second, where frames have neither timestamps nor names with times.
        lenient: go without images and cuboids that are wrong, and count them.

    Raises:
        OptionError: the rate is no number above 0.
    """
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        return _Reader(path, ledger, rate_hz).scene()


class _Reader:
    """One task."""

    def __init__(self, root: Path, ledger: Ledger, rate_hz: float | str | None) -> None:
        self.root, self.ledger = root, ledger
        self.task = read_json(root / "task.json", _Task) if (root / "task.json").is_file() else _Task()
        if self.task.type not in _TASK_TYPES:
            message = f"labels of tasks of the type {self.task.type!r} are left out"
            ledger.note(WarningKind.SKIPPED, "task-type", str(root / "task.json"), message)
        self.files = self._frame_files()
        records = [read_json(file, _Frame) for file in self.files]
        self.times_ns = self._times([record.timestamp for record in records], rate_hz)
        self.radar: list[tuple[int, list[_RadarPoint]]] = [
            (k, record.radar_points) for k, record in enumerate(records) if record.radar_points
        ]
        self.frames = [self._frame(k, record) for k, record in enumerate(records)]

    def scene(self) -> Scene:
        world = TaskWorld.of(self.frames, self.root, self.ledger)
        reader = _PointFiles(tuple(self.files), self.times_ns)
        lidar = posed_lidar(
            LazyFrames(self.times_ns, reader),
            world.poses(range(len(self.files))),
            points_frame=PointsFrame.WORLD,
            extras=MappingProxyType({"intensity_max": 1.0}),
        )
        tracks = TaskTracks()
        for where, frame, cuboid in self._cuboids():
            try:
                self._add(where[0], where[1], frame, cuboid, tracks)
            except DataError as error:
                self.ledger.fault("labels", error)
        about = {"task_id": self.task.task_id, "type": self.task.type}
        return task_scene(
            [lidar, *self._radars(), *cameras_of(self.frames, world, self.root, self.ledger)],
            tracks.cuboids(self.times_ns, None, lidar_id=lidar.id),
            world,
            self.ledger,
            source=self.root,
            format="scale-task",
            about={name: value for name, value in about.items() if value},
        )

    def _frame_files(self) -> list[Path]:
        """The files of frames: in the order of the task's attachments where these are there, else by name."""
        there = scale_frames(self.root)
        if not there:
            raise DataError(self.root, "", "no frame; expected frames/*.json with points and device_position")
        by_name = {file.name: file for file in there}
        listed = [PurePosixPath(unquote(urlsplit(url).path)).name for url in self.task.params.attachments]
        missing = [name for name in listed if name not in by_name]
        if missing:
            problem = f"attachment {missing[0]!r} is not there; expected frames/{missing[0]}"
            self.ledger.fault("frames-missing", DataError(self.root, "frames", problem), count=len(missing))
        chosen = [by_name[name] for name in dict.fromkeys(listed) if name in by_name]
        return chosen or there

    def _times(self, stated: Sequence[int | float | None], rate_hz: float | str | None) -> Int64Array:
        """Times of frames: their timestamps, whole nanoseconds or seconds with a fraction; else by names."""
        known = [time for time in stated if time is not None]
        if rate_hz is None and len(known) == len(stated):
            if any(isinstance(time, float) and not time.is_integer() for time in known):
                message = "timestamps with a fraction are taken for seconds"
                self.ledger.note(WarningKind.ASSUMED, "timestamps", str(self.root), message)
                known = [time * SECOND_NS for time in known]
            if all(isfinite(time) and abs(time) < _LATEST_NS for time in known):
                times = np.array([round(time) for time in known], np.int64)
                if (np.diff(times) > 0).all():
                    return times
            message = "timestamps of frames are not in ascending order, and are not used"
            self.ledger.note(WarningKind.SKIPPED, "timestamps", str(self.root), message)
        names = [file.stem for file in self.files]
        return frame_times(names, self.root / "frames", self.ledger, rate_hz=rate_hz)

    def _frame(self, k: int, record: _Frame) -> TaskFrame:
        path = self.files[k]
        position = record.device_position.array(path, "device_position")
        heading = (0.0, 0.0, 0.0, 1.0) if record.device_heading is None else record.device_heading.xyzw
        device = rigid_of(path, "device_heading", position, heading)
        images = []
        for number, image in enumerate(record.images):
            try:
                found = self._image(path, number, image, int(self.times_ns[k]), device)
            except DataError as error:
                self.ledger.fault("images", error)
                continue
            images += [] if found is None else [found]
        return TaskFrame(path.stem, int(self.times_ns[k]), path, device, tuple(images))

    def _image(self, path: Path, number: int, image: _Image, time_ns: int, device: RigidTransform) -> TaskImage | None:
        where = f"images[{number}]"
        file, camera_id = self._find(path, where, image, number)
        if file is None:
            self.ledger.note(WarningKind.SKIPPED, "images-missing", f"{path}: {where}", "images are not there")
            return None
        model = image.camera_model or "brown_conrady"
        if model not in _COEFFICIENTS:
            raise DataError(path, f"{where}.camera_model", f"{model!r}; expected one of {', '.join(_COEFFICIENTS)}")
        coefficients = [getattr(image, name) or 0.0 for name in _COEFFICIENTS[model]]
        if image.skew or image.scale_factor not in (None, 1, 0):
            message = "skew and scale_factor of images are not used"
            self.ledger.note(WarningKind.SKIPPED, "camera-skew", f"{path}: {where}", message)
        numbers = (image.fx, image.fy, image.cx, image.cy)
        if not any(coefficients) and model == "brown_conrady":
            camera = camera_of(path, where, file, "pinhole", numbers)
        else:
            camera = camera_of(path, where, file, model, numbers, coefficients)
        position = image.position.array(path, f"{where}.position")
        pose = rigid_of(path, f"{where}.heading", position, image.heading.xyzw)
        stated = image.timestamp
        if stated is not None and isfinite(stated) and abs(stated - time_ns) < _NEAR_NS:
            time_ns = round(stated)
        name = file.relative_to(self.root).as_posix()
        return TaskImage(camera_id, file, name, time_ns, camera, device.inverse() @ pose)

    def _find(self, path: Path, where: str, image: _Image, number: int) -> tuple[Path | None, str]:
        """The file of an image below the task, None where there is none; and the name of its camera."""
        parts = urlsplit(image.image_url)
        named = PurePosixPath(unquote(parts.path))
        usual = f"camera{number if image.camera_index is None else image.camera_index}"
        if not parts.scheme and ("\0" in image.image_url or ".." in named.parts):
            problem = f"{image.image_url!r}; expected a URL, or the name of a file in the task"
            raise DataError(path, f"{where}.image_url", problem)
        if not parts.scheme and not named.is_absolute():
            file = self.root.joinpath(*named.parts)
            if file.is_file():
                return file, unquote(named.parts[-2]) if len(named.parts) > 2 else usual
        tried = [self.root / "images" / usual / named.name, self.root / "images" / named.name]
        return next((file for file in tried if named.name and file.is_file()), None), usual

    def _cuboids(self) -> Iterator[tuple[tuple[Path, str], int, _Cuboid]]:
        path = self._labels_path()
        if path is None:
            self.ledger.note(WarningKind.SKIPPED, "unlabelled", str(self.root), "the task has no annotations.json")
            return
        labels = read_json(path, list[_LabelFrame])
        if len(labels) > len(self.frames):
            problem = f"{len(labels)} frames; expected {len(self.frames)}, as many as the task has"
            self.ledger.fault("label-frames", DataError(path, "", problem))
        for k, frame in enumerate(labels[: len(self.frames)]):
            for row, cuboid in enumerate(frame.cuboids or ()):
                yield (path, f"[{k}].cuboids[{row}]"), k, cuboid

    def _labels_path(self) -> Path | None:
        url = self.task.response.annotations.url if self.task.response and self.task.response.annotations else ""
        last = PurePosixPath(unquote(urlsplit(url).path)).name
        names = (last, f"{last}.json", "annotations.json") if last else ("annotations.json",)
        return next((self.root / name for name in names if (self.root / name).is_file()), None)

    def _add(self, path: Path, where: str, frame: int, cuboid: _Cuboid, tracks: TaskTracks) -> None:
        if cuboid.pitch or cuboid.roll:
            message = "pitch and roll of cuboids are left out: in which order they rotate is not known"
            self.ledger.note(WarningKind.SKIPPED, "tilt", f"{path}: {where}", message)
        if not isfinite(cuboid.yaw):
            raise DataError(path, f"{where}.yaw", f"{cuboid.yaw}; expected a number")
        half = 0.5 * (cuboid.yaw + np.pi / 2)
        width, length, height = cuboid.dimensions.array(path, f"{where}.dimensions").tolist()
        box = (
            cuboid.position.array(path, f"{where}.position"),
            np.array([length, width, height]),
            np.array([0.0, 0.0, np.sin(half), np.cos(half)]),
        )
        beside = {name: getattr(cuboid, name) for name in _BESIDE}
        stated = {name: value for name, value in {**(cuboid.attributes or {}), **beside}.items() if value is not None}
        tracks.add(path, where, identifier_of(cuboid.uuid), frame, cuboid.label, box, stated=stated)

    def _radars(self) -> list[RadarSensor]:
        """The radar whose points are in the world; [] without any."""
        if not self.radar:
            return []
        times = self.times_ns[[k for k, _ in self.radar]]
        frames = []
        for (k, points), time in zip(self.radar, times.tolist(), strict=True):
            path = self.files[k]
            positions = [one.position.array(path, f"radar_points[{row}].position") for row, one in enumerate(points)]
            directions = [(one.direction or XYZ(1.0, 0.0, 0.0)).array(path, "radar_points") for one in points]
            norms = np.linalg.norm(directions, axis=1)
            units = np.where(norms[:, None] > 0, directions, [1.0, 0.0, 0.0])
            units = units / np.linalg.norm(units, axis=1, keepdims=True)
            sizes = [one.size if one.size is not None and isfinite(one.size) else 0.0 for one in points]
            made = RadarPoints(
                read_only(positions, np.float32), read_only(units, np.float32), read_only(sizes, np.float32)
            )
            frames.append(RadarFrame(time, made))
        return [RadarSensor("radar", LazyFrames.of(frames, times.tolist()), points_frame=PointsFrame.WORLD)]


@dataclass(frozen=True, slots=True, eq=False)
class _PointFiles:
    """Reads the points of frames."""

    files: tuple[Path, ...]
    times_ns: Int64Array

    def __call__(self, k: int) -> LidarFrame:
        """Read the points of frame `k`.

        Raises:
            DataError: the file is missing or wrong.
        """
        path = self.files[k]
        points = read_json(path, _Points).points
        positions = np.array([(one.x, one.y, one.z) for one in points], np.float64).reshape(-1, 3)
        if not (np.abs(positions) < _FARTHEST).all():
            row = int(np.argmin((np.abs(positions) < _FARTHEST).all(axis=1)))
            raise DataError(path, f"points[{row}]", f"{positions[row].tolist()}; expected metres below {_FARTHEST:g}")
        extras = {}
        if any(one.d is not None for one in points):
            numbers = [one.d if one.d is not None and 0 <= one.d < 1 << 31 else -1 for one in points]
            extras["d"] = read_only(numbers, np.int32)
        times = self._times(points, int(self.times_ns[k]))
        if times is not None:  # labels hold for the whole frame: these are no times by which boxes are looked up
            extras["t"] = times
        made = LidarPoints(read_only(positions, np.float32), self._intensities(points), extras=MappingProxyType(extras))
        return LidarFrame(int(self.times_ns[k]), made, MappingProxyType({"file": f"frames/{path.name}"}))

    @staticmethod
    def _intensities(points: Sequence[_Point]) -> Any:
        """Intensities of 0 to 1 as 0 to 255; None where no point has one."""
        if all(one.i is None for one in points):
            return None
        values = np.array([0.0 if one.i is None else one.i for one in points])
        return read_only(np.rint(np.clip(np.nan_to_num(values), 0.0, 1.0) * 255.0), np.uint8)

    @staticmethod
    def _times(points: Sequence[_Point], time_ns: int) -> Any:
        """Times of points, where all have one near the frame's."""
        times = [one.t for one in points if one.t is not None]
        if not times or len(times) < len(points):
            return None
        near = all(isfinite(time) and abs(time - time_ns) < _NEAR_NS for time in times)
        return read_only([round(time) for time in times], np.int64) if near else None


# writing

_KIND = FolderKind(
    "task for Scale", (r"(task|annotations)\.json", r"frames/-?\d{19}\.json", r"images/.+/.+\.(jpg|png)"), r"task\.json"
)


def write_scale_task(
    scene: Scene, path: Path, *, overwrite: bool = False, lidar: str | None = None, trajectory: str | None = None
) -> LossReport:
    """Write a scene as a task with its response; frames are read, written and released one by one.

    URLs are paths below the folder: they become those of the files when these are uploaded.

    Args:
        overwrite: replace the folder if it is such a task, or empty.
        lidar, trajectory: as of `TaskOptions`.

    Raises:
        OptionError: the scene has no sweep.
        DataError: a frame or image cannot be read.
    """
    options = TaskOptions(lidar, None, trajectory)
    models = ("pinhole", *_COEFFICIENTS)
    plan = TaskPlan(
        scene, SCALE_SUPPORTS, options, usual_frame=PointsFrame.WORLD, camera_models=models, holds_times=True
    )
    if any(len(one.frames) for one in scene.lidars) and not plan.posed:
        what = "not known: the clouds' frame is taken for the world"
        plan.losses.approximated("sensors.lidar.poses", what)
    with replacing(path, overwrite=overwrite, folder=_KIND) as draft:
        _write(plan, draft, path.stem)
    return LossReport.of(plan.losses)


def _write(plan: TaskPlan, root: Path, name: str) -> None:
    (root / "frames").mkdir()
    labels, names, classes = [], [], dict[str, None]()
    texts: dict[str, Any] = {}
    for frame in plan:
        file = f"frames/{frame.name}.json"
        names.append(file)
        (root / file).write_bytes(_frame_text(plan, frame, root))
        cuboids = _cuboids(plan, frame, texts)
        classes.update(dict.fromkeys(one["label"] for one in cuboids))
        labels.append({"cuboids": cuboids})
    task = {
        "task_id": uuid5(_NAMESPACE, "\0".join((name, *plan.names))).hex[:24],
        "type": _TASK_TYPES[0],
        "status": "completed",
        "params": {"attachment_type": "json", "attachments": names, "labels": [*classes], "meters_per_unit": 1},
        "response": {"annotations": {"url": "annotations.json"}},
    }
    for target, value in (("task.json", task), ("annotations.json", labels)):
        (root / target).write_bytes(msgspec.json.encode(value))


def _frame_text(plan: TaskPlan, frame: WrittenFrame, root: Path) -> bytes:
    device = plan.device(frame.number)
    record = {
        "device_position": xyz(device.translation),
        "device_heading": _xyzw(device),
        "timestamp": frame.timestamp_ns,
        "images": [*filter(None, (_image(plan, frame, image, root) for image in frame.images))],
        "points": _points(plan, frame),
    }
    return msgspec.json.encode(record)


def _points(plan: TaskPlan, frame: WrittenFrame) -> list[_Point]:
    points, count = frame.sweep.points, len(frame.sweep.points)
    positions = np.round(points.positions.astype(np.float64), 5)
    finite = finite_rows(positions)
    field = "sensors.lidar.frames.points"
    plan.losses.dropped(f"{field}.positions", "points that are not finite are left out", count=int((~finite).sum()))
    bright = points.intensities
    intensities = [None] * count if bright is None else np.round(bright / 255.0, 6).tolist()
    stated = points.extras.get("t") if points.timestamps_ns is None else points.timestamps_ns
    times = [None] * count if stated is None or stated.shape != (count,) else stated.tolist()
    for name in ("rings", "colors", "camera_index"):
        if getattr(points, name) is not None:
            plan.losses.dropped(f"{field}.{name}", "points have x, y, z, intensity and time", count=count)
    if set(points.extras) - {"t"}:
        plan.losses.dropped(f"{field}.extras", "points have x, y, z, intensity and time", count=count)
    rows = zip(positions.tolist(), intensities, times, finite.tolist(), strict=True)
    return [_Point(x, y, z, i, None, t) for (x, y, z), i, t, there in rows if there]


def _image(plan: TaskPlan, frame: WrittenFrame, written: WrittenImage, root: Path) -> dict[str, Any] | None:
    if written.cloud_from_camera is None:
        plan.losses.dropped("sensors.camera", f"{written.camera_id!r} is left out: its mounting is not known")
        return None
    path = plan.write_image(written, root / "images" / file_stem(written.camera_id))
    camera = written.image.camera
    pose = frame.world_from_cloud @ written.cloud_from_camera
    order = [str(one.id) for one in plan.scene.cameras]
    record: dict[str, Any] = {
        "image_url": path.relative_to(root).as_posix(),
        "camera_index": order.index(str(written.camera_id)),
        "timestamp": written.image.timestamp_ns,
        "position": xyz(pose.translation),
        "heading": _xyzw(pose),
        **{name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy")},
    }
    if camera.model in _COEFFICIENTS:
        names = _COEFFICIENTS[camera.model]
        record["camera_model"] = camera.model
        record |= {name: float(value) for name, value in zip(names, camera.coefficients, strict=False)}
        if any(camera.coefficients[len(names) :]):
            what = f"coefficients beyond {', '.join(names)} are left out"
            plan.losses.approximated("sensors.camera.camera", what)
    return record


def _cuboids(plan: TaskPlan, frame: WrittenFrame, texts: dict[str, Any]) -> list[dict[str, Any]]:
    yaws, tilts = headings_of(frame.boxes)
    lost = tilts > 1e-6
    what, error = "boxes have a yaw only: their tilt is left out [deg]", float(np.degrees(tilts.max(initial=0.0)))
    plan.losses.approximated("annotations.cuboid.path.values", what, count=int(lost.sum()), error=error)
    found = []
    for box, yaw in zip(frame.boxes, yaws.tolist(), strict=True):
        text = unique_text(texts, box.cuboid.id, plan.losses)
        stated = {name: value for name, value in box.stated.items() if value is not None}
        if box.cuboid.label is None:
            plan.losses.converted("annotations.cuboid.label", "objects without a class become `unknown`")
        beside = {name: stated.pop(name) for name in _BESIDE if name in stated}
        if box.cuboid.stationary is not None:
            beside.setdefault("stationary", box.cuboid.stationary)
        found.append(
            {
                "uuid": text,
                "label": box.cuboid.label or "unknown",
                "position": xyz(box.center),
                "dimensions": xyz(box.size_lwh[[1, 0, 2]]),
                "yaw": _wrapped(yaw - np.pi / 2),
                **beside,
                "attributes": stated,
            }
        )
    return found


def _wrapped(angle: float) -> float:
    """An angle from -pi to pi [rad]."""
    return angle - 2 * np.pi * floor((angle + np.pi) / (2 * np.pi))


def _xyzw(pose: RigidTransform) -> dict[str, float]:
    return dict(zip("xyzw", pose.quaternion_xyzw.tolist(), strict=True))
