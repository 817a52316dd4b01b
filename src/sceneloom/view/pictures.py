"""Pictures in the frusta of their cameras, straight where the lens bends."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.undistortion import undistorted_camera
from sceneloom.editing.undistortion import undistort_scene
from sceneloom.errors import CalibrationError
from sceneloom.formats.sfs.write_pictures import encode_jpeg
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations.corrections import CameraCalibration
from sceneloom.scene.cameras import CameraSensor, Picture
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, Key, key_of
from sceneloom.view.clouds import SENSORS, WORLD
from sceneloom.view.feeds import Tell
from sceneloom.view.places import Places, poses_within_reach
from sceneloom.view.poses import pose_at, transform, transform_columns
from sceneloom.view.sdk import sdk
from sceneloom.view.stream import Stream, fits

PICTURE = "picture"
"""The entity of a camera's pictures, below that of the camera; its own space of pixels."""

_QUALITY = 88
_JPEG_START = b"\xff\xd8"
_CORNER = 0.5
"""The viewer counts pixels from the picture's corner, lenses from the centre of the first one."""
_FRUSTUM, _HALF_WIDTH = 2.5, 1.2
"""How far before the camera its picture hangs at most, and half of how wide it is at most [m]."""
_FINEST = 0.7
"""A straightened picture magnifies its middle by this or more, of what one without empty borders would: a lens that
sees very far aside shows less of its border then, and its middle stays sharp."""


def with_straight_lenses(scene: Scene, tell: Tell) -> tuple[Scene, frozenset[Key]]:
    """Give the scene with pinholes for lenses, as the viewer knows no others; what is drawn in pictures follows.

    Returns:
        The scene, and the cameras whose lens no pinhole can stand for: their pictures hang nowhere.
    """
    bent = [camera for camera in scene.cameras if camera.camera.model != "pinhole"]
    # a calibration that gives a camera another lens is shown beside the one at hand, not applied
    calibrations = tuple(one for one in scene.annotations if isinstance(one, CameraCalibration))
    scene = replace(scene, annotations=tuple(one for one in scene.annotations if one not in calibrations))
    kept_bent = set()
    for sensor in bent:
        place = f"sensors[{sensor.id!r}]"
        try:
            keep = _kept_share(sensor.camera)
            scene = replace(undistort_scene(scene, cameras=[sensor.id], keep=keep), notices=scene.notices)
        except CalibrationError as error:
            kept_bent.add(key_of(sensor.id))
            tell("lens-left", place, f"its pictures are shown beside the cloud only: {error}")
        else:
            tell(
                "straightened",
                place,
                f"pictures of its {sensor.camera.model} lens are shown without distortion",
            )
    return replace(scene, annotations=(*scene.annotations, *calibrations)), frozenset(kept_bent)


def _kept_share(camera: Camera) -> float:
    """How much of what is outside a straight picture's valid part is shown: all, unless the middle gets too coarse."""
    valid, whole = (undistorted_camera(camera, keep=keep).fx for keep in (0.0, 1.0))
    if whole >= _FINEST * valid:
        return 1.0
    return (1.0 - _FINEST) * valid / (valid - whole)


def straight_lens(camera: Camera) -> Camera:
    """The pinhole that is shown for a lens.

    Raises:
        CalibrationError: none can stand for it.
    """
    return camera if camera.model == "pinhole" else undistorted_camera(camera, keep=_kept_share(camera))


def pinhole(camera: Camera) -> Any:
    """A lens without distortion as the viewer takes it."""
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


def picture_path(stream: Stream, sensor_id: Identifier) -> str:
    """The entity of its pictures."""
    return f"{camera_path(stream, sensor_id)}/{PICTURE}"


def jpeg_of(picture: Picture) -> bytes:
    """The camera's own JPEG file where there is one, else the picture encoded.

    Raises:
        DataError: the picture cannot be decoded.
    """
    own = None if picture.encoded is None else picture.encoded()
    if own is not None and own.startswith(_JPEG_START):
        return own
    return encode_jpeg(picture.rgb, quality=_QUALITY, subsampling="420")


@dataclass(slots=True, eq=False)
class PlacedCamera:
    """Logs where a camera is, and its lens where that is another one than before."""

    stream: Stream
    places: Places
    sensor: CameraSensor | DepthCameraSensor
    tell: Tell
    has_pinhole: bool = True
    _source: PoseSource = field(init=False)
    _lens: Camera | None = None

    def __post_init__(self) -> None:
        self._source, problem = self.places.source(self.sensor)
        if problem is not None:
            self.tell("not-placed", f"sensors[{self.sensor.id!r}]", problem)

    def log_poses(self, times_ns: Int64Array) -> None:
        """Log the poses at the times of all pictures, (N,) [ns], by the camera's own mounting."""
        poses, rows = poses_within_reach(self._source, times_ns)
        if len(rows) < len(times_ns):
            self.tell(
                "beyond-the-way",
                f"sensors[{self.sensor.id!r}]",
                f"its place is not known at {len(times_ns) - len(rows)} of {len(times_ns)} times",
            )
        path = camera_path(self.stream, self.sensor.id)
        self.stream.columns(times_ns[rows], path, transform_columns(poses, rows))

    def log(self, time_ns: int, lens: Camera, mount: RigidTransform | None) -> None:
        """Log what is the picture's own at a time [ns]: another mounting, another lens."""
        pose = None if mount is None else pose_at(self._source.mounted(mount), time_ns)
        if pose is not None:
            self.stream.log(time_ns, camera_path(self.stream, self.sensor.id), transform(pose))
        if self.has_pinhole and lens != self._lens:
            self._lens = lens
            if not fits(lens.matrix).all():
                self.tell(
                    "lens-left", f"sensors[{self.sensor.id!r}]", "its lens is beyond the viewer's float32"
                )
                return
            self.stream.log(time_ns, picture_path(self.stream, self.sensor.id), pinhole(lens))


@dataclass(frozen=True, slots=True, eq=False)
class ShownPicture:
    """A picture with the JPEG file that is shown."""

    picture: Picture
    content: bytes


@dataclass(frozen=True, slots=True, eq=False)
class CameraView:
    """Shows the pictures of one camera."""

    camera: PlacedCamera
    pictures: LazyFrames[Picture]

    def prepare(self, k: int) -> ShownPicture:
        """Read picture `k`, and encode it where it is no JPEG yet."""
        picture = self.pictures[k]
        return ShownPicture(picture, jpeg_of(picture))

    def log(self, shown: ShownPicture) -> None:
        """Log a picture."""
        stream, picture = self.camera.stream, shown.picture
        self.camera.log(picture.timestamp_ns, picture.camera, picture.mount)
        image = sdk().EncodedImage(contents=shown.content, media_type="image/jpeg")
        path = picture_path(stream, self.camera.sensor.id)
        stream.log(picture.timestamp_ns, path, image, kind="pictures", size=len(shown.content))
