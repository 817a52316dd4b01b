"""A server on a free port of this machine, and a caller that knows no more than the descriptor of the service."""

import contextlib
import json
import signal
import subprocess
import sys
from pathlib import Path

import grpc
import pytest
from google.protobuf.message_factory import GetMessageClass
from tests.unit.db34t.sending import calibration, cloud, image

from sceneloom.db34t.protobuf import fill_message, to_send_request
from sceneloom.db34t.wire import fusion_pb2
from sceneloom.service.running import running_server
from sceneloom.service.server import ServerSettings

SERVICE = fusion_pb2.DESCRIPTOR.services_by_name["DataFusion"]

DEADLINE_S = 60  # for calls that end at once: far more than they take on a busy machine


class Caller:
    """Calls methods by name; requests are messages or bytes."""

    def __init__(self, address, *, session="", credentials=None, metadata=()):
        options = [("grpc.max_receive_message_length", -1), ("grpc.use_local_subchannel_pool", 1)]
        if credentials is None:
            self.channel = grpc.insecure_channel(address, options)
        else:
            self.channel = grpc.secure_channel(address, credentials, options)
        self.session, self.metadata = session, metadata

    def method(self, name):
        found = SERVICE.methods_by_name[name]
        make = {
            (False, False): self.channel.unary_unary,
            (True, False): self.channel.stream_unary,
            (False, True): self.channel.unary_stream,
        }[found.client_streaming, found.server_streaming]
        return make(
            f"/{SERVICE.full_name}/{name}",
            request_serializer=lambda message: message if isinstance(message, bytes) else message.SerializeToString(),
            response_deserializer=GetMessageClass(found.output_type).FromString,
        )

    def request(self, name, /, **fields):
        return GetMessageClass(SERVICE.methods_by_name[name].input_type)(session=self.session, **fields)

    def __call__(self, name, request=None, /, *, timeout=DEADLINE_S, **fields):
        asked = self.request(name, **fields) if request is None else request
        return self.method(name)(asked, timeout=timeout, metadata=self.metadata)

    def fails(self, name, request=None, /, **options):
        """The code and the details that a call ends with."""
        with pytest.raises(grpc.RpcError) as caught:
            answer = self(name, request, **options)
            list(answer if name == "Subscribe" else ())
        return caught.value.code().name, caught.value.details()

    def send(self, record):
        return self("Send", to_send_request(record, session=self.session))

    def send_pair(self, seq, level=7):
        for record in (image(100 * seq, seq, level), cloud(100 * seq, seq, ((10.0, 0.0, 0.0), (-10.0, 0.0, 0.0)))):
            assert self.send(record).status == 1

    def calibrate(self, **changed):
        request = self.request("SetCalibration", camera_id=1)
        fill_message(request.calibration, calibration(**changed))
        return self("SetCalibration", request)


class Served:
    """A server in a process of its own; use it in `with`."""

    def __init__(self, *options, **environment):
        command = [sys.executable, "-m", "sceneloom", "serve", "--json", *map(str, options)]
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **environment
        )
        lines = ""
        while not lines.endswith("}\n"):
            line = self.process.stdout.readline()
            assert line, self.process.stderr.read()
            lines += line
        self.address = json.loads(lines)["address"]

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.communicate()

    def peak(self):
        """The most memory that it had [byte]."""
        lines = Path(f"/proc/{self.process.pid}/status").read_text().splitlines()
        return next(int(line.split()[1]) << 10 for line in lines if line.startswith("VmHWM"))

    def end(self, code=0, *, asked=False):
        """End it unless it was asked to already, and give what it complained about."""
        if not asked:
            self.process.send_signal(signal.SIGTERM)
        _, reported = self.process.communicate(timeout=DEADLINE_S)
        assert self.process.returncode == code
        return reported


@pytest.fixture
def serve():
    """Starts a server with given settings; it ends with the test."""
    with contextlib.ExitStack() as stack:

        def start(**settings):
            return stack.enter_context(running_server(ServerSettings(**settings)))

        yield start


@pytest.fixture
def connect():
    """Opens a caller to a server; it is closed with the test."""
    with contextlib.ExitStack() as stack:

        def open_caller(server, **options):
            caller = Caller(server if isinstance(server, str) else server.address, **options)
            stack.callback(caller.channel.close)
            return caller

        yield open_caller


@pytest.fixture
def call(serve, connect):
    """A caller of a server of its own, with one camera calibrated."""
    caller = connect(serve())
    assert caller.calibrate().status == 1
    return caller
