"""Making a sample: find the frames that belong to a moment, and where their sensors were."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from sceneloom.cameras.camera import Camera
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.nearest import FramesByTimestamp, SweepsByReference
from sceneloom.scene.sample import Once, Sample
from sceneloom.scene.sample_boxes import Boxes, BoxTable
from sceneloom.scene.sample_positions import (
    Location,
    Pose,
    SamplePoses,
    choose_ego,
    frame_of_points,
    locations_of,
    poses_at,
)
from sceneloom.scene.sample_selection import Selection
from sceneloom.scene.sensor_sources import Posed
from sceneloom.scene.shooting import ShootingSensor, Shot, shots_of
from sceneloom.scene.span import sweep_period_ns
from sceneloom.scene.types import Identifier

Finder = SweepsByReference | FramesByTimestamp[Any]

_NO_POINTS = Location(None, "there is no sweep")


@dataclass(slots=True)
class _Found:
    """What was found for a moment, by id of the sensor; the frames are of the class that the sensor gives."""

    frames: dict[Identifier, Any] = field(default_factory=dict)
    times_ns: dict[Identifier, int] = field(default_factory=dict)
    missing: dict[Identifier, str] = field(default_factory=dict)

    def add(self, sensor_id: Identifier, answer: tuple[Any, int] | str) -> None:
        if isinstance(answer, str):
            self.missing[sensor_id] = answer
        else:
            self.frames[sensor_id], self.times_ns[sensor_id] = answer


class SampleMaker:
    """Makes the samples of a selection; a pickled one begins anew with the same selection.

    Attributes:
        selection: what each sample holds.
        count: how many samples there are.
        trajectory: name of the ego trajectory that poses come from, or None.
    """

    def __init__(self, selection: Selection) -> None:
        """Prepare what all samples share; no frame is read.

        Raises:
            OptionError: there is no such trajectory.
            PoseError: it has no orientations.
        """
        self.selection = selection
        scene, reference = selection.scene, selection.reference
        frames = reference.frames if isinstance(reference, LidarSensor) else reference.images
        self.count = len(frames)
        ego = choose_ego(scene, selection.trajectory)
        self.trajectory = None if ego is None else ego.name
        self._finders: dict[Identifier, Finder] = {
            **{lidar.id: _sweeps(lidar) for lidar in selection.lidars},
            **{camera.id: FramesByTimestamp(shots_of(camera)) for camera in selection.shooting},
            **{radar.id: FramesByTimestamp(radar.frames) for radar in selection.radars},
        }
        sensors: list[Posed] = [*selection.lidars, *selection.shooting, *selection.radars]
        self._locations = locations_of(scene, sensors, ego)
        self._points = frame_of_points(scene, selection.lidars[0], ego) if selection.lidars else _NO_POINTS
        self._boxes = BoxTable(scene)

    def __reduce__(self) -> tuple[Any, ...]:
        return SampleMaker, (self.selection,)

    def make(self, index: int) -> Sample:
        """Make the sample of the reference sensor's frame `index`.

        Raises:
            DataError: a frame cannot be read.
        """
        reference_id = self.selection.reference.id
        found = _Found()
        found.add(reference_id, self._finders[reference_id].read(index))
        moment_ns = found.times_ns[reference_id]
        for sensor_id, finder in self._finders.items():
            if sensor_id != reference_id:
                found.add(sensor_id, finder.find(moment_ns, self.selection.tolerance_ns))
        return self._sample(index, moment_ns, found)

    def _sample(self, index: int, moment_ns: int, found: _Found) -> Sample:
        selection, frames = self.selection, found.frames
        return Sample(
            index=index,
            timestamp_ns=moment_ns,
            reference_id=selection.reference.id,
            lidar_id=selection.lidars[0].id if selection.lidars else None,
            sweeps={lidar.id: frames.get(lidar.id) for lidar in selection.lidars},
            images={camera.id: frames.get(camera.id) for camera in selection.cameras},
            radar_frames={radar.id: frames.get(radar.id) for radar in selection.radars},
            depth_frames={camera.id: frames.get(camera.id) for camera in selection.depth_cameras},
            cameras={
                camera.id: _camera_model(camera, frames.get(camera.id)) for camera in selection.shooting
            },
            times_ns=found.times_ns,
            missing=found.missing,
            find_poses=Once(partial(self._poses, frames, found.times_ns)),
            find_boxes={
                sensor_id: Once(partial(self._boxes_of, sensor_id, time_ns, found.frames[sensor_id]))
                for sensor_id, time_ns in found.times_ns.items()
            },
        )

    def _boxes_of(self, sensor_id: Identifier, time_ns: int, frame: Any) -> Boxes:
        """The boxes as a sensor sees them at the time of its frame."""
        return self._boxes.at(time_ns, sensor_id=sensor_id, window_ns=(int(frame.timestamp_ns), time_ns))

    def _locations_for(self, frames: Mapping[Identifier, Any]) -> dict[Identifier, Location]:
        """The sensors' locations, of cameras those of images that have a mounting of their own."""
        locations = dict(self._locations)
        for sensor_id, frame in frames.items():
            if isinstance(frame, Shot) and frame.mount is not None:
                location = locations[sensor_id]
                source = None if location.source is None else location.source.mounted(frame.mount)
                locations[sensor_id] = replace(location, source=source, mount=frame.mount)
        return locations

    def _poses(self, frames: Mapping[Identifier, Any], times_ns: Mapping[Identifier, int]) -> SamplePoses:
        """Poses of the sensors, each at the time of its frame, and that of the stored points."""
        locations = self._locations_for(frames)
        asked = [(locations[key], time_ns) for key, time_ns in times_ns.items()]
        lidars = self.selection.lidars
        swept_ns = times_ns.get(lidars[0].id) if lidars else None
        if swept_ns is not None:
            asked.append((self._points, swept_ns))
        poses = poses_at(asked)
        points = Pose(None) if swept_ns is None else poses.pop()
        found = {key: Pose(None, "it has no frame in this sample") for key in locations}
        found |= dict(zip(times_ns, poses, strict=True))
        return SamplePoses(
            world_from_sensor={key: pose.world_from_sensor for key, pose in found.items()},
            ego_from_sensor={key: location.mount for key, location in locations.items()},
            world_from_points=points.world_from_sensor,
            ego_from_points=self._points.mount,
            unposed={key: pose.problem for key, pose in found.items() if pose.problem},
            extrapolated=tuple(key for key, pose in found.items() if pose.extrapolated),
        )


def _sweeps(lidar: LidarSensor) -> SweepsByReference:
    return SweepsByReference(lidar.frames, sweep_period_ns(lidar))


def _camera_model(camera: ShootingSensor, shot: Shot | None) -> Camera:
    return camera.camera if shot is None else shot.camera
