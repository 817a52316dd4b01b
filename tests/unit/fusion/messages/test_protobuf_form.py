"""Records as protobuf messages."""

import subprocess
import sys

import numpy as np
import pytest

from sceneloom.db34t import Boxes3d, FusedDetections, ImageData, PointCloudData, Timestamp
from sceneloom.db34t.protobuf import (
    decode,
    decode_send_request,
    encode,
    fill_message,
    from_protobuf,
    from_send_request,
    parse_message,
    to_protobuf,
)
from sceneloom.db34t.types import bytes_of
from sceneloom.db34t.wire import fusion_pb2
from sceneloom.errors import DataError, OptionError

TIME = Timestamp(1595682678, 715705367)
TIMESTAMP = fusion_pb2.Timestamp(s=1595682678, ns=715705367)


def image(data=b"\1\2\3", **changes):
    fields = {
        "sensor_id": 1,
        "timestamp": TIMESTAMP,
        "seq": 1,
        "height": 1,
        "width": 1,
        "encoding": "rgb8",
        "channel": 3,
    }
    return fusion_pb2.ImageData(**{**fields, "data": data, **changes})


def box(**changes):
    fields = {
        "id": 1,
        "class": "Car",
        "points_seq": 5,
        "confidence": 0.5,
        "timestamp": TIMESTAMP,
        "X": 1,
        "Y": 2,
        "Z": 3,
    }
    sizes = {"length": 4, "width": 2, "height": 1.5, "direction": (1, 0, 0), "velocity": -1}
    return fusion_pb2.Box3d(**{**fields, **sizes, **changes})


def boxes(*members, **changes):
    return fusion_pb2.Boxes3d(
        **{"sensor_id": 1, "seq": 5, "timestamp": TIMESTAMP, "boxes": members, **changes}
    )


def test_pixels_are_a_read_only_view_of_the_bytes_of_the_message():
    record = from_protobuf(image())
    assert record.data.tolist() == [1, 2, 3]
    base = record.data
    while isinstance(base, np.ndarray):
        base = base.base
    assert type(base) is bytes
    assert not record.data.flags.writeable
    assert bytes_of(record.data) is base


def test_a_part_of_an_array_gives_the_bytes_of_this_part():
    whole = np.frombuffer(b"\1\2\3\4", np.uint8)
    assert bytes_of(whole[:2]) == b"\1\2"
    assert bytes_of(whole[::-1]) == b"\4\3\2\1"


def test_points_are_little_endian_numbers_of_32_bits():
    cloud = PointCloudData(
        sensor_id=0,
        timestamp=TIME,
        seq=1,
        number=1,
        fields=("x", "y", "z"),
        fields_number=3,
        data=np.array([1, -2, 0.5], np.float32),
    )
    message = to_protobuf(cloud)
    assert message.data == bytes.fromhex("0000803f000000c00000003f")
    assert not message.HasField("beam")


def test_fields_stand_under_their_row_numbers_on_the_wire():
    content = encode(ImageData(
        sensor_id=7, timestamp=Timestamp(1, 2), seq=3, height=1, width=1, encoding="mono8", channel=1,
        data=np.array([9], np.uint8),
    ))  # fmt: skip
    # tag = number * 8 + type, written out by hand from the protobuf encoding
    assert content == bytes.fromhex("0807 1204 0801 1002 1803 2001 2801 3205") + b"mono8" + bytes.fromhex(
        "3801 420109"
    )


def test_boxes_are_read_into_columns():
    record = from_protobuf(boxes(box(), box(id=-2, X=9)))
    assert record.id.tolist() == [1, -2]
    assert record.centers.tolist() == [[1, 2, 3], [9, 2, 3]]
    assert record.velocities.tolist() == [-1, -1]
    assert record.velocity_vectors is None


FAULTS = [
    (image(timestamp=None), "timestamp", "missing; expected uint32. uint32"),
    (
        image(timestamp=fusion_pb2.Timestamp(s=1, ns=10**9)),
        "timestamp.ns",
        "1000000000; expected 0 to 999999999",
    ),
    (image(sensor_id=256), "sensor_id", "256; expected 0 to 255"),
    (image(data=b"\1\2"), "data", "2 values; expected 3"),
    (image(encoding=""), "encoding", "''; expected one of rgb8"),
    (boxes(box(), box(points_seq=6)), "boxes[1].points_seq", "6; expected 5 as all of them"),
    (
        boxes(box(timestamp=fusion_pb2.Timestamp(s=1))),
        "boxes[0].timestamp",
        "1.000000000; expected 1595682678",
    ),
    (boxes(box(timestamp=None)), "boxes[0].timestamp", "0.000000000; expected 1595682678"),
    (boxes(box(direction=(1, 0))), "boxes[0].direction", "(1.0, 0.0); expected float[3]"),
    (boxes(box(length=0)), "boxes[0].length", "0.0; expected more than 0"),
    (boxes(box(), box(velocity_vector=(1, 2, 3))), "boxes[0].velocity_vector", "(); expected float[3]"),
    (boxes(box(), timestamp=None), "timestamp", "missing"),
    (boxes(box(X=float("nan"))), "boxes[0].X", "nan; expected a finite number"),
]


@pytest.mark.parametrize(
    ("message", "location", "problem"), FAULTS, ids=[location for _, location, _ in FAULTS]
)
def test_a_fault_in_a_message_is_named(message, location, problem):
    with pytest.raises(DataError) as fault:
        from_protobuf(message)
    assert fault.value.location == location
    assert problem in fault.value.problem


def test_points_that_are_no_whole_number_of_values_are_refused():
    message = fusion_pb2.PointCloudData(
        timestamp=TIMESTAMP, fields=["x", "y", "z"], fields_number=3, data=b"12345"
    )
    with pytest.raises(DataError, match="data: 5 bytes; expected a multiple of 4"):
        from_protobuf(message)


def test_bytes_that_are_no_message_are_refused():
    with pytest.raises(DataError, match="3 bytes; expected a message ImageData"):
        decode("image", b"\xff\xff\xff")
    with pytest.raises(DataError, match="expected a message SendRequest"):
        parse_message(fusion_pb2.SendRequest, b"\x0a\x7f")


def test_pixels_of_a_request_are_a_view_of_its_bytes():
    content = fusion_pb2.SendRequest(image=image(), session="rig").SerializeToString()
    record = decode_send_request(content)
    base = record.data
    while isinstance(base, np.ndarray):
        base = base.base
    assert base is content
    assert record.data.tolist() == [1, 2, 3]


@pytest.mark.parametrize("before", range(4))
def test_points_of_a_request_are_aligned_wherever_they_stand(before):
    fields = {"timestamp": TIMESTAMP, "fields": ["x", "y", "z"], "fields_number": 3, "number": 1}
    points = fusion_pb2.PointCloudData(**fields, data=np.float32([1, 2, 3]).tobytes())
    content = (
        b"\xa2\x06"
        + bytes([before])
        + b"a" * before
        + fusion_pb2.SendRequest(points=points).SerializeToString()
    )
    record = decode_send_request(content)
    assert record.data.flags.aligned
    assert record.data.tolist() == [1, 2, 3]


def test_a_record_that_stands_twice_is_read_as_protobuf_reads_it():
    first, second = (
        fusion_pb2.SendRequest(image=image(data)).SerializeToString() for data in (b"123", b"456")
    )
    assert decode_send_request(first + second).data.tobytes() == b"456"
    other = fusion_pb2.SendRequest(raw=fusion_pb2.RawData(timestamp=TIMESTAMP)).SerializeToString()
    assert type(decode_send_request(first + other)).__name__ == "RawData"


def test_a_request_without_a_record_is_refused():
    with pytest.raises(DataError, match="missing; expected a record of one of tables 4 to 8"):
        from_send_request(fusion_pb2.SendRequest(session="a"))


def test_what_is_no_record_and_no_message_of_one_is_refused():
    with pytest.raises(OptionError):
        to_protobuf("image")
    with pytest.raises(OptionError):
        from_protobuf(fusion_pb2.Status(status=1))


def test_a_list_without_boxes_marks_its_location_in_a_reply():
    reply = fusion_pb2.GetReply()
    fill_message(
        reply.detections,
        FusedDetections.empty(Timestamp(0), image_seq=0, points_seq=0, camera_id=0, lidar_id=0),
    )
    assert reply.WhichOneof("result") == "detections"
    sent = fusion_pb2.GetReply.FromString(reply.SerializeToString())
    assert from_protobuf(sent.detections).timestamp == Timestamp(0)


def test_equal_records_have_equal_bytes():
    first, second = (from_protobuf(boxes(box(), box(id=2))) for _ in range(2))
    assert isinstance(first, Boxes3d)
    assert encode(first) == encode(second)


def test_records_and_json_need_no_protobuf_and_without_it_the_extra_is_named():
    program = (
        "import sys; import sceneloom.db34t.json; print('google.protobuf' in sys.modules)\n"
        "sys.modules['google.protobuf'] = None\n"
        "from sceneloom.errors import MissingExtraError\n"
        "try:\n    import sceneloom.db34t.protobuf\n"
        "except MissingExtraError as error:\n    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    loaded, reported = done.stdout.splitlines()
    assert loaded == "False"
    assert "pip install 'sceneloom[serve]'" in reported
