"""Where coloured sweeps go: one map, a file for each sweep, a scene of the drive, images."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray
from sceneloom.colouring.world_map import WorldMap
from sceneloom.editing.chosen_points import chosen_points
from sceneloom.formats.clouds.writing import open_cloud_writer
from sceneloom.formats.clouds.written import NO_LABEL, CloudWriter, WrittenPoints
from sceneloom.images.drive_cloud import DriveCloud
from sceneloom.pipeline.colouring.sweeps import ColouredSweep
from sceneloom.pipeline.fusing.sinks import SceneSink
from sceneloom.scene.annotations.labelled_points import LabeledPoints, LabeledPointsAnnotation
from sceneloom.scene.clouds import LidarPoints, grey_where_unseen
from sceneloom.scene.poses import Poses
from sceneloom.scene.types import Identifier


class ColourSink(Protocol):
    """Takes coloured sweeps, one after another."""

    def add(self, sweep: ColouredSweep, kept: BoolArray) -> None:
        """Take one sweep; `kept` (N,) are the points that stay."""
        ...


@dataclass(frozen=True, slots=True)
class Columns:
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
class MapSink:
    """Writes the drive as one cloud, each point, or one for each cube of space.

    Attributes:
        writer: the open file.
        columns: of the file.
        cubes: gathers the points; None: all of them are written at once.
        complete: what completes the file, where nobody else does.
        written: points in the file.
    """

    writer: CloudWriter
    columns: Columns
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
class SweepFiles:
    """Writes a cloud for each sweep: `<frame number>.ply`, of several lidars below `<lidar>/`."""

    folders: Mapping[Identifier, Path]
    suffix: str
    columns: Columns
    written: int = 0

    def add(self, sweep: ColouredSweep, kept: BoolArray) -> None:
        """Write one sweep."""
        folder = self.folders[sweep.frame.lidar_id]
        folder.mkdir(parents=True, exist_ok=True)
        with open_cloud_writer(folder / f"{sweep.frame.index:06d}{self.suffix}") as writer:
            writer.add(self.columns.written(sweep.points[kept]))
        self.written += 1


@dataclass(slots=True)
class SweepScene:
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
        frame = replace(sweep.frame, points=kept_points(sweep.frame.points, kept))
        self.sink.add(frame)
        number = self._frames.get(frame.lidar_id, 0)
        self._frames[frame.lidar_id] = number + 1
        for label, rows in rows_of_labels(sweep.points["label"][kept]):
            entry = LabeledPoints(frame.lidar_id, rows, sensor_frame=number)
            self._labelled.setdefault(label, []).append(entry)

    def finish(self) -> None:
        """Add the labels, and complete the file."""
        for label in sorted(self._labelled):
            self.sink.writer.add_annotation(
                label_annotation(label, tuple(self._labelled[label]), self.names, self.taken)
            )
        self.sink.finish()


def kept_points(points: LidarPoints, kept: BoolArray) -> LidarPoints:
    """Those points of a sweep that are kept, with all their fields."""
    return points if kept.all() else chosen_points(points, np.flatnonzero(kept))


def rows_of_labels(labels: AnyArray) -> Iterator[tuple[int, AnyArray]]:
    """Each label of some points, (N,) uint16, and the rows (K,) uint32 that have it."""
    for label in np.unique(labels).tolist():
        if label != NO_LABEL:
            yield label, np.flatnonzero(labels == label).astype(np.uint32)


def label_annotation(
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
class CloudImages:
    """Draws the drive as one cloud."""

    folder: Path
    cloud: DriveCloud
    ego_poses: Poses | None
    written: int = 0

    def add(self, sweep: ColouredSweep, kept: BoolArray) -> None:
        """Gather one sweep."""
        self.cloud.add(replace(sweep.frame, points=kept_points(sweep.frame.points, kept)))

    def finish(self) -> None:
        """Draw the drive."""
        self.written += len(self.cloud.save(self.folder, self.ego_poses))
