"""A scene as frames of KITTI's object benchmark: each with a calibration of its own, and without a common world."""

from pathlib import Path

from sceneloom.cameras.camera import Camera
from sceneloom.formats.kitti.labels import write_object_labels
from sceneloom.formats.kitti.object.reading import FRAME_NS
from sceneloom.formats.kitti.spec import OBJECT_CAMERAS
from sceneloom.formats.kitti.written.calibration_text import Mounted, write_calibration
from sceneloom.formats.kitti.written.choice import Choice, choose, dropped_parts
from sceneloom.formats.kitti.written.frames import point_time_loss, write_frames
from sceneloom.formats.kitti.written.label_rows import LabelRows
from sceneloom.formats.kitti.written.locations import egos_at, is_lidar
from sceneloom.formats.kitti.written.target import kept_of
from sceneloom.formats.kitti.written.timeline import NONE, Timeline, check_files, timeline_of
from sceneloom.formats.loss import Loss, LossReport, Support
from sceneloom.formats.output import FolderKind, replacing
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations.boxes_2d import Box2DAnnotation
from sceneloom.scene.annotations.cuboids import CuboidAnnotation
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.scene import Scene

HELD = frozenset({LidarSensor, CameraSensor, CuboidAnnotation, Box2DAnnotation})
"""Kinds of sensors and annotations that frames have a location for."""

_KIND = FolderKind(
    "folder of KITTI's object benchmark",
    (
        r"training/velodyne/\d{6}\.bin",
        r"training/(calib|label_2)/\d{6}\.txt",
        r"training/image_\d/\d{6}\.(png|jpe?g)",
    ),
    r"training/calib/\d{6}\.txt",
)


def write_object(scene: Scene, path: Path, *, overwrite: bool = False) -> LossReport:
    """Write a scene as frames in a folder `training`.

    Args:
        scene: to be written.
        path: the folder above `training`.
        overwrite: replace a folder of such frames as a whole.

    Returns:
        What the folder could not hold.

    Raises:
        OutputError: the path exists, or cannot be written.
        DataError: what the scene is read from is damaged.
    """
    choice = choose(scene, tuple(OBJECT_CAMERAS), rectified=True, models=frozenset({"pinhole"}), rigid=False)
    losses = [*dropped_parts(scene, HELD), *choice.losses]
    check_files(choice, labels=True)
    timeline = timeline_of(choice, one_time=False)
    numbers = _numbers(scene, timeline)
    losses += [*timeline.losses, *_time_losses(scene, choice, timeline)]
    with replacing(path, overwrite=overwrite, folder=_KIND) as draft:
        folder = draft / "training"
        (folder / "calib").mkdir(parents=True)
        images = {number: folder / kind for number, kind in OBJECT_CAMERAS.items()}
        losses += write_frames(
            choice,
            timeline,
            lambda k: f"{numbers[k]:06d}",
            folder / "velodyne",
            images,
            lambda _, frame: losses.extend(point_time_loss(frame)),
            own_camera_models=True,
        )
        locations = _FrameLocations(choice, timeline)
        rectified = [
            write_calibration(
                folder / "calib" / f"{numbers[k]:06d}.txt",
                "object",
                locations.mounted(k),
                _kept(scene, numbers[k]),
            )
            for k in range(len(timeline))
        ]
        losses += _write_labels(choice, timeline, numbers, locations, rectified, folder / "label_2")
    return LossReport.of(losses)


def _numbers(scene: Scene, timeline: Timeline) -> list[int]:
    """The numbers of frames: those that a scene of such frames had, else from 0 on."""
    kept = kept_of(scene).get("numbers")
    rows = [divmod(time, FRAME_NS) for time in timeline.timestamps_ns.tolist()]
    if isinstance(kept, list) and all(rest == 0 and 0 <= row < len(kept) for row, rest in rows):
        return [int(kept[row]) for row, _ in rows]
    return list(range(len(timeline)))


def _time_losses(scene: Scene, choice: Choice, timeline: Timeline) -> list[Loss]:
    """Frames have neither times nor a trajectory: what of both a scene has is lost."""
    if kept_of(scene).get("benchmark") == "object":
        return []
    losses = [
        Loss(field=name, what="left out: frames have numbers and no times", count=count)
        for name, count in (
            ("sensors.lidar.frames.timestamp_ns", int((timeline.sweeps != NONE).sum())),
            (
                "sensors.camera.images.timestamp_ns",
                sum(int((p != NONE).sum()) for p in timeline.images.values()),
            ),
        )
        if count
    ]
    if choice.ego_path is not None:
        what = "left out: every frame's world is its own lidar's frame"
        losses.append(Loss(field="trajectories", what=what))
    return losses


def _kept(scene: Scene, number: int) -> dict[str, list[float]] | None:
    """The entries of the calibration that a frame was read with."""
    kept = kept_of(scene)
    reported = kept.get("calibration")
    if kept.get("benchmark") != "object" or not isinstance(reported, dict):
        return None
    row = reported.get("frames", {}).get(str(number))
    different = reported.get("different", [])
    return different[row] if isinstance(row, int) and 0 <= row < len(different) else None


class _FrameLocations:
    """Where the cameras are in each frame, and with which camera models: images may have their own."""

    def __init__(self, choice: Choice, timeline: Timeline) -> None:
        self._choice, self._timeline = choice, timeline

    def image(self, number: int, k: int) -> CameraImage | None:
        """The image of a camera in a frame."""
        row = int(self._timeline.images[number][k])
        return None if row == NONE else self._choice.cameras[number].images[row]

    def camera_model(self, number: int, k: int) -> Camera:
        """The camera model of a frame's image; the camera's own, where it has none or another kind."""
        own, image = self._choice.cameras[number].camera, self.image(number, k)
        return image.camera if image is not None and image.camera.model == "pinhole" else own

    def mounted(self, k: int) -> Mounted:
        """How the sensors lie in a frame."""
        choice = self._choice
        camera_models, mounts = {}, {}
        for number, mount in choice.ego_from_camera.items():
            image = self.image(number, k)
            ego_from_camera = mount if image is None or image.mount is None else image.mount
            camera_models[number] = self.camera_model(number, k)
            mounts[number] = ego_from_camera.inverse() @ choice.ego_from_lidar
        lidar_from_imu = None if is_lidar(choice) else choice.ego_from_lidar.inverse()
        return Mounted(camera_models, mounts, lidar_from_imu, choice.reference, choice.lidar is not None)


def _write_labels(
    choice: Choice,
    timeline: Timeline,
    numbers: list[int],
    locations: _FrameLocations,
    rectified_from_lidar: list[RigidTransform],
    folder: Path,
) -> list[Loss]:
    egos = egos_at(choice, timeline.timestamps_ns)
    world_from_rectified = [
        ego @ choice.ego_from_lidar @ rectified.inverse()
        for ego, rectified in zip(egos, rectified_from_lidar, strict=True)
    ]
    rows = LabelRows(
        choice,
        timeline,
        world_from_rectified.__getitem__,
        lambda k, _: locations.camera_model(choice.reference or 0, k),
        with_tracks=False,
    )
    labels = rows.labels()
    write_object_labels(labels.with_frames(numbers), folder, frames=numbers)
    tracked = sum(
        isinstance(a, CuboidAnnotation) and len(a.path.timestamps_ns) > 1 for a in choice.scene.annotations
    )
    what = "frames know nothing of each other: an object is another one in each"
    lost = (
        [Loss(field="annotations.cuboid.id", what=what, count=tracked, support=Support.DROPPED)]
        if tracked
        else []
    )
    return [*rows.losses, *lost]
