"""What the benchmark of the service runs beside itself: servers, and processes that send.

The bare server is a gRPC server of the same methods that does nothing: it takes the same bytes in, and gives back as
many as the fusion does, one result for each sweep.
"""

import asyncio
import multiprocessing
import signal
import subprocess
import sys
import threading
import time
from collections import defaultdict
from contextlib import contextmanager

import grpc
import numpy as np

from benchmarks.street import LIDAR_WORLD, make_street
from sceneloom.db34t.wire import fusion_pb2

SERVICE = fusion_pb2.DESCRIPTOR.services_by_name["DataFusion"]
OPTIONS = [("grpc.max_send_message_length", -1), ("grpc.max_receive_message_length", -1)]
START_NS = 1_600_000_000_000_000_000
CAMERA_ID, LIDAR_ID = 1, 0


# servers


@contextmanager
def started(*command):
    """Run a server that prints its port; give its port and its process, and end it."""
    process = subprocess.Popen([sys.executable, *command], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        line = process.stdout.readline()
        yield int("".join(line.split(":")[-1].split())), process
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
        process.stdout.close()


def ours():
    return started("-m", "sceneloom", "serve", "--port", "0", "--quiet")


def bare(result_bytes, detections_bytes):
    program = "from benchmarks.service_peers import serve_bare; serve_bare"
    return started("-c", f"{program}({result_bytes}, {detections_bytes})")


def serve_bare(result_bytes, detections_bytes):
    """Serve until the process is ended."""
    asyncio.run(_serve_bare(result_bytes, detections_bytes))


async def _serve_bare(result_bytes, detections_bytes):
    queues = defaultdict(asyncio.Queue)
    done = fusion_pb2.Status(status=1).SerializeToString()
    value = fusion_pb2.Property(name="camera_frequency", value=fusion_pb2.Value(integer_value=10))
    filling = {0: bytes(result_bytes), 1: bytes(detections_bytes)}

    async def send(_, context):
        reported = dict(context.invocation_metadata())
        if "sweep" in reported:
            number, kind = int(reported["sweep"]), int(reported["kind"])
            queues[kind].put_nowait(number.to_bytes(8, "little") + filling[kind])
        return done

    async def send_stream(requests, context):
        reported, number = dict(context.invocation_metadata()), 0
        async for _ in requests:
            if reported["sweeps"] == "1":
                queues[int(reported["kind"])].put_nowait(number.to_bytes(8, "little") + filling[int(reported["kind"])])
            number += 1
        return fusion_pb2.SendSummary(accepted=number).SerializeToString()

    async def subscribe(request, context):
        queue = queues[fusion_pb2.SubscribeRequest.FromString(request).fusion_type]
        while True:
            await context.write(await queue.get())

    async def status(_request, _context):
        return done

    async def get_property(_request, _context):
        return value.SerializeToString()

    unary = grpc.unary_unary_rpc_method_handler
    handlers = {
        "Send": unary(send),
        "SendStream": grpc.stream_unary_rpc_method_handler(send_stream),
        "Subscribe": grpc.unary_stream_rpc_method_handler(subscribe),
        "SetProperty": unary(status),
        "GetProperty": unary(get_property),
    }
    server = grpc.aio.server(options=OPTIONS)
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(SERVICE.full_name, handlers),))
    print("port:", server.add_insecure_port("127.0.0.1:0"), flush=True)
    await server.start()
    await server.wait_for_termination()


# clients, who send and take bytes: what they do is the same for both servers


def stub(channel, name, kind="unary_unary"):
    return getattr(channel, kind)(f"/{SERVICE.full_name}/{name}")


def connect(port):
    return grpc.insecure_channel(f"127.0.0.1:{port}", OPTIONS)


def timestamp(number, period_ns):
    s, ns = divmod(START_NS + number * period_ns, 10**9)
    return fusion_pb2.Timestamp(s=s, ns=ns)


class Images:
    """Makes requests with an image."""

    sweeps, kind = False, 0

    def __init__(self, width, height):
        pixels = np.random.default_rng(1).integers(0, 255, (height, width, 3), np.uint8)
        self.fields = {"height": height, "width": width, "encoding": "rgb8", "channel": 3, "data": pixels.tobytes()}

    def request(self, number, period_ns, session=""):
        image = fusion_pb2.ImageData(
            sensor_id=CAMERA_ID, timestamp=timestamp(number, period_ns), seq=number, **self.fields
        )
        return fusion_pb2.SendRequest(image=image, session=session).SerializeToString()


class Clouds:
    """Makes requests with what a dense lidar sees of a street ahead, x, y, z, reflectivity."""

    sweeps, kind = True, 0

    def __init__(self, count):
        points = make_street(count) - LIDAR_WORLD
        reflectivity = np.random.default_rng(2).integers(0, 255, count)
        values = np.column_stack([points, reflectivity]).astype("<f4")
        self.fields = {
            "number": count,
            "fields": ("x", "y", "z", "reflectivity"),
            "fields_number": 4,
            "data": values.tobytes(),
        }

    def request(self, number, period_ns, session=""):
        points = fusion_pb2.PointCloudData(
            sensor_id=LIDAR_ID, timestamp=timestamp(number, period_ns), seq=number, **self.fields
        )
        return fusion_pb2.SendRequest(points=points, session=session).SerializeToString()


class Boxes:
    """Makes requests with boxes; `sweeps` says whether in space or in the image."""

    kind = 1

    def __init__(self, count, *, sweeps):
        self.count, self.sweeps = count, sweeps

    def request(self, number, period_ns, session=""):
        time_stamp = timestamp(number, period_ns)
        if self.sweeps:
            boxes = [self._box_3d(k, number, time_stamp) for k in range(self.count)]
            listed = fusion_pb2.Boxes3d(sensor_id=LIDAR_ID, seq=number, timestamp=time_stamp, boxes=boxes)
            request = fusion_pb2.SendRequest(boxes_3d=listed, session=session)
        else:
            boxes = [self._box_2d(k, number, time_stamp) for k in range(self.count)]
            listed = fusion_pb2.Boxes2d(sensor_id=CAMERA_ID, seq=number, timestamp=time_stamp, boxes=boxes)
            request = fusion_pb2.SendRequest(boxes_2d=listed, session=session)
        return request.SerializeToString()

    @staticmethod
    def _box_3d(k, number, time_stamp):
        fields = {"class": "Car", "X": 10.0 + 3 * k, "Y": 4.0 * (k % 5 - 2), "Z": -0.5}
        return fusion_pb2.Box3d(
            id=k, points_seq=number, confidence=0.75, timestamp=time_stamp, length=4.5, width=1.75, height=1.5,
            direction=(1.0, 0.0, 0.0), velocity=5.0, **fields,
        )  # fmt: skip

    @staticmethod
    def _box_2d(k, number, time_stamp):
        x, y = 960 - 1000 * 4 * (k % 5 - 2) // (10 + 3 * k), 540 + 500 // (10 + 3 * k)
        half = 1500 // (10 + 3 * k)
        x, half = max(x, half), max(half, 2)
        corners = {"x1": x - half, "x2": x + half, "y1": y - half // 2, "y2": y + half // 2}
        return fusion_pb2.Box2d(
            id=k, image_seq=number, confidence=0.75, timestamp=time_stamp, **{"class": "Car"}, **corners
        )


def _send(port, maker, count, period_s, begun, sent, received, window, ready, *, streamed):
    """Send requests 0 to count - 1; by a clock, or as long as fewer than `window` results are due."""
    period_ns = round((period_s or 0.1) * 1e9)
    due = _when_due(count, period_s, begun, sent, received, window)
    with connect(port) as channel:
        upcoming = maker.request(0, period_ns)
        with ready.get_lock():
            ready.value += 1
        if streamed:
            reported = (("kind", str(maker.kind)), ("sweeps", str(int(maker.sweeps))))
            requests = (maker.request(number, period_ns) for number in due)
            stub(channel, "SendStream", "stream_unary")(requests, metadata=reported)
            return
        send = stub(channel, "Send")
        for number in due:
            # what our server finds in the message the bare one is reported beside it
            reported = (("kind", str(maker.kind)), *((("sweep", str(number)),) if maker.sweeps else ()))
            send(upcoming, metadata=reported)
            upcoming = maker.request(number + 1, period_ns)


def _when_due(count, period_s, begun, sent, received, window):
    """Give the numbers 0 to count - 1, each when it may be sent."""
    while begun.value == 0.0:
        time.sleep(0.001)
    for number in range(count):
        if period_s:
            time.sleep(max(begun.value + number * period_s - time.monotonic(), 0.0))
        else:
            while number - received.value >= window:
                time.sleep(0.0002)
        sent[number] = time.monotonic()
        yield number


class Exchange:
    """Two processes that send to a server, and this one that takes the results."""

    def __init__(self, port, makers, number_of, *, count, period_s=0.0, window=4, streamed=False):
        """Start the senders; `number_of` gives a reply's sweep; `streamed`: by one call, not by one for each record."""
        context = multiprocessing.get_context("spawn")
        self.begun, self.received, ready = (context.Value("d", 0.0), context.Value("q", 0), context.Value("i", 0))
        self.count, self.period_s, self.number_of = count, period_s, number_of
        self.sent = [context.Array("d", count, lock=False) for _ in makers]
        self.processes = [
            context.Process(
                target=_send,
                args=(port, maker, count, period_s, self.begun, times, self.received, window, ready),
                kwargs={"streamed": streamed},
                daemon=True,
            )
            for maker, times in zip(makers, self.sent, strict=True)
        ]
        for process in self.processes:
            process.start()
        self.channel = connect(port)
        request = fusion_pb2.SubscribeRequest(fusion_type=makers[0].kind)
        self.replies = stub(self.channel, "Subscribe", "unary_stream")(request.SerializeToString())
        self.arrivals = {}
        self.last = 0.0
        while ready.value < len(makers):
            time.sleep(0.01)
        time.sleep(0.3)  # until the subscription has come to the server

    def run(self):
        """Take results until all are there or none comes any more; give latencies [s] and the whole time [s]."""
        self.begun.value = start = time.monotonic() + 0.05
        self.last = start + 5.0
        watch = threading.Thread(target=self._give_up, daemon=True)
        watch.start()
        try:
            for reply in self.replies:
                self.last = at = time.monotonic()
                self.received.value += 1
                self.arrivals[self.number_of(reply)] = at
                if len(self.arrivals) == self.count:
                    break
        except grpc.RpcError:
            pass
        self.replies.cancel()
        self.channel.close()
        for process in self.processes:
            process.terminate()
            process.join()
        latencies = [at - max(times[n] for times in self.sent) for n, at in self.arrivals.items()]
        return latencies, max(self.arrivals.values(), default=start) - start

    def _give_up(self):
        while len(self.arrivals) < self.count:
            if time.monotonic() > self.last + 5.0 + self.period_s:
                self.replies.cancel()
                return
            time.sleep(0.2)


def number_in_bare(reply):
    return int.from_bytes(reply[:8], "little")


def number_in_ours(reply):
    found = fusion_pb2.GetReply.FromString(reply)
    return getattr(found, found.WhichOneof("result")).points_seq
