"""Write a sequence of the odometry benchmark, with labelled points in SemanticKITTI's numbers."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sceneloom.arrays import UInt32Array, finite_rows
from sceneloom.errors import OptionError
from sceneloom.formats.base.losses import Losses, LossReport
from sceneloom.formats.base.output import FolderKind, replacing
from sceneloom.formats.base.text_tables import seconds_text
from sceneloom.formats.base.written_ego import egos_at
from sceneloom.formats.kitti.calibration import write_calibration
from sceneloom.formats.kitti.frames_writer import Choice, Timeline, kept_calibration, kept_of
from sceneloom.formats.kitti.odometry_reader import CLASS_BITS, CLASS_NAMES, UNLABELED
from sceneloom.formats.kitti.spec import ODOMETRY_CAMERAS, OdometrySequence
from sceneloom.formats.kitti.text import write_lines
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations import LabeledPointsAnnotation
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.motion import OdometrySensor
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import key_of

_NUMBERS: Mapping[str, int] = {name: number for number, name in CLASS_NAMES.items()}
_KEPT = "semantic_kitti"
_LARGEST = (1 << CLASS_BITS) - 1


@dataclass(slots=True)
class _PointLabels:
    """The labels of a lidar's sweeps: by number of the sweep, the numbers and the points that have them."""

    losses: Losses
    parts: dict[int, list[tuple[int, UInt32Array]]] = field(default_factory=lambda: defaultdict(list))

    def __bool__(self) -> bool:
        return bool(self.parts)

    @classmethod
    def of(cls, choice: Choice) -> "_PointLabels":
        """Collect what a scene says of the lidar's points."""
        found = cls(choice.losses)
        instances: dict[int, int] = defaultdict(int)
        for annotation in choice.scene.annotations:
            if isinstance(annotation, LabeledPointsAnnotation):
                value = found._value(annotation, instances)
                if value is not None:
                    found._add(annotation, value, choice.lidar)
        return found

    def values(self, sweep: int, count: int) -> UInt32Array:
        """The labels of a sweep's points, (count,) uint32; of several of one point the last counts."""
        values = np.full(count, UNLABELED, np.uint32)
        repeated = beyond = 0
        for value, rows in self.parts.get(sweep, ()):
            inside = rows[rows < count]
            beyond += len(rows) - len(inside)
            repeated += int((values[inside] != UNLABELED).sum())
            values[inside] = value
        name = "annotations.labeled_points.labeled_points.point_ids"
        self.losses.dropped(name, "a point has one label there: the last one", count=repeated)
        self.losses.dropped(name, "of no point", count=beyond)
        return values

    def _value(self, annotation: LabeledPointsAnnotation, instances: dict[int, int]) -> int | None:
        """The number of an annotation: as it was read, else that of its class, and a free one for an object."""
        kept = annotation.extras.get(_KEPT)
        if isinstance(kept, int) and 0 < kept < 1 << (2 * CLASS_BITS):
            return kept
        number = _class_number(annotation.label)
        if number is None:
            what = f"{annotation.label!r} left out: SemanticKITTI has no number for it"
            count = sum(len(part.point_ids) for part in annotation.labeled_points)
            self.losses.dropped("annotations.labeled_points", what, count=count)
            return None
        if not annotation.is_instance:
            return number
        instances[number] += 1
        if instances[number] > _LARGEST:
            return number
        what = "objects are called by numbers there"
        self.losses.converted("annotations.labeled_points.id", what)
        return number | instances[number] << CLASS_BITS

    def _add(self, annotation: LabeledPointsAnnotation, value: int, lidar: LidarSensor | None) -> None:
        for part in annotation.labeled_points:
            is_here = lidar is not None and key_of(part.sensor_id) == key_of(lidar.id)
            if is_here and part.sensor_frame is not None:
                self.parts[part.sensor_frame].append((value, part.point_ids))
                continue
            what = "left out: points of another sensor, or of no sweep"
            name = "annotations.labeled_points.labeled_points"
            self.losses.dropped(name, what, count=len(part.point_ids))
        for name, count in (
            ("attributes", len(annotation.attributes)),
            ("parent_id", int(annotation.parent_id is not None)),
            ("extras", len([key for key in annotation.extras if key != _KEPT])),
        ):
            if count:
                what = "left out: a label is a number"
                self.losses.dropped(f"annotations.labeled_points.{name}", what, count=count)


def _class_number(label: str | None) -> int | None:
    """The number of a class by its name in any case, or the number that it is called by."""
    if label is None:
        return None
    name = label.strip().lower().replace("_", "-").replace(" ", "-")
    if name.isascii() and name.isdigit() and 0 < int(name) <= _LARGEST:
        return int(name)
    number = _NUMBERS.get(name)
    return number or None


_SLOTS = (2, 3, 0, 1)  # numbers of cameras, those of the coloured ones first

_HELD = frozenset({LidarSensor, CameraSensor, OdometrySensor, LabeledPointsAnnotation})
"""Kinds of sensors and annotations that a sequence can hold."""

_SEQUENCE = r"sequences/(?P<one>.+)"

_KIND = FolderKind(
    "folder of KITTI's odometry benchmark",
    (
        rf"{_SEQUENCE}/(calib|times)\.txt",
        rf"{_SEQUENCE}/(velodyne|labels|image_\d)/\d{{6}}\.(bin|label|png|jpe?g)",
        r"poses/(?P<one>.+)\.txt",
    ),
    r"sequences/.+/calib\.txt",
)


def write_odometry(scene: Scene, path: Path, *, overwrite: bool = False, sequence: str | None = None) -> LossReport:
    """Write a scene as a sequence in folders `sequences` and `poses` below the path.

    Args:
        sequence: its name, two digits; None for the one that the scene was read from, else "00".

    Raises:
        OptionError: the name is none.
    """
    kept = kept_of(scene)
    name = str(kept["sequence"]) if kept.get("benchmark") == "odometry" and "sequence" in kept else "00"
    location = _location(path, sequence or name)
    choice = Choice.of(scene, _SLOTS, _HELD)
    choice.check_files(labels=False)
    timeline = choice.timeline()
    labels = _PointLabels.of(choice)
    with replacing(path, overwrite=overwrite, folder=_KIND) as draft:
        folder = draft / "sequences" / location.name
        folder.mkdir(parents=True)

        def reported(k: int, frame: LidarFrame) -> None:
            if labels:
                values = labels.values(int(timeline.sweeps[k]), len(frame.points))
                written = finite_rows(frame.points.positions)
                (folder / "labels" / f"{k:06d}.label").write_bytes(values[written].astype("<u4").tobytes())

        if labels:
            (folder / "labels").mkdir()
        images = {number: folder / kind for number, kind in ODOMETRY_CAMERAS.items()}
        choice.write_frames(timeline, "{:06d}".format, folder / "velodyne", images, reported)
        mounted = choice.mounted(with_imu=False)
        rectified_from_lidar = write_calibration(folder / "calib.txt", "odometry", mounted, kept_calibration(scene))
        write_lines(folder / "times.txt", map(seconds_text, timeline.timestamps_ns.tolist()))
        if choice.ego_path is not None:
            (draft / "poses").mkdir()
            poses = _poses(choice, timeline, rectified_from_lidar)
            write_lines(draft / "poses" / f"{location.name}.txt", poses)
    return LossReport.of(choice.losses)


def _location(path: Path, name: str) -> OdometrySequence:
    if not (name.isascii() and name.isdigit() and int(name) < 100):
        raise OptionError(f"sequence {name!r}; expected two digits, as 00")
    name = f"{int(name):02d}"
    return OdometrySequence(name, path / "sequences" / name, path / "poses" / f"{name}.txt")


def _poses(choice: Choice, timeline: Timeline, rectified_from_lidar: RigidTransform) -> list[str]:
    """The poses of camera 0's rectified frame, seen from its first one, a line each."""
    egos = egos_at(choice.ego_path, timeline.timestamps_ns)
    if not egos:
        return []
    path, losses = choice.ego_path, choice.losses
    if path is not None and not path.static:
        timestamps = timeline.timestamps_ns
        beyond = int(((timestamps < path.start_ns) | (timestamps > path.stop_ns)).sum())
        losses.approximated("trajectories.positions", "beyond the trajectory: its end poses written", count=beyond)
        further = len(np.setdiff1d(path.timestamps_ns, timestamps))
        what = "a pose for each frame; those between are left out"
        losses.approximated("trajectories.timestamps_ns", what, count=further)
    if np.abs(egos[0].matrix - np.eye(4)).max() > 1e-9:
        what = "seen from the first pose, which becomes the world's origin; read back, its axes are the lidar's there"
        losses.converted("trajectories.positions", what, count=len(egos))
    ego_from_camera = choice.ego_from_lidar @ rectified_from_lidar.inverse()
    first_from_world = (egos[0] @ ego_from_camera).inverse()
    poses = (first_from_world @ ego @ ego_from_camera for ego in egos)
    return [" ".join(map(repr, pose.matrix[:3].reshape(-1).tolist())) for pose in poses]
