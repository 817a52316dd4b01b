"""How long `sceneloom validate --quick` takes on an hour's recording, against reading its lines alone.

Run with `python -m benchmarks.recording_validation [--minutes 60]`. The recording has an accelerometer and a gyroscope
at 100 Hz each, images at 20 Hz in a video that is counted and not decoded, poses at 10 Hz and fixes at 1 Hz: an hour
is 720 000 lines of the IMU and 72 000 of images. The variants take rotates; figures are medians.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import av
import numpy as np

from sceneloom import validate
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.recording.contents import read_lines

Line = dict[str, object]
IMU_HZ = 100
IMAGES_EVERY, POSES_EVERY, FIXES_EVERY = 5, 10, 100
TARGET = 3.0
CAMERA_MODEL = {
    "model": "pinhole",
    "focalLengthX": 20.0,
    "focalLengthY": 20.0,
    "principalPointX": 15.5,
    "principalPointY": 7.5,
    "imageWidth": 32,
    "imageHeight": 16,
    "imuToCamera": np.eye(4).tolist(),
}


def make_lines(minutes: float) -> Iterator[Line]:
    """A sound drive straight ahead at 10 m/s, in the order of time."""
    random = np.random.default_rng(0)
    for tick in range(round(minutes * 60 * IMU_HZ)):
        time_s = tick / IMU_HZ
        pull, rotation = random.normal((0.0, 0.0, 9.81), 0.05), random.normal(scale=0.01, size=3)
        yield {"sensor": {"type": "accelerometer", "values": pull.tolist()}, "time": time_s}
        yield {"sensor": {"type": "gyroscope", "values": rotation.tolist()}, "time": time_s}
        if tick % IMAGES_EVERY == 0:
            image = time_s + 0.0037
            entry = {"cameraInd": 0, "time": image}
            yield {"frames": [entry], "number": tick // IMAGES_EVERY, "time": image}
        if tick % POSES_EVERY == 0:
            position = {"x": 10.0 * time_s, "y": 0.0, "z": 0.0}
            rotated = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
            yield {"groundTruth": {"position": position, "orientation": rotated}, "time": time_s + 0.004}
        if tick % FIXES_EVERY == 0:
            north = (0.5 * random.normal() + 10.0 * time_s) / 111_400
            fix = {"latitude": 50.0 + north, "longitude": 25.0, "altitude": 10.0, "accuracy": 0.5}
            yield {"gps": fix, "time": time_s + 0.005}


def make_recording(folder: Path, minutes: float) -> Path:
    """Write the lines, the calibration, and a video that shows one image again and again."""
    folder.mkdir()
    with (folder / "data.jsonl").open("w") as file:
        for line in make_lines(minutes):
            file.write(json.dumps(line, separators=(",", ":")) + "\n")
    (folder / "calibration.json").write_text(json.dumps({"cameras": [CAMERA_MODEL]}))
    with av.open(str(folder / "data.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=IMU_HZ // IMAGES_EVERY, options={"threads": "1"})
        stream.width, stream.height, stream.pix_fmt = 32, 16, "bgr0"
        grey = av.VideoFrame.from_ndarray(np.full((16, 32, 3), 90, np.uint8), format="rgb24")
        [packet] = [*stream.encode(grey.reformat(format="bgr0")), *stream.encode()]
        for number in range(round(minutes * 60 * IMU_HZ / IMAGES_EVERY)):
            again = av.Packet(bytes(packet))
            again.stream, again.pts, again.dts = stream, number, number
            again.time_base, again.is_keyframe = packet.time_base, True
            container.mux(again)
    return folder


def parse(folder: Path) -> None:
    """Lines to columns, and nothing else."""
    read_lines(folder / "data.jsonl", Ledger(lenient=False))


def check(folder: Path) -> None:
    """All rules but those that look into images."""
    report = validate(folder, frames=False)
    assert report.passed, report.findings[:5]


VARIANTS: dict[str, Callable[[Path], None]] = {"parse": parse, "validate": check}


def measure(folder: Path, repetitions: int) -> dict[str, float]:
    """The median time of each variant [s]."""
    taken: dict[str, list[float]] = {name: [] for name in VARIANTS}
    for _ in range(repetitions):
        for name, run in VARIANTS.items():
            begun = time.perf_counter()
            run(folder)
            taken[name].append(time.perf_counter() - begun)
    return {name: float(np.median(seconds)) for name, seconds in taken.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--repetitions", type=int, default=5)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = make_recording(Path(scratch) / "drive", given.minutes)
        medians = measure(folder, given.repetitions)
    for name, median in medians.items():
        print(f"{name:8} {median:6.2f} s")
    print(f"ratio    {medians['validate'] / medians['parse']:6.2f} (at most {TARGET:g})")


if __name__ == "__main__":
    main()
