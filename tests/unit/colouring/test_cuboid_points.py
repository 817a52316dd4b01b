"""Counting points in cuboids, against the simulated street and against every pair by the formula."""

from dataclasses import replace

import numpy as np
import pytest

from sceneloom import scene as sc
from sceneloom.colouring.cuboid_projection import count_points, with_activations, with_counts, with_labeled_points
from sceneloom.errors import OptionError, PoseError
from sceneloom.geometry.boxes import points_in_box
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.simulate import LidarSpec, TrafficSpec, simulate_street

ON_FACES = 0.02
"""Share of the points of an object that lie on its faces within what a straight path between samples is off."""


@pytest.fixture(scope="module")
def drive():
    """A street with traffic, as seen by a lidar that turns while everything moves."""
    return simulate_street(3, frames=2, lidar=LidarSpec(beams=32, steps=400), cameras=(), traffic=TrafficSpec())


def exact_counts(drive, k, instances):
    """The points of sweep k as measured, in the exact boxes at each point's own time."""
    lidar = drive.scene.lidars[0]
    moments, which = np.unique(lidar.frames[k].points.timestamps_ns, return_inverse=True)
    boxes, poses = drive.truth.boxes(moments), drive.truth.world_from_ego(moments).interpolate(moments)
    counts = dict.fromkeys(instances, 0)
    for m in range(len(moments)):
        pose = RigidTransform.from_quaternion(poses.positions[m], poses.quaternions_xyzw[m])
        world = (pose @ lidar.mount).apply(lidar.frames[k].points.positions[which == m])
        for column, instance in enumerate(boxes.instances.tolist()):
            center, size, half = boxes.centers_world[m, column], boxes.sizes_lwh[column], boxes.yaws[m, column] / 2
            near = np.linalg.norm(world - center, axis=1) < np.linalg.norm(size)
            if instance in counts and boxes.present[m, column] and near.any():
                rotation = np.array([0, 0, np.sin(half), np.cos(half)])
                counts[instance] += int(points_in_box(world[near], center, size, rotation).sum())
    return np.array([counts[instance] for instance in instances])


@pytest.mark.slow
def test_points_in_moving_boxes_of_a_moving_lidar_are_counted_at_their_own_times(drive):
    found = count_points(drive.scene, moment="points")
    instances = [int(str(identifier).rsplit("-", 1)[1]) for identifier in found.annotation_ids]
    for k in range(2):
        exact = exact_counts(drive, k, instances)
        assert exact.sum() > 1_000
        assert np.abs(found.lidars[0].counts[k] - exact).sum() <= ON_FACES * exact.sum()


def test_points_are_met_where_the_sensor_was_at_their_own_times_those_in_the_world_as_they_are(drive):
    at_points, at_frame = (count_points(drive.scene, moment=m).lidars[0].counts for m in ("points", "frame"))
    assert at_frame.sum() < 0.95 * at_points.sum()
    # 3 m ahead of a sensor that looks along the world's y, at x = 5 m and z = 2 m half a second later
    box = a_box("a", [1, 1, 1, 5, 3, 2, 0, 0, 0])
    scene = a_scene([[3.0, 0, 0]], coordinates_path=straight_trajectory(), cuboids=(box,), times_ns=(0, 500_000_000))
    assert count_points(scene).lidars[0].counts[:, 0].tolist() == [0, 1]
    box = a_box("a", [2, 2, 2, 0, 0, 0, 0, 0, 45])
    scene = a_scene([[1.2, 0, 0], [0.9, 0.9, 0]], frame=sc.PointsFrame.WORLD, cuboids=(box,))
    assert count_points(scene).lidars[0].counts.tolist() == [[1]]
    scene = a_scene([[0, 0, 0]], cuboids=(a_box("a", [1, 1, 1, 0, 0, 10, 0, 0, 0]),))
    with pytest.raises(PoseError, match="trajectory"):
        count_points(scene)
    poses = sc.Poses(np.array([0]), np.array([[0.0, 0, 10]]), np.array([[0.0, 0, 0, 1]]), static=True)
    lidar = replace(scene.lidars[0], mount=None, poses=poses)
    assert count_points(replace(scene, sensors=(lidar,))).lidars[0].counts.tolist() == [[1]]
    box = a_box("a", [9, 9, 9, 0, 0, 0, 0, 0, 0], stationary=True)
    times_ns = (0, 100_000_000, 200_000_000, 9_000_000_000)
    scene = a_scene([[0, 0, 0]], coordinates_path=straight_trajectory(), cuboids=(box,), times_ns=times_ns)
    for moment in ("frame", "points"):
        found = count_points(scene, moment=moment)
        assert (found.unplaced, found.lidars[0].there[:, 0].tolist()) == (1, [True, True, True, False])


def a_scene(positions, *, frame=sc.PointsFrame.SENSOR, coordinates_path=None, cuboids=None, times_ns=(0,)):
    points = sc.LidarPoints(np.asarray(positions, np.float32))
    frames = sc.LazyFrames.of([sc.LidarFrame(t, points) for t in times_ns], times_ns)
    mount = RigidTransform(np.eye(3), np.array([0.0, 0.0, 2.0]))
    lidar = sc.LidarSensor("lidar", frames, mount=mount, points_frame=frame)
    trajectories = {} if coordinates_path is None else {"trajectory": coordinates_path}
    return sc.Scene((lidar,), cuboids or (), trajectories=trajectories)


def a_box(identifier, values, timestamps=(0, 1_000_000_000), **more):
    rows = np.tile(np.asarray(values, np.float64), (len(timestamps), 1))
    return sc.CuboidAnnotation(identifier, sc.CuboidPath(np.array(timestamps, np.int64), rows), **more)


def straight_trajectory():
    """10 m/s along x, rotated a quarter to the left all the time."""
    rotation = np.tile([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)], (2, 1))
    return sc.Trajectory("trajectory", np.array([0, 1_000_000_000]), np.array([[0.0, 0, 0], [10.0, 0, 0]]), rotation)


@pytest.mark.parametrize("strange", [np.nan, np.inf, -np.inf, 1e300, -1e300])
@pytest.mark.parametrize("column", [0, 3, 8])
@pytest.mark.parametrize("moment", ["frame", "points"])
def test_numbers_that_mean_nothing_spoil_their_own_cuboid_only(strange, column, moment):
    values = np.array([2.0, 2, 2, 0, 0, 0, 0, 0, 0])
    values[column] = strange
    good = a_box("good", [2, 2, 2, 0, 0, 0, 0, 0, 0], stationary=True)
    scene = a_scene([[0, 0, 0]], coordinates_path=straight_trajectory(), cuboids=(a_box("bad", values), good))
    raised = replace(scene, annotations=(*scene.annotations, a_box("up", [2, 2, 2, 0, 0, 2, 0, 0, 0])))
    assert count_points(raised, moment=moment).lidars[0].counts[0, 1:].tolist() == [0, 1]
    alone = replace(scene, annotations=scene.annotations[:1])
    assert count_points(alone, moment=moment).lidars[0].counts.sum() == 0


def test_a_point_counts_in_every_box_that_it_lies_in_and_counts_become_attributes_labels_and_activations():
    boxes = (
        a_box("a", [2, 2, 2, 0, 0, 0, 0, 0, 0]),
        a_box("b", [1, 1, 1, 0, 0, 0, 0, 0, 0]),
        a_box("gone", [9, 9, 9, 0, 0, 0, 0, 0, 0], timestamps=(5, 6)),
        a_box("stands", [9, 9, 9, 0, 0, 0, 0, 0, 0], timestamps=(5,), stationary=True),
        a_box("upside down", [-9, 9, 9, 0, 0, 0, 0, 0, 0]),
        a_box("nowhere", [9, 9, 9, np.nan, 0, 0, 0, 0, 0]),
    )
    found = count_points(a_scene([[0.1, 0.2, 0.3]], frame=sc.PointsFrame.WORLD, cuboids=boxes)).lidars[0]
    assert found.counts.tolist() == [[1, 1, 0, 1, 0, 0]]
    assert found.there.tolist() == [[True, True, False, True, True, True]]
    box = a_box("a", [-2, -2, -2, 0, 0, 0, 0, 0, 0])
    scene = a_scene([[0, 0, 0]], frame=sc.PointsFrame.WORLD, cuboids=(box,))
    assert count_points(scene, margin=0.1).lidars[0].counts.tolist() == [[0]]
    scene = a_scene(np.zeros((0, 3)), frame=sc.PointsFrame.WORLD, cuboids=(a_box("a", [2, 2, 2, 0, 0, 0, 0, 0, 0]),))
    for moment in ("frame", "points"):
        found = count_points(scene, moment=moment, listed=True).lidars[0]
        assert (found.counts.tolist(), found.point_ids) == ([[0]], [{}])
    found = count_points(a_scene([[0, 0, 0]], frame=sc.PointsFrame.WORLD))
    assert (found.annotation_ids, found.lidars[0].counts.shape) == ((), (1, 0))
    scene = a_scene([[0, 0, 0]], frame=sc.PointsFrame.WORLD)
    for call, message in (
        (lambda: count_points(scene, margin=-0.1), "margin"),
        (lambda: count_points(scene, moment="noon"), "'noon'; expected one of frame, points"),
        (lambda: with_labeled_points(scene, count_points(scene)), "listed=True"),
    ):
        with pytest.raises(OptionError, match=message):
            call()
    older = sc.AttributePath("points", (99,), np.array([0]), sensor_id="lidar")
    elsewhere = sc.AttributePath("points", (7,), np.array([0]), sensor_id="other")
    box = a_box("a", [2, 2, 2, 0, 0, 0, 0, 0, 0], timestamps=(0, 2), attributes=(older, elsewhere))
    scene = a_scene([[0, 0, 0]], frame=sc.PointsFrame.WORLD, cuboids=(box,), times_ns=(0, 1, 2, 3))
    counted = with_counts(scene, count_points(scene)).annotations[0]
    kept, reported = counted.attributes
    assert kept is elsewhere
    assert (reported.name, reported.sensor_id, reported.values) == ("points", "lidar", (1, 1, 1))
    assert reported.timestamps_ns.tolist() == [0, 1, 2]
    boxes = (a_box("a", [2, 2, 2, 0, 0, 0, 0, 0, 0], label="car"), a_box(7, [1, 1, 1, 50, 0, 0, 0, 0, 0]))
    scene = a_scene([[9, 9, 9], [0, 0, 0], [1, 1, 1]], frame=sc.PointsFrame.WORLD, cuboids=boxes, times_ns=(0, 1))
    counts = count_points(scene, listed=True)
    once = with_labeled_points(scene, counts)
    twice = with_labeled_points(once, counts)
    assert [each.id for each in twice.annotations] == ["a", 7, "a:points"]
    made = twice.annotations[2]
    assert isinstance(made, sc.LabeledPointsAnnotation)
    assert (made.label, made.parent_id, made.is_instance) == ("car", "a", True)
    assert [(e.sensor_id, e.sensor_frame, e.point_ids.tolist()) for e in made.labeled_points] == [
        ("lidar", 0, [1, 2]),
        ("lidar", 1, [1, 2]),
    ]
    of_others = sc.Activation("camera", np.array([3]))
    box = a_box("a", [1, 1, 1, 5, 0, 0, 0, 0, 0], timestamps=(0, 300), activations=(of_others,))
    scene = a_scene([[5, 0, 0], [5.1, 0, 0]], frame=sc.PointsFrame.WORLD, cuboids=(box,), times_ns=(0, 100, 200, 400))
    counts = count_points(scene)
    kept, reported = with_activations(scene, counts).annotations[0].activations
    assert kept is of_others
    assert (reported.sensor_id, reported.timestamps_ns.tolist(), reported.durations_ns) == ("lidar", [0], (400,))
    assert with_activations(scene, counts, min_points=3).annotations[0].activations == (of_others,)
