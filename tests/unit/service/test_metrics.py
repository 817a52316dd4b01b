"""Numbers for Prometheus, and who can read them."""

import contextlib
import http.client
import re
import socket

import pytest

from sceneloom.service.methods import BOUNDS_S, Histogram

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


@pytest.fixture
def server(serve):
    return serve(metrics_port=0)


def ask(port, path="/metrics", method="GET"):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    try:
        connection.request(method, path)
        answer = connection.getresponse()
        return answer.status, answer.read().decode(), answer.headers
    finally:
        connection.close()


def test_calls_and_what_sessions_count_are_reported(server, connect):
    call = connect(server, session="rig")
    call.calibrate()
    call.send_pair(0)
    call("Flush")
    call("AddProperty", name="chirality", description="", type="bool")
    status, text, headers = ask(server.metrics_port)
    assert status == 200
    assert headers["Content-Type"].startswith("text/plain; version=0.0.4")
    found = samples(text)
    assert found["sceneloom_calls_total", 'method="Send",outcome="OK"'] == 2
    assert found["sceneloom_call_seconds_count", 'method="Send"'] == 2
    assert found["sceneloom_call_seconds_bucket", 'method="Send",le="+Inf"'] == 2
    assert found["sceneloom_sessions", ""] == 1
    assert found["sceneloom_waiting_results", 'session="rig"'] == 1
    assert found["sceneloom_session_events_total", 'session="rig",event="received.image"'] == 1
    assert text.count("# TYPE sceneloom_call_seconds histogram") == 1


def test_a_duration_is_counted_in_the_class_that_it_is_at_most():
    histogram = Histogram()
    for duration_s in (0.0, 0.0005, 0.0006, 10.0, 11.0):
        histogram.add(duration_s)
    assert histogram.counts == [2, 1, *[0] * (len(BOUNDS_S) - 3), 1, 1]


@pytest.mark.parametrize(("path", "method", "status"), [("/", "GET", 404), ("/metrics", "POST", 405)])
def test_nothing_else_is_answered(server, path, method, status):
    assert ask(server.metrics_port, path, method)[0] == status


@pytest.mark.parametrize("garbage", [b"\r\n\r\n", b"\xff" * 100 + b"\r\n\r\n", b"x" * 100_000, b""])
def test_garbage_ends_a_connection_and_nothing_else(server, garbage):
    with socket.create_connection(("127.0.0.1", server.metrics_port), timeout=30) as connection:
        connection.sendall(garbage)
        connection.shutdown(socket.SHUT_WR)
        with contextlib.suppress(ConnectionResetError):
            connection.recv(100)
    assert ask(server.metrics_port)[0] == 200


def test_the_port_is_of_this_machine_alone(server):
    (address,) = {found.getsockname()[0] for found in server._metrics_server.sockets}
    assert address == "127.0.0.1"
