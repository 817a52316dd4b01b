"""Records of tables 3 to 10 and as JSON: the standard's examples, and every fault by its field's name."""

import json
from dataclasses import replace

import numpy as np
import pytest

from sceneloom.db34t import (
    RECORD_KINDS,
    Boxes2d,
    Boxes3d,
    CalibrationData,
    FusedDetections,
    RawData,
    SensorFusionData,
    Timestamp,
    kind_of,
)
from sceneloom.db34t.json import format_json, from_json, parse_json, to_json
from sceneloom.db34t.records import FusedDetection
from sceneloom.errors import DataError, OptionError

from .sending import box_2d, box_3d, cloud, image

TIME = Timestamp(1595682678, 715705367)
COV = (0.2, 0.01, 0.01, 0.01, 0.2, 0.01, 0.01, 0.01, 0.2)

CALIBRATION = CalibrationData(
    image_size=(640, 480),
    distortion_coeffs=(-0.3995, 0.1803, 0, 0, 0.0429),
    intrinsic_matrix=(468.3708, 0.0, 339.7596, 0.0, 470.2517, 235.6143, 0.0, 0.0, 1.0),
    reference_frame=0,
    extrinsic_matrix=(
        *(0.0070, 1e-06, 0.9999, 0, -0.9999, -0.0016, 0.0070, 0),
        *(0.0016, -0.9999, -1e-06, 0, -0.0062, 0.0756, 0.0337, 1),
    ),
)
RAW = RawData(sensor_id=1, timestamp=TIME, seq=1, length=1, data=b"\x80")
IMAGE = image(0, 1, width=360, height=480)
CLOUD = replace(cloud(0, 1, np.zeros((1000, 4)), fields=("x", "y", "z", "reflectivity")), beam=32, ring=0)
BOX_3D = box_3d(0, 2, direction=(2.0, 3.0, 0.0), velocity=1)
BOX_2D = box_2d(0, 1, x1=103, y1=103, x2=204, y2=204)
PAIR = {"timestamp": TIME, "image_seq": 1, "points_seq": 1, "camera_id": 1, "lidar_id": 1}
PIXELS = {"encoding": "rgb8", "image_channel": 3, "image_data": np.zeros(480 * 360 * 3, np.uint8)}
POINTS = {"point_fields": ("x", "y", "z"), "fields_number": 3, "point_data": np.zeros((10000, 3), np.float32)}
FUSION = SensorFusionData(
    **PAIR, height=480, width=360, **PIXELS, image_depth=np.zeros(480 * 360, np.float32), point_num=10000, **POINTS
)
SIZE = {"length": 1.0, "width": 1.0, "height": 1.0, "size_cov": COV}
GOING = {"direction": (2.0, 3.0, 0.0), "velocity": 1}
CORNERS = {"x1": 103, "y1": 103, "x2": 204, "y2": 204}
CENTER = {"X": 1.0, "Y": 1.0, "Z": 1.0, "center_cov": COV}
DETECTION = FusedDetection(id=1, confidence=0.8, timestamp=TIME, class_name="Car", **CENTER, **SIZE, **GOING, **CORNERS)
BOXES_3D = BOX_3D.alone(0)
BOXES_2D = BOX_2D.alone(1)
DETECTIONS = FusedDetections(
    **PAIR,
    id=np.array([1, 2], np.int32),
    class_names=("Car", "Car"),
    confidence=np.array([0.8, 0.5], np.float32),
    centers=np.ones((2, 3), np.float32),
    center_covs=np.tile(np.reshape(COV, (3, 3)).astype(np.float32), (2, 1, 1)),
    sizes_lwh=np.array([[4, 2, 1], [0, 0, 0]], np.float32),
    size_covs=np.zeros((2, 3, 3), np.float32),
    directions=np.array([[1, 0, 0], [0, 0, 0]], np.float32),
    velocities=np.zeros(2, np.float32),
    corners_xyxy=np.array([[1, 2, 3, 4], [5, 5, 5, 5]], np.uint32),
    box_3d_ids=(7, None),
    box_2d_ids=(None, -1),
)


def test_numbers_of_32_bits_are_kept_as_such_and_what_is_no_record_has_no_kind():
    assert (BOX_3D.confidence, BOX_3D.velocity, BOXES_3D.confidence[0]) == (
        float(np.float32(0.8)),
        1.0,
        np.float32(0.8),
    )
    assert (BOXES_3D[0], BOXES_2D[0]) == (BOX_3D, BOX_2D)
    with pytest.raises(OptionError, match="a str; expected one of RawData"):
        kind_of("record")


def test_arrays_are_flat_read_only_views_with_shaped_views_beside_them_and_may_be_empty_or_not_finite():
    assert (IMAGE.data.shape, IMAGE.pixels.shape) == ((480 * 360 * 3,), (480, 360, 3))
    assert (FUSION.depths.shape, FUSION.pixels.shape) == ((480, 360), (480, 360, 3))
    assert (CLOUD.points.shape, FUSION.points.shape) == ((1000, 4), (10000, 3))
    with pytest.raises(ValueError, match="read-only"):
        IMAGE.pixels[0, 0, 0] = 1
    # a file of an image has no pixels before it is decoded
    assert replace(IMAGE, encoding="jpeg", data=np.zeros(7, np.uint8)).pixels is None
    assert replace(CALIBRATION, distortion_coeffs=None).distortion_coeffs == (0.0,) * 5
    assert len(Boxes3d.empty(0, 1, TIME)) == len(Boxes2d.empty(0, 1, TIME)) == 0
    empty = FusedDetections.empty(TIME, image_seq=1, points_seq=2, camera_id=3, lidar_id=4)
    assert (len(empty), empty.box_3d_ids) == (0, ())
    assert DETECTIONS[1].length == 0.0  # without a box in space
    assert (DETECTIONS[0].box_3d_id, DETECTIONS[1].box_3d_id) == (7, None)
    for data in (bytearray(b"\x80"), memoryview(b"\x80"), np.array([-128], np.int8)):
        assert replace(RAW, data=data).data == b"\x80"
    assert np.isnan(replace(CLOUD, data=np.full(4000, np.nan, np.float32)).data).all()


FAULTS = [
    (CALIBRATION, {"image_size": (0, 480)}, "image_size", "(0, 480); expected 1 or more"),
    (CALIBRATION, {"intrinsic_matrix": (1.0,) * 8}, "intrinsic_matrix", "expected double[9]"),
    (CALIBRATION, {"extrinsic_matrix": (float("nan"),) * 16}, "extrinsic_matrix[0]", "nan; expected a finite double"),
    (CALIBRATION, {"reference_frame": 2}, "reference_frame", "2; expected 0 to 1"),
    (RAW, {"length": 2}, "length", "2; expected 1, as there are bytes in data"),
    (RAW, {"data": "a"}, "data", "'a'; expected bytes"),
    (RAW, {"seq": 2**32}, "seq", "4294967296; expected 0 to 4294967295"),
    (RAW, {"seq": -1}, "seq", "-1; expected 0 to 4294967295"),
    (RAW, {"timestamp": 1595682678.7}, "timestamp", "1595682678.7; expected a Timestamp"),
    (RAW, {"timestamp": None}, "timestamp", "missing; expected uint32. uint32"),
    (IMAGE, {"height": 0}, "height", "0; expected 1 to 4294967295"),
    (IMAGE, {"height": 481}, "data", "518400 values; expected 519480 (width * height * channel)"),
    (IMAGE, {"sensor_id": 256}, "sensor_id", "256; expected 0 to 255"),
    (IMAGE, {"sensor_id": 1.0}, "sensor_id", "1.0; expected 0 to 255"),
    (IMAGE, {"encoding": "yuv"}, "encoding", "'yuv'; expected one of rgb8"),
    (IMAGE, {"encoding": "mono8"}, "channel", "3 of mono8; expected 1"),
    (IMAGE, {"encoding": "png", "data": np.zeros(0, np.uint8)}, "data", "empty; expected a file of png"),
    (IMAGE, {"data": np.zeros(480 * 360 * 3)}, "data", "expected an array of uint8"),
    (CLOUD, {"number": 999}, "data", "4000 values; expected 3996 (number * fields_number)"),
    (CLOUD, {"fields_number": 3}, "fields_number", "3; expected 4, as there are names in fields"),
    (CLOUD, {"fields": ("x", "y", "r", "i")}, "fields", "expected x, y and z among them"),
    (CLOUD, {"fields": ("x", "y", "z", "x")}, "fields", "expected different names"),
    (CLOUD, {"fields": ("x", "y", "z", "")}, "fields", "expected different names"),
    (CLOUD, {"data": np.zeros(4000)}, "data", "expected an array of float32"),
    (CLOUD, {"sensor_type": 2}, "sensor_type", "2; expected 0 to 1"),
    (CLOUD, {"sensor_type": 1}, "beam", "32 of a solid-state lidar; expected none"),
    (BOX_3D, {"confidence": 1.5}, "confidence", "1.5; expected 0 to 1"),
    (BOX_3D, {"length": 0.0}, "length", "0.0; expected more than 0"),
    (BOX_3D, {"X": float("nan")}, "X", "nan; expected a finite float"),
    (BOX_3D, {"direction": (0, 0, 0)}, "direction", "expected a vector other than 0"),
    (BOX_3D, {"direction": (1, 0)}, "direction", "(1, 0); expected float[3]"),
    (BOX_3D, {"class_name": ""}, "class", "expected the name of a class"),
    (BOX_3D, {"class_name": 3}, "class", "3; expected a string"),
    (BOX_3D, {"id": 2**31}, "id", "2147483648; expected -2147483648 to 2147483647"),
    (BOX_2D, {"x2": 103}, "x2", "103; expected more than 103, which is x1"),
    (BOX_2D, {"x2": 102}, "x2", "102; expected more than 103, which is x1"),
    (BOX_2D, {"y1": 204}, "y2", "204; expected more than 204, which is y1"),
    (BOX_2D, {"x1": -1}, "x1", "-1; expected 0 to 4294967295"),
    (BOXES_3D, {"centers": np.full((1, 3), np.nan, np.float32)}, "boxes[0].X", "nan; expected a finite number"),
    (BOXES_3D, {"sizes_lwh": np.array([[1, 1, -1]], np.float32)}, "boxes[0].height", "-1.0; expected more than 0"),
    (BOXES_3D, {"directions": np.zeros((1, 3), np.float32)}, "boxes[0].direction", "expected a vector other than 0"),
    (BOXES_3D, {"directions": np.array([[1, 0, np.inf]], np.float32)}, "boxes[0].direction[2]", "inf; expected"),
    (BOXES_3D, {"confidence": np.array([2], np.float32)}, "boxes[0].confidence", "2.0; expected 0 to 1"),
    (BOXES_3D, {"confidence": np.ones(2, np.float32)}, "confidence", "expected an array (1) float32"),
    (BOXES_3D, {"id": np.array([1])}, "id", "expected an array (N) int32"),
    (BOXES_3D, {"class_names": ("Car", "Car")}, "class", "expected a tuple of 1"),
    (BOXES_3D, {"class_names": ([],)}, "boxes[0].class", "[]; expected a string"),
    (BOXES_2D, {"corners_xyxy": np.array([[2, 0, 1, 0]], np.uint32)}, "boxes[0].x2", "1; expected more than 2, which"),
    (BOXES_2D, {"corners_xyxy": np.array([[2, 0, 3, 0]])}, "corners_xyxy", "expected an array (1, 4) uint32"),
    (FUSION, {"image_depth": np.zeros(5, np.float32)}, "image_depth", "5 values; expected 172800 (width * height)"),
    (FUSION, {"image_depth": np.full(172800, -1, np.float32)}, "image_depth[0]", "-1.0; expected 0 or more"),
    (FUSION, {"depth_kind": "disparity"}, "depth_kind", "'disparity'; expected one of z, range"),
    (FUSION, {"point_frame": "world"}, "point_frame", "'world'; expected one of lidar, camera"),
    (FUSION, {"image_channel": 1}, "image_channel", "1 of rgb8; expected 3"),
    (FUSION, {"point_num": 1}, "point_data", "30000 values; expected 3 (point_num * fields_number)"),
    (DETECTION, {"center_cov": (1, 2, 0, 0, 1, 0, 0, 0, 1)}, "center_cov", "expected a symmetric 3x3 matrix"),
    (DETECTION, {"size_cov": (-1, 0, 0, 0, 1, 0, 0, 0, 1)}, "size_cov", "without negative variances"),
    (DETECTION, {"box_3d_id": 1, "length": 0}, "length", "0.0; expected more than 0"),
    (DETECTION, {"box_3d_id": 1, "direction": (0, 0, 0)}, "direction", "expected a vector other than 0"),
    (DETECTION, {"length": -1}, "length", "-1; expected 0 or more"),
    (DETECTIONS, {"box_3d_ids": (7, 8)}, "detections[1].length", "expected more than 0"),
    (DETECTIONS, {"box_3d_ids": (7,)}, "box_3d_id", "expected a tuple of 2"),
    (DETECTIONS, {"box_2d_ids": (None, 2**31)}, "box_2d_id", "2147483648; expected"),
    (DETECTIONS, {"motion_compensated": 2}, "motion_compensated", "2; expected 0 to 1"),
]


TIME_TEXT = "1595682678.715705367"
BOX = {
    "id": 1,
    "class": "Car",
    "points_seq": 2,
    "confidence": 0.8,
    "timestamp": TIME_TEXT,
    "X": 1.0,
    "Y": 1.0,
    "Z": 1.0,
    "length": 1.0,
    "width": 1.0,
    "height": 1.0,
    "direction": [2.0, 3.0, 0.0],
    "velocity": 1.0,
}
"""The example of table 7, word by word."""

CALIBRATION_JSON = {
    "image_size": [640, 480],
    "distortion_coeffs": [-0.3995, 0.1803, 0, 0, 0.0429],
    "intrinsic_matrix": [468.3708, 0.0, 339.7596, 0.0, 470.2517, 235.6143, 0.0, 0.0, 1.0],
    "reference_frame": 0,
    "extrinsic_matrix": [
        *(0.0070, 1e-06, 0.9999, 0, -0.9999, -0.0016, 0.0070, 0),
        *(0.0016, -0.9999, -1e-06, 0, -0.0062, 0.0756, 0.0337, 1),
    ],
}
"""The example of table 3."""

HEAD = {"timestamp": TIME_TEXT, "seq": 1, "height": 1, "width": 2, "encoding": "rgb8"}
DATA = [0, 1, 2, 253, 254, 255]
IMAGE_JSON = {"sensor_id": 1, **HEAD, "channel": 3, "data": DATA}
BOXES = {"sensor_id": 0, "seq": 2, "timestamp": TIME_TEXT, "boxes": [BOX, {**BOX, "id": 2}]}


def test_the_examples_of_tables_3_and_7_come_back_word_by_word():
    for name, content in (("box_3d", BOX), ("calibration", CALIBRATION_JSON), ("boxes_3d", BOXES)):
        assert to_json(from_json(name, content)) == content
    assert parse_json(json.dumps({"boxes_3d": BOXES})).class_names == ("Car", "Car")


def test_arrays_are_base64_or_lists_and_raw_bytes_int8_as_the_standard_says():
    record = from_json("image", IMAGE_JSON)
    assert to_json(record, lists=True) == IMAGE_JSON
    assert to_json(record)["data"] == "AAEC/f7/"
    assert from_json("image", {**IMAGE_JSON, "data": "AAEC/f7/"}).data.tolist() == IMAGE_JSON["data"]
    raw = RawData(sensor_id=1, timestamp=Timestamp(1), seq=1, length=3, data=b"\x00\x7f\x80")
    content = to_json(raw, lists=True)
    assert (content["data"], from_json("raw", content).data) == ([0, 127, -128], raw.data)
    # points in lists are written as short as they were stated
    assert json.loads(format_json(cloud(0, 1, [0.1, -2.5, 1e-7]), lists=True))["points"]["data"] == [0.1, -2.5, 1e-7]


@pytest.mark.parametrize(
    "content",
    [
        {"sensor_id": 1, **HEAD, "image_channel": 3, "image_data": DATA},
        {"camera_id": 1, **HEAD, "channel": 3, "data": DATA},
        {**IMAGE_JSON, "timestamp": {"s": 1595682678, "ns": 715705367}},
    ],
)
def test_names_of_the_same_field_in_other_tables_and_timestamps_of_two_numbers_are_read(content):
    assert to_json(from_json("image", content), lists=True) == IMAGE_JSON


JSON_FAULTS = [
    ("image", {"timestamp": 1595682678.715705367}, "timestamp", "expected a text"),
    ("image", {"timestamp": "1595682678.7157"}, "timestamp", "expected a text"),
    ("image", {"timestamp": {"s": 1, "ns": 10**9}}, "timestamp.ns", "1000000000; expected 0 to 999999999"),
    ("image", {"colour": 1}, "colour", "is no field of it; expected sensor_id, timestamp"),
    ("image", {"image_channel": 3}, "channel", "stands there twice"),
    ("image", {"seq": None}, "seq", "missing; expected uint32, 0 to 4294967295"),
    ("image", {"data": [0, 1, 2, 3, 4, 256]}, "data", "expected a list of uint8"),
    ("image", {"data": [0, 1, 2, 3, 4, True]}, "data", "expected a list of uint8"),
    ("image", {"data": [[0, 1, 2], [3, 4, 5]]}, "data", "expected a list of uint8"),
    ("image", {"data": "AAEC/f7"}, "data", "expected Base64"),
    ("image", {"data": 5}, "data", "5; expected Base64 or a list of numbers"),
    ("boxes_3d", {"boxes": None}, "boxes", "missing; expected a list"),
    ("boxes_3d", {"boxes": [BOX, {**BOX, "points_seq": 3}]}, "boxes[1].points_seq", "3; expected 2"),
    ("boxes_3d", {"boxes": [{**BOX, "length": -1}]}, "boxes[0].length", "-1; expected more than 0"),
    ("boxes_3d", {"boxes": [BOX, 5]}, "boxes[1]", "5; expected a JSON object"),
    (
        "boxes_3d",
        {"boxes": [BOX | {"velocity_vector": [1, 2, 3]}, BOX]},
        "boxes[1].velocity_vector",
        "missing; expected",
    ),
]
EXAMPLES = {"image": IMAGE_JSON, "boxes_3d": BOXES}  # by which the names above are known


@pytest.mark.parametrize(
    ("record", "changes", "location", "problem"), [*FAULTS, *JSON_FAULTS], ids=lambda value: str(value)[:40]
)
def test_a_fault_names_table_field_value_and_what_was_expected(record, changes, location, problem):
    with pytest.raises(DataError) as fault:
        from_json(record, EXAMPLES[record] | changes) if isinstance(record, str) else replace(record, **changes)
    kind = RECORD_KINDS[record] if isinstance(record, str) else kind_of(record)
    assert fault.value.file.endswith(f"(table {kind.table.number})")
    assert (fault.value.location, problem in fault.value.problem) == (location, True), fault.value.problem


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "{}", '{"image": {}, "raw": {}}', '{"image": {}}', '{"image": NaN}', b"\xff"]
)
def test_a_text_that_is_no_record_is_refused(text):
    with pytest.raises(DataError, match=r"record|sensor_id: missing"):
        parse_json(text)
