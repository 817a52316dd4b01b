"""Clause 5.6: what is taken, what is refused, and that pairs, order and numbers are kept."""

from collections.abc import Iterator

from sceneloom.fusion.messages.wire import fusion_pb2
from sceneloom.service.conformance import scene
from sceneloom.service.conformance.bench import DETECTIONS, SENSOR_DATA, Bench, Peer
from sceneloom.service.conformance.catalogue import Basis, Catalogue, Seen, same
from sceneloom.service.conformance.sent_rows import RAW_SENSORS

CHECKS = Catalogue("Receiving, pairs and order (clause 5.6)")

_PERIOD_NS = 100_000_000


@CHECKS.clause("5.6-1", "5.6.1", "raw data, images, clouds, 3D boxes and 2D boxes are taken")
def _kinds(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    peer.set("sensors", RAW_SENSORS)
    requests = (
        scene.raw(scene.drawn_image().tobytes()),
        scene.image(2),
        scene.cloud(),
        scene.boxes_3d(),
        scene.boxes_2d(),
    )
    for request in requests:
        yield same(
            f"Send {request.WhichOneof('data')}", "taken", "taken" if peer.send(request) else "refused"
        )


@CHECKS.clause("5.6-2", "5.6.2", "a request without data is refused")
def _nothing(bench: Bench) -> Iterator[Seen]:
    yield same("Send of nothing", "status 0", f"status {bench.ready().send(fusion_pb2.SendRequest())}")


@CHECKS.clause("5.6-3", "5.6.3", "sending returns 1, and 0 where the data are not taken")
def _status(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    yield same("Send of an image", 1, peer.send(scene.image()))
    yield same("Send of an image of 0 rows", 0, peer.send(scene.image(2, height=0)))


@CHECKS.clause("5.6-4", "5.6.1", "data of a sensor without a calibration are refused", basis=Basis.READING)
def _uncalibrated(bench: Bench) -> Iterator[Seen]:
    peer = bench.peer()
    yield same("Send before any calibration", "status 0", f"status {peer.send(scene.image())}")
    peer.calibrate()
    status = peer.send(scene.cloud(sensor_id=scene.LIDAR_ID + 1))
    yield same("Send of a lidar that has none", "status 0", f"status {status}")


@CHECKS.clause(
    "5.6-5", "5.6.1", "lists without boxes are taken: frames in which nothing was found", basis=Basis.READING
)
def _empty_lists(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    for request in (scene.boxes_2d(boxes=[]), scene.boxes_3d(boxes=[])):
        name = request.WhichOneof("data")
        yield same(f"Send of {name} without boxes", "taken", "taken" if peer.send(request) else "refused")
    yield same("Get: detections", 0, len(peer.result(DETECTIONS).detections))


@CHECKS.clause("5.6-6", "5.6.1", "boxes that come one by one are those of their frame", basis=Basis.READING)
def _bare(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    peer.set(
        "pairing_timeout_ms", 10_000
    )  # nothing but the next number closes a frame, however slow the trajectory is
    later = _PERIOD_NS + scene.IMAGE_LATER_NS
    for box in (scene.box_2d(), scene.box_2d(2, later)):
        yield same(
            f"Send box_2d of image {box.image_seq}",
            "taken",
            _taken(peer, fusion_pb2.SendRequest(box_2d=box)),
        )
    for bare in (
        scene.box_3d(scene.MATCHED),
        scene.box_3d(scene.ALONE),
        scene.box_3d(scene.MATCHED, 2, _PERIOD_NS),
    ):
        request = fusion_pb2.SendRequest(box_3d=bare)
        yield same(f"Send box_3d of sweep {bare.points_seq}", "taken", _taken(peer, request))
    found = peer.result(DETECTIONS)
    ids = sorted(box.box_3d_id for box in found.detections if box.HasField("box_3d_id"))
    yield same("Get: boxes of sweep 1", [scene.MATCHED.id, scene.ALONE.id], ids)


def _taken(peer: Peer, request: fusion_pb2.SendRequest) -> str:
    return "taken" if peer.send(request) else "refused"


@CHECKS.clause("5.6-7", "5.6.1", "the same number of a sensor again is refused", basis=Basis.READING)
def _duplicate(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    peer.send(scene.cloud(5))
    status = peer.send(scene.cloud(5, _PERIOD_NS))
    yield same("Send of clouds with seq 5 and 5: the second", "status 0", f"status {status}")


@CHECKS.clause(
    "5.6-8", "5.6.2", "seq is a uint32 that goes on from 4294967295 with 0, and comes back as it was sent"
)
def _wrap(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    numbers = [2**31 - 1, 2**31, 2**32 - 2, 2**32 - 1, 0, 1]
    for k, number in enumerate(numbers):
        peer.send(scene.image(number, k * _PERIOD_NS + scene.IMAGE_LATER_NS))
        peer.send(scene.cloud(number, k * _PERIOD_NS))
    found = [peer.result(SENSOR_DATA) for _ in numbers]
    yield same(f"pairs with seq {numbers}, Get: points_seq", numbers, [record.points_seq for record in found])
    yield same(f"pairs with seq {numbers}, Get: image_seq", numbers, [record.image_seq for record in found])


@CHECKS.clause("5.6-9", "5.6.1", "a sweep gets the image nearest in time", basis=Basis.READING)
def _nearest(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    for seq, offset_ns in ((1, -30_000_000), (2, 10_000_000), (3, 60_000_000)):
        peer.send(scene.image(seq, offset_ns))
    peer.send(scene.cloud(9))
    sent = "images 1, 2, 3 taken 30 ms before, 10 and 60 ms after a sweep, Get: image_seq"
    yield same(sent, 2, peer.result(SENSOR_DATA).image_seq)


@CHECKS.clause(
    "5.6-10", "5.6.1", "records that come late and out of order find their partners", basis=Basis.READING
)
def _out_of_order(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    peer.send(scene.image(2, _PERIOD_NS))
    peer.send(scene.image(1, 0))
    peer.send(scene.cloud(1))
    peer.send(scene.cloud(2, _PERIOD_NS))
    found = [peer.result(SENSOR_DATA) for _ in range(2)]
    yield same(
        "images 2, 1, then sweeps 1, 2, Get: (points_seq, image_seq)",
        [(1, 1), (2, 2)],
        [(record.points_seq, record.image_seq) for record in found],
    )


@CHECKS.clause(
    "5.6-11", "5.6.1", "a record far older than its sensor's newest is refused", basis=Basis.READING
)
def _backwards(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    peer.send(scene.cloud(1, 3_000_000_000))
    status = peer.send(scene.cloud(2, 0))
    yield same("Send of a sweep 3 s older than the one before", "status 0", f"status {status}")


@CHECKS.clause(
    "5.6-12", "5.6.3", "what is refused leaves no trace: the next pair is fused", basis=Basis.READING
)
def _no_trace(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    peer.send(scene.image(1, width=1))
    peer.send(scene.cloud(1, number=1))
    peer.send(scene.image(1))
    peer.send(scene.cloud(1))
    record = peer.result(SENSOR_DATA)
    yield same(
        "faulty records with seq 1, then good ones with seq 1, Get",
        (1, 1),
        (record.points_seq, record.image_seq),
    )
