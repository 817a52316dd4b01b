"""Records as protobuf messages; lists of boxes by compiled loops, against Google's library doing the same."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from grpc_tools import protoc
from tests.properties.test_fusion_messages import RECORDS, Draws

from sceneloom.db34t import ImageData, kind_of
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
from sceneloom.db34t.records import FusedDetections
from sceneloom.db34t.types import Timestamp, bytes_of
from sceneloom.db34t.wire import fusion_pb2
from sceneloom.errors import DataError, OptionError

from .sending import cloud

TIMESTAMP = fusion_pb2.Timestamp(s=1595682678, ns=715705367)


def image(data=b"\1\2\3", **changes):
    fields = {"sensor_id": 1, "timestamp": TIMESTAMP, "seq": 1, "height": 1, "width": 1}
    return fusion_pb2.ImageData(**{**fields, "encoding": "rgb8", "channel": 3, "data": data, **changes})


def box(**changes):
    fields = {"id": 1, "class": "Car", "points_seq": 5, "confidence": 0.5, "timestamp": TIMESTAMP}
    where = {"X": 1, "Y": 2, "Z": 3, "direction": (1, 0, 0), "velocity": -1}
    return fusion_pb2.Box3d(**{**fields, **where, "length": 4, "width": 2, "height": 1.5, **changes})


def boxes(*members, **changes):
    return fusion_pb2.Boxes3d(**{"sensor_id": 1, "seq": 5, "timestamp": TIMESTAMP, "boxes": members, **changes})


def owner(data):
    """What holds the memory of an array."""
    while isinstance(data, np.ndarray):
        data = data.base
    return data


def test_pixels_and_points_are_read_only_views_of_the_bytes_of_the_message_or_request():
    record = from_protobuf(image())
    assert type(owner(record.data)) is bytes
    assert not record.data.flags.writeable
    assert bytes_of(record.data) is owner(record.data)
    content = fusion_pb2.SendRequest(image=image(), session="rig").SerializeToString()
    sent = decode_send_request(content)
    assert owner(sent.data) is content
    assert record.data.tolist() == sent.data.tolist() == [1, 2, 3]
    whole = np.frombuffer(b"\1\2\3\4", np.uint8)  # a part of an array gives the bytes of this part
    assert (bytes_of(whole[:2]), bytes_of(whole[::-1])) == (b"\1\2", b"\4\3\2\1")
    fields = {"timestamp": TIMESTAMP, "fields": ["x", "y", "z"], "fields_number": 3, "number": 1}
    points = fusion_pb2.PointCloudData(**fields, data=np.float32([1, 2, 3]).tobytes())
    content = fusion_pb2.SendRequest(points=points).SerializeToString()
    for before in range(4):  # points are aligned wherever they stand
        sent = decode_send_request(b"\xa2\x06" + bytes([before]) + b"a" * before + content)
        assert (sent.data.flags.aligned, sent.data.tolist()) == (True, [1, 2, 3])


def test_fields_stand_under_their_row_numbers_on_the_wire():
    form = {"height": 1, "width": 1, "encoding": "mono8", "channel": 1, "data": np.array([9], np.uint8)}
    content = encode(ImageData(sensor_id=7, timestamp=Timestamp(1, 2), seq=3, **form))
    # tag = number * 8 + type, written out by hand from the protobuf encoding
    assert content == bytes.fromhex("0807 1204 0801 1002 1803 2001 2801 3205") + b"mono8" + bytes.fromhex("3801 420109")
    message = to_protobuf(cloud(0, 1, [(1, -2, 0.5)]))
    assert message.data == bytes.fromhex("0000803f000000c00000003f")  # little-endian numbers of 32 bits
    assert not message.HasField("beam")
    reply = fusion_pb2.GetReply()
    numbers = {"image_seq": 0, "points_seq": 0, "camera_id": 0, "lidar_id": 0}
    fill_message(reply.detections, FusedDetections.empty(Timestamp(0), **numbers))
    assert reply.WhichOneof("result") == "detections"  # though there are none
    assert from_protobuf(fusion_pb2.GetReply.FromString(reply.SerializeToString()).detections).timestamp == Timestamp(0)


FAULTS = [
    (image(timestamp=None), "timestamp", "missing; expected uint32. uint32"),
    (image(timestamp=fusion_pb2.Timestamp(s=1, ns=10**9)), "timestamp.ns", "1000000000; expected 0 to 999999999"),
    (boxes(box(), box(points_seq=6)), "boxes[1].points_seq", "6; expected 5 as all of them"),
    (boxes(box(timestamp=fusion_pb2.Timestamp(s=1))), "boxes[0].timestamp", "1.000000000; expected 1595682678"),
    (boxes(box(timestamp=None)), "boxes[0].timestamp", "0.000000000; expected 1595682678"),
    (boxes(box(direction=(1, 0))), "boxes[0].direction", "(1.0, 0.0); expected float[3]"),
    (boxes(box(), box(velocity_vector=(1, 2, 3))), "boxes[0].velocity_vector", "(); expected float[3]"),
    (boxes(box(), timestamp=None), "timestamp", "missing"),
]


@pytest.mark.parametrize(("message", "location", "problem"), FAULTS, ids=[location for _, location, _ in FAULTS])
def test_a_fault_in_a_message_is_named(message, location, problem):
    with pytest.raises(DataError) as fault:
        from_protobuf(message)
    assert fault.value.location == location
    assert problem in fault.value.problem


def test_what_is_no_record_no_message_of_one_or_cut_is_refused():
    points = fusion_pb2.PointCloudData(timestamp=TIMESTAMP, fields=["x", "y", "z"], fields_number=3, data=b"12345")
    nothing = fusion_pb2.SendRequest(session="a")
    for read, given, error, words in (
        (from_protobuf, (points,), DataError, "data: 5 bytes; expected a multiple of 4"),
        (decode, ("image", b"\xff\xff\xff"), DataError, "3 bytes; expected a message ImageData"),
        (parse_message, (fusion_pb2.SendRequest, b"\x0a\x7f"), DataError, "expected a message SendRequest"),
        (from_send_request, (nothing,), DataError, "missing; expected a record of one of tables 4 to 8"),
        (to_protobuf, ("image",), OptionError, "a str; expected"),
        (from_protobuf, (fusion_pb2.Status(status=1),), OptionError, "a Status; expected"),
    ):
        with pytest.raises(error, match=words):
            read(*given)


def test_a_record_that_stands_twice_is_read_as_protobuf_reads_it():
    first, second = (fusion_pb2.SendRequest(image=image(data)).SerializeToString() for data in (b"123", b"456"))
    assert decode_send_request(first + second).data.tobytes() == b"456"
    other = fusion_pb2.SendRequest(raw=fusion_pb2.RawData(timestamp=TIMESTAMP)).SerializeToString()
    assert type(decode_send_request(first + other)).__name__ == "RawData"


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


def outcome(read, *given):
    """What comes of reading: every field of the record, or the fault."""
    try:
        record = read(*given)
    except DataError as error:
        # how many bytes are no message depends on what has been taken out of them
        return re.sub(r"^protobuf: \d+ bytes", "protobuf: bytes", str(error))
    return [
        (name, value.dtype, value.shape, value.tobytes()) if isinstance(value, np.ndarray) else (name, value)
        for name in type(record).__slots__
        for value in [getattr(record, name)]
    ]


def by_the_library(content):
    return from_send_request(parse_message(fusion_pb2.SendRequest, content))


@pytest.mark.parametrize("kind", ["boxes_3d", "boxes_2d"])
def test_lists_are_read_as_the_library_reads_them_broken_ones_too(kind):
    random = np.random.default_rng(3)
    faults = 0
    for seed in range(40):
        record = RECORDS[kind](Draws(seed))
        listed = encode(record)
        assert outcome(read_usual_list, listed, 0, len(listed), kind_of(record)) == outcome(decode, kind, listed)
        content = to_send_request(record, session="a" if seed % 3 else "").SerializeToString()
        assert outcome(decode_send_request, content) == outcome(by_the_library, content)
        content = to_send_request(record).SerializeToString()
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


def field(number, content):
    return tagged(number, 2, bytes([len(content)]) + content)


TIME_5 = field(3, b"\x08\x05")
BOX = field(2, b"car") + tagged(3, 0, b"\x07") + field(5, b"\x08\x05")


@pytest.mark.parametrize(
    "members",
    [
        field(4, BOX) + TIME_5,  # time behind the boxes
        field(4, BOX),  # no time
        TIME_5 + field(3, b"\x08\x07") + field(4, BOX),  # two times
        TIME_5 + tagged(9, 0, b"\x05") + field(4, BOX),  # a field that nobody knows
        TIME_5 + field(4, BOX + tagged(15, 0, b"\x05")),  # such a field in a box
        TIME_5 + field(4, BOX + tagged(9, 0, b"\x50")),  # a number that comes twice
        TIME_5 + field(4, BOX + tagged(9, 0, b"\xff" * 9 + b"\x01")),  # a number of 64 bits
        TIME_5 + field(4, BOX + tagged(3, 0, b"\x09")),  # another number of the image
        TIME_5 + field(4, BOX + field(2, b"\xff")),  # no UTF-8
        TIME_5 + field(4, BOX + tagged(2, 2, b"\x7fa")),  # a text that is too long
    ],
)
def test_unusual_bytes_have_the_outcome_that_the_library_gives_them(members):
    content = field(5, tagged(1, 0, b"\x02") + tagged(2, 0, b"\x07") + members)
    assert outcome(decode_send_request, content) == outcome(by_the_library, content)
    box = field(2, b"car") + field(5, b"")  # vectors in single numbers are read
    for number, value in zip((9, 10, 11, 12, 12, 12), (2, 2, 2, 1.0, 0.0, 0.5), strict=True):
        box += tagged(number, 5, np.float32(value).tobytes())
    record = decode_send_request(field(4, field(3, b"") + field(4, box)))
    assert record.directions.tolist() == [[1.0, 0.0, 0.5]]


PROTO_FOLDER = Path(__file__).parents[3] / "proto"
PROTO = "sceneloom/db34t4101/v1/fusion.proto"


def without_versions(code):
    """Generated code less what changes with the compiler alone."""
    return [line for line in code.read_text("utf-8").splitlines() if line.startswith(("DESCRIPTOR", "  _globals"))]


def test_the_committed_code_is_made_from_the_proto_as_it_is(tmp_path):
    assert protoc.main(["protoc", f"-I{PROTO_FOLDER}", f"--python_out={tmp_path}", PROTO]) == 0
    committed = without_versions(Path(fusion_pb2.__file__))
    assert committed == without_versions(tmp_path / PROTO.replace(".proto", "_pb2.py"))
    assert len(committed) > 30
