"""The image of a drive as one cloud: what goes in, what is kept, when there is nothing to draw."""

from pathlib import Path

import numpy as np
from PIL import Image

from sceneloom.colouring.results import FusedFrame
from sceneloom.scene import LidarPoints, Poses
from sceneloom.visualization import DriveCloud
from sceneloom.visualization.fused_frames import CUBE

RED, BLUE = (250, 10, 10), (10, 10, 250)


def sweep(index: int, positions: np.ndarray, color: tuple[int, int, int], *, seen: bool = True) -> FusedFrame:
    count = len(positions)
    points = LidarPoints(
        positions.astype(np.float32),
        colors=np.full((count, 3), color, np.uint8),
        camera_index=np.full(count, 0 if seen else 255, np.uint8),
    )
    return FusedFrame("lidar", index, index, index, points)


def wall(x: float) -> np.ndarray:
    y, z = (axis.ravel() for axis in np.mgrid[-2:2:0.05, 0:2:0.05])
    return np.column_stack([np.full(len(y), x), y, z])


def trajectory() -> Poses:
    timestamps = np.arange(3) * 100_000_000
    return Poses(timestamps, np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), np.tile([0.0, 0, 0, 1], (3, 1)))


def has(image: Path, color: tuple[int, int, int]) -> bool:
    """Whether some pixels show that hue clearly."""
    pixels = np.asarray(Image.open(image).convert("RGB")).astype(int)
    strongest = int(np.argmax(color))
    others = [axis for axis in range(3) if axis != strongest]
    return bool((pixels[..., strongest] > pixels[..., others].max(axis=2) + 100).sum() > 50)


def test_sweeps_are_drawn_together(tmp_path: Path) -> None:
    cloud = DriveCloud(frozenset({0, 1}))
    cloud.add(sweep(0, wall(6.0), RED))
    cloud.add(sweep(1, wall(3.0) + np.array([0, 5, 0]), BLUE))
    paths = cloud.save(tmp_path, trajectory())
    assert [path.name for path in paths] == ["cloud_drive_above.png", "cloud_drive_perspective.png"]
    assert has(paths[1], RED)
    assert has(paths[1], BLUE)


def test_sweeps_that_are_not_chosen_or_not_fused_stay_out(tmp_path: Path) -> None:
    cloud = DriveCloud(frozenset({0, 1, 2}))
    cloud.add(sweep(0, wall(6.0), RED))
    cloud.add(sweep(1, wall(6.0), RED))
    cloud.add(sweep(5, wall(4.0), BLUE))
    fused = sweep(2, wall(4.0), BLUE)
    cloud.add(FusedFrame("lidar", 2, 2, 2, fused.points, unfused="beyond the trajectory"))
    assert not has(cloud.save(tmp_path, trajectory())[1], BLUE)


def test_one_sweep_alone_is_no_drive(tmp_path: Path) -> None:
    cloud = DriveCloud(frozenset({0}))
    cloud.add(sweep(0, wall(6.0), RED))
    assert cloud.save(tmp_path, trajectory()) == []
    assert list(tmp_path.iterdir()) == []


def test_of_points_in_one_cube_the_one_that_a_camera_saw_is_kept(tmp_path: Path) -> None:
    cloud = DriveCloud(frozenset({0, 1}))
    locations = wall(6.0) // CUBE * CUBE
    grey, red = (sweep(0, locations + 0.1 * CUBE, RED, seen=False), sweep(0, locations + 0.2 * CUBE, RED))
    both = LidarPoints(
        np.concatenate([grey.points.positions, red.points.positions]),
        colors=np.concatenate([grey.points.colors, red.points.colors]),
        camera_index=np.concatenate([grey.points.camera_index, red.points.camera_index]),
    )
    cloud.add(FusedFrame("lidar", 0, 0, 0, both))
    cloud.add(sweep(1, wall(60.0), BLUE, seen=False))
    assert has(cloud.save(tmp_path, trajectory())[1], RED)


def test_without_a_trajectory_the_cloud_is_drawn_from_its_middle(tmp_path: Path) -> None:
    cloud = DriveCloud(frozenset({0, 1}))
    cloud.add(sweep(0, wall(6.0), RED))
    cloud.add(sweep(1, np.full((3, 3), np.nan), RED))
    assert len(cloud.save(tmp_path, None)) == 2
