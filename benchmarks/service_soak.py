"""Memory of the fusion service beside clients that behave badly.

One client sends frames and never gets; one sends a stream and is killed in the middle of it, again and again; one sends
garbage to every method; one behaves well. Memory is the server's resident set, measured once a second; its growth is
that from the second quarter of the time, when all queues are full, to the last.
"""

import multiprocessing
import random
import statistics
import time
from contextlib import suppress
from pathlib import Path

import grpc

from benchmarks.service_peers import SERVICE, Clouds, Images, connect, ours, stub
from sceneloom.db34t.wire import fusion_pb2

WIDTH, HEIGHT, POINTS = 320, 240, 10_000
PERIOD_NS = 100_000_000


def _calibrate(channel, session):
    calibration = fusion_pb2.Calibration(
        image_size=(WIDTH, HEIGHT),
        intrinsic_matrix=(200.0, 0, 159.5, 0, 200.0, 119.5, 0, 0, 1),
        extrinsic_matrix=(0, 0, 1, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 0, 1),
    )
    request = fusion_pb2.SetCalibrationRequest(calibration=calibration, camera_id=1, lidar_id=0, session=session)
    stub(channel, "SetCalibration")(request.SerializeToString())


def never_gets(port, *, gets=False):
    """Send frames for ever; results are fetched only with `gets`."""
    session = "gets" if gets else "never gets"
    makers = Images(WIDTH, HEIGHT), Clouds(POINTS)
    with connect(port) as channel:
        _calibrate(channel, session)
        number = 0
        while True:
            for maker in makers:
                stub(channel, "Send")(maker.request(number, PERIOD_NS, session))
            if gets:
                request = fusion_pb2.GetRequest(fusion_type=0, wait_ms=1000, session=session)
                stub(channel, "Get")(request.SerializeToString())
            number += 1
            time.sleep(0.02)


def behaves(port):
    never_gets(port, gets=True)


def streams(port, salt):
    """Send a stream that does not end; the process is killed in it."""
    makers = Images(WIDTH, HEIGHT), Clouds(POINTS)
    session = f"dies {salt % 3}"

    def requests():
        number = salt * 100_000
        while True:
            yield makers[number % 2].request(number, PERIOD_NS, session)
            number += 1
            time.sleep(0.005)

    with connect(port) as channel:
        _calibrate(channel, session)
        stub(channel, "SendStream", "stream_unary")(requests())


def garbage(port):
    """Send random bytes to every method."""
    kinds = {(False, False): "unary_unary", (True, False): "stream_unary", (False, True): "unary_stream"}
    chance = random.Random(3)
    with connect(port) as channel:
        calls = [(stub(channel, m.name, kinds[m.client_streaming, m.server_streaming]), m) for m in SERVICE.methods]
        while True:
            for call, method in calls:
                content = chance.randbytes(chance.choice([0, 1, 10, 1000, 100_000]))
                with suppress(grpc.RpcError):
                    if method.client_streaming:
                        call(iter([content]), timeout=5)
                    elif method.server_streaming:
                        next(iter(call(content, timeout=0.05)), None)
                    else:
                        call(content, timeout=5)
                time.sleep(0.005)


def resident_mb(pid):
    for line in Path(f"/proc/{pid}/status").read_text("ascii").splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) / 1024
    raise ValueError(f"no resident set of {pid}")


def soak(seconds):
    print(f"soak of {seconds:g} s: one never gets, one dies in the middle of a stream, one sends garbage")
    context = multiprocessing.get_context("spawn")
    with ours() as (port, server):
        steady = [
            context.Process(target=target, args=(port,), daemon=True) for target in (never_gets, behaves, garbage)
        ]
        for process in steady:
            process.start()
        sizes, deaths, begun = [], 0, time.monotonic()
        dying, dies_at = None, 0.0
        while time.monotonic() < begun + seconds:
            if time.monotonic() > dies_at:
                if dying is not None:
                    dying.kill()
                    dying.join()
                    deaths += 1
                dying = context.Process(target=streams, args=(port, deaths), daemon=True)
                dying.start()
                dies_at = time.monotonic() + 5.0
            time.sleep(1.0)
            sizes.append(resident_mb(server.pid))
        alive = server.poll() is None and all(process.is_alive() for process in steady)
        for process in (*steady, dying):
            process.kill()
            process.join()
    quarter = max(len(sizes) // 4, 1)
    before, after = statistics.median(sizes[quarter : 2 * quarter]), statistics.median(sizes[-quarter:])
    print(f"  {deaths} clients died; all others and the server went on: {'yes' if alive else 'NO'}")
    print(f"  {sizes[0]:.0f} MB after a second, {before:.0f} MB in the second quarter, {after:.0f} MB in the last")
    print(f"  growth {100 * (after / before - 1):+.1f} % (limit 5 %)")
