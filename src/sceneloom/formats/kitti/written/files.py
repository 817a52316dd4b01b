"""Images and sweeps as KITTI's files: PNG, and four float32 a point."""

import shutil
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from sceneloom.arrays import Float32Array, UInt32Array, finite_rows
from sceneloom.editing.chosen_points import chosen_points
from sceneloom.editing.sensor_frames import points_change
from sceneloom.errors import CalibrationError, PoseError
from sceneloom.formats.kitti.written.choice import Choice
from sceneloom.formats.loss import Loss, Support
from sceneloom.formats.rig.images import ImageFile
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.types import PointsFrame

_COMPRESSION = 1
"""PNG's quickest: images of drives hardly shrink further, and it takes a third of the time."""


def write_image(image: CameraImage, path: Path) -> None:
    """Write an image as PNG; one that is such a file is copied, and a grey one written as grey.

    Raises:
        DataError: it cannot be decoded.
    """
    source = image.decode
    if isinstance(source, ImageFile) and source.path.suffix.lower() == ".png":
        shutil.copyfile(source.path, path)
        return
    from PIL import Image

    rgb = image.rgb
    is_grey = bool((rgb[..., 0] == rgb[..., 1]).all() and (rgb[..., 1] == rgb[..., 2]).all())
    Image.fromarray(np.ascontiguousarray(rgb[..., 0]) if is_grey else rgb).save(
        path, "PNG", compress_level=_COMPRESSION
    )


def check_camera_model(camera: CameraSensor, image: CameraImage) -> None:
    """Refuse an image of another size than its camera's: a folder with one calibration has one camera model for all.

    Raises:
        CalibrationError: it has another size.
    """
    own, other = camera.camera, image.camera
    if (own.width, own.height) != (other.width, other.height):
        raise CalibrationError(
            f"camera {camera.id!r}: its image at {image.timestamp_ns} ns is {other.width}x{other.height}, others "
            f"are {own.width}x{own.height}; expected one size for all: frames of KITTI's object benchmark "
            "have a camera model each (`--to kitti-object`)"
        )


def image_losses(camera: CameraSensor) -> list[Loss]:
    """What is known to be lost of a camera's images."""
    if camera.video is not None:
        what = f"{camera.id!r}: {camera.video.codec} decoded; each image is a PNG of the decoded pixels"
        return [Loss(field="sensors.camera.video", what=what, support=Support.CONVERTED)]
    return []


@dataclass(slots=True)
class SweepFiles:
    """Writes the sweeps of the lidar, each when it is asked for.

    Attributes:
        choice: what is written.
        losses: what was lost so far.
    """

    choice: Choice
    losses: list[Loss] = field(default_factory=list)

    def placed(self, frame: LidarFrame) -> LidarFrame:
        """The sweep without the points that have no location, which files of bare numbers cannot state."""
        there = finite_rows(frame.points.positions)
        if there.all():
            return frame
        self._lose("positions", "points whose location is not finite are left out", int((~there).sum()))
        return replace(frame, points=chosen_points(frame.points, np.flatnonzero(there)))

    def write(self, frame: LidarFrame, path: Path) -> Float32Array:
        """Write a sweep in the lidar's own frame; gives its positions there, (N, 3) float32 [m].

        Raises:
            PoseError: the points are elsewhere, and it is not known where the lidar was.
        """
        lidar = self.choice.lidar
        points = np.zeros((len(frame.points), 4), "<f4")
        positions = frame.points.positions if lidar is None else self._in_sensor_frame(lidar, frame)
        points[:, :3] = positions
        intensities = frame.points.intensities
        if intensities is None:
            what = "0 written: the source has none"
            self._lose("intensities", what, len(points), Support.APPROXIMATED)
        else:
            points[:, 3] = intensities.astype(np.float32) / 255
        for name in ("colors", "rings", "camera_index"):
            if getattr(frame.points, name) is not None:
                self._lose(name, "left out: a point has x, y, z and reflectance", len(points))
        if frame.points.extras:
            self._lose("extras", "left out: a point has x, y, z and reflectance", len(points))
        path.write_bytes(points.tobytes())
        return positions

    def _in_sensor_frame(self, lidar: LidarSensor, frame: LidarFrame) -> Float32Array:
        if lidar.points_frame is PointsFrame.SENSOR:
            return frame.points.positions
        path = self.choice.ego_path
        ego = None if path is None else EgoMotion("ego", path)
        timestamps = lidar.frames.timestamps_ns
        reach = int(np.median(np.diff(timestamps))) if len(timestamps) > 1 else 0
        change = points_change(self.choice.scene, lidar, ego, PointsFrame.SENSOR, reach_ns=reach)
        if change is None:
            return frame.points.positions
        times = frame.points.timestamps_ns
        if times is None:
            times = np.full(len(frame.points), frame.timestamp_ns, np.int64)
        moved = (
            change.locations(times, frame.points.positions[:, None])[:, 0]
            if len(times)
            else frame.points.positions
        )
        if not np.isfinite(moved).all():
            raise PoseError(
                f"lidar {lidar.id!r}: sweep at {frame.timestamp_ns} ns: no pose for some of its points, which have to "
                "be brought into the lidar's own frame"
            )
        what = f"brought from the {lidar.points_frame} frame into the lidar's own, in float32"
        self._lose("positions", what, len(times), Support.CONVERTED)
        return moved.astype(np.float32)

    def _lose(self, name: str, what: str, count: int, support: Support = Support.DROPPED) -> None:
        self.losses.append(
            Loss(field=f"sensors.lidar.frames.points.{name}", what=what, count=count, support=support)
        )


def write_point_labels(values: UInt32Array, path: Path) -> None:
    """Write SemanticKITTI's labels of a sweep, (N,) uint32."""
    path.write_bytes(values.astype("<u4").tobytes())
