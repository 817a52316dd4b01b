"""Read a sequence of KITTI-360: sweeps, rectified and fisheye images, poses, and boxes in the world.

Source: https://www.cvlibs.net/datasets/kitti-360/documentation.php and the public scripts `kitti360Scripts`. The poses
are those of a GPS/IMU frame with x ahead, y right and z down, as calib_cam_to_pose.txt shows; the ego here has y left
and z up. The rectified cameras are turned by R_rect against the frames of calib_cam_to_pose.txt.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.errors import CalibrationError, DataError, OptionError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import read_bytes
from sceneloom.formats.base.xml_files import xml_root
from sceneloom.formats.base.yaml_files import read_yaml
from sceneloom.formats.kitti.calibration import rigid_of, rotation_of
from sceneloom.formats.kitti.oxts import PERIOD_NS
from sceneloom.formats.kitti.raw_reader import TimestampFile, in_order, timestamped
from sceneloom.formats.kitti.sensors import camera_sensor, kitti_metadata, lidar_sensor
from sceneloom.formats.kitti.spec import (
    BOXES_360,
    DRIVE_NAME,
    IMAGES,
    IMAGES_360,
    POINTS_360,
    POSES_360,
    SWEEPS,
    sequences_360,
)
from sceneloom.formats.kitti.text import LARGEST, LATEST, Line, NumberedFiles, numbered_files, read_entries, read_lines
from sceneloom.geometry.euler import cuboid_angles_from_rotation
from sceneloom.geometry.rigid import RigidTransform, quaternion_from_matrix
from sceneloom.scene.annotations import CuboidAnnotation, CuboidPath
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.warnings import WarningKind

_PERSPECTIVE = {0: "image_00/data_rect", 1: "image_01/data_rect"}
_FISHEYE = {2: "image_02/data_rgb", 3: "image_03/data_rgb"}

_EGO_FROM_POSE = RigidTransform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))

_CLASSES: Mapping[int, tuple[int, str]] = MappingProxyType({
    1: (7, "road"), 2: (9, "parking"), 3: (8, "sidewalk"), 4: (22, "terrain"), 5: (21, "vegetation"), 6: (35, "gate"),
    7: (12, "wall"), 8: (13, "fence"), 9: (23, "sky"), 10: (10, "rail track"), 11: (11, "building"),
    12: (34, "garage"), 13: (26, "car"), 14: (27, "truck"), 15: (30, "trailer"), 16: (29, "caravan"),
    17: (32, "motorcycle"), 18: (33, "bicycle"), 19: (24, "person"), 20: (25, "rider"), 21: (17, "pole"),
    22: (37, "smallpole"), 23: (19, "traffic light"), 24: (20, "traffic sign"), 25: (38, "lamp"),
    26: (39, "trash bin"), 27: (40, "vending machine"), 28: (41, "box"), 29: (36, "stop"), 30: (14, "guard rail"),
    31: (15, "bridge"), 32: (16, "tunnel"), 33: (31, "train"), 34: (28, "bus"), 35: (42, "unknown construction"),
    36: (43, "unknown vehicle"), 37: (44, "unknown object"),
})  # fmt: skip
"""Id and name of a class by the number that files of boxes have for it. Source: `helpers/labels.py` of the scripts."""


def open_360(path: Path, *, sequence: str | None = None, lenient: bool = False) -> Scene:
    """Open a sequence.

    Args:
        path: the folder with `calibration`, `data_2d_raw`, `data_3d_raw` and `data_poses`.
        sequence: which one, as `0000` or its folder's name, where there are several.

    Raises:
        OptionError: there are several sequences and none was chosen, or the chosen one is not there.
    """
    names = sequences_360(path)
    if not names:
        expected = f"{IMAGES_360}, {POINTS_360} or {POSES_360} with 2013_05_28_drive_0000_sync"
        raise DataError(path, "", f"holds no sequence; expected {expected}")
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        return _Sequence(path, _chosen(path, names, sequence), ledger).scene()


def _chosen(path: Path, names: tuple[str, ...], wanted: str | None) -> str:
    shown = ", ".join(names)
    if wanted is None:
        if len(names) > 1:
            raise OptionError(f"{path} has several sequences: {shown}; choose one with `--sequence NAME`")
        return names[0]
    for name in names:
        match = DRIVE_NAME.fullmatch(name)
        if wanted == name or (match is not None and wanted == match["number"]):
            return name
    raise OptionError(f"sequence {wanted!r}: {path} has {shown}")


class _Sequence:
    """A sequence that is being read."""

    def __init__(self, root: Path, name: str, ledger: Ledger) -> None:
        self.root, self.name, self.ledger = root, name, ledger
        self.images, self.points = root / IMAGES_360 / name, root / POINTS_360 / name
        self.clocks: dict[Path, TimestampFile] = {}
        for file in (*(self.images / f"image_{k:02d}" for k in range(4)), self.points / "velodyne_points"):
            if (file / "timestamps.txt").is_file():
                self.clocks[file] = TimestampFile.read(file / "timestamps.txt")

    def scene(self) -> Scene:
        for folder, what in (
            (self.points / "sick_points", "laser scanners"),
            (self.root / POSES_360 / self.name / "oxts", "OXTS lines"),
        ):
            if folder.is_dir():
                self.ledger.note(WarningKind.SKIPPED, "not-read", str(folder), f"{what} are not read")
        mounts = self._mounts()
        trajectory = self._trajectory()
        path = None if trajectory is None else trajectory.poses
        sensors: list[Sensor] = []
        sweeps, times = self._files(self.points / "velodyne_points", "data", SWEEPS)
        if len(sweeps):
            sensors.append(lidar_sensor(sweeps, times, self._lidar_mount(mounts), path, self.ledger))
        for number, place in (_PERSPECTIVE | _FISHEYE).items():
            sensor, _, data = place.partition("/")
            files, times = self._files(self.images / sensor, data, IMAGES)
            if not len(files):
                continue
            try:
                model, turned = self._model(number)
                mount = mounts[number] @ turned if number in mounts else self._no_mount(number)
            except DataError as error:
                self.ledger.fault("camera-calibration", error, count=len(files))
                continue
            sensors.append(camera_sensor(number, files, times, model, mount, path))
        if not sensors and path is None:
            raise DataError(self.root, self.name, "holds no sweeps, images or poses")
        trajectories = {} if trajectory is None else {trajectory.name: trajectory}
        return Scene(
            tuple(sensors),
            annotations=self._cuboids(),
            trajectories=MappingProxyType(trajectories),
            metadata=kitti_metadata("kitti-360", sequence=self.name),
            source=str(self.root / self.name),
            format="kitti-360",
            warnings=self.ledger.warnings,
        )

    # times

    def _files(self, folder: Path, data: str, suffixes: tuple[str, ...]) -> tuple[NumberedFiles, Int64Array]:
        """The files of a sensor in the order of their times."""
        files = numbered_files(folder / data, suffixes, self.ledger)
        if folder not in self.clocks:
            times = self.times_of(files.numbers)
            known = times >= 0
            files = files.only(known.tolist())
            return files, times[known]
        clock = self.clocks[folder]
        if not len(files):
            return files, files.numbers
        files = timestamped(files, clock, self.ledger) if _lack_times(files, clock) else files
        rows = in_order(files.numbers, clock, self.ledger)
        files = NumberedFiles(files.folder, files.numbers[rows], tuple(files.paths[k] for k in rows.tolist()))
        return files, clock.values_ns[files.numbers]

    def times_of(self, numbers: Int64Array) -> Int64Array:
        """Times of frames by those of the first sensor that has any, (N,) int64 [ns]; -1 where it states none.

        Without any, frame k is at k / 10 s.
        """
        clock = next(iter(self.clocks.values()), None)
        if clock is None:
            if len(numbers):
                message = "no timestamps.txt: frame k is at k / 10 s"
                self.ledger.note(WarningKind.ASSUMED, "frame-times", str(self.root / self.name), message)
            return numbers * PERIOD_NS
        within = np.clip(numbers, 0, len(clock.values_ns) - 1)
        known = (numbers < len(clock.values_ns)) & clock.reported[within]
        if not known.all():
            problem = f"no time of frame {int(numbers[int(np.argmin(known))])}; expected one"
            self.ledger.fault("frames-without-time", DataError(clock.path, "", problem), count=int((~known).sum()))
        return np.where(known, clock.values_ns[within], -1)

    # calibration

    def _mounts(self) -> dict[int, RigidTransform]:
        """`ego_from_camera` by number, of the cameras before they were rectified."""
        file = self.root / "calibration" / "calib_cam_to_pose.txt"
        try:
            entries = _entries(file)
        except DataError as error:
            self.ledger.fault("mountings-missing", error)
            return {}
        names = {f"image_{number:02d}": number for number in range(4)}
        return {
            names[name]: _EGO_FROM_POSE @ rigid_of(line, line.entry(12))
            for name, line in entries.items()
            if name in names
        }

    def _no_mount(self, number: int) -> RigidTransform:
        file = self.root / "calibration" / "calib_cam_to_pose.txt"
        raise DataError(file, "", f"no image_{number:02d}; expected where the camera is mounted")

    def _lidar_mount(self, mounts: Mapping[int, RigidTransform]) -> RigidTransform:
        """`ego_from_lidar`, by way of the first camera."""
        if 0 not in mounts:
            return self._no_mount(0)
        file = self.root / "calibration" / "calib_cam_to_velo.txt"
        lines = [line for line in read_lines(file) if line.words] if file.is_file() else []
        if len(lines) != 1:
            raise DataError(file, "", f"{len(lines)} lines; expected one of 12 numbers, the camera's pose on the lidar")
        lines[0].check_count((12,), "three rows of [R t]")
        numbers = np.array(lines[0].floats(0, [f"value {k}" for k in range(12)]))
        return mounts[0] @ rigid_of(lines[0], numbers).inverse()

    def _model(self, number: int) -> tuple[Camera, RigidTransform]:
        """A camera model, and what takes the camera's frame into the one before it was rectified."""
        if number in _FISHEYE:
            return _fisheye(self.root / "calibration" / f"image_{number:02d}.yaml"), RigidTransform.identity()
        file = self.root / "calibration" / "perspective.txt"
        entries, ending = _entries(file), f"rect_{number:02d}"
        missing = [name for name in (f"P_{ending}", f"R_{ending}", f"S_{ending}") if name not in entries]
        if missing:
            raise DataError(file, "", f"no {', '.join(missing)}; it has {', '.join(entries) or 'nothing'}")
        k = entries[f"P_{ending}"].entry(12).reshape(3, 4)
        rotation = entries[f"R_{ending}"].entry(9).reshape(3, 3)
        width, height = entries[f"S_{ending}"].entry(2).tolist()
        line = entries[f"P_{ending}"]
        try:
            camera = Camera("pinhole", int(width), int(height), *k[[0, 1, 0, 1], [0, 1, 2, 2]].tolist())
            turned = RigidTransform(rotation_of(entries[f"R_{ending}"], rotation).T, np.zeros(3))
        except CalibrationError as error:
            raise line.fault(str(error)) from error
        return camera, turned

    def _trajectory(self) -> Trajectory | None:
        """Poses of the ego in the world, by number of the frame."""
        file = self.root / POSES_360 / self.name / "poses.txt"
        if not file.is_file():
            message = "no poses.txt: the trajectory is not known"
            self.ledger.note(WarningKind.SKIPPED, "no-poses", str(file.parent), message)
            return None
        numbers, poses = [], []
        for line in read_lines(file):
            line.check_count((13,), "number of the frame, and three rows of [R t]")
            numbers.append(line.whole_at(0, "frame"))
            values = np.array(line.floats(1, [f"value {k}" for k in range(12)]))
            poses.append(rigid_of(line, values) @ _EGO_FROM_POSE.inverse())
        if not poses:
            raise DataError(file, "", "is empty; expected a pose for each frame")
        times = self.times_of(np.array(numbers, np.int64))
        kept, rows = np.unique(times, return_index=True)
        rows = rows[kept >= 0]
        if not len(rows):
            return None
        rotations = np.stack([poses[row].rotation for row in rows.tolist()])
        positions = np.stack([poses[row].translation for row in rows.tolist()])
        return Trajectory(
            "pose", read_only(times[rows]), read_only(positions), read_only(quaternion_from_matrix(rotations))
        )

    # boxes

    def _cuboids(self) -> tuple[CuboidAnnotation, ...]:
        """A cuboid for each object; static ones hold from their first to their last frame."""
        files = [self.root / BOXES_360 / part / f"{self.name}.xml" for part in ("train", "train_full")]
        file = next((file for file in files if file.is_file()), None)
        if file is None:
            return ()
        boxes: dict[str, list[tuple[int, Float64Array]]] = {}
        about: dict[str, dict[str, Any]] = {}
        for row, item in enumerate(_objects(file)):
            box = _Box(file, f"{item.tag}[{row}]", item)
            values = box.values()
            if values is None:
                message = "shapes of boxes that are no cuboids are left out"
                self.ledger.note(WarningKind.SKIPPED, "no-cuboids", str(file), message)
                continue
            number, label = _CLASSES.get(box.semantic, (box.semantic, box.label or str(box.semantic)))
            name = str(number * 1000 + box.instance)
            if box.frame < 0:
                name = name if name not in boxes else f"{name}:{row}"
                boxes[name] = [(box.first, values), (max(box.last, box.first), values)]
            else:
                boxes.setdefault(name, []).append((box.frame, values))
            about.setdefault(name, {"label": label, "stationary": box.frame < 0, "start": box.first, "end": box.last})
        return tuple(found for name, rows in boxes.items() if (found := self._cuboid(name, rows, about[name])))

    def _cuboid(
        self, name: str, rows: Sequence[tuple[int, Float64Array]], about: Mapping[str, Any]
    ) -> CuboidAnnotation | None:
        times = self.times_of(np.array([frame for frame, _ in rows], np.int64))
        kept, order = np.unique(times, return_index=True)
        order = order[kept >= 0]
        if not len(order):
            return None
        values = np.stack([rows[k][1] for k in order.tolist()])
        extras = MappingProxyType({"start_frame": about["start"], "end_frame": about["end"]})
        path = CuboidPath(times[order], values)
        return CuboidAnnotation(name, path, label=about["label"], stationary=about["stationary"], extras=extras)


def _lack_times(files: NumberedFiles, clock: TimestampFile) -> bool:
    """Whether a file has no time; that others were not downloaded, though they have times, is no fault."""
    numbers = files.numbers
    return bool(numbers[-1] >= len(clock.values_ns) or not clock.reported[numbers].all())


class _Box:
    """A shape in the file of boxes."""

    def __init__(self, file: Path, location: str, item: ET.Element) -> None:
        self.file, self.location, self.item = file, location, item
        self.label = (item.findtext("label") or "").strip()
        self.semantic, self.instance = self._whole("semanticId"), self._whole("instanceId")
        self.frame = self._whole("timestamp", low=-1)
        self.first, self.last = self._whole("start_frame"), self._whole("end_frame")

    def _whole(self, name: str, *, low: int = 0) -> int:
        text = (self.item.findtext(name) or "").strip()
        if not re.fullmatch(r"-?\d{1,9}", text) or not low <= int(text) <= LATEST:
            problem = f"{text[:40]!r}; expected a whole number from {low} to {LATEST}"
            raise DataError(self.file, f"{self.location}/{name}", problem)
        return int(text)

    def _matrix(self, name: str, columns: int) -> Float64Array:
        """A matrix of OpenCV's, (N, columns) float64."""
        found = self.item.find(name)
        words = ("" if found is None else found.findtext("data") or "").split()
        try:
            numbers = np.array([float(word) for word in words])
        except ValueError:
            numbers = np.array([np.nan])
        if not len(numbers) or len(numbers) % columns or not (np.abs(numbers) <= LARGEST).all():
            problem = f"{len(words)} values; expected rows of {columns} numbers within ±{LARGEST:g}"
            raise DataError(self.file, f"{self.location}/{name}", problem)
        return numbers.reshape(-1, columns)

    def values(self) -> Float64Array | None:
        """Row `dx dy dz px py pz roll pitch yaw` in the world [m, deg]; None of what is no cuboid."""
        transform = self._matrix("transform", 4)
        if transform.shape != (4, 4):
            raise DataError(self.file, f"{self.location}/transform", f"{transform.shape}; expected 4 rows of 4")
        vertices = self._matrix("vertices", 3)
        scales = np.linalg.norm(transform[:3, :3], axis=0)
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        sizes = (high - low) * scales
        if len(vertices) != 8 or not (sizes > 0).all():
            return None
        on_faces = np.minimum(np.abs(vertices - low), np.abs(vertices - high)) * scales
        rotation = transform[:3, :3] / scales
        if on_faces.max() > _OFF_M or np.abs(rotation.T @ rotation - np.eye(3)).max() > _OFF:
            return None
        if np.linalg.det(rotation) < 0:  # of a box, the mirror image is the box itself
            rotation[:, 1] *= -1
        nearest, _ = RigidTransform.nearest(np.column_stack([rotation, np.zeros(3)]))
        center = transform[:3, :3] @ ((low + high) / 2.0) + transform[:3, 3]
        return np.concatenate([sizes, center, cuboid_angles_from_rotation(nearest.rotation)])


_OFF_M, _OFF = 0.01, 1e-3


def _objects(file: Path) -> list[ET.Element]:
    return [item for item in xml_root(file, read_bytes(file)) if item.find("transform") is not None]


def _entries(file: Path) -> dict[str, Line]:
    if not file.is_file():
        raise DataError(file, "", "is missing; expected the calibration of KITTI-360")
    return read_entries(file)


_GROUPS = {
    "mirror_parameters": ("xi",),
    "distortion_parameters": ("k1", "k2", "p1", "p2"),
    "projection_parameters": ("gamma1", "gamma2", "u0", "v0"),
}


def _fisheye(file: Path) -> Camera:
    """A fisheye camera: Mei's model, as OpenCV's kind of YAML states it."""
    if not file.is_file():
        raise DataError(file, "", "is missing; expected the fisheye calibration")
    found = read_yaml(file)
    stated: dict[str, float] = {}
    for group, names in ((None, ("image_width", "image_height")), *_GROUPS.items()):
        for name in names:
            inside = found if group is None else found.get(group) if isinstance(found, dict) else None
            value = inside.get(name) if isinstance(inside, dict) else None
            if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= LARGEST:
                raise DataError(file, f"{group}.{name}" if group else name, f"{value!r:.40}; expected a number")
            stated[name] = value
    coefficients = (stated["k1"], stated["k2"], 0.0, 0.0, stated["p1"], stated["p2"], stated["xi"], 0.0, 0.0)
    size = int(stated["image_width"]), int(stated["image_height"])
    focal = (stated["gamma1"], stated["gamma2"], stated["u0"], stated["v0"])
    try:
        fx, fy, cx, cy = map(float, focal)
        return Camera("omnidirectional", *size, fx, fy, cx, cy, tuple(map(float, coefficients)))
    except CalibrationError as error:
        raise DataError(file, "", str(error)) from error
