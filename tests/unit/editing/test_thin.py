"""Scenes with fewer points, frames and timestamps: which stay, and that what is known of them follows."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from sceneloom import scene as sc
from sceneloom.editing import simplify_scene, thin_scene
from sceneloom.editing.simplify import _thin_greedily
from sceneloom.editing.thin import evenly, one_per_cube
from sceneloom.errors import OptionError


def lidar_frame(k, count=100):
    """Points along x, 0.1 m apart, on both sides of zero; everything that is known of a point bears its number."""
    numbers = np.arange(count)
    positions = np.zeros((count, 3), np.float32)
    positions[:, 0] = (numbers - count // 2) * 0.1 + 0.05
    byte, times = numbers.astype(np.uint8), numbers.astype(np.int64) + k * 100
    extras = {"echo": numbers.astype(np.float64), "calibration": np.zeros(3)}
    colors = np.repeat(byte[:, None], 3, 1)
    points = sc.LidarPoints(positions, byte, colors, times, numbers.astype(np.uint16), byte, extras=extras)
    return sc.LidarFrame(k * 100, points)


def scene_of(frames=6, annotations=()):
    times = [k * 100 for k in range(frames)]
    lidar = sc.LidarSensor("top", sc.LazyFrames.of([lidar_frame(k) for k in range(frames)], times))
    cycles = [
        sc.RadarFrame(t, sc.RadarPoints(np.zeros((4, 3), np.float32), lengths=np.arange(4, dtype=np.float32)))
        for t in times
    ]
    chart = sc.PointsSensor("map", np.array([[-0.1, 0, 0], [0.1, 0, 0], [0.2, 0, 0]], np.float32))
    return sc.Scene((lidar, sc.RadarSensor("radar", sc.LazyFrames.of(cycles, times)), chart), tuple(annotations))


def labels(frame, *ids, sensor="top"):
    return sc.LabeledPoints(sensor, np.array(ids, np.uint32), frame)


def test_one_point_of_each_cube_stays_with_all_that_is_known_of_it():
    points = thin_scene(scene_of(), voxel=1.0).sensor("top").frames[2].points
    # ten points to a cube; the middle ones, rows 4 and 5, are equally near to the mean but for float32
    rows = points.rings.astype(int)
    assert len(points) == 10
    assert np.isin(rows % 10, [4, 5]).all()
    for array in (points.intensities, points.camera_index, points.timestamps_ns - 200, points.extras["echo"]):
        np.testing.assert_array_equal(array, rows)
    np.testing.assert_array_equal(points.colors[:, 1], rows)
    np.testing.assert_array_equal(points.positions, lidar_frame(2).points.positions[rows])
    assert len(points.extras["calibration"]) == 3
    again = pickle.loads(pickle.dumps(thin_scene(scene_of(), voxel=1.0).sensor("top")))
    np.testing.assert_array_equal(again.frames[2].points.positions, points.positions)
    first = thin_scene(scene_of(), voxel=1.0, keep="first").sensor("top").frames[0].points
    assert first.rings.tolist() == list(range(0, 100, 10))
    # points that are nowhere go
    positions = np.array([[0, 0, 0], [np.nan, 0, 0], [5, 0, 0]], np.float32)
    assert one_per_cube(positions, 1.0).tolist() == [0, 2]


def test_shares_and_counts_are_spread_evenly_and_every_other_frame_stays():
    assert evenly(10, 10).tolist() == list(range(10))
    assert evenly(10, 5).tolist() == [1, 3, 5, 7, 9]
    assert evenly(3, 7).tolist() == [0, 1, 2]
    assert evenly(7, 1).tolist() == [3]
    thinned = thin_scene(scene_of(), share=0.25)
    assert {len(frame.points) for frame in thinned.sensor("top").frames} == {25}
    assert len(thin_scene(scene_of(), points=7).sensor("top").frames[0].points) == 7
    assert thin_scene(scene_of(), share=0.5).sensor("radar").frames[0].points.lengths.tolist() == [1.0, 3.0]
    thinned = thin_scene(scene_of(), every=4, sensors=["radar"])
    assert thinned.sensor("radar").frames.timestamps_ns.tolist() == [0, 400]
    assert len(thinned.sensor("top").frames) == 6
    assert thinned.metadata["sceneloom"]["thinned"] == {"every": 4}


def test_labelled_points_follow_and_what_cannot_be_followed_is_refused():
    entries = (labels(0, 4, 5, 14, 15, 99), labels(1, 7), labels(2, 0, 90, 91), labels(None, 1, 2, sensor="map"))
    scene = scene_of(
        annotations=[sc.LabeledPointsAnnotation("a", entries), sc.LabeledPointsAnnotation("b", entries[1:2])]
    )
    thinned = thin_scene(scene, voxel=1.0, keep="first", every=2)
    assert [annotation.id for annotation in thinned.annotations] == ["a"]
    found = thinned.annotations[0].labeled_points
    assert [(entry.sensor_id, entry.sensor_frame, entry.point_ids.tolist()) for entry in found] == [
        ("top", 1, [0, 9]),
        ("map", None, [1]),
    ]
    reported = {warning.code: warning.count for warning in thinned.warnings}
    assert reported == {"labelled-points": 7, "labelled-frames": 2, "labelled-annotations": 1}
    for stated, problem in (
        ({}, "nothing to thin by"),
        ({"voxel": 0.0}, "voxel 0.0"),
        ({"voxel": float("nan")}, "voxel nan"),
        ({"share": 1.5}, "share 1.5"),
        ({"points": 0}, "points 0"),
        ({"every": 0}, "every 0"),
        ({"voxel": 1.0, "keep": "last"}, "keep 'last'"),
        ({"voxel": 1.0, "sensors": ["nose"]}, "no sensor 'nose'"),
    ):
        with pytest.raises(OptionError, match=problem):
            thin_scene(scene_of(), **stated)


ROTATION = np.array([[0.0, 0.0, 0.0, 1.0]])


def a_cuboid(values, timestamps=None):
    timestamps = np.arange(len(values)) * 100 if timestamps is None else timestamps
    return sc.CuboidAnnotation("a", sc.CuboidPath(np.asarray(timestamps, np.int64), np.asarray(values, np.float64)))


def rows(x, *, yaw=0.0):
    values = np.zeros((len(x), 9))
    values[:, :3], values[:, 3], values[:, 8] = (4.0, 2.0, 1.5), x, yaw
    return values


def test_a_path_needs_its_ends_and_corners_only_and_bends_what_their_curvature_says():
    for values, options, kept in (
        (rows(np.linspace(0, 50, 1001)), {"tolerance_m": 1e-9}, [0, 100_000]),
        (rows(np.concatenate([np.linspace(0, 10, 50), np.full(50, 10.0)])), {}, [0, 4900, 9900]),
        # less than half a rotation is known by its ends: 17 steps of 10 degrees
        (rows(np.zeros(37), yaw=np.arange(37) * 10.0), {"tolerance_deg": 0.01}, [0, 1700, 3400, 3600]),
        # values that are not finite stay
        (rows([0.0, 0.0, np.nan, 0.0, 0.0]), {}, [0, 100, 200, 300, 400]),
    ):
        (simple,) = simplify_scene(sc.Scene((), (a_cuboid(values),)), **options).annotations
        assert simple.path.timestamps_ns.tolist() == kept
    # a circle of 20 m: between timestamps an angle φ apart a line is r (1 - cos(φ/2)) off; 0.01 m: 3.6 degrees
    angles = np.radians(np.arange(0, 360, 0.1))
    values = rows(20 * np.cos(angles))
    values[:, 4] = 20 * np.sin(angles)
    (simple,) = simplify_scene(sc.Scene((), (a_cuboid(values),)), tolerance_deg=90).annotations
    assert 100 <= len(simple.path.timestamps_ns) <= 102
    # long straight curves are not looked at point by point
    calls = []

    def misfits(a, b):
        calls.append(b - a)
        return np.zeros(b - a - 1)

    assert _thin_greedily(100_000, misfits).tolist() == [0, 99_999]
    assert len(calls) < 20
    # of equal or running back timestamps, and short ones
    paths = [a_cuboid(rows(np.zeros(count))) for count in (0, 1, 2)]
    for cuboid in (a_cuboid(rows(np.zeros(4)), timestamps=[0, 5, 5, 9]), *paths):
        assert simplify_scene(sc.Scene((), (cuboid,))).annotations[0].path is cuboid.path
    empty = sc.PointsAnnotation("p", (sc.PointPath(np.zeros(0, np.int64), np.zeros((0, 3))),))
    assert simplify_scene(sc.Scene((), (empty,)), tolerance_m=1.0).annotations[0].paths == empty.paths


def a_scene():
    timestamps = np.arange(9) * 100
    locations = np.column_stack([np.arange(9.0), np.zeros(9), np.zeros(9)])
    path = sc.Poses(timestamps, locations, np.repeat(ROTATION, 9, axis=0))
    known = {"file_seconds": timestamps * 1e-9, "covariances": np.tile(np.eye(6), (9, 1, 1))}
    trajectory = sc.Trajectory("trajectory", timestamps, locations, None, **known)
    annotations = (
        a_cuboid(rows(np.arange(9.0))),
        sc.PointsAnnotation("p", (sc.PointPath(timestamps, locations, id="q"),), labels=("nose",)),
        sc.LocalizationAdjustment("l", path),
        sc.GroupAnnotation("g"),
    )
    return sc.Scene((sc.OdometrySensor("ego", path),), annotations, trajectories={"trajectory": trajectory})


def counts(scene):
    cuboid, points, adjustment, _ = scene.annotations
    paths = {"cuboids": cuboid.path, "keypoints": points.paths[0], "adjustments": adjustment.poses}
    paths |= {"sensors": scene.sensors[0].poses, "trajectories": scene.trajectories["trajectory"]}
    return {name: len(path.timestamps_ns) for name, path in paths.items()}


def test_all_kinds_of_paths_or_one_are_simplified_and_reported_and_a_pose_that_holds_for_ever_stays():
    simple = simplify_scene(a_scene())
    assert counts(simple) == dict.fromkeys(counts(simple), 2)
    assert {warning.location: warning.count for warning in simple.warnings} == dict.fromkeys(counts(simple), 7)
    trajectory = simple.trajectories["trajectory"]
    assert (trajectory.file_seconds.tolist(), trajectory.covariances.shape) == ([0.0, 800 * 1e-9], (2, 6, 6))
    assert simple.annotations[1].paths[0].id == "q"
    for kind in ("cuboids", "keypoints"):
        others = dict.fromkeys(("cuboids", "keypoints", "poses"), False)
        found = counts(simplify_scene(a_scene(), **{**others, kind: True}))
        assert [name for name, count in found.items() if count == 2] == [kind]
    scene = replace(a_scene(), sensors=(sc.OdometrySensor("ego", sc.Poses.identity()),))
    assert simplify_scene(scene).sensors[0].poses.static
    for wrong in ({"tolerance_m": -1.0}, {"tolerance_deg": float("nan")}):
        with pytest.raises(OptionError, match="expected a number from 0 on"):
            simplify_scene(sc.Scene(()), **wrong)
