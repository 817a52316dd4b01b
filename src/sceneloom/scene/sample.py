"""One synchronised set: a sweep, the images and other frames that belong to it, and where everything was."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import cached_property, partial
from typing import Any, Generic, TypeVar

import numpy as np

from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError, OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraImage
from sceneloom.scene.clouds import LidarFrame, RadarFrame
from sceneloom.scene.depth import DepthFrame
from sceneloom.scene.sample_boxes import Boxes
from sceneloom.scene.sample_positions import SamplePoses
from sceneloom.scene.types import Identifier

Value = TypeVar("Value")
Image = TypeVar("Image", CameraImage, DepthFrame)


class Once(Generic[Value]):
    """Works something out when it is first called, and then keeps it; pickled, it is what was worked out."""

    def __init__(self, work_out: Callable[[], Value]) -> None:
        """Take the work."""
        self._work_out = work_out

    def __call__(self) -> Value:
        """Give the result."""
        return self._result

    @cached_property
    def _result(self) -> Value:
        return self._work_out()

    def __reduce__(self) -> tuple[Any, ...]:
        return _finished, (self(),)


def _finished(result: Value) -> Once[Value]:
    return Once(partial(_itself, result))


def _itself(result: Value) -> Value:
    return result


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """What several sensors measured about one moment.

    Every sensor that was asked for is a key of the mappings. Where it has no frame near enough, or its pose is not
    known, the value is None, and `missing` or `unposed` says why. Images are decoded when their `rgb` is asked for,
    depth images when their `depth` is. A sample that is pickled takes pixels, poses and boxes along, so that whoever
    gets it needs no file.

    Attributes:
        index: number of the reference sensor's frame.
        timestamp_ns: the moment [ns]: the sweep's reference time (median of its point times), or that of the image.
        reference_id: the sensor that gives the moment.
        lidar_id: the lidar of `sweep`; None without any.
        sweeps: by id of the lidar.
        images: by id of the camera.
        radar_frames: by id of the radar.
        depth_frames: by id of the depth camera.
        cameras: the camera model by id of the camera or depth camera: that of the image or depth image, where there is
            one.
        times_ns: time of each frame that is there, by id [ns]; of sweeps their reference time.
        missing: why a frame is not there, by id.
        find_poses: works out where the sensors were.
        find_boxes: works out the boxes as a sensor sees them at the time of its frame, by id.
    """

    index: int
    timestamp_ns: int
    reference_id: Identifier
    lidar_id: Identifier | None
    sweeps: Mapping[Identifier, LidarFrame | None]
    images: Mapping[Identifier, CameraImage | None]
    radar_frames: Mapping[Identifier, RadarFrame | None]
    depth_frames: Mapping[Identifier, DepthFrame | None]
    cameras: Mapping[Identifier, Camera]
    times_ns: Mapping[Identifier, int]
    missing: Mapping[Identifier, str]
    find_poses: Callable[[], SamplePoses]
    find_boxes: Mapping[Identifier, Callable[[], Boxes]]

    @property
    def sweep(self) -> LidarFrame | None:
        """The reference lidar's sweep; with a camera as reference, the nearest one of the first lidar."""
        return None if self.lidar_id is None else self.sweeps[self.lidar_id]

    @property
    def boxes(self) -> Boxes:
        """The scene's boxes at the sample's moment as the reference sensor sees them, interpolated when asked for.

        A box whose activations name that sensor is there only while it is active for it, by its own computed cuboids.

        Raises:
            OptionError: unit or order of their angles is none of those known.
        """
        return self.boxes_for(self.reference_id)

    def boxes_for(self, sensor_id: Identifier) -> Boxes:
        """Give the boxes as another sensor of the sample sees them, at the time of its own frame.

        Raises:
            OptionError: the sensor has no frame in this sample, or as of `boxes`.
        """
        if sensor_id not in self.find_boxes:
            known = ", ".join(map(repr, self.find_boxes))
            raise OptionError(f"sensor {sensor_id!r} has no frame in this sample; it has frames of {known}")
        return self.find_boxes[sensor_id]()

    @property
    def poses(self) -> SamplePoses:
        """Where the sensors were, each at the time of its frame; interpolated when first asked for."""
        return self.find_poses()

    @property
    def unposed(self) -> Mapping[Identifier, str]:
        """Why the pose of a sensor in the world is not known, by id."""
        return self.poses.unposed

    @property
    def time_differences_ns(self) -> dict[Identifier, int]:
        """How much later than the sample's moment each frame that is there was taken, by id [ns]."""
        return {sensor_id: time_ns - self.timestamp_ns for sensor_id, time_ns in self.times_ns.items()}

    @property
    def world_from_lidar(self) -> RigidTransform | None:
        """Pose of the lidar of `sweep` at the sweep's reference time."""
        return None if self.lidar_id is None else self.poses.world_from_sensor[self.lidar_id]

    @property
    def world_from_camera(self) -> dict[Identifier, RigidTransform | None]:
        """Pose of each camera and depth camera at the time of its image or depth image, by id."""
        return {camera_id: self.poses.world_from_sensor[camera_id] for camera_id in self.cameras}

    @property
    def camera_from_lidar(self) -> dict[Identifier, RigidTransform | None]:
        """Takes the lidar at the sweep's reference time into each of `cameras` at the time of its image, by id.

        The ego's motion between the two times is in it. Without a trajectory (`unposed` says so) only the mountings
        are, which is right for an ego that is stationary.
        """
        poses, lidar_id = self.poses, self.lidar_id
        return {key: None if lidar_id is None else poses.into(key, lidar_id) for key in self.cameras}

    @property
    def camera_from_points(self) -> dict[Identifier, RigidTransform | None]:
        """The same for the positions of `sweep` as they are stored, whichever frame that is, by id of the camera."""
        return {camera_id: self.poses.into(camera_id, None) for camera_id in self.cameras}

    def arrays(self) -> dict[str, np.ndarray[Any, Any]]:
        """Give all of it as plain arrays by name, of the same names and dtypes for every sample of a scene.

        They are the caller's own. Shapes differ from sample to sample only where counts do: of points and of boxes.
        docs/samples.md lists the names.

        Raises:
            DataError: an image or depth image cannot be decoded.
        """
        from sceneloom.scene.sample_arrays import arrays_of

        return arrays_of(self)

    def __reduce__(self) -> tuple[Any, ...]:
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        for images in ("images", "depth_frames"):
            values[images] = {camera_id: _with_pixels(image) for camera_id, image in values[images].items()}
        return Sample, tuple(values.values())


def _with_pixels(image: Image | None) -> Image | None:
    """Decode an image; one that cannot be decoded stays as it is and says so when it is asked for."""
    try:
        return None if image is None else image.loaded()
    except DataError:
        return image
