"""Several scenes of one drive made one."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType
from typing import Any

from sceneloom.arrays import Int64Array
from sceneloom.editing.camera_index import recounted
from sceneloom.editing.joined_annotations import joined_annotation, joined_attributes
from sceneloom.editing.joined_sensors import Joint, joined_sensor, joined_trajectory
from sceneloom.editing.record import OURS, assumed, ours_of, skipped, with_warnings
from sceneloom.editing.references import (
    NewIds,
    attributes_of,
    metadata_of,
    with_annotation_ids,
    with_sensor_ids,
    with_sensor_parent,
)
from sceneloom.editing.same_world import (
    different_drives,
    in_words_of,
    in_world_of,
    merged_metadata,
    nothing_relates,
)
from sceneloom.editing.sameness import contradicting, differing_fields, is_same
from sceneloom.errors import OptionError
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.labelled_points import LabeledPointsAnnotation
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, PointsSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import Identifier, Key, key_of
from sceneloom.scene.warnings import DataWarning

SHARED = (OdometrySensor, ImuSensor, GnssSensor, PointsSensor)
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
        placed = in_world_of(scene, merged)
        reasons = different_drives(merged, placed)
        if reasons and not force:
            raise OptionError(
                f"{scene.source}: of another drive than {merged.source}: {'; '.join(reasons)}; expected parts of one "
                "drive in one world; state `--force` to merge them all the same"
            )
        unrelated = not reasons and nothing_relates(merged, placed)
        placed = in_words_of(placed, merged)
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
        extras, differing = merged_metadata(self.first.extras, scene.extras)
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
        merged, differing = merged_metadata(free[0], free[1])
        ours, ours_differing = merged_metadata(mine, other)
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
    return isinstance(sensor, SHARED) and is_same(known, sensor)


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
