"""Records of DB34/T 4101-2022 come back from every form as they were; what is not a record is reported as such."""

import functools
import json
import operator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sceneloom.db34t import ENCODINGS, RECORD_KINDS, RawData, SensorFusionData, Timestamp, kind_of
from sceneloom.db34t import protobuf as pb
from sceneloom.db34t.json import format_json, from_json, parse_json, to_json
from sceneloom.db34t.records import Boxes2d, Boxes3d, CalibrationData, FusedDetections, ImageData, PointCloudData
from sceneloom.db34t.wire import fusion_pb2
from sceneloom.errors import DataError

SENDABLE = ("raw", "image", "points", "boxes_3d", "boxes_2d", "box_3d", "box_2d")
SEEDS = st.integers(0, 2**32 - 1)
"""Arrays are drawn by NumPy out of a seed: number by number takes a hundred times as long."""

LARGEST = float(np.finfo(np.float32).max)
FLOATS = np.array([0.0, -0.0, 1.0, -1.0, 0.1, 1e-45, -1e-40, LARGEST, -LARGEST, 3.5, 1e10], np.float32)
POSITIVES = FLOATS[FLOATS > 0]
PARTS = np.array([0.0, 1.0, 0.5, 0.1, 1e-45, 1.0 - 2.0**-24], np.float32)
UINT32S = np.array([0, 1, 255, 256, 2**31, 2**32 - 1], np.uint32)
INT32S = np.array([0, 1, -1, -(2**31), 2**31 - 1, 77], np.int32)
NAMES = ("Car", "车", "a b", "class", '"', "\\", "\0x", "é" * 40)
FIELDS = ("reflectivity", "ring", "time", "车", "t[0]")


class Draws:
    """Draws values of the standard's types, with a liking for the ends of their ranges."""

    def __init__(self, seed):
        self.rng = np.random.default_rng(seed)

    def array(self, pool, *shape):
        return self.rng.choice(pool, shape)

    def one(self, pool):
        return self.rng.choice(np.asarray(pool)).item()

    def head(self):
        """The fields that most records begin with."""
        return {"sensor_id": self.uint8(), "timestamp": self.time(), "seq": self.one(UINT32S)}

    def pair(self):
        """What fused data states of its sweep and image."""
        return {
            "timestamp": self.time(),
            "image_seq": self.one(UINT32S),
            "points_seq": self.one(UINT32S),
            "camera_id": self.uint8(),
            "lidar_id": self.uint8(),
            "motion_compensated": self.one([0, 1]),
            "image_timestamp": self.maybe(self.time()),
        }

    def uint8(self):
        return int(self.rng.integers(256))

    def time(self):
        return Timestamp(self.one(UINT32S), self.one([0, 1, 10**9 - 1, 715705367]))

    def count(self):
        return int(self.rng.integers(4))

    def maybe(self, value):
        return value if self.rng.random() < 0.5 else None

    def pixels(self, channels, values):
        """Size, encoding, channels and values of an image, the latter under these names."""
        height, width = int(self.rng.integers(1, 6)), int(self.rng.integers(1, 6))
        encoding = self.one(sorted(ENCODINGS))
        channel = self.one(sorted(ENCODINGS[encoding].channels))
        length = int(self.rng.integers(1, 50)) if ENCODINGS[encoding].is_file else height * width * channel
        data = self.rng.integers(0, 256, length, np.uint8)
        return {"height": height, "width": width, "encoding": encoding, channels: channel, values: data}

    def points(self, number, fields, values):
        """Number of points, their fields, and values, under these names."""
        names = tuple(self.rng.permutation(["x", "y", "z", *self.rng.permutation(FIELDS)[: self.count()]]).tolist())
        data = self.array(FLOATS, (count := self.count()) * len(names))
        return {number: count, fields: names, "fields_number": len(names), values: data}

    def directions(self, count):
        directions = self.array(FLOATS, count, 3)
        directions[:, 1] = self.array(POSITIVES, count)
        return directions

    def corners(self, count):
        sides = np.sort(self.array(UINT32S, count, 2, 2), axis=-1)
        flat = sides[..., 0] == sides[..., 1]
        sides[..., 0][flat & (sides[..., 0] > 0)] -= 1
        sides[..., 1][sides[..., 0] == sides[..., 1]] += 1
        return np.ascontiguousarray(sides.swapaxes(-1, -2)).reshape(count, 4)

    def covariances(self, count):
        """Symmetric matrices with variances that are not negative."""
        square = self.array(FLOATS, count, 3, 3)
        symmetric = np.triu(square) + np.triu(square, 1).transpose(0, 2, 1)
        symmetric[:, range(3), range(3)] = np.abs(symmetric[:, range(3), range(3)])
        return symmetric

    def objects(self, count):
        names = tuple(self.array(NAMES, count).tolist())
        return {"id": self.array(INT32S, count), "class_names": names, "confidence": self.array(PARTS, count)}

    def columns_3d(self, count):
        """The columns that lists of tables 7 and 10 have in common."""
        return self.objects(count) | {
            "centers": self.array(FLOATS, count, 3),
            "sizes_lwh": self.array(POSITIVES, count, 3),
            "directions": self.directions(count),
            "velocities": self.array(FLOATS, count),
            "velocity_vectors": self.maybe(self.array(FLOATS, count, 3)),
        }

    def ids(self, count):
        return tuple(self.maybe(number) for number in self.array(INT32S, count).tolist())


def raw_data(draws):
    data = draws.rng.bytes(draws.count())
    return RawData(**draws.head(), length=len(data), data=data)


def image_data(draws):
    return ImageData(**draws.head(), **draws.pixels("channel", "data"))


def point_cloud_data(draws):
    points, solid = draws.points("number", "fields", "data"), draws.rng.random() < 0.5
    beam, ring = (None if solid else draws.maybe(draws.one(UINT32S)) for _ in range(2))
    return PointCloudData(**draws.head(), **points, sensor_type=int(solid), beam=beam, ring=ring)


def boxes_3d(draws, count=None):
    return Boxes3d(**draws.head(), **draws.columns_3d(draws.count() if count is None else count))


def boxes_2d(draws, count=None):
    count = draws.count() if count is None else count
    return Boxes2d(**draws.head(), **draws.objects(count), corners_xyxy=draws.corners(count))


def calibration(draws):
    doubles = [0.0, 1.0, -1e-300, 1e300, 0.1]
    return CalibrationData(
        image_size=(draws.one(UINT32S[1:]), draws.one(UINT32S[1:])),
        intrinsic_matrix=tuple(draws.array(doubles, 9).tolist()),
        reference_frame=draws.one([0, 1]),
        extrinsic_matrix=tuple(draws.array(doubles, 16).tolist()),
        distortion_coeffs=tuple(draws.array(doubles, 5).tolist()),
    )


def sensor_fusion_data(draws):
    image = draws.pixels("image_channel", "image_data")
    return SensorFusionData(
        **draws.pair(),
        **image,
        **draws.points("point_num", "point_fields", "point_data"),
        class_name=draws.one(["", "Car"]),
        image_depth=np.abs(draws.array(FLOATS, image["height"] * image["width"])),
        depth_kind=draws.maybe(draws.one(["z", "range"])),
        point_frame=draws.maybe(draws.one(["lidar", "camera"])),
    )


def fused_detections(draws, count=None):
    count = draws.count() if count is None else count
    return FusedDetections(
        **draws.pair(),
        **draws.columns_3d(count),
        center_covs=draws.covariances(count),
        size_covs=draws.covariances(count),
        corners_xyxy=draws.corners(count),
        box_3d_ids=draws.ids(count),
        box_2d_ids=draws.ids(count),
    )


RECORDS = {
    "raw": raw_data,
    "image": image_data,
    "points": point_cloud_data,
    "boxes_3d": boxes_3d,
    "boxes_2d": boxes_2d,
    "box_3d": lambda draws: boxes_3d(draws, 1)[0],
    "box_2d": lambda draws: boxes_2d(draws, 1)[0],
    "calibration": calibration,
    "sensor_data": sensor_fusion_data,
    "detections": fused_detections,
    "detection": lambda draws: fused_detections(draws, 1)[0],
}
KINDS = pytest.mark.parametrize("kind", RECORD_KINDS)


@KINDS
@settings(max_examples=15)
@given(seed=SEEDS, lists=st.booleans())
def test_a_record_comes_back_from_protobuf_and_json_as_it_was(kind, seed, lists, assert_same):
    record = RECORDS[kind](Draws(seed))
    assert_same(pb.from_protobuf(pb.to_protobuf(record)), record)
    assert_same(pb.decode(kind, pb.encode(record)), record)
    # its bytes are those that protobuf writes
    assert pb.encode(record) == pb.to_protobuf(record).SerializeToString(deterministic=True)
    text = format_json(record, lists=lists)
    assert_same(parse_json(text), record)
    # another author's parser reads the same
    assert_same(from_json(kind, json.loads(text)[kind]), record)


@pytest.mark.parametrize("kind", SENDABLE)
@settings(max_examples=10)
@given(seed=SEEDS)
def test_a_record_comes_back_from_a_request_as_it_was(kind, seed, assert_same):
    record = RECORDS[kind](Draws(seed))
    request = pb.to_send_request(record, session="rig")
    assert (request.WhichOneof("data"), request.session) == (kind, "rig")
    sent = fusion_pb2.SendRequest.FromString(request.SerializeToString())
    assert_same(pb.from_send_request(sent), record)
    assert pb.encode_in(fusion_pb2.SendRequest(session="rig"), record) == request.SerializeToString()
    assert_same(pb.decode_send_request(request.SerializeToString()), record)


@KINDS
@settings(max_examples=5)
@given(seed=SEEDS)
def test_members_of_a_list_are_its_columns(kind, seed):
    record = RECORDS[kind](Draws(seed))
    layout = RECORD_KINDS[kind].layout
    if layout is None:
        return
    for k, member in enumerate(record):
        for column in layout.columns:
            values = getattr(record, column.attribute)
            rows = [layout.table.row(name) for name in column.names]
            found = [getattr(member, row.attribute) for row in rows]
            if values is None:
                assert found == [None]
            else:
                np.testing.assert_array_equal(np.ravel(found), values[k].ravel())


def record_or_fault(read, *arguments):
    """What reading gives: a record, or the fault that it raises; nothing else may be raised."""
    try:
        return read(*arguments)
    except DataError as error:
        return error


OTHERS = [None, True, -1, 0, 2**32, 2**70, 0.5, 1e39, 1e300, "", "x", "1.5", [], {}, [1], [[1]], {"s": 1, "ns": 10**9}]


def locations(content, path=()):
    """All paths to the values of a JSON document, of lists to the first of their items."""
    if path:
        yield path
    parts = (
        content.items() if isinstance(content, dict) else enumerate(content[:20] if isinstance(content, list) else ())
    )
    for key, value in parts:
        yield from locations(value, (*path, key))


@KINDS
@settings(max_examples=30)
@given(seed=SEEDS, data=st.data())
def test_json_with_another_value_somewhere_is_a_record_or_a_fault(kind, seed, data):
    content = json.loads(json.dumps(to_json(RECORDS[kind](Draws(seed)), lists=data.draw(st.booleans()))))
    *path, last = data.draw(st.sampled_from(list(locations(content))))
    parent = functools.reduce(operator.getitem, path, content)
    if isinstance(parent, dict) and data.draw(st.booleans()):
        del parent[last]
    else:
        old = parent[last]
        others = st.sampled_from(OTHERS) | st.just([old, old]) | st.just({"a": old}) | st.text(max_size=5)
        parent[last] = data.draw(others)
    found = record_or_fault(from_json, kind, content)
    if isinstance(found, DataError):
        assert f"table {RECORD_KINDS[kind].table.number}" in found.file
    else:
        assert kind_of(found).name == kind


@settings(max_examples=100)
@given(st.binary(max_size=60) | st.text(max_size=60), st.integers(0, 2**32 - 1), st.integers(0, 10**9 - 1))
def test_any_text_is_a_record_or_a_fault_and_timestamps_come_back_from_nanoseconds_and_text(text, seconds, rest):
    found = record_or_fault(parse_json, text)
    assert isinstance(found, DataError)
    assert found.problem
    timestamp = Timestamp(seconds, rest)
    assert Timestamp.of(timestamp.nanoseconds) == Timestamp.parse(str(timestamp)) == timestamp


@KINDS
@settings(max_examples=30)
@given(seed=SEEDS, data=st.data())
def test_protobuf_with_other_bytes_somewhere_is_a_record_or_a_fault(kind, seed, data):
    content = bytearray(pb.encode(RECORDS[kind](Draws(seed))))
    for _ in range(data.draw(st.integers(1, 3))):
        k = data.draw(st.integers(0, len(content)))
        content[k : k + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=3))
    found = record_or_fault(pb.decode, kind, bytes(content))
    if isinstance(found, DataError):
        assert found.problem
    else:
        assert kind_of(found).name == kind
        pb.encode(found)


@pytest.mark.parametrize("kind", SENDABLE)
@settings(max_examples=60)
@given(seed=SEEDS, data=st.data())
def test_a_request_with_other_bytes_somewhere_is_a_record_or_a_fault(kind, seed, data):
    content = bytearray(pb.to_send_request(RECORDS[kind](Draws(seed))).SerializeToString())
    k = data.draw(st.integers(0, len(content)))
    content[k : k + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=3))
    found = record_or_fault(lambda: pb.from_send_request(pb.parse_message(fusion_pb2.SendRequest, bytes(content))))
    quickly = record_or_fault(pb.decode_send_request, bytes(content))
    assert isinstance(quickly, DataError) == isinstance(found, DataError), (found, quickly)
    if not isinstance(found, DataError):
        assert kind_of(found).name in SENDABLE
        assert pb.encode(quickly) == pb.encode(found)
