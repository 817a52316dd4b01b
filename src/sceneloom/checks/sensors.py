"""Rules about sensors, ids and references: content, parents, order of streams, and that what is named exists."""

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.checks.rule import ERROR, HINT, WARNING, Hit, Rule, Subject, unless_recording
from sceneloom.formats.sfs.schema import ANNOTATION_RECORDS, SENSOR_RECORDS
from sceneloom.scene.annotations import (
    Activation,
    Annotation,
    AttributePath,
    Box2DAnnotation,
    CameraCalibration,
    CuboidAnnotation,
    GroupAnnotation,
    LabeledPoints,
    LinkAnnotation,
    ObjectAnnotation,
    PlainAnnotation,
    PointProjection,
    PointsAnnotation,
    Projection,
    ShapeAnnotation,
)
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, PointsSensor, RadarSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor, PlainSensor
from sceneloom.scene.scene import Posed, Sensor, frames_of
from sceneloom.scene.types import Identifier, key_of

Key = tuple[type, Identifier]
_EMPTYING = frozenset({"missing-videos", "unreadable-videos", "unmatched-images"})
"""Faults of a recording that leave a camera without images."""


@dataclass(frozen=True, slots=True)
class _SensorMention:
    """A location that names a sensor."""

    number: int  # of the annotation
    suffix: str  # where in it (`.projections[1].sensor_id`)
    sensor_id: Identifier
    annotation: Annotation
    part: Any  # what names it: the annotation, an activation, projection, attribute, or labelled points


def _sensor_mentions(subject: Subject) -> list[_SensorMention]:
    """All locations in annotations that name a sensor."""
    return subject.table("mentions of sensors", lambda inner: list(_mentions(inner)))


_NAMING_PARTS = ("activations", "projections", "attributes", "labeled_points")


def _mentions(subject: Subject) -> Iterator[_SensorMention]:
    for number, annotation in enumerate(subject.scene.annotations):
        own = getattr(annotation, "sensor_id", None)
        if own is not None:
            yield _SensorMention(number, ".sensor_id", own, annotation, annotation)
        for name in _NAMING_PARTS:
            for k, part in enumerate(getattr(annotation, name, ())):
                for inside, named in _naming(part):
                    yield _SensorMention(number, f".{name}[{k}]{inside}.sensor_id", named.sensor_id, annotation, named)


def _naming(part: Any) -> Iterator[tuple[str, Any]]:
    """The parts of a part that name a sensor: the points of a points annotation have several projections each."""
    if isinstance(part, tuple):
        yield from ((f"[{k}]", inner) for k, inner in enumerate(part))
    elif part.sensor_id is not None:
        yield "", part


def _nothing(subject: Subject) -> Iterator[Hit]:
    if subject.holds_nothing:
        yield Hit("sensors", "neither a sensor nor an annotation nor a trajectory")


def _count(sensor: Sensor) -> int | None:
    """How much a sensor has measured; None where that cannot be stated, and for poses, of which there is always one."""
    if isinstance(sensor, Posed):
        return len(frames_of(sensor))
    if isinstance(sensor, PointsSensor):
        return len(sensor.positions)
    if isinstance(sensor, ImuSensor):
        return sum(map(len, sensor.streams.values()))
    return len(sensor.timestamps_ns) if isinstance(sensor, GnssSensor) else None


def _empty(subject: Subject) -> Iterator[Hit]:
    """Sensors without content; those that annotations name belong to a scene whose data are elsewhere."""
    # cameras of a recording are passed over where each of them has a fault of its video that says why it is empty
    named = {(type(mention.sensor_id), mention.sensor_id) for mention in _sensor_mentions(subject)}
    empty = [
        (path, sensor) for path, sensor in subject.sensors() if _count(sensor) == 0 and key_of(sensor.id) not in named
    ]
    reported = sum(fault.code in _EMPTYING for fault in subject.faults)
    explained = sum(isinstance(sensor, CameraSensor) for _, sensor in empty) <= reported
    for path, sensor in empty:
        if not (explained and isinstance(sensor, CameraSensor)):
            what = "images" if isinstance(sensor, CameraSensor) else "measurements"
            yield Hit(path, f"{sensor.type} {sensor.id!r} has no {what}")


def _unknown_sensor_types(subject: Subject) -> Iterator[Hit]:
    return _unknown_of(subject.sensors_of(PlainSensor), tuple(SENSOR_RECORDS))


def _unknown_of(parts: Iterator[tuple[str, Any]], known: Sequence[str]) -> Iterator[Hit]:
    for path, part in parts:
        near = get_close_matches(str(part.type).casefold(), known, n=1)
        hint = f", which is like {near[0]!r}" if near else ""
        yield Hit(f"{path}.type", f"{part.type!r}{hint}; its fields are kept and not used")


def _similar_ids(subject: Subject) -> Iterator[Hit]:
    seen: dict[str, Identifier] = {}
    for path, sensor in subject.sensors():
        other = seen.setdefault(str(sensor.id), sensor.id)
        if type(other) is not type(sensor.id):
            yield Hit(f"{path}.id", f"{sensor.id!r} beside {other!r}: a number and a text that look alike")


def _dangling_parents(subject: Subject) -> Iterator[Hit]:
    for path, sensor in subject.sensors():
        parent_id = sensor.parent_id
        if parent_id is None or subject.is_left_out("sensors", parent_id):
            continue
        if not subject.has_sensor(parent_id):
            known = ", ".join(repr(other.id) for other in subject.scene.sensors[:10])
            yield Hit(f"{path}.parent_id", f"{parent_id!r} is no sensor of the scene; it has {known}")


def _sensor_cycles(subject: Subject) -> Iterator[Hit]:
    parents: dict[Key, Key] = {
        key_of(s.id): (type(s.parent_id), s.parent_id) for s in subject.scene.sensors if s.parent_id is not None
    }
    for path, sensor in subject.sensors():
        start: Key = key_of(sensor.id)
        trajectory, at = [start], parents.get(start)
        while at is not None and at not in trajectory:
            trajectory.append(at)
            at = parents.get(at)
        if at == start:
            names = " in ".join(repr(identifier) for _, identifier in [*trajectory, start])
            yield Hit(f"{path}.parent_id", f"a cycle: {names}")


def _streams(subject: Subject) -> Iterator[tuple[str, Int64Array, Float64Array]]:
    for path, sensor in subject.sensors():
        if isinstance(sensor, ImuSensor):
            for name, stream in sensor.streams.items():
                yield f"{path}.streams.{name}", stream.timestamps_ns, stream.values
        elif isinstance(sensor, GnssSensor):
            yield path, sensor.timestamps_ns, sensor.positions_lla


def _disordered_samples(subject: Subject) -> Iterator[Hit]:
    for path, timestamps_ns, _ in _streams(subject):
        wrong = np.flatnonzero(timestamps_ns[1:] <= timestamps_ns[:-1])
        if len(wrong):
            k = int(wrong[0]) + 1
            problem = f"{timestamps_ns[k]} ns after {timestamps_ns[k - 1]} ns; expected a later time than that before"
            yield Hit(f"{path}.timestamps_ns[{k}]", problem, len(wrong))


def _infinite_samples(subject: Subject) -> Iterator[Hit]:
    for path, _, values in _streams(subject):
        wrong = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if len(wrong):
            row = values[wrong[0]].tolist()
            yield Hit(f"{path}.values[{wrong[0]}]", f"{row}; expected finite numbers", len(wrong))


def _off_the_earth(subject: Subject) -> Iterator[Hit]:
    for path, sensor in subject.sensors_of(GnssSensor):
        latitudes, longitudes = sensor.positions_lla[:, 0], sensor.positions_lla[:, 1]
        wrong = np.flatnonzero((np.abs(latitudes) > 90) | (np.abs(longitudes) > 180))
        if len(wrong):
            k = wrong[0]
            problem = f"latitude {latitudes[k]}, longitude {longitudes[k]}; expected at most 90 and 180 degrees"
            yield Hit(f"{path}.positions_lla[{k}]", problem, len(wrong))


# fmt: off
SENSOR_RULES: tuple[Rule, ...] = (
    Rule("scene-not-empty", WARNING, "A scene has a sensor, an annotation or a trajectory.",
         "See whether the sensors stand where the format wants them.", find=_nothing),
    Rule("sensor-empty", WARNING, "Every sensor has frames, images, points or samples, or annotations name it.",
         "Leave the sensor out if it is not used, or find its data.", find=_empty),
    Rule("sensor-type-known", WARNING, "Every sensor is of a type that the format lists.",
         "Use one of points, lidar, radar, camera and odometry; other programs may refuse the file.",
         find=_unknown_sensor_types),
    Rule("sensor-ids-distinct", HINT, "No two ids of sensors differ only in being a number and a text.",
         "Use one kind: programs that compare ids as texts take both for one.", find=_similar_ids),
    Rule("sensor-parent-known", ERROR, "The parent of a sensor is a sensor of the scene.",
         'Name the parent by its id, of the same type (1 is not "1"), or leave `parent_id` out.',
         find=_dangling_parents),
    Rule("sensor-parent-cycle", ERROR, "No sensor is its own parent, directly or over others.",
         "Leave `parent_id` out of one of them.", find=_sensor_cycles),
    Rule("sample-times-increasing", WARNING,
         "Samples of inertial sensors and fixes of satellite receivers have strictly increasing times.",
         "Sort them, and leave out those that stand there twice.", find=unless_recording(_disordered_samples)),
    Rule("samples-finite", WARNING,
         "Samples of inertial sensors and fixes of satellite receivers hold finite numbers only.",
         "Leave the sample out.", find=_infinite_samples),
    Rule("gnss-on-earth", ERROR, "Latitudes lie within 90 degrees, longitudes within 180.",
         "See whether latitude and longitude are exchanged, or given in another unit than degrees.",
         find=unless_recording(_off_the_earth)),
)
# fmt: on


def _known_ids(subject: Subject) -> Mapping[Key, int]:
    return subject.table(
        "numbers of annotations by id", lambda inner: {key_of(a.id): k for k, a in enumerate(inner.scene.annotations)}
    )


def _unknown(kind: str, identifier: Identifier, known: Mapping[Key, Any]) -> str:
    """Report that nothing has this id, and whether something has it as text instead of a number."""
    twin: Identifier | None = str(identifier) if isinstance(identifier, int) else None
    if isinstance(identifier, str) and identifier.isascii() and identifier.isdigit() and len(identifier) <= 18:
        twin = int(identifier)  # ids with more digits than any counter has are not looked at
    if twin is not None and key_of(twin) in known:
        return f"{identifier!r} is no {kind}; there is one {twin!r}, which is another id"
    return f"{identifier!r} is no {kind} of the scene"


def _unknown_annotation_types(subject: Subject) -> Iterator[Hit]:
    return _unknown_of(subject.annotations_of(PlainAnnotation), tuple(ANNOTATION_RECORDS))


def _unknown_parents(subject: Subject) -> Iterator[Hit]:
    known = _known_ids(subject)
    for path, annotation in subject.annotations():
        parent_id = annotation.parent_id
        if parent_id is None or key_of(parent_id) in known or subject.is_left_out("annotations", parent_id):
            continue
        yield Hit(f"{path}.parent_id", _unknown("annotation", parent_id, known))


def _annotation_cycles(subject: Subject) -> Iterator[Hit]:
    """Follow each annotation's parents; one that is met again on the same way lies on a cycle."""
    known, annotations = _known_ids(subject), subject.scene.annotations
    settled: set[int] = set()
    for start in range(len(annotations)):
        trajectory: dict[int, None] = {}
        number: int | None = start
        while number is not None and number not in settled and number not in trajectory:
            trajectory[number] = None
            parent_id = annotations[number].parent_id
            number = None if parent_id is None else known.get(key_of(parent_id))
        if number is not None and number in trajectory:
            cycle = list(trajectory)[list(trajectory).index(number) :]
            names = " in ".join(repr(annotations[k].id) for k in [*cycle[:5], number])
            more = f" (and {len(cycle) - 5} more between)" if len(cycle) > 5 else ""
            yield Hit(f"{subject.annotation_paths[number]}.parent_id", f"{names}{more}; expected no cycle")
        settled.update(trajectory)


def _unknown_sensors(subject: Subject) -> Iterator[Hit]:
    known = {key_of(sensor.id): sensor for sensor in subject.scene.sensors}
    named = [(_location(subject, mention), mention.sensor_id) for mention in _sensor_mentions(subject)]
    for k, attribute in enumerate(subject.scene.attributes):
        if attribute.sensor_id is not None:
            named.append((f"attributes[{k}].sensor_id", attribute.sensor_id))
    for location, sensor_id in named:
        if key_of(sensor_id) not in known and not subject.is_left_out("sensors", sensor_id):
            yield Hit(location, _unknown("sensor", sensor_id, known))


def _several_for_a_sensor(subject: Subject) -> Iterator[Hit]:
    """Activations, and projections of a cuboid or of one point, of which a sensor has more than one."""
    for path, annotation in subject.annotations():
        for location, parts in _parts_of_sensors(path, annotation):
            first: dict[Key, int] = {}
            for k, part in enumerate(parts):
                before = first.setdefault(key_of(part.sensor_id), k)
                if before != k:
                    problem = f"{part.sensor_id!r} has one already, at [{before}]; expected one for each sensor"
                    yield Hit(f"{location}[{k}].sensor_id", problem)


def _parts_of_sensors(path: str, annotation: Annotation) -> Iterator[tuple[str, Sequence[Any]]]:
    if isinstance(annotation, CuboidAnnotation):
        yield f"{path}.activations", annotation.activations
        yield f"{path}.projections", annotation.projections
    elif isinstance(annotation, PointsAnnotation):
        for k, of_point in enumerate(annotation.projections):
            yield f"{path}.projections[{k}]", of_point


def _location(subject: Subject, mention: _SensorMention) -> str:
    return subject.annotation_paths[mention.number] + mention.suffix


_CLOUDS = (LidarSensor, RadarSensor, PointsSensor)


def _wrong_sensors(subject: Subject) -> Iterator[Hit]:
    for mention in _sensor_mentions(subject):
        sensor = subject.sensor(mention.sensor_id)
        expected = _expected_sensor(mention.part)
        if sensor is None or expected is None or isinstance(sensor, PlainSensor):
            continue
        classes, word = expected
        if not isinstance(sensor, classes):
            yield Hit(_location(subject, mention), f"{mention.sensor_id!r} is {_a(sensor)}; expected {word}")


def _expected_sensor(part: Any) -> tuple[tuple[type, ...], str] | None:
    """Which sensors a part can be about, and in words; None: any."""
    if isinstance(part, Projection | PointProjection | Box2DAnnotation | CameraCalibration):
        return (CameraSensor,), "a camera"
    if isinstance(part, ShapeAnnotation) and part.dimensions == 2:
        return (CameraSensor,), "a camera"
    if isinstance(part, Activation):
        return (LidarSensor, RadarSensor, CameraSensor), "a lidar, a radar or a camera"
    return (_CLOUDS, "a sensor with points") if isinstance(part, LabeledPoints) else None


def _a(sensor: Sensor) -> str:
    word = str(sensor.type)
    return f"{'an' if word[:1] in 'aeiou' else 'a'} {word}"


def _unknown_link_ends(subject: Subject) -> Iterator[Hit]:
    known = _known_ids(subject)
    for path, link in subject.annotations_of(LinkAnnotation):
        for name in ("from_id", "to_id"):
            identifier = getattr(link, name)
            if key_of(identifier) not in known and not subject.is_left_out("annotations", identifier):
                yield Hit(f"{path}.{name}", _unknown("annotation", identifier, known))


def _links_to_themselves(subject: Subject) -> Iterator[Hit]:
    for path, link in subject.annotations_of(LinkAnnotation):
        if key_of(link.from_id) == key_of(link.to_id):
            yield Hit(path, f"leads from {link.from_id!r} to itself; expected two annotations")
        elif key_of(link.id) in (key_of(link.from_id), key_of(link.to_id)):
            yield Hit(path, f"one end is the link {link.id!r} itself; expected two other annotations")


def _unused(subject: Subject) -> Iterator[Hit]:
    used = {key_of(a.parent_id) for a in subject.scene.annotations if a.parent_id is not None}
    for _, link in subject.annotations_of(LinkAnnotation):
        used |= {key_of(link.from_id), key_of(link.to_id)}
    for path, annotation in subject.annotations():
        says_nothing = isinstance(annotation, ObjectAnnotation | GroupAnnotation) and not annotation.attributes
        if says_nothing and key_of(annotation.id) not in used:
            yield Hit(path, f"the {annotation.type} {annotation.id!r} has no members, no links and no attributes")


def _unknown_points(subject: Subject) -> Iterator[Hit]:
    for path, annotation in subject.annotations():
        count = len(getattr(annotation, "paths", ()))
        for k, attribute in enumerate(getattr(annotation, "attributes", ())):
            index = attribute.point_index if isinstance(attribute, AttributePath) else None
            if index is not None and not 0 <= index < count:
                location = f"{path}.attributes[{k}].point_index"
                yield Hit(location, f"{index}; the annotation has {count} points, counted from 0")


def _spellings(subject: Subject) -> Iterator[Hit]:
    """Group labels by their letters and digits alone; of several in a group, one spelling is meant."""
    counts = Counter(label for a in subject.scene.annotations if isinstance(label := getattr(a, "label", None), str))
    groups: dict[str, list[str]] = defaultdict(list)
    for label in counts:
        groups["".join(letter for letter in label.casefold() if letter.isalnum())].append(label)
    for letters, labels in groups.items():
        if letters and len(labels) > 1:
            usual = max(labels, key=lambda label: counts[label])
            reported = ", ".join(f"{label!r} ({counts[label]} times)" for label in labels)
            rare = sum(counts[label] for label in labels if label != usual)
            yield Hit("annotations", f"labels {reported}; expected one spelling, as {usual!r}", count=rare)


# fmt: off
REFERENCE_RULES: tuple[Rule, ...] = (
    Rule("annotation-parent-unknown", ERROR, "The parent that an annotation names is an annotation of the scene.",
         'Name an annotation that exists, with the type of its id (1 is not "1"), or leave `parent_id` out.',
         find=_unknown_parents),
    Rule("annotation-parent-cycle", ERROR, "No annotation is its own parent, nor a parent of its parents.",
         "Leave one `parent_id` of the cycle out.", find=_annotation_cycles),
    Rule("annotation-type-known", WARNING, "Every annotation is of a type that the format lists.",
         "Correct the type; an annotation of another type is carried along, and nothing computes with it.",
         find=_unknown_annotation_types),
    Rule("part-of-sensor-once", WARNING, "An annotation has one activation and one projection for each sensor.",
         "Join them: their timestamps, and what belongs to each.", find=_several_for_a_sensor),
    Rule("annotation-sensor-unknown", ERROR,
         "Every sensor that an annotation or an attribute of the scene names is a sensor of the scene.",
         'Name a sensor that exists, with the type of its id (1 is not "1"), or take the part out.',
         find=_unknown_sensors),
    Rule("annotation-sensor-type", ERROR,
         "Boxes and shapes in images, projections and camera calibrations are of cameras; labelled points are of "
         "sensors with points; activations are of lidars, radars and cameras.",
         "Name the sensor that was meant.", find=_wrong_sensors),
    Rule("link-end-unknown", ERROR, "Both ends of a link are annotations of the scene.",
         "Name annotations that exist, or take the link out.", find=_unknown_link_ends),
    Rule("link-to-itself", WARNING, "A link joins two different annotations.",
         "Name the other annotation, or take the link out.", find=_links_to_themselves),
    Rule("attribute-point-unknown", ERROR,
         "The point that an attribute of a points annotation is for is one of its points.",
         "Count points from 0, in the order of `paths`.", find=_unknown_points),
    Rule("annotation-unused", HINT, "Objects and groups have members, links or attributes.",
         "Take it out if nothing belongs to it.", find=_unused),
    Rule("label-spellings", HINT, "A label is spelt in one way throughout a scene.",
         "Rename the labels to one spelling.", find=_spellings),
)
# fmt: on
