"""Write a sequence of the odometry benchmark, with labelled points in SemanticKITTI's numbers."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sceneloom.arrays import UInt32Array, finite_rows
from sceneloom.errors import OptionError
from sceneloom.formats.base.losses import Loss, LossReport, Support
from sceneloom.formats.base.output import FolderKind, replacing
from sceneloom.formats.base.text_tables import seconds_text
from sceneloom.formats.kitti.calibration import write_calibration
from sceneloom.formats.kitti.frames_writer import (
    Choice,
    Timeline,
    check_files,
    choose,
    dropped_parts,
    egos_at,
    kept_calibration,
    kept_of,
    mounted_of,
    point_time_loss,
    timeline_of,
    write_frames,
)
from sceneloom.formats.kitti.odometry_reader import CLASS_BITS, CLASS_NAMES, UNLABELED
from sceneloom.formats.kitti.spec import ODOMETRY_CAMERAS, OdometrySequence
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
    """The labels of a lidar's sweeps.

    Attributes:
        parts: by number of the sweep, the numbers and the points that have them.
        losses: of annotations that have no number.
        lost_later: of points that have several labels, found while sweeps are written.
    """

    parts: dict[int, list[tuple[int, UInt32Array]]] = field(default_factory=lambda: defaultdict(list))
    losses: list[Loss] = field(default_factory=list)
    lost_later: list[Loss] = field(default_factory=list)

    def __bool__(self) -> bool:
        return bool(self.parts)

    @classmethod
    def of(cls, scene: Scene, lidar: LidarSensor | None) -> "_PointLabels":
        """Collect what a scene says of a lidar's points."""
        found = cls()
        instances: dict[int, int] = defaultdict(int)
        for annotation in scene.annotations:
            if isinstance(annotation, LabeledPointsAnnotation):
                value = found._value(annotation, instances)
                if value is not None:
                    found._add(annotation, value, lidar)
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
        for lost, what in ((repeated, "a point has one label there: the last one"), (beyond, "of no point")):
            if lost:
                name = "annotations.labeled_points.labeled_points.point_ids"
                self.lost_later.append(Loss(field=name, what=what, count=lost))
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
            self.losses.append(Loss(field="annotations.labeled_points", what=what, count=count))
            return None
        if not annotation.is_instance:
            return number
        instances[number] += 1
        if instances[number] > _LARGEST:
            return number
        what = "objects are called by numbers there"
        self.losses.append(Loss(field="annotations.labeled_points.id", what=what, support=Support.CONVERTED))
        return number | instances[number] << CLASS_BITS

    def _add(self, annotation: LabeledPointsAnnotation, value: int, lidar: LidarSensor | None) -> None:
        for part in annotation.labeled_points:
            is_here = lidar is not None and key_of(part.sensor_id) == key_of(lidar.id)
            if is_here and part.sensor_frame is not None:
                self.parts[part.sensor_frame].append((value, part.point_ids))
                continue
            what = "left out: points of another sensor, or of no sweep"
            name = "annotations.labeled_points.labeled_points"
            self.losses.append(Loss(field=name, what=what, count=len(part.point_ids)))
        for name, count in (
            ("attributes", len(annotation.attributes)),
            ("parent_id", int(annotation.parent_id is not None)),
            ("extras", len([key for key in annotation.extras if key != _KEPT])),
        ):
            if count:
                what = "left out: a label is a number"
                self.losses.append(Loss(field=f"annotations.labeled_points.{name}", what=what, count=count))


def _class_number(label: str | None) -> int | None:
    """The number of a class by its name in any case, or the number that it is called by."""
    if label is None:
        return None
    name = label.strip().lower().replace("_", "-").replace(" ", "-")
    if name.isascii() and name.isdigit() and 0 < int(name) <= _LARGEST:
        return int(name)
    number = _NUMBERS.get(name)
    return number or None


_SLOTS = (2, 3, 0, 1)
"""Numbers of cameras, those of the coloured ones first."""

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


def write_odometry(
    scene: Scene, path: Path, *, overwrite: bool = False, sequence: str | None = None
) -> LossReport:
    """Write a scene as a sequence in folders `sequences` and `poses`.

    Args:
        scene: to be written.
        path: the folder above `sequences`.
        overwrite: replace a folder of such sequences as a whole.
        sequence: its name, two digits; None for the one that the scene was read from, else "00".

    Returns:
        What the folder could not hold.

    Raises:
        OptionError: the name is none.
        OutputError: the path exists, or cannot be written.
        DataError: what the scene is read from is damaged.
    """
    location = _location(path, sequence or _kept_name(scene))
    choice = choose(scene, _SLOTS, rectified=True, models=frozenset({"pinhole"}))
    losses = [*dropped_parts(scene, _HELD), *choice.losses]
    check_files(choice, labels=False)
    timeline = timeline_of(choice)
    losses += timeline.losses
    labels = _PointLabels.of(scene, choice.lidar)
    losses += labels.losses
    with replacing(path, overwrite=overwrite, folder=_KIND) as draft:
        folder = draft / "sequences" / location.name
        folder.mkdir(parents=True)

        def reported(k: int, frame: LidarFrame) -> None:
            losses.extend(point_time_loss(frame))
            if labels:
                values = labels.values(int(timeline.sweeps[k]), len(frame.points))
                written = finite_rows(frame.points.positions)
                _write_point_labels(values[written], folder / "labels" / f"{k:06d}.label")

        if labels:
            (folder / "labels").mkdir()
        images = {number: folder / kind for number, kind in ODOMETRY_CAMERAS.items()}
        losses += write_frames(choice, timeline, "{:06d}".format, folder / "velodyne", images, reported)
        mounted = mounted_of(choice, with_imu=False)
        rectified_from_lidar = write_calibration(
            folder / "calib.txt", "odometry", mounted, kept_calibration(scene)
        )
        seconds = "".join(f"{seconds_text(time)}\n" for time in timeline.timestamps_ns.tolist())
        (folder / "times.txt").write_text(seconds, "utf-8", newline="\n")
        if choice.ego_path is not None:
            (draft / "poses").mkdir()
            text, lost = _poses(choice, timeline, rectified_from_lidar)
            (draft / "poses" / f"{location.name}.txt").write_text(text, "utf-8", newline="\n")
            losses += lost
    return LossReport.of([*losses, *labels.lost_later])


def _kept_name(scene: Scene) -> str:
    kept = kept_of(scene)
    return str(kept["sequence"]) if kept.get("benchmark") == "odometry" and "sequence" in kept else "00"


def _location(path: Path, name: str) -> OdometrySequence:
    if not (name.isascii() and name.isdigit() and int(name) < 100):
        raise OptionError(f"sequence {name!r}; expected two digits, as 00")
    name = f"{int(name):02d}"
    return OdometrySequence(name, path / "sequences" / name, path / "poses" / f"{name}.txt")


def _poses(
    choice: Choice, timeline: Timeline, rectified_from_lidar: RigidTransform
) -> tuple[str, list[Loss]]:
    """The poses of camera 0's rectified frame, seen from its first one."""
    ego_from_camera = choice.ego_from_lidar @ rectified_from_lidar.inverse()
    egos = egos_at(choice, timeline.timestamps_ns)
    if not egos:
        return "", []
    first_from_world = (egos[0] @ ego_from_camera).inverse()
    lines = [
        " ".join(map(repr, (first_from_world @ ego @ ego_from_camera).matrix[:3].reshape(-1).tolist()))
        for ego in egos
    ]
    path, losses = choice.ego_path, list[Loss]()
    if path is not None and not path.static:
        timestamps = timeline.timestamps_ns
        beyond = int(((timestamps < path.start_ns) | (timestamps > path.stop_ns)).sum())
        if beyond:
            what = "beyond the trajectory: its end poses written"
            losses.append(
                Loss(field="trajectories.positions", what=what, count=beyond, support=Support.APPROXIMATED)
            )
        further = len(np.setdiff1d(path.timestamps_ns, timestamps))
        if further:
            what = "a pose for each frame; those between are left out"
            losses.append(
                Loss(
                    field="trajectories.timestamps_ns", what=what, count=further, support=Support.APPROXIMATED
                )
            )
    if np.abs(egos[0].matrix - np.eye(4)).max() > 1e-9:
        what = "seen from the first pose, which becomes the world's origin; read back, its axes are the lidar's there"
        losses.append(
            Loss(field="trajectories.positions", what=what, count=len(egos), support=Support.CONVERTED)
        )
    return "".join(f"{line}\n" for line in lines), losses


def _write_point_labels(values: UInt32Array, path: Path) -> None:
    """Write SemanticKITTI's labels of a sweep, (N,) uint32."""
    path.write_bytes(values.astype("<u4").tobytes())
