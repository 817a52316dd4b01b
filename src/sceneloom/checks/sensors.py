"""Rules about sensors: that they have content, that their parents are there, that their streams are in order."""

from collections.abc import Iterator, Sequence
from difflib import get_close_matches

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.checks.annotation_table import sensor_mentions
from sceneloom.checks.rule import Hit, Rule, unless_recording
from sceneloom.checks.subject import Subject
from sceneloom.formats.sfs.fields import SENSOR_RECORDS
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, PointsSensor, RadarSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.findings import Severity
from sceneloom.scene.motion import GnssSensor, ImuSensor
from sceneloom.scene.plain import PlainSensor
from sceneloom.scene.scene import Sensor
from sceneloom.scene.types import Identifier, key_of

Key = tuple[type, Identifier]


_EMPTYING = frozenset({"missing-videos", "unreadable-videos", "unmatched-images"})
"""Faults of a recording that leave a camera without images."""


def _nothing(subject: Subject) -> Iterator[Hit]:
    if subject.holds_nothing:
        yield Hit("sensors", "neither a sensor nor an annotation nor a trajectory")


def _count(sensor: Sensor) -> int | None:
    """How much a sensor has measured; None where that cannot be stated, and for poses, of which there is always one."""
    if isinstance(sensor, LidarSensor | RadarSensor | DepthCameraSensor):
        return len(sensor.frames)
    if isinstance(sensor, CameraSensor):
        return len(sensor.images)
    if isinstance(sensor, PointsSensor):
        return len(sensor.positions)
    if isinstance(sensor, ImuSensor):
        return sum(map(len, sensor.streams.values()))
    return len(sensor.timestamps_ns) if isinstance(sensor, GnssSensor) else None


def _empty(subject: Subject) -> Iterator[Hit]:
    """Sensors without content; those that annotations name belong to a scene whose data are elsewhere.

    Cameras of a recording are passed over where each of them has a fault of its video that says why it is empty.
    """
    named = {(type(mention.sensor_id), mention.sensor_id) for mention in sensor_mentions(subject)}
    empty = [
        (path, sensor)
        for path, sensor in subject.sensors()
        if _count(sensor) == 0 and key_of(sensor.id) not in named
    ]
    reported = sum(fault.code in _EMPTYING for fault in subject.faults)
    explained = sum(isinstance(sensor, CameraSensor) for _, sensor in empty) <= reported
    for path, sensor in empty:
        if not (explained and isinstance(sensor, CameraSensor)):
            what = "images" if isinstance(sensor, CameraSensor) else "measurements"
            yield Hit(path, f"{sensor.type} {sensor.id!r} has no {what}")


def _unknown_types(subject: Subject) -> Iterator[Hit]:
    for path, sensor in subject.sensors():
        if isinstance(sensor, PlainSensor):
            near = nearest(str(sensor.type), tuple(SENSOR_RECORDS))
            yield Hit(
                f"{path}.type", f"{sensor.type!r}{near}; its fields are carried along and not understood"
            )


def nearest(name: str, known: Sequence[str]) -> str:
    """Name the known word that is most like another one, as a part of a message; empty where none is."""
    near = get_close_matches(name.casefold(), known, n=1)
    return f", which is like {near[0]!r}" if near else ""


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


def _parent_cycles(subject: Subject) -> Iterator[Hit]:
    parents: dict[Key, Key] = {
        key_of(s.id): (type(s.parent_id), s.parent_id)
        for s in subject.scene.sensors
        if s.parent_id is not None
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
    for path, sensor in subject.sensors():
        if isinstance(sensor, GnssSensor):
            latitudes, longitudes = sensor.positions_lla[:, 0], sensor.positions_lla[:, 1]
            wrong = np.flatnonzero((np.abs(latitudes) > 90) | (np.abs(longitudes) > 180))
            if len(wrong):
                k = wrong[0]
                problem = (
                    f"latitude {latitudes[k]}, longitude {longitudes[k]}; expected at most 90 and 180 degrees"
                )
                yield Hit(f"{path}.positions_lla[{k}]", problem, len(wrong))


RULES: tuple[Rule, ...] = (
    Rule(
        "scene-not-empty",
        Severity.WARNING,
        "A scene has a sensor, an annotation or a trajectory.",
        "See whether the sensors stand where the format wants them.",
        find=_nothing,
    ),
    Rule(
        "sensor-empty",
        Severity.WARNING,
        "Every sensor has frames, images, points or samples, or annotations name it.",
        "Leave the sensor out if it is not used, or find its data.",
        find=_empty,
    ),
    Rule(
        "sensor-type-known",
        Severity.WARNING,
        "Every sensor is of a type that the format lists.",
        "Use one of points, lidar, radar, camera and odometry; other programs may refuse the file.",
        find=_unknown_types,
    ),
    Rule(
        "sensor-ids-distinct",
        Severity.HINT,
        "No two ids of sensors differ only in being a number and a text.",
        "Use one kind: programs that compare ids as texts take both for one.",
        find=_similar_ids,
    ),
    Rule(
        "sensor-parent-known",
        Severity.ERROR,
        "The parent of a sensor is a sensor of the scene.",
        'Name the parent by its id, of the same type (1 is not "1"), or leave `parent_id` out.',
        find=_dangling_parents,
    ),
    Rule(
        "sensor-parent-cycle",
        Severity.ERROR,
        "No sensor is its own parent, directly or over others.",
        "Leave `parent_id` out of one of them.",
        find=_parent_cycles,
    ),
    Rule(
        "sample-times-increasing",
        Severity.WARNING,
        "Samples of inertial sensors and fixes of satellite receivers have strictly increasing times.",
        "Sort them, and leave out those that stand there twice.",
        find=unless_recording(_disordered_samples),
    ),
    Rule(
        "samples-finite",
        Severity.WARNING,
        "Samples of inertial sensors and fixes of satellite receivers hold finite numbers only.",
        "Leave the sample out.",
        find=_infinite_samples,
    ),
    Rule(
        "gnss-on-earth",
        Severity.ERROR,
        "Latitudes lie within 90 degrees, longitudes within 180.",
        "See whether latitude and longitude are exchanged, or given in another unit than degrees.",
        find=unless_recording(_off_the_earth),
    ),
)
