"""Requests with other bytes somewhere: each is answered or refused, none ends a call in any other way."""

import contextlib

import pytest
from google.protobuf.message import DecodeError
from hypothesis import given
from hypothesis import strategies as st

from sceneloom.db34t.interface import FusionInterface
from sceneloom.db34t.wire import fusion_pb2
from sceneloom.errors import DataError
from sceneloom.service.methods import METHODS
from sceneloom.service.sessions import CallError

TIMESTAMP = fusion_pb2.Timestamp(s=1, ns=2)
POSE = fusion_pb2.Pose(timestamp=TIMESTAMP, position=[1, 2, 3], quaternion_xyzw=[0, 0, 0, 1])
LIST = fusion_pb2.ValueList(values=[fusion_pb2.Value(integer_value=k) for k in (0, -1, 2)])
FORWARD = (0, 0, 1, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 0, 1)

REQUESTS = {
    "AddProperty": fusion_pb2.AddPropertyRequest(name="mode", description="a=1, b=2", type="(enum, float)"),
    "SetProperty": fusion_pb2.SetPropertyRequest(name="lidar_coordinate", value=fusion_pb2.Value(list_value=LIST)),
    "GetProperty": fusion_pb2.GetPropertyRequest(name="chirality"),
    "ListProperties": fusion_pb2.ListPropertiesRequest(session="a"),
    "SetCalibration": fusion_pb2.SetCalibrationRequest(
        calibration=fusion_pb2.Calibration(
            image_size=[4, 2], intrinsic_matrix=[5, 0, 2, 0, 5, 1, 0, 0, 1], extrinsic_matrix=FORWARD
        ),
        camera_id=1,
    ),
    "SendMotion": fusion_pb2.SendMotionRequest(poses=[POSE]),
    "Send": fusion_pb2.SendRequest(
        points=fusion_pb2.PointCloudData(
            timestamp=TIMESTAMP, number=1, fields=["x", "y", "z"], fields_number=3, data=bytes(12)
        ),
        session="a",
    ),
    "GetCounters": fusion_pb2.GetCountersRequest(session="a"),
    "Flush": fusion_pb2.FlushRequest(session="a"),
}


def test_each_method_that_is_one_step_is_tried():
    assert set(REQUESTS) == {name for name, method in METHODS.items() if method.call.perform is not None}


@pytest.mark.parametrize("name", REQUESTS)
@given(data=st.data())
def test_other_bytes_are_answered_or_refused(name, data):
    content = bytearray(REQUESTS[name].SerializeToString())
    for _ in range(data.draw(st.integers(1, 3))):
        k = data.draw(st.integers(0, len(content)))
        content[k : k + data.draw(st.integers(0, 4))] = data.draw(st.binary(max_size=4))
    method = METHODS[name]
    with FusionInterface(inline=True) as fusion, contextlib.suppress(CallError):
        method.reply_type.FromString(method.perform(fusion, bytes(content)))


@pytest.mark.parametrize("name", REQUESTS)
@given(content=st.binary(max_size=60))
def test_any_bytes_name_a_session_or_are_refused(name, content):
    method = METHODS[name]
    try:
        expected = method.request_type.FromString(content).session
    except DecodeError:
        expected = None
    try:
        found = method.session_of(content)
    except DataError:
        found = None
    assert expected is None or found == expected
