"""The opening of what a colouring writes."""

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from sceneloom.colouring.world_map import WorldMap
from sceneloom.formats.clouds.writing import open_cloud_writer
from sceneloom.formats.output import filling
from sceneloom.formats.sfs.writer import SceneWriter
from sceneloom.images.drive_cloud import MOST_SWEEPS, DriveCloud
from sceneloom.pipeline.aligned.provenance import provenance
from sceneloom.pipeline.aligned.scene import Aligned
from sceneloom.pipeline.colouring.label_projection import LabelProjection
from sceneloom.pipeline.colouring.map_scene import MapScene
from sceneloom.pipeline.colouring.settings import SCENE_SUFFIX, ColourOutputs, ColourSettings
from sceneloom.pipeline.colouring.sinks import (
    CloudImages,
    ColourSink,
    Columns,
    MapSink,
    SweepFiles,
    SweepScene,
)
from sceneloom.pipeline.colouring.sweeps import SweepColouring
from sceneloom.pipeline.fusing.outputs import FusionOutputs, open_scene_sink, spread
from sceneloom.pipeline.fusing.sinks import lidar_folders, names_of


@dataclass(slots=True)
class ColourSinks:
    """The open outputs of a colouring."""

    map: MapSink | None = None
    sweeps: SweepFiles | None = None
    scene: SweepScene | None = None
    images: CloudImages | None = None
    projection: LabelProjection | None = None

    @property
    def all(self) -> list[ColourSink]:
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
    columns = Columns(settings.labels is not None, settings.provenance, (x, y, z))
    sinks = ColourSinks()
    if wanted.map is not None:
        sinks.map = _open_map(aligned, wanted.map, wanted, settings, colouring, stack, rest)
    if wanted.per_sweep is not None and wanted.scene_of_sweeps:
        sinks.scene = _open_scene(aligned, wanted.per_sweep, wanted, colouring, stack)
    elif wanted.per_sweep is not None:
        folder = stack.enter_context(filling(wanted.per_sweep, overwrite=wanted.overwrite))
        sinks.sweeps = SweepFiles(lidar_folders(folder, aligned.scene), wanted.sweep_suffix, columns)
    if wanted.images is not None:
        folder = stack.enter_context(filling(wanted.images, overwrite=wanted.overwrite))
        cloud = DriveCloud(spread(aligned.scene, MOST_SWEEPS))
        sinks.images = CloudImages(folder, cloud, None if aligned.ego is None else aligned.ego.path)
    if wanted.project_labels is not None:
        folder = stack.enter_context(filling(wanted.project_labels, overwrite=wanted.overwrite))
        names = names_of(aligned.scene.cameras)
        sinks.projection = LabelProjection(aligned.scene, folder, names, colouring, settings.label_radius_px)
    return sinks


def _open_map(
    aligned: Aligned,
    target: Path,
    wanted: ColourOutputs,
    settings: ColourSettings,
    colouring: SweepColouring,
    stack: ExitStack,
    rest: Path,
) -> MapSink:
    names = {} if colouring.labels is None else colouring.labels.names
    labels = settings.labels is not None
    cubes = None
    if settings.voxel is not None:
        (rest / "tiles").mkdir()
        cubes = WorldMap(settings.voxel, rest / "tiles", mean=settings.blend == "weighted")
    if target.suffix.lower() != SCENE_SUFFIX:
        x, y, z = aligned.origin_world.tolist()
        writer = stack.enter_context(open_cloud_writer(target, overwrite=wanted.overwrite))
        return MapSink(writer, Columns(labels, settings.provenance, (x, y, z)), cubes)
    (rest / "columns").mkdir()
    scene_writer = stack.enter_context(SceneWriter(target, overwrite=wanted.overwrite))
    scene_writer.set_metadata(provenance(aligned))
    scene = MapScene(scene_writer, rest / "columns", names)
    return MapSink(scene, Columns(labels, provenance=False), cubes, complete=scene.close)


def _open_scene(
    aligned: Aligned, target: Path, wanted: ColourOutputs, colouring: SweepColouring, stack: ExitStack
) -> SweepScene:
    names = {} if colouring.labels is None else colouring.labels.names
    sink = open_scene_sink(aligned, FusionOutputs(overwrite=wanted.overwrite), target, stack, None)
    return SweepScene(sink, names, {annotation.id for annotation in aligned.scene.annotations})
