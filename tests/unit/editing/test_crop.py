"""Scenes cropped in time and space, and kept lines of recordings cut with them."""

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest

from sceneloom import scene as sc
from sceneloom.editing import crop_scene, to_ego
from sceneloom.errors import OptionError
from sceneloom.formats import open_scene, write_scene
from sceneloom.scene.scene import time_span
from sceneloom.simulate import LidarSpec, simulate_street

BOX = (-10.0, -15.0, -20.0, 25.0, 12.0, 20.0)
REACH = 22.0


def inside_box(points):
    return ((points >= BOX[:3]) & (points <= BOX[3:])).all(axis=1)


@pytest.mark.parametrize("given", list(sc.PointsFrame))
@pytest.mark.parametrize("frame", list(sc.PointsFrame))
def test_points_in_a_box_of_any_frame_stay(drive, given, frame):
    cropped = crop_scene(drive.scene(given), box=BOX, frame=frame)
    for sensor_id in ("lidar", "radar"):
        before = drive.scene(given).sensor(sensor_id)
        for k, found in enumerate(cropped.sensor(sensor_id).frames):
            inside = inside_box(drive.frame_from_world(k, frame).apply(drive.points_world(k)))
            assert 0 < inside.sum() < len(inside)
            np.testing.assert_array_equal(found.points.positions, before.frames[k].points.positions[inside])
    assert cropped.metadata["sceneloom"]["cropped"] == {"box": list(BOX), "frame": frame.value}


def test_points_within_range_stay_and_a_map_where_any_sensor_comes_by(drive):
    for frame in (sc.PointsFrame.SENSOR, sc.PointsFrame.EGO):
        cropped = crop_scene(drive.scene(sc.PointsFrame.WORLD), reach=REACH, frame=frame)
        for k, found in enumerate(cropped.sensor("lidar").frames):
            away = np.linalg.norm(drive.frame_from_world(k, frame).apply(drive.points_world(k)), axis=1)
            expected = drive.points_world(k)[away <= REACH].astype(np.float32)
            np.testing.assert_array_equal(found.points.positions, expected)
    locations = np.array([[20.0, 0, 0], [20, 5, 0], [-20, 0, 0], [np.nan, 0, 0]], np.float32)
    scene = drive.scene(sc.PointsFrame.WORLD)
    scene = replace(scene, sensors=(*scene.sensors, sc.PointsSensor("map", locations)))
    inside = crop_scene(scene, box=(0, -1, -1, 30, 9, 1)).sensor("map").positions
    np.testing.assert_array_equal(inside, locations[:2])
    # the ego goes from (20, 0) to (19.6, 4): the second location is 1.1 m from where it ends
    near = crop_scene(scene, reach=1.5, frame="ego").sensor("map").positions
    np.testing.assert_array_equal(near, locations[:2])


def test_labelled_points_are_counted_anew_also_in_a_part_in_time(drive):
    inside = np.flatnonzero(inside_box(drive.points_world(2)))
    ids = np.array([inside[3], inside[0], np.setdiff1d(np.arange(40), inside)[0]], np.uint32)
    label = sc.LabeledPointsAnnotation("a", (sc.LabeledPoints("lidar", ids, 2),))
    cropped = crop_scene(drive.scene(sc.PointsFrame.WORLD, [label]), box=BOX)
    assert cropped.annotations[0].labeled_points[0].point_ids.tolist() == [3, 0]
    assert {warning.code for warning in cropped.warnings} == {"labelled-points"}
    # frames are counted from the part's own start
    label = sc.LabeledPointsAnnotation("a", (sc.LabeledPoints("lidar", np.arange(40, dtype=np.uint32), 3),))
    cropped = crop_scene(drive.scene(sc.PointsFrame.WORLD, [label]), start=0.3, box=BOX)
    entry = cropped.annotations[0].labeled_points[0]
    assert entry.sensor_frame == 3 - (drive.frames - len(cropped.sensor("lidar").frames))
    kept = cropped.sensor("lidar").frames[entry.sensor_frame].points.positions
    assert len(entry.point_ids) == len(kept) == inside_box(drive.points_world(3)).sum()
    # a cropped scene can go to another process
    cropped = crop_scene(drive.scene(), box=BOX, frame="ego").sensor("radar")
    again = pickle.loads(pickle.dumps(cropped))
    np.testing.assert_array_equal(again.frames[1].points.positions, cropped.frames[1].points.positions)


def test_cuboids_stay_while_their_centre_is_inside(drive, box):
    times = drive.timestamps_ns
    passing = box("passing", times, [[-25.0, 0, 0], [-12, 0, 0], [0, 0, 0], [30, 0, 0], [40, 0, 0]])
    passing = replace(
        passing, activations=(sc.Activation("lidar", times, durations_ns=(1, 2, 3, 4, 5)),), stationary=False
    )
    seldom = box("between", [0, 400_000_000], [[-50.0, 0, 0], [50, 0, 0]])
    outside = box("outside", times[:2], [[0.0, 50, 0], [0, 50, 0]])
    parked = box("parked", [7], [[1.0, 1, 1]], stationary=True)
    cropped = crop_scene(drive.scene(annotations=[passing, seldom, outside, parked]), box=BOX)
    found = {annotation.id: annotation for annotation in cropped.annotations}
    # inside at the third keyframe, and between it and its neighbours, which stay for that
    assert found["passing"].path.timestamps_ns.tolist() == times[1:4].tolist()
    assert found["passing"].activations[0].durations_ns == (2, 3, 4)
    # inside at a frame's time, at no keyframe
    assert found["between"].path.timestamps_ns.tolist() == [0, 400_000_000]
    assert set(found) == {"passing", "between", "parked"}
    assert [(n.code, n.count) for n in cropped.warnings] == [("annotations-left-out", 1)]
    # those on the ego are cropped in the world, and the other way round
    front = box("front", drive.timestamps_ns, np.tile([20.0, 0.5, 0], (5, 1)))
    for annotation, frame in ((front, "world"), (front, "ego")):
        on_ego = to_ego(drive.scene(annotations=[annotation]))
        near = crop_scene(on_ego, box=(19, 0, -1, 21, 1, 1), frame=frame)
        assert len(near.annotations) == (frame == "world")
        far = crop_scene(drive.scene(annotations=[annotation]), box=(-5, -5, -2, 5, 5, 2), frame=frame)
        assert len(far.annotations) == (frame == "ego")


def test_shapes_and_named_points_stay_whole_when_any_vertex_is_inside(drive):
    first, square = drive.timestamps_ns[:1], np.array([[24.0, 0, 0], [30, 0, 0], [30, 6, 0]])
    near, far = sc.PointPath(first, np.zeros((1, 3))), sc.PointPath(first, np.array([[99.0, 0, 0]]))
    shapes = [
        sc.ShapeAnnotation("touching", sc.ShapeType.POLYGON, sc.VertexPath(first, (square,))),
        sc.ShapeAnnotation("away", sc.ShapeType.POLYLINE, sc.VertexPath(first, (square + 9.0,))),
        sc.ShapeAnnotation("drawn", sc.ShapeType.POLYGON_2D, sc.VertexPath(first, (square[:, :2] + 99.0,)), "camera"),
        sc.PointsAnnotation("body", (far, near)),
        sc.PointsAnnotation("far body", (far,)),
    ]
    cropped = crop_scene(drive.scene(annotations=shapes), box=BOX)
    assert [annotation.id for annotation in cropped.annotations] == ["touching", "drawn", "body"]
    assert len(cropped.annotations[0].path.vertices[0]) == 3
    assert len(cropped.annotations[2].paths) == 2


def test_sensors_go_with_all_that_is_stated_for_them_and_labels_stay_with_parents_and_links(drive, box):
    seen = replace(
        box("seen", [0], [[0.0, 0, 0]]),
        activations=(sc.Activation("radar", drive.timestamps_ns), sc.Activation("lidar", drive.timestamps_ns)),
        attributes=(sc.AttributePath("wet", ("yes",), sensor_id="camera"), sc.AttributePath("new", ("yes",))),
    )
    drawn = sc.Box2DAnnotation("drawn", "camera", sc.BoxPath(drive.timestamps_ns[:1], np.ones((1, 4))))
    owner = sc.ObjectAnnotation("owner", parent_id="drawn")
    link = sc.LinkAnnotation("link", "seen", "drawn")
    cropped = crop_scene(drive.scene(annotations=[seen, drawn, owner, link]), without=["camera", "radar"])
    assert [sensor.id for sensor in cropped.sensors] == ["lidar", "ego"]
    assert [(a.id, a.parent_id) for a in cropped.annotations] == [("seen", None), ("owner", None)]
    assert [entry.sensor_id for entry in cropped.annotations[0].activations] == ["lidar"]
    assert [attribute.name for attribute in cropped.annotations[0].attributes] == ["new"]
    counts = {"annotations": 1, "links": 1, "parents": 1, "sensors": 2}
    expected = {"colours-kept": 1, **{f"{name}-left-out": count for name, count in counts.items()}}
    assert {warning.code: warning.count for warning in cropped.warnings} == expected
    annotations = [
        sc.GroupAnnotation("fleet"),
        replace(box("car", [0], [[0.0, 0, 0]]), label="car", parent_id="fleet"),
        replace(box("van", [0], [[0.0, 0, 0]]), label="van", parent_id="fleet"),
        replace(box("cab", [0], [[0.0, 0, 0]]), label="car"),
        sc.LinkAnnotation("same", "car", "cab"),
        sc.LinkAnnotation("other", "car", "van"),
        sc.LocalizationAdjustment("repair", sc.Poses.identity()),
    ]
    cropped = crop_scene(drive.scene(annotations=annotations), labels=["car"])
    assert [annotation.id for annotation in cropped.annotations] == ["fleet", "car", "cab", "same", "repair"]


def test_points_name_the_cameras_by_their_new_locations(drive):
    scene = drive.scene(sc.PointsFrame.WORLD)
    camera, frame = scene.sensor("camera"), scene.sensor("lidar").frames[0]
    index = np.resize(np.array([0, 1, 2, 255], np.uint8), len(frame.points))
    coloured = replace(frame, points=replace(frame.points, camera_index=index))
    lidar = replace(scene.sensor("lidar"), frames=sc.LazyFrames.of([coloured], [0]))
    cameras = ("camera", "left", "right")
    sensors = (lidar, *(replace(camera, id=name) for name in cameras))
    scene = replace(scene, sensors=sensors, metadata={"sceneloom": {"fusion": {"cameras": list(cameras)}}})
    cropped = crop_scene(scene, without=["left"])
    assert cropped.sensor("lidar").frames[0].points.camera_index[:4].tolist() == [0, 255, 1, 255]
    assert cropped.metadata["sceneloom"]["fusion"]["cameras"] == ["camera", "right"]
    last = crop_scene(scene, without=["right"]).sensor("lidar").frames[0]
    assert last.points.camera_index[:4].tolist() == [0, 1, 255, 255]


@pytest.mark.parametrize(
    ("stated", "problem"),
    [
        ({"box": (0, 0, 0, -1, 1, 1)}, "each minimum at most"),
        ({"box": (0, 0, 0)}, "expected xmin"),
        ({"reach": -1.0}, "range -1.0"),
        ({"frame": "moon", "reach": 1.0}, "frame 'moon'"),
        ({"without": ["nose"]}, "no sensor 'nose'"),
        ({"labels": ["unicorn"]}, "no annotation has the label 'unicorn'"),
        ({"sensors": ["lidar"], "without": ["lidar"]}, "no sensor is left"),
        ({}, "nothing to crop by; expected one of a time"),
    ],
)
def test_what_cannot_be_followed_is_refused(drive, stated, problem):
    with pytest.raises(OptionError, match=problem):
        crop_scene(drive.scene(), **stated)
    # the ego cannot go from under what rides on it
    with pytest.raises(OptionError, match="to-world"):
        crop_scene(to_ego(drive.scene()), without=["ego"])


@pytest.mark.parametrize(
    ("cut", "counts"),
    [
        ({"without": ("imu",)}, {"at home": 3, "on the road": 2, "a phone": 1}),
        # the line without a time stood behind the last one, and goes with it
        ({"stop": 1.12}, {"at home": 0, "on the road": 2, "a phone": 0}),
        # a line of which nothing says what it is of stays
        ({"without": ("gnss",)}, {"gps": 0, "at home": 1, "latitude": 0}),
    ],
)
def test_lines_of_a_recording_that_no_scene_has_a_location_for_are_cut_with_it(tmp_path, cut, counts):
    folder = tmp_path / "drive"
    write_scene(simulate_street(1, frames=3, lidar=LidarSpec(beams=4, steps=30), cameras=()).scene, folder)

    def fix(latitude, note):
        return {"latitude": latitude, "longitude": 25.0, "altitude": 1.0, "note": note}

    lines = [
        {"madeBy": "a phone"},
        {"location": "on the road", "time": 1.02},
        {"location": "at home", "time": 1.19},
        {"gps": fix(60.0, "on the road"), "time": 1.03},
        {"gps": fix(61.0, "at home"), "time": 1.18},
        {"sensor": {"type": "gyroscope", "values": [1.0, 1.0, 1.0]}, "gps": fix(62.0, "at home"), "time": 1.185},
    ]
    with (folder / "data.jsonl").open("a") as file:
        file.writelines(json.dumps(line) + "\n" for line in lines)
    with open_scene(folder) as scene:
        if "stop" in cut:
            cut = {"stop": cut["stop"] - time_span(scene)[0] / 1e9}
        cropped = crop_scene(scene, **cut)
        kept = str(cropped.metadata["recording"])
        write_scene(cropped, tmp_path / "out")
    text = (tmp_path / "out" / "data.jsonl").read_text()
    assert {word: text.count(word) for word in counts} == counts
    assert not [word for word, count in counts.items() if count == 0 and word in kept and word != "gps"]
