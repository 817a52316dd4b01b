"""Records as protobuf messages; lists of boxes by compiled loops, against Google's library doing the same."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from grpc_tools import protoc

from sceneloom.db34t import ImageData, PointCloudData
from sceneloom.db34t.protobuf import (
    decode,
    decode_send_request,
    encode,
    fill_message,
    from_protobuf,
    from_send_request,
    parse_message,
    read_usual_list,
    to_protobuf,
    to_send_request,
)
from sceneloom.db34t.records import RECORD_KINDS, Boxes2d, Boxes3d, FusedDetections
from sceneloom.db34t.types import Timestamp, bytes_of
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
    return fusion_pb2.Boxes3d(**{"sensor_id": 1, "seq": 5, "timestamp": TIMESTAMP, "boxes": members, **changes})


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
    assert content == bytes.fromhex("0807 1204 0801 1002 1803 2001 2801 3205") + b"mono8" + bytes.fromhex("3801 420109")


def test_boxes_are_read_into_columns():
    record = from_protobuf(boxes(box(), box(id=-2, X=9)))
    assert record.id.tolist() == [1, -2]
    assert record.centers.tolist() == [[1, 2, 3], [9, 2, 3]]
    assert record.velocities.tolist() == [-1, -1]
    assert record.velocity_vectors is None


FAULTS = [
    (image(timestamp=None), "timestamp", "missing; expected uint32. uint32"),
    (image(timestamp=fusion_pb2.Timestamp(s=1, ns=10**9)), "timestamp.ns", "1000000000; expected 0 to 999999999"),
    (image(sensor_id=256), "sensor_id", "256; expected 0 to 255"),
    (image(data=b"\1\2"), "data", "2 values; expected 3"),
    (image(encoding=""), "encoding", "''; expected one of rgb8"),
    (boxes(box(), box(points_seq=6)), "boxes[1].points_seq", "6; expected 5 as all of them"),
    (boxes(box(timestamp=fusion_pb2.Timestamp(s=1))), "boxes[0].timestamp", "1.000000000; expected 1595682678"),
    (boxes(box(timestamp=None)), "boxes[0].timestamp", "0.000000000; expected 1595682678"),
    (boxes(box(direction=(1, 0))), "boxes[0].direction", "(1.0, 0.0); expected float[3]"),
    (boxes(box(length=0)), "boxes[0].length", "0.0; expected more than 0"),
    (boxes(box(), box(velocity_vector=(1, 2, 3))), "boxes[0].velocity_vector", "(); expected float[3]"),
    (boxes(box(), timestamp=None), "timestamp", "missing"),
    (boxes(box(X=float("nan"))), "boxes[0].X", "nan; expected a finite number"),
]


@pytest.mark.parametrize(("message", "location", "problem"), FAULTS, ids=[location for _, location, _ in FAULTS])
def test_a_fault_in_a_message_is_named(message, location, problem):
    with pytest.raises(DataError) as fault:
        from_protobuf(message)
    assert fault.value.location == location
    assert problem in fault.value.problem


def test_points_that_are_no_whole_number_of_values_are_refused():
    message = fusion_pb2.PointCloudData(timestamp=TIMESTAMP, fields=["x", "y", "z"], fields_number=3, data=b"12345")
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
    content = b"\xa2\x06" + bytes([before]) + b"a" * before + fusion_pb2.SendRequest(points=points).SerializeToString()
    record = decode_send_request(content)
    assert record.data.flags.aligned
    assert record.data.tolist() == [1, 2, 3]


def test_a_record_that_stands_twice_is_read_as_protobuf_reads_it():
    first, second = (fusion_pb2.SendRequest(image=image(data)).SerializeToString() for data in (b"123", b"456"))
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
        reply.detections, FusedDetections.empty(Timestamp(0), image_seq=0, points_seq=0, camera_id=0, lidar_id=0)
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


NAMES = ("car", "Pedestrian", "行人", "x" * 300, "é")
TIMES = (Timestamp(0, 0), Timestamp(1595682678, 715705367), Timestamp(2**32 - 1, 0))


def odd_floats(random, shape):
    """Numbers of which many are 0, -0, tiny or huge."""
    values = random.normal(size=shape).astype(np.float32)
    for odd in (0.0, -0.0, 1e-45, 3e38):
        values[random.random(shape) < 0.1] = odd
    return values


def whole(random, count):
    return random.choice(np.array([0, 1, -1, 127, -64, 2**31 - 1, -(2**31)], np.int32), count)


def boxes_3d(seed):
    random = np.random.default_rng(seed)
    count = int(random.integers(0, 7))
    directions = odd_floats(random, (count, 3))
    directions[:, 1] = 0.5
    return Boxes3d(
        sensor_id=int(random.choice([0, 200])),
        seq=int(random.choice([0, 5, 2**32 - 1])),
        timestamp=TIMES[random.integers(3)],
        id=whole(random, count),
        class_names=tuple(random.choice(NAMES, count).tolist()),
        confidence=random.choice(np.array([0, 0.3, 1], np.float32), count),
        centers=odd_floats(random, (count, 3)),
        sizes_lwh=random.uniform(0.1, 5, (count, 3)).astype(np.float32),
        directions=directions,
        velocities=odd_floats(random, count),
        velocity_vectors=odd_floats(random, (count, 3)) if seed % 2 else None,
    )


def boxes_2d(seed):
    random = np.random.default_rng(seed)
    count = int(random.integers(0, 7))
    edges = np.array([0, 1, 127, 128, 2**32 - 1], np.uint32)
    sides = [random.choice(edges, 2, replace=False) for _ in range(2 * count)]
    corners = np.sort(np.array(sides, np.uint32).reshape(count, 2, 2), axis=2).swapaxes(1, 2)
    return Boxes2d(
        sensor_id=7,
        seq=int(random.choice([0, 5, 2**32 - 1])),
        timestamp=TIMES[random.integers(3)],
        id=whole(random, count),
        class_names=tuple(random.choice(NAMES, count).tolist()),
        confidence=random.choice(np.array([0, 0.3, 1], np.float32), count),
        corners_xyxy=corners.reshape(count, 4),
    )


def detections(seed):
    random = np.random.default_rng(seed)
    three = boxes_3d(seed)
    count = len(three)
    two_ids = tuple(None if random.random() < 0.3 else int(k) for k in whole(random, count))
    return FusedDetections(
        timestamp=three.timestamp,
        image_seq=0,
        points_seq=9,
        camera_id=3,
        lidar_id=0,
        id=three.id,
        class_names=three.class_names,
        confidence=three.confidence,
        centers=three.centers,
        center_covs=np.tile(np.eye(3, dtype=np.float32), (count, 1, 1)),
        sizes_lwh=three.sizes_lwh,
        size_covs=np.zeros((count, 3, 3), np.float32),
        directions=three.directions,
        velocities=three.velocities,
        corners_xyxy=np.tile(np.array([0, 2, 300, 2**32 - 1], np.uint32), (count, 1)),
        velocity_vectors=three.velocity_vectors,
        box_3d_ids=tuple(three.id.tolist()),
        box_2d_ids=two_ids,
        motion_compensated=seed % 2,
        image_timestamp=TIMES[1] if seed % 3 else None,
    )


def outcome(read, *given):
    """What comes of reading: every field of the record, or the fault."""
    try:
        record = read(*given)
    except DataError as error:
        return str(error)
    return [
        (name, value.dtype, value.shape, value.tobytes()) if isinstance(value, np.ndarray) else (name, value)
        for name in type(record).__slots__
        for value in [getattr(record, name)]
    ]


def by_the_library(content):
    return from_send_request(parse_message(fusion_pb2.SendRequest, content))


def read_as_usual(record):
    content = encode(record)
    name = "boxes_3d" if isinstance(record, Boxes3d) else "boxes_2d"
    return read_usual_list(content, 0, len(content), RECORD_KINDS[name])


@pytest.mark.parametrize("make", [boxes_3d, boxes_2d, detections])
def test_lists_are_written_byte_by_byte_as_the_library_writes_them(make):
    for seed in range(60):
        record = make(seed)
        message = to_protobuf(record)
        assert encode(record) == message.SerializeToString(deterministic=True)
        assert outcome(from_protobuf, message) == outcome(lambda: record)  # noqa: B023 - called at once


@pytest.mark.parametrize("make", [boxes_3d, boxes_2d])
def test_lists_are_read_as_the_library_reads_them(make):
    for seed in range(60):
        record = make(seed)
        content = to_send_request(record, session="a" if seed % 3 else "").SerializeToString()
        assert outcome(decode_send_request, content) == outcome(by_the_library, content)
        assert outcome(read_as_usual, record) == outcome(by_the_library, content)


@pytest.mark.parametrize("make", [boxes_3d, boxes_2d])
def test_broken_bytes_have_the_outcome_that_the_library_gives_them(make):
    random = np.random.default_rng(3)
    faults = 0
    for seed in range(40):
        content = bytearray(to_send_request(make(seed)).SerializeToString())
        for _ in range(12):
            broken = bytearray(content)
            for location in random.integers(len(broken), size=random.integers(1, 3)):
                broken[location] = random.choice([0, 1, 0xFF, broken[location] ^ 1 << random.integers(8)])
            broken = bytes(broken[: random.integers(1, 2 * len(broken))])
            assert outcome(decode_send_request, broken) == outcome(by_the_library, broken)
            faults += isinstance(outcome(by_the_library, broken), str)
    assert 50 < faults < 450


def tagged(number, kind, content):
    return bytes([number << 3 | kind]) + content


UNUSUAL = {
    "time behind the boxes": lambda head, time, box: head + tagged(4, 2, bytes([len(box)]) + box) + time,
    "no time": lambda head, time, box: head + tagged(4, 2, bytes([len(box)]) + box),
    "two times": lambda head, time, box: head + time + tagged(3, 2, b"\x02\x08\x07") + _field(box),
    "a field that nobody knows": lambda head, time, box: head + time + tagged(9, 0, b"\x05") + _field(box),
    "such a field in a box": lambda head, time, box: head + time + _field(box + tagged(15, 0, b"\x05")),
    "a number that comes twice": lambda head, time, box: head + time + _field(box + tagged(9, 0, b"\x50")),
    "a number of 64 bits": lambda head, time, box: head + time + _field(box + tagged(9, 0, b"\xff" * 9 + b"\x01")),
    "another number of the image": lambda head, time, box: head + time + _field(box + tagged(3, 0, b"\x09")),
    "no UTF-8": lambda head, time, box: head + time + _field(box + tagged(2, 2, b"\x01\xff")),
    "a text that is too long": lambda head, time, box: head + time + _field(box + tagged(2, 2, b"\x7fa")),
}


def _field(box):
    return tagged(4, 2, bytes([len(box)]) + box)


@pytest.mark.parametrize("name", UNUSUAL)
def test_unusual_bytes_have_the_outcome_that_the_library_gives_them(name):
    time = tagged(3, 2, b"\x02\x08\x05")
    box = tagged(2, 2, b"\x03car") + tagged(3, 0, b"\x07") + tagged(5, 2, b"\x02\x08\x05")
    boxes = UNUSUAL[name](tagged(1, 0, b"\x02") + tagged(2, 0, b"\x07"), time, box)
    content = tagged(5, 2, bytes([len(boxes)]) + boxes)
    assert outcome(decode_send_request, content) == outcome(by_the_library, content)


def test_vectors_in_single_numbers_are_read():
    box = tagged(2, 2, b"\x03car") + tagged(5, 2, b"\x00")
    for size in (9, 10, 11):
        box += tagged(size, 5, np.float32(2).tobytes())
    for value in (1.0, 0.0, 0.5):
        box += tagged(12, 5, np.float32(value).tobytes())
    boxes = tagged(3, 2, b"\x00") + tagged(4, 2, bytes([len(box)]) + box)
    record = decode_send_request(tagged(4, 2, bytes([len(boxes)]) + boxes))
    assert record.directions.tolist() == [[1.0, 0.0, 0.5]]


PROTO_FOLDER = Path(__file__).parents[3] / "proto"
PROTO = "sceneloom/db34t4101/v1/fusion.proto"


def without_versions(code):
    """Generated code less what changes with the compiler alone."""
    return [line for line in code.splitlines() if line.startswith(("DESCRIPTOR", "  _globals"))]


def test_the_committed_code_is_made_from_the_proto_as_it_is(tmp_path):
    arguments = ["protoc", f"-I{PROTO_FOLDER}", f"--python_out={tmp_path}", PROTO]
    assert protoc.main(arguments) == 0
    compiled = (tmp_path / PROTO.replace(".proto", "_pb2.py")).read_text("utf-8")
    committed = Path(fusion_pb2.__file__).read_text("utf-8")
    assert without_versions(committed) == without_versions(compiled)
    assert len(without_versions(committed)) > 30
