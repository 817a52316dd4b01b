"""Writing the sweeps and images of a synchronised folder, frame by frame."""

from collections.abc import Callable, Mapping
from pathlib import Path

from sceneloom.formats.kitti.written.choice import Choice
from sceneloom.formats.kitti.written.files import SweepFiles, check_camera_model, image_losses, write_image
from sceneloom.formats.kitti.written.timeline import NONE, Timeline
from sceneloom.formats.loss import Loss
from sceneloom.scene.clouds import LidarFrame

Name = Callable[[int], str]


def write_frames(
    choice: Choice,
    timeline: Timeline,
    name: Name,
    sweeps: Path,
    images: Mapping[int, Path],
    reported: Callable[[int, LidarFrame], None] | None = None,
    *,
    own_camera_models: bool = False,
) -> list[Loss]:
    """Write the files of all frames; each sweep and image is read, written and let go.

    Args:
        choice: what is written.
        timeline: the frames.
        name: of a frame's files, without suffix.
        sweeps: the folder of sweeps; it is made if there are any.
        images: the folders of images, by number of the camera.
        reported: is given each sweep and its frame's number.
        own_camera_models: whether images may have camera models of their own.

    Returns:
        What was lost.

    Raises:
        CalibrationError: an image has another size than its camera's others.
    """
    writer = SweepFiles(choice)
    losses = [loss for camera in choice.cameras.values() for loss in image_losses(camera)]
    if choice.lidar is not None and len(choice.lidar.frames):
        sweeps.mkdir(parents=True)
    for number, camera in choice.cameras.items():
        if len(camera.images):
            images[number].mkdir(parents=True)
    for k in range(len(timeline)):
        sweep = int(timeline.sweeps[k])
        if choice.lidar is not None and sweep != NONE:
            frame = choice.lidar.frames[sweep]
            writer.write(writer.placed(frame), sweeps / f"{name(k)}.bin")
            if reported is not None:
                reported(k, frame)
        for number, camera in choice.cameras.items():
            row = int(timeline.images[number][k])
            if row != NONE:
                image = camera.images[row]
                if not own_camera_models:
                    check_camera_model(camera, image)
                write_image(image, images[number] / f"{name(k)}.png")
    return [*losses, *writer.losses]


def point_time_loss(frame: LidarFrame) -> list[Loss]:
    """The loss of a sweep's point times, where the target has none."""
    count = len(frame.points) if frame.points.timestamps_ns is not None else 0
    what = "left out: points have no times there"
    return [Loss(field="sensors.lidar.frames.points.timestamps_ns", what=what, count=count)] if count else []
