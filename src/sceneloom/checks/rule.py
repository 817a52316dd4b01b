"""What a rule is: the scene that it looks at, its id, severity, remedy and fix, and what several rules share."""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate
from typing import Any, TypeVar, cast

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float64Array, Int64Array, spread_rows
from sceneloom.formats.base.diagnostics import PlacedFault
from sceneloom.formats.recording.contents import RecordingContents
from sceneloom.scene.annotations import Annotation, Box2DAnnotation, CuboidAnnotation, PointsAnnotation, ShapeAnnotation
from sceneloom.scene.cameras import CameraImage, CameraSensor, DepthFrame
from sceneloom.scene.clouds import LidarFrame, RadarFrame
from sceneloom.scene.scene import NOMINAL_PERIOD_NS, Scene, Sensor, frames_of
from sceneloom.scene.types import Identifier, key_of
from sceneloom.warnings import DataWarning, Severity

_Table = TypeVar("_Table")
_Kind = TypeVar("_Kind")
_Owner = TypeVar("_Owner")
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
        header: the header of an `.sfs` file, else None.
        faults: what was found wrong while the file was read.
        sensor_paths: path of each sensor in its file; empty: counted in the scene.
        annotation_paths: path of each annotation; empty: counted in the scene.
        warnings: what the reader assumed, repaired or left out this time; None: all warnings of the scene.
        fetch: gives arrays of the header with their values, which those of a file behind a URL may lack.
        recording: the parsed files of a recording, lines in the order of the file; None for other formats.
        frame_numbers: numbers in the file of the frames and images of a sensor, by the path of their list, where some
            were left out.
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
        """Warnings of the reader; of a scene file not those of when it was made."""
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

    def sensors_of(self, kind: type[_Kind]) -> Iterator[tuple[str, _Kind]]:
        """All sensors of a class with their paths."""
        return ((path, sensor) for path, sensor in self.sensors() if isinstance(sensor, kind))

    def annotations_of(self, kind: type[_Kind]) -> Iterator[tuple[str, _Kind]]:
        """All annotations of a class with their paths."""
        return ((path, annotation) for path, annotation in self.annotations() if isinstance(annotation, kind))

    def sensor_path(self, sensor: Sensor) -> str:
        """`sensors[3]`."""
        return self.table("paths of sensors", lambda inner: {id(one): path for path, one in inner.sensors()})[
            id(sensor)
        ]

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
        known = self.table("sensors by id", lambda inner: {key_of(one.id): one for one in inner.scene.sensors})
        return known.get((type(sensor_id), sensor_id))


def _ids(subject: Subject, kind: str) -> frozenset[tuple[type, Identifier]]:
    listed = (subject.header or {}).get(kind)
    things = listed if isinstance(listed, list) else []
    ids = (thing.get("id") for thing in things if isinstance(thing, dict))
    return frozenset(key_of(identifier) for identifier in ids if isinstance(identifier, str | int))


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


ALL_PROFILES = ("sfs", "scale")
"""What a scene is checked against: the description of the format; also what Scale's own library loads and validates."""

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
    profiles: tuple[str, ...] = ALL_PROFILES


def timestamps_of(sensor: Sensor) -> Int64Array:
    """The times of a sensor's frames or images, (N,) int64 [ns]; none for sensors without frames."""
    return frames_of(sensor).timestamps_ns


def period_ns(timestamps_ns: Int64Array) -> float:
    """The median time from frame to frame [ns]; that of 10 Hz where the timestamps report none."""
    median_ns = float(np.median(np.diff(timestamps_ns))) if len(timestamps_ns) > 1 else 0.0
    return median_ns if median_ns > 0 else float(NOMINAL_PERIOD_NS)


def frames_spread(count: int, wanted: int) -> frozenset[int]:
    """Numbers of frames, evenly spread over all of a sensor's."""
    return frozenset(spread_rows(count, wanted, nearest=False).tolist())


def frames_path(sensor_path: str, sensor: Sensor) -> str:
    """`sensors[3].frames`, or `sensors[3].images`."""
    return f"{sensor_path}.{'images' if isinstance(sensor, CameraSensor) else 'frames'}"


def seconds(nanoseconds: float) -> str:
    """A time in seconds, as findings report it."""
    return f"{nanoseconds / 1e9:.6f} s"


def with_each(owner: _Owner, name: str, repair: Callable[[Any], Any]) -> _Owner:
    """Repair each part in a field of a scene or an annotation; `repair` gives back those that need nothing as they are.

    Args:
        name: of the field, a tuple: "annotations", "sensors", ….
    """
    parts = getattr(owner, name)
    repaired = tuple(map(repair, parts))
    if all(new is old for new, old in zip(repaired, parts, strict=True)):
        return owner
    changed: _Owner = replace(cast("Any", owner), **{name: repaired})
    return changed


@dataclass(frozen=True, slots=True, eq=False)
class PartTable:
    """Parts of annotations of one kind, such as all paths of cuboids, their rows one after another.

    Attributes:
        parts: P objects with timestamps (`CuboidPath`, `Projection`, …).
        numbers: (P,) int64, number of the annotation of each.
        suffixes: where each stands inside its annotation (`.path`, `.projections[1]`).
        starts: (P + 1,) int64, first row of each part.
        timestamps_ns: (R,) int64 [ns], those of all parts.
    """

    parts: Sequence[Any]
    numbers: Int64Array
    suffixes: Sequence[str]
    starts: Int64Array
    timestamps_ns: Int64Array

    @classmethod
    def of(cls, entries: Sequence[tuple[int, str, Any]]) -> "PartTable":
        """Line up parts, each with the number of its annotation and its location in there."""
        parts = [part for _, _, part in entries]
        times = [part.timestamps_ns for part in parts]
        starts = np.fromiter(accumulate(map(len, times), initial=0), np.int64, len(times) + 1)
        return cls(
            parts,
            np.array([number for number, _, _ in entries], np.int64),
            [suffix for _, suffix, _ in entries],
            starts,
            np.concatenate(times) if times else np.zeros(0, np.int64),
        )

    @property
    def owners(self) -> Int64Array:
        """(R,) int64: the part that each row belongs to."""
        return np.repeat(np.arange(len(self.parts)), np.diff(self.starts))

    @property
    def inner(self) -> BoolArray:
        """(R - 1,) bool: whether a row and the next one belong to one part."""
        inner = np.ones(max(len(self.timestamps_ns) - 1, 0), bool)
        ends = self.starts[1:-1]
        inner[ends[(ends > 0) & (ends < len(self.timestamps_ns))] - 1] = False
        return inner

    def rows(self, values: Callable[[Any], AnyArray], columns: int) -> Float64Array:
        """Join what the parts hold, (R, columns) float64."""
        arrays = [values(part) for part in self.parts]
        return np.concatenate(arrays) if arrays else np.zeros((0, columns))

    def location(self, subject: Subject, part: int) -> str:
        """Where a part stands in the file."""
        return subject.annotation_paths[int(self.numbers[part])] + self.suffixes[part]

    def hits(self, subject: Subject, bad: BoolArray, state: Callable[[int], str], *, within: str = "") -> Iterator[Hit]:
        """Give one hit for each part that has rows at fault.

        Args:
            bad: (R,) bool, which rows are.
            state: gives the message for a row.
            within: what of the part is at fault (`.values`); the position of its first row at fault is named.
        """
        rows = np.flatnonzero(bad)
        if len(rows) == 0:
            return
        parts = np.searchsorted(self.starts, rows, side="right") - 1
        firsts = np.flatnonzero(np.diff(parts, prepend=-1))
        counts = np.diff(firsts, append=len(rows))
        for first, count in zip(firsts.tolist(), counts.tolist(), strict=True):
            row, part = int(rows[first]), int(parts[first])
            inside = f"{within}[{row - int(self.starts[part])}]" if within else ""
            yield Hit(self.location(subject, part) + inside, state(row), count=count)


def annotation_parts(subject: Subject, kind: str) -> PartTable:
    """All paths of "cuboids", "boxes", "shapes" or named "points", or all of another kind of `PART_KINDS`."""
    return subject.table("parts of annotations", _made_tables)[kind]


_Entries = list[tuple[int, str, Any]]
PART_KINDS = ("cuboids", "activations", "projections", "point_projections", "boxes", "shapes", "points")


def _made_tables(subject: Subject) -> dict[str, PartTable]:
    entries: dict[str, _Entries] = {name: [] for name in PART_KINDS}
    for number, annotation in enumerate(subject.scene.annotations):
        if isinstance(annotation, CuboidAnnotation):
            entries["cuboids"].append((number, ".path", annotation.path))
            if annotation.activations:
                _add(entries["activations"], number, ".activations", annotation.activations)
            if annotation.projections:
                _add(entries["projections"], number, ".projections", annotation.projections)
        elif isinstance(annotation, Box2DAnnotation):
            entries["boxes"].append((number, ".path", annotation.path))
        elif isinstance(annotation, ShapeAnnotation):
            entries["shapes"].append((number, ".path", annotation.path))
        elif isinstance(annotation, PointsAnnotation):
            _add(entries["points"], number, ".paths", annotation.paths)
            for k, of_point in enumerate(annotation.projections):
                _add(entries["point_projections"], number, f".projections[{k}]", of_point)
    return {name: PartTable.of(found) for name, found in entries.items()}


def _add(entries: _Entries, number: int, name: str, parts: Sequence[Any]) -> None:
    entries.extend((number, f"{name}[{k}]", part) for k, part in enumerate(parts))


def camera_rows(subject: Subject, table: PartTable) -> Iterator[tuple[CameraSensor, Int64Array]]:
    """Give each camera with the rows of a table that are about it, (K,) int64; cameras without rows are left out."""
    numbers = {key_of(camera.id): n for n, camera in enumerate(subject.scene.cameras)}
    annotations = subject.scene.annotations
    owners = [
        part if hasattr(part, "sensor_id") else annotations[number]
        for part, number in zip(table.parts, table.numbers.tolist(), strict=True)
    ]
    of_parts = [numbers.get((type(owner.sensor_id), owner.sensor_id), -1) for owner in owners]
    of_rows = np.repeat(np.array(of_parts, np.int64), np.diff(table.starts))
    for number, camera in enumerate(subject.scene.cameras):
        rows = np.flatnonzero(of_rows == number)
        if len(rows):
            yield camera, rows
