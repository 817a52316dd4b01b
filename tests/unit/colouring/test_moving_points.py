"""Points on what moved: other rays pass through their locations, or an annotated box holds them."""

import numpy as np

from sceneloom.colouring.moving_points import LAGS, MovingBoxes, MovingPoints
from sceneloom.colouring.results import LidarTrajectory
from sceneloom.geometry.rigid import matrix_from_quaternion
from sceneloom.scene import CuboidAnnotation, CuboidPath, Scene
from sceneloom.simulate import LidarSpec, TrafficSpec, simulate_street

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


def test_sweeps_come_back_in_their_order_and_move_nothing_where_it_is_not_known_from_where_they_were_measured():
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


def test_points_in_boxes_that_move_are_found_at_their_own_times():
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
