"""A drive in cubes of space, the same whatever rests on the disk, and points on what moved."""

import numpy as np
import pytest

from sceneloom.colouring.moving_points import LAGS, MovingBoxes, MovingPoints
from sceneloom.colouring.results import LidarTrajectory
from sceneloom.colouring.world_map import WorldMap, empty_points
from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import matrix_from_quaternion
from sceneloom.scene import CuboidAnnotation, CuboidPath, Scene
from sceneloom.simulate import LidarSpec, TrafficSpec, simulate_street

VOXEL = 0.25


def drive(count=6000, sweeps=8):
    """Sweeps of points over several tiles, on either side of the origin."""
    random, found = np.random.default_rng(2), []
    for k in range(sweeps):
        points = empty_points(count)
        points["position"] = random.uniform(-1, 1, (count, 3)) * [150, 150, 3] + [20 * k, 0, 0]
        points["weight"], points["time_ns"] = random.uniform(0.1, 1, count), k
        points["color"] = 100 + random.integers(0, 20, (count, 3))
        points["intensity"], points["label"] = random.integers(0, 255, count), random.integers(0, 3, count)
        found.append(points)
    return found


def gathered(sweeps, folder, **settings):
    world = WorldMap(VOXEL, folder, **settings)
    for points in sweeps:
        world.add(points)
    parts = list(world.points())
    return np.concatenate(parts) if parts else empty_points(0)


def by_cube(points):
    """The points of each cube, the slow way."""
    cubes = {}
    for row in points:
        cubes.setdefault(tuple(np.floor(row["position"] / VOXEL).astype(int).tolist()), []).append(row)
    return cubes


@pytest.mark.parametrize("most_cells", [300, 10_000_000])
def test_each_cube_gives_one_point_with_the_means_of_its_points(tmp_path, most_cells):
    sweeps = drive(400, 5)
    points = np.concatenate(sweeps)
    points["position"][:, 2] *= 0.2  # so that cubes hold several points
    points["position"][:, :2] = np.round(points["position"][:, :2] / 12) * 12 + 0.1
    slow = by_cube(points)
    fast = by_cube(gathered(np.split(points, 5), tmp_path, most_cells=most_cells))
    assert slow.keys() == fast.keys()
    assert max(map(len, slow.values())) > 2
    for cube, held in slow.items():
        (point,) = fast[cube]
        weights = np.array([row["weight"] for row in held])
        np.testing.assert_allclose(point["position"], np.mean([row["position"] for row in held], axis=0))
        colors = np.array([row["color"] for row in held])
        # float32 sums
        np.testing.assert_allclose(point["color"], np.average(colors, axis=0, weights=weights), rtol=1e-5)
        best = held[int(weights.argmax())]
        assert (point["weight"], point["time_ns"]) == (best["weight"], best["time_ns"])
        stated, counts = np.unique([row["label"] for row in held], return_counts=True)
        assert point["label"] == stated[counts.argmax()]
    assert list(tmp_path.iterdir()) == []


def test_the_map_does_not_depend_on_tiles_on_the_disk_and_points_without_colour_count_for_none(tmp_path):
    (tmp_path / "much").mkdir()
    world = WorldMap(VOXEL, tmp_path, most_cells=5_000)
    for points in drive():
        world.add(points)
    assert sum(tile.size for tile in world._tiles.values()) <= 5_000
    assert len(list(tmp_path.iterdir())) > 5
    little = np.concatenate(list(world.points()))
    assert little.tobytes() == gathered(drive(), tmp_path / "much").tobytes()
    points = empty_points(3)
    points["position"] = [[0.1, 0.1, 0.1], [0.2, 0.2, 0.2], [5.0, 5.0, 5.0]]
    points["weight"][0], points["color"][0], points["camera"][0] = 0.4, 50, 2
    found = {row["camera"]: row for row in gathered([points], tmp_path)}
    assert (found[2]["color"].tolist(), found[255]["color"].tolist()) == ([50, 50, 50], [255, 255, 255])
    points = empty_points(3)
    points["position"][0], points["position"][1] = np.nan, np.inf
    assert (len(gathered([points], tmp_path)), len(gathered([], tmp_path))) == (1, 0)
    with pytest.raises(OptionError, match="voxel 0"):
        WorldMap(0.0, tmp_path)


FRAMES = 36


def judged(drive, cleans):
    """Moving points of each sweep by number, from exact positions."""
    finder, found = MovingPoints(), {}
    for k, (frame, clean) in enumerate(zip(drive.scene.lidars[0].frames, cleans, strict=True)):
        times = frame.points.timestamps_ns
        ends = drive.truth.world_from_ego(np.array([times.min(), times.max()]))
        rotations = matrix_from_quaternion(ends.quaternions_xyzw)
        eyes = ends.positions + rotations @ drive.scene.lidars[0].mount.translation
        fractions = (times - times.min()).astype(np.float32) / np.float32(np.ptp(times))
        trajectory = LidarTrajectory(eyes, fractions)
        found.update(finder.add(k, clean.positions_world.astype(np.float32), trajectory))
    found.update(finder.flush())
    return found


def test_most_of_what_moves_is_found_and_almost_nothing_that_stands():
    lidar = LidarSpec(beams=40, steps=450)
    traffic = simulate_street(5, frames=FRAMES, lidar=lidar, cameras=(), traffic=TrafficSpec())
    cleans = [traffic.truth.clean_points_world(k) for k in range(FRAMES)]
    found = judged(traffic, cleans)
    assert sorted(found) == list(range(FRAMES))
    right = wrong = moving = stationary = 0
    for k, marked in found.items():
        truth = np.linalg.norm(cleans[k].velocities, axis=1) > 0.5
        right, moving = right + (marked & truth).sum(), moving + truth.sum()
        wrong, stationary = wrong + (marked & ~truth).sum(), stationary + (~truth).sum()
    assert moving > 3000
    assert right > 0.6 * moving
    assert wrong < 0.003 * stationary


def test_sweeps_come_back_in_order_nothing_moves_without_locations_and_points_in_moving_boxes_are_found():
    finder, trajectory = MovingPoints(), LidarTrajectory(np.zeros((2, 3)), np.zeros(1, np.float32))
    wall = np.array([[10.0, 0.0, 0.0]], np.float32)
    order = [[load for load, _ in finder.add(k, wall, trajectory)] for k in range(LAGS[-1] + 3)]
    assert (order[: LAGS[-1]], order[LAGS[-1] :]) == ([[]] * LAGS[-1], [[0], [1], [2]])
    assert [load for load, _ in finder.flush()] == list(range(3, LAGS[-1] + 3))
    finder, points = MovingPoints(), np.random.default_rng(0).uniform(-20, 20, (500, 3)).astype(np.float32)
    for k in range(3 * LAGS[0]):
        list(finder.add(k, points + 3 * k, None))
    assert not any(marked.any() for _, marked in finder.flush())
    finder = MovingPoints()
    for count in (1, 0):
        trajectory = LidarTrajectory(np.zeros((2, 3)), np.zeros(count, np.float32))
        list(finder.add(count, np.full((count, 3), np.nan, np.float32), trajectory))
    assert [marked.tolist() for _, marked in finder.flush()] == [[False], []]

    def box(annotation_id, stop_x, *, stationary=False):
        rows = np.array([[4, 2, 1.5, 0, 0, 0, 0, 0, 0], [4, 2, 1.5, stop_x, 0, 0, 0, 0, 0]], np.float64)
        path = CuboidPath(np.array([0, 1_000_000_000]), rows)
        return CuboidAnnotation(annotation_id, path, stationary=stationary)

    moving = MovingBoxes.of(Scene((), annotations=(box("a", 10.0), box("b", 0.1), box("c", 9.0, stationary=True))))
    assert [each.id for each in moving.cuboids] == ["a"]
    points = np.array([[0.0, 0.9, 0.0], [5.0, 0.0, 0.0], [5.0, 0.0, 0.0], [5.0, 1.5, 0.0], [np.nan, 0, 0]])
    times = np.array([0, 0, 500_000_000, 500_000_000, 0])
    assert moving.inside(points, times).tolist() == [True, False, True, False, False]
    assert moving.inside(points + 1000, times + 10**10).tolist() == [False] * 5
    assert moving.inside(np.zeros((0, 3)), np.zeros(0, np.int64)).tolist() == []
