"""Servers that answer anything: `send`, `get` and `conformance` end with a clear error, no traceback, and soon."""

import functools
import random
import time
from concurrent.futures import ThreadPoolExecutor

import grpc
import pytest
from google.protobuf.message_factory import GetMessageClass
from tests.malformed.mutants import sound_scene
from tests.unit.service.conftest import SERVICE

import sceneloom
from sceneloom.cli import main
from sceneloom.db34t.interface import FusionInterface
from sceneloom.db34t.wire import fusion_pb2
from sceneloom.service.server import METHODS

SECONDS = 110
"""Of the long run."""


class Liar:
    """A server whose answers are those of a mutant: other bytes, other values, or an error in the position of one."""

    def __init__(self):
        self.chance = random.Random(0)
        self.server = grpc.server(ThreadPoolExecutor(4))
        self.server.add_generic_rpc_handlers((self,))
        self.address = f"127.0.0.1:{self.server.add_insecure_port('127.0.0.1:0')}"
        self.server.start()

    def service(self, details):
        name = details.method.rpartition("/")[2]
        method = SERVICE.methods_by_name.get(name)
        if method is None:
            return None
        kind = "_".join("stream" if s else "unary" for s in (method.client_streaming, method.server_streaming))

        def answer(request, context):
            if method.client_streaming:
                list(request)
            if self.chance.random() < 0.05:
                context.abort(self.chance.choice(list(grpc.StatusCode)[1:]), "\u00e9\nno")
            return self.content(method)

        def answers(request, context):
            for _ in range(self.chance.randrange(4)):
                yield answer(request, context)

        return getattr(grpc, f"{kind}_rpc_method_handler")(answers if method.server_streaming else answer)

    def content(self, method):
        """What a sound server may state, mostly, with some bytes changed."""
        content = bytearray(_sound(method).SerializeToString())
        for _ in range(self.chance.choice((0, 0, 1, 2))):
            start = self.chance.randrange(len(content) + 1)
            stop = start + self.chance.randrange(4)
            content[start:stop] = self.chance.randbytes(self.chance.randrange(5))
        return bytes(content)


def _sound(method):
    if method.output_type.name == "Status":
        return fusion_pb2.Status(status=1)
    if method.output_type.name == "GetReply":
        box = {"id": 4, "confidence": 0.8, "direction": (1, 0, 0), "length": 4.0, "width": 2.0, "height": 1.5}
        found = fusion_pb2.FusedDetections(points_seq=1, detections=[box])
        return fusion_pb2.GetReply(number=1, detections=found, configuration=_properties())
    if method.output_type.name == "Properties":
        return _properties()
    if method.output_type.name == "Property":
        return _properties().properties[0]
    return GetMessageClass(method.output_type)()


@functools.cache
def _properties():
    with FusionInterface(inline=True) as fusion:
        return fusion_pb2.Properties.FromString(METHODS["ListProperties"].perform(fusion, b""))


@pytest.fixture(scope="module")
def liar():
    found = Liar()
    yield found
    found.server.stop(None).wait()


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    path = tmp_path_factory.mktemp("drive") / "drive.sfs"
    sceneloom.write(sound_scene(), path)
    return path


@pytest.mark.parametrize("numbers", [range(12), pytest.param(range(12, 2012), marks=pytest.mark.slow)])
def test_a_server_that_says_anything_ends_a_client_with_a_clear_error(liar, drive, tmp_path, capfd, caplog, numbers):
    calls = (
        ("send", drive, liar.address, "--rate", 0, "-q", "--json"),
        ("get", liar.address, "--type", "detection", "--json"),
        ("get", liar.address, "--type", "sensor", "-o", tmp_path / "out", "--overwrite", "--wait", 0),
        ("conformance", liar.address, "--only", "5.3", "-q"),
        ("conformance", liar.address, "--only", "5.7", "--json", "-q"),
    )
    codes, end = set(), time.monotonic() + SECONDS
    for number in numbers:
        if time.monotonic() > end:
            break
        liar.chance.seed(number)
        verb, *arguments = map(str, calls[number % len(calls)])
        with pytest.raises(SystemExit) as stop:
            main([verb, *arguments])
        out, err = capfd.readouterr()
        reported = f"mutant {number}: {verb}: {stop.value.code}: {out[-300:]} {err[-3000:]} {caplog.text}"
        assert stop.value.code in {0, 1, 2, None}, reported
        assert "Traceback" not in err + caplog.text, reported
        assert stop.value.code != 1 or verb == "conformance" or err.startswith("sceneloom: "), reported
        caplog.clear()
        codes.add(stop.value.code)
    assert 1 in codes
