"""Scenes cut in time, in space, to some sensors, to some labels."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from sceneloom.arrays import BoolArray, Float32Array, Int64Array
from sceneloom.editing.choose import with_annotations, with_labels_chosen, with_sensors_chosen
from sceneloom.editing.chosen_points import CloudSensor, OnPoints, chosen_map, with_chosen_points
from sceneloom.editing.crop_annotations import SpaceCrop
from sceneloom.editing.cut_lines import cut_lines
from sceneloom.editing.frame_change import KNOWN, FrameChange
from sceneloom.editing.frame_of_annotations import frames_ns
from sceneloom.editing.moved_clouds import chosen_frames
from sceneloom.editing.record import skipped, with_ours, with_warnings
from sceneloom.editing.region import FrameChoice, Placed, Region, held_at
from sceneloom.editing.sensor_frames import points_change
from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.ego_motion import ego_motion_as_given
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations_frame import annotations_frame
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor, PointsSensor, RadarFrame, RadarSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.labelled import Renumbering, renumbered
from sceneloom.scene.part import chosen_interval, cut_scene
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.sensor_sources import sensor_source
from sceneloom.scene.span import scene_period_ns
from sceneloom.scene.types import Coordinates, Identifier, Key, PointsFrame, key_of
from sceneloom.scene.warnings import DataWarning

_CHOICES = ("a time (start, stop)", "a space (box, range)", "sensors", "sensors to do without", "labels")


def crop_scene(
    scene: Scene,
    *,
    start: float | None = None,
    stop: float | None = None,
    box: Sequence[float] | None = None,
    frame: PointsFrame | str = PointsFrame.WORLD,
    reach: float | None = None,
    sensors: Iterable[Identifier] | None = None,
    without: Iterable[Identifier] = (),
    labels: Iterable[str] | None = None,
    trajectory: str | None = None,
    heading: str | None = None,
    on_points: OnPoints | None = None,
) -> Scene:
    """Give a part of a scene; points are chosen when frames are read, frames with labelled points now.

    In space a point stays that lies inside; a cuboid whose centre is inside at some time, its path cut to that time and
    a keyframe around it; a shape or named points any of whose vertices is inside at some time, whole.

    Args:
        scene: as it is.
        start: seconds after the scene's first timestamp, None for the beginning.
        stop: seconds after it, exclusive, None for the end.
        box: least x, y, z and greatest x, y, z [m], the faces included.
        frame: along whose axes the box lies: "world", or of each frame's time "ego" or "sensor", where annotations and
            maps stay that are in the box of any lidar or radar.
        reach: greatest distance from the ego where `frame` is "ego", else from the sensor [m].
        sensors: ids of the only sensors that stay; None for all.
        without: ids of sensors that go.
        labels: of the only annotations that stay, with their parents; None for all.
        trajectory: name of the ego trajectory, where it is needed; None for the default.
        heading: "motion" to derive orientations where the trajectory has positions only.
        on_points: reported each frame that is read.

    Raises:
        OptionError: a value cannot be followed, there is nothing to do, or nothing is left.
        PoseError: the poses that this needs are not known.
        DataError: a frame that this needs cannot be read.
    """
    if frame not in tuple(PointsFrame):
        raise OptionError(f"frame {frame!r}; expected one of {', '.join(PointsFrame)}")
    gone = tuple(without)
    if not gone and all(stated is None for stated in (start, stop, box, reach, sensors, labels)):
        raise OptionError(f"nothing to crop by; expected one of {', '.join(_CHOICES)}")
    regions = _regions(PointsFrame(frame), box, reach)
    cut = scene
    if sensors is not None or gone:
        cut = with_sensors_chosen(cut, sensors=sensors, without=gone)
    part = chosen_interval(cut, start=start, stop=stop)
    cut = cut_scene(cut, start=start, stop=stop)
    cut = replace(cut, metadata=cut_lines(cut, part))
    if labels is not None:
        cut = with_labels_chosen(cut, labels)
    if not regions:
        return cut
    ego = _ego(cut, regions, trajectory, heading)
    cropped = _Crop(cut, ego, regions, on_points).cropped()
    stated = {"box": None if box is None else list(box), "frame": PointsFrame(frame).value, "range": reach}
    return with_ours(cropped, cropped={name: value for name, value in stated.items() if value is not None})


def _regions(frame: PointsFrame, box: Sequence[float] | None, reach: float | None) -> tuple[Region, ...]:
    regions = [] if box is None else [Region(frame, box=tuple(box))]
    if reach is not None:
        around = PointsFrame.EGO if frame is PointsFrame.EGO else PointsFrame.SENSOR
        regions.append(Region(around, reach=reach))
    return tuple(regions)


def _ego(
    scene: Scene, regions: tuple[Region, ...], trajectory: str | None, heading: str | None
) -> EgoMotion | None:
    """The ego trajectory, if something may need it."""
    posed = [
        s
        for s in scene.sensors
        if isinstance(s, LidarSensor | RadarSensor | CameraSensor | DepthCameraSensor)
    ]
    on_ego = any(s.mount is not None or s.coordinates is Coordinates.EGO for s in posed)
    asked = any(region.frame is PointsFrame.EGO for region in regions)
    if trajectory is None and not asked and not (on_ego and scene.trajectories):
        return None
    return ego_motion_as_given(scene, name=trajectory, heading=heading)


@dataclass(slots=True, eq=False)
class _Crop:
    """Crops one scene in space."""

    scene: Scene
    ego: EgoMotion | None
    regions: tuple[Region, ...]
    on_points: OnPoints | None
    changes: dict[Key, Renumbering] = field(default_factory=dict)
    warnings: list[DataWarning] = field(default_factory=list)

    def cropped(self) -> Scene:
        sensors = tuple(self._sensor(sensor) for sensor in self.scene.sensors)
        crop = SpaceCrop(
            self._around(annotations_frame(self.scene)), frames_ns(self.scene), CuboidAngles.of(self.scene)
        )
        cut = with_annotations(self.scene, [crop(annotation) for annotation in self.scene.annotations])
        annotations, reported = renumbered(cut.annotations, self.changes)
        return with_warnings(
            replace(cut, sensors=sensors, annotations=annotations), (*self.warnings, *reported)
        )

    def _sensor(self, sensor: Sensor) -> Sensor:
        if isinstance(sensor, LidarSensor):
            return self._cloud(sensor)
        if isinstance(sensor, RadarSensor):
            return self._cloud(sensor)
        if isinstance(sensor, PointsSensor):
            rows = np.flatnonzero(self._held_once(sensor.positions))
            self.changes[key_of(sensor.id)] = Renumbering(rows=partial(_always, rows))
            return chosen_map(sensor, rows)
        return sensor

    def _cloud(self, sensor: CloudSensor) -> CloudSensor:
        placed = self._placed_points(sensor)
        numbers = _known(placed, sensor.frames.timestamps_ns)
        lost = len(sensor.frames) - len(numbers)
        what = "frames at whose time the ego trajectory is not known"
        location = f"sensors[{sensor.id}].frames"
        self.warnings.append(skipped("frames-beyond-the-trajectory", location, what, count=lost))
        choice = FrameChoice(placed)
        self.changes[key_of(sensor.id)] = Renumbering(numbers, partial(_rows_of, sensor.frames, choice))
        frames = chosen_frames(sensor.frames, numbers)
        return replace(sensor, frames=with_chosen_points(frames, choice, sensor.id, self.on_points))

    def _placed_points(self, sensor: LidarSensor | RadarSensor) -> tuple[Placed, ...]:
        """The regions, each with what takes the sensor's points into its frame."""
        reach_ns = scene_period_ns(self.scene)
        return tuple(
            (region, points_change(self.scene, sensor, self.ego, region.frame, reach_ns=reach_ns))
            for region in self.regions
        )

    def _around(self, old: Coordinates) -> tuple[tuple[Placed, ...], ...]:
        """The regions for locations in the world or on the ego: around each sensor, where one is asked for."""
        if all(region.frame is not PointsFrame.SENSOR for region in self.regions):
            return (tuple((region, self._change(old, region.frame, None)) for region in self.regions),)
        clouds = [s for s in self.scene.sensors if isinstance(s, LidarSensor | RadarSensor)]
        if not clouds:
            raise OptionError(
                f"{self.scene.source}: no lidar or radar in it whose frame or distance could be meant"
            )
        return tuple(
            tuple((region, self._change(old, region.frame, sensor)) for region in self.regions)
            for sensor in clouds
        )

    def _change(
        self, old: Coordinates, new: PointsFrame, sensor: LidarSensor | RadarSensor | None
    ) -> FrameChange | None:
        if old.value == new.value:
            return None
        return FrameChange(self._in_world(PointsFrame(old.value), None), self._in_world(new, sensor))

    def _in_world(self, frame: PointsFrame, sensor: LidarSensor | RadarSensor | None) -> PoseSource | None:
        reach_ns = scene_period_ns(self.scene)
        if frame is PointsFrame.WORLD:
            return None
        if sensor is not None and frame is PointsFrame.SENSOR:
            return sensor_source(self.scene, sensor, self.ego, reach_ns=reach_ns)
        ego = ego_motion_as_given(self.scene) if self.ego is None else self.ego
        return PoseSource(ego.path, RigidTransform.identity(), reach_ns)

    def _held_once(self, positions: Float32Array) -> BoolArray:
        """Report which points of a map lie inside at any time."""
        inside = np.zeros(len(positions), np.bool_)
        for placed in self._around(Coordinates.WORLD):
            constant = all(change is None or change.is_constant for _, change in placed)
            times_ns = np.zeros(1, np.int64) if constant else frames_ns(self.scene)
            for time_ns in times_ns[_known(placed, times_ns)].tolist():
                left = np.flatnonzero(~inside)
                inside[left] = held_at(placed, time_ns, positions[left])
        return inside


def _known(placed: tuple[Placed, ...], times_ns: Int64Array) -> Int64Array:
    """The rows of the times at which all changes are known."""
    known = np.ones(len(times_ns), np.bool_)
    for _, change in placed:
        if change is not None:
            known &= change.at(times_ns).coverage <= KNOWN
    return np.flatnonzero(known)


def _always(rows: Int64Array, number: int | None) -> Int64Array:  # noqa: ARG001 - a map has one frame only
    return rows


def _rows_of(
    frames: LazyFrames[LidarFrame] | LazyFrames[RadarFrame], choice: FrameChoice, number: int | None
) -> Int64Array | None:
    return None if number is None else choice(frames[number])
