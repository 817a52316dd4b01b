"""A scene as a data set in the nuScenes schema."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import AnyArray
from sceneloom.cameras.camera import Camera
from sceneloom.errors import OptionError
from sceneloom.formats.loss import LossReport, Support
from sceneloom.formats.nuscenes.further_fields import OF_FRAMES, reported
from sceneloom.formats.nuscenes.keyframes import microseconds, timestamps_of
from sceneloom.formats.nuscenes.tables import TABLES
from sceneloom.formats.nuscenes.writing_plan import (
    Channel,
    WritingPlan,
    channels_of,
    differences_us,
    is_version,
    sensor_key,
)
from sceneloom.formats.nuscenes.written_boxes import Boxes, categories_of, write_boxes
from sceneloom.formats.nuscenes.written_frames import (
    FrameLosses,
    in_sensor_frame,
    write_cycle,
    write_image,
    write_sweep,
)
from sceneloom.formats.nuscenes.written_labels import PointClasses, category_rows
from sceneloom.formats.nuscenes.written_tables import Row, TableWriter, placed, token_of, write_table
from sceneloom.formats.option_values import as_positive
from sceneloom.formats.output import FolderKind, replacing
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraImage
from sceneloom.scene.clouds import LidarFrame, LidarSensor, RadarFrame
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import PointsFrame

IMAGES = ("copy", "png")
"""How images are written."""

_KIND = FolderKind(
    "data set of nuScenes",
    (
        rf"(?P<one>v\d[\w.-]*)/({'|'.join((*TABLES, 'map'))})\.json",
        r"(samples|sweeps)/.+/.+\.(pcd|bin|jpe?g|png)",
        r"lidarseg/v\d[\w.-]*/\w+_lidarseg\.bin",
        r"maps/none\.png",
    ),
    r"v\d[\w.-]*/sample_data\.json",
)
_MAP = "maps/none.png"
"""A mask without anything on it: the development kit wants one for each log."""


def write_nuscenes(
    scene: Scene,
    path: Path,
    *,
    overwrite: bool = False,
    version: str | None = None,
    keyframe_rate_hz: float | str | None = None,
    images: str = "copy",
    channel: str | Iterable[str] | None = None,
    trajectory: str | None = None,
) -> LossReport:
    """Write a scene as a data set; frames are read, written and let go one by one.

    Args:
        scene: what to write.
        path: the folder that is made.
        overwrite: replace the folder if it is a data set, or empty; nobody else's folder is ever replaced.
        version: name of the folder of tables; None: that which the scene was read from, else `v1.0-sceneloom`.
        keyframe_rate_hz: samples a second; None: those that the scene was read with, else two a second.
        images: "copy" copies JPEG and PNG files, and writes others as JPEG; "png" writes them as PNG.
        channel: channels of sensors, as `lidar=LIDAR_TOP,camera0=CAM_FRONT` or one text for each; others get the name
            that nuScenes has for the lidar or for the only camera that looks their trajectory, else their id.
        trajectory: name of the ego's, as of `ego_in_world`.

    Returns:
        What the tables could not hold.

    Raises:
        OptionError: an option is none of these.
        PoseError: the trajectory cannot be taken.
        OutputError: the path exists, or cannot be written.
        CalibrationError: a camera model cannot be computed with.
        DataError: what the scene is read from is damaged, or has no frame at all.
    """
    if images not in IMAGES:
        raise OptionError(f"images {images!r}; nuScenes takes {', '.join(IMAGES)}")
    if version is not None and not is_version(version):
        raise OptionError(f"version {version!r}; expected a name such as v1.0-mini")
    rate_hz = None if keyframe_rate_hz is None else as_positive("keyframe_rate_hz", keyframe_rate_hz)
    plan = WritingPlan.of(scene, path, version, rate_hz, channels_of(scene, channel), trajectory)
    with replacing(path, overwrite=overwrite, folder=_KIND) as draft:
        losses = _Writer(plan, draft, images).write()
    return LossReport.of([*plan.losses, *losses])


@dataclass(slots=True)
class _Writer:
    """Writes one data set into an empty folder."""

    plan: WritingPlan
    root: Path
    images: str
    losses: FrameLosses = field(default_factory=FrameLosses)
    calibrations: dict[str, dict[str, Any]] = field(default_factory=dict)

    @property
    def tables(self) -> Path:
        return self.root / self.plan.version

    def write(self) -> FrameLosses:
        """Write all files; give what was lost."""
        plan = self.plan
        self.tables.mkdir()
        boxes = Boxes.of(plan.scene, plan.samples)
        classes = PointClasses.of(plan.scene, self.losses)
        with TableWriter(self.tables, "sample_data") as rows, TableWriter(self.tables, "ego_pose") as poses:
            for channel in plan.channels:
                self._write_channel(channel, rows, poses, boxes, classes)
        self.losses.add(
            "annotations.labeled_points", "classes of sweeps between samples are left out", classes.left()
        )
        categories = categories_of(plan.scene)
        write_boxes(self.tables, plan.about[0].name, boxes, plan.samples, categories, self.losses)
        write_table(self.tables, "category", category_rows(categories, classes))
        if classes.rows:
            write_table(self.tables, "lidarseg", classes.rows)
        self._write_sensors()
        self._write_samples()
        return self.losses

    def _write_channel(
        self, channel: Channel, rows: TableWriter, poses: TableWriter, boxes: Boxes, classes: PointClasses
    ) -> None:
        plan, sensor = self.plan, channel.sensor
        timestamps = timestamps_of(sensor)
        timestamps_us, egos = microseconds(timestamps), plan.egos_at(timestamps)
        is_key = plan.samples.key_rows(sensor)
        samples = plan.samples.numbers(sensor, is_key)
        tokens = [
            token_of("sample_data", plan.about[0].name, channel.name, k) for k in range(len(timestamps))
        ]
        stems = _stems(plan.about[0].name, channel, timestamps_us.tolist())
        for k, token in enumerate(tokens):
            folder = self.root / ("samples" if is_key[k] else "sweeps") / channel.folder
            folder.mkdir(parents=True, exist_ok=True)
            written = self._write_frame(channel, k, folder / stems[k], egos[k])
            if written.points_world is not None and is_key[k]:
                name = "num_lidar_pts" if isinstance(sensor, LidarSensor) else "num_radar_pts"
                boxes.count(name, int(samples[k]), written.points_world)
                if isinstance(sensor, LidarSensor):
                    self._write_classes(classes, channel, k, token, len(written.points_world))
            poses.add(token=token, timestamp=int(timestamps_us[k]), **placed(egos[k]))
            rows.add(
                token=token,
                sample_token=plan.samples.tokens[int(samples[k])],
                ego_pose_token=token,
                calibrated_sensor_token=self._calibration(channel, written.mount, written.camera_model),
                timestamp=int(timestamps_us[k]),
                fileformat=written.path.suffix[1:] if written.camera_model is not None else "pcd",
                is_key_frame=bool(is_key[k]),
                height=0 if written.camera_model is None else written.camera_model.height,
                width=0 if written.camera_model is None else written.camera_model.width,
                filename=written.path.relative_to(self.root).as_posix(),
                prev=tokens[k - 1] if k else "",
                next=tokens[k + 1] if k + 1 < len(tokens) else "",
            )
        self._report_times(channel, timestamps, timestamps_us)

    def _write_frame(self, channel: Channel, k: int, stem: Path, ego: RigidTransform) -> "_Frame":
        sensor = channel.sensor
        frame: Any = sensor.images[k] if channel.modality == "camera" else sensor.frames[k]  # type: ignore[union-attr]
        for loss in reported(_extras_of(channel), frame.extras, OF_FRAMES):
            self.losses.add(loss.field, loss.what, 1)
        if isinstance(frame, CameraImage):
            path = write_image(stem, frame, self.images, self.losses)
            return _Frame(path, frame.mount or channel.mount, frame.camera)
        return self._write_points(channel, frame, stem, ego, sensor.points_frame)  # type: ignore[union-attr]

    def _write_points(
        self,
        channel: Channel,
        frame: LidarFrame | RadarFrame,
        stem: Path,
        ego: RigidTransform,
        points_frame: PointsFrame,
    ) -> "_Frame":
        positions = in_sensor_frame(frame.points.positions, points_frame, channel.mount, ego)
        if isinstance(frame, LidarFrame):
            path = stem.with_name(f"{stem.name}.pcd.bin")
            write_sweep(path, frame, positions, self.losses)
        else:
            path = stem.with_name(f"{stem.name}.pcd")
            write_cycle(path, frame, positions, self.losses)
        world = (ego @ channel.mount).apply(np.asarray(positions, np.float32))
        return _Frame(path, channel.mount, points_world=world)

    def _write_classes(self, classes: PointClasses, channel: Channel, k: int, token: str, count: int) -> None:
        frame = (sensor_key(channel.sensor), k)
        classes.write(self.root, self.plan.version, token, frame, count, self.losses)

    def _calibration(self, channel: Channel, mount: RigidTransform, camera_model: Camera | None) -> str:
        """The token of a mounting and a camera model; their row is kept for later."""
        numbers = [] if camera_model is None else camera_model.matrix.tolist()
        token = token_of("calibrated_sensor", channel.name, mount.matrix.tolist(), numbers)
        if token not in self.calibrations:
            row = {"sensor_token": channel.token, **placed(mount), "camera_intrinsic": numbers}
            self.calibrations[token] = row
        return token

    def _report_times(self, channel: Channel, timestamps: AnyArray, timestamps_us: AnyArray) -> None:
        off = differences_us(timestamps, timestamps_us)
        location = f"sensors.{channel.modality}.{'images' if channel.modality == 'camera' else 'frames'}"
        count = int((timestamps != timestamps_us * 1000).sum())
        what = "rounded to microseconds [ns]"
        self.losses.add(f"{location}.timestamp_ns", what, count, Support.CONVERTED, error=off)
        beyond = self.plan.beyond(timestamps)
        what = "frames beyond the ego trajectory have its end poses"
        self.losses.add("trajectories.positions", what, beyond, Support.APPROXIMATED)

    def _write_sensors(self) -> None:
        sensors: Iterable[Row] = (
            {"token": channel.token, "channel": channel.name, "modality": channel.modality}
            | ({} if channel.name == channel.sensor.id else {"sensor_id": channel.sensor.id})
            for channel in self.plan.channels
        )
        write_table(self.tables, "sensor", sensors)
        rows = ({"token": token, **row} for token, row in self.calibrations.items())
        write_table(self.tables, "calibrated_sensor", rows)

    def _write_samples(self) -> None:
        scene, log = self.plan.about
        tokens, times = self.plan.samples.tokens, microseconds(self.plan.samples.timestamps_ns).tolist()
        with TableWriter(self.tables, "sample") as table:
            for k, token in enumerate(tokens):
                table.add(
                    token=token,
                    timestamp=times[k],
                    prev=tokens[k - 1] if k else "",
                    next=tokens[k + 1] if k + 1 < len(tokens) else "",
                    scene_token=scene.token,
                )
        scene.nbr_samples, scene.first_sample_token, scene.last_sample_token = (
            len(tokens),
            tokens[0],
            tokens[-1],
        )
        write_table(self.tables, "scene", [msgspec.structs.asdict(scene)])
        write_table(self.tables, "log", [msgspec.structs.asdict(log)])
        self._write_map(log.token)

    def _write_map(self, log_token: str) -> None:
        from PIL import Image

        (self.root / _MAP).parent.mkdir()
        Image.new("L", (1, 1)).save(self.root / _MAP)
        row = {
            "category": "semantic_prior",
            "token": token_of("map"),
            "filename": _MAP,
            "log_tokens": [log_token],
        }
        write_table(self.tables, "map", [row])


def _extras_of(channel: Channel) -> str:
    """The field of the further fields of a channel's frames."""
    return f"sensors.{channel.modality}.{'images' if channel.modality == 'camera' else 'frames'}.extras"


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    """A frame that was written: its file, mounting, camera model of images, points of others."""

    path: Path
    mount: RigidTransform
    camera_model: Camera | None = None
    points_world: AnyArray | None = None


def _stems(name: str, channel: Channel, timestamps_us: Sequence[int]) -> list[str]:
    """Names of files, as nuScenes has them: scene, channel, time; a number where two frames have one time."""
    from sceneloom.formats.file_names import file_stem

    stems: list[str] = []
    seen: dict[int, int] = {}
    for time in timestamps_us:
        number = seen[time] = seen.get(time, 0) + 1
        again = "" if number == 1 else f"~{number}"
        stems.append(f"{file_stem(name)}__{channel.folder}__{time}{again}")
    return stems
