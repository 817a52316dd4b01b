"""Records as messages of the Foxglove schemas; their published protobuf classes are the judge."""

import struct
from importlib import import_module

import numpy as np
import pytest

from sceneloom.errors import DataError, OptionError
from sceneloom.fusion.messages import (
    Boxes2d,
    Boxes3d,
    FusedDetections,
    ImageData,
    PointCloudData,
    SensorFusionData,
    Timestamp,
)
from sceneloom.fusion.messages.foxglove_form import NUMERIC_TYPES, FoxgloveMessage, from_foxglove, to_foxglove

TIME = Timestamp(1595682678, 715705367)
COMMON = {"sensor_id": 3, "timestamp": TIME, "seq": 9}
IMAGE = ImageData(**COMMON, height=1, width=2, encoding="rgb8", channel=3, data=np.arange(6, dtype=np.uint8))
CLOUD = PointCloudData(
    **COMMON,
    number=1,
    fields=("x", "y", "z", "ring"),
    fields_number=4,
    data=np.array([1, 2, 3, 4], np.float32),
)
COLUMNS_3D = {
    "id": np.array([7, 8], np.int32),
    "class_names": ("Car", "车"),
    "confidence": np.array([0.75, 0.1], np.float32),
    "centers": np.array([[1, 2, 3], [4, 5, 6]], np.float32),
    "sizes_lwh": np.array([[4, 2, 1.5], [1, 1, 1]], np.float32),
    "directions": np.array([[0, 5, 0], [1, 0, 0]], np.float32),
    "velocities": np.array([1.5, 0], np.float32),
}
BOXES_3D = Boxes3d(**COMMON, **COLUMNS_3D)
BOXES_2D = Boxes2d(
    **COMMON,
    id=np.array([-2], np.int32),
    class_names=("Car",),
    confidence=np.array([0.5], np.float32),
    corners_xyxy=np.array([[10, 20, 13, 26]], np.uint32),
)
FUSION = SensorFusionData(
    timestamp=TIME,
    image_seq=1,
    points_seq=2,
    camera_id=3,
    lidar_id=4,
    height=1,
    width=2,
    encoding="rgb8",
    image_channel=3,
    image_data=np.arange(6, dtype=np.uint8),
    image_depth=np.array([0, 2.5], np.float32),
    point_num=1,
    point_fields=("x", "y", "z"),
    fields_number=3,
    point_data=np.array([1, 2, 3], np.float32),
    image_timestamp=Timestamp(5, 6),
)
DETECTIONS = FusedDetections(
    timestamp=TIME,
    image_seq=1,
    points_seq=2,
    camera_id=3,
    lidar_id=4,
    **{**COLUMNS_3D, "directions": np.array([[0, 5, 0], [0, 0, 0]], np.float32)},
    center_covs=np.zeros((2, 3, 3), np.float32),
    size_covs=np.zeros((2, 3, 3), np.float32),
    corners_xyxy=np.array([[1, 2, 3, 4], [5, 6, 7, 8]], np.uint32),
)


def schema_class(schema):
    """The published protobuf class of a schema."""
    name = schema.removeprefix("foxglove.")
    return getattr(import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)


def published(message):
    """The message as the published class reads it from the wire."""
    kind = schema_class(message.schema)
    return kind.FromString(kind(**message.content).SerializeToString())


def as_content(message):
    """The fields of a protobuf message as mappings."""
    content = {}
    for field, value in message.ListFields():
        if field.message_type is None:
            content[field.name] = value
        elif field.is_repeated:
            content[field.name] = [with_zeros(inner) for inner in value]
        else:
            content[field.name] = with_zeros(value)
    return content


def with_zeros(message):
    """The fields of a protobuf message, those left out on the wire with their zeros."""
    zeros = {
        field.name: field.default_value
        for field in message.DESCRIPTOR.fields
        if field.message_type is None and not field.is_repeated
    }
    return {**zeros, **as_content(message)}


RECORDS = {"image": IMAGE, "points": CLOUD, "boxes_3d": BOXES_3D, "boxes_2d": BOXES_2D}


@pytest.mark.parametrize(
    "record", [*RECORDS.values(), FUSION, DETECTIONS], ids=lambda record: type(record).__name__
)
def test_the_published_classes_take_every_message(record):
    messages = to_foxglove(record, frame_id="lidar", image_frame_id="camera")
    for message in messages.values():
        assert published(message) == schema_class(message.schema)(**message.content)


@pytest.mark.parametrize("part", RECORDS)
def test_a_record_comes_back_from_the_published_class(part):
    record = RECORDS[part]
    message = to_foxglove(record, frame_id="lidar")[part]
    content = with_zeros(published(message))
    back = from_foxglove(FoxgloveMessage(message.schema, content), sensor_id=3, seq=9)
    for name in record.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(back, name), getattr(record, name), err_msg=name)


def test_numeric_types_are_those_of_the_published_schema():
    values = schema_class("foxglove.PackedElementField").DESCRIPTOR.enum_types_by_name["NumericType"].values
    assert {value.number: value.name.lower() for value in values if value.number} == dict(NUMERIC_TYPES)


def test_a_picture_says_its_time_frame_and_rows():
    message = to_foxglove(IMAGE, frame_id="camera")["image"]
    found = published(message)
    assert (found.timestamp.seconds, found.timestamp.nanos) == (1595682678, 715705367)
    assert (found.frame_id, found.width, found.height, found.step) == ("camera", 2, 1, 6)
    assert (found.encoding, found.data) == ("rgb8", bytes(range(6)))


def test_new_boxes_take_the_place_of_the_last_ones():
    found = published(to_foxglove(BOXES_3D, frame_id="lidar")["boxes_3d"])
    assert [deletion.type for deletion in found.deletions] == [found.deletions[0].ALL]
    assert [entity.texts[0].text for entity in found.entities] == ["Car 7 0.75", "车 8 0.10"]
    empty = published(to_foxglove(Boxes3d.empty(3, 9, TIME), frame_id="lidar")["boxes_3d"])
    assert (len(empty.deletions), len(empty.entities)) == (1, 0)


def test_boxes_in_a_picture_are_loops_from_corner_to_corner():
    found = published(to_foxglove(BOXES_2D, frame_id="camera")["boxes_2d"])
    (loop,) = found.points
    assert loop.type == loop.LINE_LOOP
    assert [(point.x, point.y) for point in loop.points] == [(10, 20), (13, 20), (13, 26), (10, 26)]


def test_a_result_shows_picture_depths_and_points():
    messages = {part: published(message) for part, message in
                to_foxglove(FUSION, frame_id="lidar", image_frame_id="camera").items()}  # fmt: skip
    assert set(messages) == {"image", "depth", "points"}
    assert messages["depth"].encoding == "32FC1"
    assert np.frombuffer(messages["depth"].data, "<f4").tolist() == [0, 2.5]
    assert {part: message.frame_id for part, message in messages.items()} == {
        "image": "camera",
        "depth": "camera",
        "points": "lidar",
    }
    assert messages["image"].timestamp.seconds == 5


def test_fused_detections_show_the_boxes_that_there_are():
    messages = {
        part: published(message) for part, message in to_foxglove(DETECTIONS, frame_id="lidar").items()
    }
    assert len(messages["boxes_3d"].entities) == 1
    assert len(messages["boxes_2d"].points) == 2


def colored_cloud(colors, names=("x", "y", "r", "g", "b", "z", "intensity")):
    points = np.array([[1.5, -2.0, *color, 3.25, 0.1] for color in colors], np.float32)
    return PointCloudData(**COMMON, number=len(points), fields=names, fields_number=len(names), data=points)


def test_colours_of_points_are_the_bytes_that_viewers_know():
    colors = [(255, 0, 7), (1, 2, 3), (255, 255, 255)]
    record = colored_cloud(colors)
    message = to_foxglove(record, frame_id="lidar")["points"]
    found = published(message)
    kinds = {field.name: (field.offset, field.type) for field in found.fields}
    of = found.fields[0].NumericType.Value
    assert {name for name, (_, kind) in kinds.items() if kind == of("UINT8")} == {
        "red",
        "green",
        "blue",
        "alpha",
    }
    assert {name for name, (_, kind) in kinds.items() if kind == of("FLOAT32")} == {
        "x",
        "y",
        "z",
        "intensity",
    }
    assert len(found.data) == 3 * found.point_stride == 3 * 20
    for k, color in enumerate(colors):  # as a viewer reads them, byte by byte
        point = found.data[k * found.point_stride :]
        assert tuple(point[kinds[name][0]] for name in ("red", "green", "blue", "alpha")) == (*color, 255)
        assert [struct.unpack_from("<f", point, kinds[name][0])[0] for name in "xyz"] == [1.5, -2.0, 3.25]
    content = with_zeros(found)
    back = from_foxglove(FoxgloveMessage(message.schema, content), sensor_id=3, seq=9)
    assert back.fields == record.fields
    np.testing.assert_array_equal(back.data, record.data)


@pytest.mark.parametrize("color", [(0.5, 0, 0), (256, 0, 0), (-1, 0, 0)])
def test_colours_that_are_no_bytes_stay_numbers(color):
    record = colored_cloud([color])
    message = to_foxglove(record, frame_id="lidar")["points"]
    assert [field.name for field in published(message).fields] == list(record.fields)
    back = from_foxglove(FoxgloveMessage(message.schema, with_zeros(published(message))), sensor_id=3, seq=9)
    np.testing.assert_array_equal(back.data, record.data)


def test_an_alpha_of_others_that_says_something_is_kept():
    fields = [
        *({"name": name, "offset": 4 * k, "type": 7} for k, name in enumerate("xyz")),
        *(
            {"name": name, "offset": 12 + k, "type": 1}
            for k, name in enumerate(["red", "green", "blue", "alpha"])
        ),
    ]
    data = struct.pack("<3f4B", 1, 2, 3, 10, 20, 30, 40)
    content = {
        "timestamp": {"seconds": 1, "nanos": 0},
        "frame_id": "",
        "point_stride": 16,
        "fields": fields,
        "data": data,
    }
    back = from_foxglove(FoxgloveMessage("foxglove.PointCloud", content), sensor_id=3, seq=9)
    assert back.fields == ("x", "y", "z", "r", "g", "b", "alpha")
    assert back.data.tolist() == [1, 2, 3, 10, 20, 30, 40]


def test_points_under_a_pose_are_moved_into_the_frame():
    message = to_foxglove(CLOUD, frame_id="lidar")["points"]
    # half a turn about z, then 10 m along x
    pose = {
        "position": {"x": 10.0, "y": 0.0, "z": 0.0},
        "orientation": {"x": 0.0, "y": 0.0, "z": 1.0, "w": 0.0},
    }
    moved = from_foxglove(
        FoxgloveMessage(message.schema, {**message.content, "pose": pose}), sensor_id=3, seq=9
    )
    np.testing.assert_allclose(moved.points, [[9, -2, 3, 4]], atol=1e-6)


def test_drawings_of_others_become_boxes_without_a_class():
    content = {
        "entities": [
            {
                "timestamp": {"seconds": 1, "nanos": 2},
                "cubes": [
                    {
                        "pose": {
                            "position": {"x": 1.0, "y": 2.0, "z": 3.0},
                            "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 2.0},
                        },
                        "size": {"x": 4.0, "y": 2.0, "z": 1.0},
                    }
                ],
            }
        ]
    }
    record = from_foxglove(FoxgloveMessage("foxglove.SceneUpdate", content), sensor_id=0, seq=0)
    assert record.timestamp == Timestamp(1, 2)
    assert (record.class_names, record.confidence.tolist()) == (("object",), [1.0])
    np.testing.assert_allclose(record.directions, [[1, 0, 0]])


@pytest.mark.parametrize(
    ("schema", "content", "problem"),
    [
        ("foxglove.SceneUpdate", {}, "timestamp: missing"),
        ("foxglove.RawImage", {"timestamp": {"seconds": 1, "nanos": 2}}, "missing"),
        ("foxglove.ImageAnnotations", {"timestamp": 5}, "timestamp: 5; expected an object"),
    ],
)
def test_a_fault_in_a_message_is_named(schema, content, problem):
    with pytest.raises(DataError, match=problem):
        from_foxglove(FoxgloveMessage(schema, content), sensor_id=0, seq=0)


def test_other_records_and_schemas_are_refused():
    with pytest.raises(OptionError, match="expected one of ImageData"):
        to_foxglove("picture", frame_id="a")
    with pytest.raises(OptionError, match=r"expected one of foxglove\.RawImage"):
        from_foxglove(FoxgloveMessage("foxglove.Log", {}), sensor_id=0, seq=0)
    five = ImageData(**COMMON, height=1, width=1, encoding="raw", channel=5, data=np.zeros(5, np.uint8))
    with pytest.raises(OptionError, match="raw pixels of 5 values; expected 1, 3 or 4"):
        to_foxglove(five, frame_id="a")


@pytest.mark.parametrize("names", [("x", "y", "z"), ("x", "y", "z", "r", "g", "b")])
def test_a_sweep_in_which_nothing_was_measured_is_shown_and_read(names):
    none = np.zeros((0, len(names)), np.float32)
    record = PointCloudData(
        sensor_id=0,
        timestamp=Timestamp(1, 2),
        seq=3,
        number=0,
        fields=names,
        fields_number=len(names),
        data=none,
    )
    (message,) = to_foxglove(record, frame_id="lidar").values()
    assert (message.content["data"], message.content["point_stride"] > 0) == (b"", True)
    assert from_foxglove(message, sensor_id=0, seq=3).fields == names
