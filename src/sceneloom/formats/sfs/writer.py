"""Writing a scene as a whole or as a stream; the header is made at the end."""

from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from sceneloom.arrays import AnyArray, Int64Array
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.losses import LossReport, Support
from sceneloom.formats.base.output import replacing
from sceneloom.formats.base.registry import FORMATS
from sceneloom.formats.sfs.annotations import attribute_record, encode_annotation
from sceneloom.formats.sfs.clock import READABLE_TICKS_NS, TICKS_NS, UINT32_MAX, chosen_offset_ns
from sceneloom.formats.sfs.container import collector_paused
from sceneloom.formats.sfs.encode import (
    Items,
    RecordWriter,
    draft_of,
    encode_header,
    trajectory_record,
    warning_record,
    with_written_camera_model,
)
from sceneloom.formats.sfs.images import ImageNotesWriter
from sceneloom.formats.sfs.metadata import OURS
from sceneloom.formats.sfs.profiles import (
    Profile,
    attribute_fits,
    profile_named,
    simplified_attributes,
    thousandths,
)
from sceneloom.formats.sfs.reader import DEFAULT_EULER
from sceneloom.formats.sfs.records import Location
from sceneloom.formats.sfs.schema import annotation_record, sensor_record
from sceneloom.formats.sfs.spool import (
    Blob,
    CameraDraft,
    ClockKeeper,
    CloudWriter,
    ImageWriter,
    Losses,
    SensorDraft,
    Spool,
    check_new,
    note_losses,
)
from sceneloom.scene.annotations import (
    Annotation,
    Box2DAnnotation,
    CameraCalibration,
    CuboidAnnotation,
    EventAnnotation,
    LocalizationAdjustment,
    PointsAnnotation,
    ShapeAnnotation,
)
from sceneloom.scene.cameras import CameraImage, CameraSensor, DepthCameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor, RadarFrame, RadarSensor
from sceneloom.scene.motion import OdometrySensor
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import Identifier, key_of
from sceneloom.warnings import WarningKind

_VERSION = "1.0"

_LAYOUT = 1
"""Number of the layout of our metadata."""

_UNIT_OF = {tick_ns: unit for unit, tick_ns in TICKS_NS.items()}

_EVERYWHERE = "sensors[], annotations[], attributes[]"

_ROUNDING = 0.5
"""How far a time is off at most where it is rounded [µs]."""


@dataclass(slots=True)
class _Contents:
    """Everything that a writer was given, arrays of frames spooled already.

    Attributes:
        drafts: the sensors, by id.
        annotations: their records.
        attributes: of the scene and its sensors.
        metadata: free fields.
        ours: fields of our entry of the metadata.
        extras: further root fields.
        time_unit: how the unit is spelt; None for the usual spelling.
    """

    drafts: dict[tuple[type, Identifier], SensorDraft] = field(default_factory=dict)
    annotations: list[dict[str, Any]] = field(default_factory=list)
    attributes: list[Mapping[str, Any]] = field(default_factory=list)
    metadata: dict[str, Any] = field(default_factory=dict)
    ours: dict[str, Any] = field(default_factory=dict)
    extras: dict[str, Any] = field(default_factory=dict)
    time_unit: str | None = None


class _Recorder:
    """Spools the arrays of a first pass over everything, and remembers where each stands."""

    def __init__(self, spool: Spool) -> None:
        self.spool = spool
        self.known: dict[int, tuple[AnyArray, Blob]] = {}

    def add(self, array: AnyArray) -> Blob:
        """Spool one array."""
        blob = self.spool.add(array)
        self.known[id(array)] = (array, blob)
        return blob


class _Replay:
    """Gives the blobs of a first pass again, each once; an array made anew is spooled anew."""

    def __init__(self, first: _Recorder) -> None:
        self._first = first

    def add(self, array: AnyArray) -> Blob:
        """Find or spool one array."""
        known = self._first.known.pop(id(array), None)
        return self._first.spool.add(array) if known is None else known[1]


def _assemble(contents: _Contents, profile: Profile, keeper: ClockKeeper, losses: Losses) -> bytes:
    """Make the header.

    Raises:
        OptionError: something cannot be held by the format.
    """
    firsts = [first for draft in contents.drafts.values() if (first := draft.first_ns()) is not None]
    if firsts:
        keeper.clock_for(min(firsts))
    recorder = _Recorder(keeper.spool)
    passed = _Pass(contents, profile, RecordWriter(keeper.clock, recorder))
    header = passed.header()
    if passed.writer.lowest < 0:
        # a time that stands only in annotations or attributes is earlier than all frames and poses
        keeper.clock_for(passed.writer.lowest * keeper.tick_ns + keeper.clock.offset_ns)
        passed = _Pass(contents, profile, RecordWriter(keeper.clock, _Replay(recorder)))
        header = passed.header()
    losses.add_all(passed.losses)
    return encode_header(header, passed.items)


@dataclass(slots=True)
class _Pass:
    """One attempt at the header."""

    contents: _Contents
    profile: Profile
    writer: RecordWriter
    losses: Losses = field(default_factory=Losses)
    items: Items = field(default_factory=list)

    def header(self) -> dict[str, Any]:
        """Write everything; the locations of arrays are left empty."""
        clock = self.writer.clock
        header: dict[str, Any] = {
            "version": _VERSION,
            "time_unit": self.contents.time_unit or _UNIT_OF[clock.tick_ns],
            "time_offset": max(clock.offset_ns, 0) // clock.tick_ns,
        }
        header["sensors"], sensors_aside, notes = self._sensors()
        header["annotations"], annotations_aside, exact = self._annotations()
        header["attributes"], attributes_aside, exact_of_scene = self._attributes()
        header["metadata"] = self._metadata()
        ours = self._ours(
            {
                **self.contents.ours,
                "time_shift_ns": -clock.offset_ns if clock.offset_ns < 0 else None,
                "sensor_notes": notes or None,
                "attributes": attributes_aside or None,
                "exact_attributes": exact_of_scene + exact or None,
            },
            {
                "sensors": (sensors_aside, sensor_record),
                "annotations": (annotations_aside, annotation_record),
            },
        )
        if ours:
            header["metadata"][OURS] = {"layout": _LAYOUT, **ours}
        further = {name: value for name, value in self.contents.extras.items() if name not in header}
        self._count_rounding()
        return {**header, **self._written(further, "scene", ())}

    def _metadata(self) -> dict[str, Any]:
        inner: Items = []
        written = self.writer.plain_object(self.contents.metadata, inner)
        self.items.extend((("metadata", *keys), blob) for keys, blob in inner)
        return written

    def _ours(self, fields: Mapping[str, Any], aside: Mapping[str, tuple[list[Any], Any]]) -> dict[str, Any]:
        """Write our entry of the metadata, and in it what the format or the profile has no field for."""
        location: Location = ("metadata", OURS)
        written = self._written(fields, OURS, location)
        for name, (records, record_of) in aside.items():
            if records:
                written[name] = self._list(records, (*location, name), record_of)
        return written

    def _written(self, record: Mapping[str, Any], name: str, location: Location) -> dict[str, Any]:
        inner: Items = []
        written = self.writer.write(record, name, inner)
        self.items.extend(((*location, *keys), blob) for keys, blob in inner)
        return written

    def _list(
        self, records: list[dict[str, Any]], location: Location, record_of: Any
    ) -> list[dict[str, Any]]:
        return [
            self._written(record, record_of(record["type"]), (*location, index))
            for index, record in enumerate(records)
        ]

    def _sensors(self) -> tuple[list[Any], list[dict[str, Any]], list[dict[str, Any]]]:
        """Write the sensors; give those that must stand aside, and the notes."""
        kept: list[dict[str, Any]] = []
        aside: list[dict[str, Any]] = []
        notes: list[dict[str, Any]] = []
        for draft in self.contents.drafts.values():
            record = draft.record(self.writer.clock, self.losses)
            obstacle = self.profile.sensor_obstacle(record, self.writer.clock)
            (kept if obstacle is None else aside).append(record)
            if obstacle is not None:
                self.losses.add(draft.location, obstacle, kept="metadata.sceneloom.sensors")
            if draft.note:
                notes.append({"id": draft.id, **draft.note})
        return self._list(kept, ("sensors",), sensor_record), aside, notes

    def _annotations(self) -> tuple[list[Any], list[dict[str, Any]], list[Mapping[str, Any]]]:
        """Write the annotations; give those that must stand aside, and the exact attributes."""
        kept: list[dict[str, Any]] = []
        aside: list[dict[str, Any]] = []
        exact: list[Mapping[str, Any]] = []
        for record in self.contents.annotations:
            simple, exact_records = self._simplified(record)
            obstacle = self.profile.annotation_obstacle(simple)
            if obstacle is None:
                kept.append(simple)
                exact += exact_records
            else:
                aside.append(record)
                where = "metadata.sceneloom.annotations"
                self.losses.add(f"annotations[{record['type']}]", obstacle, kept=where)
        self._note_exact(exact, "annotations[].attributes[]")
        return self._list(kept, ("annotations",), annotation_record), aside, exact

    def _simplified(self, record: dict[str, Any]) -> tuple[dict[str, Any], list[Mapping[str, Any]]]:
        attributes = record.get("attributes")
        if self.profile.exact_attributes or not isinstance(attributes, list | tuple):
            return record, []
        simple, exact = simplified_attributes(attributes, record["id"])
        return {**record, "attributes": simple}, exact

    def _attributes(self) -> tuple[list[Any], list[Mapping[str, Any]], list[Mapping[str, Any]]]:
        """Write the scene's attributes; give those that must stand aside, and the exact ones."""
        if self.profile.exact_attributes:
            return self._written({"attributes": self.contents.attributes}, "scene", ())["attributes"], [], []
        fitting: list[Mapping[str, Any]] = []
        aside: list[Mapping[str, Any]] = []
        for attribute in self.contents.attributes:
            (fitting if attribute_fits(thousandths(attribute)) else aside).append(attribute)
        simple, exact = simplified_attributes(fitting, None)
        what = "Scale's loader takes text and integers only"
        self.losses.add("attributes[]", what, count=len(aside), kept="metadata.sceneloom.attributes")
        self._note_exact(exact, "attributes[]")
        return self._written({"attributes": simple}, "scene", ())["attributes"], aside, exact

    def _note_exact(self, exact: list[Mapping[str, Any]], where: str) -> None:
        what = "made integers (fractions in thousandths), static ones with one time stamp"
        self.losses.add(where, what, count=len(exact), kept="metadata.sceneloom.exact_attributes")

    def _count_rounding(self) -> None:
        what = "times rounded to whole microseconds, halves to even: at most 0.5 µs off"
        self.losses.add(
            _EVERYWHERE, what, count=self.writer.rounded, support=Support.CONVERTED, largest_error=_ROUNDING
        )
        what = "numbers that are infinite or none, written as null"
        self.losses.add(_EVERYWHERE, what, count=self.writer.not_numbers)


def _with_euler(contents: _Contents) -> None:
    """Record how the angles of cuboids are meant, where there are cuboids and nothing says it."""
    if any(record["type"] == "cuboid" for record in contents.annotations):
        contents.ours = {**DEFAULT_EULER, **contents.ours}


_Frame = LidarFrame | RadarFrame | CameraImage

_RESERVED = frozenset(
    {
        "layout",
        "time_shift_ns",
        "sensor_notes",
        "sensors",
        "annotations",
        "attributes",
        "trajectories",
        "exact_attributes",
        "warnings",
    }
)

_ROOT = frozenset({"version", "time_unit", "time_offset"})

_PER_FRAME, _PER_POSE, _PER_ANNOTATION = 2048, 180, 2048

_LEAST_HEADER, _UNKNOWN_HEADER = 1 << 17, 1 << 20


@dataclass(frozen=True, slots=True)
class _OpenFile:
    """What is there between opening and finishing a file."""

    spool: Spool
    keeper: ClockKeeper
    clouds: CloudWriter
    images: ImageWriter


class SceneWriter:
    """Writes a scene file sensor by sensor, frame by frame; memory holds the header and the frame at hand.

    ```python
    with SceneWriter("drive.sfs") as writer:
        writer.add_sensor(LidarSensor("top", LazyFrames.of([], []), points_frame=PointsFrame.WORLD))
        for timestamp_ns, positions in sweeps:
            writer.add_frame("top", LidarFrame(timestamp_ns, LidarPoints(positions)))
        writer.set_poses("top", Poses(timestamps_ns, positions_world, quaternions_xyzw))
    ```

    The file is there, whole, when the block ends without an error; else nothing is there.

    Attributes:
        losses: what the file cannot hold; empty before `finish`.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        overwrite: bool = False,
        profile: str = "sfs",
        time_unit: str = "microseconds",
        time_offset_ns: int | None = None,
        usual_offset_ns: int | None = None,
        first_ns: int | None = None,
        frame_count: int = 0,
        metadata: Mapping[str, Any] | None = None,
        verbatim: bool = False,
    ) -> None:
        """Check what is asked for; the file is opened on entering the context.

        Args:
            path: the file to be made.
            overwrite: whether a file there may be replaced.
            profile: "sfs", or "scale" for a file that Scale's own library loads and validates.
            time_unit: "microseconds" or "nanoseconds".
            time_offset_ns: the absolute time of the file's zero [ns]; None to choose it by the earliest time.
            usual_offset_ns: an offset to begin with; unlike `time_offset_ns` it moves if something earlier comes.
            first_ns: the earliest time that will come, where it is known [ns]; saves moving the offset later.
            frame_count: how many frames will come, where it is known; saves copying arrays behind the header.
            metadata: free fields of the scene.
            verbatim: the contents come from a file of this format: frame timestamps and far positions pass
                unchanged.

        Raises:
            OptionError: a value is not one that can be followed.
        """
        self._path, self._overwrite, self._verbatim = Path(path), overwrite, verbatim
        self._profile = profile_named(profile)
        if time_unit not in self._profile.time_units:
            known = ", ".join(self._profile.time_units)
            raise OptionError(f"time_unit {time_unit!r}; expected {known} in profile {profile!r}")
        self._tick_ns = TICKS_NS[time_unit]
        self._fixed_offset_ns, self._frame_count = time_offset_ns, frame_count
        self._usual_offset_ns = usual_offset_ns
        if usual_offset_ns is None and first_ns is not None:
            self._usual_offset_ns = chosen_offset_ns(first_ns)
        self._contents = _Contents()
        self._cameras: dict[tuple[type, Identifier], CameraDraft] = {}
        self._unfused: list[Mapping[str, Any]] = []
        self._losses = Losses()
        self._stack = ExitStack()
        self._open: _OpenFile | None = None
        self.losses = LossReport()
        self.set_metadata(metadata or {})

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            draft = stack.enter_context(replacing(self._path, overwrite=self._overwrite))
            spool = stack.enter_context(Spool(draft, reserve=self._expected_header))
            fixed = self._fixed_offset_ns is not None
            offset_ns = self._fixed_offset_ns if fixed else self._usual_offset_ns
            keeper = ClockKeeper(self._tick_ns, offset_ns, fixed, spool, self._contents.drafts.values())
            self._open = _OpenFile(
                spool,
                keeper,
                CloudWriter(spool, self._profile, self._losses, self._verbatim, keeper),
                ImageWriter(spool, draft.parent, self._losses, self._verbatim),
            )
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self._open = None
            self._stack.__exit__(kind, error, trace)
        elif self._open is not None:
            self.finish()

    def finish(self) -> LossReport:
        """Complete the file and put it in its location; leaving the context does it, too.

        Raises:
            OptionError: something cannot be held by the format.
            OutputError: the file cannot be written.
        """
        opened = self._opened()
        with self._stack.pop_all():
            self._open = None
            for key, camera in self._cameras.items():
                note = note_losses(camera, self._losses)
                if note is not None:
                    self._contents.drafts[key].note["images"] = note
            _with_euler(self._contents)
            self._contents.ours["unfused"] = self._unfused or None
            with collector_paused():
                header = _assemble(self._contents, self._profile, opened.keeper, self._losses)
            opened.spool.finish(header)
        self.losses = LossReport.of(self._losses.all())
        return self.losses

    def add_sensor(self, sensor: Sensor) -> None:
        """Add a sensor, and write the frames or images that it holds; more may follow with `add_frame`.

        Raises:
            OptionError: its id stands in the file already, or something in it cannot be held by the format.
            DataError: a frame or image of it cannot be read.
        """
        opened, key = self._opened(), key_of(sensor.id)
        check_new(self._contents.drafts, sensor.id)
        any_distortion = self._profile.any_distortion and self._verbatim
        draft = draft_of(sensor, self._losses, any_distortion=any_distortion)
        self._contents.drafts[key] = draft
        if isinstance(sensor, CameraSensor):
            self._cameras[key] = CameraDraft(draft, ImageNotesWriter.empty(sensor.camera))
            opened.images.add_sensor(self._cameras[key], sensor)
        elif isinstance(sensor, LidarSensor | RadarSensor):
            for frame in sensor.frames:
                self.add_frame(sensor.id, frame)

    def add_frame(self, sensor_id: Identifier, frame: _Frame) -> None:
        """Write one more frame of a lidar or radar, or one more image of a camera without a video.

        Raises:
            OptionError: the sensor takes no such frame, positions lie too far away, or times cannot be held.
        """
        opened, draft = self._opened(), self._draft(sensor_id)
        if isinstance(frame, LidarFrame) and draft.type == "lidar":
            opened.clouds.add_lidar_frame(draft, frame)
        elif isinstance(frame, RadarFrame) and draft.type == "radar":
            opened.clouds.add_radar_frame(draft, frame)
        elif isinstance(frame, CameraImage) and draft.type == "camera" and draft.streamed:
            opened.images.add_image(self._cameras[type(sensor_id), sensor_id], frame)
        else:
            held = "a video" if draft.type == "camera" else f"a {draft.type}"
            raise OptionError(f"{draft.location} is {held}; it takes no {type(frame).__name__}")

    def add_unfused(self, sensor_id: Identifier, frame: LidarFrame, reason: str) -> None:
        """Keep a sweep that could not be brought into the world, in its sensor's frame, under our metadata.

        Raises:
            OptionError: the sensor is not in the file.
        """
        draft = self._draft(sensor_id)
        points = self._opened().clouds.unfused_points(frame.points)
        record = {
            "sensor_id": draft.id,
            "timestamp_ns": frame.timestamp_ns,
            "reason": reason,
            "points": points,
        }
        self._unfused.append(record)
        kept = "metadata.sceneloom.unfused"
        # what stands behind a colon differs from sweep to sweep
        why = reason.partition(":")[0]
        self._losses.add(f"{draft.location}.frames[]", f"left out of the frames: {why}", kept=kept)

    def set_poses(self, sensor_id: Identifier, poses: Poses) -> None:
        """Report where a sensor was, in the frame that its `coordinates` name.

        Raises:
            OptionError: the sensor is not in the file.
        """
        self._draft(sensor_id).poses = poses

    def add_annotation(self, annotation: Annotation) -> None:
        """Add an annotation.

        Raises:
            OptionError: a number of it is not finite.
        """
        if isinstance(annotation, CameraCalibration):
            any_model = self._profile.any_distortion
            annotation = with_written_camera_model(annotation, self._losses, any_model=any_model)
        self._contents.annotations.append(encode_annotation(annotation))

    def set_metadata(self, fields: Mapping[str, Any]) -> None:
        """Add free fields; those under "sceneloom" join ours.

        Raises:
            OptionError: a field under "sceneloom" is one that the writer fills itself.
        """
        ours = dict(fields.get(OURS) or {})
        taken = sorted(_RESERVED.intersection(ours))
        if taken:
            raise OptionError(f"metadata.{OURS}.{taken[0]} is filled by the writer; expected another name")
        self._unfused.extend(ours.pop("unfused", []))
        self._contents.metadata.update({name: value for name, value in fields.items() if name != OURS})
        self._contents.ours.update(ours)

    def spell_time_unit(self, spelling: str) -> None:
        """Write the unit of time by another of its names, as the file that a scene comes from has it."""
        self._contents.time_unit = spelling

    def add_scene(self, scene: Scene) -> None:
        """Add everything that a scene holds.

        Raises:
            OptionError: something in it cannot be held by the format.
            DataError: a frame or image cannot be read.
        """
        self.set_metadata(scene.metadata)
        self._contents.extras.update({name: v for name, v in scene.extras.items() if name not in _ROOT})
        self._contents.attributes.extend(map(attribute_record, scene.attributes))
        # what was repaired of the source is in order in the file; a correction that was applied stays one
        reported = [
            warning
            for warning in scene.warnings
            if self._verbatim or warning.kind != WarningKind.REPAIRED or warning.code == "correction-applied"
        ]
        if reported:
            self._contents.ours["warnings"] = [warning_record(warning, scene.source) for warning in reported]
        for annotation in scene.annotations:
            self._add_read(annotation, scene)
        self._add_trajectories(scene)
        for sensor in scene.sensors:
            if isinstance(sensor, DepthCameraSensor):
                self._lose_depth(sensor)
            else:
                self.add_sensor(sensor)

    def _lose_depth(self, sensor: DepthCameraSensor) -> None:
        what = (
            f"left out, with {len(sensor.frames)} depth images: the format has no cameras that measure depth"
        )
        self._losses.add(f"sensors[{sensor.id}]", what)

    def _add_read(self, annotation: Annotation, scene: Scene) -> None:
        """Add an annotation; what cannot be held of one that was read from a file is a fault of that file."""
        try:
            self.add_annotation(annotation)
        except OptionError as error:
            if scene.format not in FORMATS:
                raise
            raise DataError(scene.source, "", str(error)) from None

    def _add_trajectories(self, scene: Scene) -> None:
        odometry = [sensor for sensor in scene.sensors if isinstance(sensor, OdometrySensor)]
        records = [
            trajectory_record(name, trajectory, odometry) for name, trajectory in scene.trajectories.items()
        ]
        alone = sum("sensor_id" not in record for record in records)
        what, kept = "the format knows odometry sensors only", "metadata.sceneloom.trajectories"
        self._losses.add("trajectories[]", what, count=alone, kept=kept)
        reported = [{"name": str(sensor.id), "sensor_id": sensor.id} for sensor in odometry]
        if records and records != reported:
            self._contents.ours["trajectories"] = records

    def _opened(self) -> _OpenFile:
        if self._open is None:
            raise OptionError(f"{self._path}: not open; use the writer in a `with` block, before `finish`")
        return self._open

    def _draft(self, sensor_id: Identifier) -> SensorDraft:
        draft = self._contents.drafts.get((type(sensor_id), sensor_id))
        if draft is None:
            known = ", ".join(repr(identifier) for _, identifier in self._contents.drafts)
            raise OptionError(f"no sensor {sensor_id!r} in the file; it has {known or 'none'}")
        return draft

    def _expected_header(self) -> int:
        """About how many bytes the header will take, by what is known of the scene now."""
        contents = self._contents
        poses = sum(0 if d.poses is None else len(d.poses.timestamps_ns) for d in contents.drafts.values())
        frames = max(self._frame_count, sum(len(d.frames or ()) for d in contents.drafts.values()))
        expected = frames * _PER_FRAME + poses * _PER_POSE + len(contents.annotations) * _PER_ANNOTATION
        return max(expected, _LEAST_HEADER if self._frame_count else _UNKNOWN_HEADER)


_LATEST_START_NS = {"sfs": None, "scale": 90_000_000_000}


def write_scene(
    scene: Scene,
    path: str | Path,
    *,
    overwrite: bool = False,
    profile: str = "sfs",
    time_unit: str | None = None,
    time_offset_ns: int | None = None,
) -> LossReport:
    """Write a scene to a file.

    Args:
        scene: any scene; one that was read from a file of this format keeps its unit, offset and timestamps.
        path: the file to be made.
        overwrite: whether a file there may be replaced.
        profile: "sfs", or "scale" for a file that Scale's own library loads and validates.
        time_unit: "microseconds" or "nanoseconds"; None for the scene's own, else microseconds.
        time_offset_ns: the absolute time of the file's zero [ns]; None to choose it.

    Returns:
        What the file cannot hold.

    Raises:
        OptionError: a value is not one that can be followed, or something cannot be held by the format.
        DataError: a frame or image cannot be read.
        OutputError: the file exists, or cannot be written.
    """
    times_ns = list(_known_times(scene))
    unit = time_unit or _own_unit(scene, profile)
    from_sfs = scene.format == "sfs"
    own_spelling = (
        scene.extras.get("time_unit") if from_sfs and time_unit is None and profile == "sfs" else None
    )
    keeps_offset = from_sfs and time_offset_ns is None and _offset_serves(scene, times_ns, unit, profile)
    with SceneWriter(
        path,
        overwrite=overwrite,
        profile=profile,
        time_unit=unit,
        time_offset_ns=time_offset_ns,
        usual_offset_ns=scene.time_offset_ns if keeps_offset else None,
        first_ns=min(times_ns, default=None),
        frame_count=sum(len(s.frames) for s in scene.sensors if isinstance(s, LidarSensor | RadarSensor)),
        verbatim=from_sfs,
    ) as writer:
        writer.add_scene(scene)
        if isinstance(own_spelling, str) and READABLE_TICKS_NS.get(own_spelling) == TICKS_NS[unit]:
            writer.spell_time_unit(own_spelling)
    return writer.losses


def _own_unit(scene: Scene, profile: str) -> str:
    own = scene.extras.get("time_unit")
    if profile == "scale" or not isinstance(own, str) or own not in READABLE_TICKS_NS:
        return "microseconds"
    return next(unit for unit, tick_ns in TICKS_NS.items() if tick_ns == READABLE_TICKS_NS[own])


def _offset_serves(scene: Scene, times_ns: list[int], unit: str, profile: str) -> bool:
    """Whether the offset of the file that the scene comes from can stay."""
    offset_ns, tick_ns = scene.time_offset_ns, TICKS_NS[unit]
    if offset_ns % tick_ns or not times_ns:
        return offset_ns % tick_ns == 0
    latest_start_ns = _LATEST_START_NS.get(profile)
    starts_late = latest_start_ns is not None and min(times_ns) - offset_ns > latest_start_ns
    wraps = tick_ns > 1 and (max(times_ns) - offset_ns) // tick_ns > UINT32_MAX
    return offset_ns <= min(times_ns) and not starts_late and not wraps


def _known_times(scene: Scene) -> Iterator[int]:
    """First and last of all times that are known without reading a frame [ns]."""
    for sensor in scene.sensors:
        if isinstance(sensor, LidarSensor | RadarSensor) and len(sensor.frames):
            times = sensor.frames.timestamps_ns
            yield from (int(times.min()), int(times.max()))
        if isinstance(sensor, CameraSensor) and len(sensor.images):
            times = sensor.images.timestamps_ns
            yield from (int(times.min()), int(times.max()))
        if isinstance(sensor, LidarSensor | RadarSensor | CameraSensor | OdometrySensor):
            poses = sensor.poses
            if poses is not None and not poses.static:
                yield from (poses.start_ns, poses.stop_ns)
    for annotation in scene.annotations:
        for times in _times_of(annotation):
            if len(times):
                yield from (int(times.min()), int(times.max()))


def _times_of(annotation: Annotation) -> list[Int64Array]:
    """The times of an annotation's paths, or of its beginning."""
    if isinstance(annotation, CuboidAnnotation | Box2DAnnotation | ShapeAnnotation):
        return [annotation.path.timestamps_ns]
    if isinstance(annotation, PointsAnnotation):
        return [path.timestamps_ns for path in annotation.paths]
    if isinstance(annotation, EventAnnotation):
        return [np.array([annotation.start_ns], np.int64)]
    if isinstance(annotation, LocalizationAdjustment | CameraCalibration):
        poses = annotation.poses
        return [] if poses is None or poses.static else [poses.timestamps_ns]
    return []
