"""Scenes cropped in time, in space, to some sensors or to some labels."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, FloatArray, Int64Array
from sceneloom.editing.move_points import (
    KNOWN,
    FrameChange,
    OnPoints,
    chosen_frames,
    chosen_map,
    points_change,
    renumbered_frames,
    renumbered_map,
    with_chosen_points,
)
from sceneloom.editing.move_world import frames_ns
from sceneloom.editing.references import (
    OURS,
    NewIds,
    assumed,
    attributes_of,
    metadata_of,
    ours_of,
    skipped,
    with_annotation_ids,
    with_ours,
    with_sensor_ids,
    with_sensor_parent,
    with_warnings,
    without_cameras,
)
from sceneloom.editing.retime import LINES, SHARED, TEXTS, streams_of
from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.ego_trajectory import ego_motion_as_given
from sceneloom.scene.annotations import (
    Annotation,
    CameraCalibration,
    CuboidAnnotation,
    CuboidPath,
    LinkAnnotation,
    LocalizationAdjustment,
    PlainAnnotation,
    PointsAnnotation,
    ShapeAnnotation,
    locations_of,
)
from sceneloom.scene.annotations_at import CuboidAngles, annotations_frame, cuboid_at, point_at, shape_at
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor, PointsSensor, RadarFrame, RadarSensor
from sceneloom.scene.ego import EgoMotion, Posed, sensor_source
from sceneloom.scene.motion import OdometrySensor
from sceneloom.scene.poses import PoseSource
from sceneloom.scene.scene import Scene, Sensor, scene_period_ns
from sceneloom.scene.time_range import (
    Interval,
    Renumbering,
    chosen_interval,
    cut_scene,
    renumbered,
    select_rows,
)
from sceneloom.scene.types import Coordinates, Identifier, Key, PointsFrame, key_of
from sceneloom.warnings import DataWarning


def _with_sensors_chosen(
    scene: Scene, *, sensors: Iterable[Identifier] | None = None, without: Iterable[Identifier] = ()
) -> Scene:
    """Give a scene with some of its sensors, and without what is stated for the others.

    Args:
        scene: as it is.
        sensors: ids of those that stay; None for all.
        without: ids of those that go all the same.

    Raises:
        OptionError: there is no such sensor, none is left, or one that is left refers to an ego that is gone.
    """
    wanted = {key_of(s.id) for s in scene.sensors}
    if sensors is not None:
        wanted = {key_of(scene.sensor(identifier).id) for identifier in sensors}
    wanted -= {key_of(scene.sensor(identifier).id) for identifier in without}
    if not wanted:
        raise OptionError(f"{scene.source}: no sensor is left")
    ids = NewIds({key_of(s.id): None for s in scene.sensors if key_of(s.id) not in wanted})
    if not ids.changed:
        return scene
    kept = tuple(with_sensor_parent(s, ids) for s in scene.sensors if key_of(s.id) in wanted)
    _check_ego(scene, kept, ids)
    attributes = attributes_of(scene.attributes, ids)
    cut = replace(scene, sensors=kept, attributes=attributes)
    cut = _with_annotations(cut, [with_sensor_ids(annotation, ids) for annotation in scene.annotations])
    ours = metadata_of(ours_of(scene), ids)
    if ours:
        cut = replace(cut, metadata=MappingProxyType({**scene.metadata, OURS: ours}))
    reported = skipped("sensors-left-out", "sensors", "sensors that were not chosen", count=len(ids.changed))
    colours = assumed(
        "colours-kept",
        "sensors[].frames[].points.camera_index",
        "points keep the colours that a camera that was left out gave them, without saying which it was",
        count=sum(isinstance(s, CameraSensor) and ids.gone(s.id) for s in scene.sensors),
    )
    clouds = any(isinstance(sensor, LidarSensor) for sensor in kept)
    return with_warnings(without_cameras(scene, cut), (reported, *((colours,) if clouds else ())))


def _check_ego(scene: Scene, kept: tuple[object, ...], ids: NewIds) -> None:
    gone = [s for s in scene.sensors if isinstance(s, OdometrySensor) and ids.gone(s.id)]
    left = any(isinstance(sensor, OdometrySensor) for sensor in kept)
    for sensor in kept if gone else ():
        if isinstance(sensor, Posed) and sensor.coordinates is Coordinates.EGO and not left:
            raise OptionError(
                f"{scene.source}: sensor {sensor.id!r} is in ego coordinates and needs the odometry "
                f"sensor {gone[0].id!r}; bring the scene into the world first: `sceneloom edit to-world`"
            )


def _with_annotations(scene: Scene, found: list[Annotation | None]) -> Scene:
    """Give a scene whose annotations became these, None for one that is gone; links to it and its role as parent go.

    Args:
        scene: with all annotations.
        found: one for each of them.
    """
    gone: dict[Key, Identifier | None] = {}
    for annotation, new in zip(scene.annotations, found, strict=True):
        if new is None:
            gone[key_of(annotation.id)] = None
    kept = tuple(annotation for annotation in found if annotation is not None)
    if not gone:
        return replace(scene, annotations=kept)
    ids = NewIds(gone)
    orphans = sum(ids.gone(annotation.parent_id) for annotation in kept)
    freed = [with_annotation_ids(annotation, ids) for annotation in kept]
    left = tuple(annotation for annotation in freed if annotation is not None)
    reported = (
        ("annotations", "annotations that are not in it any more", len(gone)),
        ("links", "links to annotations that are not in it any more", len(kept) - len(left)),
        ("parents", "names of parents that are not in it any more", orphans),
    )
    warnings = [skipped(f"{what}-left-out", "annotations", message, count=n) for what, message, n in reported]
    return with_warnings(replace(scene, annotations=left), warnings)


def _with_labels_chosen(scene: Scene, labels: Iterable[str]) -> Scene:
    """Give a scene with the annotations of these labels, their parents, links between them, and all corrections.

    Raises:
        OptionError: no annotation has such a label.
    """
    wanted = frozenset(labels)
    stated = {_label(annotation) for annotation in scene.annotations}
    unknown = sorted(wanted - stated)
    if unknown:
        known = ", ".join(sorted(repr(label) for label in stated if label is not None))
        raise OptionError(f"{scene.source}: no annotation has the label {unknown[0]!r}; there are {known or 'none'}")
    kept = {key_of(a.id) for a in scene.annotations if _label(a) in wanted}
    parents = {key_of(a.id): a.parent_id for a in scene.annotations}
    for key in list(kept):
        parent = parents[key]
        while parent is not None and key_of(parent) not in kept and key_of(parent) in parents:
            kept.add(key_of(parent))
            parent = parents[key_of(parent)]
    links = {
        key_of(a.id)
        for a in scene.annotations
        if isinstance(a, LinkAnnotation) and key_of(a.from_id) in kept and key_of(a.to_id) in kept
    }
    corrections = (LocalizationAdjustment, CameraCalibration)
    return _with_annotations(
        scene,
        [
            a if key_of(a.id) in kept or key_of(a.id) in links or isinstance(a, corrections) else None
            for a in scene.annotations
        ],
    )


def _label(annotation: Annotation) -> str | None:
    if isinstance(annotation, PlainAnnotation):
        label = annotation.fields.get("label")
        return label if isinstance(label, str) else None
    return getattr(annotation, "label", None)


@dataclass(frozen=True, slots=True)
class _Region:
    """A box along the axes of a frame, or a ball around its origin, or what is in both.

    Attributes:
        frame: whose axes and origin.
        box: least x, y, z and greatest x, y, z [m], the faces included; None for all of space.
        reach: greatest distance from the origin [m]; None for any.
    """

    frame: PointsFrame
    box: tuple[float, ...] | None = None
    reach: float | None = None

    def __post_init__(self) -> None:
        if self.box is not None:
            fits = len(self.box) == 6 and all(low <= high for low, high in zip(self.box[:3], self.box[3:], strict=True))
            if not fits:
                raise OptionError(
                    f"box {self.box}; expected xmin,ymin,zmin,xmax,ymax,zmax, each minimum at most the maximum"
                )
        if self.reach is not None and not self.reach > 0:
            raise OptionError(f"range {self.reach}; expected a positive number of metres")

    def holds(self, points: FloatArray) -> BoolArray:
        """Report which points (..., 3) [m] of the frame lie in it; one that is not finite does not."""
        inside: BoolArray = np.asarray(np.isfinite(points).all(axis=-1))
        if self.box is not None:
            inside &= (points >= self.box[:3]).all(axis=-1) & (points <= self.box[3:]).all(axis=-1)
        if self.reach is not None:
            inside &= np.einsum("...i,...i->...", points, points) <= self.reach**2
        return inside


_Placed = tuple[_Region, FrameChange | None]
"""A region, and what takes locations into its frame; None where they are in it."""


@dataclass(frozen=True, slots=True, eq=False)
class _FrameChoice:
    """Chooses the points of frames that lie in all of some regions."""

    regions: tuple[_Placed, ...]

    def __call__(self, frame: LidarFrame | RadarFrame) -> Int64Array:
        """The rows that stay of a frame, at whose time the changes are known."""
        return np.flatnonzero(_held_at(self.regions, frame.timestamp_ns, frame.points.positions))


def _held_at(regions: tuple[_Placed, ...], timestamp_ns: int, locations: FloatArray) -> BoolArray:
    """Report which locations (N, 3) [m] lie in all regions at a time at which the changes are known."""
    exact = np.asarray(locations, np.float64)
    inside = np.ones(len(exact), np.bool_)
    for region, change in regions:
        inside &= region.holds(exact if change is None else change.transform(timestamp_ns).apply(exact))
    return inside


def _ever_held(alternatives: tuple[tuple[_Placed, ...], ...], times_ns: Int64Array, locations: FloatArray) -> BoolArray:
    """Report at which times a thing lies in all regions of any alternative.

    Args:
        alternatives: regions around the world, the ego, or one sensor each.
        times_ns: (M,) int64 [ns].
        locations: (M, V, 3) [m], of its V vertices at each time; NaN where it is not there.

    Returns:
        (M,) bool, where any vertex lies inside; not where a change is not known.
    """
    found = np.zeros(len(times_ns), np.bool_)
    for regions in alternatives:
        inside = np.ones(locations.shape[:2], np.bool_)
        for region, change in regions:
            if change is None:
                inside &= region.holds(locations)
            else:
                known = change.at(times_ns).coverage <= KNOWN
                inside &= region.holds(change.locations(times_ns, locations)) & known[:, None]
        found |= inside.any(axis=1)
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _SpaceCrop:
    """Keeps the annotations that lie in a region at some time.

    Attributes:
        alternatives: the region around the world, the ego, or each of the sensors.
        times_ns: (T,) int64 [ns], ascending: of the scene's frames. A thing is looked at at these and at its keyframes.
        angles: how the angles of cuboids are meant.
    """

    alternatives: tuple[tuple[_Placed, ...], ...]
    times_ns: Int64Array
    angles: CuboidAngles

    def __call__(self, annotation: Annotation) -> Annotation | None:
        """Give the annotation, its path cut if it is a cuboid; None where it is never inside."""
        crop = next((crop for kind, crop in _CROPS.items() if isinstance(annotation, kind)), None)
        return annotation if crop is None else crop(self, annotation)

    def looks(self, timestamps_ns: Int64Array, *, stationary: bool) -> Int64Array:
        """The times at which a path is looked at."""
        times = self.times_ns
        if not stationary:
            times = times[(times >= timestamps_ns.min()) & (times <= timestamps_ns.max())]
        return np.union1d(timestamps_ns, times)

    def inside(self, times_ns: Int64Array, locations: Float64Array) -> BoolArray:
        """Report at which times a thing with vertices (M, V, 3) is inside."""
        return _ever_held(self.alternatives, times_ns, locations)


def _cropped_cuboid(crop: _SpaceCrop, annotation: CuboidAnnotation) -> CuboidAnnotation | None:
    path, stationary = annotation.path, bool(annotation.stationary)
    if len(path.timestamps_ns) == 0:
        return annotation
    times = crop.looks(path.timestamps_ns, stationary=stationary)
    centers = cuboid_at(annotation, times, angles=crop.angles)[0][:, 3:6]
    inside = np.flatnonzero(crop.inside(times, centers[:, None]))
    if len(inside) == 0:
        return None
    if stationary or len(inside) == len(times):
        return annotation
    timestamps_ns = path.timestamps_ns
    # one keyframe before and one after, so that nothing changes in between
    first = max(int(np.searchsorted(timestamps_ns, times[inside[0]], side="right")) - 1, 0)
    last = min(int(np.searchsorted(timestamps_ns, times[inside[-1]])), len(timestamps_ns) - 1)
    cut = CuboidPath(timestamps_ns[first : last + 1], path.values[first : last + 1], path.extras)
    return replace(
        annotation,
        path=cut,
        activations=tuple(_between(entry, cut.timestamps_ns) for entry in annotation.activations),
        projections=tuple(_between(entry, cut.timestamps_ns) for entry in annotation.projections),
    )


def _between(entry: Any, timestamps_ns: Int64Array) -> Any:
    """Of an activation or a projection what lies between the first and the last keyframe."""
    kept = (entry.timestamps_ns >= timestamps_ns[0]) & (entry.timestamps_ns <= timestamps_ns[-1])
    return select_rows(entry, np.flatnonzero(kept))


def _cropped_shape(crop: _SpaceCrop, annotation: ShapeAnnotation) -> ShapeAnnotation | None:
    timestamps_ns = annotation.path.timestamps_ns
    if annotation.dimensions == 2 or len(timestamps_ns) == 0:
        return annotation
    times = crop.looks(timestamps_ns, stationary=bool(annotation.stationary))
    found = shape_at(annotation, times)
    widest = max((len(vertices) for vertices in found if vertices is not None), default=0)
    locations = np.full((len(times), widest, 3), np.nan)
    for row, vertices in zip(locations, found, strict=True):
        if vertices is not None:
            row[: len(vertices)] = vertices
    return annotation if crop.inside(times, locations).any() else None


def _cropped_points(crop: _SpaceCrop, annotation: PointsAnnotation) -> PointsAnnotation | None:
    stationary = bool(annotation.stationary)
    placed = [p for p in annotation.paths if len(p.timestamps_ns) and p.values.shape[1] % 3 == 0]
    for path in placed:
        times = crop.looks(path.timestamps_ns, stationary=stationary)
        locations = locations_of(point_at(path, times, stationary=stationary)[0])
        if crop.inside(times, locations).any():
            return annotation
    return None if placed else annotation


_CROPS: Mapping[type, Callable[[_SpaceCrop, Any], Annotation | None]] = MappingProxyType(
    {CuboidAnnotation: _cropped_cuboid, ShapeAnnotation: _cropped_shape, PointsAnnotation: _cropped_points}
)
"""How the annotations that have a location in space are cropped; the others stay."""

_OTHER, _ANCHORS, _FRAMES = "other_lines", "other_seconds", "frame_lines"


def _cut_lines(scene: Scene, part: Interval | None) -> Mapping[str, Any]:
    """Give a scene's metadata without lines of other times, and of sensors and trajectories that are gone.

    Lines of unknown content stay where their time does, those without one where that of the line before does: it is not
    known what they are of.

    Args:
        scene: the part that stays.
        part: its times [ns]; None where it was not cut in time.
    """
    kept = scene.metadata.get(LINES)
    if not isinstance(kept, Mapping):
        return scene.metadata
    there = {f"trajectories.{name}" for name in scene.trajectories}
    there |= {name for sensor in scene.sensors for name in streams_of(sensor)}
    changed = {**kept, **_other_lines(kept, part)}
    texts, shared = kept.get(TEXTS), kept.get(SHARED)
    if isinstance(texts, Mapping):
        changed[TEXTS] = {
            name: {key: text for key, text in lines.items() if _is_key_inside(key, part)}
            for name, lines in texts.items()
            if name in there and isinstance(lines, Mapping)
        }
    if isinstance(shared, list):
        changed[SHARED] = [line for line in shared if _stays(line, there, part)]
    if part is not None:
        changed.pop(_FRAMES, None)
    left = {name: value for name, value in changed.items() if value or value == kept.get(name)}
    return MappingProxyType({**scene.metadata, LINES: MappingProxyType(left)})


def _other_lines(kept: Mapping[str, Any], part: Interval | None) -> dict[str, Any]:
    """Lines that nothing computes with, with the times of those that have none of their own."""
    lines, anchors = kept.get(_OTHER), kept.get(_ANCHORS)
    if part is None or not isinstance(lines, list):
        return {}
    seconds = anchors if isinstance(anchors, Mapping) else {}
    chosen = []
    for location, text in enumerate(lines):
        anchor = seconds.get(str(location))
        time = anchor if anchor is not None else _seconds_of(text)
        if time is None or _is_inside(round(time * 1e9), part):
            chosen.append((text, anchor))
    found = {str(location): anchor for location, (_, anchor) in enumerate(chosen) if anchor is not None}
    return {_OTHER: [text for text, _ in chosen], **({_ANCHORS: found} if _ANCHORS in kept else {})}


def _stays(line: Any, there: set[str], part: Interval | None) -> bool:
    """Whether a line that several streams have a part in is of the part, and of streams all of which stay."""
    records = line.get("records") if isinstance(line, Mapping) else None
    pairs = [record for record in records or () if len(record) == 2]
    return all(stream in there and _is_key_inside(key, part) for stream, key in pairs)


def _is_key_inside(key: str, part: Interval | None) -> bool:
    timestamp = key.partition("#")[0]
    return part is None or (timestamp.removeprefix("-").isdecimal() and _is_inside(int(timestamp), part))


def _is_inside(time_ns: int, part: Interval) -> bool:
    return part[0] <= time_ns < part[1]


def _seconds_of(text: Any) -> float | None:
    try:
        line = json.loads(text)
    except (TypeError, ValueError, RecursionError):
        return None
    seconds = line.get("time") if isinstance(line, dict) else None
    return float(seconds) if isinstance(seconds, int | float) and abs(seconds) < 9.2e9 else None


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
        cut = _with_sensors_chosen(cut, sensors=sensors, without=gone)
    part = chosen_interval(cut, start=start, stop=stop)
    cut = cut_scene(cut, start=start, stop=stop)
    cut = replace(cut, metadata=_cut_lines(cut, part))
    if labels is not None:
        cut = _with_labels_chosen(cut, labels)
    if not regions:
        return cut
    ego = _ego(cut, regions, trajectory, heading)
    cropped = _Crop(cut, ego, regions, on_points).cropped()
    stated = {"box": None if box is None else list(box), "frame": PointsFrame(frame).value, "range": reach}
    return with_ours(cropped, cropped={name: value for name, value in stated.items() if value is not None})


def _regions(frame: PointsFrame, box: Sequence[float] | None, reach: float | None) -> tuple[_Region, ...]:
    regions = [] if box is None else [_Region(frame, box=tuple(box))]
    if reach is not None:
        around = PointsFrame.EGO if frame is PointsFrame.EGO else PointsFrame.SENSOR
        regions.append(_Region(around, reach=reach))
    return tuple(regions)


def _ego(scene: Scene, regions: tuple[_Region, ...], trajectory: str | None, heading: str | None) -> EgoMotion | None:
    """The ego trajectory, if something may need it."""
    posed = [s for s in scene.sensors if isinstance(s, Posed)]
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
    regions: tuple[_Region, ...]
    on_points: OnPoints | None
    changes: dict[Key, Renumbering] = field(default_factory=dict)
    warnings: list[DataWarning] = field(default_factory=list)

    def cropped(self) -> Scene:
        sensors = tuple(self._sensor(sensor) for sensor in self.scene.sensors)
        crop = _SpaceCrop(
            self._around(annotations_frame(self.scene)), frames_ns(self.scene), CuboidAngles.of(self.scene)
        )
        cut = _with_annotations(self.scene, [crop(annotation) for annotation in self.scene.annotations])
        annotations, reported = renumbered(cut.annotations, self.changes)
        return with_warnings(replace(cut, sensors=sensors, annotations=annotations), (*self.warnings, *reported))

    def _sensor(self, sensor: Sensor) -> Sensor:
        if isinstance(sensor, LidarSensor | RadarSensor):
            return self._cloud(sensor)
        if isinstance(sensor, PointsSensor):
            rows = np.flatnonzero(self._held_once(sensor.positions))
            self.changes[key_of(sensor.id)] = renumbered_map(rows)
            return chosen_map(sensor, rows)
        return sensor

    def _cloud(self, sensor: LidarSensor | RadarSensor) -> Sensor:
        placed = self._placed_points(sensor)
        numbers = _known(placed, sensor.frames.timestamps_ns)
        lost = len(sensor.frames) - len(numbers)
        what = "frames at whose time the ego trajectory is not known"
        location = f"sensors[{sensor.id}].frames"
        self.warnings.append(skipped("frames-beyond-the-trajectory", location, what, count=lost))
        choice = _FrameChoice(placed)
        self.changes[key_of(sensor.id)] = renumbered_frames(numbers, sensor.frames, choice)
        frames: Any = with_chosen_points(chosen_frames(sensor.frames, numbers), choice, sensor.id, self.on_points)
        return replace(sensor, frames=frames)

    def _placed_points(self, sensor: LidarSensor | RadarSensor) -> tuple[_Placed, ...]:
        """The regions, each with what takes the sensor's points into its frame."""
        reach_ns = scene_period_ns(self.scene)
        return tuple(
            (region, points_change(self.scene, sensor, self.ego, region.frame, reach_ns=reach_ns))
            for region in self.regions
        )

    def _around(self, old: Coordinates) -> tuple[tuple[_Placed, ...], ...]:
        """The regions for locations in the world or on the ego: around each sensor, where one is asked for."""
        if all(region.frame is not PointsFrame.SENSOR for region in self.regions):
            return (tuple((region, self._change(old, region.frame, None)) for region in self.regions),)
        clouds = [s for s in self.scene.sensors if isinstance(s, LidarSensor | RadarSensor)]
        if not clouds:
            raise OptionError(f"{self.scene.source}: no lidar or radar in it whose frame or distance could be meant")
        return tuple(
            tuple((region, self._change(old, region.frame, sensor)) for region in self.regions) for sensor in clouds
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
                inside[left] = _held_at(placed, time_ns, positions[left])
        return inside


def _known(placed: tuple[_Placed, ...], times_ns: Int64Array) -> Int64Array:
    """The rows of the times at which all changes are known."""
    known = np.ones(len(times_ns), np.bool_)
    for _, change in placed:
        if change is not None:
            known &= change.at(times_ns).coverage <= KNOWN
    return np.flatnonzero(known)
