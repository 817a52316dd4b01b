"""The server: calls and their answers, sessions, numbers for Prometheus, reflection, tracks of fused results."""

import asyncio
import contextlib
import http.client
import re
import socket

import grpc
import pytest
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from grpc_reflection.v1alpha.proto_reflection_descriptor_database import ProtoReflectionDescriptorDatabase
from tests.unit.db34t.sending import boxes_3d, no_boxes_2d

from sceneloom.db34t.interface import FusionInterface
from sceneloom.db34t.wire import fusion_pb2
from sceneloom.errors import DataError
from sceneloom.service.client import FusionClient
from sceneloom.service.server import BOUNDS_S, METHODS, SERVICE, CallError, Histogram, SessionTable
from sceneloom.service.startup import ServiceLimits


def test_what_cannot_be_done_gets_0_with_cause_and_reason_or_is_an_error(serve, connect):
    call = connect(serve())
    for method, fields, cause in (
        ("AddProperty", {"name": "chirality", "description": "", "type": "bool"}, "known-name"),
        ("AddProperty", {"name": "x", "description": "", "type": "int64"}, "ill-typed"),
        ("SetProperty", {"name": "x", "value": fusion_pb2.Value(integer_value=1)}, "unknown-name"),
        ("SetProperty", {"name": "lidar_frequency", "value": fusion_pb2.Value(integer_value=2**32 + 10)}, "ill-typed"),
        ("SetProperty", {"name": "lidar_frequency", "value": fusion_pb2.Value(string_value="10")}, "ill-typed"),
        ("SetProperty", {"name": "lidar_frequency"}, "ill-typed"),
        ("SetCalibration", {"camera_id": 1}, "bad-calibration"),
        ("SetCalibration", {"camera_id": 256}, "bad-calibration"),
        ("SendMotion", {}, "bad-motion"),
        ("SendMotion", {"poses": [fusion_pb2.Pose(position=[0, 0, 0])]}, "bad-motion"),
        ("Send", {}, "bad-record"),
        ("Send", {"image": fusion_pb2.ImageData(height=1)}, "bad-record"),
        ("CloseSession", {"session": "nobody"}, "unknown-name"),
    ):
        status = call(method, GetMessageClass(SERVICE.methods_by_name[method].input_type)(**fields))
        assert (status.status, status.cause, bool(status.reason)) == (0, cause, True), (method, fields)
    for method, entry in METHODS.items():
        for garbage in (b"\xff\xff\xff", b"\x0a\x7fshort", b"\x00\x00", b"\xa2\x06\x02\xff\xfe"):
            if entry.answers_status:
                status = call(method, garbage)
                assert (status.status, bool(status.cause)) == (0, True), method
        if not entry.answers_status and method != "SendStream":
            assert call.fails(method, b"\xff\xff\xff")[0] == "INVALID_ARGUMENT", method
    code, details = call.fails("GetProperty", name="colour")
    assert (code, "'colour'" in details, "chirality" in details) == ("NOT_FOUND", True, True)
    words = "fusion type 2; expected 0 (sensor data) or 1 (detections)"
    assert call.fails("Get", fusion_type=2) == ("INVALID_ARGUMENT", words)
    code, details = call.fails("Subscribe", track=True, fusion_type=0)
    assert (code, "expected 1, detections" in details) == ("INVALID_ARGUMENT", True)


def test_a_get_that_waits_and_a_subscriber_have_what_comes_meanwhile_in_order(call):
    waiting = call.method("Get").future(call.request("Get", wait_ms=30_000), timeout=60)
    call.send_pair(0)
    call("Flush")
    assert waiting.result().sensor_data.points_seq == 0
    results = call("Subscribe", most=3)
    for seq in range(1, 4):
        call.send_pair(seq)
    call("Flush")
    assert [reply.number for reply in results] == [1, 2, 3]
    call.send_pair(4)  # nobody fetches it
    call("Flush")
    counts = call("GetCounters").counts
    assert (counts["delivered.sensor_data"], counts["results.sensor_data"]) == (4, 5)
    assert "delivered.detections" not in counts


def test_a_session_that_is_closed_ends_its_subscriptions_and_is_forgotten(call):
    results = call("Subscribe", timeout=30)
    call.send_pair(0)
    assert call("CloseSession").status == 1
    assert [reply.number for reply in results] == [0]
    assert dict(call("GetCounters").counts) == {}


class Clock:
    """Seconds that go on when they are reported to."""

    now_s = 1000.0

    def __call__(self):
        return self.now_s


def with_table(**limits):
    """Make a test of a coroutine that examines a table of sessions and its clock."""

    def declared(examine):
        async def run():
            clock = Clock()
            interface = lambda name, on_result: FusionInterface(on_result=on_result)  # noqa: E731
            table = SessionTable(interface, ServiceLimits(**limits), clock=clock)
            try:
                await examine(table, clock)
            finally:
                await table.end_all(30)
                table.close()

        return lambda: asyncio.run(run())

    return declared


@with_table(idle_minutes=2)
async def test_a_session_that_nobody_uses_ends_after_its_time_and_not_before(table, clock):
    idle, used, waiting = (table.named(name) for name in ("idle", "used", "waiting"))
    with waiting.request(0, clock):
        clock.now_s += 119.9
        with used.request(0, clock):
            pass
        assert table.end_idle() == []
        clock.now_s += 0.1
        assert table.end_idle() == ["idle"]
        clock.now_s += 1000
        assert table.end_idle() == ["used"]
    assert table.end_idle() == []  # its request has just ended
    clock.now_s += 120
    assert table.end_idle() == ["waiting"]
    assert len(table) == 0
    assert table.named("idle") is not idle


@with_table(most_sessions=1, most_bytes_waiting=100)
async def test_requests_that_wait_may_hold_so_many_bytes_and_sessions_that_are_ending_count(table, clock):
    session = table.named("a")
    with session.request(60, clock):
        with pytest.raises(CallError, match="60 bytes of session 'a' wait; expected at most 100"):
            session.request(41, clock).__enter__()
        with session.request(40, clock):
            pass
    with session.request(100, clock):
        pass
    clock.now_s += 10_000
    assert table.end_idle() == ["a"]
    with pytest.raises(CallError, match="as many as there may be"):
        table.named("b")


@with_table()
async def test_the_end_of_a_session_wakes_all_who_wait_and_one_without_a_name_is_the_default_one(table, clock):
    session = table.named("")
    assert session is table.named("default")
    waiting = [asyncio.ensure_future(session.next_result(kind, None)) for kind in (0, 1)]
    await asyncio.sleep(0)
    assert not any(one.done() for one in waiting)
    await session.end()
    assert await asyncio.gather(*waiting) == [None, None]
    assert table.take("").name == "default"
    assert table.take("") is None


@pytest.mark.parametrize(
    ("table", "location", "words"),
    [
        ({"sessions": 3}, "service.sessions", "unknown; expected one of most_sessions"),
        ({"most_sessions": 0}, "service.most_sessions", "0; expected a whole number above 0"),
        ({"most_sessions": 1.5}, "service.most_sessions", "1.5; expected a whole number above 0"),
        ({"most_sessions": True}, "service.most_sessions", "True; expected a whole number"),
        ({"idle_minutes": float("nan")}, "service.idle_minutes", "nan; expected a number above 0"),
        ({"idle_minutes": "1"}, "service.idle_minutes", "'1'; expected a number above 0"),
    ],
)
def test_limits_are_read_from_a_table_and_one_that_is_none_is_reported_with_its_location(table, location, words):
    with pytest.raises(DataError, match=f"rig.toml: {location}: {words}"):
        ServiceLimits.of(table, file="rig.toml", location="service")
    assert ServiceLimits.of({"most_sessions": 3, "idle_minutes": 1}) == ServiceLimits(most_sessions=3, idle_minutes=1)


LINE = re.compile(r'(?P<name>[a-z_]+)(?:\{(?P<labels>(?:[a-z]+="(?:[^"\\]|\\.)*",?)*)\})? (?P<value>\S+)')


def samples(text):
    """A reader of the text format, from its description: values by name and labels."""
    found = {}
    for line in text.splitlines():
        if not line.startswith("#"):
            match = LINE.fullmatch(line)
            assert match, line
            found[match["name"], match["labels"] or ""] = float(match["value"])
    return found


def ask(port, path="/metrics", method="GET"):
    with contextlib.closing(http.client.HTTPConnection("127.0.0.1", port, timeout=30)) as connection:
        connection.request(method, path)
        answer = connection.getresponse()
        return answer.status, answer.read().decode(), answer.headers


def test_calls_and_what_sessions_count_are_reported_and_garbage_ends_a_connection_alone(serve, connect):
    server = serve(metrics_port=0)
    assert {found.getsockname()[0] for found in server._metrics_server.sockets} == {"127.0.0.1"}
    call = connect(server, session="rig")
    call.calibrate()
    call.send_pair(0)
    call("Flush")
    for garbage in (b"\r\n\r\n", b"\xff" * 100 + b"\r\n\r\n", b"x" * 100_000, b""):
        with socket.create_connection(("127.0.0.1", server.metrics_port), timeout=30) as connection:
            connection.sendall(garbage)
            connection.shutdown(socket.SHUT_WR)
            with contextlib.suppress(ConnectionResetError):
                connection.recv(100)
    for path, method, status in (("/", "GET", 404), ("/metrics", "POST", 405)):
        assert ask(server.metrics_port, path, method)[0] == status
    status, text, headers = ask(server.metrics_port)
    assert (status, headers["Content-Type"].partition(" charset")[0]) == (200, "text/plain; version=0.0.4;")
    found = samples(text)
    expected = {
        ("sceneloom_calls_total", 'method="Send",outcome="OK"'): 2,
        ("sceneloom_call_seconds_count", 'method="Send"'): 2,
        ("sceneloom_call_seconds_bucket", 'method="Send",le="+Inf"'): 2,
        ("sceneloom_sessions", ""): 1,
        ("sceneloom_waiting_results", 'session="rig"'): 1,
        ("sceneloom_session_events_total", 'session="rig",event="received.image"'): 1,
    }
    assert {key: found[key] for key in expected} == expected
    assert text.count("# TYPE sceneloom_call_seconds histogram") == 1
    histogram = Histogram()
    for duration_s in (0.0, 0.0005, 0.0006, 10.0, 11.0):  # each in the class that it is at most
        histogram.add(duration_s)
    assert histogram.counts == [2, 1, *[0] * (len(BOUNDS_S) - 3), 1, 1]


def test_the_service_reports_its_methods_and_messages(serve):
    with grpc.insecure_channel(serve().address) as channel:
        database = ProtoReflectionDescriptorDatabase(channel)
        assert set(database.get_services()) == {
            "sceneloom.db34t4101.v1.DataFusion",
            "grpc.health.v1.Health",
            "grpc.reflection.v1alpha.ServerReflection",
        }
        service = DescriptorPool(database).FindServiceByName("sceneloom.db34t4101.v1.DataFusion")
        method = service.FindMethodByName("GetProperty")
        request, reply = GetMessageClass(method.input_type), GetMessageClass(method.output_type)
        call = channel.unary_unary(
            f"/{service.full_name}/{method.name}",
            request_serializer=request.SerializeToString,
            response_deserializer=reply.FromString,
        )
        assert call(request(name="lidar_frequency"), timeout=30).value.integer_value == 10


def send_boxes(call, seqs):
    for seq in seqs:
        assert call.send(no_boxes_2d(100 * seq, seq)).status == 1
        assert call.send(boxes_3d(100 * seq, seq, id=40 + seq, X=12.0 + seq)).status == 1
    assert call("Flush").status == 1


def test_a_client_that_asks_for_tracks_gets_them_with_one_number_each(serve, connect):
    server = serve()
    call = connect(server)
    call.calibrate()
    with FusionClient(server.address) as client:
        results = client.subscribe(1, most=5, track=True)
        send_boxes(call, range(5))
        reported = [(result.number, result.record.id.tolist(), result.record) for result in results]
    assert [row[:2] for row in reported] == [(k, [1]) for k in range(5)]
    assert reported[-1][2].velocity_vectors[0, 0] == pytest.approx(10.0, abs=2.0)  # 1 m in 0.1 s, after five looks


def test_results_after_a_tracking_subscriber_has_left_are_as_they_were_sent(call):
    subscription = call("Subscribe", track=True, timeout=60)
    send_boxes(call, range(1))
    assert [one.id for one in next(subscription).detections.detections] == [1]
    subscription.cancel()
    send_boxes(call, range(1, 4))
    left = [call("Get", fusion_type=1, wait_ms=5000) for _ in range(2)]
    assert [reply.detections.detections[0].box_3d_id for reply in left][-1] in (42, 43)
    assert all(reply.detections.detections[0].id == 0 for reply in left)
