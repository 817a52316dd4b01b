"""How fast recordings are read: lines into columns, video into pictures, lidar files into points.

Run with `python -m benchmarks.recording [lines|video|lidar …] [--lines 1000000] [--repetitions 5]`; orjson is in the
extra `bench`. Both sides of each comparison take turns, and the least time of each counts. A ratio of 1.2 means that
the other side takes 1.2 times as long.

Lines: a drive with accelerometer and gyroscope at 200 Hz, ground truth at 100 Hz, pictures of two cameras at 20 Hz and
fixes at 1 Hz, all numbers with the digits that a 64-bit number needs. The other side is a plain loop of `orjson.loads`
that checks nothing and fills the same arrays. The peak is what reading allocates at most, beside the arrays that it
ends with. Processor seconds are those of this process and, with two, of the busier one: what two idle processors take.

Video: 1080p H.264, against a bare loop of PyAV as it decodes by itself (one thread for pictures of one slice), against
one that asks it for red, green and blue, too, by its fast converter, which is a level dark, and against a bare loop
whose decoder works on several pictures at once, as it does here.

Lidar: files of 23-byte records, let go one by one, against `numpy.fromfile`, which leaves records as they are. Reading
here maps a file and checks the time of every record, and nothing more: fields are taken out of the records at their
first use. The last row has that in it: positions, intensities, rings, and times as seconds and as nanoseconds, each in
an array of its own.
"""

import argparse
import os
import resource
import tempfile
import time
import tracemalloc
from array import array
from collections.abc import Callable, Mapping
from math import nan
from pathlib import Path
from typing import Any

import av
import numpy as np
import orjson

from sceneloom.formats.ledger import Ledger
from sceneloom.formats.recording.columns import RecordingColumns
from sceneloom.formats.recording.lidar_files import XYZIRT, read_points
from sceneloom.formats.recording.line_parts import PROCESSES
from sceneloom.formats.recording.lines import read_lines
from sceneloom.formats.video import open_video

Arrays = dict[str, tuple[Any, ...]]
LIDAR_FILES, LIDAR_POINTS = 36, 120_000
PICTURES = 240


def write_lines(path: Path, count: int) -> None:
    """Write a drive of so many lines, in the order of time."""
    random = np.random.default_rng(0)
    written, tick = 0, 0
    with path.open("wb") as file:
        while written < count:
            lines = list(_lines_of_tick(tick, random))
            file.writelines(orjson.dumps(line, option=orjson.OPT_APPEND_NEWLINE) for line in lines)
            written, tick = written + len(lines), tick + 1


def _lines_of_tick(tick: int, random: np.random.Generator) -> list[dict[str, Any]]:
    seconds = 0.005 * tick + 1e-5 * random.random()
    lines: list[dict[str, Any]] = [
        {"sensor": {"type": sensor, "values": random.normal(size=3).tolist()}, "time": seconds}
        for sensor in ("accelerometer", "gyroscope")
    ]
    if tick % 2 == 0:
        position, turn = random.normal(size=3).tolist(), random.normal(size=4)
        orientation = dict(zip("xyzw", (turn / np.linalg.norm(turn)).tolist(), strict=True))
        pose = {"position": dict(zip("xyz", position, strict=True)), "orientation": orientation}
        lines.append({"groundTruth": pose, "time": seconds})
    if tick % 10 == 0:
        entries = [{"cameraInd": index, "time": seconds} for index in range(2)]
        lines.append({"frames": entries, "number": tick // 10, "time": seconds})
    if tick % 200 == 0:
        latitude, longitude, altitude = random.normal(size=3).tolist()
        fix = {"latitude": latitude, "longitude": longitude, "altitude": altitude, "accuracy": 4.0}
        lines.append({"gps": fix, "time": seconds})
    return lines


def read_plainly(path: Path) -> Arrays:
    """As one would write it in ten minutes: no check of any kind."""
    arrays: dict[str, Any] = {}
    with path.open("rb") as file:
        for text in file:
            line = orjson.loads(text)
            if "sensor" in line:
                sensor = line["sensor"]
                columns = arrays.get(sensor["type"])
                if columns is None:
                    columns = arrays[sensor["type"]] = (array("d"), array("d"))
                columns[0].append(line["time"])
                columns[1].extend(sensor["values"])
            elif "groundTruth" in line:
                pose = line["groundTruth"]
                place, turn = pose["position"], pose["orientation"]
                columns = arrays.setdefault("groundTruth", (array("d"), array("d")))
                columns[0].append(line["time"])
                columns[1].extend(
                    (place["x"], place["y"], place["z"], turn["x"], turn["y"], turn["z"], turn["w"])
                )
            elif "frames" in line:
                columns = arrays.setdefault("frames", (array("d"), array("q"), array("q"), array("d")))
                columns[0].append(line["time"])
                columns[1].append(line["number"])
                for entry in line["frames"]:
                    columns[2].append(entry["cameraInd"])
                    columns[3].append(entry["time"])
            else:
                fix = line["gps"]
                columns = arrays.setdefault("gps", (array("d"), array("d")))
                columns[0].append(line["time"])
                columns[1].extend(
                    (
                        fix["latitude"],
                        fix["longitude"],
                        fix["altitude"],
                        fix.get("accuracy", nan),
                        fix.get("verticalAccuracy", nan),
                    )
                )
    return arrays


def read_here(path: Path, processes: int) -> RecordingColumns:
    """As the package reads."""
    os.environ[PROCESSES] = str(processes)
    return read_lines(path, Ledger(lenient=False))


def check_equal(path: Path) -> None:
    """Refuse to compare sides that do different work."""
    theirs = read_plainly(path)
    for processes in (1, 2):
        ours = read_here(path, processes)
        streams = {**ours.sensors, "gps": ours.gnss}
        streams["groundTruth"] = ours.poses["groundTruth", "groundTruth"].samples
        assert streams.keys() | {"frames"} == theirs.keys()
        for name, stream in streams.items():
            np.testing.assert_array_equal(stream.seconds, theirs[name][0])
            np.testing.assert_array_equal(stream.values, theirs[name][1])
        assert ours.frames.seconds == theirs["frames"][0]
        assert ours.frames.numbers == theirs["frames"][1]


def size_of(columns: RecordingColumns) -> int:
    """The length of all arrays [bytes]."""
    frames = columns.frames
    arrays = [columns.log.codes, frames.numbers, frames.seconds, frames.lines, frames.offsets]
    for stream in columns.streams().values():
        arrays += [stream.seconds, stream.values]
    arrays += [poses.lines for poses in columns.poses.values()]
    for camera in frames.cameras.values():
        arrays += [camera.rows, camera.seconds, camera.parameters, camera.mounts, camera.missing]
    return sum(len(numbers) * numbers.itemsize for numbers in arrays)


def measure(sides: Mapping[str, Callable[[], object]], repetitions: int) -> dict[str, tuple[float, float]]:
    """Give the least seconds, and the least processor seconds of the busiest process, of each side."""
    least = dict.fromkeys(sides, (float("inf"), float("inf")))
    for _ in range(repetitions):
        for name, run in sides.items():
            begun, ours, theirs = time.perf_counter(), _busy(0), _busy(1)
            run()
            taken = time.perf_counter() - begun, max(_busy(0) - ours, _busy(1) - theirs)
            least[name] = (min(least[name][0], taken[0]), min(least[name][1], taken[1]))
    return least


def _busy(which: int) -> float:
    used = resource.getrusage((resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)[which])
    return used.ru_utime + used.ru_stime


def peak_ratio(path: Path, processes: int) -> float:
    """What reading allocates at most, for each byte of the arrays that it ends with."""
    tracemalloc.start()
    try:
        columns = read_here(path, processes)
        return tracemalloc.get_traced_memory()[1] / size_of(columns)
    finally:
        tracemalloc.stop()


def show(title: str, against: str, found: Mapping[str, tuple[float, float]]) -> None:
    print(title)
    wall, busy = found[against]
    for name, (seconds, processor) in found.items():
        print(
            f"  {name:28} {seconds:8.3f} s, ratio {wall / seconds:5.2f}; "
            f"processor {processor:8.3f} s, ratio {busy / processor:5.2f}"
        )


def measure_lines(folder: Path, given: argparse.Namespace) -> None:
    path = folder / "data.jsonl"
    write_lines(path, given.lines)
    check_equal(path)
    sides: dict[str, Callable[[], object]] = {
        "plain loop of orjson": lambda: read_plainly(path),
        "one process": lambda: read_here(path, 1),
        "two processes": lambda: read_here(path, 2),
    }
    title = f"lines: {given.lines:,} in {path.stat().st_size / 1e6:.0f} MB"
    show(title, "plain loop of orjson", measure(sides, given.repetitions))
    for processes in (1, 2):
        print(f"  peak with {processes}: {peak_ratio(path, processes):.2f} times the arrays")


def write_video(path: Path) -> None:
    """Write a textured picture with a little noise that moves."""
    random = np.random.default_rng(0)
    texture = np.kron(random.integers(0, 255, (60, 120, 3)), np.ones((40, 40, 1), np.int64))
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "20", "preset": "veryfast"})
        stream.width, stream.height, stream.pix_fmt = 1920, 1080, "yuv420p"
        for k in range(PICTURES):
            part = texture[5 * k : 5 * k + 1080, 8 * k : 8 * k + 1920]
            noisy = np.clip(part + random.integers(-6, 6, (1080, 1920, 1)), 0, 255).astype(np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(noisy, format="rgb24")))
        container.mux(stream.encode())


def decode_barely(path: Path, *, colours: bool = False, at_once: bool = False) -> int:
    """Decode all pictures, and throw them away."""
    count = 0
    with av.open(str(path)) as container:
        if at_once:
            container.streams.video[0].thread_type = "AUTO"
        for frame in container.decode(video=0):
            count += 1
            if colours:
                frame.to_ndarray(format="rgb24")
    return count


def read_pictures(path: Path) -> int:
    """Read all pictures here."""
    with open_video(path) as video:
        for k in range(video.count):
            video.rgb(k)
        return video.count


def measure_video(folder: Path, given: argparse.Namespace) -> None:
    path = folder / "data.mkv"
    write_video(path)
    sides: dict[str, Callable[[], object]] = {
        "PyAV, bare": lambda: decode_barely(path),
        "PyAV, with its colours": lambda: decode_barely(path, colours=True),
        "PyAV, bare, AUTO": lambda: decode_barely(path, at_once=True),
        "here": lambda: read_pictures(path),
    }
    show(f"video: {PICTURES} pictures of 1080p", "PyAV, bare", measure(sides, given.repetitions))


def write_lidar(folder: Path) -> list[Path]:
    """Write files of about 100 MB in all."""
    random = np.random.default_rng(0)
    paths = [folder / f"{k:06d}.bin" for k in range(LIDAR_FILES)]
    for k, path in enumerate(paths):
        records = np.zeros(LIDAR_POINTS, XYZIRT)
        for axis in "xyz":
            records[axis] = random.normal(size=LIDAR_POINTS)
        records["intensity"] = random.integers(0, 255, LIDAR_POINTS)
        records["ring"] = random.integers(0, 64, LIDAR_POINTS)
        records["timestamp"] = 0.1 * k + 1e-6 * np.arange(LIDAR_POINTS)
        path.write_bytes(records.tobytes())
    return paths


def read_fields(path: Path) -> None:
    """Read a sweep, and have all its fields made."""
    points = read_points(path)
    assert points.positions.flags.c_contiguous
    assert len(points.extras["file_seconds"]) == len(points)


def measure_lidar(folder: Path, given: argparse.Namespace) -> None:
    paths = write_lidar(folder)
    sides: dict[str, Callable[[], object]] = {
        "numpy.fromfile": lambda: [None for path in paths if np.fromfile(path, XYZIRT) is None],
        "here, records": lambda: [None for path in paths if read_points(path) is None],
        "here, all fields as arrays": lambda: [read_fields(path) for path in paths],
    }
    size = sum(path.stat().st_size for path in paths) / 1e6
    show(f"lidar: {size:.0f} MB in {len(paths)} files", "numpy.fromfile", measure(sides, given.repetitions))


PARTS: dict[str, Callable[[Path, argparse.Namespace], None]] = {
    "lines": measure_lines,
    "video": measure_video,
    "lidar": measure_lidar,
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}; all of them if none is named"
    )
    parser.add_argument("--lines", type=int, default=1_000_000)
    parser.add_argument("--repetitions", type=int, default=5)
    given = parser.parse_args()
    for name in given.parts or PARTS:
        with tempfile.TemporaryDirectory() as folder:
            PARTS[name](Path(folder), given)


if __name__ == "__main__":
    main()
