"""The server: answers, sessions, numbers for Prometheus, reflection, tracks; callers that vanish, wait or flood."""

import asyncio
import contextlib
import http.client
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time

import grpc
import pytest
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from grpc_reflection.v1alpha.proto_reflection_descriptor_database import ProtoReflectionDescriptorDatabase
from tests.unit.db34t.sending import boxes_3d, cloud, image, no_boxes_2d
from tests.unit.service.conftest import Served

from sceneloom.db34t.events import Refused
from sceneloom.db34t.interface import FusionInterface
from sceneloom.db34t.protobuf import to_send_request
from sceneloom.db34t.wire import fusion_pb2
from sceneloom.errors import DataError
from sceneloom.service.client import FusionClient
from sceneloom.service.server import BOUNDS_S, METHODS, SERVICE, CallError, Histogram, SessionTable
from sceneloom.service.session_log import compare, is_complete, read_log, unfinished_path
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


def test_who_waits_or_subscribes_has_what_comes_in_order_and_who_gives_up_takes_nothing_along(call):
    gone, waiting = (call.method("Get").future(call.request("Get", wait_ms=60_000), timeout=60) for _ in range(2))
    assert gone.cancel()
    assert call.fails("Get", timeout=0.05, wait_ms=60_000)[0] == "DEADLINE_EXCEEDED"
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
    results = call("Subscribe", timeout=30)
    assert next(results).number == 4
    assert call("CloseSession").status == 1  # which ends subscriptions
    assert list(results) == []
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


PATIENCE_S = 60  # for other processes on a busy machine

LARGE = (640, 480)  # an image whose result does not fit into what a connection takes without being read


def send_large_pairs(call, count):
    """Pairs whose results are of megabytes."""
    width, height = LARGE
    assert call.calibrate(image_size=LARGE).status == 1
    for seq in range(count):
        assert call.send(image(100 * seq, seq, width=width, height=height)).status == 1
        assert call.send(cloud(100 * seq, seq)).status == 1
    assert call("Flush").status == 1


def left_of(call, count):
    """The numbers of the results that are left, up to the last one."""
    numbers = []
    while not numbers or numbers[-1] < count - 1:
        reply = call("Get", wait_ms=20_000)
        assert reply.WhichOneof("result") == "sensor_data", numbers
        numbers.append(reply.number)
    return numbers


COUNT = 12  # results of 2 MB: more than are on their trajectory at once


DYING = """
import sys, grpc
from sceneloom.db34t.wire import fusion_pb2 as pb
channel = grpc.insecure_channel(sys.argv[1])
service = "/sceneloom.db34t4101.v1.DataFusion/"
if sys.argv[2] == "Subscribe":
    method = channel.unary_stream(service + "Subscribe", pb.SubscribeRequest.SerializeToString, pb.GetReply.FromString)
    call = method(pb.SubscribeRequest(), wait_for_ready=True)
    print("ready", flush=True)
    sys.stdin.read()
else:
    def requests():
        for seq in range(3):
            yield pb.SendRequest(boxes_2d=pb.Boxes2d(sensor_id=1, seq=seq, timestamp=pb.Timestamp(s=1, ns=seq)))
        print("ready", flush=True)
        sys.stdin.read()
    method = channel.stream_unary(service + "SendStream", pb.SendRequest.SerializeToString, pb.SendSummary.FromString)
    method(requests(), wait_for_ready=True)
"""


@pytest.fixture
def dying():
    """Starts a caller in a process of its own that says when it is ready and can be killed."""
    started = []

    def start(server, method):
        command = [sys.executable, "-c", DYING, server.address, method]
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        started.append(process)
        assert process.stdout.readline() == "ready\n"
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("killed", [False, True])
def test_what_a_subscriber_had_not_got_when_it_left_or_was_killed_goes_to_others_in_order(
    serve, connect, dying, killed
):
    server = serve()
    call = connect(server)
    subscription = dying(server, "Subscribe") if killed else call("Subscribe", timeout=PATIENCE_S)
    send_large_pairs(call, COUNT)
    if killed:
        subscription.send_signal(signal.SIGKILL)
        subscription.wait()
    else:
        assert next(subscription).number == 0
        subscription.cancel()
    left = left_of(call, COUNT)
    assert left == list(range(left[0], COUNT))
    assert (0 if killed else 1) <= left[0] < COUNT - 1
    sender = dying(server, "SendStream")  # of a session that goes on
    sender.send_signal(signal.SIGKILL)
    sender.wait()
    assert call.send(image(100 * COUNT, COUNT, width=LARGE[0], height=LARGE[1])).status == 1
    assert call.send(cloud(100 * COUNT, COUNT)).status == 1
    assert call("Flush").status == 1
    assert call("Get").WhichOneof("result") == "sensor_data"


def test_a_session_whose_fusion_hangs_blocks_no_other(serve, connect):
    hanging, release = threading.Event(), threading.Event()

    def observe(name):
        def hang(event):
            if name == "slow" and not isinstance(event, Refused):
                hanging.set()
                release.wait(PATIENCE_S)

        return hang

    server = serve(observe=observe)
    slow, quick = connect(server, session="slow"), connect(server, session="quick")
    try:
        slow.calibrate()
        assert slow.send(cloud(0, 0)).status == 1
        assert hanging.wait(PATIENCE_S)
        flushing = [slow.method("Flush").future(slow.request("Flush")) for _ in range(5)]
        refused = [  # to be reported to the observer, who does not listen
            slow.method("Send").future(to_send_request(cloud(0, 0), session="slow")) for _ in range(5)
        ]
        quick.calibrate()
        quick.send_pair(0)
        assert quick("Flush").status == 1
        assert quick("Get").WhichOneof("result") == "sensor_data"
        assert slow("GetProperty", name="chirality").name == "chirality"
        assert not any(call.done() for call in (*flushing, *refused))
    finally:
        release.set()
    assert [call.result(PATIENCE_S).status for call in flushing] == [1] * 5
    assert [call.result(PATIENCE_S).status for call in refused] == [0] * 5


def test_sessions_beyond_the_limit_or_without_a_sound_name_get_0_or_an_error(serve, connect):
    server = serve(limits=ServiceLimits(most_sessions=2))
    for name in ("a", "b"):
        connect(server, session=name)("ListProperties")
    call = connect(server, session="c")
    status = call("AddProperty", name="x", description="", type="bool")
    assert (status.status, status.cause) == (0, "too-many")
    assert call.fails("ListProperties")[0] == "RESOURCE_EXHAUSTED"
    assert connect(server, session="a")("CloseSession").status == 1
    assert call("AddProperty", name="x", description="", type="bool").status == 1
    for name in ("a b", "a/b", "../x", "é", "x" * 65, "-x", "a\n"):
        call = connect(server, session=name)
        assert call("Flush").cause == "out-of-range", name
        code, details = call.fails("ListProperties")
        assert (code, "expected 1 to 64 letters" in details) == ("INVALID_ARGUMENT", True)


def test_requests_and_queues_beyond_the_limit_are_refused(serve, connect):
    call = connect(serve(limits=ServiceLimits(most_open_requests=3, most_queue_length=64)))
    for name in ("queue_length", "result_queue_length"):
        assert call("SetProperty", name=name, value=fusion_pb2.Value(integer_value=64)).status == 1
        status = call("SetProperty", name=name, value=fusion_pb2.Value(integer_value=65))
        assert (status.status, status.cause) == (0, "out-of-range")
        assert "expected at most 64 here" in status.reason
    waiting = [call.method("Get").future(call.request("Get", wait_ms=60_000)) for _ in range(3)]
    code = None
    while code is None:  # until all of them have come
        try:
            call("ListProperties")
        except grpc.RpcError as error:
            code = error.code().name
    assert (code, call("Flush").cause) == ("RESOURCE_EXHAUSTED", "too-many")
    for one in waiting:
        one.cancel()


def test_a_server_that_is_reported_to_end_delivers_what_waits_and_says_goodbye(connect):
    with Served() as server:
        call = connect(server)
        results = call("Subscribe", timeout=PATIENCE_S)
        call.calibrate()
        for seq in range(4):
            call.send_pair(seq)
        server.process.send_signal(signal.SIGTERM)
        assert [reply.number for reply in results] == [0, 1, 2, 3]
        err = server.end(asked=True)
    lines = [line for line in map(json.loads, err.splitlines()) if not line["event"].startswith("compiling")]
    loading, *events = [line["event"] for line in lines]
    assert "the port is closed until then" in loading
    assert events == ["listening", "session begins", "draining", "ended"]
    assert lines[2]["session"] == "default"


def logged(path):
    """What stands in a log that is being written."""
    try:
        return [entry.what for entry in read_log(path)]
    except DataError:  # there is nothing yet
        return []


@pytest.mark.slow
def test_a_server_that_is_killed_ends_calls_with_unavailable_and_leaves_a_log_to_be_read(connect, tmp_path):
    log = tmp_path / "log.mcap"
    with Served("--quiet", "--log", log) as server:
        call = connect(server)
        call.calibrate()
        results = call("Subscribe", timeout=PATIENCE_S)
        for seq in range(3):
            call.send_pair(seq)
        assert next(results).number == 0
        end = threading.Event()
        requests = (call.request("Send") if end.wait(PATIENCE_S) else None for _ in range(1))
        streaming = call.method("SendStream").future(requests, timeout=PATIENCE_S)
        until_s = time.monotonic() + PATIENCE_S
        while logged(unfinished_path(log)).count("record") < 6 and time.monotonic() < until_s:
            assert server.process.poll() is None  # what was taken is on the disk after a second
        server.process.kill()
        server.process.wait()
        with pytest.raises(grpc.RpcError) as caught:
            list(results)
        assert caught.value.code().name == "UNAVAILABLE"
        assert streaming.exception(timeout=PATIENCE_S).code().name == "UNAVAILABLE"
        end.set()
    assert not log.exists()
    assert not is_complete(unfinished_path(log))
    assert compare(unfinished_path(log))


HANGING = """
import threading
def hang(*_, **__):
    print("hangs", flush=True)
    threading.Event().wait()
"""


def install(folder):
    """A package in a folder, that brings the algorithm `hang`."""
    (folder / "hanging.py").write_text(HANGING)
    reported = folder / "hanging-1.0.dist-info"
    reported.mkdir()
    (reported / "METADATA").write_text("Metadata-Version: 2.1\nName: hanging\nVersion: 1.0\n")
    (reported / "entry_points.txt").write_text("[sceneloom.sensor_data_fusion]\nhang = hanging:hang\n")
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), *sys.path])}


@pytest.mark.slow
def test_a_server_with_an_algorithm_that_hangs_ends_by_itself_and_says_so(connect, tmp_path):
    config, log = tmp_path / "rig.toml", tmp_path / "log.mcap"
    config.write_text('[properties]\nfusion_algorithm = "hang"\n[service]\ndrain_seconds = 0.2\n')
    with Served("--config", config, "--log", log, env=install(tmp_path)) as server:
        call = connect(server, session="stuck")
        call.calibrate()
        call.send_pair(0)
        call.send_pair(1)
        assert server.process.stdout.readline() == "hangs\n"
        *lines, last = server.end(1).splitlines()
    (reported,) = [line for line in map(json.loads, lines) if line["level"] == "error"]
    assert (reported["event"], reported["sessions"]) == ("sessions do not end: an algorithm hangs", ["stuck"])
    assert "fusion of stuck hanging" in last
    assert is_complete(log)  # the session log was closed all the same


def test_records_that_wait_and_results_that_nobody_fetches_may_be_so_large_together(serve, connect):
    call = connect(serve(limits=ServiceLimits(most_bytes_waiting=50_000)))
    call.calibrate()
    statuses = [call.send(image(100 * seq, seq)) for seq in range(6)]  # 9216 bytes each, and no sweep
    assert [(status.status, status.cause) for status in statuses] == [(1, "")] * 5 + [(0, "too-many")]
    assert "46080 bytes wait and 9216 come; expected at most 50000" in statuses[5].reason
    assert call("Flush").status == 1  # what waited for a sweep was let go
    assert call.send(image(700, 7)).status == 1
    assert call("GetCounters").counts["unpaired.image"] == 5
    for seq in range(10, 15):  # results of 64 x 48 pixels of 3 + 4 bytes and two points: 21.5 kB
        call.send_pair(seq)
        call("Flush")
    assert [call("Get").number for _ in range(2)] == [3, 4]
    assert call("Get").WhichOneof("result") == "no_data"
    assert call("GetCounters").counts["dropped.results"] == 3
