"""Fused detections and tracks: boxes, covariances, origins; read from files."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.errors import ArrayError, DataError
from sceneloom.formats.base.files import file_faults, open_file
from sceneloom.geometry.rigid import quaternion_from_matrix
from sceneloom.scene.detections import Support, TrackedObjects
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier
from sceneloom.view.images import image_path
from sceneloom.view.stream import EDGES, WORLD, Feed, Stream, one_packed, sdk
from sceneloom.visualization.figures import colour_of_name


def detection_feeds(stream: Stream, path: Path, origin: Float64Array) -> list[Feed]:
    """Show what `fuse --type detection` wrote, the objects of each camera below an entity of its own.

    Args:
        origin: (3,) float64 [m], subtracted from positions.

    Raises:
        DataError: it is no such file, or faulty.
    """
    return [
        _ObjectsView(stream, ("detections", camera_id), moments, origin, has_history=False).feed
        for camera_id, moments in _by_camera(_read_detections(path)).items()
    ]


def track_feed(stream: Stream, path: Path, scene: Scene, origin: Float64Array) -> Feed:
    """Show the lines of JSON that `track` wrote.

    Args:
        origin: (3,) float64 [m], subtracted from positions.

    Raises:
        DataError: a line is none of these.
    """
    return _ObjectsView(stream, ("tracks",), _read_tracks(path, scene), origin, has_history=True).feed


def _read_detections(path: Path) -> tuple[TrackedObjects, ...]:
    """Read what `fuse --type detection` wrote: the objects of each sweep and image, in the world."""
    # imports kernels and SciPy
    from sceneloom.pipeline.fusing_detections import fused_files, read_fused
    from sceneloom.visualization.objects import objects_of_fused

    if not path.is_file():
        raise DataError(path, "", "no such file; expected the lines that `fuse --type detection` wrote")
    if not fused_files(path):
        raise DataError(path, "", "begins otherwise; expected the lines that `fuse --type detection` wrote")
    _, observations = read_fused(path)
    return tuple(
        objects_of_fused(fused, camera_id, world_from_lidar=seen.world_from_lidar)
        for seen in observations
        for camera_id, fused in seen.fused.items()
    )


_Three = tuple[float, float, float]
_Nine = tuple[float, float, float, float, float, float, float, float, float]


class _Object(msgspec.Struct, frozen=True):
    """One object of a line, as `pipeline.tracking` writes it."""

    id: int
    label: str = msgspec.field(name="class")
    confidence: float
    center: _Three
    size_lwh: _Three
    yaw: float
    velocity: _Three
    support: str
    center_cov: _Nine
    yaw_rate: float = 0.0
    boxes_2d: dict[str, tuple[float, float, float, float]] = {}


class _Line(msgspec.Struct, frozen=True):
    timestamp_ns: int
    objects: tuple[_Object, ...]


def _read_tracks(path: Path, scene: Scene) -> tuple[TrackedObjects, ...]:
    """Read the lines of JSON that `track` wrote."""
    ids = {str(camera.id): camera.id for camera in scene.cameras}
    moments: list[TrackedObjects] = []
    with file_faults(path), open_file(path) as lines:
        for number, text in enumerate(lines, start=1):
            try:
                moments.append(_moment(msgspec.json.decode(text, type=_Line), ids))
            except (msgspec.DecodeError, UnicodeError, RecursionError, ArrayError, KeyError) as error:
                problem = f"{error}; expected a line that `track --format jsonl` wrote"
                raise DataError(path, f"line {number}", problem) from error
    return tuple(sorted(moments, key=lambda moment: moment.timestamp_ns))


def _moment(line: _Line, ids: dict[str, Identifier]) -> TrackedObjects:
    objects, count = line.objects, len(line.objects)
    covariances = np.zeros((count, 10, 10))
    covariances[:, :3, :3] = _columns([one.center_cov for one in objects], 9).reshape(-1, 3, 3)
    cameras = dict.fromkeys(camera for one in objects for camera in one.boxes_2d)
    nowhere = (np.nan,) * 4
    return TrackedObjects(
        timestamp_ns=line.timestamp_ns,
        ids=np.array([one.id for one in objects], np.int64),
        labels=tuple(one.label for one in objects),
        centers=_columns([one.center for one in objects], 3),
        sizes_lwh=_columns([one.size_lwh for one in objects], 3),
        yaws=np.array([one.yaw for one in objects], np.float64),
        velocities=_columns([one.velocity for one in objects], 3),
        yaw_rates=np.array([one.yaw_rate for one in objects], np.float64),
        covariances=covariances,
        scores=np.array([one.confidence for one in objects], np.float64),
        supports=np.array([Support[one.support.upper()] for one in objects], np.uint8),
        corners_xyxy={
            ids[camera]: _columns([one.boxes_2d.get(camera, nowhere) for one in objects], 4)
            for camera in cameras
            if camera in ids
        },
    )


def _columns(rows: Any, width: int) -> Float64Array:
    return np.array(rows, np.float64).reshape(len(rows), width)


_CERTAINTY = 0.95  # an ellipsoid holds the middle of its object with this probability
_HISTORY_NS = 3_000_000_000
_LARGEST = 10.0  # ellipsoids with a longer half axis would hide the others, and are not drawn [m]
_THIN, _THICK = -1.0, -2.0


def ellipsoid(covariances: Float64Array, *, degrees_of_freedom: float = np.inf) -> tuple[Float64Array, Float64Array]:
    """Give the ellipsoids that hold errors of such covariances with the probability `_CERTAINTY`.

    Args:
        covariances: (N, 3, 3) [m²], symmetric.
        degrees_of_freedom: of the Student distribution of errors with these covariances; infinite for a Gaussian one.

    Returns:
        half_sizes: (N, 3) [m], along the axes, ascending.
        quaternions_xyzw: (N, 4), whose rotations have these axes as columns.
    """
    from sceneloom.detections.settings import radius_squared  # imports kernels

    variances, axes = np.linalg.eigh(covariances)
    mirrored = np.linalg.det(axes) < 0
    axes[mirrored, :, 0] *= -1
    scale = np.sqrt(radius_squared(_CERTAINTY, degrees_of_freedom=degrees_of_freedom))
    return scale * np.sqrt(np.maximum(variances, 0.0)), quaternion_from_matrix(axes)


@dataclass(slots=True, eq=False)
class _ObjectsView:
    """Shows what was found at each moment."""

    stream: Stream
    names: tuple[Identifier, ...]
    moments: tuple[TrackedObjects, ...]
    origin: Float64Array  # (3,) [m], what is taken off locations
    has_history: bool
    degrees_of_freedom: float = np.inf
    _trajectories: dict[int, list[tuple[int, Float64Array]]] = field(default_factory=dict)

    @property
    def kind(self) -> str:
        """What the objects are."""
        return str(self.names[0])

    @property
    def feed(self) -> Feed:
        """Its moments in order."""
        return Feed(np.array([moment.timestamp_ns for moment in self.moments], np.int64), self.log)

    def log(self, k: int, _: None) -> None:
        """Log the objects of one moment."""
        moment, base = self.moments[k], self.stream.path(WORLD, *self.names)
        named = moment.ids if self.has_history else moment.labels
        colours = np.array([one_packed(colour_of_name(name)) for name in named], np.uint32)
        self._boxes(moment, base, colours)
        self._ellipsoids(moment, base, colours)
        self._velocities(moment, base, colours)
        self._in_images(moment, colours)
        if self.has_history:
            self._history(moment, base, colours)

    def _boxes(self, moment: TrackedObjects, base: str, colours: np.ndarray) -> None:
        rr, count = sdk(), len(moment)
        halves = moment.yaws / 2
        rotations = np.column_stack([np.zeros((count, 2)), np.sin(halves), np.cos(halves)])
        by_sweep = np.isin(moment.supports, (Support.BOTH, Support.SWEEP))
        boxes = rr.Boxes3D(
            centers=moment.centers - self.origin,
            half_sizes=moment.sizes_lwh / 2,
            quaternions=rotations,
            colors=colours,
            radii=np.where(by_sweep, _THICK, _THIN).astype(np.float32),
            labels=self._names(moment),
            fill_mode=EDGES,
        )
        stated = rr.AnyValues(
            id=[str(one) for one in moment.ids.tolist()],
            existence=moment.scores,
            support=[Support(int(one)).name.lower() for one in moment.supports],
        )
        reported = (stated,) if count else ()
        self.stream.log(moment.timestamp_ns, f"{base}/boxes", boxes, *reported, kind=self.kind, size=200 * count)

    def _names(self, moment: TrackedObjects) -> list[str]:
        if self.has_history:
            return [f"{label} {one}" for label, one in zip(moment.labels, moment.ids.tolist(), strict=True)]
        return [f"{label} {score:.0%}" for label, score in zip(moment.labels, moment.scores.tolist(), strict=True)]

    def _ellipsoids(self, moment: TrackedObjects, base: str, colours: np.ndarray) -> None:
        covariances = moment.covariances[:, :3, :3]
        half_sizes, rotations = ellipsoid(covariances, degrees_of_freedom=self.degrees_of_freedom)
        known = (half_sizes > 0).all(axis=1) & (half_sizes < _LARGEST).all(axis=1)
        shown = sdk().Ellipsoids3D(
            centers=(moment.centers - self.origin)[known],
            half_sizes=half_sizes[known],
            quaternions=rotations[known],
            colors=colours[known],
            fill_mode=EDGES,
        )
        self.stream.log(moment.timestamp_ns, f"{base}/certainty", shown)

    def _velocities(self, moment: TrackedObjects, base: str, colours: np.ndarray) -> None:
        moving = np.isfinite(moment.velocities).all(axis=1) & (np.abs(moment.velocities).max(axis=1, initial=0) > 0.1)
        arrows = sdk().Arrows3D(
            origins=(moment.centers - self.origin)[moving],
            vectors=moment.velocities[moving],
            colors=colours[moving],
            radii=np.full(int(moving.sum()), _THIN, np.float32),
        )
        self.stream.log(moment.timestamp_ns, f"{base}/velocities", arrows)

    def _in_images(self, moment: TrackedObjects, colours: np.ndarray) -> None:
        names = self._names(moment)
        for camera_id, corners in moment.corners_xyxy.items():
            rows = np.flatnonzero(np.isfinite(corners).all(axis=1))
            boxes = sdk().Boxes2D(
                mins=corners[rows, :2],
                sizes=corners[rows, 2:] - corners[rows, :2],
                colors=colours[rows],
                labels=[names[row] for row in rows.tolist()],
            )
            self.stream.log(moment.timestamp_ns, f"{image_path(self.stream, camera_id)}/{self.kind}", boxes)

    def _history(self, moment: TrackedObjects, base: str, colours: np.ndarray) -> None:
        for one, center in zip(moment.ids.tolist(), moment.centers - self.origin, strict=True):
            self._trajectories.setdefault(one, []).append((moment.timestamp_ns, center))
        since = moment.timestamp_ns - _HISTORY_NS
        self._trajectories = {
            one: kept
            for one, trajectory in self._trajectories.items()
            if (kept := [p for p in trajectory if p[0] >= since])
        }
        rows = [row for row, one in enumerate(moment.ids.tolist()) if len(self._trajectories[one]) > 1]
        strips = sdk().LineStrips3D(
            [[center for _, center in self._trajectories[int(moment.ids[row])]] for row in rows],
            colors=colours[rows],
            radii=np.full(len(rows), -1.5, np.float32),
        )
        self.stream.log(moment.timestamp_ns, f"{base}/history", strips)


def _by_camera(moments: tuple[TrackedObjects, ...]) -> dict[Identifier, tuple[TrackedObjects, ...]]:
    """Moments of single cameras, those of each camera together."""
    cameras = dict.fromkeys(camera_id for moment in moments for camera_id in moment.corners_xyxy)
    return {camera_id: tuple(moment for moment in moments if camera_id in moment.corners_xyxy) for camera_id in cameras}
