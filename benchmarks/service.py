"""The fusion service against a bare gRPC server that is given the same bytes and gives as many back.

Run with `python -m benchmarks.service [--only frames,flat,properties,boxes,soak] [--seconds 60] [--calls 50000]
[--soak-seconds 60]`. Both servers are asked in rotations, so that a busy machine slows both alike.

- frames: 10 Hz of a 1920x1080x3 raw image and 250,000 points of a street x 4 float32, from two processes; from
  the second of a pair sent to its result received. Limit: p99 at most 2.5 times the bare server's, plus the
  fusion's own time.
- flat: the same as fast as results come. Limit: half of the bare server's pairs a second.
- properties: calls of GetProperty and SetProperty while frames stream. Limit: p99 at most 3 times the bare server's.
- boxes: pairs of 20 + 20 boxes, sent by one streaming call or by a call for each list. Limits: 500 pairs a second
  through the service, 2,000 in process.
- soak: memory while one client never gets, one dies in the middle of a stream, and one sends garbage. Limit: 5 %.
"""

import argparse
import threading
import time

import numpy as np

from benchmarks.service_peers import (
    CAMERA_ID,
    LIDAR_ID,
    Boxes,
    Clouds,
    Exchange,
    Images,
    bare,
    connect,
    number_in_bare,
    number_in_ours,
    ours,
    stub,
)
from benchmarks.service_soak import soak
from sceneloom.db34t import CalibrationData
from sceneloom.db34t.interface import FusionInterface
from sceneloom.db34t.protobuf import encode, from_send_request, to_protobuf
from sceneloom.db34t.wire import fusion_pb2

WIDTH, HEIGHT, POINTS, BOXES = 1920, 1080, 250_000, 20
SLICES = 3
FORWARD = (0.0, 0, 1, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 0, 1)
CALIBRATION = CalibrationData(
    image_size=(WIDTH, HEIGHT),
    intrinsic_matrix=(1000.0, 0, 959.5, 0, 1000.0, 539.5, 0, 0, 1),
    reference_frame=0,
    extrinsic_matrix=FORWARD,
)
FRAMES = (Images(WIDTH, HEIGHT), Clouds(POINTS))
LISTS = (Boxes(BOXES, sweeps=False), Boxes(BOXES, sweeps=True))


def percentiles(seconds):
    p50, p99 = np.percentile(np.array(seconds or [float("nan")]) * 1e3, [50, 99])
    return f"p50 {p50:8.2f} ms, p99 {p99:8.2f} ms", p99


def prepare(port):
    """Begin a session anew: calibrated, nothing sent."""
    with connect(port) as channel:
        stub(channel, "CloseSession")(fusion_pb2.CloseSessionRequest().SerializeToString())
        request = fusion_pb2.SetCalibrationRequest(
            calibration=to_protobuf(CALIBRATION), camera_id=CAMERA_ID, lidar_id=LIDAR_ID
        )
        stub(channel, "SetCalibration")(request.SerializeToString())


def exchange(port, makers, *, is_ours, **settings):
    if is_ours:
        prepare(port)
    return Exchange(port, makers, number_in_ours if is_ours else number_in_bare, **settings)


def in_process(makers, count):
    """Fuse in this process; give the time that each pair took [s], and the size of a result's message [byte]."""
    taken, size = [], 0
    with FusionInterface(inline=True) as fusion:
        fusion.set_calibration(CALIBRATION, camera_id=CAMERA_ID, lidar_id=LIDAR_ID)
        for number in range(count):
            records = [
                from_send_request(fusion_pb2.SendRequest.FromString(maker.request(number, 100_000_000)))
                for maker in makers
            ]
            begun = time.perf_counter()
            for record in records:
                assert fusion.send(record)
            result = fusion.get(makers[0].kind)
            taken.append(time.perf_counter() - begun)
            size = size or len(encode(result.record))
    return taken[1:], size


def frames(ports, seconds, fusion_s):
    print(f"10 Hz of {WIDTH}x{HEIGHT}x3 and {POINTS} points from two processes, {seconds:g} s for each server")
    count = round(seconds * 10 / SLICES)
    latencies, lost = {name: [] for name in ports}, dict.fromkeys(ports, 0)
    for _ in range(SLICES):
        for name, port in ports.items():
            found, _ = exchange(port, FRAMES, is_ours=name == "ours", count=count, period_s=0.1).run()
            latencies[name] += found
            lost[name] += count - len(found)
    p99 = {}
    for name, found in latencies.items():
        reported, p99[name] = percentiles(found)
        print(f"  {name:5} {reported}; {lost[name]} of {count * SLICES} results missing")
    reported, own = percentiles(fusion_s)
    print(f"  fusion itself, in process: {reported}")
    ratio, beyond = p99["ours"] / p99["bare"], (p99["ours"] - own) / p99["bare"]
    print(f"  p99 {ratio:.2f} times the bare server's, {beyond:.2f} times without the fusion itself (limit 2.5)")


def flat_out(ports, count):
    print("as fast as results come, 4 pairs due")
    rates = {name: [] for name in ports}
    for _ in range(SLICES):
        for name, port in ports.items():
            found, taken = exchange(port, FRAMES, is_ours=name == "ours", count=count).run()
            rates[name].append(len(found) / taken)
    best = {name: max(found) for name, found in rates.items()}
    for name, rate in best.items():
        print(f"  {name:5} {rate:8.1f} pairs/s")
    print(f"  {best['ours'] / best['bare']:.2f} of the bare server's (limit 0.5)")


def properties(ports, calls):
    print(f"{calls} calls of GetProperty and SetProperty while frames stream at 10 Hz")
    p99 = {}
    parts = {name: [] for name in ports}
    for _ in range(SLICES):
        for name, port in ports.items():
            streaming = exchange(port, FRAMES, is_ours=name == "ours", count=6000, period_s=0.1)
            thread = threading.Thread(target=streaming.run, daemon=True)
            thread.start()
            time.sleep(1.0)
            parts[name] += _call_properties(port, calls // SLICES)
            streaming.replies.cancel()
            thread.join()
    for name, found in parts.items():
        reported, p99[name] = percentiles(found)
        print(f"  {name:5} {reported}")
    print(f"  p99 {p99['ours'] / p99['bare']:.2f} times the bare server's (limit 3)")


def _call_properties(port, calls):
    value = fusion_pb2.Value(integer_value=10)
    requests = [
        ("GetProperty", fusion_pb2.GetPropertyRequest(name="camera_frequency").SerializeToString()),
        ("SetProperty", fusion_pb2.SetPropertyRequest(name="camera_frequency", value=value).SerializeToString()),
    ]
    taken = []
    with connect(port) as channel:
        sides = [(stub(channel, name), request) for name, request in requests]
        for number in range(calls):
            call, request = sides[number % 2]
            begun = time.perf_counter()
            call(request)
            taken.append(time.perf_counter() - begun)
    return taken


def boxes(ports, count):
    print(f"pairs of {BOXES} + {BOXES} boxes")
    for streamed, call in ((True, "SendStream"), (False, "Send")):
        best = dict.fromkeys(ports, 0.0)
        for _ in range(SLICES):
            for name, port in ports.items():
                found, taken = exchange(
                    port, LISTS, is_ours=name == "ours", count=count, window=16, streamed=streamed
                ).run()
                best[name] = max(best[name], len(found) / taken)
        reported = ", ".join(f"{name} {rate:.0f}" for name, rate in best.items())
        print(f"  through the service, by {call}: {reported} pairs/s (limit 500)")
    taken, _ = in_process(LISTS, count)
    print(f"  {'in process':12} {1.0 / np.median(taken):8.0f} pairs/s (limit 2000)")


def main():
    parts = ("frames", "flat", "properties", "boxes", "soak")
    parser = argparse.ArgumentParser()
    parser.add_argument("--only", default=",".join(parts))
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--calls", type=int, default=50_000)
    parser.add_argument("--soak-seconds", type=float, default=60.0)
    chosen = parser.parse_args()
    wanted = chosen.only.split(",")
    if set(wanted) - {"soak"}:
        against_bare(wanted, chosen.seconds, chosen.calls)
    if "soak" in wanted:
        soak(chosen.soak_seconds)


def against_bare(wanted, seconds, calls):
    """What is measured on both servers in rotations."""
    fusion_s, result_bytes = in_process(FRAMES, 40)
    _, detections_bytes = in_process(LISTS, 2)
    with ours() as (port, _), bare(result_bytes, detections_bytes) as (bare_port, _):
        ports = {"bare": bare_port, "ours": port}
        if "frames" in wanted:
            frames(ports, seconds, fusion_s)
        if "flat" in wanted:
            flat_out(ports, 60)
        if "properties" in wanted:
            properties(ports, calls)
        if "boxes" in wanted:
            boxes(ports, 3000)


if __name__ == "__main__":
    main()
