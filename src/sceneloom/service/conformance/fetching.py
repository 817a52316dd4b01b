"""Clause 5.7: results of each type, first in, first out, each of them once."""

from collections.abc import Iterator

from sceneloom.service.conformance import scene
from sceneloom.service.conformance.bench import DETECTIONS, RESULT_NAMES, SENSOR_DATA, Bench, Peer
from sceneloom.service.conformance.catalogue import Basis, Catalogue, Seen, same
from sceneloom.service.conformance.transport import CallFailedError

CHECKS = Catalogue("Fetching (clause 5.7)")

PERIOD_NS = 100_000_000


def send_pairs(peer: Peer, numbers: range) -> None:
    """Send pairs of an image and a sweep, a period apart."""
    for k in numbers:
        peer.send(scene.image(k, k * PERIOD_NS + scene.IMAGE_LATER_NS))
        peer.send(scene.cloud(k, k * PERIOD_NS))


def _send_boxes(peer: Peer, numbers: range) -> None:
    for k in numbers:
        peer.send(scene.boxes_2d(k, k * PERIOD_NS + scene.IMAGE_LATER_NS))
        peer.send(scene.boxes_3d(k, k * PERIOD_NS))


@CHECKS.clause("5.7-1", "5.7.1", "sensor data come fused as table 9 says, detections as table 10")
def _both(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    send_pairs(peer, range(1))
    _send_boxes(peer, range(1))
    for fusion_type, name in enumerate(RESULT_NAMES):
        yield same(f"Get fusion_type {fusion_type}", name, peer.fetch(fusion_type).WhichOneof("result"))


@CHECKS.clause(
    "5.7-2",
    "5.7.2",
    "the fusion type is 0 or 1; without it, what the property fusion_type says",
    basis=Basis.READING,
)
def _type(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    send_pairs(peer, range(1))
    _send_boxes(peer, range(1))
    for fusion_type in (DETECTIONS, SENSOR_DATA):
        peer.set("fusion_type", fusion_type)
        found = peer.fetch(None).WhichOneof("result")
        yield same(
            f"SetProperty fusion_type {fusion_type}, Get without a type", RESULT_NAMES[fusion_type], found
        )
    try:
        found = f"an answer with {peer.fetch(2, wait_ms=0).WhichOneof('result')}"
    except CallFailedError:
        found = "an error"
    yield same("Get fusion_type 2", "an error", found)


@CHECKS.clause(
    "5.7-3", "5.7.3", "results come first in, first out, of each type by itself", basis=Basis.READING
)
def _order(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    send_pairs(peer, range(5))
    _send_boxes(peer, range(5))
    numbers = list(range(5))
    for fusion_type in (DETECTIONS, SENSOR_DATA):
        found = [peer.result(fusion_type).points_seq for _ in numbers]
        yield same(f"pairs 0 to 4, Get fusion_type {fusion_type} five times: points_seq", numbers, found)


@CHECKS.clause("5.7-4", "5.7.3", "each result is given once", basis=Basis.READING)
def _once(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    send_pairs(peer, range(2))
    found = sorted(peer.result(SENSOR_DATA).points_seq for _ in range(2))
    yield same("two pairs, Get twice: points_seq, sorted", [0, 1], found)
    yield same("Get a third time", "no_data", _held(peer, SENSOR_DATA, 0))


@CHECKS.clause(
    "5.7-5", "5.7.3", "where there is no result, the answer says so, and is no error", basis=Basis.READING
)
def _no_data(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    for fusion_type in (SENSOR_DATA, DETECTIONS):
        for wait_ms in (0, 20):
            found = _held(peer, fusion_type, wait_ms)
            yield same(f"Get fusion_type {fusion_type}, wait_ms {wait_ms}, of nothing", "no_data", found)


def _held(peer: Peer, fusion_type: int, wait_ms: int) -> str:
    try:
        return str(peer.fetch(fusion_type, wait_ms=wait_ms).WhichOneof("result"))
    except CallFailedError as error:
        return str(error)
