"""The colour job: the points of a drive coloured from all its cameras, as one map or sweep by sweep.

Labels go from label images to points and back. In this order: settings, outputs and report; the colours of a sweep; the
labels of an image; the files that are written; the job.
"""

import re
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from math import isfinite
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float64Array, Int64Array, UInt16Array, finite_rows
from sceneloom.colouring.blending import blend_colours
from sceneloom.colouring.exposure import ExposureGains, ExposureLinks
from sceneloom.colouring.labels import LabelCanvas, paint_labels
from sceneloom.colouring.moving_points import MovingBoxes, MovingPoints, lags_for
from sceneloom.colouring.results import FusedFrame, FusedView, LidarTrajectory
from sceneloom.colouring.visibility import VisibilitySettings
from sceneloom.colouring.world_map import WorldMap, empty_points
from sceneloom.editing.thin import chosen_points
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.files import check_regular, read_bytes
from sceneloom.formats.base.images import PNG_START, open_image, write_grey_png
from sceneloom.formats.base.output import check_output, file_stems, filling
from sceneloom.formats.base.spec import first_bytes
from sceneloom.formats.points.cloud import NO_LABEL, CloudWriter, WrittenPoints
from sceneloom.formats.points.files import WRITTEN_SUFFIXES, check_cloud_suffix, open_cloud_writer
from sceneloom.formats.sfs.writer import SceneWriter
from sceneloom.fusion.configuration import FusionConfiguration
from sceneloom.fusion.system import FusionSystem
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.pipeline.alignment import Aligned, align
from sceneloom.pipeline.fusing import CameraReport, FusionStatistics, percent
from sceneloom.pipeline.outputs import ImageSink, SceneSink, lidar_folders, names_of
from sceneloom.pipeline.play import (
    Skips,
    build_system,
    check_any_placed,
    check_has_lidar,
    play,
    report_of,
    reported_once,
    telling,
)
from sceneloom.scene.annotations import LabeledPoints, LabeledPointsAnnotation
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor, PointsSensor, grey_where_unseen
from sceneloom.scene.ego import lidar_position
from sceneloom.scene.poses import PoseSource
from sceneloom.scene.scene import Scene, scene_period_ns
from sceneloom.scene.types import Identifier, Key, Progress, key_of
from sceneloom.visualization.canvas import counting_left_out
from sceneloom.warnings import DataWarning, assumed

_SCENE_SUFFIX = ".sfs"


@dataclass(frozen=True, slots=True, kw_only=True)
class ColourSettings:
    """How a drive is coloured.

    Attributes:
        exposure: whether differences in exposure are compensated.
        voxel: side of the cubes of which the map keeps one point each [m]; None: it keeps all points.
        remove_moving: whether points on moving objects are left out.
        labels: folder of label images that are painted onto the points.
        only_coloured: whether points that no image shows are left out.
        provenance: whether clouds name the camera, image, pixel and weight of each point.
        label_radius_px: of the square that a point fills in projected label images beside its pixel.
        threads: how many share the work on a sweep; the result does not depend on it.

    Raises:
        OptionError: a value is not one that can be followed.
    """

    exposure: bool = True
    voxel: float | None = None
    remove_moving: bool = False
    labels: Path | None = None
    only_coloured: bool = False
    provenance: bool = False
    label_radius_px: int = 0
    threads: int = 1

    def __post_init__(self) -> None:
        if self.voxel is not None and not (isfinite(self.voxel) and 0.001 <= self.voxel <= 1000):
            raise OptionError(f"voxel {self.voxel}; expected 0.001 to 1000 m")
        if not 0 <= self.label_radius_px <= 100:
            raise OptionError(f"label_radius_px {self.label_radius_px}; expected 0 to 100")
        if not 1 <= self.threads <= 256:
            raise OptionError(f"threads {self.threads}; expected 1 to 256")


@dataclass(frozen=True, slots=True, kw_only=True)
class ColourOutputs:
    """Where a colouring writes what; None: not at all.

    Attributes:
        map: the whole drive as one cloud: .las, .laz, .ply, .pcd or .sfs.
        per_sweep: a folder of clouds, one for each sweep, or an .sfs file of the fused drive.
        project_labels: folder of label images of the scene's labelled points.
        images: folder of images for people.
    """

    map: Path | None = None
    per_sweep: Path | None = None
    project_labels: Path | None = None
    images: Path | None = None
    overwrite: bool = False

    def check(self) -> None:
        """Refuse outputs that cannot be, before much is done.

        Raises:
            OptionError: there is nothing to write, a suffix is unknown, or two outputs have one name.
            OutputError: an output exists, or its folder is missing.
        """
        locations = list(filter(None, (self.map, self.per_sweep, self.project_labels, self.images)))
        if not locations:
            raise OptionError(
                "nothing to write: name a map (`-o map.laz`), a folder for sweeps (`--per-sweep DIR`), "
                "for label images (`--project-labels DIR`) or for images (`--visualize DIR`)"
            )
        if len({location.absolute() for location in locations}) < len(locations):
            raise OptionError(f"{locations[0]}: named twice; expected a name for each output")
        if self.map is not None and self.map.suffix.lower() != _SCENE_SUFFIX:
            try:
                check_cloud_suffix(self.map)
            except OptionError as error:
                raise OptionError(f"{error}, or {_SCENE_SUFFIX} for a scene") from None
        for location in locations:
            check_output(location, overwrite=self.overwrite)


class _ExposureReport(msgspec.Struct, frozen=True, kw_only=True):
    """How differently the cameras were exposed."""

    seam_before: float | None  # median colour difference [levels] of points two cameras show at once
    seam_after: float | None  # likewise
    seam_points: int
    alone: tuple[Identifier, ...]
    unlinked: tuple[Identifier, ...]
    factors: dict[str, tuple[float, float]]

    @classmethod
    def of(cls, gains: ExposureGains, cameras: Sequence[Identifier]) -> "_ExposureReport":
        """Report what was found, by the cameras' ids instead of their numbers."""
        found = {camera: logs for camera, logs in gains.log_gains.items() if len(logs)}
        return cls(
            seam_before=gains.seam_before if isfinite(gains.seam_before) else None,
            seam_after=gains.seam_after if isfinite(gains.seam_after) else None,
            seam_points=gains.seam_pairs,
            alone=tuple(cameras[camera] for camera in gains.alone if camera in found),
            unlinked=tuple(cameras[camera] for camera in gains.alone if camera not in found),
            factors={
                str(cameras[camera]): (float(2.718281828459045 ** logs.min()), float(2.718281828459045 ** logs.max()))
                for camera, logs in found.items()
            },
        )


class _LabelReport(msgspec.Struct, frozen=True, kw_only=True):
    """What became of labels."""

    images: int = 0
    missing: int = 0
    points: int = 0
    drawn: int = 0
    classes: int = 0


class ColourReport(msgspec.Struct, frozen=True, kw_only=True):
    """One colouring.

    Attributes:
        output: the map written, or None.
        trajectory: name of the ego trajectory that the map stands on, or None where the scene's own poses were used.
        frames: sweeps that were read.
        unfused: why the others are not, with counts.
        skipped: sweeps and images that could not be read, one line each.
        points: points of all fused sweeps.
        coloured_percent: share of them that got a colour.
        removed_in_boxes, removed_by_rays: points left out because they lie in boxes that move, and because rays of
            other sweeps pass through their locations.
        unjudged: sweeps of which it is not known from where they were measured, so that rays state nothing.
        written: points of the map.
        exposure: None where it was left as it is.
        labels: None where there are none.
    """

    source: str
    output: str | None
    trajectory: str | None
    frames: int
    fused: int
    unfused: dict[str, int]
    skipped: tuple[str, ...]
    points: int
    coloured_percent: float
    removed_in_boxes: int
    removed_by_rays: int
    unjudged: int
    written: int
    exposure: _ExposureReport | None
    labels: _LabelReport | None
    cameras: tuple[CameraReport, ...]
    files: dict[str, int]
    seconds: float
    warnings: tuple[DataWarning, ...]


_NUMBERS = {"1", "L", "P", "I", "I;16", "I;16B", "I;16L"}
_LARGEST, _LARGEST_BYTE = 65535, 255


def _read_label_png(path: Path) -> UInt16Array:
    """Read the numbers of the classes, (H, W); of a palette its indices, whatever their colours are."""
    try:
        check_regular(path)
        if first_bytes(path, len(PNG_START)) != PNG_START:
            raise DataError(path, "", "is no PNG file; expected a label image")
        with open_image(path, ("PNG",)) as image:
            mode = image.mode
            values = np.asarray(image) if mode in _NUMBERS else None
    except (OSError, ValueError, SyntaxError) as error:
        raise DataError(path, "", f"cannot be read: {error}; expected a label image") from error
    if values is None or values.ndim != 2:
        problem = f"pixels are colours ({mode}); expected one number each: grey of 8 or 16 bits, or a palette"
        raise DataError(path, "", problem)
    if values.size and not (int(values.min()) >= 0 and int(values.max()) <= _LARGEST):
        raise DataError(path, "", f"numbers from {values.min()} to {values.max()}; expected 0 to {_LARGEST}")
    return values.astype(np.uint16)


NAMES_FILE = "labels.json"
"""Beside the images: what each number means, as `{"7": "road"}`."""

_NEAR_NS = 1_000  # times in names may be rounded to microseconds
_WHOLE, _SECONDS = re.compile(r"\d{1,19}"), re.compile(r"\d{1,10}\.\d{1,9}")


@dataclass(slots=True)
class _LabelFolder:
    """Label images of a scene's cameras."""

    folder: Path
    names: Mapping[int, str]
    used: int = 0
    missing: int = 0
    _files: dict[tuple[Identifier, int], Path] = field(default_factory=dict)

    @classmethod
    def of(cls, folder: Path, cameras: Sequence[CameraSensor]) -> "_LabelFolder":
        """Find the images: in a folder for each camera, by its id; of a single camera also in the folder itself.

        Raises:
            DataError: there is no image for any image, or a name is neither the number nor the time of an image.
        """
        if not folder.is_dir():
            raise DataError(folder, "", "no such folder; expected one of label images")
        found = cls(folder, _names(folder / NAMES_FILE))
        stems = file_stems([camera.id for camera in cameras])
        for camera, stem in zip(cameras, stems, strict=True):
            location = folder / stem
            if not location.is_dir() and len(cameras) == 1:
                location = folder
            images = sorted(location.glob("*.png")) if location.is_dir() else []
            found._files.update(_matched(images, camera))
        if not found._files:
            expected = ", ".join(f"{stem}/<number or time>.png" for stem in stems)
            raise DataError(folder, "", f"no label image in it; expected {expected or 'a scene with cameras'}")
        return found

    def image(self, camera: CameraSensor, number: int, size_px: tuple[int, int]) -> UInt16Array | None:
        """Read the image of an image, (H, W) uint16; None where there is none, which is counted.

        Args:
            camera: of the image.
            number: of the image.
            size_px: width and height that it must have.

        Raises:
            DataError: it cannot be read, or has another size.
        """
        path = self._files.get((camera.id, number))
        if path is None:
            self.missing += 1
            return None
        labels = _read_label_png(path)
        if labels.shape != (size_px[1], size_px[0]):
            problem = f"{labels.shape[1]}x{labels.shape[0]} pixels; expected {size_px[0]}x{size_px[1]}, the image's"
            raise DataError(path, "", problem)
        self.used += 1
        return labels


def _names(path: Path) -> dict[int, str]:
    if not path.is_file():
        return {}
    try:
        return msgspec.json.decode(read_bytes(path), type=dict[int, str])
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, OSError) as error:
        raise DataError(path, "", f'{error}; expected numbers and names, {{"7": "road"}}') from error


def _matched(images: Sequence[Path], camera: CameraSensor) -> dict[tuple[Identifier, int], Path]:
    """The images of a camera by the numbers of its images; all names are numbers, or all are times."""
    timestamps_ns = camera.images.timestamps_ns
    whole = {path for path in images if _WHOLE.fullmatch(path.stem)}
    numbered = all(int(path.stem) < len(timestamps_ns) for path in whole)
    found: dict[tuple[Identifier, int], Path] = {}
    for path in images:
        number = int(path.stem) if numbered and path in whole else _by_time(path, timestamps_ns)
        if (camera.id, number) in found:
            other = found[camera.id, number].name
            raise DataError(path, "", f"is for image {number}, as {other} is; expected one image for each")
        found[camera.id, number] = path
    return found


def _by_time(path: Path, timestamps_ns: Int64Array) -> int:
    """The number of the image whose time a name says: nanoseconds or microseconds, or seconds with a point."""
    if _SECONDS.fullmatch(path.stem):
        whole, _, part = path.stem.partition(".")
        reported = [int(whole) * 1_000_000_000 + int(part.ljust(9, "0"))]
    elif _WHOLE.fullmatch(path.stem):
        reported = [int(path.stem), int(path.stem) * 1_000]
    else:
        reported = []
    for time_ns in reported:
        if len(timestamps_ns) and time_ns < 2**62:
            number = int(np.argmin(np.abs(timestamps_ns - time_ns)))
            if abs(int(timestamps_ns[number]) - time_ns) <= _NEAR_NS:
                return number
    span = f"{timestamps_ns.min()} to {timestamps_ns.max()} ns" if len(timestamps_ns) else "none"
    problem = f"named for no image; expected a number from 0 to {len(timestamps_ns) - 1}, or a time of one ({span})"
    raise DataError(path, "", problem)


_MOST_COMPARED = 300  # so many sweeps, spread over the drive, exposures are compared by at most
_NO_IMAGE = -1


@dataclass(frozen=True, slots=True, eq=False)
class _ColouredSweep:
    """A fused sweep without its images, and its points as rows of a map, (N,) of dtype `POINT`."""

    frame: FusedFrame
    points: AnyArray

    def kept(self, kept: BoolArray) -> "_ColouredSweep":
        """The sweep with those of its points alone that are kept, (N,)."""
        if kept.all():
            return self
        points = chosen_points(self.frame.points, np.flatnonzero(kept))
        return _ColouredSweep(replace(self.frame, points=points), self.points[kept])


@dataclass(slots=True)
class _SweepColouring:
    """Colours sweeps; the numbers of images are those in the cameras of the scene as read."""

    scene: Scene
    gains: ExposureGains | None = None
    labels: _LabelFolder | None = None
    _cameras: dict[Identifier, tuple[int, CameraSensor]] = field(default_factory=dict)
    _numbers: dict[Identifier, Mapping[int, int]] = field(default_factory=dict)
    _images: dict[Identifier, tuple[int, UInt16Array | None]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._cameras = {camera.id: (k, camera) for k, camera in enumerate(self.scene.cameras)}
        for camera in self.scene.cameras:
            timestamps = camera.images.timestamps_ns.tolist()
            self._numbers[camera.id] = {time_ns: k for k, time_ns in reversed([*enumerate(timestamps)])}

    def number(self, view: FusedView) -> int:
        """The number of a view's image in its camera."""
        return self._numbers[view.camera_id].get(view.timestamp_ns, _NO_IMAGE)

    def colour(self, frame: FusedFrame) -> _ColouredSweep:
        """Give a fused sweep its colours and labels."""
        # before they were rounded to float32, where an image was found
        points_world = frame.views[0].points_world if frame.views else frame.points.positions.astype(np.float64)
        times = frame.points.timestamps_ns
        indices = [self._cameras[view.camera_id][0] for view in frame.views]
        gains = {} if self.gains is None else self.gains.for_views(frame.views, indices)
        blended = blend_colours(points_world, frame.views, indices, timestamps_ns=times, gains=gains)
        colors, sources = blended.colors, blended.sources
        points = empty_points(len(points_world))
        points["position"] = points_world
        points["color"], points["weight"] = colors, sources.weights
        points["camera"], points["pixel"] = sources.camera_index, sources.pixels
        for view, index in zip(frame.views, indices, strict=True):
            points["image"][sources.camera_index == index] = self.number(view)
        if frame.points.intensities is not None:
            points["intensity"] = frame.points.intensities
        points["time_ns"] = frame.timestamp_ns if times is None else times
        if self.labels is not None:
            images = [self._label_image(view, self.labels) for view in frame.views]
            points["label"] = paint_labels(points_world, frame.views, images, timestamps_ns=times)
        coloured = replace(frame.points, colors=colors, camera_index=sources.camera_index)
        return _ColouredSweep(replace(frame, points=coloured, views=()), points)

    def _label_image(self, view: FusedView, labels: _LabelFolder) -> UInt16Array | None:
        """The label image of an image, read once where several sweeps are paired with it."""
        number = self.number(view)
        kept = self._images.get(view.camera_id)
        if kept is None or kept[0] != number:
            camera = self._cameras[view.camera_id][1]
            kept = number, labels.image(camera, number, (view.camera.width, view.camera.height))
            self._images[view.camera_id] = kept
        return kept[1]


_CANVASES = 2  # images of a camera that are drawn at once: sweeps of several lidars may meet them alternately


def _numbered_labels(labelled: Sequence[LabeledPointsAnnotation], source: str) -> dict[str, int]:
    """The number of each label of labelled points: the label itself where all are numbers, else 1, 2, … by name."""
    names = sorted(set(map(_name, labelled)))
    if not names:
        raise DataError(source, "annotations", "no labelled points in it; expected labels of lidar frames")
    if len(names) >= NO_LABEL:
        raise DataError(source, "annotations", f"{len(names)} labels; expected at most {NO_LABEL - 1}")
    if all(name.isascii() and name.isdigit() and 0 < int(name) < NO_LABEL for name in names):
        return {name: int(name) for name in names}
    return {name: k for k, name in enumerate(names, 1)}


def _name(annotation: LabeledPointsAnnotation) -> str:
    return str(annotation.id) if annotation.label is None else annotation.label


@dataclass(slots=True)
class _LabelProjection:
    """Draws labels: `<camera>/<image number>.png`, 0 where no labelled point is, and what the numbers mean."""

    scene: Scene
    folder: Path
    colouring: _SweepColouring
    radius_px: int = 0
    written: int = 0
    numbers: dict[str, int] = field(default_factory=dict)
    _names: Mapping[Identifier, str] = field(default_factory=dict)
    _entries: dict[tuple[Key, int], list[tuple[int, Sequence[int]]]] = field(default_factory=dict)
    _open: dict[Identifier, dict[int, LabelCanvas]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        labelled = [each for each in self.scene.annotations if isinstance(each, LabeledPointsAnnotation)]
        self.numbers, self._names = _numbered_labels(labelled, self.scene.source), names_of(self.scene.cameras)
        for annotation in labelled:
            for entry in annotation.labeled_points:
                if entry.sensor_frame is not None:
                    key = (key_of(entry.sensor_id), entry.sensor_frame)
                    reported = (self.numbers[_name(annotation)], entry.point_ids)
                    self._entries.setdefault(key, []).append(reported)  # type: ignore[arg-type]

    def add(self, frame: FusedFrame) -> None:
        """Draw the labels of one sweep into its images."""
        labels = np.full(len(frame.points), NO_LABEL, np.uint16)
        for label, ids in self._entries.get((key_of(frame.lidar_id), frame.index), ()):
            if len(ids) and int(np.max(ids)) >= len(labels):
                location = f"annotations[].labeled_points[{frame.lidar_id}, frame {frame.index}]"
                problem = f"point {int(np.max(ids))}; expected numbers below {len(labels)}"
                raise DataError(self.scene.source, location, problem)
            labels[np.asarray(ids)] = label
        for view in frame.views:
            canvases = self._open.setdefault(view.camera_id, {})
            number = self.colouring.number(view)
            if number not in canvases:
                if len(canvases) == _CANVASES:
                    self._write(view.camera_id, next(iter(canvases)))
                width, height = view.camera.width, view.camera.height
                canvases[number] = LabelCanvas.blank(width, height, radius_px=self.radius_px)
            canvases[number].draw(view, labels)

    def _write(self, camera_id: Identifier, number: int) -> None:
        canvas = self._open[camera_id].pop(number)
        folder = self.folder / self._names[camera_id]
        folder.mkdir(parents=True, exist_ok=True)
        labels = canvas.labels.astype(np.uint8) if canvas.labels.max(initial=0) <= _LARGEST_BYTE else canvas.labels
        write_grey_png(labels, folder / f"{number:06d}.png", overwrite=True)
        self.written += 1

    def finish(self) -> None:
        """Write the last images, and what the numbers mean."""
        for camera_id, canvases in self._open.items():
            for number in [*canvases]:
                self._write(camera_id, number)
        reported = {str(number): name for name, number in self.numbers.items()}
        (self.folder / NAMES_FILE).write_bytes(msgspec.json.format(msgspec.json.encode(reported), indent=2))


@dataclass(frozen=True, slots=True, eq=False)
class _Columns:
    """The columns of written clouds."""

    labels: bool
    provenance: bool
    origin_world: Float64Array | float = 0.0  # (3,) [m], what is added to positions

    def written(self, points: AnyArray) -> WrittenPoints:
        """Rows of a map (N,) of dtype `POINT` as the columns of a file."""
        extras: dict[str, AnyArray] = {"camera": np.ascontiguousarray(points["camera"])}
        if self.provenance:
            extras["image"] = np.ascontiguousarray(points["image"])
            extras["u"], extras["v"] = (np.ascontiguousarray(points["pixel"][:, k]) for k in range(2))
            extras["weight"] = np.ascontiguousarray(points["weight"])
        return WrittenPoints(
            points["position"] + self.origin_world,
            grey_where_unseen(np.rint(np.clip(points["color"], 0, 255)).astype(np.uint8), points["camera"]),
            np.rint(np.clip(points["intensity"], 0, 255)).astype(np.uint8),
            np.ascontiguousarray(points["time_ns"]),
            np.ascontiguousarray(points["label"]) if self.labels else None,
            extras,
        )


@dataclass(slots=True)
class _MapSink:
    """Writes the drive as one cloud, each point, or one for each cube of space; `complete` ends files of others."""

    writer: CloudWriter
    columns: _Columns
    cubes: WorldMap | None = None
    complete: Callable[[], None] | None = None
    written: int = 0

    def add(self, sweep: _ColouredSweep) -> None:
        """Take one sweep."""
        if self.cubes is None:
            self._write(sweep.points[finite_rows(sweep.points["position"])])
        else:
            self.cubes.add(sweep.points)

    def finish(self) -> None:
        """Write what was gathered."""
        for points in self.cubes.points() if self.cubes is not None else ():
            self._write(points)
        if self.complete is not None:
            self.complete()

    def _write(self, points: AnyArray) -> None:
        self.writer.add(self.columns.written(points))
        self.written += len(points)


@dataclass(slots=True)
class _SweepFiles:
    """Writes a cloud for each sweep: `<frame number>.ply`, of several lidars below `<lidar>/`."""

    folders: Mapping[Identifier, Path]
    suffix: str
    columns: _Columns
    written: int = 0

    def add(self, sweep: _ColouredSweep) -> None:
        """Write one sweep."""
        folder = self.folders[sweep.frame.lidar_id]
        folder.mkdir(parents=True, exist_ok=True)
        with open_cloud_writer(folder / f"{sweep.frame.index:06d}{self.suffix}") as writer:
            writer.add(self.columns.written(sweep.points))
        self.written += 1

    def finish(self) -> None:
        """Nothing is left to do."""


@dataclass(slots=True)
class _SweepScene:
    """Writes the sweeps into a scene file whose other sensors stand in it already, with their labels."""

    sink: SceneSink
    names: Mapping[int, str]
    taken: set[Identifier]
    _labelled: dict[int, list[LabeledPoints]] = field(default_factory=dict)
    _frames: Counter[Identifier] = field(default_factory=Counter)

    def add(self, sweep: _ColouredSweep) -> None:
        """Write one sweep."""
        lidar_id = sweep.frame.lidar_id
        self.sink.add(sweep.frame)
        for label, rows in _rows_of_labels(sweep.points["label"]):
            entry = LabeledPoints(lidar_id, rows, sensor_frame=self._frames[lidar_id])
            self._labelled.setdefault(label, []).append(entry)
        self._frames[lidar_id] += 1

    def finish(self) -> None:
        """Add the labels, and complete the file."""
        for label in sorted(self._labelled):
            entries = tuple(self._labelled[label])
            self.sink.writer.add_annotation(_label_annotation(label, entries, self.names, self.taken))
        self.sink.finish()


def _rows_of_labels(labels: AnyArray) -> Iterator[tuple[int, AnyArray]]:
    """Each label of some points, (N,) uint16, and the rows (K,) uint32 that have it."""
    for label in np.unique(labels).tolist():
        if label != NO_LABEL:
            yield label, np.flatnonzero(labels == label).astype(np.uint32)


def _label_annotation(
    label: int, entries: tuple[LabeledPoints, ...], names: Mapping[int, str], taken: set[Identifier]
) -> LabeledPointsAnnotation:
    """An annotation of the points of one label, with an id that is not taken."""
    annotation_id = f"label-{label}"
    while annotation_id in taken:
        annotation_id += "-painted"
    taken.add(annotation_id)
    return LabeledPointsAnnotation(annotation_id, entries, label=names.get(label, str(label)), is_instance=False)


_MAP_ID = "map"
_KINDS = {"positions": ("f4", 3), "colors": ("u1", 3), "labels": ("u2", 1)}


@dataclass(slots=True)
class _MapScene:
    """Writes points chunk by chunk to files, and at the end all of them as one sensor of a scene."""

    writer: SceneWriter
    folder: Path
    names: Mapping[int, str]
    _files: dict[str, BinaryIO] = field(default_factory=dict)

    def add(self, points: WrittenPoints) -> None:
        """Take some more points."""
        columns: dict[str, AnyArray | None] = {
            "positions": points.positions_world.astype(np.float32),
            "colors": points.colors,
            "labels": points.labels,
        }
        for name, values in columns.items():
            if values is not None:
                if name not in self._files:
                    self._files[name] = (self.folder / name).open("wb")
                self._files[name].write(np.ascontiguousarray(values).tobytes())

    def close(self) -> None:
        """Write the sensor and the labels; the scene file is completed by who opened it."""
        for file in self._files.values():
            file.close()
        positions = self._column("positions")
        colors = self._column("colors") if "colors" in self._files else None
        self.writer.add_sensor(PointsSensor(_MAP_ID, positions, colors))
        if "labels" in self._files:
            taken: set[Identifier] = set()
            for label, rows in _rows_of_labels(self._column("labels")[:, 0]):
                entries = (LabeledPoints(_MAP_ID, rows),)
                self.writer.add_annotation(_label_annotation(label, entries, self.names, taken))
        self.writer.finish()

    def _column(self, name: str) -> AnyArray:
        kind, width = _KINDS[name]
        path = self.folder / name
        if name not in self._files or not path.stat().st_size:
            return np.zeros((0, width), kind)
        column: AnyArray = np.memmap(path, kind, mode="r").reshape(-1, width)
        return column


_Sinks = Mapping[str, Any]  # the open outputs of a colouring, by what they hold


def _open_sinks(
    aligned: Aligned, wanted: ColourOutputs, settings: ColourSettings, colouring: _SweepColouring, stack: ExitStack
) -> dict[str, Any]:
    """Open every wanted output; an error later removes all of them again."""
    sinks: dict[str, Any] = {}
    scene, overwrite = aligned.scene, wanted.overwrite
    names = {} if colouring.labels is None else colouring.labels.names
    columns = _Columns(settings.labels is not None, settings.provenance, aligned.origin_world)
    if wanted.map is not None:
        sinks["map"] = _open_map(aligned, wanted.map, settings, columns, names, stack, overwrite=overwrite)
    if wanted.per_sweep is not None and wanted.per_sweep.suffix.lower() == _SCENE_SUFFIX:
        sink = SceneSink.open(aligned, wanted.per_sweep, stack, Skips(lenient=False), overwrite=overwrite)
        sinks["scene"] = _SweepScene(sink, names, {annotation.id for annotation in scene.annotations})
    elif wanted.per_sweep is not None:
        suffix = "" if wanted.map is None else wanted.map.suffix.lower()
        suffix = suffix if suffix in WRITTEN_SUFFIXES else ".ply"
        folder = stack.enter_context(filling(wanted.per_sweep, overwrite=overwrite))
        sinks["sweeps"] = _SweepFiles(lidar_folders(folder, scene), suffix, columns)
    if wanted.images is not None:
        sinks["images"] = ImageSink.open(aligned, wanted.images, stack, overwrite=overwrite, sweeps=False)
    if wanted.project_labels is not None:
        folder = stack.enter_context(filling(wanted.project_labels, overwrite=overwrite))
        sinks["label images"] = _LabelProjection(scene, folder, colouring, settings.label_radius_px)
    return sinks


def _open_map(
    aligned: Aligned,
    target: Path,
    settings: ColourSettings,
    columns: _Columns,
    names: Mapping[int, str],
    stack: ExitStack,
    *,
    overwrite: bool,
) -> _MapSink:
    # what does not fit into memory
    rest = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="sceneloom-map-")))
    cubes = None
    if settings.voxel is not None:
        (rest / "tiles").mkdir()
        cubes = WorldMap(settings.voxel, rest / "tiles")
    if target.suffix.lower() != _SCENE_SUFFIX:
        return _MapSink(stack.enter_context(open_cloud_writer(target, overwrite=overwrite)), columns, cubes)
    (rest / "columns").mkdir()
    writer = stack.enter_context(SceneWriter(target, overwrite=overwrite))
    writer.set_metadata(aligned.provenance())
    scene = _MapScene(writer, rest / "columns", names)
    return _MapSink(scene, _Columns(columns.labels, provenance=False), cubes, complete=scene.close)


@dataclass(slots=True)
class _Job:
    """One colouring under way; counts have the names of the fields of `ColourReport`."""

    aligned: Aligned
    source: Scene
    settings: ColourSettings
    skips: Skips
    progress: Progress | None
    statistics: FusionStatistics = field(init=False)
    boxes: MovingBoxes = field(init=False)
    removed_in_boxes: int = 0
    removed_by_rays: int = 0
    unjudged: int = 0
    guessed: int = 0
    coloured: int = 0
    labelled: int = 0
    classes: set[int] = field(default_factory=set)
    _done: int = 0
    _ahead: int = 0

    def __post_init__(self) -> None:
        self.statistics = FusionStatistics.of(self.aligned)
        self.boxes = MovingBoxes.of(self.aligned.scene)

    def compare_exposures(self) -> ExposureGains:
        """Look at the drive a first time, at what several images show."""
        every = max(1, -(-self.aligned.sweeps // _MOST_COMPARED))
        scene = self.aligned.scene
        sensors = (
            replace(sensor, frames=sensor.frames[::every]) if isinstance(sensor, LidarSensor) else sensor
            for sensor in scene.sensors
        )
        thinned = replace(scene, sensors=tuple(sensors))
        self._ahead = sum(len(lidar.frames) for lidar in thinned.lidars)
        index = {camera.id: k for k, camera in enumerate(scene.cameras)}
        links = ExposureLinks()
        for frame in play(thinned, self._system(), self.skips):
            if frame.views:
                points_world = frame.views[0].points_world
                links.add(points_world, frame.views, [index[view.camera_id] for view in frame.views])
            self._step()
        return links.solve()

    def run(self, colouring: _SweepColouring, sinks: _Sinks) -> None:
        """Colour every sweep and give it to the outputs."""
        locations = self._locations() if self.settings.remove_moving else {}
        lags = {lidar.id: lags_for(len(lidar.frames)) for lidar in self.aligned.scene.lidars}
        finders: dict[Identifier, MovingPoints[_ColouredSweep]] = {}
        for frame in play(self.aligned.scene, self._system(), self.skips):
            self.statistics.add(frame)
            self._step()
            if frame.unfused is not None:
                continue
            if "label images" in sinks:
                sinks["label images"].add(frame)
            sweep = colouring.colour(frame)
            self.coloured += int((sweep.points["camera"] != 255).sum())
            if self.settings.labels is not None:
                stated = sweep.points["label"][sweep.points["label"] != NO_LABEL]
                self.labelled += len(stated)
                self.classes.update(np.unique(stated).tolist())
            if not self.settings.remove_moving:
                self._give(sweep, np.ones(len(sweep.points), np.bool_), sinks)
                continue
            location = locations[frame.lidar_id]
            measured = LidarFrame(frame.timestamp_ns, sweep.frame.points)
            trajectory = None if location is None else LidarTrajectory.of(measured, location)
            self.unjudged += trajectory is None
            finder = finders.setdefault(frame.lidar_id, MovingPoints(lags[frame.lidar_id]))
            self._give_judged(finder.add(sweep, sweep.frame.points.positions, trajectory), sinks)
        for finder in finders.values():
            self._give_judged(finder.flush(), sinks)
        check_any_placed(self.source, self.statistics.unfused, self.statistics.frames)

    def _give_judged(self, judged: Iterator[tuple[_ColouredSweep, BoolArray]], sinks: _Sinks) -> None:
        for sweep, moving in judged:
            times, positions = sweep.points["time_ns"], sweep.points["position"]
            in_boxes = self.boxes.inside(np.ascontiguousarray(positions), np.ascontiguousarray(times))
            self.removed_in_boxes += int(in_boxes.sum())
            self.removed_by_rays += int((moving & ~in_boxes).sum())
            self._give(sweep, ~(moving | in_boxes), sinks)

    def _give(self, sweep: _ColouredSweep, kept: BoolArray, sinks: _Sinks) -> None:
        if self.settings.only_coloured:
            kept = kept & (sweep.points["weight"] > 0)
        rest = sweep.kept(kept)
        for kind, sink in sinks.items():
            if kind != "label images":  # which takes sweeps with their images
                sink.add(rest.frame if kind == "images" else rest)

    def _locations(self) -> dict[Identifier, PoseSource | None]:
        """From where the lidars measured; the middle of the cameras stands for an unknown position."""
        scene, ego, reach_ns = self.aligned.scene, self.aligned.ego, scene_period_ns(self.aligned.scene)
        mounts = [camera.mount.translation for camera in scene.cameras if camera.mount is not None]
        locations = {lidar.id: lidar_position(scene, lidar, ego, reach_ns=reach_ns) for lidar in scene.lidars}
        for lidar_id, location in locations.items():
            if location is None and ego is not None and mounts:
                middle = RigidTransform(np.eye(3), np.mean(mounts, axis=0))
                locations[lidar_id] = PoseSource(ego.path, middle, reach_ns)
                self.guessed += 1
        return locations

    def _system(self) -> FusionSystem:
        configuration = FusionConfiguration(visibility=VisibilitySettings(threads=self.settings.threads))
        return build_system(self.aligned.scene, self.aligned.ego, configuration, self.skips)

    def _step(self) -> None:
        self._done += 1
        if self.progress is not None:
            self.progress(self._done, self._ahead + self.aligned.sweeps)

    def warnings(self) -> tuple[DataWarning, ...]:
        """What had to be assumed, beyond what the scene and the sweeps report."""
        unjudged = (
            "it is not known from where these sweeps were measured; their moving points stay, except those in "
            "annotated boxes"
        )
        guessed = (
            "the position of a lidar whose points come in the ego's frame is not known; the middle of the cameras "
            "stands for it in the search for moving points"
        )
        found = (
            assumed("moving-points-unjudged", "sensors[]", unjudged, count=self.unjudged),
            assumed("lidar-location-guessed", "sensors[]", guessed, count=self.guessed),
        )
        reported = reported_once(self.aligned.scene.warnings, self.statistics.warnings())
        return (*reported, *(warning for warning in found if warning.count))


def colour(
    scene: Scene, output: str | Path | None = None, *, trajectory: str | None = None, heading: str | None = None,
    start: float | None = None, stop: float | None = None, settings: ColourSettings | None = None,
    outputs: ColourOutputs | None = None, lenient: bool = False, progress: Progress | None = None,
) -> ColourReport:  # fmt: skip
    """Colour the points of a drive from all cameras that see them, and write them as one map, or sweep by sweep.

    Memory depends on the sweeps in flight and on the tiles of the map around them, not on the length of the drive.

    Args:
        output: the map to write; the same as `outputs.map`.
        trajectory: name of the ego trajectory; "identity" for an ego that is stationary; "lidar" to find it from the
            sweeps; None for the scene's default, which is found from the sweeps where the scene has none.
        heading: "motion" to derive orientations where the trajectory has positions only.
        start: seconds after the scene's first timestamp, None for the beginning.
        stop: seconds after it, exclusive, None for the end.
        lenient: count sweeps and images that cannot be read, and go on.
        progress: reported after each sweep; those that exposures are reported by count, too.

    Returns:
        What was done, in numbers.

    Raises:
        PoseError: the sensors' motion is not known, or at the time of no sweep.
        DataError: there is no lidar, something cannot be read, or a label image does not fit its image.
        OutputError: an output exists, or cannot be written.
        OptionError: a value is not one that can be followed.
    """
    begun, chosen = time.perf_counter(), settings or ColourSettings()
    wanted = outputs or ColourOutputs()
    wanted = wanted if output is None else replace(wanted, map=Path(output))
    wanted.check()
    check_has_lidar(scene, "colouring needs")
    scene = scene.corrected()
    aligned = align(scene, trajectory=trajectory, heading=heading, start=start, stop=stop, lenient=lenient)
    job = _Job(aligned, scene, chosen, Skips(lenient), progress)
    with telling(job.skips), counting_left_out() as left, ExitStack() as stack:
        labels = None if chosen.labels is None else _LabelFolder.of(chosen.labels, scene.cameras)
        gains = job.compare_exposures() if chosen.exposure and len(scene.cameras) else None
        colouring = _SweepColouring(scene, gains, labels)
        sinks = _open_sinks(aligned, wanted, chosen, colouring, stack)
        job.run(colouring, sinks)
        for sink in sinks.values():
            sink.finish()
    kinds = [kind for kind in ("sweeps", "label images", "images") if kind in sinks]
    return report_of(
        ColourReport,
        job.statistics,
        source=scene.source,
        output=None if wanted.map is None else str(wanted.map),
        trajectory=aligned.trajectory,
        skipped=job.skips.reasons,
        coloured_percent=percent(job.coloured, job.statistics.points),
        removed_in_boxes=job.removed_in_boxes,
        removed_by_rays=job.removed_by_rays,
        unjudged=job.unjudged,
        written=sinks["map"].written if "map" in sinks else 0,
        exposure=None if gains is None else _ExposureReport.of(gains, [camera.id for camera in scene.cameras]),
        labels=_label_report(job, colouring, sinks.get("label images")),
        files={kind: sinks[kind].written for kind in kinds},
        seconds=time.perf_counter() - begun,
        warnings=(*job.warnings(), *left.warnings),
    )


def _label_report(job: _Job, colouring: _SweepColouring, drawn: _LabelProjection | None) -> _LabelReport | None:
    painted = colouring.labels
    if painted is None and drawn is None:
        return None
    return _LabelReport(
        images=0 if painted is None else painted.used,
        missing=0 if painted is None else painted.missing,
        points=job.labelled,
        drawn=0 if drawn is None else drawn.written,
        classes=len(job.classes) if painted is not None or drawn is None else len(drawn.numbers),
    )
