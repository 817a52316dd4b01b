"""A scene as a sequence of KITTI's odometry benchmark, with SemanticKITTI's labels where it has labelled points."""

from pathlib import Path

import numpy as np

from sceneloom.arrays import finite_rows
from sceneloom.errors import OptionError
from sceneloom.formats.kitti.odometry.written_labels import PointLabels
from sceneloom.formats.kitti.spec import ODOMETRY_CAMERAS, OdometrySequence
from sceneloom.formats.kitti.written.calibration_text import write_calibration
from sceneloom.formats.kitti.written.choice import Choice, choose, dropped_parts
from sceneloom.formats.kitti.written.files import write_point_labels
from sceneloom.formats.kitti.written.frames import point_time_loss, write_frames
from sceneloom.formats.kitti.written.locations import egos_at, mounted_of
from sceneloom.formats.kitti.written.target import kept_calibration, kept_of
from sceneloom.formats.kitti.written.timeline import Timeline, check_files, timeline_of
from sceneloom.formats.loss import Loss, LossReport, Support
from sceneloom.formats.output import FolderKind, replacing
from sceneloom.formats.recording.written_times import seconds_text
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations.labelled_points import LabeledPointsAnnotation
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.motion import OdometrySensor
from sceneloom.scene.scene import Scene

SLOTS = (2, 3, 0, 1)
"""Numbers of cameras, those of the coloured ones first."""

HELD = frozenset({LidarSensor, CameraSensor, OdometrySensor, LabeledPointsAnnotation})
"""Kinds of sensors and annotations that a sequence has a location for."""

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
    choice = choose(scene, SLOTS, rectified=True, models=frozenset({"pinhole"}))
    losses = [*dropped_parts(scene, HELD), *choice.losses]
    check_files(choice, labels=False)
    timeline = timeline_of(choice)
    losses += timeline.losses
    labels = PointLabels.of(scene, choice.lidar)
    losses += labels.losses
    with replacing(path, overwrite=overwrite, folder=_KIND) as draft:
        folder = draft / "sequences" / location.name
        folder.mkdir(parents=True)

        def reported(k: int, frame: LidarFrame) -> None:
            losses.extend(point_time_loss(frame))
            if labels:
                values = labels.values(int(timeline.sweeps[k]), len(frame.points))
                written = finite_rows(frame.points.positions)
                write_point_labels(values[written], folder / "labels" / f"{k:06d}.label")

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
