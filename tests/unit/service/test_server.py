"""Each method of the service, called over the network by the descriptor alone."""

import grpc
import numpy as np
import pytest

from sceneloom.db34t.protobuf import to_send_request
from sceneloom.db34t.wire import fusion_pb2
from sceneloom.service.methods import CALLS, METHODS, SERVICE


def failure(function, *arguments, **options):
    """The code and the details that a call ends with."""
    with pytest.raises(grpc.RpcError) as caught:
        function(*arguments, **options)
    return caught.value.code().name, caught.value.details()


def test_the_table_has_the_methods_of_the_descriptor():
    assert list(CALLS) == list(METHODS) == [method.name for method in SERVICE.methods]


def test_properties_are_added_set_and_read(call):
    assert call("AddProperty", name="site", description="where", type="string[]").status == 1
    sites = [fusion_pb2.Value(string_value=name) for name in ("yard", "road")]
    value = fusion_pb2.Value(list_value=fusion_pb2.ValueList(values=sites))
    assert call("SetProperty", name="site", value=value).status == 1
    found = call("GetProperty", name="site")
    assert (found.description, found.type, found.predefined) == ("where", "string[]", False)
    assert [item.string_value for item in found.value.list_value.values] == ["yard", "road"]
    listed = call("ListProperties").properties
    assert [p.name for p in listed[:3]] == ["fusion_type", "chirality", "camera_coordinate"]
    assert listed[-1] == found


@pytest.mark.parametrize(
    ("method", "fields", "cause"),
    [
        ("AddProperty", {"name": "chirality", "description": "", "type": "bool"}, "known-name"),
        ("AddProperty", {"name": "x", "description": "", "type": "int64"}, "ill-typed"),
        ("SetProperty", {"name": "x", "value": fusion_pb2.Value(integer_value=1)}, "unknown-name"),
        (
            "SetProperty",
            {"name": "lidar_frequency", "value": fusion_pb2.Value(integer_value=2**32 + 10)},
            "ill-typed",
        ),
        (
            "SetProperty",
            {"name": "lidar_frequency", "value": fusion_pb2.Value(string_value="10")},
            "ill-typed",
        ),
        ("SetProperty", {"name": "lidar_frequency"}, "ill-typed"),
        ("SetCalibration", {"camera_id": 1}, "bad-calibration"),
        ("SetCalibration", {"camera_id": 256}, "bad-calibration"),
        ("SendMotion", {}, "bad-motion"),
        ("SendMotion", {"poses": [fusion_pb2.Pose(position=[0, 0, 0])]}, "bad-motion"),
        ("Send", {}, "bad-record"),
        ("Send", {"image": fusion_pb2.ImageData(height=1)}, "bad-record"),
        ("CloseSession", {}, "unknown-name"),
    ],
)
def test_what_cannot_be_done_gets_0_with_cause_and_reason(serve, connect, method, fields, cause):
    status = connect(serve())(method, **fields)
    assert (status.status, status.cause) == (0, cause)
    assert status.reason


@pytest.mark.parametrize("method", [name for name, method in METHODS.items() if method.answers_status])
@pytest.mark.parametrize("garbage", [b"\xff\xff\xff", b"\x0a\x7fshort", b"\x00\x00", b"\xa2\x06\x02\xff\xfe"])
def test_bytes_that_are_no_message_get_0_where_a_status_answers(call, method, garbage):
    status = call(method, garbage)
    assert status.status == 0
    assert status.cause
    assert call("GetProperty", name="chirality").value.integer_value == 0


@pytest.mark.parametrize("method", ["GetProperty", "ListProperties", "GetCounters", "Get"])
def test_bytes_that_are_no_message_are_an_invalid_argument_elsewhere(call, method):
    assert failure(lambda: list_of(call(method, b"\xff\xff\xff")))[0] == "INVALID_ARGUMENT"


def list_of(answer):
    return list(answer) if hasattr(answer, "__iter__") else [answer]


def test_a_subscription_that_is_no_message_is_an_invalid_argument(call):
    assert failure(list, call("Subscribe", b"\xff\xff\xff"))[0] == "INVALID_ARGUMENT"


def test_an_unknown_property_is_not_found(call):
    code, details = failure(call, "GetProperty", name="colour")
    assert code == "NOT_FOUND"
    assert "'colour'" in details
    assert "chirality" in details


def test_an_unknown_fusion_type_is_an_invalid_argument(call):
    assert failure(call, "Get", fusion_type=2) == (
        "INVALID_ARGUMENT",
        "fusion type 2; expected 0 (sensor data) or 1 (detections)",
    )


def test_a_pair_comes_back_as_a_record_of_table_9(call):
    call.send_pair(5)
    assert call("Flush").status == 1
    reply = call("Get", fusion_type=0)
    record = reply.sensor_data
    assert (reply.number, record.image_seq, record.points_seq, record.camera_id) == (0, 5, 5, 1)
    points = np.frombuffer(record.point_data, "<f4").reshape(record.point_num, record.fields_number)
    np.testing.assert_array_equal(points, [[10, 0, 0, 7, 7, 7], [-10, 0, 0, 128, 128, 128]])
    assert {p.name: p.value.integer_value for p in reply.configuration.properties}["lidar_frequency"] == 10
    assert call("Get").WhichOneof("result") == "no_data"


def test_a_stream_of_records_is_summed_up(call, records):
    sent = [
        records.image(0, 0),
        records.cloud(0, 0),
        records.cloud(0, 0),
        records.cloud(100, 1, sensor_id=9),
        records.image(100, 1),
    ]
    summary = call("SendStream", (to_send_request(record) for record in sent))
    assert (summary.accepted, summary.refused) == (3, 2)
    assert [(r.number, r.status.cause) for r in summary.refusals] == [(2, "duplicate"), (3, "no-calibration")]


def test_a_get_that_waits_has_what_comes_meanwhile(call):
    waiting = call.method("Get").future(call.request("Get", wait_ms=30_000), timeout=60)
    call.send_pair(0)
    call("Flush")
    assert waiting.result().sensor_data.points_seq == 0


def test_a_subscriber_has_all_results_in_order(call):
    results = call("Subscribe", most=3)
    for seq in range(3):
        call.send_pair(seq)
    call("Flush")
    assert [reply.number for reply in results] == [0, 1, 2]


def test_a_session_that_is_closed_ends_its_subscriptions_and_is_forgotten(call):
    results = call("Subscribe", timeout=30)
    call.send_pair(0)
    assert call("CloseSession").status == 1
    assert [reply.number for reply in results] == [0]
    assert dict(call("GetCounters").counts) == {}


def test_sessions_know_nothing_of_each_other(serve, connect):
    server = serve()
    one, other = connect(server, session="one"), connect(server, session="other")
    assert one.calibrate().status == 1
    one("SetProperty", name="lidar_frequency", value=fusion_pb2.Value(integer_value=20))
    assert other("GetProperty", name="lidar_frequency").value.integer_value == 10
    one.send_pair(0)
    one("Flush")
    assert other("Get").WhichOneof("result") == "no_data"
    assert dict(other("GetCounters").counts) == {}
    assert one("Get").WhichOneof("result") == "sensor_data"
