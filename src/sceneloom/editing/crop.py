"""Scenes cropped in time, in space, to some sensors or to some labels."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, FloatArray, Int64Array
from sceneloom.editing.move_world import FrameChange, points_change
from sceneloom.editing.references import (
    LINES,
    OURS,
    TEXTS,
    WHOLE_LABELS,
    NewIds,
    entries_of,
    metadata_of,
    ours_of,
    recounted,
    streams_of,
    with_annotation_ids,
    with_ours,
    with_sensor_ids,
    with_sensor_parent,
    with_warnings,
)
from sceneloom.editing.thin import OnPoints, with_map_points, with_points
from sceneloom.errors import OptionError, check_choice
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.ego_trajectory import ego_motion_as_given
from sceneloom.scene.annotations import (
    Annotation,
    CameraCalibration,
    CuboidAnnotation,
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
from sceneloom.scene.ego import EgoMotion, frames_ns, sensor_source
from sceneloom.scene.motion import OdometrySensor
from sceneloom.scene.poses import PoseSource
from sceneloom.scene.scene import Posed, Scene, Sensor, scene_period_ns
from sceneloom.scene.time_range import Interval, Renumbering, chosen_interval, cut_scene, renumbered, select_rows
from sceneloom.scene.types import Coordinates, Identifier, Key, PointsFrame, key_of
from sceneloom.warnings import DataWarning, assumed, skipped

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
    a keyframe around it; a shape or keypoints any of whose vertices is inside at some time, whole.

    Args:
        scene: the scene.
        start: seconds after the scene's first timestamp, None for the beginning.
        stop: seconds after it, exclusive, None for the end.
        box: least x, y, z and greatest x, y, z [m], the faces included.
        frame: along whose axes the box lies: "world", or of each frame's time "ego" or "sensor", where annotations and
            maps stay that are in the box of any lidar or radar.
        reach: greatest distance from the ego where `frame` is "ego", else from the sensor [m].
        sensors: ids of the only sensors that stay; None for all.
        without: ids of sensors to leave out.
        labels: of the only annotations that stay, with their parents; None for all.
        trajectory: name of the ego trajectory, where it is needed; None for the default.
        heading: "motion" to derive orientations where the trajectory has positions only.
        on_points: called for each frame that is read.

    Raises:
        OptionError: a value is invalid, there is nothing to do, or nothing is left.
        PoseError: the poses that this needs are not known.
        DataError: a frame that this needs cannot be read.
    """
    check_choice("frame", frame, PointsFrame)
    gone = tuple(without)
    if not gone and all(stated is None for stated in (start, stop, box, reach, sensors, labels)):
        raise OptionError(f"nothing to crop by; expected one of {', '.join(_CHOICES)}")
    regions = [] if box is None else [_Region(PointsFrame(frame), box=tuple(box))]
    if reach is not None:
        around = PointsFrame.EGO if frame == PointsFrame.EGO else PointsFrame.SENSOR
        regions.append(_Region(around, reach=reach))
    cut = scene if sensors is None and not gone else _with_sensors(scene, sensors, gone)
    part = chosen_interval(cut, start=start, stop=stop)
    cut = cut_scene(cut, start=start, stop=stop)
    cut = replace(cut, metadata=_cut_lines(cut, part))
    if labels is not None:
        cut = _with_labels(cut, labels)
    if not regions:
        return cut
    ego = _ego_if_needed(cut, regions, trajectory, heading)
    cropped = _SpaceCrop(cut, ego, tuple(regions), on_points).cropped()
    stated = {"box": None if box is None else list(box), "frame": PointsFrame(frame).value, "range": reach}
    return with_ours(cropped, cropped={name: value for name, value in stated.items() if value is not None})


def _with_sensors(scene: Scene, sensors: Iterable[Identifier] | None, without: Iterable[Identifier]) -> Scene:
    """Give a scene with some of its sensors (None for all), and without what is stated for the others."""
    wanted = {key_of(s.id) for s in scene.sensors}
    if sensors is not None:
        wanted = {key_of(scene.sensor(identifier).id) for identifier in sensors}
    wanted -= {key_of(scene.sensor(identifier).id) for identifier in without}
    if not wanted:
        raise OptionError(f"{scene.source}: no sensor is left")
    ids = NewIds({key_of(s.id): None for s in scene.sensors if key_of(s.id) not in wanted})
    if not ids.changed:
        return scene
    kept = [with_sensor_parent(s, ids) for s in scene.sensors if key_of(s.id) in wanted]
    _check_ego(scene, kept, ids)
    order = {key_of(camera.id): k for k, camera in enumerate(s for s in kept if isinstance(s, CameraSensor))}
    numbers = {k: order[key_of(one.id)] for k, one in enumerate(scene.cameras) if key_of(one.id) in order}
    lost_cameras = len(scene.cameras) - len(numbers)
    if lost_cameras:
        kept = [recounted(sensor, numbers) if isinstance(sensor, LidarSensor) else sensor for sensor in kept]
    cut = replace(scene, sensors=tuple(kept), attributes=entries_of(scene.attributes, ids))
    cut = _with_annotations(cut, [with_sensor_ids(annotation, ids) for annotation in scene.annotations])
    ours = metadata_of(ours_of(scene), ids)
    if ours:
        cut = replace(cut, metadata=MappingProxyType({**scene.metadata, OURS: ours}))
    reported = skipped("sensors-left-out", "sensors", "sensors that were not chosen", count=len(ids.changed))
    colours = assumed(
        "colours-kept",
        "sensors[].frames[].points.camera_index",
        "points keep the colours of a camera that was left out, without naming it",
        count=lost_cameras if any(isinstance(sensor, LidarSensor) for sensor in kept) else 0,
    )
    return with_warnings(cut, (reported, colours))


def _check_ego(scene: Scene, kept: list[Sensor], ids: NewIds) -> None:
    gone = [s for s in scene.sensors if isinstance(s, OdometrySensor) and ids.gone(s.id)]
    if not gone or any(isinstance(sensor, OdometrySensor) for sensor in kept):
        return
    for sensor in kept:
        if isinstance(sensor, Posed) and sensor.coordinates is Coordinates.EGO:
            raise OptionError(
                f"{scene.source}: sensor {sensor.id!r} is in ego coordinates and needs the odometry "
                f"sensor {gone[0].id!r}; bring the scene into the world first: `sceneloom edit to-world`"
            )


def _with_annotations(scene: Scene, found: Sequence[Annotation | None]) -> Scene:
    """Give a scene whose annotations became these; None: it is gone, with links to it and its role as parent."""
    gone = [old for old, new in zip(scene.annotations, found, strict=True) if new is None]
    kept = tuple(annotation for annotation in found if annotation is not None)
    if not gone:
        return replace(scene, annotations=kept)
    ids = NewIds({key_of(annotation.id): None for annotation in gone})
    freed = [with_annotation_ids(annotation, ids) for annotation in kept]
    left = tuple(annotation for annotation in freed if annotation is not None)
    orphans = sum(ids.gone(annotation.parent_id) for annotation in kept)
    reported = (
        ("annotations", "annotations that are no longer in the scene", len(gone)),
        ("links", "links to annotations that are no longer in the scene", len(kept) - len(left)),
        ("parents", "references to parents that are no longer in the scene", orphans),
    )
    warnings = [skipped(f"{what}-left-out", "annotations", message, count=n) for what, message, n in reported]
    return with_warnings(replace(scene, annotations=left), warnings)


def _with_labels(scene: Scene, labels: Iterable[str]) -> Scene:
    """Give a scene with the annotations of these labels, their parents, links between them, and all corrections."""
    wanted = frozenset(labels)
    stated = {_label(annotation) for annotation in scene.annotations}
    if unknown := sorted(wanted - stated):
        known = ", ".join(sorted(repr(label) for label in stated if label is not None))
        raise OptionError(f"{scene.source}: no annotation has the label {unknown[0]!r}; there are {known or 'none'}")
    kept = {key_of(a.id) for a in scene.annotations if _label(a) in wanted}
    parents = {key_of(a.id): a.parent_id for a in scene.annotations}
    for key in list(kept):
        parent = parents[key]
        while parent is not None and key_of(parent) not in kept and key_of(parent) in parents:
            kept.add(key_of(parent))
            parent = parents[key_of(parent)]

    def stays(annotation: Annotation) -> bool:
        if isinstance(annotation, LinkAnnotation) and {key_of(annotation.from_id), key_of(annotation.to_id)} <= kept:
            return True
        return key_of(annotation.id) in kept or isinstance(annotation, LocalizationAdjustment | CameraCalibration)

    return _with_annotations(scene, [a if stays(a) else None for a in scene.annotations])


def _label(annotation: Annotation) -> str | None:
    if isinstance(annotation, PlainAnnotation):
        label = annotation.fields.get("label")
        return label if isinstance(label, str) else None
    return getattr(annotation, "label", None)


def _ego_if_needed(
    scene: Scene, regions: Iterable["_Region"], trajectory: str | None, heading: str | None
) -> EgoMotion | None:
    posed = [s for s in scene.sensors if isinstance(s, Posed)]
    on_ego = any(s.mount is not None or s.coordinates is Coordinates.EGO for s in posed)
    asked = any(region.frame is PointsFrame.EGO for region in regions)
    if trajectory is None and not asked and not (on_ego and scene.trajectories):
        return None
    return ego_motion_as_given(scene, name=trajectory, heading=heading)


# In space.


@dataclass(frozen=True, slots=True)
class _Region:
    """A box along the axes of a frame, or a ball around its origin, or what is in both."""

    frame: PointsFrame
    box: tuple[float, ...] | None = None  # least, then greatest x, y, z [m], faces included; None: all
    reach: float | None = None  # greatest distance from the origin [m]; None for any

    def __post_init__(self) -> None:
        box = self.box
        if box is not None and not (len(box) == 6 and all(a <= b for a, b in zip(box[:3], box[3:], strict=True))):
            raise OptionError(f"box {box}; expected xmin,ymin,zmin,xmax,ymax,zmax, each minimum at most the maximum")
        if self.reach is not None and not self.reach > 0:
            raise OptionError(f"range {self.reach}; expected a positive number of metres")

    def contains(self, points: FloatArray) -> BoolArray:
        """Report which points (..., 3) [m] of the frame lie in it; non-finite ones do not."""
        inside: BoolArray = np.asarray(np.isfinite(points).all(axis=-1))
        if self.box is not None:
            inside &= (points >= self.box[:3]).all(axis=-1) & (points <= self.box[3:]).all(axis=-1)
        if self.reach is not None:
            inside &= np.einsum("...i,...i->...", points, points) <= self.reach**2
        return inside


@dataclass(frozen=True, slots=True, eq=False)
class _Regions:
    """Regions that a point must be in all of, each with what takes positions into its frame; None: they are in it."""

    placed: tuple[tuple[_Region, FrameChange | None], ...]

    def contain(self, times_ns: Int64Array, positions: FloatArray) -> BoolArray:
        """Report which positions (M, V, 3) [m] at times (M,) lie inside; none do where a change is not known."""
        exact = np.asarray(positions, np.float64)
        inside = np.ones(exact.shape[:-1], np.bool_)
        for region, change in self.placed:
            inside &= region.contains(exact if change is None else change.positions(times_ns, exact))
        return inside

    def known(self, times_ns: Int64Array) -> Int64Array:
        """The rows of the times at which all changes are known."""
        known = np.ones(len(times_ns), np.bool_)
        for _, change in self.placed:
            known &= True if change is None else change.is_known(times_ns)
        return np.flatnonzero(known)

    @property
    def constant(self) -> bool:
        """Whether they are the same at all times."""
        return all(change is None or change.is_constant for _, change in self.placed)

    def __call__(self, frame: LidarFrame | RadarFrame) -> Int64Array:
        """The rows of a frame's points that lie inside."""
        times_ns = np.array([frame.timestamp_ns], np.int64)
        return np.flatnonzero(self.contain(times_ns, frame.points.positions[None])[0])


@dataclass(slots=True, eq=False)
class _SpaceCrop:
    """Crops one scene in space."""

    scene: Scene
    ego: EgoMotion | None
    regions: tuple[_Region, ...]
    on_points: OnPoints | None
    angles: CuboidAngles = field(init=False)
    frames_ns: Int64Array = field(init=False)
    changes: dict[Key, Renumbering] = field(default_factory=dict)
    warnings: list[DataWarning] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.angles, self.frames_ns = CuboidAngles.of(self.scene), frames_ns(self.scene)

    def cropped(self) -> Scene:
        sensors = tuple(self._sensor(sensor) for sensor in self.scene.sensors)
        around = self._around(annotations_frame(self.scene))
        cut = _with_annotations(self.scene, [self._annotation(around, one) for one in self.scene.annotations])
        annotations, reported = renumbered(cut.annotations, self.changes)
        return with_warnings(replace(cut, sensors=sensors, annotations=annotations), (*self.warnings, *reported))

    def _sensor(self, sensor: Sensor) -> Sensor:
        key = key_of(sensor.id)
        if isinstance(sensor, PointsSensor):
            sensor, self.changes[key] = with_map_points(sensor, np.flatnonzero(self._map_inside(sensor.positions)))
        elif isinstance(sensor, LidarSensor | RadarSensor):
            reach_ns = scene_period_ns(self.scene)
            changes = [points_change(self.scene, sensor, self.ego, r.frame, reach_ns=reach_ns) for r in self.regions]
            regions = _Regions(tuple(zip(self.regions, changes, strict=True)))
            numbers = regions.known(sensor.frames.timestamps_ns)
            lost, location = len(sensor.frames) - len(numbers), f"sensors[{sensor.id}].frames"
            what = "frames at whose time the ego trajectory is not known"
            self.warnings.append(skipped("frames-beyond-the-trajectory", location, what, count=lost))
            sensor, self.changes[key] = with_points(sensor, numbers, regions, self.on_points)
        return sensor

    def _around(self, old: Coordinates) -> list[_Regions]:
        """The regions for positions in the world or on the ego: around each lidar and radar, if in sensor frames."""
        if all(region.frame is not PointsFrame.SENSOR for region in self.regions):
            return [self._regions(old, None)]
        clouds = [s for s in self.scene.sensors if isinstance(s, LidarSensor | RadarSensor)]
        if not clouds:
            raise OptionError(f"{self.scene.source}: no lidar or radar in it whose frame or distance could be meant")
        return [self._regions(old, sensor) for sensor in clouds]

    def _regions(self, old: Coordinates, sensor: LidarSensor | RadarSensor | None) -> _Regions:
        placed = [
            (
                region,
                None
                if old.value == region.frame.value
                else FrameChange(self._in_world(PointsFrame(old.value), None), self._in_world(region.frame, sensor)),
            )
            for region in self.regions
        ]
        return _Regions(tuple(placed))

    def _in_world(self, frame: PointsFrame, sensor: LidarSensor | RadarSensor | None) -> PoseSource | None:
        """The pose of a frame in the world; None of the world itself."""
        reach_ns = scene_period_ns(self.scene)
        if frame is PointsFrame.WORLD:
            return None
        if sensor is not None and frame is PointsFrame.SENSOR:
            return sensor_source(self.scene, sensor, self.ego, reach_ns=reach_ns)
        ego = ego_motion_as_given(self.scene) if self.ego is None else self.ego
        return PoseSource(ego.path, RigidTransform.identity(), reach_ns)

    def _map_inside(self, positions: Float32Array) -> BoolArray:
        """Report which points of a map lie inside at any time."""
        inside = np.zeros(len(positions), np.bool_)
        for regions in self._around(Coordinates.WORLD):
            times_ns = np.zeros(1, np.int64) if regions.constant else self.frames_ns
            for k in regions.known(times_ns).tolist():
                left = np.flatnonzero(~inside)
                inside[left] = regions.contain(times_ns[k : k + 1], positions[None, left])[0]
        return inside

    def _annotation(self, around: list[_Regions], annotation: Annotation) -> Annotation | None:
        """Give the annotation, its path cut if it is a cuboid; None where it is never inside."""
        times: list[Int64Array] = []
        positions: list[Float64Array] = []
        stationary = bool(getattr(annotation, "stationary", None))
        match annotation:
            case CuboidAnnotation(path=path) if len(path.timestamps_ns):
                times = [self._looks(path.timestamps_ns, stationary=stationary)]
                positions = [cuboid_at(annotation, times[0], angles=self.angles)[0][:, None, 3:6]]
            case ShapeAnnotation(path=path) if annotation.dimensions == 3 and len(path.timestamps_ns):
                times = [self._looks(path.timestamps_ns, stationary=stationary)]
                found = shape_at(annotation, times[0])
                widest = max((len(vertices) for vertices in found if vertices is not None), default=0)
                positions = [np.full((len(found), widest, 3), np.nan)]
                for row, vertices in zip(positions[0], found, strict=True):
                    if vertices is not None:
                        row[: len(vertices)] = vertices
            case PointsAnnotation():
                paths = [p for p in annotation.paths if len(p.timestamps_ns) and p.values.shape[1] % 3 == 0]
                times = [self._looks(path.timestamps_ns, stationary=stationary) for path in paths]
                pairs = zip(paths, times, strict=True)
                positions = [locations_of(point_at(path, at, stationary=stationary)[0]) for path, at in pairs]
        inside = [
            np.any([regions.contain(at, there).any(axis=1) for regions in around], axis=0)
            for at, there in zip(times, positions, strict=True)
        ]
        if inside and not any(one.any() for one in inside):
            return None
        if not isinstance(annotation, CuboidAnnotation) or not inside or stationary or inside[0].all():
            return annotation
        return _cut_cuboid(annotation, *times[0][np.flatnonzero(inside[0])[[0, -1]]].tolist())

    def _looks(self, timestamps_ns: Int64Array, *, stationary: bool) -> Int64Array:
        """The times at which a path is looked at: of its keyframes and of the scene's frames."""
        times = self.frames_ns
        if not stationary:
            times = times[(times >= timestamps_ns.min()) & (times <= timestamps_ns.max())]
        return np.union1d(timestamps_ns, times)


def _cut_cuboid(annotation: CuboidAnnotation, first_ns: int, last_ns: int) -> CuboidAnnotation:
    """Cut a cuboid to a time, and one keyframe before and after it, so that nothing changes in between."""
    timestamps_ns = annotation.path.timestamps_ns
    first = max(int(np.searchsorted(timestamps_ns, first_ns, side="right")) - 1, 0)
    last = min(int(np.searchsorted(timestamps_ns, last_ns)), len(timestamps_ns) - 1)
    start_ns, stop_ns = timestamps_ns[[first, last]]

    def cut(entry: Any) -> Any:
        return select_rows(entry, (entry.timestamps_ns >= start_ns) & (entry.timestamps_ns <= stop_ns))

    return replace(
        annotation,
        path=select_rows(annotation.path, slice(first, last + 1)),
        activations=tuple(map(cut, annotation.activations)),
        projections=tuple(map(cut, annotation.projections)),
    )


# Lines of recordings that are kept as text.

_OTHER, _ANCHORS, _FRAMES = "other_lines", "other_seconds", "frame_lines"


def _cut_lines(scene: Scene, part: Interval | None) -> Mapping[str, Any]:
    """Metadata of what stays, without lines of times outside `part` [ns], and of sensors and trajectories gone.

    Nor is a file of labels kept as text, where times go.
    """
    # unknown lines stay where their time does, those without one where that of the line before does
    metadata, (labels, document) = dict(scene.metadata), WHOLE_LABELS
    if part is not None and isinstance(whole := metadata.get(labels), Mapping):
        metadata[labels] = {name: value for name, value in whole.items() if name != document}
    kept = metadata.get(LINES)
    if not isinstance(kept, Mapping):
        return MappingProxyType(metadata)
    there = {f"trajectories.{name}" for name in scene.trajectories}
    there |= {name for sensor in scene.sensors for name in streams_of(sensor)}
    changed = {**kept, **_other_lines(kept, part)}
    texts = kept.get(TEXTS)
    if isinstance(texts, Mapping):
        changed[TEXTS] = {
            name: {key: text for key, text in lines.items() if _is_key_inside(key, part)}
            for name, lines in texts.items()
            if name in there and isinstance(lines, Mapping)
        }
    if part is not None:
        changed.pop(_FRAMES, None)
    left = {name: value for name, value in changed.items() if value or value == kept.get(name)}
    return MappingProxyType({**metadata, LINES: MappingProxyType(left)})


def _other_lines(kept: Mapping[str, Any], part: Interval | None) -> dict[str, Any]:
    """Unknown lines, with the times of those that have none of their own."""
    lines, anchors = kept.get(_OTHER), kept.get(_ANCHORS)
    if part is None or not isinstance(lines, list):
        return {}
    seconds = anchors if isinstance(anchors, Mapping) else {}
    chosen = []
    for number, text in enumerate(lines):
        anchor = seconds.get(str(number))
        time = anchor if anchor is not None else _seconds_of(text)
        if time is None or part[0] <= round(time * 1e9) < part[1]:
            chosen.append((text, anchor))
    found = {str(number): anchor for number, (_, anchor) in enumerate(chosen) if anchor is not None}
    return {_OTHER: [text for text, _ in chosen], **({_ANCHORS: found} if _ANCHORS in kept else {})}


def _is_key_inside(key: str, part: Interval | None) -> bool:
    timestamp = key.partition("#")[0]
    return part is None or (timestamp.removeprefix("-").isdecimal() and part[0] <= int(timestamp) < part[1])


def _seconds_of(text: Any) -> float | None:
    try:
        line = json.loads(text)
    except (TypeError, ValueError, RecursionError):
        return None
    seconds = line.get("time") if isinstance(line, dict) else None
    return float(seconds) if isinstance(seconds, int | float) and abs(seconds) < 9.2e9 else None
