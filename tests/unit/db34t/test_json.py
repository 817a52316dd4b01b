"""Records as JSON, by the standard's names."""

import json

import pytest

from sceneloom.db34t import RawData, Timestamp
from sceneloom.db34t.json import format_json, from_json, parse_json, to_json
from sceneloom.errors import DataError

from .sending import cloud

TIME = "1595682678.715705367"
BOX = {
    "id": 1,
    "class": "Car",
    "points_seq": 2,
    "confidence": 0.8,
    "timestamp": TIME,
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

CALIBRATION = {
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

HEAD = {"timestamp": TIME, "seq": 1, "height": 1, "width": 2, "encoding": "rgb8"}
DATA = [0, 1, 2, 253, 254, 255]
IMAGE = {"sensor_id": 1, **HEAD, "channel": 3, "data": DATA}
BOXES = {"sensor_id": 0, "seq": 2, "timestamp": TIME, "boxes": [BOX, {**BOX, "id": 2}]}


def test_the_examples_of_tables_3_and_7_come_back_word_by_word():
    for name, content in (("box_3d", BOX), ("calibration", CALIBRATION), ("boxes_3d", BOXES)):
        assert to_json(from_json(name, content)) == content
    assert parse_json(json.dumps({"boxes_3d": BOXES})).class_names == ("Car", "Car")


def test_arrays_are_base64_or_lists_and_raw_bytes_int8_as_the_standard_says():
    record = from_json("image", IMAGE)
    assert to_json(record, lists=True) == IMAGE
    assert to_json(record)["data"] == "AAEC/f7/"
    assert from_json("image", {**IMAGE, "data": "AAEC/f7/"}).data.tolist() == IMAGE["data"]
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
        {**IMAGE, "timestamp": {"s": 1595682678, "ns": 715705367}},
    ],
)
def test_names_of_the_same_field_in_other_tables_and_timestamps_of_two_numbers_are_read(content):
    assert to_json(from_json("image", content), lists=True) == IMAGE


FAULTS = [
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
EXAMPLES = {"image": IMAGE, "boxes_3d": BOXES}


@pytest.mark.parametrize(("name", "changes", "location", "problem"), FAULTS)
def test_a_fault_in_json_is_named(name, changes, location, problem):
    with pytest.raises(DataError) as fault:
        from_json(name, {**EXAMPLES[name], **changes})
    assert fault.value.location == location
    assert problem in fault.value.problem


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "{}", '{"image": {}, "raw": {}}', '{"image": {}}', '{"image": NaN}', b"\xff"]
)
def test_a_text_that_is_no_record_is_refused(text):
    with pytest.raises(DataError, match=r"record|sensor_id: missing"):
        parse_json(text)
