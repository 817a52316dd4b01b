"""Writing a file as a stream: sensors, frames and annotations come one by one, the header is made at the end."""

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from sceneloom.errors import DataError, OptionError
from sceneloom.formats.loss import LossReport
from sceneloom.formats.output import replacing
from sceneloom.formats.sfs.assembly import Contents, assemble, with_euler
from sceneloom.formats.sfs.camera_models import with_written_camera_model
from sceneloom.formats.sfs.clock_keeper import ClockKeeper
from sceneloom.formats.sfs.drafts import Losses, SensorDraft, check_new
from sceneloom.formats.sfs.garbage import collector_paused
from sceneloom.formats.sfs.image_notes import ImageNotesWriter
from sceneloom.formats.sfs.profiles import profile_named
from sceneloom.formats.sfs.root import OURS
from sceneloom.formats.sfs.sensor_drafts import draft_of
from sceneloom.formats.sfs.spool import Spool
from sceneloom.formats.sfs.times import TICKS_NS, chosen_offset_ns
from sceneloom.formats.sfs.write_annotations import annotation_record, attribute_record
from sceneloom.formats.sfs.write_clouds import CloudWriter
from sceneloom.formats.sfs.write_images import CameraDraft, ImageWriter, note_losses
from sceneloom.formats.sfs.write_records import trajectory_record, warning_record
from sceneloom.formats.table import FORMATS
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.corrections import CameraCalibration
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor, RadarFrame, RadarSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.motion import OdometrySensor
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import Identifier, key_of
from sceneloom.scene.warnings import WarningKind

Frame = LidarFrame | RadarFrame | CameraImage

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
        self._contents = Contents()
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
            with_euler(self._contents)
            self._contents.ours["unfused"] = self._unfused or None
            with collector_paused():
                header = assemble(self._contents, self._profile, opened.keeper, self._losses)
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

    def add_frame(self, sensor_id: Identifier, frame: Frame) -> None:
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
        self._contents.annotations.append(annotation_record(annotation))

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
