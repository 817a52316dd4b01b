"""Clients that mean harm, against a server that is calibrated and running: it answers, bounded, and goes on.

Every method gets requests with other bytes or other values; images declare or hold far more than they are; records
and results flood; callers never read. After each of these a session of someone else still gets what it sends fused.
"""

import contextlib
import io
import json
import random
import signal
import socket
import struct
import subprocess
import sys
import time
import zlib
from pathlib import Path

import grpc
import numpy as np
import pytest
from google.protobuf.message import DecodeError
from google.protobuf.message_factory import GetMessageClass
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from tests.unit.service.test_security import Authority

from sceneloom.db34t.interface import FusionInterface
from sceneloom.db34t.wire import fusion_pb2
from sceneloom.errors import DataError
from sceneloom.service.server import METHODS, CallError

SERVICE = fusion_pb2.DESCRIPTOR.services_by_name["DataFusion"]
WIDTH, HEIGHT = 64, 48
FORWARD = (0, 0, 1, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 0, 1)
TOKEN = "0123456789abcdefghij"
DEADLINE_S = 60
"""Of calls that end at once: far more than they take on a busy machine."""

ANSWERS = {"INVALID_ARGUMENT", "NOT_FOUND", "RESOURCE_EXHAUSTED"}
"""Errors that are answers; others are failures of the service."""

SMALL, LARGE = 40, 2000
"""Mutants of each method, always and in the slow variant."""

MEBIBYTE = 1 << 20

SERVER = """
import sys
from sceneloom.cli.main import main
main(["serve", "-q", "--json", *sys.argv[1:]])
"""


class Server:
    """A server in a process of its own."""

    def __init__(self, *arguments):
        command = [sys.executable, "-c", SERVER, *map(str, arguments)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        line = ""
        while not line.rstrip().endswith("}"):
            more = self.process.stdout.readline()
            assert more, self.process.stderr.read()
            line += more
        self.address = json.loads(line)["address"]

    def peak(self):
        """The most memory that it had [byte]."""
        lines = Path(f"/proc/{self.process.pid}/status").read_text().splitlines()
        return next(int(line.split()[1]) << 10 for line in lines if line.startswith("VmHWM"))

    def end(self):
        """End it, and give what it complained about."""
        self.process.send_signal(signal.SIGTERM)
        _, reported = self.process.communicate(timeout=DEADLINE_S)
        assert self.process.returncode == 0
        return reported


class Rig:
    """A caller of one session, with one camera calibrated, whose records go on in time."""

    def __init__(self, address, session, *, credentials=None, token=None):
        options = [("grpc.max_receive_message_length", -1), ("grpc.use_local_subchannel_pool", 1)]
        secure = credentials is not None
        arguments = (address, credentials, options) if secure else (address, options)
        self.channel = (grpc.secure_channel if secure else grpc.insecure_channel)(*arguments)
        self.session, self.seq = session, 0
        self.metadata = () if token is None else (("authorization", f"Bearer {token}"),)

    def begin(self):
        self("CloseSession")
        self.seq = 0
        assert self("SetCalibration", calibration=calibration(), camera_id=1).status == 1
        return self

    def method(self, name):
        found = SERVICE.methods_by_name[name]
        kind = f"{'stream' if found.client_streaming else 'unary'}_{'stream' if found.server_streaming else 'unary'}"
        return getattr(self.channel, kind)(
            f"/{SERVICE.full_name}/{name}",
            request_serializer=lambda content: content,
            response_deserializer=GetMessageClass(found.output_type).FromString,
        )

    def request(self, name, /, **fields):
        return GetMessageClass(SERVICE.methods_by_name[name].input_type)(session=self.session, **fields)

    def __call__(self, name, /, **fields):
        content = self.request(name, **fields).SerializeToString()
        return self.method(name)(content, timeout=DEADLINE_S, metadata=self.metadata)

    def records(self):
        """A sweep, an image and their boxes, of the next time."""
        self.seq += 1
        now = timestamp(100 * self.seq)
        yield "image", image(self.seq, now)
        yield "points", cloud(self.seq, now)
        yield "boxes_3d", boxes_3d(self.seq, now)
        yield "boxes_2d", boxes_2d(self.seq, now)

    def works(self):
        """Whether a pair that is sent now comes back fused."""
        for name, record in self.records():
            status = self("Send", **{name: record})
            assert status.status == 1, status.reason
        self("Flush")
        for fusion_type, name in enumerate(("sensor_data", "detections")):
            replies = iter(lambda kind=fusion_type: self("Get", fusion_type=kind), None)
            found = next(getattr(reply, name) for reply in replies if getattr(reply, name).points_seq == self.seq)
            assert found.image_seq == self.seq
        return True

    def counts(self):
        return dict(self("GetCounters").counts)


def timestamp(milliseconds):
    s, ns = divmod(1_595_682_678_000_000_000 + milliseconds * 1_000_000, 10**9)
    return fusion_pb2.Timestamp(s=s, ns=ns)


def calibration(**changed):
    intrinsic = (50.0, 0, 31.5, 0, 50.0, 23.5, 0, 0, 1)
    fields = {"image_size": (WIDTH, HEIGHT), "intrinsic_matrix": intrinsic, "extrinsic_matrix": FORWARD}
    return fusion_pb2.Calibration(**fields | changed)


def image(seq, now, **changed):
    fields = {"sensor_id": 1, "timestamp": now, "seq": seq, "height": HEIGHT, "width": WIDTH, "encoding": "rgb8"}
    fields |= {"channel": 3, "data": bytes(range(256)) * (HEIGHT * WIDTH * 3 // 256)}
    return fusion_pb2.ImageData(**fields | changed)


def cloud(seq, now):
    data = np.array([[10, 0, 0], [12, 1, 0.5], [-10, 0, 0]], "<f4").tobytes()
    return fusion_pb2.PointCloudData(timestamp=now, seq=seq, number=3, fields="xyz", fields_number=3, data=data)


def boxes_3d(seq, now):
    fields = {"id": 4, "class": "Car", "points_seq": seq, "confidence": 0.8, "timestamp": now, "X": 20.0, "velocity": 5}
    box = fusion_pb2.Box3d(**fields, length=4.0, width=2.0, height=1.5, direction=(1, 0, 0))
    return fusion_pb2.Boxes3d(seq=seq, timestamp=now, boxes=[box])


def boxes_2d(seq, now):
    fields = {"id": 6, "class": "Car", "image_seq": seq, "confidence": 0.9, "timestamp": now}
    box = fusion_pb2.Box2d(**fields, x1=28, y1=21, x2=35, y2=26)
    return fusion_pb2.Boxes2d(sensor_id=1, seq=seq, timestamp=now, boxes=[box])


def seeds(rig):
    """Sound requests of each method, whose records are of the next time; nothing is sent."""
    value, made = fusion_pb2.Value, rig.request
    listed = fusion_pb2.ValueList(values=[value(integer_value=k) for k in (0, -1, 2)])
    pose = fusion_pb2.Pose(timestamp=timestamp(100 * rig.seq), position=[1, 2, 3], quaternion_xyzw=[0, 0, 0, 1])
    camera_model = {"model": "fisheye", "image_size": [WIDTH, HEIGHT], "fx": 50, "fy": 50, "cx": 31, "cy": 23}
    sent = [made("Send", **{name: record}) for name, record in rig.records()]
    later = timestamp(100 * rig.seq)
    sent.append(made("Send", box_3d=boxes_3d(rig.seq + 1, later).boxes[0]))
    sent.append(made("Send", box_2d=boxes_2d(rig.seq + 1, later).boxes[0]))
    sent.append(made("Send", raw=fusion_pb2.RawData(sensor_id=1, timestamp=later, seq=rig.seq, length=3, data=b"abc")))
    requests = {
        "AddProperty": [
            {"name": f"mode{rig.seq}", "description": "a=1, b=2", "type": "(enum, float)"},
            {"name": "camera_models", "description": "", "type": "string"},
        ],
        "SetProperty": [
            {"name": "lidar_coordinate", "value": value(list_value=listed)},
            {"name": "queue_length", "value": value(integer_value=8)},
            {"name": "camera_models", "value": value(string_value=json.dumps({"1": camera_model}))},
            {"name": "sensors", "value": value(string_value='{"1": {"kind": "camera", "raw": "png"}}')},
            {"name": "pairing_tolerance_ms", "value": value(number_value=5.0)},
        ],
        "GetProperty": [{"name": "chirality"}],
        "SetCalibration": [{"calibration": calibration(), "camera_id": 1}],
        "SendMotion": [{"poses": [pose]}],
        "Get": [{"fusion_type": 0}, {"fusion_type": 1}],
        "Subscribe": [{"fusion_type": 1, "most": 1, "track": True}, {"most": 1}],
    }
    requests |= {name: [{}] for name in ("ListProperties", "GetCounters", "Flush", "CloseSession")}
    made_of = {name: [made(name, **fields) for fields in listed] for name, listed in requests.items()}
    return made_of | {"Send": sent, "SendStream": sent}


NUMBERS = (0, 1, -1, 2, 127, 255, 256, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, -(2**63), 2**64 - 1)
BROKEN = (0.0, -0.0, 1e-45, 1e38, -1e38, 3.5e38, 1e308, float("inf"), float("-inf"), float("nan"), 0.5)
TEXTS = ("", "x", "\0", "é" * 300, "rgb8", "raw", "jpeg", "png", "[[[[", "{}", "1" * 400, "-", "nan", "../x")


def other_bytes(rng, request):
    """The bytes of a request with some of them changed, cut out, put in, doubled or rotated."""
    content = bytearray(request.SerializeToString())
    for _ in range(rng.randint(1, 4)):
        k, n = rng.randrange(len(content) + 1), rng.choice((1, 1, 2, 4, 30))
        match rng.randrange(5):
            case 0:
                content[k : k + n] = rng.randbytes(n)
            case 1:
                del content[k : k + n]
            case 2:
                content[k:k] = rng.randbytes(n)
            case 3:
                content[k:k] = content[k : k + 200]
            case _ if content:
                content[k % len(content)] ^= 1 << rng.randrange(8)
    return bytes(content)


def other_values(rng, request):
    """The bytes of a request in which fields have values that a parser takes, and nobody expects."""
    message = type(request).FromString(request.SerializeToString())
    for _ in range(rng.randint(1, 3)):
        inner = message
        while True:
            field = rng.choice(inner.DESCRIPTOR.fields)
            if field.type != field.TYPE_MESSAGE:
                break
            found = getattr(inner, field.name)
            if field.is_repeated:
                if not len(found) or rng.random() < 0.2:
                    found.add()
                inner = rng.choice(found)
            else:
                inner = found
        with contextlib.suppress(ValueError, TypeError, OverflowError):
            change(rng, inner, field)
    return message.SerializeToString()


def change(rng, message, field):
    if field.name == "session":
        return
    kinds = {field.TYPE_STRING: TEXTS, field.TYPE_BYTES: (b"", b"\0" * 7, rng.randbytes(64), b"\xff" * 36)}
    kinds |= dict.fromkeys((field.TYPE_FLOAT, field.TYPE_DOUBLE), BROKEN)
    pool = kinds.get(field.type, NUMBERS)
    if field.is_repeated:
        found = getattr(message, field.name)
        if rng.random() < 0.3:
            del found[rng.randrange(len(found) + 1) :]
        found.extend(rng.choices(pool, k=rng.choice((0, 1, 3, 40))))
        if len(found) and rng.random() < 0.7:
            found[rng.randrange(len(found))] = rng.choice(pool)
    else:
        setattr(message, field.name, rng.choice(pool))


ONE_STEP = [name for name, method in METHODS.items() if method.call.perform is not None]
SEEDS = seeds(Rig("localhost:1", "a"))


@pytest.mark.parametrize("name", ONE_STEP)
@given(data=st.data())
def test_other_bytes_are_answered_or_refused_by_a_method_that_is_one_step(name, data):
    content = bytearray(data.draw(st.sampled_from(SEEDS[name])).SerializeToString())
    for _ in range(data.draw(st.integers(1, 3))):
        k = data.draw(st.integers(0, len(content)))
        content[k : k + data.draw(st.integers(0, 4))] = data.draw(st.binary(max_size=4))
    method = METHODS[name]
    with FusionInterface(inline=True) as fusion, contextlib.suppress(CallError):
        method.reply_type.FromString(method.perform(fusion, bytes(content)))


@pytest.mark.parametrize("name", ONE_STEP)
@given(content=st.binary(max_size=60))
def test_any_bytes_name_a_session_or_are_refused(name, content):
    expected = found = None
    with contextlib.suppress(DecodeError):
        expected = METHODS[name].request_type.FromString(content).session
    with contextlib.suppress(DataError):
        found = METHODS[name].session_of(content)
    assert expected is None or found == expected


def attack(rig, other, name, count, *, seed=0):
    """Send mutants of a method, and give the failures: errors that are no answers, by the mutant's number."""
    rng, failures = random.Random(f"{name}{seed}"), []
    method, streams = rig.method(name), SERVICE.methods_by_name[name].client_streaming
    waits = name in ("Get", "Subscribe")
    for number in range(count):
        if number % 50 == 0:
            rig.begin()
            for _ in range(2):
                assert rig.works()
            assert other.works()
        request = rng.choice(seeds(rig)[name])
        content = (other_values if rng.random() < 0.5 else other_bytes)(rng, request)
        try:
            timeout = 0.25 if waits else DEADLINE_S  # a mutant may ask to wait for ever
            call = method(iter([content, content]) if streams else content, timeout=timeout, metadata=rig.metadata)
            if name == "Subscribe":
                if rng.random() < 0.1:
                    call.initial_metadata()
                call.cancel()
        except grpc.RpcError as error:
            if error.code().name not in ANSWERS | ({"DEADLINE_EXCEEDED"} if waits else set()):
                failures.append((number, error.code().name, error.details()))
        if number % 50 == 49 or number == count - 1:
            wrong = {key: n for key, n in rig.counts().items() if is_a_fault(key)}
            if wrong:
                failures.append((number, "COUNTED", wrong))
    rig.begin()
    assert rig.works()
    assert other.works()
    return failures


def is_a_fault(counter):
    """Whether a counter reports an exception that should not have been."""
    return counter.startswith("errors.") and counter != "errors.unreadable-image"


@pytest.fixture(scope="module")
def server():
    running = Server()
    yield running
    assert "Traceback" not in running.end()


@pytest.fixture
def rigs(server):
    both = [Rig(server.address, name).begin() for name in ("attacker", "other")]
    yield both
    for rig in both:
        with contextlib.suppress(grpc.RpcError):
            rig("CloseSession")
        rig.channel.close()


@pytest.mark.few(6)
@pytest.mark.parametrize("name", SERVICE.methods_by_name)
def test_mutants_of_a_request_are_answered_or_refused(rigs, name):
    assert attack(*rigs, name, SMALL if name != "Subscribe" else 10) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", SERVICE.methods_by_name)
def test_thousands_of_mutants_of_a_request_are_answered_or_refused(rigs, name):
    assert attack(*rigs, name, LARGE, seed="deep") == []


def test_images_that_declare_more_pixels_than_a_session_may_have_are_refused(server, rigs):
    rig, other = rigs
    before = server.peak()
    huge = calibration(image_size=(100_000, 10_000))
    status = rig("SetCalibration", calibration=huge, camera_id=1)
    assert (status.status, status.cause) == (0, "too-many")
    for changed in ({"height": 31_250, "width": 32_000}, {"height": 2**31}, {"encoding": "png", "width": 10**9}):
        assert rig("Send", image=image(1, timestamp(0), **changed)).cause == "bad-record"
    assert rig("AddProperty", name="camera_models", type="string").status == 1
    camera_model = {"model": "pinhole", "image_size": [31_250, 32_000], "fx": 50, "fy": 50, "cx": 31, "cy": 23}
    for size in ([31_250, 32_000], [10**400, 1], [1e400, 2], [True, 2]):
        text = json.dumps({"1": camera_model | {"image_size": size}, "2": camera_model | {"fx": 10**400}})
        rig("SetProperty", name="camera_models", value=fusion_pb2.Value(string_value=text))
        rig("Send", image=image(1, timestamp(0)))
    rig("SetProperty", name="camera_models", value=fusion_pb2.Value(string_value=""))
    for camera_id in range(2, 42):  # each may be, all together not
        rig("SetCalibration", calibration=calibration(image_size=(4000, 3000)), camera_id=camera_id)
    assert rig("Send", points=cloud(1, timestamp(0))).cause == "too-many"
    assert other.works()
    assert server.peak() - before < 64 * MEBIBYTE


def chunk(name, content):
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))


def png(size, *, rows, chunks=b""):
    """A PNG whose head declares a size, with so many rows of zeros in it."""
    deflate = zlib.compressobj(9)
    row = b"\0" * (3 * size[0] + 1)
    body = b"".join(deflate.compress(row) for _ in range(rows)) + deflate.flush()
    head = struct.pack(">IIBBBBB", *size, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunks + chunk(b"IDAT", body) + chunk(b"IEND", b"")


def progressive(scans):
    """A progressive JPEG one of whose scans is there many times."""
    file = io.BytesIO()
    Image.new("RGB", (WIDTH, HEIGHT)).save(file, "JPEG", progressive=True)
    content = file.getvalue()
    last = content.rindex(b"\xff\xda")
    return content[:-2] + content[last:-2] * scans + content[-2:]


def test_files_of_images_that_hold_far_more_than_they_should_cost_their_image_alone(server, rigs):
    rig, other = rigs
    before = server.peak()
    text_bomb = chunk(b"zTXt", b"k\0\0" + zlib.compress(bytes(200_000_000), 9))
    bombs = [
        ("png", png((WIDTH, HEIGHT), rows=1_000_000)),
        ("png", png((WIDTH, HEIGHT), rows=HEIGHT, chunks=text_bomb)),
        ("png", png((60_000, 60_000), rows=100)),
        ("png", png((WIDTH, HEIGHT), rows=1)),
        ("jpeg", progressive(20_000)),
        ("jpeg", progressive(0).replace(struct.pack(">HH", HEIGHT, WIDTH), b"\xff\xff\xff\xff")),
    ]
    for k, (encoding, content) in enumerate(bombs):
        now = timestamp(100 * k)
        data = {"encoding": encoding, "channel": 3, "data": content}
        assert rig("Send", image=image(k, now, **data)).status == 1
        assert rig("Send", points=cloud(k, now)).status == 1
    rig("Flush")
    counts = rig.counts()
    assert counts["received.image"] == len(bombs)
    assert counts["errors.unreadable-image"] >= 4
    assert not [name for name in counts if is_a_fault(name)]
    assert other.works()
    assert server.peak() - before < 192 * MEBIBYTE


@pytest.mark.parametrize(
    ("count", "size"), [(150, (640, 480)), pytest.param(2000, (1920, 1080), marks=pytest.mark.slow)]
)
def test_a_flood_of_images_without_sweeps_is_bounded_and_counted(server, rigs, count, size):
    rig, other = rigs
    rig("SetProperty", name="queue_length", value=fusion_pb2.Value(integer_value=16))
    rig("SetCalibration", calibration=calibration(image_size=size), camera_id=1)
    changed = {"width": size[0], "height": size[1], "data": bytes(size[0] * size[1] * 3)}
    before = server.peak()
    images = (rig.request("Send", image=image(k, timestamp(k), **changed)).SerializeToString() for k in range(count))
    summary = rig.method("SendStream")(images, timeout=600, metadata=rig.metadata)
    assert other.works()
    rig("Flush")
    counts = rig.counts()
    assert summary.accepted + summary.refused == count
    assert counts["received.image"] == summary.accepted
    gone = [n for name, n in counts.items() if name.endswith(".image") and name != "received.image"]
    assert 0 <= summary.accepted - sum(gone) <= 2 * 16
    assert counts["dropped.waiting.image"] > 0
    assert server.peak() - before < (3 * 16 + 8) * size[0] * size[1] * 3 + 96 * MEBIBYTE


def test_a_subscriber_that_never_reads_costs_its_own_results_alone(server, rigs):
    rig, other = rigs
    rig("SetProperty", name="result_queue_length", value=fusion_pb2.Value(integer_value=4))
    size = (640, 480)
    assert rig("SetCalibration", calibration=calibration(image_size=size), camera_id=1).status == 1
    before = server.peak()
    request = rig.request("Subscribe", fusion_type=0).SerializeToString()
    calls = [rig.method("Subscribe")(request, timeout=DEADLINE_S) for _ in range(3)]
    pixels = bytes(size[0] * size[1] * 3)
    for seq in range(60):
        now = timestamp(100 * seq)
        assert rig("Send", image=image(seq, now, width=size[0], height=size[1], data=pixels)).status == 1
        assert rig("Send", points=cloud(seq, now)).status == 1
        if seq % 20 == 0:
            assert other.works()
    rig("Flush")
    counts = rig.counts()
    assert counts["results.sensor_data"] == 60
    waiting = 60 - counts.get("delivered.sensor_data", 0) - counts.get("dropped.results", 0)
    assert counts["dropped.results"] > 0
    assert 0 <= waiting <= 4 + len(calls)
    assert server.peak() - before < 192 * MEBIBYTE
    for call in calls:
        call.cancel()
    assert rig.begin().works()


def test_streams_that_never_end_and_callers_that_go_disturb_nobody(server, rigs):
    rig, other = rigs

    def forever():
        yield from (rig.request("Send", **{name: record}).SerializeToString() for name, record in rig.records())
        while True:  # the other half of the stream stays open
            time.sleep(0.01)
            yield b"\xff"

    calls = [rig.method("SendStream").future(forever(), timeout=DEADLINE_S) for _ in range(4)]
    host, port = server.address.split(":")
    preface, raw = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", []
    for content in (preface, preface + b"\xff" * 4000, b"GET / HTTP/1.1\r\n"):
        raw.append(socket.create_connection((host, int(port))))
        raw[-1].sendall(content)
        raw[-1].shutdown(socket.SHUT_WR)
    assert other.works()
    for end in [*(call.cancel for call in calls), *(connection.close for connection in raw)]:
        end()
    assert other.works()
    assert rig.begin().works()


def enclosed(number, content):
    n = len(content)
    length = bytes([n & 0x7F | 0x80, n >> 7 & 0x7F | 0x80, n >> 14 & 0x7F | 0x80, n >> 21])
    return bytes([number << 3 | 2]) + length + content


@pytest.mark.parametrize("kind", ["values", "boxes", "poses", "fields", "session", "too large"])
@pytest.mark.few(2)
def test_messages_of_very_many_parts_are_refused_before_they_are_taken_apart(server, rigs, kind):
    """Two bytes of a message can be an empty part, which takes fifty in memory."""
    rig, other = rigs
    before = server.peak()
    count = 18_000_000 if kind == "too large" else 6_000_000
    values, sensors = (enclosed(2, enclosed(6, b"\x0a\x00" * count)), rig.request("SetProperty", name="sensors"))
    requests = {
        "values": ("SetProperty", sensors, values),
        "boxes": ("Send", rig.request("Send"), enclosed(4, b"\x22\x00" * count)),
        "poses": ("SendMotion", rig.request("SendMotion"), b"\x0a\x00" * count),
        "fields": ("Send", rig.request("Send"), enclosed(3, b"\x2a\x00" * count)),
        "session": ("Flush", fusion_pb2.FlushRequest(), b"\x38\x00" * count),
        "too large": ("SetProperty", sensors, values),
    }
    name, message, rest = requests[kind]
    with contextlib.suppress(grpc.RpcError):
        answer = rig.method(name)(message.SerializeToString() + rest, timeout=DEADLINE_S)
        assert answer.status == 0 or kind == "session"
    assert other.works()
    assert server.peak() - before < 900 * MEBIBYTE


def test_properties_may_hold_so_much_together(server, rigs):
    rig, other = rigs
    before, text, statuses = server.peak(), fusion_pb2.Value(string_value="x" * 8_000_000), []
    for k in range(12):
        assert rig("AddProperty", name=f"text{k}", type="string").status == 1
        statuses.append(rig("SetProperty", name=f"text{k}", value=text))
    assert [status.status for status in statuses].count(1) == 4
    assert {status.cause for status in statuses if not status.status} == {"too-many"}
    assert rig("SetProperty", name="text0", value=fusion_pb2.Value(string_value="")).status == 1
    assert rig("SetProperty", name="text9", value=text).status == 1
    many = json.dumps([{"camera_id": k % 256, "lidar_id": k // 256} for k in range(60_000)])
    assert rig("SetProperty", name="calibration", value=fusion_pb2.Value(string_value=many)).status == 0
    assert other.works()
    assert server.peak() - before < 256 * MEBIBYTE


@pytest.fixture(scope="module")
def guarded(tmp_path_factory):
    """A server over TLS that asks for a token, and the certificates of its authority and of another."""
    folder = tmp_path_factory.mktemp("tls")
    authority, stranger = (Authority(folder, name) for name in ("authority", "stranger"))
    certificate, key = authority.issue("server")
    (folder / "token").write_text(TOKEN)
    running = Server("--tls-cert", certificate, "--tls-key", key, "--token-file", folder / "token")
    yield running, authority.path.read_bytes(), stranger.path.read_bytes()
    assert "Traceback" not in running.end()


def tokens(rng, count):
    for _ in range(count):
        text, k = list(TOKEN), rng.randrange(len(TOKEN))
        match rng.randrange(4):
            case 0:
                text[k] = chr(rng.randrange(33, 127))
            case 1:
                del text[k:]
            case 2:
                text.insert(k, rng.choice(" ,0A~"))
            case _:
                text.reverse()
        if "".join(text) != TOKEN:
            yield "".join(text)


@pytest.mark.parametrize("count", [4, pytest.param(200, marks=pytest.mark.slow)])
def test_wrong_tokens_get_nowhere_with_any_method(guarded, count):
    server, authority, _ = guarded
    rng, credentials = random.Random(1), grpc.ssl_channel_credentials(authority)
    good = Rig(server.address, "good", credentials=credentials, token=TOKEN).begin()
    bad = Rig(server.address, "good", credentials=credentials)
    for name in SERVICE.methods_by_name:
        for token in tokens(rng, count):
            request = rng.choice(seeds(bad)[name])
            content = other_bytes(rng, request) if rng.random() < 0.5 else request.SerializeToString()
            sent = iter([content]) if SERVICE.methods_by_name[name].client_streaming else content
            metadata = (("authorization", f"Bearer {token}"),)
            with pytest.raises(grpc.RpcError) as refused:
                list(bad.method(name)(sent, timeout=DEADLINE_S, metadata=metadata))
            assert refused.value.code().name == "UNAUTHENTICATED"
    assert good.works()
    for rig in (good, bad):
        rig.channel.close()


def test_wrong_certificates_and_bytes_that_are_no_tls_find_nobody_and_disturb_nobody(guarded):
    server, authority, stranger = guarded
    good = Rig(server.address, "good", credentials=grpc.ssl_channel_credentials(authority), token=TOKEN).begin()
    for credentials in (grpc.ssl_channel_credentials(stranger), None):
        rig = Rig(server.address, "x", credentials=credentials, token=TOKEN)
        with pytest.raises(grpc.RpcError) as refused:
            rig("Flush")
        assert refused.value.code().name == "UNAVAILABLE"
        rig.channel.close()
    host, port = server.address.split(":")
    rng = random.Random(2)
    for _ in range(20):
        with contextlib.suppress(OSError), socket.create_connection((host, int(port))) as raw:
            raw.sendall(b"\x16\x03\x01" + rng.randbytes(rng.randrange(2000)))
    assert good.works()
    good.channel.close()


def test_mutants_over_tls_are_answered_or_refused(guarded):
    server, authority, _ = guarded
    credentials = grpc.ssl_channel_credentials(authority)
    both = [Rig(server.address, name, credentials=credentials, token=TOKEN).begin() for name in ("attacker", "other")]
    assert attack(*both, "Send", SMALL, seed="tls") == []
    for rig in both:
        rig.channel.close()
