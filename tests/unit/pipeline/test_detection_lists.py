"""Lists of boxes in each form, read for a lidar and a camera of which the rest is known."""

import json

import numpy as np
import pytest

from sceneloom.db34t.json import format_json
from sceneloom.db34t.scene_objects import boxes_2d_record, boxes_3d_record
from sceneloom.errors import DataError, UnknownFormatError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.pipeline.detection_lists import ListContext, form_of, read_boxes_2d, read_boxes_3d
from sceneloom.scene import Boxes2D, Boxes3D, Poses, ScoreForm
from sceneloom.scene.poses import PoseSource

TIMES = np.array([0, 100_000_000, 200_000_000], np.int64)
LIDAR_FROM_CAMERA = RigidTransform(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.array([0.3, 0.0, -0.1]))
"""The camera looks ahead: its z is the lidar's x, its x the lidar's -y, its y the lidar's -z."""


@pytest.fixture
def context():
    """A lidar that drives 10 m/s to the north and looks there."""
    positions = np.array([[5.0, 0.0, 0.0], [5.0, 1.0, 0.0], [5.0, 2.0, 0.0]])
    trajectory = Poses(TIMES, positions, np.tile([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)], (3, 1)))
    source = PoseSource(trajectory, RigidTransform.identity())
    return ListContext("lidar", TIMES, source=source, sensor_from_camera=LIDAR_FROM_CAMERA)


def strict():
    return Ledger(lenient=False)


def file(tmp_path, text, name="boxes.txt"):
    path = tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


NAMED = {"id": 3, "class": "Car", "confidence": 0.5, "timestamp": "0.100000000"}
SIZE = {"length": 4.0, "width": 2.0, "height": 1.5}
PLACED = {"points_seq": 1, "X": 10.0, "Y": 1.0, "Z": -0.5, "direction": [0.0, 2.0, 0.0], "velocity": -3.0}
BOX_3D = {**NAMED, **SIZE, **PLACED}
BOX_2D = {**NAMED, "image_seq": 1, "x1": 10, "y1": 20, "x2": 30, "y2": 40}


def test_bare_records_are_put_together_by_frame_and_lists_of_frames_read_as_they_were_written(tmp_path, context):
    other = {**BOX_3D, "points_seq": 0, "timestamp": "0.000000000", "X": 20.0}
    lines = "\n".join(json.dumps(box) for box in (BOX_3D, other, {**BOX_3D, "class": "Van"}))
    path = file(tmp_path, lines)
    assert form_of(path).name == "json-lines"
    first, second = read_boxes_3d(path, context, strict())
    assert (first.timestamp_ns, second.timestamp_ns) == (0, 100_000_000)
    assert second.labels == ("Car", "Van")
    assert second.centers.tolist()[0] == [10.0, 1.0, -0.5]
    np.testing.assert_allclose(second.yaws, np.pi / 2)
    np.testing.assert_allclose(second.velocities[0], [0.0, -3.0, 0.0], atol=1e-6)  # against its direction
    ones, scores = np.ones((2, 3)), np.array([0.25, 0.75])
    boxes = Boxes3D(100_000_000, ones, 2 * ones, np.zeros(2), scores, ("Car", "Bus"))
    seen = Boxes2D(200_000_000, np.array([[1.0, 2.0, 3.0, 4.0]]), np.array([0.5]), ("Car",))
    in_space = file(tmp_path, format_json(boxes_3d_record(boxes, sensor_id=0, seq=1)), "a.jsonl")
    in_image = file(tmp_path, format_json(boxes_2d_record(seen, sensor_id=1, seq=2)), "b.jsonl")
    (back,) = read_boxes_3d(in_space, context, strict())
    assert (back.labels, back.scores.tolist(), back.sensor_id) == (("Car", "Bus"), [0.25, 0.75], "lidar")
    (image,) = read_boxes_2d(in_image, context, strict())
    assert image.corners_xyxy.tolist() == [[1.0, 2.0, 3.0, 4.0]]


def test_lists_of_other_sensors_and_leniently_faulty_records_are_left_out_and_counted(tmp_path, context):
    boxes = Boxes2D(0, np.array([[1.0, 2.0, 3.0, 4.0]]), np.array([0.5]), ("Car",))
    lines = [format_json(boxes_2d_record(boxes, sensor_id=number, seq=0)) for number in (1, 2, 7)]
    ledger, lenient = strict(), Ledger(lenient=True)
    own = ListContext("camera", TIMES, number=2, others=frozenset({1, 2}))
    assert len(read_boxes_2d(file(tmp_path, "\n".join(lines)), own, ledger)) == 1
    assert [(warning.code, warning.count) for warning in ledger.warnings] == [("other-sensors", 1)]
    path = file(tmp_path, f"{json.dumps(BOX_3D)}\n{{}}\n")
    assert [len(boxes) for boxes in read_boxes_3d(path, context, lenient)] == [1]
    assert [(warning.code, warning.count) for warning in lenient.warnings] == [("faulty-detections", 1)]


TOKEN = "ca9a282c9e77460f8360f564131a8af5"
NUSCENES = {"sample_token": TOKEN, "translation": [5.0, 11.0, 1.0], "size": [2.0, 4.0, 1.5], "velocity": [0.0, 3.0]}
NUSCENES |= {"rotation": [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)], "detection_name": "car", "detection_score": 0.4}
NUSCENES |= {"attribute_name": ""}


def nuscenes(tmp_path, box, *, token=TOKEN, micros=100_000):
    file(tmp_path, json.dumps([{"token": TOKEN, "timestamp": micros}]), "sample.json")
    return file(tmp_path, json.dumps({"meta": {"use_lidar": True}, "results": {token: [box]}}), "results.json")


def test_boxes_of_nuscenes_come_into_the_lidars_frame_if_their_times_are_known(tmp_path, context):
    path = file(tmp_path, json.dumps({"results": {TOKEN: [NUSCENES]}}))
    with pytest.raises(DataError, match=r"put nuScenes' table sample\.json"):
        read_boxes_3d(path, context, strict())
    path = nuscenes(tmp_path, NUSCENES)
    assert form_of(path).name == "nuscenes"
    (boxes,) = read_boxes_3d(path, context, strict())
    # by hand: at 0.1 s the lidar is at (5, 1, 0) and looks north, where the box is 10 m ahead, 1 m up, and heads too
    np.testing.assert_allclose(boxes.centers, [[10.0, 0.0, 1.0]], atol=1e-9)
    np.testing.assert_allclose(boxes.yaws, [0.0], atol=1e-9)
    np.testing.assert_allclose(boxes.velocities, [[3.0, 0.0, 0.0]], atol=1e-9)
    assert boxes.sizes_lwh.tolist() == [[4.0, 2.0, 1.5]]  # nuScenes says width first
    assert (boxes.timestamp_ns, boxes.labels) == (100_000_000, ("car",))
    ledger = strict()
    assert not read_boxes_3d(nuscenes(tmp_path, NUSCENES, micros=10**15), context, ledger)
    assert [warning.code for warning in ledger.warnings] == ["other-samples"]


def test_a_faulty_box_of_nuscenes_is_reported_with_its_location(tmp_path, context):
    for field, value, reported in [
        ("size", [2.0, -4.0, 1.5], "size: .*expected sizes above 0"),
        ("size", [2.0, 4.0], "size: .*expected 3 finite numbers"),
        ("rotation", [0.0, 0.0, 0.0, 0.0], "rotation: .*of length 1"),
        ("translation", [1.0, "x", 2.0], "translation: .*expected 3 finite numbers"),
        ("translation", None, "translation: None"),
        ("detection_name", 7, "detection_name: 7; expected the name of a class"),
        ("detection_score", "0.4", "detection_score: '0.4'; expected a finite number"),
        ("velocity", [1.0], "velocity: .*expected two numbers"),
    ]:
        path = nuscenes(tmp_path, {**NUSCENES, field: value})
        with pytest.raises(DataError, match=rf"results\.{TOKEN}\[0\]\.{reported}"):
            read_boxes_3d(path, context, strict())


def test_kittis_lists_are_in_the_cameras_frame_and_take_the_class_of_their_folder(tmp_path, context):
    path = file(tmp_path, "1,2,0,0,9,9,-1.5,1.5,1.6,4.0,2.0,1.5,10.0,0.0,0.2\n", "Car/0000.txt")
    assert form_of(path).name == "kitti-lists"
    before, boxes, after = read_boxes_3d(path, context, strict())
    assert (len(before), len(after)) == (0, 0)
    # by hand: 10.3 ahead, 2 to the right; the middle is 0.75 above the bottom, which is 1.5 below the camera
    np.testing.assert_allclose(boxes.centers, [[10.3, -2.0, -0.85]], atol=1e-12)
    np.testing.assert_allclose(boxes.yaws, [-np.pi / 2], atol=1e-12)
    assert (boxes.score_form, boxes.timestamp_ns) == (ScoreForm.LOGIT, 100_000_000)
    boxes = read_boxes_2d(file(tmp_path, "0,10,20,30,40,0.5\n", "pedestrian/0000.txt"), context, strict())[0]
    assert (boxes.labels, boxes.corners_xyxy.tolist()) == (("Pedestrian",), [[10.5, 20.5, 30.5, 40.5]])


RESULT = "1 7 Car 0 0 0.5 10 20 30 40 1.5 1.6 4.0 2.0 1.5 10.0 0.0 {score}\n"
NOWHERE = "1 -1 DontCare -1 -1 -10 1 2 3 4 -1 -1 -1 -1000 -1000 -1000 -10 {score}\n"


@pytest.mark.parametrize(("score", "form"), [("0.5", ScoreForm.PROBABILITY), ("7.5", ScoreForm.LOGIT)])
def test_kittis_results_report_by_their_range_what_scores_are(tmp_path, context, score, form):
    path = file(tmp_path, (RESULT + NOWHERE).format(score=score))
    assert form_of(path).name == "kitti-results"
    boxes = read_boxes_3d(path, context, strict())[1]
    assert (boxes.score_form, boxes.labels) == (form, ("Car",))
    np.testing.assert_allclose(boxes.centers, [[10.3, -2.0, -0.85]], atol=1e-12)
    assert read_boxes_2d(path, context, strict())[1].corners_xyxy.tolist() == [[10.5, 20.5, 30.5, 40.5]]


def test_empty_files_or_frames_say_that_nothing_was_found_and_what_is_no_list_is_reported(tmp_path, context):
    later = {**BOX_2D, "image_seq": 2, "timestamp": "0.200000000"}
    first = {**BOX_2D, "image_seq": 0, "timestamp": "0.000000000"}
    lists = read_boxes_2d(file(tmp_path, f"{json.dumps(first)}\n{json.dumps(later)}"), context, strict())
    assert [len(boxes) for boxes in lists] == [1, 0, 1]
    path = file(tmp_path, "\n")
    assert form_of(path) is None
    assert [len(boxes) for boxes in read_boxes_3d(path, context, strict())] == [0, 0, 0]
    assert [boxes.timestamp_ns for boxes in read_boxes_2d(path, context, strict())] == TIMES.tolist()
    for text, reported in (
        ("hello\n", "'hello'; expected a list of boxes: json-lines"),
        ("\x00\x01\x02", "expected a list of boxes"),
        ("1,2,3\n", "'1,2,3'; expected a list of boxes"),
    ):
        with pytest.raises(UnknownFormatError, match=reported):
            read_boxes_3d(file(tmp_path, text), context, strict())


def test_a_faulty_list_is_reported_with_its_line(tmp_path, context):
    for text, reported in [
        (json.dumps(BOX_3D)[:-9], "line 1: no JSON"),
        (json.dumps(BOX_3D) + "\n{}", "line 2: .*missing"),
        (json.dumps({**BOX_3D, "width": -1.0}), "line 1: width: -1.0; expected more than 0"),
        (json.dumps({**BOX_3D, "confidence": 1.5}), "line 1: confidence: 1.5"),
        (json.dumps({**BOX_3D, "direction": [0.0, 0.0, 0.0]}), "line 1: direction: .*vector other than 0"),
        (json.dumps({**BOX_3D, "X": "far"}), "line 1: X: 'far'"),
        (json.dumps(BOX_2D), "line 1: a Box2d; expected Boxes3d or Box3d"),
        ("3,2,0,0,9,9,-1.5,1.5,1.6,4.0,2.0,1.5,10.0,0.0,0.2", "frame 3; expected 0 to 2, as sensor 'lidar'"),
        ("1,2,0,0,9,9,-1.5,1.5,1.6,nan,2.0,1.5,10.0,0.0,0.2", "line 1: l 'nan'"),
    ]:
        with pytest.raises(DataError, match=reported):
            read_boxes_3d(file(tmp_path, text, "Car/list.txt"), context, strict())
