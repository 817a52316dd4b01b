"""Images of a tracked drive: the objects over the images, and on the map of the sweep."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.formats.file_names import file_stem
from sceneloom.images.canvas import PilImage
from sceneloom.images.ego import EgoPosition
from sceneloom.images.objects import draw_objects_above, draw_objects_in_image
from sceneloom.images.sheets import save_image
from sceneloom.pipeline.detections.detected import DetectedDrive, poses_at
from sceneloom.pipeline.detections.sweep_points import SweepPoints
from sceneloom.scene.scene import Scene
from sceneloom.scene.tracks import TrackedObjects

_REACH = 40.0
"""From the middle of the map to its upper edge [m]."""
_TRAIL = 20
"""So many sweeps back the trajectories of objects are drawn."""


def save_tracking_images(
    scene: Scene,
    drive: DetectedDrive,
    moments: Sequence[TrackedObjects],
    folder: Path,
    *,
    count: int = 12,
) -> list[Path]:
    """Draw some moments of a tracked drive into a folder, evenly spread over it.

    `<number>_above.png`, and `<number>_<camera>.png` for each camera with an image within half a sweep.

    Args:
        scene: whose sweeps and images; what it does not have is not drawn.
        drive: where the sensors were.
        moments: the objects at each sweep.
        folder: made where it is missing; files of the same names are replaced.
        count: how many moments at most.

    Returns:
        The paths written.

    Raises:
        OutputError: a file cannot be written.
        DataError: a sweep or image cannot be read.
    """
    rows = np.unique(np.linspace(0, len(moments) - 1, min(count, len(moments))).round().astype(np.int64))
    folder.mkdir(parents=True, exist_ok=True)
    return [
        save_image(image, folder / name, overwrite=True)
        for row in rows.tolist()
        for name, image in _drawn(scene, drive, moments, row)
    ]


def _drawn(
    scene: Scene, drive: DetectedDrive, moments: Sequence[TrackedObjects], row: int
) -> Iterator[tuple[str, PilImage]]:
    objects = moments[row]
    (world_from_lidar,) = poses_at(drive.source, np.array([objects.timestamp_ns], np.int64))
    ego = EgoPosition(world_from_lidar.translation, _level(world_from_lidar.rotation[:, 0]))
    points = SweepPoints.of(scene, drive.lidar_id, drive.source)
    cloud = None if points is None else points.at(objects.timestamp_ns)
    seen = np.zeros((0, 3)) if cloud is None else world_from_lidar.apply(cloud.astype(np.float64))
    trails = _trails(moments[max(row - _TRAIL, 0) : row + 1])
    yield f"{row:06d}_above.png", draw_objects_above(seen, objects, ego=ego, trails=trails, reach=_REACH)
    for camera in scene.cameras:
        location = drive.cameras.get(camera.id)
        k = _nearest(camera.images.timestamps_ns, objects.timestamp_ns, drive.period_ns // 2)
        if location is None or k is None:
            continue
        image = camera.images[k]
        (world_from_camera,) = poses_at(location.source, np.array([image.timestamp_ns], np.int64))
        drawn = draw_objects_in_image(image, objects, world_from_camera, camera.id)
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
    locations: dict[int, list[Float64Array]] = {}
    for moment in moments:
        for number, center in zip(moment.ids.tolist(), moment.centers, strict=True):
            locations.setdefault(number, []).append(center)
    return {number: np.array(found) for number, found in locations.items()}
