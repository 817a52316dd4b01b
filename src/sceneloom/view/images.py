"""Camera images in their frusta, undistorted where the camera model is not a _pinhole, and depth images."""

import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Float32Array, Int64Array, UInt16Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.undistortion import Undistortion, undistorted_camera
from sceneloom.editing.cameras import undistort_scene
from sceneloom.errors import CalibrationError, DataError
from sceneloom.formats.base.files import check_regular, file_faults, open_file
from sceneloom.formats.base.images import encode_jpeg, open_image
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations import CameraCalibration
from sceneloom.scene.cameras import CameraImage, CameraSensor, DepthCameraSensor, DepthFrame
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import PoseSource
from sceneloom.scene.scene import Scene, frame_times
from sceneloom.scene.types import Identifier, Key, key_of
from sceneloom.view.poses import Locations, pose_at, poses_within_reach, transform, transform_columns
from sceneloom.view.stream import SENSORS, WORLD, Feed, Report, Stream, fits, sdk

IMAGE = "image"
"""The entity of a camera's images, below that of the camera; its own space of pixels."""
_QUALITY = 88
_JPEG_START = b"\xff\xd8"
_CORNER = 0.5  # the viewer counts pixels from the image's corner, camera models from the centre of the first one
_FRUSTUM, _HALF_WIDTH = 2.5, 1.2
"""How far before the camera its image hangs at most, and half of how wide it is at most [m]."""
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


def _pinhole(camera: Camera) -> Any:
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


def _camera_path(stream: Stream, sensor_id: Identifier) -> str:
    """The entity of a camera."""
    return stream.path(WORLD, SENSORS, sensor_id)


def image_path(stream: Stream, sensor_id: Identifier) -> str:
    """The entity of its images."""
    return f"{_camera_path(stream, sensor_id)}/{IMAGE}"


def _jpeg_of(camera_image: CameraImage) -> bytes:
    """The camera's own JPEG file where there is one, else the image encoded."""
    own = None if camera_image.encoded is None else camera_image.encoded()
    if own is not None and own.startswith(_JPEG_START):
        return own
    return encode_jpeg(camera_image.rgb, quality=_QUALITY, subsampling="420")


@dataclass(slots=True, eq=False)
class _PlacedCamera:
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
        path = _camera_path(self.stream, self.sensor.id)
        self.stream.columns(times_ns[rows], path, transform_columns(poses, rows))

    def log(self, time_ns: int, camera_model: Camera, mount: RigidTransform | None) -> None:
        """Log what is the image's own at a time [ns]: another mounting, another camera model."""
        pose = None if mount is None else pose_at(self._source.mounted(mount), time_ns)
        if pose is not None:
            self.stream.log(time_ns, _camera_path(self.stream, self.sensor.id), transform(pose))
        if self.has_pinhole and camera_model != self._camera_model:
            self._camera_model = camera_model
            if not fits(camera_model.matrix).all():
                self.notify(
                    "camera-model-left",
                    f"sensors[{self.sensor.id!r}]",
                    "its camera model is beyond the viewer's float32",
                )
                return
            self.stream.log(time_ns, image_path(self.stream, self.sensor.id), _pinhole(camera_model))


@dataclass(frozen=True, slots=True, eq=False)
class _ShownImage:
    """An image with the JPEG file that is shown."""

    image: CameraImage
    content: bytes


@dataclass(frozen=True, slots=True, eq=False)
class _CameraView:
    """Shows the images of one camera."""

    camera: _PlacedCamera
    images: LazyFrames[CameraImage]

    def prepare(self, k: int) -> _ShownImage:
        """Read image `k`, and encode it where it is no JPEG yet."""
        camera_image = self.images[k]
        return _ShownImage(camera_image, _jpeg_of(camera_image))

    def log(self, k: int, prepared: _ShownImage | None) -> None:
        """Log image `k`."""
        shown = self.prepare(k) if prepared is None else prepared
        stream, camera_image = self.camera.stream, shown.image
        self.camera.log(camera_image.timestamp_ns, camera_image.camera, camera_image.mount)
        image = sdk().EncodedImage(contents=shown.content, media_type="image/jpeg")
        path = image_path(stream, self.camera.sensor.id)
        stream.log(camera_image.timestamp_ns, path, image, kind="images", size=len(shown.content))


STEPS_PER_METRE = 256  # shown depths are whole steps of 1/256 m, as in KITTI's depth images: 4 mm, up to 256 m
_LARGEST = 65535
DEPTH = "depth"
"""The entity of fused depth images, below that of the images that they belong to."""


def _depth_image(depths: Float32Array) -> Any:
    """An image of depths (H, W) [m], 0 for none, as the viewer takes it."""
    steps: UInt16Array = np.clip(np.rint(np.nan_to_num(depths) * STEPS_PER_METRE), 0, _LARGEST).astype(np.uint16)
    rr = sdk()
    near = steps[steps > 0]
    farthest = float(np.percentile(near, 98)) if len(near) else _LARGEST
    return rr.DepthImage(steps, meter=STEPS_PER_METRE, depth_range=[0, farthest], colormap="turbo")


@dataclass(slots=True, eq=False)
class _Straightener:
    """Resamples depth images to a pinhole by the nearest pixel: no depth between two others is made up."""

    known: Undistortion | None = None

    def straight(self, camera: Camera, depths: Float32Array) -> tuple[Camera, Float32Array]:
        """Give the camera model that is shown, and the depths as it sees them."""
        if camera.model == "pinhole":
            return camera, depths
        if self.known is None or self.known.source != camera:
            self.known = Undistortion.between(camera, undistorted_camera(camera))
        locations = np.nan_to_num(self.known.locations, nan=-1.0)
        columns, rows = (np.rint(locations[..., axis]).astype(np.int64) for axis in (0, 1))
        inside = self.known.seen
        limits = np.clip(rows, 0, camera.height - 1), np.clip(columns, 0, camera.width - 1)
        return self.known.target, np.where(inside, depths[limits], np.float32(0.0))


@dataclass(frozen=True, slots=True, eq=False)
class _DepthView:
    """Shows the images of one depth camera."""

    camera: _PlacedCamera
    frames: Any
    straightener: _Straightener

    def log(self, k: int, _: None) -> None:
        """Log image `k`."""
        frame: DepthFrame = self.frames[k]
        stream = self.camera.stream
        camera_model, depths = self.straightener.straight(frame.camera, frame.depth)
        self.camera.log(frame.timestamp_ns, camera_model, frame.mount)
        path = image_path(stream, self.camera.sensor.id)
        stream.log(frame.timestamp_ns, path, _depth_image(depths), kind="depth images", size=2 * depths.size)


def camera_feed(
    stream: Stream,
    locations: Locations,
    sensor: CameraSensor | DepthCameraSensor,
    notify: Report,
    *,
    every: int,
    has_pinhole: bool,
    ahead: bool,
) -> Feed | None:
    """Place a camera, and show its images; None where no pinhole can stand for the camera model of a depth camera.

    Args:
        every: of so many images one is placed.
        has_pinhole: whether its images hang somewhere.
        ahead: whether images are prepared while others are logged.
    """
    times_ns = frame_times(sensor)
    placed = _PlacedCamera(stream, locations, sensor, notify, has_pinhole=has_pinhole)
    placed.log_poses(np.unique(times_ns[::every]))
    if isinstance(sensor, CameraSensor):
        shown = _CameraView(placed, sensor.images)
        return Feed(times_ns, shown.log, shown.prepare if ahead else None)
    if sensor.camera.model != "pinhole":
        try:
            undistorted_camera(sensor.camera)
        except CalibrationError as error:
            notify("camera-model-left", f"sensors[{sensor.id!r}]", f"its depth images are not shown: {error}")
            return None
    return Feed(times_ns, _DepthView(placed, sensor.frames, _Straightener()).log)


class _Entry(msgspec.Struct, frozen=True):
    """A line of the index that a folder of depth images has."""

    file: str
    sweep_ns: int
    camera: Identifier
    image_ns: int


def _written_depths(folder: Path) -> Iterator[_Entry]:
    """The images of a folder that `fuse --depth` or `depth` wrote, by its index."""
    index = folder / "index.jsonl"
    if not index.is_file():
        raise DataError(index, "", "is missing; expected the folder that `fuse --depth` or `depth` wrote")
    with file_faults(index), open_file(index) as lines:
        for number, line in enumerate(lines, start=1):
            try:
                yield msgspec.json.decode(line, type=_Entry)
            except (msgspec.DecodeError, UnicodeError, RecursionError) as error:
                raise DataError(index, f"line {number}", f"{error}; expected a depth image") from error


@dataclass(frozen=True, slots=True, eq=False)
class _FusedDepthView:
    """Shows depth images of a folder over the images that they belong to."""

    # they are in the camera's own, distorted grid; a straightened camera takes them straightened the same way

    stream: Stream
    folder: Path
    entries: tuple[_Entry, ...]
    maps: dict[Identifier, Undistortion | None]

    def log(self, k: int, _: None) -> None:
        """Log image `k`."""
        entry = self.entries[k]
        depths = _read(self.folder / entry.file)
        undistortion = self.maps.get(entry.camera)
        if undistortion is not None:
            depths = _Straightener(undistortion).straight(undistortion.source, depths)[1]
        path = f"{image_path(self.stream, entry.camera)}/{DEPTH}"
        self.stream.log(entry.image_ns, path, _depth_image(depths), kind="fused depth images", size=2 * depths.size)


def fused_depth_feed(stream: Stream, folder: Path, measured: Scene, shown: Scene) -> Feed:
    """Show a folder of depth images.

    Args:
        measured: the scene with its own camera models, in whose grids the images are.
        shown: the scene with the camera models that are shown.

    Raises:
        DataError: the index is missing or faulty.
    """
    camera_models = {camera.id: camera.camera for camera in measured.cameras}
    ends = {camera.id: camera.camera for camera in shown.cameras}
    maps = {
        camera_id: Undistortion.between(camera_model, ends[camera_id])
        if camera_model != ends[camera_id] and camera_model.model != "pinhole"
        else None
        for camera_id, camera_model in camera_models.items()
    }
    entries = sorted((e for e in _written_depths(folder) if e.camera in camera_models), key=lambda e: e.image_ns)
    times_ns = np.array([entry.image_ns for entry in entries], np.int64)
    return Feed(times_ns, _FusedDepthView(stream, folder, tuple(entries), maps).log)


def _read(path: Path) -> Float32Array:
    with file_faults(path):
        try:
            if path.suffix == ".npz":
                check_regular(path)
                with np.load(path) as arrays:
                    return np.asarray(arrays["depth"], np.float32)
            with open_image(path, ("PNG",)) as image:
                if not image.mode.startswith("I"):
                    raise DataError(path, "", f"an image of mode {image.mode}; expected depths of 16 bits a pixel")
                return np.asarray(image, np.float32) / np.float32(STEPS_PER_METRE)
        except (OSError, ValueError, KeyError, EOFError, SyntaxError, zipfile.BadZipFile, zlib.error) as error:
            raise DataError(path, "", f"cannot be read as a depth image: {error}") from error


def show_calibration(stream: Stream, annotation: CameraCalibration, notify: Report) -> None:
    """The camera' = camera D(t), with the other camera model if one is stated."""
    entity = f"{_camera_path(stream, annotation.sensor_id)}/calibrated"
    if annotation.poses is not None:
        poses = annotation.poses.held(annotation.poses.timestamps_ns)
        if annotation.poses.static:
            rotation = sdk().Quaternion(xyzw=poses.quaternions_xyzw[0])
            stream.static(entity, sdk().Transform3D(translation=poses.positions[0], quaternion=rotation))
        else:
            held = fits(poses.positions)
            stream.leave_out("poses of calibrations", np.count_nonzero(~held))
            rows = np.flatnonzero(held)
            stream.columns(annotation.poses.timestamps_ns[rows], entity, transform_columns(poses, rows))
    if annotation.intrinsics is not None:
        try:
            camera = annotation.intrinsics
            if camera.model != "pinhole":
                camera = undistorted_camera(camera, keep=_kept_share(camera))
            stream.static(f"{entity}/camera model", _pinhole(camera))
        except CalibrationError as error:
            notify("camera-model-left", f"annotations[{annotation.id!r}]", f"its camera model is not drawn: {error}")
    stream.static(entity, sdk().TransformAxes3D(0.5))
    stream.count("camera calibrations", 1)
