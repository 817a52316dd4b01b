"""How fast, and in how much memory, a long drive is fused.

Run with `python -m benchmarks.pipeline [--frames 600] [--keep DIR]`. A simulated drive (120k rays a sweep, one
1242x375 camera as H.264, ground-truth trajectory) is written once as a recording. Then two processes fuse it:
ours, `sceneloom.fuse` to a scene file; and the peer, the loop that one writes with NumPy, SciPy and OpenCV: decode,
deskew by the points' times, project, z-buffer (no windowed visibility: so it does less), colours, depth image,
arrays to a file. Figures: sweeps a second after the first 20, and the ratio; the peak memory, and how much it
grows from sweep 100 to the end.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

WARM_UP = 20
SETTLED = 100


def make_drive(folder: Path, frames: int) -> None:
    """Write the simulated recording, unless it is there already."""
    if folder.exists():
        return
    import sceneloom
    from sceneloom.simulate import LidarSpec, simulate_street

    drive = simulate_street(frames=frames, lidar=LidarSpec(steps=1875))  # 64 beams: 120,000 rays a sweep
    sceneloom.write(drive.scene, folder)


def peak_megabytes() -> float:
    """The most memory that this process has held; `getrusage` would count what its parent held before the start."""
    status = Path("/proc/self/status").read_text()
    return float(status.split("VmHWM:")[1].split()[0]) * 1024 / 1e6


class Meter:
    """Notes the time and the memory after each sweep."""

    def __init__(self) -> None:
        self.seconds: list[float] = []
        self.megabytes: list[float] = []

    def note(self, _done: int = 0, _total: int = 0) -> None:
        """Take one reading."""
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        self.seconds.append(time.perf_counter())
        self.megabytes.append(pages * resource.getpagesize() / 1e6)

    def figures(self) -> dict[str, float]:
        """Sweeps a second after the warm-up, peak memory [MB], growth of the memory since it settled [%]."""
        settled = min(SETTLED, len(self.megabytes) // 2)
        early = float(np.mean(self.megabytes[settled - 10 : settled + 10]))
        late = float(np.mean(self.megabytes[-20:]))
        return {
            "fps": (len(self.seconds) - 1 - WARM_UP) / (self.seconds[-1] - self.seconds[WARM_UP]),
            "peak_mb": peak_megabytes(),
            "growth_percent": 100 * (late / early - 1),
        }


def fuse_ours(recording: Path, target: Path) -> dict[str, float]:
    """The main job."""
    import sceneloom

    meter = Meter()
    with sceneloom.open(recording) as scene:
        sceneloom.fuse(scene, target, progress=meter.note)
    return meter.figures()


def fuse_peer(recording: Path, target: Path) -> dict[str, float]:
    """The same work, written with the usual libraries."""
    import cv2
    from scipy.spatial.transform import Rotation, Slerp

    record = np.dtype([("p", "<f4", 3), ("i", "u1"), ("r", "<u2"), ("t", "<f8")])
    lines = [json.loads(line) for line in (recording / "data.jsonl").read_text().splitlines()]
    calibration = json.loads((recording / "calibration.json").read_text())
    camera_model = calibration["cameras"][0]
    camera_from_ego = np.array(camera_model["imuToCamera"])
    ego_from_lidar = np.linalg.inv(np.array(calibration["lidars"][0]["imuToLidar"]))
    matrix = np.array(
        [
            [camera_model["focalLengthX"], 0, camera_model["principalPointX"]],
            [0, camera_model["focalLengthY"], camera_model["principalPointY"]],
            [0, 0, 1],
        ]
    )
    poses = [line for line in lines if "groundTruth" in line]
    times = np.array([line["time"] for line in poses])
    locations = np.array([[line["groundTruth"]["position"][k] for k in "xyz"] for line in poses])
    rotations = Slerp(
        times, Rotation.from_quat([[line["groundTruth"]["orientation"][k] for k in "xyzw"] for line in poses])
    )
    timestamps = [line["time"] for line in lines if "frames" in line]
    video, shown, image = cv2.VideoCapture(str(recording / "data.mkv")), -1, None
    meter = Meter()
    with target.open("wb") as out:
        for line in (line for line in lines if "lidar" in line):
            cloud = np.fromfile(recording / line["lidar"]["dataFile"], record)
            at = np.clip(cloud["t"], times[0], times[-1])
            ego = cloud["p"] @ ego_from_lidar[:3, :3].T + ego_from_lidar[:3, 3]
            world = rotations(at).apply(ego) + np.stack(
                [np.interp(at, times, locations[:, k]) for k in range(3)], axis=1
            )
            nearest = int(np.argmin(np.abs(np.array(timestamps) - np.median(cloud["t"]))))
            while shown < nearest:
                shown, image = shown + 1, video.read()[1]
            when = np.clip(timestamps[nearest], times[0], times[-1])
            location = np.array([np.interp(when, times, locations[:, k]) for k in range(3)])
            on_ego = rotations(when).inv().apply(world - location)
            points = on_ego @ camera_from_ego[:3, :3].T + camera_from_ego[:3, 3]
            front = np.flatnonzero(points[:, 2] > 0.1)
            pixels = cv2.projectPoints(points[front], np.zeros(3), np.zeros(3), matrix, None)[0].reshape(-1, 2)
            height, width = image.shape[:2]
            columns, rows = np.rint(pixels).astype(int).T
            inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
            columns, rows, front = columns[inside], rows[inside], front[inside]
            depth = np.full((height, width), np.inf, np.float32)
            np.minimum.at(depth, (rows, columns), points[front, 2].astype(np.float32))
            colors = np.full((len(cloud), 3), 255, np.uint8)
            colors[front] = image[rows, columns, ::-1]
            for array in (world.astype(np.float32), colors, cloud["i"], (cloud["t"] * 1e6).astype(np.uint32)):
                out.write(np.ascontiguousarray(array))
            meter.note()
    return meter.figures()


def in_own_process(role: str, recording: Path, target: Path) -> dict[str, float]:
    """Run one side alone, so that its memory is its own."""
    command = [sys.executable, "-m", "benchmarks.pipeline", "--role", role, str(recording), str(target)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout)


def main() -> None:
    """Make the drive, run both sides, print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--keep", type=Path, help="keep the drive there for the next time")
    parser.add_argument("--role", choices=["ours", "peer"], help=argparse.SUPPRESS)
    parser.add_argument("paths", nargs="*", type=Path, help=argparse.SUPPRESS)
    stated = parser.parse_args()
    if stated.role:
        print(json.dumps({"ours": fuse_ours, "peer": fuse_peer}[stated.role](*stated.paths)))
        return
    with tempfile.TemporaryDirectory() as location:
        folder = Path(location)
        if stated.keep:
            stated.keep.mkdir(parents=True, exist_ok=True)
        recording = (stated.keep or folder) / f"drive{stated.frames}"
        make_drive(recording, stated.frames)
        ours = in_own_process("ours", recording, folder / "ours.sfs")
        peer = in_own_process("peer", recording, folder / "peer.bin")
    print(f"{stated.frames} sweeps of 120k rays, one 1242x375 camera")
    for name, side in (("ours", ours), ("NumPy + SciPy + OpenCV loop", peer)):
        print(
            f"{name:28} {side['fps']:6.1f} sweeps a second, peak {side['peak_mb']:6.0f} MB, "
            f"growth since sweep {SETTLED} {side['growth_percent']:+.1f} %"
        )
    print(f"ratio ours / peer            {ours['fps'] / peer['fps']:6.2f}")
    print("limits: at least 15 sweeps a second, at most 600 MB, at most 5 %")


if __name__ == "__main__":
    main()
