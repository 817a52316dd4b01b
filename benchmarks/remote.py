"""What one frame of a large scene file behind a URL costs: bytes and requests, counted by a server on this machine.

`python -m benchmarks.remote [--frames 600]`: the file is sparse, so that a gigabyte takes no room on disk.
"""

import argparse
import json
import re
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from tempfile import TemporaryDirectory

import sceneloom

POINTS = 131_072
ARRAYS = (("positions", "float32", 3, 4), ("intensities", "uint8", 1, 1))


def write_sparse_scene(path: Path, frames: int) -> None:
    """A lidar whose points are all zero."""
    sweeps, items, offset = [], [], 64
    for k in range(frames):
        sweeps.append({"timestamp": 100_000 * k, "points": dict.fromkeys(("positions", "intensities"))})
        for name, dtype, columns, size in ARRAYS:
            length = POINTS * columns * size
            keys = ["sensors", 0, "frames", k, "points", name]
            shape = [POINTS, columns] if columns > 1 else [POINTS]
            items.append({"keys": keys, "offset": offset, "length": length, "dtype": dtype, "shape": shape})
            offset += length
    lidar = {"id": "top", "type": "lidar", "frames": sweeps}
    header = json.dumps({"version": "1.0", "sensors": [lidar], "$items": items}).encode()
    with path.open("wb") as file:
        file.write(header + b"\0")
        file.truncate(len(header) + offset)


class CountingServer(ThreadingHTTPServer):
    """Serves one file by ranges, and counts what it sends."""

    def __init__(self, path: Path, latency: float) -> None:
        super().__init__(("127.0.0.1", 0), Answers)
        self.path, self.latency, self.sent, self.requests = path, latency, 0, 0
        threading.Thread(target=self.serve_forever, daemon=True).start()


class Answers(BaseHTTPRequestHandler):
    def do_HEAD(self) -> None:
        self._answer(with_content=False)

    def do_GET(self) -> None:
        self._answer(with_content=True)

    def _answer(self, *, with_content: bool) -> None:
        time.sleep(self.server.latency)
        size = self.server.path.stat().st_size
        wanted = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
        start, stop = (int(wanted[1]), min(int(wanted[2]) + 1, size)) if wanted else (0, size)
        self.send_response(206 if wanted else 200)
        if wanted:
            self.send_header("Content-Range", f"bytes {start}-{stop - 1}/{size}")
        self.send_header("Accept-Ranges", "bytes")
        self.send_header("Content-Length", str(stop - start))
        self.end_headers()
        self.server.requests += 1
        if with_content:
            with self.server.path.open("rb") as file:
                file.seek(start)
                content = file.read(stop - start)
            self.server.sent += len(content)  # before the client may have it and look
            self.wfile.write(content)

    def log_message(self, *_: object) -> None:
        pass


def measure(path: Path, latency: float) -> dict[str, float]:
    server = CountingServer(path, latency)
    begun = time.perf_counter()
    with sceneloom.open(f"http://127.0.0.1:{server.server_port}/drive.sfs") as scene:
        opened = time.perf_counter()
        told = {
            "opening_mb": server.sent / 1e6,
            "opening_seconds": opened - begun,
            "opening_requests": server.requests,
        }
        lidar = scene.lidars[0]
        assert len(lidar.frames[len(lidar.frames) // 2].points.positions) == POINTS
        told |= {
            "frame_mb": server.sent / 1e6 - told["opening_mb"],
            "frame_seconds": time.perf_counter() - opened,
            "all_mb": server.sent / 1e6,
            "requests": server.requests,
        }
    server.shutdown()
    server.server_close()
    return told


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--latency", type=float, default=0.02, help="of each answer [s]")
    given = parser.parse_args()
    with TemporaryDirectory() as folder:
        path = Path(folder) / "drive.sfs"
        write_sparse_scene(path, given.frames)
        told = measure(path, given.latency)
        print(f"one frame of a scene file of {path.stat().st_size / 1e9:.2f} GB, {given.frames} frames:")
        for name, value in told.items():
            print(f"  {name}: {value:.3f}")
        assert told["all_mb"] < 20.0


if __name__ == "__main__":
    main()
