"""What a rule is: the scene that it looks at, its id, severity, remedy and fix, and what several rules share."""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any, TypeVar, cast

import numpy as np

from sceneloom.arrays import AnyArray, Int64Array
from sceneloom.formats.base.diagnostics import PlacedFault
from sceneloom.formats.recording.reader import RecordingContents
from sceneloom.scene.annotations import Annotation
from sceneloom.scene.cameras import CameraImage, CameraSensor, DepthCameraSensor, DepthFrame
from sceneloom.scene.clouds import LidarFrame, LidarSensor, RadarFrame, RadarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.scene import NOMINAL_PERIOD_NS, Scene, Sensor
from sceneloom.scene.types import Identifier, key_of
from sceneloom.warnings import DataWarning, Severity

_Table = TypeVar("_Table")

ERROR, WARNING, HINT = Severity.ERROR, Severity.WARNING, Severity.HINT

_FRAME = re.compile(r"(.*?sensors\[\d+\])\.(frames|images)\[(\d+)\](.*)", re.DOTALL)


@dataclass(frozen=True, slots=True)
class FrameInHand:
    """A frame or image that was read, or could not be.

    Attributes:
        sensor: whose it is.
        sensor_path: `sensors[3]`.
        number: of the frame within its sensor.
        frame: None where it could not be read; an image is decoded already.
        fault: why it could not.
    """

    sensor: Sensor
    sensor_path: str
    number: int
    frame: LidarFrame | RadarFrame | CameraImage | DepthFrame | None
    fault: str | None = None

    @property
    def path(self) -> str:
        """`sensors[3].frames[12]`, or `sensors[3].images[12]`."""
        name = "images" if isinstance(self.sensor, CameraSensor) else "frames"
        return f"{self.sensor_path}.{name}[{self.number}]"


@dataclass(frozen=True)
class Subject:
    """A scene under examination.

    Attributes:
        scene: as far as it could be read.
        header: the file's own header where it is an `.sfs` file, else None.
        faults: what was found wrong while the file was read.
        sensor_paths: where each sensor of the scene stands in its file; empty: counted in the scene.
        annotation_paths: where each annotation stands; empty: counted in the scene.
        warnings: what the reader assumed, repaired or left out this time; None: all that the scene reports.
        fetch: gives arrays of the header with their values, which those of a file behind a URL may lack.
        recording: what the files of a recording state, lines in the order of the file; None for other formats.
        frame_numbers: the numbers in the file of the frames and images of a sensor, by the path of their list, where
            some were left out.
        cache: what `table` keeps.
    """

    scene: Scene
    header: Mapping[str, Any] | None = None
    faults: tuple[PlacedFault, ...] = ()
    sensor_paths: Sequence[str] = ()
    annotation_paths: Sequence[str] = ()
    warnings: Sequence[DataWarning] | None = None
    fetch: Callable[[Any], Any] | None = None
    recording: RecordingContents | None = None
    frame_numbers: Mapping[str, Sequence[int]] = field(default_factory=dict)
    cache: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, things in (("sensors", self.scene.sensors), ("annotations", self.scene.annotations)):
            attribute = f"{name.removesuffix('s')}_paths"
            if len(getattr(self, attribute)) != len(things):
                object.__setattr__(self, attribute, tuple(f"{name}[{k}]" for k in range(len(things))))

    @property
    def is_recording(self) -> bool:
        """Whether a recording's files are examined, though none of them may be readable."""
        return self.recording is not None or (self.scene.format == "recording" and bool(self.faults))

    @property
    def holds_nothing(self) -> bool:
        """Whether the scene has nothing in it that a rule could look at."""
        return not (self.scene.sensors or self.scene.annotations or self.scene.trajectories)

    @property
    def notes(self) -> Sequence[DataWarning]:
        """What the reader remarked; of a scene file not what was remarked when it was made."""
        return self.scene.warnings if self.warnings is None else self.warnings

    def fetched(self, array: AnyArray) -> AnyArray:
        """An array of the header with its values."""
        return array if self.fetch is None else cast("AnyArray", self.fetch(array))

    def table(self, name: str, make: Callable[["Subject"], _Table]) -> _Table:
        """Give a table that several rules need; the first that asks has it made."""
        if name not in self.cache:
            self.cache[name] = make(self)
        return cast("_Table", self.cache[name])

    def path_in_file(self, path: str) -> str:
        """A path whose frames are counted in the scene, as the file counts them."""
        found = _FRAME.match(path) if self.frame_numbers else None
        if found is None:
            return path
        owner, name, number, rest = found.groups()
        numbers = self.frame_numbers.get(f"{owner}.{'images' if name == 'images' else name}")
        if numbers is None or int(number) >= len(numbers):
            return path
        return f"{owner}.{name}[{numbers[int(number)]}]{rest}"

    def sensors(self) -> Iterator[tuple[str, Sensor]]:
        """All sensors with their paths."""
        return zip(self.sensor_paths, self.scene.sensors, strict=True)

    def annotations(self) -> Iterator[tuple[str, Annotation]]:
        """All annotations with their paths."""
        return zip(self.annotation_paths, self.scene.annotations, strict=True)

    def sensor_path(self, sensor: Sensor) -> str:
        """`sensors[3]`."""
        return self.table("paths of sensors", _paths_of_sensors)[id(sensor)]

    def is_left_out(self, kind: str, identifier: Identifier) -> bool:
        """Whether the file lists a sensor or annotation (`kind`: "sensors", "annotations") that has not been read.

        Its own fault is reported; that others name it is none.
        """
        return key_of(identifier) in self.table(f"ids of {kind} in the file", lambda inner: _ids(inner, kind))

    def has_sensor(self, sensor_id: Identifier) -> bool:
        """Whether the scene has a sensor of that id, of that very type."""
        return self.sensor(sensor_id) is not None

    def sensor(self, sensor_id: Identifier) -> Sensor | None:
        """The sensor of that id, of that very type, or None."""
        return self.table("sensors by id", _sensors_by_id).get((type(sensor_id), sensor_id))


def _ids(subject: Subject, kind: str) -> frozenset[tuple[type, Identifier]]:
    listed = (subject.header or {}).get(kind)
    things = listed if isinstance(listed, list) else []
    ids = (thing.get("id") for thing in things if isinstance(thing, dict))
    return frozenset(key_of(identifier) for identifier in ids if isinstance(identifier, str | int))


def _paths_of_sensors(subject: Subject) -> dict[int, str]:
    return {id(sensor): path for path, sensor in subject.sensors()}


def _sensors_by_id(subject: Subject) -> dict[tuple[type, Identifier], Sensor]:
    return {key_of(sensor.id): sensor for sensor in subject.scene.sensors}


@dataclass(frozen=True, slots=True)
class Hit:
    """A location where a rule does not hold.

    Attributes:
        path: in the words of the file (`sensors[3].frames[12].points.colors`).
        message: what was found, with the value, and what was expected.
        count: how often, where one hit stands for several.
    """

    path: str
    message: str
    count: int = 1


class CheckProfile(StrEnum):
    """What a scene is checked against."""

    SFS = "sfs"
    """The description of the format."""
    SCALE = "scale"
    """Also what Scale's own library loads and validates."""


ALL_PROFILES = frozenset(CheckProfile)

SCALE_ONLY = frozenset({CheckProfile.SCALE})

Find = Callable[[Subject], Iterable[Hit]]

_Look = Callable[[Subject, FrameInHand], Iterable[Hit]]

_Fix = Callable[[Scene], Scene]


def unless_recording(find: Find) -> Find:
    """Leave recordings out, of which rules over their lines report the same with the line, and more."""

    def found(subject: Subject) -> Iterable[Hit]:
        return () if subject.recording is not None else find(subject)

    return found


@dataclass(frozen=True, slots=True)
class Rule:
    """One rule; it has `find`, or `look`, or both; `look` with `conclude` judges frames together.

    Attributes:
        id: kebab case, stable ("quaternion-norm").
        severity: how bad a hit is.
        summary: what holds in a sound scene, one sentence for the catalogue.
        remedy: what a person can do about a hit.
        find: looks at the whole scene without reading frames.
        look: looks at one frame or image; each is read once for all rules, and those of a sensor come in order.
        conclude: says at the end what all frames together show; what `look` kept for it is in `Subject.cache`.
        fix: gives the scene repaired: safe, idempotent, changing nothing else; None where a person has to decide.
        profiles: for which profiles it holds.
    """

    id: str
    severity: Severity
    summary: str
    remedy: str
    find: Find | None = None
    look: _Look | None = None
    conclude: Find | None = None
    fix: _Fix | None = None
    profiles: frozenset[CheckProfile] = ALL_PROFILES


@dataclass(slots=True)
class _Observation:
    """The first frame of a sensor in which something was seen, and how many there are."""

    path: str
    problem: str
    frames: int = 0


def note_observation(subject: Subject, rule: str, frame: FrameInHand, field: str, problem: str) -> None:
    """Remember that something was seen in a field of a frame.

    The first problem of a sensor is the one that is reported.
    """
    observations = _observations(subject, rule)
    seen = observations.setdefault(frame.sensor_path, _Observation(f"{frame.path}.{field}", problem))
    seen.frames += 1


def observations_of(rule: str) -> Find:
    """Report what was remembered for a rule: one hit for each sensor."""

    def conclude(subject: Subject) -> Iterator[Hit]:
        for seen in _observations(subject, rule).values():
            yield Hit(seen.path, seen.problem, seen.frames)

    return conclude


def _observations(subject: Subject, rule: str) -> dict[str, _Observation]:
    found: dict[str, _Observation] = subject.table(f"observations of {rule}", lambda _: {})
    return found


def timestamps_of(sensor: Sensor) -> Int64Array:
    """The times of a sensor's frames or images, (N,) int64 [ns]; none for sensors without frames."""
    if isinstance(sensor, CameraSensor):
        return sensor.images.timestamps_ns
    if isinstance(sensor, LidarSensor | RadarSensor | DepthCameraSensor):
        return sensor.frames.timestamps_ns
    return np.zeros(0, np.int64)


def period_ns(timestamps_ns: Int64Array) -> float:
    """The median time from frame to frame [ns]; that of 10 Hz where the timestamps report none."""
    median_ns = float(np.median(np.diff(timestamps_ns))) if len(timestamps_ns) > 1 else 0.0
    return median_ns if median_ns > 0 else float(NOMINAL_PERIOD_NS)


def frames_path(sensor_path: str, sensor: Sensor) -> str:
    """`sensors[3].frames`, or `sensors[3].images`."""
    return f"{sensor_path}.{'images' if isinstance(sensor, CameraSensor) else 'frames'}"


def seconds(nanoseconds: float) -> str:
    """A time in seconds, as findings report it."""
    return f"{nanoseconds / 1e9:.6f} s"


def repaired_annotations(scene: Scene, repair: Callable[[Annotation], Annotation]) -> Scene:
    """Repair each annotation; `repair` gives back those that need nothing as they are."""
    annotations = tuple(map(repair, scene.annotations))
    if all(new is old for new, old in zip(annotations, scene.annotations, strict=True)):
        return scene
    return replace(scene, annotations=annotations)


@dataclass(frozen=True, slots=True, eq=False)
class _Reordered:
    """Reads the frames of another sequence in another order; goes to other processes as those do."""

    read: Callable[[int], Any]
    order: tuple[int, ...]

    def __call__(self, k: int) -> Any:
        return self.read(self.order[k])


def _sorted_frames(frames: LazyFrames[Any]) -> LazyFrames[Any]:
    """The same frames in the order of their times; those of one time stay as they are among each other."""
    return chosen_frames(frames, np.argsort(frames.timestamps_ns, kind="stable").astype(np.int64))


def chosen_frames(frames: LazyFrames[Any], rows: Int64Array) -> LazyFrames[Any]:
    """Some of the frames, (M,) numbers of them, in that order."""
    read = _Reordered(frames.__getitem__, tuple(rows.tolist()))
    return LazyFrames(frames.timestamps_ns[rows], read)


def _is_sorted(frames: LazyFrames[Any]) -> bool:
    """Whether the frames stand in the order of their times."""
    timestamps_ns = frames.timestamps_ns
    return not (timestamps_ns[1:] < timestamps_ns[:-1]).any()


def with_sorted_frames(scene: Scene) -> Scene:
    """Sort the frames of every sensor by time; images of a video stay, since the video has its own order."""
    sensors = tuple(map(_sorted, scene.sensors))
    changed = any(new is not old for new, old in zip(sensors, scene.sensors, strict=True))
    return replace(scene, sensors=sensors) if changed else scene


def _sorted(sensor: Sensor) -> Sensor:
    if isinstance(sensor, LidarSensor) and not _is_sorted(sensor.frames):
        return replace(sensor, frames=_sorted_frames(sensor.frames))
    if isinstance(sensor, RadarSensor) and not _is_sorted(sensor.frames):
        return replace(sensor, frames=_sorted_frames(sensor.frames))
    if isinstance(sensor, CameraSensor) and sensor.video is None and not _is_sorted(sensor.images):
        return replace(sensor, images=_sorted_frames(sensor.images))
    if isinstance(sensor, DepthCameraSensor) and sensor.video is None and not _is_sorted(sensor.frames):
        return replace(sensor, frames=_sorted_frames(sensor.frames))
    return sensor
