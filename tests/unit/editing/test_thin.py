"""Thinned scenes: which points and frames stay, and that what is known of them follows."""

import pickle

import numpy as np
import pytest

from sceneloom import scene as sc
from sceneloom.editing import thin_scene
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
    # a cube at the origin is as large as others; points that are nowhere go
    positions = np.array([[-0.4, 0, 0], [0.4, 0, 0], [0.6, 0, 0]], np.float32)
    assert one_per_cube(positions, 1.0, keep="first").tolist() == [0, 1]
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
