"""How often the check of a calibration is right: injected rotations on a real drive, injected faults on simulated ones.

python -m benchmarks.calibration_health [--data ../shared/data] [--rotations 4] [--most 8] [--seeds 2]
"""

import argparse
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

import sceneloom
from sceneloom.calibrate.frames import CalibrationFrame, calibration_frames
from sceneloom.calibrate.health import CalibrationHealth, Verdict, check_frames
from sceneloom.calibrate.measures import Change
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.simulate import Faults, SensorFaults, inject, simulate_street

Frames = tuple[CalibrationFrame, ...]

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


def rotated(frames: Frames, rotation_deg: np.ndarray) -> Frames:
    """Frames whose stated camera is rotated."""
    error = RigidTransform.nearest(Change.rotation(np.radians(rotation_deg)).camera_from_lidar(np.eye(4)))[0]
    return tuple(replace(frame, camera_from_lidar=error @ frame.camera_from_lidar) for frame in frames)


def row(name: str, healths: list[CalibrationHealth], errors: list[float] | None = None) -> None:
    """Print how often each verdict was given."""
    counts = Counter(health.verdict for health in healths)
    cells = "  ".join(f"{verdict} {counts[verdict]:3d}" for verdict in Verdict)
    found = f"  median error of the rotation {np.median(errors):.2f} deg" if errors else ""
    print(f"{name:32s} {cells}{found}", flush=True)


def rotation_error(health: CalibrationHealth, rotation_deg: np.ndarray) -> float:
    """How far the rotation that was found is from undoing the injected one [deg]."""
    return float(np.linalg.norm(np.degrees(health.change[:3]) + rotation_deg))


def real_drive(path: Path, rotations: int, most: int) -> None:
    """Plant rotations about random axes in a real drive."""
    with sceneloom.open(path) as scene:
        frames = calibration_frames(scene, most=most)
    generator = np.random.default_rng(0)
    row(f"{path.name} as stated", [check_frames(frames)])
    for size in (1.0, 0.5):
        healths, errors = [], []
        for _ in range(rotations):
            axis = generator.normal(size=3)
            rotation = size * axis / np.linalg.norm(axis)
            healths.append(check_frames(rotated(frames, rotation)))
            errors.append(rotation_error(healths[-1], rotation))
        row(f"{path.name} rotated by {size:g} deg", healths, errors)


def simulated_drives(seeds: range) -> None:
    """Plant faults of the camera in simulated drives."""
    drives = [simulate_street(seed, frames=60) for seed in seeds]
    for name, fault in FAULTS.items():
        healths = []
        for drive in drives:
            scene = inject(drive, Faults({"camera0": fault})).scene if fault.named else drive.scene
            healths.append(check_frames(calibration_frames(scene, most=8)))
        row(f"simulated: {name}", healths)


def stated(path: Path) -> None:
    """Check every camera of a real drive as it is stated."""
    with sceneloom.open(path) as scene:
        for camera in scene.cameras:
            row(f"{path.name} {camera.id} as stated", [check_frames(calibration_frames(scene, camera.id))])


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--rotations", type=int, default=4)
    parser.add_argument("--most", type=int, default=8)
    parser.add_argument("--seeds", type=int, default=2)
    options = parser.parse_args()
    recordings = options.data / "recordings"
    if recordings.is_dir():
        real_drive(recordings / "kitti_drive", options.rotations, options.most)
        stated(recordings / "pandaset")
    simulated_drives(range(60, 60 + options.seeds))


if __name__ == "__main__":
    main()
