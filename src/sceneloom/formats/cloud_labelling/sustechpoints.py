"""SUSTechPOINTS: folders of lidar clouds, camera images, calibrations and labels; read and written.

Source: "Data preparation" of the tool's README and its doc/data-format.md: boxes are in the lidar's frame, look along
+x at yaw 0, have length, width and height as `scale`, and rotate by Rx·Ry·Rz; `extrinsic` takes points of the lidar
into the camera. `lidar_pose`, `lidar_to_camera` and calibrations of single frames are as its converter of nuScenes
writes them; radars are placed by `translation` and `rotation` in the lidar's frame.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, read_only
from sceneloom.errors import DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.images import IMAGE_SUFFIXES
from sceneloom.formats.base.json_files import read_json
from sceneloom.formats.base.losses import LossReport
from sceneloom.formats.base.output import FolderKind, file_stem, replacing
from sceneloom.formats.base.spec import choose_drive
from sceneloom.formats.cloud_labelling.spec import SUSTECH_CLOUDS, SUSTECH_SUPPORTS, sustech_scenes
from sceneloom.formats.cloud_labelling.tasks import (
    XYZ,
    TaskFrame,
    TaskImage,
    TaskOptions,
    TaskPlan,
    TaskTracks,
    TaskWorld,
    WrittenFrame,
    cameras_of,
    frame_times,
    identifier_of,
    lidar_of,
    pinhole_of,
    rigid_of_rows,
    task_scene,
    unique_text,
    xyz,
)
from sceneloom.formats.points.reader import listed_frames, stem_of
from sceneloom.geometry.euler import AngleUnit, cuboid_angles_from_rotation, rotation_from_cuboid_angles
from sceneloom.geometry.rigid import RigidTransform, matrix_from_quaternion, quaternion_from_matrix
from sceneloom.scene.clouds import LidarFrame, LidarSensor, RadarFrame, RadarPoints, RadarSensor
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier
from sceneloom.warnings import WarningKind

_READ = ("lidar", "camera", "calib", "label", "lidar_pose", "radar", "aux_lidar", "desc.json", "meta")
_ATTRIBUTES = ("obj_attr", "annotator")
_VELOCITIES = ("vx", "vy", "vz")


class _Psr(msgspec.Struct):
    position: XYZ
    scale: XYZ
    rotation: XYZ


class _Box(msgspec.Struct):
    psr: _Psr
    obj_type: str = ""
    obj_id: str | int = ""
    obj_attr: Any = None
    annotator: Any = None


class _Labels(msgspec.Struct):
    objs: list[_Box]


class _Calibration(msgspec.Struct):
    intrinsic: list[float] | None = None
    extrinsic: list[float] | None = None
    lidar_to_camera: list[float] | None = None


class _Mounting(msgspec.Struct):
    translation: list[float]
    rotation: list[float]


class _LidarPose(msgspec.Struct):
    lidarPose: list[float]  # noqa: N815 - the format's word


def open_sustechpoints(
    path: Path, *, sequence: str | None = None, rate_hz: float | str | None = None, lenient: bool = False
) -> Scene:
    """Open a scene of the tool; clouds and images are read on demand, labels at once.

    Args:
        path: the folder of a scene, or one of several.
        sequence: name of the scene, where there are several.
        rate_hz: frames a second, where names of frames are no times; by default 10, which is reported.
        lenient: go without images, poses and boxes that are missing or wrong, and count them.

    Raises:
        OptionError: there is no such scene, none was chosen of several, or the rate is no number above 0.
    """
    expected = "lidar/*.pcd, and label/, camera/ or calib/"
    folder = choose_drive(path, sustech_scenes(path), sequence, called="scene", expected=expected)
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        return _Reader(folder, ledger, rate_hz).scene()


class _Reader:
    """One scene."""

    def __init__(self, folder: Path, ledger: Ledger, rate_hz: float | str | None) -> None:
        self.folder, self.ledger = folder, ledger
        clouds = _by_stem(folder / "lidar", SUSTECH_CLOUDS)
        labels = _by_stem(folder / "label", (".json",))
        names = sorted({*clouds, *labels})
        if not names:
            raise DataError(folder / "lidar", "", "no cloud; expected files such as 000000.pcd")
        if len(clouds) < len(names):
            message, count = "clouds of some frames are not there; their labels are read", len(names) - len(clouds)
            ledger.note(WarningKind.SKIPPED, "clouds-missing", str(folder / "lidar"), message, count=count)
        self.labels = labels
        self.times_ns = frame_times(names, folder / "lidar", ledger, rate_hz=rate_hz)
        self.cameras = [one.name for one in sorted((folder / "camera").glob("*")) if one.is_dir()]
        self.calibrations = {name: self._calibration("camera", name) for name in self.cameras}
        self.images = {name: _by_stem(folder / "camera" / name, IMAGE_SUFFIXES) for name in self.cameras}
        self.frames = [
            TaskFrame(name, int(time), clouds.get(name), self._pose(name), tuple(self._images(name, int(time))))
            for name, time in zip(names, self.times_ns, strict=True)
        ]
        unread = sorted(one.name for one in folder.iterdir() if one.name not in _READ and not one.name.startswith("."))
        if unread:
            message = f"{', '.join(unread[:8])}: not read"
            ledger.note(WarningKind.SKIPPED, "files-left-out", str(folder), message, count=len(unread))

    def scene(self) -> Scene:
        world = TaskWorld.of(self.frames, self.folder, self.ledger)
        lidar = lidar_of(self.frames, world, self.ledger)
        tracks = TaskTracks()
        for number, frame in enumerate(self.frames):
            path = self.labels.get(frame.name)
            if path is not None:
                try:
                    self._add_labels(path, number, tracks)
                except DataError as error:
                    self.ledger.fault("labels", error)
        return task_scene(
            [lidar, *self._beside(), *cameras_of(self.frames, world, self.folder, self.ledger)],
            tracks.cuboids(self.times_ns, world, lidar_id=None if lidar is None else lidar.id),
            world,
            self.ledger,
            source=self.folder,
            format="sustechpoints",
            about={"scene": self.folder.resolve().name},
        )

    # frames

    def _pose(self, name: str) -> RigidTransform | None:
        path = self.folder / "lidar_pose" / f"{name}.json"
        if not path.is_file():
            return None
        try:
            return rigid_of_rows(path, "lidarPose", read_json(path, _LidarPose).lidarPose)
        except DataError as error:
            self.ledger.fault("poses", error)
            return None

    def _calibration(self, kind: str, name: str) -> _Calibration:
        path = self.folder / "calib" / kind / f"{name}.json"
        return read_json(path, _Calibration) if path.is_file() else _Calibration()

    def _images(self, name: str, time_ns: int) -> Iterator[TaskImage]:
        for camera in self.cameras:
            image = self.images[camera].get(name)
            if image is None:
                continue
            path, stated = self.folder / "calib" / "camera" / f"{camera}.json", self.calibrations[camera]
            own = self.folder / "calib" / "camera" / camera / f"{name}.json"
            try:
                if own.is_file():
                    path, known = own, msgspec.structs.asdict(read_json(own, _Calibration))
                    stated = msgspec.structs.replace(stated, **{n: v for n, v in known.items() if v is not None})
                matrix = stated.lidar_to_camera or stated.extrinsic
                if matrix is None or stated.intrinsic is None:
                    message = "images of cameras without extrinsic and intrinsic are left out"
                    self.ledger.note(WarningKind.SKIPPED, "images-without-calibration", str(path), message)
                    continue
                model = pinhole_of(path, "intrinsic", image, stated.intrinsic, self.ledger)
                pose = rigid_of_rows(path, "extrinsic", matrix).inverse()
            except DataError as error:
                self.ledger.fault("images", error)
                continue
            yield TaskImage(camera, image, f"camera/{camera}/{image.name}", time_ns, model, pose)

    def _beside(self) -> Iterator[LidarSensor | RadarSensor]:
        """Further lidars, and radars."""
        for kind in ("aux_lidar", "radar"):
            for folder in sorted(one for one in (self.folder / kind).glob("*") if one.is_dir()):
                files = _by_stem(folder, SUSTECH_CLOUDS)
                rows = [k for k, frame in enumerate(self.frames) if frame.name in files]
                if not rows:
                    continue
                try:
                    mount = self._mounting(kind, folder.name)
                    listed = [files[self.frames[k].name] for k in rows]
                    frames, extras = listed_frames(listed, self.times_ns[rows], self.ledger)
                except DataError as error:
                    self.ledger.fault(f"{kind}s".replace("_", "-"), error)
                    continue
                if kind == "radar":
                    yield RadarSensor(folder.name, frames.mapped(_radar_frame), mount=mount)
                else:
                    yield LidarSensor(folder.name, frames, mount=mount, extras=extras)

    def _mounting(self, kind: str, name: str) -> RigidTransform:
        path = self.folder / "calib" / kind / f"{name}.json"
        if not path.is_file():
            message = "sensors without a calibration are taken to be where the lidar is"
            self.ledger.note(WarningKind.ASSUMED, "no-mounting", str(path), message)
            return RigidTransform.identity()
        record = read_json(path, _Mounting)
        numbers = np.array([*record.translation, *record.rotation], np.float64)
        if len(record.translation) != 3 or len(record.rotation) != 3 or not (np.abs(numbers) < 1e4).all():
            raise DataError(path, "", "expected three numbers each of translation and rotation")
        rotation = rotation_from_cuboid_angles(numbers[3:], unit=AngleUnit.RADIANS)
        return RigidTransform(rotation, numbers[:3])

    # labels

    def _add_labels(self, path: Path, frame: int, tracks: TaskTracks) -> None:
        found = read_json(path, Any)
        kind: Any = _Labels if isinstance(found, dict) else list[_Box]
        labels = read_json(path, kind)
        boxes: list[_Box] = labels.objs if isinstance(labels, _Labels) else labels
        for row, box in enumerate(boxes):
            where = f"[{row}].psr"
            try:
                angles = box.psr.rotation.array(path, f"{where}.rotation")
                quaternion = quaternion_from_matrix(rotation_from_cuboid_angles(angles, unit=AngleUnit.RADIANS))
                position = box.psr.position.array(path, f"{where}.position")
                size = box.psr.scale.array(path, f"{where}.scale")
                stated = {name: getattr(box, name) for name in _ATTRIBUTES if getattr(box, name) not in (None, "")}
                identifier = self._identifier(box, frame, row)
                label = box.obj_type or None
                tracks.add(path, where, identifier, frame, label, (position, size, quaternion), stated=_flat(stated))
            except DataError as error:
                self.ledger.fault("labels", error)

    def _identifier(self, box: _Box, frame: int, row: int) -> Identifier:
        """The id of an object; one without is an object of its own in each frame."""
        text = str(box.obj_id)
        return identifier_of(text) if text else f"{self.frames[frame].name}.{row}"


def _by_stem(folder: Path, suffixes: tuple[str, ...]) -> dict[str, Path]:
    found = sorted(folder.iterdir()) if folder.is_dir() else []
    return {stem_of(file.name): file for file in found if file.suffix.lower() in suffixes and file.is_file()}


def _flat(stated: Mapping[str, Any]) -> dict[str, Any]:
    """Attributes that are objects of JSON, each field by itself."""
    flat: dict[str, Any] = {}
    for name, value in stated.items():
        flat |= value if isinstance(value, dict) else {name: value}
    return {name: value for name, value in flat.items() if value is not None}


def _radar_frame(frame: LidarFrame) -> RadarFrame:
    """Take a cloud with velocities as returns of a radar."""
    points, columns = frame.points, [frame.points.extras.get(name) for name in _VELOCITIES]
    directions = lengths = None
    extras = dict(points.extras)
    if all(column is not None and column.ndim == 1 and column.dtype.kind in "fiu" for column in columns):
        velocities: Float64Array = np.stack([np.nan_to_num(column) for column in columns if column is not None], axis=1)
        speeds = np.linalg.norm(velocities.astype(np.float64), axis=1)
        units = np.where(speeds[:, None] > 0, velocities, [1.0, 0.0, 0.0])
        units = units / np.linalg.norm(units, axis=1, keepdims=True)
        directions, lengths = read_only(units, np.float32), read_only(speeds, np.float32)
        extras = {name: column for name, column in extras.items() if name not in _VELOCITIES}
    made = RadarPoints(points.positions, directions, lengths, points.timestamps_ns, MappingProxyType(extras))
    return RadarFrame(frame.timestamp_ns, made, frame.extras)


# writing

_KIND = FolderKind(
    "scene of SUSTechPOINTS",
    (
        r"lidar/-?\d{19}\.pcd",
        r"(label|lidar_pose)/-?\d{19}\.json",
        r"camera/.+/-?\d{19}\.(jpg|png)",
        r"calib/camera/.+\.json",
        r"calib/camera/.+/-?\d{19}\.json",
    ),
    r"lidar/-?\d{19}\.pcd",
)
_SAME = 1e-9


def write_sustechpoints(
    scene: Scene,
    path: Path,
    *,
    overwrite: bool = False,
    lidar: str | None = None,
    points_frame: str | None = None,
    trajectory: str | None = None,
) -> LossReport:
    """Write a scene for the tool; frames are read, written and released one by one.

    Args:
        overwrite: replace the folder if it is such a scene, or empty.
        lidar, points_frame, trajectory: as of `TaskOptions`.

    Raises:
        OptionError: an option is none of these, or the scene has no sweep.
        DataError: a frame or image cannot be read.
    """
    plan = TaskPlan(scene, SUSTECH_SUPPORTS, TaskOptions(lidar, points_frame, trajectory))
    with replacing(path, overwrite=overwrite, folder=_KIND) as draft:
        _Writer(plan, draft).write()
    return LossReport.of(plan.losses)


@dataclass(slots=True)
class _Writer:
    """Writes one scene."""

    plan: TaskPlan
    root: Path

    def write(self) -> None:
        for name in ("lidar", "label"):
            (self.root / name).mkdir()
        clouds, texts = self.plan.clouds(), dict[str, Identifier]()
        calibrations: dict[str, list[tuple[str, dict[str, Any]]]] = {}
        for frame in self.plan:
            clouds.write_frame(self.plan.lidar, frame.sweep, self.root / "lidar" / f"{frame.name}.pcd")
            _dump(self.root / "label" / f"{frame.name}.json", self._boxes(frame, texts))
            if self.plan.posed:
                pose = {"lidarPose": frame.world_from_cloud.matrix.ravel().tolist()}
                _dump(self.root / "lidar_pose" / f"{frame.name}.json", pose)
            self._write_images(frame, calibrations)
        for camera, stated in calibrations.items():
            first = stated[0][1]
            _dump(self.root / "calib" / "camera" / f"{camera}.json", first)
            if any(not np.allclose(one["extrinsic"], first["extrinsic"], atol=_SAME, rtol=0) for _, one in stated):
                for name, one in stated:
                    _dump(self.root / "calib" / "camera" / camera / f"{name}.json", one)

    def _write_images(self, frame: WrittenFrame, calibrations: dict[str, list[tuple[str, dict[str, Any]]]]) -> None:
        losses = self.plan.losses
        for written in frame.images:
            camera, model = file_stem(written.camera_id), written.image.camera
            off = abs(written.image.timestamp_ns - frame.timestamp_ns)
            what = "images have the time of their cloud [s]"
            losses.approximated("sensors.camera.images.timestamp_ns", what, count=int(off > 0), error=off / 1e9)
            self.plan.write_image(replace(written, stem=frame.name), self.root / "camera" / camera)
            if written.cloud_from_camera is None:
                what = "cameras whose mounting is not known are written without calibration"
                losses.dropped("sensors.camera.camera", what)
                continue
            stated = {
                "extrinsic": written.cloud_from_camera.inverse().matrix.ravel().tolist(),
                "intrinsic": [model.fx, 0.0, model.cx, 0.0, model.fy, model.cy, 0.0, 0.0, 1.0],
            }
            calibrations.setdefault(camera, []).append((frame.name, stated))

    def _boxes(self, frame: WrittenFrame, texts: dict[str, Identifier]) -> list[dict[str, Any]]:
        rotations = matrix_from_quaternion(np.array([box.quaternion_xyzw for box in frame.boxes]).reshape(-1, 4))
        angles = cuboid_angles_from_rotation(rotations, unit=AngleUnit.RADIANS)
        found = []
        for box, rotation in zip(frame.boxes, angles, strict=True):
            if box.cuboid.label is None:
                self.plan.losses.converted("annotations.cuboid.label", "objects without a class become `Unknown`")
            stated = {name: value for name, value in box.stated.items() if value is not None}
            annotator = {"annotator": stated.pop("annotator")} if "annotator" in stated else {}
            found.append(
                {
                    "psr": {"position": xyz(box.center), "scale": xyz(box.size_lwh), "rotation": xyz(rotation)},
                    "obj_type": box.cuboid.label or "Unknown",
                    "obj_id": unique_text(texts, box.cuboid.id, self.plan.losses),
                    "obj_attr": stated.pop("obj_attr") if [*stated] == ["obj_attr"] else stated or "",
                    **annotator,
                }
            )
        return found


def _dump(path: Path, value: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(msgspec.json.encode(value))
