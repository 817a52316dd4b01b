"""Clients and servers that mean harm.

A server that is calibrated and running answers, bounded, and goes on: every method gets requests with other bytes or
other values; images declare or hold far more than they are; records and results flood; callers never read. After each
of these a session of someone else still gets what it sends fused. A server that answers anything ends `send`, `get`
and `conformance` with a clear error, no traceback, and soon.
"""

import contextlib
import functools
import io
import json
import random
import socket
import struct
import time
import zlib
from concurrent.futures import ThreadPoolExecutor

import grpc
import numpy as np
import pytest
from google.protobuf.message import DecodeError
from google.protobuf.message_factory import GetMessageClass
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from tests.malformed.mutants import mutant_of, sound_scene
from tests.unit.db34t import sending
from tests.unit.db34t.sending import HEIGHT, WIDTH
from tests.unit.service.conftest import DEADLINE_S, SERVICE, Caller, Served
from tests.unit.service.test_security import TOKEN, Authority

import sceneloom
from sceneloom.cli import main
from sceneloom.db34t.interface import FusionInterface
from sceneloom.db34t.protobuf import to_protobuf
from sceneloom.db34t.wire import fusion_pb2
from sceneloom.errors import DataError
from sceneloom.formats.base.wire_formats import enclosed
from sceneloom.service.server import METHODS, CallError

ANSWERS = {"INVALID_ARGUMENT", "NOT_FOUND", "RESOURCE_EXHAUSTED"}
"""Errors that are answers; others are failures of the service."""

SMALL, LARGE = 40, 2000  # mutants of each method, always and in the slow variant

MEBIBYTE = 1 << 20


class Rig(Caller):
    """A caller of one session, with one camera calibrated, whose records go on in time."""

    def __init__(self, address, session, *, credentials=None, token=None):
        metadata = () if token is None else (("authorization", f"Bearer {token}"),)
        super().__init__(address, session=session, credentials=credentials, metadata=metadata)
        self.seq, self.mebibytes = 0, 1024

    def begin(self):
        self("CloseSession")
        self.seq = 0
        assert self.calibrate().status == 1
        return self

    def records(self):
        """A sweep, an image and their boxes, of the next time."""
        self.seq += 1
        now = 100 * self.seq
        yield "image", image(now, self.seq)
        yield "points", cloud(now, self.seq)
        yield "boxes_3d", to_protobuf(sending.boxes_3d(now, self.seq))
        yield "boxes_2d", to_protobuf(sending.boxes_2d(now, self.seq))

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

    def set(self, name, **value):
        return self("SetProperty", name=name, value=fusion_pb2.Value(**value))

    def counts(self):
        return dict(self("GetCounters").counts)


def image(milliseconds, seq, **changed):
    message = to_protobuf(sending.image(milliseconds, seq))
    message.MergeFrom(fusion_pb2.ImageData(**changed))
    return message


def cloud(milliseconds, seq):
    return to_protobuf(sending.cloud(milliseconds, seq, [[10, 0, 0], [12, 1, 0.5], [-10, 0, 0]]))


def seeds(rig):
    """Sound requests of each method, whose records are of the next time; nothing is sent."""
    value, made = fusion_pb2.Value, rig.request
    listed = fusion_pb2.ValueList(values=[value(integer_value=k) for k in (0, -1, 2)])
    camera_model = {"model": "fisheye", "image_size": [WIDTH, HEIGHT], "fx": 50, "fy": 50, "cx": 31, "cy": 23}
    sent = [made("Send", **{name: record}) for name, record in rig.records()]
    pose = fusion_pb2.Pose(timestamp=sent[0].image.timestamp, position=[1, 2, 3], quaternion_xyzw=[0, 0, 0, 1])
    now, alone = 100 * rig.seq, {"raw": sending.raw(100 * rig.seq, rig.seq, b"abc", sensor_id=1)}
    alone |= {"box_3d": sending.box_3d(now, rig.seq + 1), "box_2d": sending.box_2d(now, rig.seq + 1)}
    sent += [made("Send", **{name: to_protobuf(record)}) for name, record in alone.items()]
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
        "SetCalibration": [{"calibration": to_protobuf(sending.calibration()), "camera_id": 1}],
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
    rng, chance, failures = random.Random(f"{name}{seed}"), np.random.default_rng([*f"{name}{seed}".encode()]), []
    method, streams = rig.method(name), SERVICE.methods_by_name[name].client_streaming
    waits = name in ("Get", "Subscribe")
    for number in range(count):
        if number % 50 == 0:
            rig.begin()
            for _ in range(2):
                assert rig.works()
            assert other.works()
        request = rng.choice(seeds(rig)[name])
        changed_bytes = rng.random() < 0.5
        content = mutant_of(request.SerializeToString(), chance) if changed_bytes else other_values(rng, request)
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
    with Served("-q") as running:
        yield running
        assert "Traceback" not in running.end()


@pytest.fixture
def rigs(server):
    """A rig that attacks, and another one that works in the end; `rig.mebibytes` is what the attack may take."""
    both = [Rig(server.address, name).begin() for name in ("attacker", "other")]
    before = server.peak()
    yield both
    assert both[1].works()
    assert server.peak() - before < both[0].mebibytes * MEBIBYTE
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


def test_images_that_declare_more_pixels_than_a_session_may_have_are_refused(rigs):
    rig, _ = rigs
    rig.mebibytes = 64
    status = rig.calibrate(image_size=(100_000, 10_000))
    assert (status.status, status.cause) == (0, "too-many")
    for changed in ({"height": 31_250, "width": 32_000}, {"height": 2**31}, {"encoding": "png", "width": 10**9}):
        assert rig("Send", image=image(0, 1, **changed)).cause == "bad-record"
    assert rig("AddProperty", name="camera_models", type="string").status == 1
    camera_model = {"model": "pinhole", "image_size": [31_250, 32_000], "fx": 50, "fy": 50, "cx": 31, "cy": 23}
    for size in ([31_250, 32_000], [10**400, 1], [1e400, 2], [True, 2]):
        text = json.dumps({"1": camera_model | {"image_size": size}, "2": camera_model | {"fx": 10**400}})
        rig.set("camera_models", string_value=text)
        rig("Send", image=image(0, 1))
    rig.set("camera_models", string_value="")
    large = to_protobuf(sending.calibration(image_size=(4000, 3000)))
    for camera_id in range(2, 42):  # each may be, all together not
        rig("SetCalibration", calibration=large, camera_id=camera_id)
    assert rig("Send", points=cloud(0, 1)).cause == "too-many"


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


def test_files_of_images_that_hold_far_more_than_they_should_cost_their_image_alone(rigs):
    rig, _ = rigs
    rig.mebibytes = 192
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
        assert rig("Send", image=image(100 * k, k, encoding=encoding, data=content)).status == 1
        assert rig("Send", points=cloud(100 * k, k)).status == 1
    rig("Flush")
    counts = rig.counts()
    assert counts["received.image"] == len(bombs)
    assert counts["errors.unreadable-image"] >= 4
    assert not [name for name in counts if is_a_fault(name)]


@pytest.mark.parametrize(
    ("count", "size"), [(150, (640, 480)), pytest.param(2000, (1920, 1080), marks=pytest.mark.slow)]
)
def test_a_flood_of_images_without_sweeps_is_bounded_and_counted(rigs, count, size):
    rig, other = rigs
    rig.mebibytes = (3 * 16 + 8) * size[0] * size[1] * 3 / MEBIBYTE + 96
    rig.set("queue_length", integer_value=16)
    rig.calibrate(image_size=size)
    changed = {"width": size[0], "height": size[1], "data": bytes(size[0] * size[1] * 3)}
    images = (rig.request("Send", image=image(k, k, **changed)).SerializeToString() for k in range(count))
    summary = rig.method("SendStream")(images, timeout=600, metadata=rig.metadata)
    assert other.works()
    rig("Flush")
    counts = rig.counts()
    assert summary.accepted + summary.refused == count
    assert counts["received.image"] == summary.accepted
    gone = [n for name, n in counts.items() if name.endswith(".image") and name != "received.image"]
    assert 0 <= summary.accepted - sum(gone) <= 2 * 16
    assert counts["dropped.waiting.image"] > 0


def test_a_subscriber_that_never_reads_costs_its_own_results_alone(rigs):
    rig, other = rigs
    rig.mebibytes = 192
    rig.set("result_queue_length", integer_value=4)
    size = (640, 480)
    assert rig.calibrate(image_size=size).status == 1
    request = rig.request("Subscribe", fusion_type=0).SerializeToString()
    calls = [rig.method("Subscribe")(request, timeout=DEADLINE_S) for _ in range(3)]
    pixels = bytes(size[0] * size[1] * 3)
    for seq in range(60):
        assert rig("Send", image=image(100 * seq, seq, width=size[0], height=size[1], data=pixels)).status == 1
        assert rig("Send", points=cloud(100 * seq, seq)).status == 1
        if seq % 20 == 0:
            assert other.works()
    rig("Flush")
    counts = rig.counts()
    assert counts["results.sensor_data"] == 60
    waiting = 60 - counts.get("delivered.sensor_data", 0) - counts.get("dropped.results", 0)
    assert counts["dropped.results"] > 0
    assert 0 <= waiting <= 4 + len(calls)
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


@pytest.mark.parametrize("kind", ["values", "boxes", "poses", "fields", "session", "too large"])
@pytest.mark.few(2)
def test_messages_of_very_many_parts_are_refused_before_they_are_taken_apart(rigs, kind):
    """Two bytes of a message can be an empty part, which takes fifty in memory."""
    rig, _ = rigs
    rig.mebibytes = 900
    count = 18_000_000 if kind == "too large" else 6_000_000
    sensors, values = rig.request("SetProperty", name="sensors"), enclosed(2, enclosed(6, [b"\x0a\x00" * count]))
    requests = {
        "values": ("SetProperty", sensors, values),
        "boxes": ("Send", rig.request("Send"), enclosed(4, [b"\x22\x00" * count])),
        "poses": ("SendMotion", rig.request("SendMotion"), [b"\x0a\x00" * count]),
        "fields": ("Send", rig.request("Send"), enclosed(3, [b"\x2a\x00" * count])),
        "session": ("Flush", fusion_pb2.FlushRequest(), [b"\x38\x00" * count]),
        "too large": ("SetProperty", sensors, values),
    }
    name, message, rest = requests[kind]
    with contextlib.suppress(grpc.RpcError):
        answer = rig.method(name)(b"".join([message.SerializeToString(), *rest]), timeout=DEADLINE_S)
        assert answer.status == 0 or kind == "session"


def test_properties_may_hold_so_much_together(rigs):
    rig, _ = rigs
    rig.mebibytes = 256
    text, statuses = "x" * 8_000_000, []
    for k in range(12):
        assert rig("AddProperty", name=f"text{k}", type="string").status == 1
        statuses.append(rig.set(f"text{k}", string_value=text))
    assert [status.status for status in statuses].count(1) == 4
    assert {status.cause for status in statuses if not status.status} == {"too-many"}
    assert [rig.set("text0", string_value="").status, rig.set("text9", string_value=text).status] == [1, 1]
    many = json.dumps([{"camera_id": k % 256, "lidar_id": k // 256} for k in range(60_000)])
    assert rig.set("calibration", string_value=many).status == 0


@pytest.fixture(scope="module")
def guarded(tmp_path_factory):
    """A server over TLS that asks for a token, and the certificates of its authority and of another."""
    folder = tmp_path_factory.mktemp("tls")
    authority, stranger = (Authority(folder, name) for name in ("authority", "stranger"))
    certificate, key = authority.issue("server")
    (folder / "token").write_text(TOKEN)
    with Served("-q", "--tls-cert", certificate, "--tls-key", key, "--token-file", folder / "token") as running:
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
    rng, chance = random.Random(1), np.random.default_rng(1)
    credentials = grpc.ssl_channel_credentials(authority)
    good = Rig(server.address, "good", credentials=credentials, token=TOKEN).begin()
    bad = Rig(server.address, "good", credentials=credentials)
    for name in SERVICE.methods_by_name:
        for token in tokens(rng, count):
            content = rng.choice(seeds(bad)[name]).SerializeToString()
            content = mutant_of(content, chance) if rng.random() < 0.5 else content
            sent = iter([content]) if SERVICE.methods_by_name[name].client_streaming else content
            metadata = (("authorization", f"Bearer {token}"),)
            with pytest.raises(grpc.RpcError) as refused:
                list(bad.method(name)(sent, timeout=DEADLINE_S, metadata=metadata))
            assert refused.value.code().name == "UNAUTHENTICATED"
    assert good.works()
    for rig in (good, bad):
        rig.channel.close()


def test_over_tls_wrong_certificates_and_bytes_find_nobody_and_mutants_are_answered_or_refused(guarded):
    server, authority, stranger = guarded
    secure = {"credentials": grpc.ssl_channel_credentials(authority), "token": TOKEN}
    good, other = (Rig(server.address, name, **secure).begin() for name in ("good", "other"))
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
    assert attack(good, other, "Send", SMALL, seed="tls") == []
    for rig in (good, other):
        rig.channel.close()


SECONDS = 45  # of the long run


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
