"""The client: what the interface of another process answers is what the interface itself would answer."""

import socket
import threading
from functools import partial
from types import SimpleNamespace

import grpc
import numpy as np
import pytest
from tests.unit.db34t import sending

from sceneloom.db34t.interface import FusionInterface
from sceneloom.db34t.protobuf import encode
from sceneloom.db34t.transport import Security
from sceneloom.db34t.types import Cause, Outcome
from sceneloom.errors import OptionError
from sceneloom.scene.poses import Poses
from sceneloom.service.client import (
    DeadlineError,
    FusionClient,
    ServiceError,
    TooLargeError,
    UnauthenticatedError,
    UnreachableError,
)
from sceneloom.service.running import running_server
from sceneloom.service.server import ServerSettings
from sceneloom.service.startup import ServiceLimits

WIDTH, HEIGHT = 32, 24
TOKEN = "a token of sixteen or more".replace(" ", "-")


@pytest.fixture(scope="module")
def running():
    with running_server() as found:
        yield found


@pytest.fixture
def client(running, request):
    with FusionClient(running.address, session=f"s{abs(hash(request.node.name))}", deadline_s=60) as made:
        yield made
        made.end_session()


calibration = partial(
    sending.calibration, image_size=(WIDTH, HEIGHT), intrinsic_matrix=(30.0, 0, 15.5, 0, 30.0, 11.5, 0, 0, 1)
)
image = partial(sending.image, level=9, width=WIDTH, height=HEIGHT)


def cloud(milliseconds, seq, *, count=20):
    points = np.random.default_rng(seq).uniform((2, -1, -1), (9, 1, 1), (count, 3))
    return sending.cloud(milliseconds, seq, points)


def used(fusion):
    """What both sides of a network answer to the same calls."""
    answers = [
        fusion.add_property("lane", "where it stands", "(int8, float)"),
        fusion.add_property("lane", "again", "int8"),
        fusion.set_property("lane", (3, 0.5)),
        fusion.set_property("lane", (300, 0.5)),
        fusion.set_property("camera_frequency", 2**40),
        fusion.set_property("nothing", 1),
        fusion.set_property("lane", {"no": "value"}),
        fusion.set_property("fusion_algorithm", "MV3d"),
        fusion.get_property("lane"),
        fusion.get_property("camera_coordinate"),
        fusion.send(image(0, 1)),
        fusion.set_calibration(calibration(), camera_id=1, lidar_id=0),
        fusion.set_calibration(calibration(), camera_id=256, lidar_id=0),
        fusion.send_motion(Poses(np.array([0], np.int64), np.zeros((1, 3)), np.array([[0, 0, 0, 1.0]]))),
        fusion.send_motion(Poses.identity()),
        fusion.send(image(0, 2)),
        fusion.send(image(0, 2)),
        fusion.send("text"),
        fusion.send(calibration()),
        fusion.send(cloud(0, 7)),
    ]
    fusion.flush()
    results = [fusion.get(0), fusion.get(0), fusion.get(1), fusion.get()]
    shown = [result and (result.number, encode(result.record)) for result in results]
    properties = [result and dict(result.configuration.properties) for result in results]
    return answers, shown, properties, fusion.list_properties()


def test_every_call_answers_as_the_interface_itself(client):
    with FusionInterface() as fusion:
        expected = used(fusion)
        counts = fusion.counters.counts()
    found = used(client)
    for ours, theirs in zip(found[0], expected[0], strict=True):
        if isinstance(theirs, Outcome):  # reasons are for people
            assert (ours.status, ours.cause) == (theirs.status, theirs.cause)
        else:
            assert ours == theirs
    assert found[1:] == expected[1:]
    counts.pop("refused.bad-record")  # what is no record never leaves the client
    delivered = {"delivered.sensor_data": sum(shown is not None for shown in found[1])}  # what a network adds
    assert client.counters() == {**counts, **delivered}


def test_streams_give_results_in_order_and_what_is_refused_by_its_number_and_can_be_left(client):
    assert client.set_calibration(calibration(), camera_id=1, lidar_id=0)
    found = []
    fetching = threading.Thread(target=lambda: found.extend(client.subscribe(0, most=5)))
    fetching.start()
    sent = client.send_stream(record for k in (0, 0, 1, 2, 3, 4) for record in (image(100 * k, k), cloud(100 * k, k)))
    client.flush()
    fetching.join(60)
    assert (sent.accepted, sent.refused) == (10, 2)
    assert {number: outcome.cause for number, outcome in sent.refusals} == dict.fromkeys((2, 3), Cause.DUPLICATE)
    assert [(result.number, result.record.points_seq) for result in found] == [(k, k) for k in range(5)]
    for seq in (5, 6):
        client.send_stream([image(100 * seq, seq), cloud(100 * seq, seq)])
        client.flush()
        if seq == 5:
            results = client.subscribe(0)
            assert next(results).number == 5
            results.close()  # a stream that is left lets the service go
    assert client.get(0, timeout_s=60).number == 6

    def records():
        yield image(700, 7)
        raise ZeroDivisionError("of the caller")

    with pytest.raises(ZeroDivisionError, match="of the caller"):
        client.send_stream(records())


def test_values_that_cannot_be_followed_are_errors_of_the_caller_and_others_keep_their_words(client):
    with pytest.raises(OptionError, match="nothing"):
        client.get_property("nothing")
    for wrong in (2, True, "0"):
        with pytest.raises(OptionError, match="fusion type"):
            client.get(wrong)
    with pytest.raises(OptionError, match="without TLS"):
        FusionClient("rig.example:7000", token=TOKEN)
    with pytest.raises(OptionError, match="without `ca`"):
        FusionClient("localhost:7000", certificate=("a.pem", "b.pem"))
    failure = client._failure(SimpleNamespace(code=lambda: grpc.StatusCode.INTERNAL, details=lambda: "it broke"))
    assert (type(failure), str(failure)) == (ServiceError, f"{client.address}: internal: it broke")


@pytest.mark.parametrize(
    ("listens", "error", "words"), [(False, UnreachableError, "unavailable"), (True, DeadlineError, "deadline")]
)
def test_nobody_at_the_address_and_no_answer_in_time_are_reported_as_such(listens, error, words):
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        if listens:
            silent.listen()
        address = f"127.0.0.1:{silent.getsockname()[1]}"
        client = FusionClient(address, deadline_s=0.2 if listens else 30.0)
        with client, pytest.raises(error, match=f"{address}: {words}"):
            client.flush()


def test_a_missing_or_wrong_token_and_a_record_beyond_the_limit_are_reported_as_such():
    limits = ServiceLimits(largest_message=10_000)
    with running_server(ServerSettings(security=Security(token=TOKEN), limits=limits)) as running:
        for token in (None, "another" * 4):
            with FusionClient(running.address, token=token) as client, pytest.raises(UnauthenticatedError):
                client.counters()
        with FusionClient(running.address, token=TOKEN) as client:
            assert client.counters() == {}
            assert client.set_calibration(calibration(), camera_id=1, lidar_id=0)
            with pytest.raises(TooLargeError, match="larger than max"):
                client.send(cloud(0, 1, count=10_000))
            assert client.send(cloud(0, 1, count=100))
