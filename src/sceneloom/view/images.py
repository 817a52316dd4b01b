"""Images in the frusta of their cameras, straight where the camera model bends."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.undistortion import undistorted_camera
from sceneloom.editing.undistortion import undistort_scene
from sceneloom.errors import CalibrationError
from sceneloom.formats.sfs.write_images import encode_jpeg
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations.corrections import CameraCalibration
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, Key, key_of
from sceneloom.view.clouds import SENSORS, WORLD
from sceneloom.view.feeds import Report
from sceneloom.view.locations import Locations, poses_within_reach
from sceneloom.view.poses import pose_at, transform, transform_columns
from sceneloom.view.sdk import sdk
from sceneloom.view.stream import Stream, fits

IMAGE = "camera_image"
"""The entity of a camera's images, below that of the camera; its own space of pixels."""

_QUALITY = 88
_JPEG_START = b"\xff\xd8"
_CORNER = 0.5
"""The viewer counts pixels from the image's corner, camera models from the centre of the first one."""
_FRUSTUM, _HALF_WIDTH = 2.5, 1.2
"""How far before the camera its camera_image hangs at most, and half of how wide it is at most [m]."""
_FINEST = 0.7
"""A straightened image magnifies its middle by this or more, of what one without empty borders would.

A camera model that
sees very far aside shows less of its border then, and its middle stays sharp."""


def with_straight_camera_models(scene: Scene, notify: Report) -> tuple[Scene, frozenset[Key]]:
    """Give the scene with pinholes for camera models, as the viewer knows no others; what is drawn in images follows.

    Returns:
        The scene, and the cameras whose camera model no pinhole can stand for: their images hang nowhere.
    """
    bent = [camera for camera in scene.cameras if camera.camera.model != "pinhole"]
    # a calibration that gives a camera another camera model is shown beside the one at hand, not applied
    calibrations = tuple(one for one in scene.annotations if isinstance(one, CameraCalibration))
    scene = replace(scene, annotations=tuple(one for one in scene.annotations if one not in calibrations))
    kept_bent = set()
    for sensor in bent:
        location = f"sensors[{sensor.id!r}]"
        try:
            keep = _kept_share(sensor.camera)
            scene = replace(undistort_scene(scene, cameras=[sensor.id], keep=keep), warnings=scene.warnings)
        except CalibrationError as error:
            kept_bent.add(key_of(sensor.id))
            notify("camera-model-left", location, f"its images are shown beside the cloud only: {error}")
        else:
            notify(
                "straightened",
                location,
                f"images of its {sensor.camera.model} camera model are shown without distortion",
            )
    return replace(scene, annotations=(*scene.annotations, *calibrations)), frozenset(kept_bent)


def _kept_share(camera: Camera) -> float:
    """How much of what is outside a straight image's valid part is shown: all, unless the middle gets too coarse."""
    valid, whole = (undistorted_camera(camera, keep=keep).fx for keep in (0.0, 1.0))
    if whole >= _FINEST * valid:
        return 1.0
    return (1.0 - _FINEST) * valid / (valid - whole)


def straight_camera_model(camera: Camera) -> Camera:
    """The pinhole that is shown for a camera model.

    Raises:
        CalibrationError: none can stand for it.
    """
    return camera if camera.model == "pinhole" else undistorted_camera(camera, keep=_kept_share(camera))


def pinhole(camera: Camera) -> Any:
    """A camera model without distortion as the viewer takes it."""
    matrix = np.array(camera.matrix)
    matrix[:2, 2] += _CORNER
    rr = sdk()
    return rr.Pinhole(
        image_from_camera=matrix,
        resolution=[camera.width, camera.height],
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=min(_FRUSTUM, _HALF_WIDTH * 2 * camera.fx / camera.width),
    )


def camera_path(stream: Stream, sensor_id: Identifier) -> str:
    """The entity of a camera."""
    return stream.path(WORLD, SENSORS, sensor_id)


def image_path(stream: Stream, sensor_id: Identifier) -> str:
    """The entity of its images."""
    return f"{camera_path(stream, sensor_id)}/{IMAGE}"


def jpeg_of(camera_image: CameraImage) -> bytes:
    """The camera's own JPEG file where there is one, else the image encoded.

    Raises:
        DataError: the image cannot be decoded.
    """
    own = None if camera_image.encoded is None else camera_image.encoded()
    if own is not None and own.startswith(_JPEG_START):
        return own
    return encode_jpeg(camera_image.rgb, quality=_QUALITY, subsampling="420")


@dataclass(slots=True, eq=False)
class PlacedCamera:
    """Logs where a camera is, and its camera model where that is another one than before."""

    stream: Stream
    locations: Locations
    sensor: CameraSensor | DepthCameraSensor
    notify: Report
    has_pinhole: bool = True
    _source: PoseSource = field(init=False)
    _camera_model: Camera | None = None

    def __post_init__(self) -> None:
        self._source, problem = self.locations.source(self.sensor)
        if problem is not None:
            self.notify("not-placed", f"sensors[{self.sensor.id!r}]", problem)

    def log_poses(self, times_ns: Int64Array) -> None:
        """Log the poses at the times of all images, (N,) [ns], by the camera's own mounting."""
        poses, rows = poses_within_reach(self._source, times_ns)
        if len(rows) < len(times_ns):
            self.notify(
                "beyond-the-trajectory",
                f"sensors[{self.sensor.id!r}]",
                f"its location is not known at {len(times_ns) - len(rows)} of {len(times_ns)} times",
            )
        path = camera_path(self.stream, self.sensor.id)
        self.stream.columns(times_ns[rows], path, transform_columns(poses, rows))

    def log(self, time_ns: int, camera_model: Camera, mount: RigidTransform | None) -> None:
        """Log what is the image's own at a time [ns]: another mounting, another camera model."""
        pose = None if mount is None else pose_at(self._source.mounted(mount), time_ns)
        if pose is not None:
            self.stream.log(time_ns, camera_path(self.stream, self.sensor.id), transform(pose))
        if self.has_pinhole and camera_model != self._camera_model:
            self._camera_model = camera_model
            if not fits(camera_model.matrix).all():
                self.notify(
                    "camera-model-left",
                    f"sensors[{self.sensor.id!r}]",
                    "its camera model is beyond the viewer's float32",
                )
                return
            self.stream.log(time_ns, image_path(self.stream, self.sensor.id), pinhole(camera_model))


@dataclass(frozen=True, slots=True, eq=False)
class ShownImage:
    """An image with the JPEG file that is shown."""

    image: CameraImage
    content: bytes


@dataclass(frozen=True, slots=True, eq=False)
class CameraView:
    """Shows the images of one camera."""

    camera: PlacedCamera
    images: LazyFrames[CameraImage]

    def prepare(self, k: int) -> ShownImage:
        """Read image `k`, and encode it where it is no JPEG yet."""
        camera_image = self.images[k]
        return ShownImage(camera_image, jpeg_of(camera_image))

    def log(self, shown: ShownImage) -> None:
        """Log an image."""
        stream, camera_image = self.camera.stream, shown.image
        self.camera.log(camera_image.timestamp_ns, camera_image.camera, camera_image.mount)
        image = sdk().EncodedImage(contents=shown.content, media_type="image/jpeg")
        path = image_path(stream, self.camera.sensor.id)
        stream.log(camera_image.timestamp_ns, path, image, kind="images", size=len(shown.content))
