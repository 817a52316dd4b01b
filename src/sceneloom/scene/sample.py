"""One synchronised set: a sweep, the pictures and other frames that belong to it, and where everything was."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import partial
from typing import Any

import numpy as np

from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import Picture
from sceneloom.scene.clouds import LidarFrame, RadarFrame
from sceneloom.scene.sample_boxes import Boxes
from sceneloom.scene.types import Identifier


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """What several sensors measured about one moment.

    Every sensor that was asked for is a key of the mappings. Where it has no frame near enough, or its pose is not
    known, the value is None and `missing` or `unposed` says why. Pictures are decoded when their `rgb` is asked for.
    A sample that is pickled takes its pixels and boxes along, so that whoever gets it needs no file.

    Attributes:
        index: number of the reference sensor's frame.
        timestamp_ns: the moment [ns]: the sweep's reference time (median of its point times), or that of the picture.
        reference_id: the sensor that gives the moment.
        lidar_id: the lidar of `sweep`; None without any.
        sweeps: by id of the lidar.
        pictures: by id of the camera.
        radar_frames: by id of the radar.
        cameras: the lens by id of the camera: that of the picture, where there is one.
        times_ns: time of each frame that is there, by id [ns]; of sweeps their reference time.
        world_from_sensor: the pose of each sensor at the time of its frame, by id.
        ego_from_sensor: its rigid mounting on the ego, by id.
        world_from_points: takes the positions of `sweep`, as they are stored, into the world.
        ego_from_points: takes them into the ego's frame at the time of the sweep; None where they are in the world.
        missing: why a frame is not there, by id.
        unposed: why a pose is not known, by id.
        extrapolated: sensors whose pose continues the trajectory beyond its ends.
        find_boxes: gives the boxes.
    """

    index: int
    timestamp_ns: int
    reference_id: Identifier
    lidar_id: Identifier | None
    sweeps: Mapping[Identifier, LidarFrame | None]
    pictures: Mapping[Identifier, Picture | None]
    radar_frames: Mapping[Identifier, RadarFrame | None]
    cameras: Mapping[Identifier, Camera]
    times_ns: Mapping[Identifier, int]
    world_from_sensor: Mapping[Identifier, RigidTransform | None]
    ego_from_sensor: Mapping[Identifier, RigidTransform | None]
    world_from_points: RigidTransform | None
    ego_from_points: RigidTransform | None
    missing: Mapping[Identifier, str]
    unposed: Mapping[Identifier, str]
    extrapolated: tuple[Identifier, ...]
    find_boxes: Callable[[], Boxes]

    @property
    def sweep(self) -> LidarFrame | None:
        """The reference lidar's sweep; with a camera as reference, the nearest one of the first lidar."""
        return None if self.lidar_id is None else self.sweeps[self.lidar_id]

    @property
    def boxes(self) -> Boxes:
        """The scene's boxes at the sample's moment, interpolated now.

        Raises:
            OptionError: unit or order of their angles is none of those known.
        """
        return self.find_boxes()

    @property
    def time_differences_ns(self) -> dict[Identifier, int]:
        """How much later than the sample's moment each frame that is there was taken, by id [ns]."""
        return {sensor_id: time_ns - self.timestamp_ns for sensor_id, time_ns in self.times_ns.items()}

    @property
    def world_from_lidar(self) -> RigidTransform | None:
        """Pose of the lidar of `sweep` at the sweep's reference time."""
        return None if self.lidar_id is None else self.world_from_sensor[self.lidar_id]

    @property
    def world_from_camera(self) -> dict[Identifier, RigidTransform | None]:
        """Pose of each camera at the time of its picture, by id."""
        return {camera_id: self.world_from_sensor[camera_id] for camera_id in self.pictures}

    @property
    def camera_from_lidar(self) -> dict[Identifier, RigidTransform | None]:
        """Takes the lidar at the sweep's reference time into each camera at the time of its picture, by id.

        The ego's motion between the two times is in it. Without a trajectory (`unposed` says so) only the mountings
        are, which is right for an ego that stands still.
        """
        ego_from_lidar = None if self.lidar_id is None else self.ego_from_sensor[self.lidar_id]
        return self._into_cameras(self.world_from_lidar, ego_from_lidar)

    @property
    def camera_from_points(self) -> dict[Identifier, RigidTransform | None]:
        """The same for the positions of `sweep` as they are stored, whichever frame that is, by id of the camera."""
        return self._into_cameras(self.world_from_points, self.ego_from_points)

    def arrays(self) -> dict[str, np.ndarray[Any, Any]]:
        """Give all of it as plain arrays by name, of the same names and dtypes for every sample of a scene.

        They are the caller's own. Shapes differ from sample to sample only where counts do: of points and of boxes.
        docs/samples.md lists the names.

        Raises:
            DataError: a picture cannot be decoded.
        """
        from sceneloom.scene.sample_arrays import arrays_of

        return arrays_of(self)

    def _into_cameras(
        self, world_from_body: RigidTransform | None, ego_from_body: RigidTransform | None
    ) -> dict[Identifier, RigidTransform | None]:
        return {
            camera_id: self._into(camera_id, world_from_body, ego_from_body) for camera_id in self.pictures
        }

    def _into(
        self,
        camera_id: Identifier,
        world_from_body: RigidTransform | None,
        ego_from_body: RigidTransform | None,
    ) -> RigidTransform | None:
        world_from_camera = self.world_from_sensor[camera_id]
        if world_from_camera is not None and world_from_body is not None:
            return world_from_camera.inverse() @ world_from_body
        ego_from_camera = self.ego_from_sensor[camera_id]
        if ego_from_camera is not None and ego_from_body is not None:
            return ego_from_camera.inverse() @ ego_from_body
        return None

    def __reduce__(self) -> tuple[Any, ...]:
        loaded = {
            "pictures": {key: _with_pixels(picture) for key, picture in self.pictures.items()},
            "find_boxes": partial(_itself, self.boxes),
        }
        return Sample, tuple(loaded.get(field.name, getattr(self, field.name)) for field in fields(self))


def _with_pixels(picture: Picture | None) -> Picture | None:
    """Decode a picture; one that cannot be decoded stays as it is and says so when it is asked for."""
    try:
        return None if picture is None else picture.loaded()
    except DataError:
        return picture


def _itself(boxes: Boxes) -> Boxes:
    return boxes
