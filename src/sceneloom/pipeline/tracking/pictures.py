"""Pictures of a tracked drive: the objects over the photographs, and on the map of the sweep."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.formats.file_names import file_stem
from sceneloom.pictures.canvas import PilImage
from sceneloom.pictures.ego import EgoPlace
from sceneloom.pictures.objects import draw_objects_above, draw_objects_in_picture
from sceneloom.pictures.sheets import save_picture
from sceneloom.pipeline.detections.detected import DetectedDrive, poses_at
from sceneloom.pipeline.detections.sweep_points import SweepPoints
from sceneloom.scene.scene import Scene
from sceneloom.scene.tracks import TrackedObjects

_REACH = 40.0
"""From the middle of the map to its upper edge [m]."""
_TRAIL = 20
"""So many sweeps back the ways of objects are drawn."""


def save_tracking_pictures(
    scene: Scene,
    drive: DetectedDrive,
    moments: Sequence[TrackedObjects],
    folder: Path,
    *,
    count: int = 12,
) -> list[Path]:
    """Draw some moments of a tracked drive into a folder, evenly spread over it.

    `<number>_above.png`, and `<number>_<camera>.png` for each camera with a picture within half a sweep.

    Args:
        scene: whose sweeps and pictures; what it does not have is not drawn.
        drive: where the sensors were.
        moments: the objects at each sweep.
        folder: made where it is missing; files of the same names are replaced.
        count: how many moments at most.

    Returns:
        The paths written.

    Raises:
        OutputError: a file cannot be written.
        DataError: a sweep or picture cannot be read.
    """
    rows = np.unique(np.linspace(0, len(moments) - 1, min(count, len(moments))).round().astype(np.int64))
    folder.mkdir(parents=True, exist_ok=True)
    return [
        save_picture(image, folder / name, overwrite=True)
        for row in rows.tolist()
        for name, image in _drawn(scene, drive, moments, row)
    ]


def _drawn(
    scene: Scene, drive: DetectedDrive, moments: Sequence[TrackedObjects], row: int
) -> Iterator[tuple[str, PilImage]]:
    objects = moments[row]
    (world_from_lidar,) = poses_at(drive.source, np.array([objects.timestamp_ns], np.int64))
    ego = EgoPlace(world_from_lidar.translation, _level(world_from_lidar.rotation[:, 0]))
    points = SweepPoints.of(scene, drive.lidar_id, drive.source)
    cloud = None if points is None else points.at(objects.timestamp_ns)
    seen = np.zeros((0, 3)) if cloud is None else world_from_lidar.apply(cloud.astype(np.float64))
    trails = _trails(moments[max(row - _TRAIL, 0) : row + 1])
    yield f"{row:06d}_above.png", draw_objects_above(seen, objects, ego=ego, trails=trails, reach=_REACH)
    for camera in scene.cameras:
        place = drive.cameras.get(camera.id)
        k = _nearest(camera.pictures.timestamps_ns, objects.timestamp_ns, drive.period_ns // 2)
        if place is None or k is None:
            continue
        picture = camera.pictures[k]
        (world_from_camera,) = poses_at(place.source, np.array([picture.timestamp_ns], np.int64))
        drawn = draw_objects_in_picture(picture, objects, world_from_camera, camera.id)
        yield f"{row:06d}_{file_stem(camera.id)}.png", drawn


def _level(forward: Float64Array) -> Float64Array:
    level = forward * (1.0, 1.0, 0.0)
    length = float(np.linalg.norm(level))
    return level / length if length > 0.0 else np.array([1.0, 0.0, 0.0])


def _nearest(times_ns: Int64Array, time_ns: int, within_ns: int) -> int | None:
    if len(times_ns) == 0:
        return None
    k = int(np.abs(times_ns - time_ns).argmin())
    return k if abs(int(times_ns[k]) - time_ns) <= within_ns else None


def _trails(moments: Sequence[TrackedObjects]) -> dict[int, Float64Array]:
    """Where objects were, by number."""
    places: dict[int, list[Float64Array]] = {}
    for moment in moments:
        for number, center in zip(moment.ids.tolist(), moment.centers, strict=True):
            places.setdefault(number, []).append(center)
    return {number: np.array(found) for number, found in places.items()}
