"""Files behind HTTP on this machine, waits that take no time, and one number for all that is in a scene."""

import hashlib
import json
import re
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import fsspec
import numpy as np
import pytest

from sceneloom.geometry.rigid import RigidTransform


class Served:
    """A folder in memory behind HTTP.

    Attributes:
        files: content by name.
        asked: the ranges that were asked for, (name, first byte, one after the last).
        ranges: whether the server answers ranges; else it sends whole files.
        faults: what goes wrong with the next requests, each once: "503", "cut", "slow", or None for nothing.
        queries: what stood behind the `?` of each request.
    """

    def __init__(self):
        self.files, self.asked, self.ranges = {}, [], True
        self.faults, self.queries, self.free = [], [], threading.Event()
        self.server = ThreadingHTTPServer(("127.0.0.1", 0), self._handler())
        self.server.handle_error = lambda *_: None  # clients hang up on answers that they did not ask for
        self.thread = threading.Thread(target=self.server.serve_forever, args=(0.01,), daemon=True)
        self.thread.start()

    def url(self, name):
        return f"http://127.0.0.1:{self.server.server_port}/{name}"

    @property
    def bytes_sent(self):
        return sum(stop - start for _, start, stop in self.asked)

    def close(self):
        self.free.set()
        self.server.shutdown()
        self.server.server_close()
        self.thread.join()

    def _handler(self):
        served = self

        class Handler(BaseHTTPRequestHandler):
            def _head(self):
                name, _, query = self.path[1:].partition("?")
                served.queries.append(query)
                content = served.files.get(name)
                if content is None:
                    self.send_error(404)
                    return None
                wanted = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
                start, stop = (int(wanted[1]), int(wanted[2]) + 1) if wanted else (0, len(content))
                if not (wanted and served.ranges):
                    start, stop = 0, len(content)
                piece = content[start:stop]
                self.send_response(206 if wanted and served.ranges else 200)
                if wanted and served.ranges:
                    self.send_header("Content-Range", f"bytes {start}-{stop - 1}/{len(content)}")
                if served.ranges:
                    self.send_header("Accept-Ranges", "bytes")
                self.send_header("ETag", f'"{hash(content)}"')
                self.send_header("Content-Length", str(len(piece)))
                self.end_headers()
                return start, piece

            def _fault(self):
                fault = served.faults.pop(0) if served.faults else None
                if fault == "503":
                    self.send_error(503)
                if fault == "slow":
                    served.free.wait(30)
                return fault

            def do_HEAD(self):
                if self._fault() is None:
                    self._head()

            def do_GET(self):
                fault = self._fault()
                found = None if fault in ("503", "slow") else self._head()
                if found is None:
                    return
                start, piece = found
                served.asked.append((self.path[1:].partition("?")[0], start, start + len(piece)))
                self.wfile.write(piece if fault is None else piece[: len(piece) // 2])

            def log_message(self, *_):
                pass

        return Handler


@pytest.fixture
def waits(monkeypatch):
    """The waits between tries [s], which take no time."""
    found = []
    monkeypatch.setattr("sceneloom.formats.remote.stores.time.sleep", found.append)
    return found


@pytest.fixture
def served(waits):
    """An HTTP server that counts what it sends; sessions of the client end before it."""
    found = Served()
    yield found
    fsspec.filesystem("http").clear_instance_cache()
    found.close()


@pytest.fixture
def memory():
    """A store in memory, empty at first."""
    files = fsspec.filesystem("memory")
    files.store.clear()
    files.pseudo_dirs[:] = [""]
    yield files
    files.store.clear()
    files.pseudo_dirs[:] = [""]


def digest(scene):
    """One number for all that can be read of a scene; self-contained, since its source goes to other processes."""
    stated = hashlib.sha256()
    for sensor in scene.sensors:
        stated.update(f"{sensor.id!r} {sorted(sensor.extras)}".encode())
        for frame in getattr(sensor, "frames", ()) if sensor.type in ("lidar", "radar") else ():
            for name in ("positions", "intensities", "timestamps_ns", "rings"):
                array = getattr(frame.points, name, None)
                stated.update(b"" if array is None else array.tobytes())
            stated.update(repr((frame.timestamp_ns, sorted(frame.extras))).encode())
    for camera in scene.cameras:
        for image in camera.images:
            stated.update(repr((image.timestamp_ns, image.camera, sorted(image.extras))).encode())
            stated.update(image.rgb.tobytes())
            stated.update(b"" if image.encoded is None else image.encoded())
        if camera.video is not None:
            with camera.video.open() as file:
                stated.update(file.read())
    for name, trajectory in sorted(scene.trajectories.items()):
        stated.update(name.encode() + trajectory.positions.tobytes())
    return f"{stated.hexdigest()} {len(scene.annotations)}"


def cameras_in_world(folder):
    """`world_from_camera` of each image by its name, (N, 4, 4), as a folder of COLMAP or nerfstudio has it."""
    if (folder / "transforms.json").exists():
        frames = json.loads((folder / "transforms.json").read_text())["frames"]
        frames.sort(key=lambda frame: frame["file_path"])
        # its camera axes are x right, y up, z back
        return np.array([frame["transform_matrix"] for frame in frames]) @ np.diag([1, -1, -1, 1])
    rows = [line.split() for line in (folder / "sparse/0/images.txt").read_text().splitlines() if ".jpg" in line]
    poses = [np.array(row[1:8], float) for row in sorted(rows, key=lambda row: row[9])]
    cameras = [RigidTransform.from_quaternion(pose[4:], np.roll(pose[:4], -1)) for pose in poses]
    return np.array([camera.inverse().matrix for camera in cameras])
