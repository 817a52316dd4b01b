"""Records as messages of ROS 2, field by field as its definitions say."""

import io
import struct

import numpy as np
import pytest
from PIL import Image

from sceneloom.errors import DataError, OptionError
from sceneloom.fusion.messages import (
    Boxes2d,
    Boxes3d,
    FusedDetections,
    ImageData,
    PointCloudData,
    RawData,
    Timestamp,
)
from sceneloom.fusion.messages.ros_form import RosMessage, from_ros, to_ros

TIME = Timestamp(1595682678, 715705367)
HEADER = {"stamp": {"sec": 1595682678, "nanosec": 715705367}, "frame_id": "front"}
COMMON = {"sensor_id": 3, "timestamp": TIME, "seq": 9}
BOXES_3D = Boxes3d(
    **COMMON,
    id=np.array([7], np.int32),
    class_names=("Car",),
    confidence=np.array([0.75], np.float32),
    centers=np.array([[1, 2, 3]], np.float32),
    sizes_lwh=np.array([[4, 2, 1.5]], np.float32),
    directions=np.array([[0, 5, 0]], np.float32),
    velocities=np.array([1], np.float32),
)
NO_COVARIANCE = [0.0] * 36


def read(message):
    return from_ros(message, sensor_id=3, seq=9)


def cloud(layout_fields, points, **changes):
    """A message of sensor_msgs/msg/PointCloud2 with points as struct packs them."""
    layout = "".join(kind for _, _, kind in layout_fields)
    data = b"".join(struct.pack("<" + layout, *point) for point in points)
    datatypes = {"b": 1, "B": 2, "h": 3, "H": 4, "i": 5, "I": 6, "f": 7, "d": 8}
    stride = struct.calcsize("<" + layout)
    content = {
        "header": HEADER,
        "height": 1,
        "width": len(points),
        "fields": [
            {"name": name, "offset": offset, "datatype": datatypes[kind], "count": 1}
            for name, offset, kind in layout_fields
        ],
        "is_bigendian": False,
        "point_step": stride,
        "row_step": stride * len(points),
        "data": data,
        "is_dense": False,
    }
    return RosMessage("sensor_msgs/msg/PointCloud2", {**content, **changes})


XYZ = [("x", 0, "f"), ("y", 4, "f"), ("z", 8, "f")]


def test_a_picture_has_the_fields_of_the_definition():
    pixels = np.arange(12, dtype=np.uint8)
    record = ImageData(**COMMON, height=2, width=2, encoding="bgr8", channel=3, data=pixels)
    message = to_ros(record, frame_id="front")
    assert message.type == "sensor_msgs/msg/Image"
    assert message.content == {
        "header": HEADER,
        "height": 2,
        "width": 2,
        "encoding": "bgr8",
        "is_bigendian": 0,
        "step": 6,
        "data": pixels.tobytes(),
    }


def test_a_file_is_a_compressed_image_whose_size_is_read_from_it():
    target = io.BytesIO()
    Image.fromarray(np.zeros((5, 7, 3), np.uint8)).save(target, "JPEG")
    data = np.frombuffer(target.getvalue(), np.uint8)
    record = ImageData(**COMMON, height=5, width=7, encoding="jpeg", channel=3, data=data)
    message = to_ros(record, frame_id="front")
    assert message == RosMessage(
        "sensor_msgs/msg/CompressedImage", {"header": HEADER, "format": "jpeg", "data": target.getvalue()}
    )
    # as image_transport writes the format
    named = RosMessage(message.type, {**message.content, "format": "bgr8; jpeg compressed bgr8"})
    back = read(named)
    assert (back.width, back.height, back.encoding) == (7, 5, "jpeg")
    with pytest.raises(DataError, match="expected jpeg or png"):
        read(RosMessage(message.type, {**message.content, "format": "bgr8; webp"}))


def test_padding_after_rows_is_dropped():
    content = {"header": HEADER, "height": 2, "width": 1, "encoding": "rgb8", "is_bigendian": 0, "step": 4}
    message = RosMessage("sensor_msgs/msg/Image", {**content, "data": bytes([1, 2, 3, 0, 4, 5, 6, 0])})
    assert read(message).data.tolist() == [1, 2, 3, 4, 5, 6]


def test_a_cloud_has_the_fields_of_the_definition():
    points = np.array([[1, 2, 3, 0.5]], np.float32)
    record = PointCloudData(
        **COMMON, number=1, fields=("x", "y", "z", "intensity"), fields_number=4, data=points
    )
    message = to_ros(record, frame_id="front")
    expected = cloud([*XYZ, ("intensity", 12, "f")], [(1, 2, 3, 0.5)], is_dense=True)
    assert message == expected


def test_fields_of_other_types_become_numbers_of_32_bits():
    fields = [*XYZ, ("intensity", 12, "B"), ("ring", 13, "H"), ("range", 15, "d")]
    record = read(cloud(fields, [(1, 2, 3, 200, 127, 0.25)]))
    assert record.fields == ("x", "y", "z", "intensity", "ring", "range")
    assert record.points.tolist() == [[1, 2, 3, 200, 127, 0.25]]


def test_values_can_be_big_endian():
    message = cloud(XYZ, [(0, 0, 0)], data=struct.pack(">fff", 1, 2, 3), is_bigendian=True)
    assert read(message).points.tolist() == [[1, 2, 3]]


def test_points_without_a_position_are_left_out():
    record = read(cloud(XYZ, [(1, 2, 3), (float("nan"), 0, 0), (4, 5, float("inf")), (6, 7, 8)]))
    assert record.points.tolist() == [[1, 2, 3], [6, 7, 8]]


@pytest.mark.parametrize(
    ("name", "kind", "value"),
    [
        ("t", "I", 62_500_000),
        ("offset_time", "I", 62_500_000),
        ("timestamp", "d", 1595682678.0625),
        ("time", "f", 0.0625),
    ],
)
def test_times_as_makers_of_lidars_write_them_are_seconds_from_the_stamp(name, kind, value):
    record = read(cloud([*XYZ, (name, 12, kind)], [(1, 2, 3, value)]))
    assert record.fields[3] == "time"
    np.testing.assert_allclose(record.points[0, 3], 0.0625, rtol=1e-6)


@pytest.mark.parametrize("kind", ["f", "I"])
def test_packed_colours_become_three_fields(kind):
    packed = 0x00FF8001
    value = struct.unpack("<f", struct.pack("<I", packed))[0] if kind == "f" else packed
    record = read(cloud([*XYZ, ("rgb", 12, kind)], [(1, 2, 3, value)]))
    assert record.fields == ("x", "y", "z", "r", "g", "b")
    assert record.points[0, 3:].tolist() == [255, 128, 1]


def test_an_organised_cloud_is_read_row_by_row():
    data = struct.pack("<fff4xfff4x", 1, 2, 3, 4, 5, 6)
    message = cloud(XYZ, [], height=2, width=1, point_step=12, row_step=16, data=data)
    assert read(message).points.tolist() == [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"data": b"123"}, "data: 3 bytes; expected 1 points of 12 bytes in 1 rows of 12 bytes"),
        ({"point_step": 0}, "data: 12 bytes; expected 1 points of 0 bytes"),
        ({"fields": []}, "expected x, y and z among them"),
        (
            {"fields": [{"name": "x", "offset": 9, "datatype": 7, "count": 1}]},
            "'x' to byte 13; expected at most 12",
        ),
        ({"fields": [{"name": "x", "offset": 0, "datatype": 9, "count": 1}]}, "datatype: 9; expected 1 to 8"),
        ({"fields": [{"name": "x", "offset": 0, "datatype": 7, "count": 1}] * 2}, "'x' twice"),
        ({"fields": "xyz"}, "fields: 'xyz'; expected a list"),
        ({"header": {"stamp": {"sec": -1, "nanosec": 0}}}, "header.stamp.sec: -1; expected a uint32"),
        (
            {"header": {"stamp": {"sec": 1, "nanosec": 10**9}}},
            "header.stamp.nanosec: 1000000000; expected 0 to",
        ),
        ({"header": {}}, "header.stamp: missing"),
        ({"header": 5}, "header: 5; expected an object"),
    ],
)
def test_a_fault_in_a_cloud_is_named(changes, problem):
    with pytest.raises(DataError, match="sensor_msgs/msg/PointCloud2") as fault:
        read(cloud(XYZ, [(1, 2, 3)], **changes))
    assert problem in str(fault.value)


def test_boxes_in_space_have_the_fields_of_the_definition():
    message = to_ros(BOXES_3D, frame_id="front")
    half = float(np.sqrt(0.5))
    (detection,) = message.content["detections"]
    center = detection["bbox"]["center"]
    assert message.type == "vision_msgs/msg/Detection3DArray"
    assert message.content["header"] == detection["header"] == HEADER
    assert detection["id"] == "7"
    assert detection["bbox"]["size"] == {"x": 4.0, "y": 2.0, "z": 1.5}
    assert center["position"] == {"x": 1.0, "y": 2.0, "z": 3.0}
    # a quarter turn to the left about z
    assert center["orientation"] == pytest.approx({"x": 0, "y": 0, "z": half, "w": half}, abs=1e-15)
    (result,) = detection["results"]
    assert result == {
        "hypothesis": {"class_id": "Car", "score": 0.75},
        "pose": {"pose": center, "covariance": NO_COVARIANCE},
    }


def test_a_climbing_direction_comes_back():
    record = Boxes3d(**{**{f: getattr(BOXES_3D, f) for f in BOXES_3D.__dataclass_fields__},
                        "directions": np.array([[-1, 2, 2]], np.float32)})  # fmt: skip
    back = read(to_ros(record, frame_id="front"))
    # float32 rounding of a third
    np.testing.assert_allclose(back.directions, [[-1 / 3, 2 / 3, 2 / 3]], atol=1e-7)


def test_the_likeliest_class_is_taken_and_ids_may_be_any_text():
    message = to_ros(BOXES_3D, frame_id="front")
    (detection,) = message.content["detections"]
    results = [
        {"hypothesis": {"class_id": name, "score": score}} for name, score in (("Van", 0.25), ("Bus", 0.5))
    ]
    changed = {**message.content, "detections": [{**detection, "results": results, "id": "a7"}]}
    record = read(RosMessage(message.type, changed))
    assert (record.class_names, record.confidence.tolist(), record.id.tolist()) == (("Bus",), [0.5], [0])


def test_covariances_of_fused_boxes_stand_in_the_pose():
    covariance = np.diag([1, 2, 3]).astype(np.float32)
    fused = FusedDetections(
        timestamp=TIME,
        image_seq=1,
        points_seq=2,
        camera_id=3,
        lidar_id=4,
        id=np.array([1, 2], np.int32),
        class_names=("Car", "Car"),
        confidence=np.ones(2, np.float32),
        centers=np.zeros((2, 3), np.float32),
        center_covs=np.stack([covariance] * 2),
        sizes_lwh=np.array([[1, 1, 1], [0, 0, 0]], np.float32),
        size_covs=np.zeros((2, 3, 3), np.float32),
        directions=np.array([[1, 0, 0], [0, 0, 0]], np.float32),
        velocities=np.zeros(2, np.float32),
        corners_xyxy=np.zeros((2, 4), np.uint32),
    )
    (detection,) = to_ros(fused, frame_id="front").content["detections"]
    found = np.reshape(detection["results"][0]["pose"]["covariance"], (6, 6))
    np.testing.assert_array_equal(found, np.diag([1, 2, 3, 0, 0, 0]))


def test_boxes_in_a_picture_have_the_fields_of_the_definition():
    record = Boxes2d(
        **COMMON,
        id=np.array([-2], np.int32),
        class_names=("Car",),
        confidence=np.array([0.5], np.float32),
        corners_xyxy=np.array([[10, 20, 13, 26]], np.uint32),
    )
    message = to_ros(record, frame_id="front")
    assert message.type == "vision_msgs/msg/Detection2DArray"
    (detection,) = message.content["detections"]
    assert detection["bbox"] == {
        "center": {"position": {"x": 11.5, "y": 23.0}, "theta": 0.0},
        "size_x": 3.0,
        "size_y": 6.0,
    }
    # turned by a right angle, width and height change places
    turned = {
        **detection,
        "bbox": {**detection["bbox"], "center": {"position": {"x": 11.5, "y": 23.0}, "theta": np.pi / 2}},
    }
    back = read(RosMessage(message.type, {**message.content, "detections": [turned]}))
    np.testing.assert_allclose(back.corners_xyxy, [[8, 21, 15, 25]])
    smaller = {**detection, "bbox": {**detection["bbox"], "size_x": -1.0}}
    with pytest.raises(DataError, match=r"detections\[0\].bbox.size_x: -1.0; expected 0 or more"):
        read(RosMessage(message.type, {**message.content, "detections": [smaller]}))


def test_other_records_and_messages_are_refused():
    with pytest.raises(OptionError, match="a RawData; expected one of ImageData"):
        to_ros(RawData(**COMMON, length=0, data=b""), frame_id="front")
    with pytest.raises(OptionError, match="expected one of sensor_msgs/msg/Image"):
        read(RosMessage("sensor_msgs/msg/Imu", {}))
