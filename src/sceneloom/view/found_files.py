"""Files of fused detections and of tracked objects, read to be shown."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.errors import ArrayError, DataError
from sceneloom.formats.files import file_faults, open_file
from sceneloom.images.objects import objects_of_fused
from sceneloom.pipeline.detections.files import fused_files, read_fused
from sceneloom.scene.scene import Scene
from sceneloom.scene.tracks import Support, TrackedObjects
from sceneloom.scene.types import Identifier


def read_detections(path: Path) -> tuple[TrackedObjects, ...]:
    """Read what `fuse --type detection` wrote: the objects of each sweep and image, in the world.

    Raises:
        DataError: it is no such file, or faulty.
    """
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
    """One object of a line, as `pipeline.tracking.lines` writes it."""

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


def read_tracks(path: Path, scene: Scene) -> tuple[TrackedObjects, ...]:
    """Read the lines of JSON that `track` wrote.

    Args:
        path: the file.
        scene: whose cameras the boxes in images are of.

    Raises:
        DataError: a line is none of these.
    """
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
