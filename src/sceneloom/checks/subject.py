"""What rules look at: a scene, and a frame of it that is in memory."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar, cast

from sceneloom.arrays import AnyArray
from sceneloom.formats.faults import PlacedFault
from sceneloom.formats.recording.further_contents import RecordingContents
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.clouds import LidarFrame, RadarFrame
from sceneloom.scene.depth import DepthFrame
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import Identifier, key_of
from sceneloom.scene.warnings import DataWarning

Table = TypeVar("Table")

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

    def table(self, name: str, make: Callable[["Subject"], Table]) -> Table:
        """Give a table that several rules need; the first that asks has it made."""
        if name not in self.cache:
            self.cache[name] = make(self)
        return cast("Table", self.cache[name])

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
