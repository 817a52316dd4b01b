"""How near repaired calibrations come to the truth: `python -m benchmarks.calibration [--starts N] [--seeds N]`.

Simulated drives have exact truth; of kitti_drive (under `SCENELOOM_DATA`) the published calibration counts as it.
Starts are random rotations of one degree; the simulated ones are 0.5 degrees, 5 cm and 30 ms off.

`--coverage N` alone counts how often the 95 % intervals of N simulated drives hold the truth, and fails beyond 92 to
98 %.
"""

import argparse
import os
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import sceneloom
from sceneloom.calibrate.extrinsics import step_between
from sceneloom.calibrate.frames import CalibrationFrame, calibration_frames
from sceneloom.calibrate.measures import Change
from sceneloom.calibrate.refinement import Refinement, refine
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.simulate import Faults, SensorFaults, inject, simulate_street

DATA = Path(os.environ.get("SCENELOOM_DATA", "../shared/data"))


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--starts", type=int, default=20)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--coverage", type=int, metavar="DRIVES")
    given = parser.parse_args()
    if given.coverage is not None:
        sys.exit(_coverage(given.coverage))
    print("simulated drives, 20 frames, injected 0.5 deg / 5 cm / 30 ms")
    print("seed  verdict  rotate [deg]  shift [cm]  time [ms]  inside 95 %  CPU [s]")
    for seed in range(given.seeds):
        _simulated(21 + seed)
    folder = DATA / "recordings" / "kitti_drive"
    if folder.is_dir():
        _kitti(folder, given.starts)
    else:
        print(f"{folder}: not there; left out")


NAMES = ("pitch", "yaw", "roll", "right", "down", "ahead", "later")


def _repaired(seed: int) -> tuple[Refinement, np.ndarray, float]:
    """Repair a drive; give the errors that are left of seven numbers [rad, m, s] and the CPU time."""
    drive = simulate_street(seed, frames=20)
    rng = np.random.default_rng(seed)
    rotation, shift = (size * _direction(rng) for size in (0.5, 0.05))
    wrong = SensorFaults(rotation_deg=tuple(rotation.tolist()), shift=tuple(shift.tolist()), time_offset_ns=30_000_000)
    frames = calibration_frames(inject(drive, Faults({"camera0": wrong})).scene)
    found, seconds = _refined(frames)
    truth = drive.scene.cameras[0].mount.inverse() @ drive.scene.lidars[0].mount
    step = step_between(found.camera_from_lidar, truth)
    return found, np.array([*step, -0.03 - found.time_offset]), seconds


def _inside(found: Refinement, errors: np.ndarray) -> list[bool]:
    """Of each number that was refined: whether its 95 % interval holds the truth."""
    return [
        abs(error) < 1.96 * found.sigmas[name]
        for error, name in zip(errors, NAMES, strict=True)
        if name in found.sigmas
    ]


def _simulated(seed: int) -> None:
    found, errors, seconds = _repaired(seed)
    inside = _inside(found, errors)
    print(
        f"{seed:4d}  {found.verdict!s:8}  {np.degrees(np.linalg.norm(errors[:3])):9.3f}  "
        f"{100 * np.linalg.norm(errors[3:6]):9.1f}  {1e3 * abs(errors[6]):9.1f}  "
        f"{sum(inside):4d} of {len(inside)}  {seconds:8.1f}",
        flush=True,
    )


def _coverage(drives: int) -> int:
    """Print how often intervals hold the truth; give 1 where that is beyond what 95 % intervals may be."""
    inside: list[bool] = []
    for seed in range(400, 400 + drives):
        found, errors, _ = _repaired(seed)
        inside += _inside(found, errors)
        print(f"{seed}: {sum(inside)} of {len(inside)} intervals hold the truth", flush=True)
    share = float(np.mean(inside))
    print(f"{drives} drives: {100 * share:.1f} % of the 95 % intervals hold the truth")
    return int(not 0.92 <= share <= 0.98)


def _kitti(folder: Path, starts: int) -> None:
    with sceneloom.open(folder) as scene:
        frames = calibration_frames(scene)
    truth = frames[0].camera_from_lidar
    rng = np.random.default_rng(100)
    errors, verdicts = [], []
    for _ in range(starts):
        numbers = np.zeros(8)
        numbers[:3] = np.radians(1.0) * _direction(rng)
        wrong = Change.of(numbers).camera_from_lidar(truth.matrix)
        stated = RigidTransform.nearest(wrong)[0]
        found, _ = _refined(tuple(replace(frame, camera_from_lidar=stated) for frame in frames))
        errors.append(np.degrees(step_between(truth, found.camera_from_lidar)[:3]))
        verdicts.append(str(found.verdict))
    rotations, yaws = np.linalg.norm(errors, axis=1), np.abs(np.array(errors)[:, 1])
    print(f"kitti_drive, {starts} starts of 1 deg: {verdicts.count('refined')} refined")
    print(
        f"rotate: median {np.median(rotations):.2f}, 90 % within {np.quantile(rotations, 0.9):.2f} deg, worst "
        f"{rotations.max():.2f}"
    )
    print(f"yaw: median {np.median(yaws):.2f}, 90 % within {np.quantile(yaws, 0.9):.2f} deg")


def _refined(frames: tuple[CalibrationFrame, ...]) -> tuple[Refinement, float]:
    start = time.process_time()
    found = refine(frames)
    return found, time.process_time() - start


def _direction(rng: np.random.Generator) -> np.ndarray:
    drawn = rng.normal(size=3)
    return np.asarray(drawn / np.linalg.norm(drawn))


if __name__ == "__main__":
    main()
