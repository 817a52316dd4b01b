"""How fast `data.jsonl` becomes columns: against a plain loop of `json.loads`, with the same columns as its result.

Run with `python -m benchmarks.recording_lines [--minutes 10]`. The recording has an accelerometer, a gyroscope and a
thermometer at 200 Hz, poses at 100 Hz and fixes at 1 Hz, all numbers with the digits that a float64 needs. The
variants take turns; figures are medians, and the peak is what reading allocates at most.
"""

import argparse
import json
import tempfile
import time
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from sceneloom.formats.ledger import Ledger
from sceneloom.formats.recording.lines import read_lines

Columns = dict[str, tuple[np.ndarray, np.ndarray]]


def make_lines(minutes: float) -> Iterator[str]:
    """The lines of a drive, in the order of time."""
    random = np.random.default_rng(0)
    for tick in range(round(minutes * 60 * 200)):
        time_s = 0.005 * tick + 1e-5 * random.random()
        for sensor in ("accelerometer", "gyroscope"):
            yield _line(
                {"sensor": {"type": sensor, "values": random.normal(size=3).tolist()}, "time": time_s}
            )
        yield _line({"sensor": {"type": "imuTemperature", "values": [292.8961]}, "time": time_s})
        if tick % 2 == 0:
            position, turn = random.normal(size=3), random.normal(size=4)
            pose = {
                "position": dict(zip("xyz", position.tolist(), strict=True)),
                "orientation": dict(zip("xyzw", (turn / np.linalg.norm(turn)).tolist(), strict=True)),
            }
            yield _line({"groundTruth": pose, "time": time_s})
        if tick % 200 == 0:
            latitude, longitude, altitude = random.normal(size=3).tolist()
            fix = {"latitude": latitude, "longitude": longitude, "altitude": altitude, "accuracy": 4.0}
            yield _line({"gps": fix, "time": time_s})


def _line(content: dict[str, object]) -> str:
    return json.dumps(content, separators=(",", ":")) + "\n"


def read_here(path: Path) -> Columns:
    """As the package reads."""
    columns = read_lines(path, Ledger(lenient=False))
    streams = {
        **columns.sensors,
        "gps": columns.gnss,
        "groundTruth": columns.poses["groundTruth", "groundTruth"].samples,
    }
    found = {name: stream.by_time() for name, stream in streams.items()}
    return {name: (stream.timestamps_ns, stream.values) for name, stream in found.items()}


def read_with_json(path: Path) -> Columns:
    """As one would write it in ten minutes: no check of any kind."""
    streams: dict[str, tuple[list[float], list[list[float]]]] = {}
    with path.open() as file:
        for text in file:
            line = json.loads(text)
            if "sensor" in line:
                name, values = line["sensor"]["type"], line["sensor"]["values"]
            elif "gps" in line:
                fix = line["gps"]
                name = "gps"
                values = [fix["latitude"], fix["longitude"], fix["altitude"], fix.get("accuracy"), None]
            else:
                name, pose = "groundTruth", line["groundTruth"]
                values = [
                    *(pose["position"][axis] for axis in "xyz"),
                    *(pose["orientation"][axis] for axis in "xyzw"),
                ]
            times, rows = streams.setdefault(name, ([], []))
            times.append(line["time"])
            rows.append(values)
    return {
        name: (np.rint(np.array(times) * 1e9).astype(np.int64), np.array(rows, np.float64))
        for name, (times, rows) in streams.items()
    }


VARIANTS: dict[str, Callable[[Path], Columns]] = {"here": read_here, "json": read_with_json}


def check_equal(path: Path) -> None:
    """Refuse to compare variants that do different work."""
    ours, theirs = read_here(path), read_with_json(path)
    assert ours.keys() == theirs.keys()
    for name in ours:
        np.testing.assert_array_equal(ours[name][0], theirs[name][0])
        np.testing.assert_array_equal(ours[name][1], theirs[name][1])


def peak_memory(path: Path, read: Callable[[Path], Columns]) -> float:
    """What reading allocates at most at any one time [MB]."""
    tracemalloc.start()
    try:
        read(path)
        return tracemalloc.get_traced_memory()[1] / 1e6
    finally:
        tracemalloc.stop()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--repetitions", type=int, default=5)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "data.jsonl"
        with path.open("w") as file:
            file.writelines(make_lines(given.minutes))
        check_equal(path)
        seconds: dict[str, list[float]] = {name: [] for name in VARIANTS}
        for _ in range(given.repetitions):
            for name, read in VARIANTS.items():
                begun = time.perf_counter()
                read(path)
                seconds[name].append(time.perf_counter() - begun)
        size = path.stat().st_size / 1e6
        medians = {name: float(np.median(taken)) for name, taken in seconds.items()}
        print(f"{size:.0f} MB of lines")
        for name, median in medians.items():
            print(
                f"{name:6} {size / median:6.0f} MB/s {peak_memory(path, VARIANTS[name]):6.0f} MB at the peak"
            )
        print(f"ratio  {medians['here'] / medians['json']:6.2f}")


if __name__ == "__main__":
    main()
