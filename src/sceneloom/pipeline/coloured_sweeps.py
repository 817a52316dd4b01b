"""Coloured sweeps with labels and provenance, and where they are written: one map, a file per sweep, a scene.

Label images, visualisations.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from math import isfinite
from pathlib import Path
from typing import BinaryIO, Protocol

import msgspec
import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float64Array, Int64Array, UInt8Array, UInt16Array
from sceneloom.colouring.blending import (
    BlendSettings,
    PointSources,
    blend_colours,
    estimate_normals,
    view_weights,
)
from sceneloom.colouring.exposure import ExposureGains
from sceneloom.colouring.labels import LabelCanvas, paint_labels
from sceneloom.colouring.results import FusedFrame, FusedView
from sceneloom.colouring.world_map import WorldMap, empty_points
from sceneloom.editing.move_points import chosen_points
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.label_images import NAMES_FILE, LabelFolder, write_label_png
from sceneloom.formats.base.output import check_output, filling
from sceneloom.formats.points.cloud import NO_LABEL, CloudWriter, WrittenPoints
from sceneloom.formats.points.files import WRITTEN_SUFFIXES, check_cloud_suffix, open_cloud_writer
from sceneloom.formats.sfs.writer import SceneWriter
from sceneloom.pipeline.alignment import Aligned, provenance
from sceneloom.pipeline.fusing import (
    FusionOutputs,
    SceneSink,
    lidar_folders,
    names_of,
    open_scene_sink,
    spread,
)
from sceneloom.scene.annotations import LabeledPoints, LabeledPointsAnnotation
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarPoints, PointsSensor, grey_where_unseen
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, Key, key_of
from sceneloom.visualization.fused_frames import MOST_SWEEPS, DriveCloud

_BLENDS = ("nearest", "best", "weighted")
"""How the colours of several images become one: that of the pixel nearest to an image's middle, that which is
trusted most, between pixels, or the mean of all that agree with it."""

_SCENE_SUFFIX = ".sfs"


@dataclass(frozen=True, slots=True, kw_only=True)
class ColourSettings:
    """How a drive is coloured.

    Attributes:
        blend: one of `_BLENDS`.
        exposure: whether differences in exposure are evened out.
        voxel: side of the cubes of which the map keeps one point each [m]; None: it keeps all points.
        remove_moving: whether points on what moved are left out.
        labels: folder of label images that are painted onto the points.
        only_coloured: whether points that no image shows are left out.
        provenance: whether clouds report each point camera, image, pixel and weight.
        label_radius_px: of the square that a point fills in projected label images beside its pixel.
        threads: how many share the work on a sweep; what they give is the same.

    Raises:
        OptionError: a value is not one that can be followed.
    """

    blend: str = "weighted"
    exposure: bool = True
    voxel: float | None = None
    remove_moving: bool = False
    labels: Path | None = None
    only_coloured: bool = False
    provenance: bool = False
    label_radius_px: int = 0
    threads: int = 1

    def __post_init__(self) -> None:
        if self.blend not in _BLENDS:
            raise OptionError(f"blend {self.blend!r}; expected one of {', '.join(_BLENDS)}")
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
        overwrite: whether outputs that exist may be replaced.
    """

    map: Path | None = None
    per_sweep: Path | None = None
    project_labels: Path | None = None
    images: Path | None = None
    overwrite: bool = False

    @property
    def sweep_suffix(self) -> str:
        """Ending of the clouds of single sweeps: that of the map, if it can be one."""
        suffix = "" if self.map is None else self.map.suffix.lower()
        return suffix if suffix in WRITTEN_SUFFIXES else ".ply"

    @property
    def scene_of_sweeps(self) -> bool:
        """Whether the sweeps go into one scene file."""
        return self.per_sweep is not None and self.per_sweep.suffix.lower() == _SCENE_SUFFIX

    def check(self) -> None:
        """Refuse outputs that cannot be, before much is done.

        Raises:
            OptionError: there is nothing to write, a suffix is unknown, or two outputs have one name.
            OutputError: an output exists, or its folder is missing.
        """
        locations = [
            location
            for location in (self.map, self.per_sweep, self.project_labels, self.images)
            if location is not None
        ]
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


_NO_IMAGE = -1


@dataclass(frozen=True, slots=True, eq=False)
class ColouredSweep:
    """A fused sweep without its images, and its points as rows of a map.

    Attributes:
        frame: the sweep with its new colours; `views` are left out, which hold whole images.
        points: (N,) of dtype `POINT`.
    """

    frame: FusedFrame
    points: AnyArray


@dataclass(slots=True)
class SweepColouring:
    """Colours sweeps.

    Attributes:
        scene: what the images are of, as read: their numbers are those in its cameras.
        blend: "nearest", "best" or "weighted".
        gains: what evens out the exposures; None: they stay.
        labels: label images; None for none.
    """

    scene: Scene
    blend: str
    gains: ExposureGains | None = None
    labels: LabelFolder | None = None
    _cameras: dict[Identifier, tuple[int, CameraSensor]] = field(default_factory=dict)
    _numbers: dict[Identifier, Mapping[int, int]] = field(default_factory=dict)
    _images: dict[Identifier, tuple[int, UInt16Array | None]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._cameras = {camera.id: (k, camera) for k, camera in enumerate(self.scene.cameras)}
        for camera in self.scene.cameras:
            timestamps = camera.images.timestamps_ns.tolist()
            self._numbers[camera.id] = {time_ns: k for k, time_ns in reversed([*enumerate(timestamps)])}

    def indices(self, views: Sequence[FusedView]) -> list[int]:
        """The numbers of the cameras of views among the scene's."""
        return [self._cameras[view.camera_id][0] for view in views]

    def number(self, view: FusedView) -> int:
        """The number of a view's image in its camera."""
        return self._numbers[view.camera_id].get(view.timestamp_ns, _NO_IMAGE)

    def colour(self, frame: FusedFrame) -> ColouredSweep:
        """Give a fused sweep its colours and labels.

        Raises:
            DataError: a label image cannot be read, or has another size than its image.
        """
        points_world = _points_of(frame)
        times = frame.points.timestamps_ns
        colors, sources = self._colours(frame, points_world, times)
        points = empty_points(len(points_world))
        points["position"] = points_world
        points["color"], points["weight"] = colors, sources.weights
        points["camera"], points["pixel"] = sources.camera_index, sources.pixels
        for view in frame.views:
            of_view = sources.camera_index == self._cameras[view.camera_id][0]
            points["image"][of_view] = self.number(view)
        if frame.points.intensities is not None:
            points["intensity"] = frame.points.intensities
        points["time_ns"] = frame.timestamp_ns if times is None else times
        if self.labels is not None:
            images = [self._label_image(view, self.labels) for view in frame.views]
            points["label"] = paint_labels(points_world, frame.views, images, timestamps_ns=times)
        coloured = replace(frame.points, colors=colors, camera_index=sources.camera_index)
        return ColouredSweep(replace(frame, points=coloured, views=()), points)

    def _colours(
        self, frame: FusedFrame, points_world: Float64Array, times: Int64Array | None
    ) -> tuple[UInt8Array, PointSources]:
        indices = self.indices(frame.views)
        gains = {} if self.gains is None else self.gains.for_views(frame.views, indices)
        if self.blend == "nearest":
            return _nearest(frame, indices, gains, points_world, times)
        normals = None
        if frame.views:
            eyes = [view.world_from_camera.translation for view in frame.views]
            normals = estimate_normals(points_world, np.mean(eyes, axis=0))
        settings = BlendSettings(mode=self.blend)
        blended = blend_colours(
            points_world,
            frame.views,
            indices,
            settings=settings,
            normals_world=normals,
            timestamps_ns=times,
            gains=gains,
        )
        return blended.colors, blended.sources

    def _label_image(self, view: FusedView, labels: LabelFolder) -> UInt16Array | None:
        """The label image of an image, read once where several sweeps are paired with it."""
        number = self.number(view)
        kept = self._images.get(view.camera_id)
        if kept is None or kept[0] != number:
            camera = self._cameras[view.camera_id][1]
            kept = number, labels.image(camera, number, (view.camera.width, view.camera.height))
            self._images[view.camera_id] = kept
        return kept[1]


def _points_of(frame: FusedFrame) -> Float64Array:
    """Positions in the world, before they were rounded to float32 where an image was found."""
    return frame.views[0].points_world if frame.views else frame.points.positions.astype(np.float64)


def _nearest(
    frame: FusedFrame,
    indices: Sequence[int],
    gains: Mapping[int, Float64Array],
    points_world: Float64Array,
    times: Int64Array | None,
) -> tuple[UInt8Array, PointSources]:
    """The colours that the fusion gave, with their provenance."""
    sources = PointSources.none(len(frame.points))
    if frame.points.colors is None or frame.points.camera_index is None:
        return np.full((len(frame.points), 3), 255, np.uint8), sources
    colors, chosen = frame.points.colors.copy(), frame.points.camera_index
    sources.camera_index[:] = chosen
    for view, index in zip(frame.views, indices, strict=True):
        rows = np.flatnonzero(chosen[view.point_ids] == index)
        ids = view.point_ids[rows]
        sources.images_ns[ids], sources.pixels[ids] = view.timestamp_ns, view.pixels[rows]
        sources.weights[ids] = view_weights(points_world, view, BlendSettings(), timestamps_ns=times)[rows]
        if index in gains:
            colors[ids] = np.rint(np.clip(colors[ids] * gains[index], 0, 255)).astype(np.uint8)
    return colors, sources


_CANVASES = 2
"""Images of a camera that are drawn at once: sweeps of several lidars may meet them alternately."""


def _numbered_labels(scene: Scene) -> dict[str, int]:
    """The number of each label of labelled points: the label itself where all are numbers, else 1, 2, … by name.

    Raises:
        DataError: there are no labelled points, or too many different labels.
    """
    names = sorted({_name(each) for each in _labelled(scene)})
    if not names:
        raise DataError(
            scene.source, "annotations", "no labelled points in it; expected labels of lidar frames"
        )
    if len(names) >= NO_LABEL:
        raise DataError(scene.source, "annotations", f"{len(names)} labels; expected at most {NO_LABEL - 1}")
    if all(name.isascii() and name.isdigit() and 0 < int(name) < NO_LABEL for name in names):
        return {name: int(name) for name in names}
    return {name: k for k, name in enumerate(names, 1)}


def _labelled(scene: Scene) -> list[LabeledPointsAnnotation]:
    return [each for each in scene.annotations if isinstance(each, LabeledPointsAnnotation)]


def _name(annotation: LabeledPointsAnnotation) -> str:
    return str(annotation.id) if annotation.label is None else annotation.label


@dataclass(slots=True)
class _LabelProjection:
    """Draws labels: `<camera>/<image number>.png`, 0 where no labelled point is, and what the numbers mean.

    Attributes:
        scene: with labelled points, whose frames are counted as the results of the fusion are.
        folder: an empty folder.
        names: folder of each camera.
        colouring: knows the numbers of images.
        radius_px: of the square that a point fills beside its pixel.
        written: images so far.
    """

    scene: Scene
    folder: Path
    names: Mapping[Identifier, str]
    colouring: SweepColouring
    radius_px: int = 0
    written: int = 0
    numbers: dict[str, int] = field(default_factory=dict)
    _entries: dict[tuple[Key, int], list[tuple[int, Sequence[int]]]] = field(default_factory=dict)
    _open: dict[Identifier, dict[int, LabelCanvas]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.numbers = _numbered_labels(self.scene)
        for annotation in _labelled(self.scene):
            for entry in annotation.labeled_points:
                if entry.sensor_frame is not None:
                    key = (key_of(entry.sensor_id), entry.sensor_frame)
                    reported = (self.numbers[_name(annotation)], entry.point_ids)
                    self._entries.setdefault(key, []).append(reported)  # type: ignore[arg-type]

    def add(self, frame: FusedFrame) -> None:
        """Draw the labels of one sweep into its images.

        Raises:
            DataError: a label names a point that the sweep does not have.
        """
        labels = self._labels(frame)
        for view in frame.views:
            canvases = self._open.setdefault(view.camera_id, {})
            number = self.colouring.number(view)
            if number not in canvases:
                if len(canvases) == _CANVASES:
                    self._write(view.camera_id, next(iter(canvases)))
                width, height = view.camera.width, view.camera.height
                canvases[number] = LabelCanvas.blank(width, height, radius_px=self.radius_px)
            canvases[number].draw(view, labels)

    def _labels(self, frame: FusedFrame) -> UInt16Array:
        labels = np.full(len(frame.points), NO_LABEL, np.uint16)
        for number, ids in self._entries.get((key_of(frame.lidar_id), frame.index), ()):
            if len(ids) and int(np.max(ids)) >= len(labels):
                location = f"annotations[].labeled_points[{frame.lidar_id}, frame {frame.index}]"
                problem = f"point {int(np.max(ids))}; expected numbers below {len(labels)}"
                raise DataError(self.scene.source, location, problem)
            labels[np.asarray(ids)] = number
        return labels

    def _write(self, camera_id: Identifier, number: int) -> None:
        canvas = self._open[camera_id].pop(number)
        folder = self.folder / self.names[camera_id]
        folder.mkdir(parents=True, exist_ok=True)
        write_label_png(canvas.labels, folder / f"{number:06d}.png", overwrite=True)
        self.written += 1

    def finish(self) -> None:
        """Write the last images, and what the numbers mean."""
        for camera_id, canvases in self._open.items():
            for number in [*canvases]:
                self._write(camera_id, number)
        reported = {str(number): name for name, number in self.numbers.items()}
        (self.folder / NAMES_FILE).write_bytes(msgspec.json.format(msgspec.json.encode(reported), indent=2))


class _ColourSink(Protocol):
    """Takes coloured sweeps, one after another."""

    def add(self, sweep: ColouredSweep, kept: BoolArray) -> None:
        """Take one sweep; `kept` (N,) are the points that stay."""
        ...


@dataclass(frozen=True, slots=True)
class _Columns:
    """What clouds report their points.

    Attributes:
        labels: whether they have labels.
        provenance: whether they name camera, image, pixel and weight.
        origin_world: (3,) [m], what is added to positions.
    """

    labels: bool
    provenance: bool
    origin_world: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def written(self, points: AnyArray) -> WrittenPoints:
        """Rows of a map (N,) of dtype `POINT` as the columns of a file."""
        extras: dict[str, AnyArray] = {"camera": np.ascontiguousarray(points["camera"])}
        if self.provenance:
            extras["image"] = np.ascontiguousarray(points["image"])
            extras["u"], extras["v"] = (np.ascontiguousarray(points["pixel"][:, k]) for k in range(2))
            extras["weight"] = np.ascontiguousarray(points["weight"])
        return WrittenPoints(
            points["position"] + np.array(self.origin_world),
            grey_where_unseen(np.rint(np.clip(points["color"], 0, 255)).astype(np.uint8), points["camera"]),
            np.rint(np.clip(points["intensity"], 0, 255)).astype(np.uint8),
            np.ascontiguousarray(points["time_ns"]),
            np.ascontiguousarray(points["label"]) if self.labels else None,
            extras,
        )


@dataclass(slots=True)
class _MapSink:
    """Writes the drive as one cloud, each point, or one for each cube of space.

    Attributes:
        writer: the open file.
        columns: of the file.
        cubes: gathers the points; None: all of them are written at once.
        complete: what completes the file, where nobody else does.
        written: points in the file.
    """

    writer: CloudWriter
    columns: _Columns
    cubes: WorldMap | None = None
    complete: Callable[[], None] | None = None
    written: int = 0

    def add(self, sweep: ColouredSweep, kept: BoolArray) -> None:
        """Take one sweep."""
        points = sweep.points[kept]
        if self.cubes is None:
            self._write(points[np.isfinite(points["position"]).all(axis=1)])
        else:
            self.cubes.add(points)

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

    def add(self, sweep: ColouredSweep, kept: BoolArray) -> None:
        """Write one sweep."""
        folder = self.folders[sweep.frame.lidar_id]
        folder.mkdir(parents=True, exist_ok=True)
        with open_cloud_writer(folder / f"{sweep.frame.index:06d}{self.suffix}") as writer:
            writer.add(self.columns.written(sweep.points[kept]))
        self.written += 1


@dataclass(slots=True)
class _SweepScene:
    """Writes the sweeps into a scene file whose other sensors stand in it already, with their labels.

    Attributes:
        sink: the open file.
        names: what labels are called, as far as it is stated.
        taken: ids of annotations that are in the file.
    """

    sink: SceneSink
    names: Mapping[int, str]
    taken: set[Identifier]
    _labelled: dict[int, list[LabeledPoints]] = field(default_factory=dict)
    _frames: dict[Identifier, int] = field(default_factory=dict)

    def add(self, sweep: ColouredSweep, kept: BoolArray) -> None:
        """Write one sweep."""
        frame = replace(sweep.frame, points=_kept_points(sweep.frame.points, kept))
        self.sink.add(frame)
        number = self._frames.get(frame.lidar_id, 0)
        self._frames[frame.lidar_id] = number + 1
        for label, rows in _rows_of_labels(sweep.points["label"][kept]):
            entry = LabeledPoints(frame.lidar_id, rows, sensor_frame=number)
            self._labelled.setdefault(label, []).append(entry)

    def finish(self) -> None:
        """Add the labels, and complete the file."""
        for label in sorted(self._labelled):
            self.sink.writer.add_annotation(
                _label_annotation(label, tuple(self._labelled[label]), self.names, self.taken)
            )
        self.sink.finish()


def _kept_points(points: LidarPoints, kept: BoolArray) -> LidarPoints:
    """Those points of a sweep that are kept, with all their fields."""
    return points if kept.all() else chosen_points(points, np.flatnonzero(kept))


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
    return LabeledPointsAnnotation(
        annotation_id, entries, label=names.get(label, str(label)), is_instance=False
    )


@dataclass(slots=True)
class _CloudImages:
    """Draws the drive as one cloud."""

    folder: Path
    cloud: DriveCloud
    ego_poses: Poses | None
    written: int = 0

    def add(self, sweep: ColouredSweep, kept: BoolArray) -> None:
        """Gather one sweep."""
        self.cloud.add(replace(sweep.frame, points=_kept_points(sweep.frame.points, kept)))

    def finish(self) -> None:
        """Draw the drive."""
        self.written += len(self.cloud.save(self.folder, self.ego_poses))


MAP_ID = "map"

_KINDS = {"positions": ("f4", 3), "colors": ("u1", 3), "labels": ("u2", 1)}


@dataclass(slots=True)
class MapScene:
    """Writes points piece by piece to files, and at the end those as one sensor of a scene.

    Attributes:
        writer: the open scene file.
        folder: an empty folder for the files in between.
        names: what labels are called, as far as it is stated.
    """

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
        self.writer.add_sensor(PointsSensor(MAP_ID, positions, colors))
        if "labels" in self._files:
            taken: set[Identifier] = set()
            for label, rows in _rows_of_labels(self._column("labels")[:, 0]):
                entries = (LabeledPoints(MAP_ID, rows),)
                self.writer.add_annotation(_label_annotation(label, entries, self.names, taken))
        self.writer.finish()

    def _column(self, name: str) -> AnyArray:
        kind, width = _KINDS[name]
        path = self.folder / name
        if name not in self._files or not path.stat().st_size:
            return np.zeros((0, width), kind)
        column: AnyArray = np.memmap(path, kind, mode="r").reshape(-1, width)
        return column


@dataclass(slots=True)
class ColourSinks:
    """The open outputs of a colouring."""

    map: _MapSink | None = None
    sweeps: _SweepFiles | None = None
    scene: _SweepScene | None = None
    images: _CloudImages | None = None
    projection: _LabelProjection | None = None

    @property
    def all(self) -> list[_ColourSink]:
        """Those that take every coloured sweep."""
        return [sink for sink in (self.map, self.sweeps, self.scene, self.images) if sink is not None]

    @property
    def files(self) -> dict[str, int]:
        """How many files of which kind were written."""
        kinds = {"sweeps": self.sweeps, "label images": self.projection, "images": self.images}
        return {kind: sink.written for kind, sink in kinds.items() if sink is not None}

    def finish(self) -> None:
        """Complete them."""
        for sink in (self.map, self.scene, self.images, self.projection):
            if sink is not None:
                sink.finish()


def open_colour_sinks(
    aligned: Aligned,
    wanted: ColourOutputs,
    settings: ColourSettings,
    colouring: SweepColouring,
    stack: ExitStack,
    rest: Path,
) -> ColourSinks:
    """Open every wanted output; what goes wrong later takes all of them away again.

    Args:
        rest: an empty folder for what does not fit into the memory.

    Raises:
        OutputError: an output exists, or cannot be made.
        DataError: labels are to be projected, and there are none.
    """
    x, y, z = aligned.origin_world.tolist()
    columns = _Columns(settings.labels is not None, settings.provenance, (x, y, z))
    sinks = ColourSinks()
    if wanted.map is not None:
        sinks.map = _open_map(aligned, wanted.map, wanted, settings, colouring, stack, rest)
    if wanted.per_sweep is not None and wanted.scene_of_sweeps:
        sinks.scene = _open_scene(aligned, wanted.per_sweep, wanted, colouring, stack)
    elif wanted.per_sweep is not None:
        folder = stack.enter_context(filling(wanted.per_sweep, overwrite=wanted.overwrite))
        sinks.sweeps = _SweepFiles(lidar_folders(folder, aligned.scene), wanted.sweep_suffix, columns)
    if wanted.images is not None:
        folder = stack.enter_context(filling(wanted.images, overwrite=wanted.overwrite))
        cloud = DriveCloud(spread(aligned.scene, MOST_SWEEPS))
        sinks.images = _CloudImages(folder, cloud, None if aligned.ego is None else aligned.ego.path)
    if wanted.project_labels is not None:
        folder = stack.enter_context(filling(wanted.project_labels, overwrite=wanted.overwrite))
        names = names_of(aligned.scene.cameras)
        sinks.projection = _LabelProjection(aligned.scene, folder, names, colouring, settings.label_radius_px)
    return sinks


def _open_map(
    aligned: Aligned,
    target: Path,
    wanted: ColourOutputs,
    settings: ColourSettings,
    colouring: SweepColouring,
    stack: ExitStack,
    rest: Path,
) -> _MapSink:
    names = {} if colouring.labels is None else colouring.labels.names
    labels = settings.labels is not None
    cubes = None
    if settings.voxel is not None:
        (rest / "tiles").mkdir()
        cubes = WorldMap(settings.voxel, rest / "tiles", mean=settings.blend == "weighted")
    if target.suffix.lower() != _SCENE_SUFFIX:
        x, y, z = aligned.origin_world.tolist()
        writer = stack.enter_context(open_cloud_writer(target, overwrite=wanted.overwrite))
        return _MapSink(writer, _Columns(labels, settings.provenance, (x, y, z)), cubes)
    (rest / "columns").mkdir()
    scene_writer = stack.enter_context(SceneWriter(target, overwrite=wanted.overwrite))
    scene_writer.set_metadata(provenance(aligned))
    scene = MapScene(scene_writer, rest / "columns", names)
    return _MapSink(scene, _Columns(labels, provenance=False), cubes, complete=scene.close)


def _open_scene(
    aligned: Aligned, target: Path, wanted: ColourOutputs, colouring: SweepColouring, stack: ExitStack
) -> _SweepScene:
    names = {} if colouring.labels is None else colouring.labels.names
    sink = open_scene_sink(aligned, FusionOutputs(overwrite=wanted.overwrite), target, stack, None)
    return _SweepScene(sink, names, {annotation.id for annotation in aligned.scene.annotations})
