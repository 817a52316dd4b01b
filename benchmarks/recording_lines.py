"""The lines of recordings, read and written: a part of `benchmarks.recording`, which says what is compared."""

import argparse
import tracemalloc
from array import array
from collections.abc import Callable
from math import nan
from pathlib import Path
from shutil import rmtree
from typing import Any

import numpy as np
import orjson

import sceneloom
from benchmarks.sides import measure, show
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.recording.contents import RecordingColumns, read_lines
from sceneloom.scene import GnssSensor, ImuSensor

Arrays = dict[str, tuple[Any, ...]]


def write_lines(path: Path, count: int, *, images: bool = True) -> None:
    """Write a drive of so many lines, in the order of time."""
    random = np.random.default_rng(0)
    written, tick = 0, 0
    with path.open("wb") as file:
        while written < count:
            lines = [line for line in _lines_of_tick(tick, random) if images or "frames" not in line]
            file.writelines(orjson.dumps(line, option=orjson.OPT_APPEND_NEWLINE) for line in lines)
            written, tick = written + len(lines), tick + 1


def _lines_of_tick(tick: int, random: np.random.Generator) -> list[dict[str, Any]]:
    seconds = 0.005 * tick + 1e-5 * random.random()
    lines: list[dict[str, Any]] = [
        {"sensor": {"type": sensor, "values": random.normal(size=3).tolist()}, "time": seconds}
        for sensor in ("accelerometer", "gyroscope")
    ]
    if tick % 2 == 0:
        position, rotation = random.normal(size=3).tolist(), random.normal(size=4)
        orientation = dict(zip("xyzw", (rotation / np.linalg.norm(rotation)).tolist(), strict=True))
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
                location, rotation = pose["position"], pose["orientation"]
                columns = arrays.setdefault("groundTruth", (array("d"), array("d")))
                columns[0].append(line["time"])
                columns[1].extend(
                    (
                        location["x"],
                        location["y"],
                        location["z"],
                        rotation["x"],
                        rotation["y"],
                        rotation["z"],
                        rotation["w"],
                    )
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


def read_here(path: Path) -> RecordingColumns:
    """As the package reads."""
    return read_lines(path, Ledger(lenient=False))


def check_equal(path: Path) -> None:
    """Refuse to compare sides that do different work."""
    theirs = read_plainly(path)
    ours = read_here(path)
    streams = {**ours.sensors, "gps": ours.gnss}
    streams["groundTruth"] = ours.poses["groundTruth", "groundTruth"]
    assert streams.keys() | {"frames"} == theirs.keys()
    for name, stream in streams.items():
        np.testing.assert_array_equal(stream.seconds, theirs[name][0])
        np.testing.assert_array_equal(stream.values, theirs[name][1])
    assert ours.frames.seconds == theirs["frames"][0]
    assert ours.frames.numbers == theirs["frames"][1]


def size_of(columns: RecordingColumns) -> int:
    """The length of all arrays [bytes]."""
    frames = columns.frames
    arrays = [frames.numbers, frames.seconds, frames.lines, frames.offsets]
    for stream in columns.streams():
        arrays += [stream.seconds, stream.values, stream.lines]
    for camera in frames.cameras.values():
        arrays += [camera.rows, camera.seconds, camera.parameters, camera.mounts, camera.missing]
    return sum(len(numbers) * numbers.itemsize for numbers in arrays)


def peak_ratio(path: Path) -> float:
    """What reading allocates at most, for each byte of the arrays that it ends with."""
    tracemalloc.start()
    try:
        columns = read_here(path)
        return tracemalloc.get_traced_memory()[1] / size_of(columns)
    finally:
        tracemalloc.stop()


def measure_lines(folder: Path, given: argparse.Namespace) -> None:
    path = folder / "data.jsonl"
    write_lines(path, given.lines)
    check_equal(path)
    sides: dict[str, Callable[[], object]] = {
        "plain loop of orjson": lambda: read_plainly(path),
        "here": lambda: read_here(path),
    }
    title = f"lines: {given.lines:,} in {path.stat().st_size / 1e6:.0f} MB"
    show(title, "plain loop of orjson", measure(sides, given.repetitions))
    print(f"  peak: {peak_ratio(path):.2f} times the arrays")


def arrays_of(scene: sceneloom.Scene) -> dict[str, tuple[Any, Any]]:
    """The times and the numbers of each stream."""
    imu, gnss, truth = scene.sensor("imu"), scene.sensor("gnss"), scene.trajectories["groundTruth"]
    assert isinstance(imu, ImuSensor)
    assert isinstance(gnss, GnssSensor)
    fixes = np.column_stack([gnss.positions_lla, gnss.accuracies])
    rotations = np.column_stack([truth.positions, truth.quaternions_xyzw])
    streams = {name: (stream.file_seconds, stream.values) for name, stream in imu.streams.items()}
    return {**streams, "groundTruth": (truth.file_seconds, rotations), "gps": (gnss.file_seconds, fixes)}


def write_plainly(scene: sceneloom.Scene, path: Path) -> None:
    """As one would write it in ten minutes: arrays in the order of time, a `dumps` for each line."""
    names, times, rows = [], [], []
    for name, stream in arrays_of(scene).items():
        names.append(name)
        times.append(stream[0])
        rows.append(stream[1].tolist())
    order = np.argsort(np.concatenate(times), kind="stable")
    which = np.repeat(np.arange(len(names)), [len(stream) for stream in times])[order].tolist()
    location = np.concatenate([np.arange(len(stream)) for stream in times])[order].tolist()
    seconds = [stream.tolist() for stream in times]
    with path.open("wb") as file:
        for stream, row in zip(which, location, strict=True):
            name, values, time_s = names[stream], rows[stream][row], seconds[stream][row]
            line: dict[str, Any]
            if name == "groundTruth":
                position = dict(zip("xyz", values[:3], strict=True))
                orientation = dict(zip("xyzw", values[3:], strict=True))
                line = {name: {"position": position, "orientation": orientation}, "time": time_s}
            elif name == "gps":
                latitude, longitude, altitude, accuracy = values
                fix = {"latitude": latitude, "longitude": longitude, "altitude": altitude}
                line = {name: {**fix, "accuracy": accuracy}, "time": time_s}
            else:
                line = {"sensor": {"type": name, "values": values}, "time": time_s}
            file.write(orjson.dumps(line, option=orjson.OPT_APPEND_NEWLINE))


def measure_writing(folder: Path, given: argparse.Namespace) -> None:
    drive, ours, theirs = folder / "drive", folder / "ours", folder / "theirs.jsonl"
    drive.mkdir()
    write_lines(drive / "data.jsonl", given.lines, images=False)
    scene = sceneloom.open(drive)

    def write_here() -> None:
        rmtree(ours, ignore_errors=True)
        sceneloom.write(scene, ours, format="recording")

    sides: dict[str, Callable[[], object]] = {
        "plain loop of orjson": lambda: write_plainly(scene, theirs),
        "here": write_here,
    }
    found = measure(sides, given.repetitions)
    texts = [sorted(path.read_bytes().splitlines()) for path in (theirs, ours / "data.jsonl")]
    assert list(map(orjson.loads, texts[0])) == list(map(orjson.loads, texts[1]))
    show(f"writing: {len(texts[0]):,} lines", "plain loop of orjson", found)
    for name, (_, processor) in found.items():
        print(f"  {name:28} {len(texts[0]) / processor / 1e6:8.2f} million lines a second of a processor")
