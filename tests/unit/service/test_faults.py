"""Callers that vanish, wait, flood or talk nonsense: each session goes on, and no result is lost to others."""

import json
import os
import signal
import subprocess
import sys
import threading
import time

import grpc
import pytest
from tests.unit.db34t.sending import cloud, image

from sceneloom.db34t.events import Refused
from sceneloom.db34t.protobuf import to_send_request
from sceneloom.db34t.wire import fusion_pb2
from sceneloom.errors import DataError
from sceneloom.service.session_log import compare, is_complete, read_log, unfinished_path
from sceneloom.service.startup import ServiceLimits

from .conftest import Served

PATIENCE_S = 60
"""For other processes on a busy machine."""

LARGE = (640, 480)
"""An image whose result does not fit into what a connection takes without being read."""


def send_large_pairs(call, count):
    """Pairs whose results are of megabytes."""
    width, height = LARGE
    assert call.calibrate(image_size=LARGE).status == 1
    for seq in range(count):
        assert call.send(image(100 * seq, seq, width=width, height=height)).status == 1
        assert call.send(cloud(100 * seq, seq)).status == 1
    assert call("Flush").status == 1


def test_a_caller_that_gives_up_or_waits_too_long_takes_no_result_along(call):
    waiting, again = (call.method("Get").future(call.request("Get", wait_ms=60_000)) for _ in range(2))
    assert waiting.cancel()
    assert call.fails("Get", timeout=0.05, wait_ms=60_000)[0] == "DEADLINE_EXCEEDED"
    call.send_pair(0)
    call("Flush")
    assert again.result(timeout=PATIENCE_S).number == 0


def left_of(call, count):
    """The numbers of the results that are left, up to the last one."""
    numbers = []
    while not numbers or numbers[-1] < count - 1:
        reply = call("Get", wait_ms=20_000)
        assert reply.WhichOneof("result") == "sensor_data", numbers
        numbers.append(reply.number)
    return numbers


COUNT = 12
"""Results of 2 MB: more than are on their trajectory at once."""


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


def test_a_sender_that_is_killed_in_a_stream_leaves_a_session_that_goes_on(serve, connect, dying):
    server = serve()
    call = connect(server)
    call.calibrate()
    process = dying(server, "SendStream")
    process.send_signal(signal.SIGKILL)
    process.wait()
    call.send_pair(0)
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
