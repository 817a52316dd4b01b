"""How often the check of a calibration is right: windows of drives, as they are and with injected errors.

python -m benchmarks.calibration_health [--data ../shared/data] [--sets kitti,single,simulated] [--seeds 302 310]
    [--every 3] [--faults 0]

Sets: windows of 10 and 20 frames of `recordings/kitti_drive_40` that overlap, frames of `real/kitti_object` and
`recordings/pandaset` by themselves, and windows of 10 frames of simulated drives. Each window is checked as it is, and
every so many with a camera rotated by 0.5 degrees about, and shifted by 10 cm along, a random direction. Flagged means
drifting or wrong; intervals are those of Clopper and Pearson at 95 %. `--faults N`: N simulated drives with faults of
each kind besides.
"""

import argparse
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.stats import binomtest

import sceneloom
from sceneloom.calibrate.frames import CalibrationFrame, calibration_frames
from sceneloom.calibrate.health import CalibrationHealth, Verdict, check_frames
from sceneloom.calibrate.measures import COUNT, Change
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.simulate import Faults, SensorFaults, inject, simulate_street

Frames = tuple[CalibrationFrame, ...]
FLAGGED = (Verdict.DRIFTING, Verdict.WRONG)
INJECTED = {"0.5 deg": (np.radians(0.5), slice(0, 3)), "10 cm": (0.1, slice(3, 6))}

FAULTS = {
    "nothing": SensorFaults(),
    "0.5 deg": SensorFaults(rotation_deg=(0.3, -0.3, 0.26)),
    "1 deg": SensorFaults(rotation_deg=(-0.6, 0.6, 0.53)),
    "5 deg": SensorFaults(rotation_deg=(3.0, -4.0, 0.0)),
    "upside down": SensorFaults(rotation_deg=(0.0, 0.0, 180.0)),
    "40 cm": SensorFaults(shift=(0.3, 0.1, -0.25)),
    "focal length 2 %": SensorFaults(focal_scale=1.02),
    "focal length 5 %": SensorFaults(focal_scale=1.05),
    "50 ms late": SensorFaults(time_offset_ns=50_000_000),
    "100 ms late": SensorFaults(time_offset_ns=100_000_000),
    "2 s late": SensorFaults(time_offset_ns=2_000_000_000),
    "black": SensorFaults(blind=((0, 10**13),)),
}


def moved(frames: Frames, numbers: np.ndarray) -> Frames:
    """Frames whose stated camera is rotated and shifted, by the numbers of a change."""
    error = RigidTransform.nearest(Change.of(numbers).camera_from_lidar(np.eye(4)))[0]
    return tuple(replace(frame, camera_from_lidar=error @ frame.camera_from_lidar) for frame in frames)


def row(name: str, healths: list[CalibrationHealth]) -> None:
    """Print how often each verdict was given."""
    counts = Counter(health.verdict for health in healths)
    print(f"{name:32s} " + "  ".join(f"{verdict} {counts[verdict]:3d}" for verdict in Verdict), flush=True)


def share(flagged: int, count: int) -> str:
    """A share, and the interval of it."""
    low, high = binomtest(flagged, count).proportion_ci(method="exact")
    return f"{flagged} of {count} flagged [{100 * low:.0f}, {100 * high:.0f}] %"


def windows(name: str, drives: Iterable[tuple[str, Frames]], every: int) -> None:
    """Check windows as they are, every so many with injected errors, too."""
    found: dict[str, list[CalibrationHealth]] = {"as stated": [], **{kind: [] for kind in INJECTED}}
    left: dict[str, list[float]] = {kind: [] for kind in INJECTED}
    for number, (window, frames) in enumerate(drives):
        for kind, healths in found.items():
            numbers = np.zeros(COUNT)
            if kind in INJECTED:
                if number % every:
                    continue
                size, part = INJECTED[kind]
                direction = np.random.default_rng([number, len(frames), len(kind)]).normal(size=3)
                numbers[part] = size * direction / np.linalg.norm(direction)
            health = check_frames(moved(frames, numbers))
            healths.append(health)
            items = [item for item in health.items if item.values]
            cells = "  ".join(f"{i.name} {i.verdict} {np.round(i.values, 3)} ± {np.round(i.sigmas, 3)}" for i in items)
            print(f"{window:24s} {kind:10s} {health.verdict:16s} {cells}", flush=True)
            if kind in INJECTED and health.verdict in FLAGGED:
                there = (np.array(health.change) + numbers)[part]
                left[kind].append(float(np.linalg.norm(there)))
    for kind, healths in found.items():
        if healths:
            row(f"{name}: {kind}", healths)
            flagged = sum(health.verdict in FLAGGED for health in healths)
            median = f"; median left {np.median(left[kind]):.4f} rad or m" if left.get(kind) else ""
            print(f"{name}: {kind}: {share(flagged, len(healths))}{median}", flush=True)


def kitti_windows(path: Path) -> Iterator[tuple[str, Frames]]:
    """Windows of a real drive."""
    with sceneloom.open(path) as scene:
        frames = calibration_frames(scene, most=40)
    for size, step in ((10, 2), (20, 10)):
        for start in range(0, len(frames) - size + 1, step):
            yield f"{path.name} {start}+{size}", frames[start : start + size]


def single_views(data: Path) -> Iterator[tuple[str, Frames]]:
    """Frames of real data that are alone, or of which there are a few."""
    with sceneloom.open(data / "recordings" / "pandaset") as scene:
        for camera in scene.cameras:
            yield f"pandaset {camera.id}", calibration_frames(scene, camera.id)
    with sceneloom.open(data / "real" / "kitti_object") as scene:
        for frame in calibration_frames(scene, most=10):
            yield f"kitti_object {frame.index}", (frame,)


def simulated_windows(seeds: range) -> Iterator[tuple[str, Frames]]:
    """Windows of simulated drives."""
    for seed in seeds:
        frames = calibration_frames(simulate_street(seed, frames=24).scene, most=24)
        for start in (0, 14):
            yield f"simulated {seed} {start}+10", frames[start : start + 10]


def simulated_drives(seeds: range) -> None:
    """Plant faults of the camera in simulated drives."""
    drives = [simulate_street(seed, frames=60) for seed in seeds]
    for name, fault in FAULTS.items():
        healths = []
        for drive in drives:
            scene = inject(drive, Faults({"camera0": fault})).scene if fault.named else drive.scene
            healths.append(check_frames(calibration_frames(scene, most=8)))
        row(f"simulated: {name}", healths)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--sets", default="kitti,single,simulated")
    parser.add_argument("--seeds", type=int, nargs=2, default=(302, 310))
    parser.add_argument("--every", type=int, default=3)
    parser.add_argument("--faults", type=int, default=0)
    options = parser.parse_args()
    drives = {
        "kitti": lambda: kitti_windows(options.data / "recordings" / "kitti_drive_40"),
        "single": lambda: single_views(options.data),
        "simulated": lambda: simulated_windows(range(*options.seeds)),
    }
    for name in options.sets.split(","):
        windows(name, drives[name](), options.every)
    if options.faults:
        simulated_drives(range(60, 60 + options.faults))


if __name__ == "__main__":
    main()
