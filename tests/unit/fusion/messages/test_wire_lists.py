"""Lists of records read from bytes and written to them by compiled loops, against Google's library doing the same."""

import numpy as np
import pytest

from sceneloom.db34t.boxes import Boxes2d, Boxes3d
from sceneloom.db34t.protobuf import (
    decode_send_request,
    encode,
    from_protobuf,
    from_send_request,
    parse_message,
    read_usual_list,
    to_protobuf,
    to_send_request,
)
from sceneloom.db34t.records import RECORD_KINDS, FusedDetections
from sceneloom.db34t.types import Timestamp
from sceneloom.db34t.wire import fusion_pb2
from sceneloom.errors import DataError

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
    "a number of 64 bits": lambda head, time, box: (
        head + time + _field(box + tagged(9, 0, b"\xff" * 9 + b"\x01"))
    ),
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
