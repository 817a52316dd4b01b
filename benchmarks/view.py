"""How fast a drive is saved for the viewer, and in how much memory.

Run with `python -m benchmarks.view [--seconds 60] [--keep DIR]`. A simulated drive (120,000 rays a sweep at 10 Hz, six
cameras of 1280x720 pixels around the ego, IMU, GNSS, boxes) is written as a scene file, whose images are JPEG files,
and as a recording, whose images are H.264: what is rendered lasts 2 s and comes again and again, the ego moves on. A
process of its own saves each: seconds of the wall and of the processor a second of the drive, the latter below 1; and
the most memory that it holds, below 1000 MB. Pages of files that are mapped are reported beside it: the system takes
them back when it needs them.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

RENDERED = 20
PERIOD_NS = 100_000_000


def make_drive(folder: Path, seconds: float) -> tuple[Path, Path]:
    """Write the drive in both forms, unless it is there already."""
    import sceneloom
    from sceneloom.cameras.camera import Camera
    from sceneloom.simulate import CameraSpec, LidarSpec, TrafficSpec, camera_mount, simulate_street

    scene_file, recording = folder / "drive.sfs", folder / "recording"
    if scene_file.exists() and recording.exists():
        return scene_file, recording
    camera_model = Camera("pinhole", 1280, 720, 700.0, 700.0, 639.5, 359.5)
    cameras = [CameraSpec(camera_model, camera_mount(yaw_deg=60.0 * k)) for k in range(6)]
    lidar = LidarSpec(steps=1875)
    drawn = simulate_street(3, frames=RENDERED, lidar=lidar, cameras=cameras, traffic=TrafficSpec())
    count = round(seconds * 10)
    frame = LidarSpec(beams=1, steps=4)
    driven = simulate_street(3, frames=count, lidar=frame, cameras=cameras, traffic=TrafficSpec())
    scene = driven.scene
    sensors = [repeated(sensor, drawn.scene) for sensor in scene.sensors]
    long = replace(scene, sensors=tuple(sensors))
    sceneloom.write(long, scene_file)
    sceneloom.write(long, recording)
    return scene_file, recording


class Repeated:
    """Frames of a short drive under the timestamps of a long one; rendered once."""

    def __init__(self, frames, timestamps_ns) -> None:
        self.frames, self.timestamps_ns, self.kept = frames, timestamps_ns, {}

    def __call__(self, k: int):
        source = k % RENDERED
        if source not in self.kept:
            frame = self.frames[source]
            self.kept[source] = frame.loaded() if hasattr(frame, "loaded") else frame
        return self.timestamped(self.kept[source], int(self.timestamps_ns[k]))

    @staticmethod
    def timestamped(frame, time_ns: int):
        moved = replace(frame, timestamp_ns=time_ns)
        points = getattr(frame, "points", None)
        if points is None or points.timestamps_ns is None:
            return moved
        times = points.timestamps_ns - frame.timestamp_ns + time_ns
        return replace(moved, points=replace(points, timestamps_ns=times))


def repeated(sensor, drawn):
    """The sensor of the long drive with what the short one shows."""
    from sceneloom.scene import CameraSensor, LazyFrames, LidarSensor

    if isinstance(sensor, CameraSensor):
        times_ns = sensor.images.timestamps_ns
        frames = drawn.sensor(sensor.id).images
        return replace(sensor, images=LazyFrames(times_ns, Repeated(frames, times_ns)))
    if isinstance(sensor, LidarSensor):
        times_ns = sensor.frames.timestamps_ns
        frames = drawn.sensor(sensor.id).frames
        return replace(sensor, frames=LazyFrames(times_ns, Repeated(frames, times_ns)))
    return sensor


class Meter:
    """Notes how much memory this process holds after each frame [MB]: its own, and pages of files."""

    def __init__(self) -> None:
        self.own, self.mapped = 0.0, 0.0

    def note(self, _done: int = 0, _total: int = 0) -> None:
        """Take one reading."""
        status = Path("/proc/self/status").read_text()
        self.own = max(self.own, megabytes(status, "RssAnon"))
        self.mapped = max(self.mapped, megabytes(status, "RssFile"))


def megabytes(status: str, name: str) -> float:
    """One line of a process's status [MB]."""
    return float(status.split(f"{name}:")[1].split(maxsplit=1)[0]) * 1024 / 1e6


def save(drive: Path, target: Path) -> dict[str, float]:
    """Save a drive, the second time without what is compiled and imported first."""
    from sceneloom.view import ViewSettings, save_view

    save_view([drive], target, settings=ViewSettings(stop=0.3), overwrite=True)
    meter = Meter()
    wall, processor = time.perf_counter(), time.process_time()
    report = save_view([drive], target, overwrite=True, progress=meter.note)
    lasted = report.drives[0].seconds
    return {
        "seconds": lasted,
        "wall": (time.perf_counter() - wall) / lasted,
        "processor": (time.process_time() - processor) / lasted,
        "own_mb": meter.own,
        "mapped_mb": meter.mapped,
        "size_mb": report.size_bytes / 1e6,
    }


def main() -> None:
    """Measure both forms, each in a process of its own."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=40.0)
    parser.add_argument("--keep", type=Path, help="folder of the drive, which is made there unless it is there")
    parser.add_argument("--one", type=Path, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        if chosen.one is not None:
            print(json.dumps(save(chosen.one, Path(scratch) / "drive.rrd")))
            return
        folder = chosen.keep or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        for drive in make_drive(folder, chosen.seconds):
            words = [sys.executable, "-m", "benchmarks.view", "--one", str(drive)]
            done = subprocess.run(words, capture_output=True, text=True, check=True)
            reported = json.loads(done.stdout)
            kept = reported["processor"] < 1.0 and reported["own_mb"] < 1000
            print(
                f"{drive.name:10s} {reported['seconds']:5.1f} s: {reported['wall']:.2f} s of the wall and "
                f"{reported['processor']:.2f} s of the processor a second of the drive, {reported['own_mb']:.0f} MB "
                f"and "
                f"{reported['mapped_mb']:.0f} MB of mapped files, file {reported['size_mb']:.0f} MB: "
                f"{'kept' if kept else 'MISSED'}"
            )


if __name__ == "__main__":
    main()
