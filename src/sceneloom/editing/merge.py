"""Several scenes of one drive merged: whether they are of one drive, in one world and with one set of ids."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.editing.joined_sensors import (
    Joint,
    contradicting,
    differing_fields,
    is_same,
    joined_annotation,
    joined_attributes,
    joined_sensor,
    joined_trajectory,
)
from sceneloom.editing.move_points import FrameChange
from sceneloom.editing.move_world import moved_world
from sceneloom.editing.references import (
    OURS,
    NewIds,
    assumed,
    attributes_of,
    metadata_of,
    ours_of,
    recounted,
    skipped,
    with_annotation_ids,
    with_ours,
    with_sensor_ids,
    with_sensor_parent,
    with_warnings,
)
from sceneloom.errors import CalibrationError, DataError, OptionError
from sceneloom.geometry.geodesy import ecef_from_geodetic
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations import Annotation, CuboidAnnotation, CuboidPath, LabeledPointsAnnotation
from sceneloom.scene.annotations_at import CuboidAngles, annotations_frame
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor
from sceneloom.scene.clouds import LidarSensor, PointsSensor, RadarSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene, Sensor, frame_times
from sceneloom.scene.types import Coordinates, Identifier, Key, key_of
from sceneloom.warnings import DataWarning

_WORLD_FROM_FILE = "world_from_file"
"""Our entry of the metadata with the transform that an earlier edit took off all locations in the world."""

_SAME_WORLD = 1e-9
"""Transforms that differ by no more are one [m], [rad]."""


def _in_world_of(scene: Scene, first: Scene) -> Scene:
    """Give a scene in the world of another one, as far as their metadata report how the two are related.

    Raises:
        DataError: the metadata of one hold no rigid transform where they should.
    """
    mine, other = _world_from_file(scene), _world_from_file(first)
    if mine is None and other is None:
        return scene
    here = RigidTransform.identity() if mine is None else mine
    there = RigidTransform.identity() if other is None else other
    first_from_here = there.inverse() @ here
    reported = scene
    if mine is None or other is None:
        which = scene if mine is None else first
        what = "nothing says that its origin was moved; taken to be the world that the others were moved from"
        reported = with_warnings(scene, [assumed("worlds-related", which.source, what)])
    if np.abs(first_from_here.matrix - np.eye(4)).max() > _SAME_WORLD:
        reported = moved_world(reported, FrameChange.constant(first_from_here))
    entry = ours_of(first).get(_WORLD_FROM_FILE)
    return with_ours(reported, **{_WORLD_FROM_FILE: entry})


_CITY_WORDS = frozenset({"city", "city_name", "location", "map_name"})
"""Names of metadata that state where a drive was."""

_LONGEST_GAP_S = 3600.0
"""Parts of one drive are not further apart in time."""

_FASTEST = 100.0
"""No vehicle is faster [m/s]."""

_SAME_LOCATION = 100.0
"""How far apart fixes or poses of one ego may be at one time [m]: receivers and their antennas differ."""


def _different_drives(first: Scene, second: Scene) -> list[str]:
    """Report why two scenes in one world are not of one drive; empty where nothing speaks against it."""
    reasons = []
    here, there = _cities(first.metadata), _cities(second.metadata)
    if here and there and here.isdisjoint(there):
        reasons.append(f"it was in {', '.join(sorted(there))}, the other in {', '.join(sorted(here))}")
    spans = _span_ns(first), _span_ns(second)
    if None not in spans:
        gap_s = (max(span[0] for span in spans if span) - min(span[1] for span in spans if span)) / 1e9
        if gap_s > _LONGEST_GAP_S:
            reasons.append(f"{_duration(gap_s)} are between them")
    apart = _apart(_fixes(first), _fixes(second))
    if apart is not None:
        reasons.append(f"their satellite fixes are {apart / 1000:,.1f} km apart")
    apart = _apart(_ego(first), _ego(second))
    if apart is not None:
        reasons.append(f"their egos are {apart:,.0f} m apart at one time")
    return reasons


def _nothing_relates(first: Scene, second: Scene) -> bool:
    """Whether `_different_drives` had nothing to compare but times, which of clocks that begin at 0 state nothing."""
    pairs = (
        (_cities(first.metadata), _cities(second.metadata)),
        (_fixes(first), _fixes(second)),
        (_ego(first), _ego(second)),
    )
    return not any(here and there for here, there in pairs)


def _cities(metadata: Mapping[str, Any], depth: int = 0) -> set[str]:
    """What metadata call the location, in words without case."""
    found: set[str] = set()
    for name, value in metadata.items():
        if isinstance(value, str) and value.strip() and name.lower() in _CITY_WORDS:
            found.add(value.strip().casefold())
        elif isinstance(value, Mapping) and depth < 3:
            found |= _cities(value, depth + 1)
    return found


def _span_ns(scene: Scene) -> tuple[int, int] | None:
    times = [timestamps for sensor in scene.sensors if len(timestamps := frame_times(sensor))]
    times += [
        trajectory.timestamps_ns
        for trajectory in scene.trajectories.values()
        if len(trajectory.timestamps_ns)
    ]
    if not times:
        return None
    return min(int(timestamps.min()) for timestamps in times), max(
        int(timestamps.max()) for timestamps in times
    )


def _duration(seconds: float) -> str:
    return f"{seconds / 3600:,.1f} h" if seconds < 172_800 else f"{seconds / 86_400:,.0f} days"


_Track = tuple[Int64Array, Float64Array] | None
"""Times (N,) and locations (N, 3) [m]."""


def _fixes(scene: Scene) -> _Track:
    """The fixes of the first receiver on the ellipsoid, earth-centred."""
    for sensor in scene.sensors:
        if isinstance(sensor, GnssSensor) and len(sensor.timestamps_ns):
            lla = sensor.positions_lla
            known = np.isfinite(lla).all(axis=1) & (np.abs(lla[:, 0]) <= 90) & (np.abs(lla[:, 2]) < 1e5)
            if known.any():
                return sensor.timestamps_ns[known], ecef_from_geodetic(lla[known])
    return None


def _ego(scene: Scene) -> _Track:
    """The ego's trajectory, else that of the first sensor whose poses in the world are known, which is close to it."""
    found = [(trajectory.timestamps_ns, trajectory.positions) for trajectory in scene.trajectories.values()]
    for one in scene.sensors:
        if isinstance(one, LidarSensor | RadarSensor | CameraSensor) and one.coordinates is Coordinates.WORLD:
            path = one.poses
            found += [] if path is None or path.static else [(path.timestamps_ns, path.positions)]
    if not found or not len(found[0][0]) or not np.isfinite(found[0][1]).all():
        return None
    return found[0]


def _apart(first: _Track, second: _Track) -> float | None:
    """How far apart two ways are where an ego cannot be on both [m]; None where it can."""
    if first is None or second is None:
        return None
    (times, locations), (other_times, other_locations) = first, second
    inside = (other_times >= times[0]) & (other_times <= times[-1])
    if inside.any():
        with np.errstate(over="ignore", invalid="ignore"):
            at = other_times[inside]
            expected = np.column_stack([np.interp(at, times, locations[:, axis]) for axis in range(3)])
            apart = float(np.median(np.linalg.norm(other_locations[inside] - expected, axis=1)))
        return apart if apart > _SAME_LOCATION else None
    early, late = ((times, locations), (other_times, other_locations))
    if other_times[-1] < times[0]:
        early, late = late, early
    with np.errstate(over="ignore"):
        apart = float(np.linalg.norm(late[1][0] - early[1][-1]))
    gap_s = (int(late[0][0]) - int(early[0][-1])) / 1e9
    return apart if gap_s >= 0 and apart > _SAME_LOCATION + _FASTEST * gap_s else None


def _world_from_file(scene: Scene) -> RigidTransform | None:
    """The transform that was taken off a scene's locations; None where none is named.

    Raises:
        DataError: what is named is no rigid transform.
    """
    named: Any = ours_of(scene).get(_WORLD_FROM_FILE)
    if named is None:
        return None
    location = f"metadata.sceneloom.{_WORLD_FROM_FILE}"
    try:
        matrix: Float64Array = np.array(named, np.float64)
        return RigidTransform.nearest(matrix)[0]
    except (TypeError, ValueError, CalibrationError):
        raise DataError(scene.source, location, f"{named!r}; expected a rigid 4x4 matrix") from None


def _in_words_of(scene: Scene, first: Scene) -> Scene:
    """Give a scene whose cuboids have their angles in the unit and order of another one.

    Raises:
        OptionError: the annotations of one are in the world and those of the other on the ego.
    """
    frames = {annotations_frame(one) for one in (scene, first) if one.annotations}
    if len(frames) > 1:
        raise OptionError(
            f"{scene.source}: its annotations are in the {annotations_frame(scene)} frame, those of {first.source} in "
            f"the {annotations_frame(first)} frame; bring both into the world first: `sceneloom edit to-world`"
        )
    mine, theirs = CuboidAngles.of(scene), CuboidAngles.of(first)
    there = any(isinstance(annotation, CuboidAnnotation) for annotation in scene.annotations)
    if mine == theirs or not there:
        return scene
    annotations = tuple(_stated_otherwise(annotation, mine, theirs) for annotation in scene.annotations)
    changed = replace(scene, annotations=annotations)
    return with_ours(changed, euler_unit=str(theirs.unit), euler_order=theirs.order)


def _stated_otherwise(annotation: Annotation, mine: CuboidAngles, theirs: CuboidAngles) -> Annotation:
    if not isinstance(annotation, CuboidAnnotation):
        return annotation
    path = annotation.path
    return replace(
        annotation,
        path=CuboidPath(path.timestamps_ns, _rows(path.values, mine, theirs), path.extras),
        activations=tuple(
            entry if entry.cuboids is None else replace(entry, cuboids=_rows(entry.cuboids, mine, theirs))
            for entry in annotation.activations
        ),
        projections=tuple(
            entry if entry.cuboids is None else replace(entry, cuboids=_rows(entry.cuboids, mine, theirs))
            for entry in annotation.projections
        ),
    )


def _rows(rows: Float64Array, mine: CuboidAngles, theirs: CuboidAngles) -> Float64Array:
    stated = rows.copy()
    there = np.isfinite(rows[:, 6:]).all(axis=1)
    stated[there, 6:] = theirs.from_quaternions(mine.quaternions(rows[there, 6:]))
    return stated


def _merged_metadata(first: Mapping[str, Any], second: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """The fields of both; of those that differ the first's. Gives the names of these, too."""
    differing = [name for name in first.keys() & second.keys() if not is_same(first[name], second[name])]
    return {**second, **first}, sorted(differing)


_SHARED = (OdometrySensor, ImuSensor, GnssSensor, PointsSensor)
"""What several scenes of one drive may each bring along; where it is the same, it stands in the merged scene once."""

_LISTED = ("deskew", "unfused", "extrapolated", "to_ego", "applied")
"""Our entries of the metadata that are lists, of which a merged scene has all."""


def merge_scenes(
    scenes: Sequence[Scene], *, rename: bool = False, join: bool = False, force: bool = False
) -> Scene:
    """Make one scene of several of one drive on one clock.

    Scenes whose metadata state which world they were moved from are brought into the first one's. References follow the
    ids of sensors and annotations that change, and points name the cameras by their new locations. The ego trajectory,
    an IMU, a receiver or a map that is the same in several scenes is taken once.

    Args:
        scenes: two or more; what differs and can stand once only is the first one's, with a warning.
        rename: give new ids to sensors and annotations whose ids stand in an earlier scene, instead of refusing them.
        force: merge scenes, too, that are of different drives by their cities, times, fixes or ego poses; each reason
            is a warning then.
        join: take sensors and annotations of equal ids for consecutive parts of one: frames, poses and paths go on;
            frames with equal timestamps and points are taken once.

    Raises:
        OptionError: there are fewer than two, they are of different drives, or ids, worlds or parts do not go together.
        DataError: a frame that this needs cannot be read.
    """
    if len(scenes) < 2:
        raise OptionError(f"{len(scenes)} scene to merge; expected two or more")
    merged = scenes[0]
    for scene in scenes[1:]:
        placed = _in_world_of(scene, merged)
        reasons = _different_drives(merged, placed)
        if reasons and not force:
            raise OptionError(
                f"{scene.source}: of another drive than {merged.source}: {'; '.join(reasons)}; expected parts of one "
                "drive in one world; state `--force` to merge them all the same"
            )
        unrelated = not reasons and _nothing_relates(merged, placed)
        placed = _in_words_of(placed, merged)
        reported = [
            assumed("different-drives", scene.source, f"merged all the same: {why}") for why in reasons
        ]
        if unrelated:
            what = (
                "no city, satellite fixes or ego poses to compare with the others; taken to be of one drive"
            )
            reported.append(assumed("drives-unrelated", scene.source, what))
        placed = with_warnings(placed, reported)
        merged = _Merger(merged, rename=rename, join=join).with_scene(placed)
    return replace(
        merged,
        source=" + ".join(scene.source for scene in scenes),
        on_close=partial(_close, tuple(scene.on_close for scene in scenes)),
    )


def _close(closing: tuple[Callable[[], None], ...]) -> None:
    for close in closing:
        close()


@dataclass(slots=True, eq=False)
class _Merger:
    """Takes one more scene into a scene."""

    first: Scene
    rename: bool
    join: bool
    sensor_ids: dict[Key, Identifier | None] = field(default_factory=dict)
    annotation_ids: dict[Key, Identifier | None] = field(default_factory=dict)
    joints: dict[Key, Joint] = field(default_factory=dict)
    warnings: list[DataWarning] = field(default_factory=list)

    def with_scene(self, scene: Scene) -> Scene:
        self._choose_sensor_ids(scene)
        ids = NewIds(self.sensor_ids)
        renamed = tuple(with_sensor_parent(sensor, ids) for sensor in scene.sensors)
        sensors = self._sensors(scene, renamed)
        moved = [self._follows(annotation, ids) for annotation in scene.annotations]
        first = self._first_annotations()
        annotations = self._annotations(scene, first, [found for found in moved if found is not None])
        stated = attributes_of(scene.attributes, ids)
        attributes = joined_attributes(self.first.attributes, stated)
        extras, differing = _merged_metadata(self.first.extras, scene.extras)
        self._report_differing("", (*contradicting(self.first.attributes, stated), *differing))
        metadata = self._metadata(scene, ids)
        merged = replace(
            self.first,
            sensors=sensors,
            annotations=annotations,
            trajectories=self._trajectories(scene),
            attributes=attributes,
            metadata=metadata,
            extras=MappingProxyType(extras),
        )
        new = [warning for warning in scene.warnings if warning not in self.first.warnings]
        return with_warnings(merged, (*new, *self.warnings))

    def _location(self, scene: Scene, kind: str, identifier: Identifier) -> str:
        return f"{scene.source}: {kind}[{identifier!r}]"

    def _choose_sensor_ids(self, scene: Scene) -> None:
        """Find the new id of each sensor whose id stands in the first scene; one that is joined or shared keeps it."""
        taken = {key_of(sensor.id): sensor for sensor in self.first.sensors}
        used = set(taken) | {key_of(sensor.id) for sensor in scene.sensors}
        for sensor in scene.sensors:
            known = taken.get(key_of(sensor.id))
            if known is None or self.join or _shared(known, sensor):
                continue
            if not self.rename:
                raise OptionError(
                    f"{self._location(scene, 'sensors', sensor.id)}: this id stands in {self.first.source}, too; state "
                    "`--rename` to give it another, or `--join` if the two are parts of one sensor"
                )
            self.sensor_ids[key_of(sensor.id)] = _free(sensor.id, used)

    def _sensors(self, scene: Scene, renamed: tuple[Sensor, ...]) -> tuple[Sensor, ...]:
        """The sensors of both; cameras first in the order of the first scene, as points name them."""
        known = {key_of(sensor.id): k for k, sensor in enumerate(self.first.sensors)}
        further = [sensor for sensor in renamed if key_of(sensor.id) not in known]
        cameras = [s for s in (*self.first.sensors, *further) if isinstance(s, CameraSensor)]
        locations = {key_of(camera.id): location for location, camera in enumerate(cameras)}
        old = [camera for camera in renamed if isinstance(camera, CameraSensor)]
        numbers = {k: locations[key_of(camera.id)] for k, camera in enumerate(old)}
        sensors = list(self.first.sensors)
        for sensor in renamed:
            counted = _recounted(sensor, numbers)
            k = known.get(key_of(sensor.id))
            if k is None:
                sensors.append(counted)
            elif self.join:
                sensors[k] = self._joined(scene, sensors[k], counted)
            else:
                what = "the same in both scenes; taken once"
                self.warnings.append(assumed("same-sensor", f"sensors[{sensor.id}]", what))
        return tuple(sensors)

    def _joined(self, scene: Scene, first: Sensor, second: Sensor) -> Sensor:
        location = self._location(scene, "sensors", second.id)
        joined, joint = joined_sensor(first, second, location)
        self._report_differing(f"sensors[{second.id}].", differing_fields(first, second))
        if joint is not None:
            self.joints[key_of(second.id)] = joint
            what = "frames that are in both scenes; taken once"
            self.warnings.append(skipped("frames-twice", f"sensors[{second.id}]", what, count=joint.twice))
        if (
            isinstance(first, CameraSensor | DepthCameraSensor)
            and isinstance(joined, CameraSensor | DepthCameraSensor)
            and first.video is not joined.video
        ):
            what = "the videos of parts cannot be joined; its images are taken one by one"
            self.warnings.append(assumed("video-in-images", f"sensors[{second.id}].video", what))
        return joined

    def _report_differing(self, where: str, names: Iterable[str], *, code: str = "fields-differ") -> None:
        what = "differs between the scenes; that of the first is kept"
        self.warnings.extend(skipped(code, f"{where}{name}", what) for name in names)

    def _first_annotations(self) -> list[Annotation]:
        numbers = {key: joint.first for key, joint in self.joints.items()}
        return [_renumbered(annotation, numbers) for annotation in self.first.annotations]

    def _follows(self, annotation: Annotation, ids: NewIds) -> Annotation | None:
        """An annotation of the second scene by the new ids of its sensors and the new numbers of its frames."""
        named = with_sensor_ids(annotation, ids)
        numbers = {key: joint.second for key, joint in self.joints.items()}
        return None if named is None else _renumbered(named, numbers)

    def _annotations(
        self, scene: Scene, first: list[Annotation], second: list[Annotation]
    ) -> tuple[Annotation, ...]:
        known = {key_of(annotation.id): k for k, annotation in enumerate(first)}
        used = set(known) | {key_of(annotation.id) for annotation in second}
        joined: set[Key] = set()
        for annotation in second:
            key = key_of(annotation.id)
            if key not in known:
                continue
            location = self._location(scene, "annotations", annotation.id)
            if self.join and first[known[key]].type == annotation.type:
                joined.add(key)
                part = first[known[key]]
                first[known[key]] = joined_annotation(part, annotation, location)
                self._report_differing(f"annotations[{annotation.id}].", differing_fields(part, annotation))
            elif self.rename:
                self.annotation_ids[key] = _free(annotation.id, used)
            else:
                raise OptionError(f"{location}: this id stands in {self.first.source}, too; state `--rename`")
        ids = NewIds(self.annotation_ids)
        further = [with_annotation_ids(a, ids) for a in second if key_of(a.id) not in joined]
        return (*first, *(annotation for annotation in further if annotation is not None))

    def _trajectories(self, scene: Scene) -> Mapping[str, Trajectory]:
        trajectories = dict(self.first.trajectories)
        for name, trajectory in scene.trajectories.items():
            renamed = NewIds(self.sensor_ids)(name)
            new = name if renamed is None else str(renamed)
            known = trajectories.get(new)
            if known is None:
                trajectories[new] = replace(trajectory, name=new)
            elif self.join:
                trajectories[new] = joined_trajectory(known, trajectory)
            elif not is_same(known, trajectory):
                if not self.rename:
                    raise OptionError(
                        f"{scene.source}: trajectories[{name}]: another way of that name stands in "
                        f"{self.first.source}; state `--rename` to give it another name, or `--join` if the two are "
                        f"parts"
                    )
                new = str(_free(name, {key_of(other) for other in trajectories}))
                trajectories[new] = replace(trajectory, name=new)
        return trajectories

    def _metadata(self, scene: Scene, ids: NewIds) -> Mapping[str, Any]:
        mine, other = ours_of(self.first), metadata_of(ours_of(scene), ids)
        free = [{name: v for name, v in s.metadata.items() if name != OURS} for s in (self.first, scene)]
        merged, differing = _merged_metadata(free[0], free[1])
        ours, ours_differing = _merged_metadata(mine, other)
        for name in _LISTED:
            lists = [stated[name] for stated in (mine, other) if isinstance(stated.get(name), list)]
            if len(lists) == 2:
                ours[name] = [*lists[0], *(entry for entry in lists[1] if entry not in lists[0])]
        ours.update(_fusion(mine, other))
        reported = [
            *differing,
            *(f"{OURS}.{name}" for name in ours_differing if name not in (*_LISTED, "fusion")),
        ]
        self._report_differing("metadata.", reported, code="metadata-differ")
        return MappingProxyType({**merged, **({OURS: ours} if ours else {})})


def _fusion(mine: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """What the first fusion stated, with the cameras of both in the order that points name them by."""
    stated = [entry.get("fusion") for entry in (mine, other)]
    if not all(isinstance(entry, Mapping) and isinstance(entry.get("cameras"), list) for entry in stated):
        return {}
    cameras = list(stated[0]["cameras"])  # type: ignore[index]
    cameras += [camera for camera in stated[1]["cameras"] if camera not in cameras]  # type: ignore[index]
    return {"fusion": {**stated[0], "cameras": cameras}}  # type: ignore[dict-item]


def _shared(known: Sensor, sensor: Sensor) -> bool:
    return isinstance(sensor, _SHARED) and is_same(known, sensor)


def _recounted(sensor: Sensor, numbers: dict[int, int]) -> Sensor:
    same = all(old == new for old, new in numbers.items())
    return sensor if same or not isinstance(sensor, LidarSensor) else recounted(sensor, numbers)


def _free(identifier: Identifier, used: set[Key]) -> Identifier:
    """A new id that is not used, and now is."""
    number = 2
    if isinstance(identifier, int):
        new: Identifier = 1 + max(value for _, value in used if isinstance(value, int))
    else:
        while (str, f"{identifier}-{number}") in used:
            number += 1
        new = f"{identifier}-{number}"
    used.add(key_of(new))
    return new


def _renumbered(annotation: Annotation, numbers: Mapping[Key, Int64Array]) -> Annotation:
    """Give labelled points by the new numbers of their frames."""
    if not isinstance(annotation, LabeledPointsAnnotation) or not numbers:
        return annotation
    entries = []
    for entry in annotation.labeled_points:
        new = numbers.get(key_of(entry.sensor_id))
        frame = entry.sensor_frame
        known = new is not None and frame is not None and 0 <= frame < len(new)
        entries.append(replace(entry, sensor_frame=int(new[frame])) if known else entry)  # type: ignore[index]
    return replace(annotation, labeled_points=tuple(entries))
