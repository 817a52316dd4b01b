"""A scene as a sequence of KITTI's tracking benchmark."""

from pathlib import Path

from sceneloom.errors import OptionError
from sceneloom.formats.kitti.labels import format_labels
from sceneloom.formats.kitti.spec import TRACKING_CAMERAS
from sceneloom.formats.kitti.written.calibration_text import write_calibration
from sceneloom.formats.kitti.written.choice import choose, dropped_parts
from sceneloom.formats.kitti.written.frames import point_time_loss, write_frames
from sceneloom.formats.kitti.written.label_rows import LabelRows
from sceneloom.formats.kitti.written.locations import egos_at, is_lidar, mounted_of
from sceneloom.formats.kitti.written.oxts_lines import oxts_lines
from sceneloom.formats.kitti.written.target import kept_calibration, kept_of
from sceneloom.formats.kitti.written.timeline import timeline_of
from sceneloom.formats.loss import LossReport
from sceneloom.formats.output import FolderKind, replacing
from sceneloom.formats.recording.written_times import seconds_text
from sceneloom.scene.annotations.boxes_2d import Box2DAnnotation
from sceneloom.scene.annotations.cuboids import CuboidAnnotation
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor
from sceneloom.scene.scene import Scene

HELD = frozenset(
    {LidarSensor, CameraSensor, ImuSensor, GnssSensor, OdometrySensor, CuboidAnnotation, Box2DAnnotation}
)
"""Kinds of sensors and annotations that a sequence has a location for."""

_KIND = FolderKind(
    "folder of KITTI's tracking benchmark",
    (
        r"training/(velodyne|image_\d\d)/(?P<one>\d{4})/\d{6}\.(bin|png|jpe?g)",
        r"training/(calib|label_\d\d|times|oxts)/(?P<one>\d{4})\.txt",
    ),
    r"training/calib/\d{4}\.txt",
)


def write_tracking(
    scene: Scene, path: Path, *, overwrite: bool = False, sequence: str | None = None
) -> LossReport:
    """Write a scene as a sequence in a folder `training`.

    Args:
        scene: to be written.
        path: the folder above `training`.
        overwrite: replace a folder of such sequences as a whole.
        sequence: its name, four digits; None for the one that the scene was read from, else "0000".

    Returns:
        What the folder could not hold.

    Raises:
        OptionError: the name is none.
        OutputError: the path exists, or cannot be written.
        DataError: what the scene is read from is damaged.
    """
    name = sequence or kept_of(scene).get("sequence") or "0000"
    name = name if len(name) == 4 else f"{int(name):04d}" if name.isascii() and name.isdigit() else name
    if not (len(name) == 4 and name.isascii() and name.isdigit()):
        raise OptionError(f"sequence {name!r}; expected four digits, as 0000")
    choice = choose(scene, tuple(TRACKING_CAMERAS), rectified=True, models=frozenset({"pinhole"}))
    losses = [*dropped_parts(scene, HELD), *choice.losses]
    timeline = timeline_of(choice)
    losses += timeline.losses
    with replacing(path, overwrite=overwrite, folder=_KIND) as draft:
        folder = draft / "training"
        for kind in ("calib", "label_02", "times"):
            (folder / kind).mkdir(parents=True)
        images = {number: folder / kind / name for number, kind in TRACKING_CAMERAS.items()}
        losses += write_frames(
            choice,
            timeline,
            "{:06d}".format,
            folder / "velodyne" / name,
            images,
            lambda _, frame: losses.extend(point_time_loss(frame)),
        )
        with_imu = choice.ego_path is not None or not is_lidar(choice)
        mounted = mounted_of(choice, with_imu=with_imu)
        rectified_from_lidar = write_calibration(
            folder / "calib" / f"{name}.txt", "tracking", mounted, kept_calibration(scene)
        )
        seconds = "".join(f"{seconds_text(time)}\n" for time in timeline.timestamps_ns.tolist())
        (folder / "times" / f"{name}.txt").write_text(seconds, "utf-8", newline="\n")
        if choice.ego_path is not None:
            lines = oxts_lines(scene, choice.ego_path, timeline.timestamps_ns)
            losses += lines.losses
            (folder / "oxts").mkdir()
            text = "".join(f"{line}\n" for line in lines.texts())
            (folder / "oxts" / f"{name}.txt").write_text(text, "utf-8", newline="\n")
        egos = egos_at(choice, timeline.timestamps_ns)
        ego_from_rectified = choice.ego_from_lidar @ rectified_from_lidar.inverse()
        rows = LabelRows(
            choice,
            timeline,
            lambda frame: egos[frame] @ ego_from_rectified,
            lambda _, camera: camera.camera,
            with_tracks=True,
        )
        text = "".join(f"{line}\n" for line in format_labels(rows.labels(), path))
        losses += rows.losses
        (folder / "label_02" / f"{name}.txt").write_text(text, "utf-8", newline="\n")
    return LossReport.of(losses)
