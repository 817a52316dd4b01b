"""How far the trajectory from satellite fixes and IMU is from fixes that were left out.

And from the truth of synthetic drives.

Run with `python -m benchmarks.gnss_imu [--seeds 5] [--data ../shared/data]`. Of KITTI's navigation unit (10 Hz) fixes
are left out, as the table says; the horizontal error at these [m, root of the mean square] stands beside that of
straight lines between the fixes that were kept. Of synthetic drives everything is known: errors of position, heading,
and roll and pitch, the squared errors in units of the covariance per degree of freedom (NEES, 1 is right), and of
biases.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from sceneloom.geometry.geodesy import enu_from_geodetic, geodetic_from_enu
from sceneloom.geometry.rigid import conjugate_quaternion, multiply_quaternions, rotation_vector_from_quaternion
from sceneloom.motion.gnss_imu import GnssImuRun, SmootherSettings, gnss_imu_motion
from sceneloom.scene import GnssSensor, ImuSensor, Scene, VectorSamples
from sceneloom.simulate.drive import GRAVITY, GnssSpec, ImuSpec, ImuTruth, gnss_sensor, imu_sensor, imu_truth
from sceneloom.simulate.trajectory import EgoPath, PathSpec

SECOND = 1_000_000_000
OUTAGE_S = 10.0


def kitti(path: Path) -> tuple[ImuSensor, GnssSensor]:
    """IMU and fixes of one sequence of KITTI tracking: 30 numbers a line, 10 lines a second."""
    rows = np.loadtxt(path)
    times = np.arange(len(rows), dtype=np.int64) * (SECOND // 10)
    streams = {
        "accelerometer": VectorSamples(times, rows[:, 11:14].copy()),
        "gyroscope": VectorSamples(times, rows[:, 17:20].copy()),
    }
    unknown = np.full(len(rows), np.nan)
    return ImuSensor("imu", streams), GnssSensor("gnss", times, rows[:, :3].copy(), rows[:, 23].copy(), unknown)


def kept_fixes(fixes: GnssSensor, rows: np.ndarray, noise_enu: np.ndarray | None = None) -> GnssSensor:
    """Some of the fixes, with noise added."""
    locations = fixes.positions_lla[rows]
    if noise_enu is not None:
        origin = locations[0]
        locations = geodetic_from_enu(enu_from_geodetic(locations, origin) + noise_enu, origin)
    return GnssSensor(
        "gnss", fixes.timestamps_ns[rows], locations, fixes.accuracies[rows], fixes.vertical_accuracies[rows]
    )


def errors(imu: ImuSensor, fixes: GnssSensor, kept: GnssSensor, left: np.ndarray) -> tuple[float, float, float]:
    """Mean square horizontal errors at the fixes left out, ours and of straight lines, and our time [s]."""
    began = time.perf_counter()
    run = gnss_imu_motion(Scene((imu, kept), source="kitti"))
    took = time.perf_counter() - began
    truth = enu_from_geodetic(fixes.positions_lla, run.origin_lla)[left, :2]
    times = fixes.timestamps_ns[left]
    trajectory = run.trajectory
    ours = np.stack([np.interp(times, trajectory.timestamps_ns, trajectory.positions[:, k]) for k in range(2)], axis=1)
    known = enu_from_geodetic(kept.positions_lla, run.origin_lla)
    lines = np.stack([np.interp(times, kept.timestamps_ns, known[:, k]) for k in range(2)], axis=1)
    return float(((ours - truth) ** 2).sum(1).mean()), float(((lines - truth) ** 2).sum(1).mean()), took


Cut = Callable[[ImuSensor, GnssSensor, int], tuple[float, float, float] | None]


def one_in_ten(imu: ImuSensor, fixes: GnssSensor, seed: int) -> tuple[float, float, float] | None:
    """(a) One fix in ten kept, beginning with each of the first ten."""
    rows = np.arange(seed % 10, len(fixes.timestamps_ns), 10)
    left = np.setdiff1d(np.arange(rows[0], rows[-1] + 1), rows)
    return errors(imu, fixes, kept_fixes(fixes, rows), left)


def outage(imu: ImuSensor, fixes: GnssSensor, seed: int) -> tuple[float, float, float] | None:
    """(b) Ten seconds without fixes, beginning somewhere, at least 1.5 s from either end."""
    times = (fixes.timestamps_ns - fixes.timestamps_ns[0]) / SECOND
    room = times[-1] - OUTAGE_S - 3.0
    if room < 0:
        return None
    start = 1.5 + room * ((0.5 + 0.381966 * seed) % 1.0)
    inside = (times > start) & (times < start + OUTAGE_S)
    return errors(imu, fixes, kept_fixes(fixes, np.flatnonzero(~inside)), np.flatnonzero(inside))


def noisy(imu: ImuSensor, fixes: GnssSensor, seed: int) -> tuple[float, float, float] | None:
    """(c) One fix in ten kept, with 1 m of noise and one in twenty 10 m off."""
    rng = np.random.default_rng(seed)
    rows = np.arange(0, len(fixes.timestamps_ns), 10)
    noise = rng.standard_normal((len(rows), 3))
    off = rng.uniform(size=len(rows)) < 0.05
    angle = rng.uniform(0, 2 * np.pi, len(rows))
    noise[:, :2] += 10.0 * off[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    left = np.setdiff1d(np.arange(rows[-1] + 1), rows)
    return errors(imu, fixes, kept_fixes(fixes, rows, noise), left)


CUTS: dict[str, Cut] = {"(a) 1 in 10": one_in_ten, "(b) 10 s outage": outage, "(c) noise, jumps": noisy}


def print_kitti(folder: Path, seeds: int) -> None:
    """A line per sequence and cut."""
    print("| sequence | cut | drives | ours [m] | straight lines [m] | ratio | worst ratio | s |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for path in sorted(folder.glob("*.txt")):
        imu, fixes = kitti(path)
        for name, cut in CUTS.items():
            found = [result for seed in range(seeds) if (result := cut(imu, fixes, seed)) is not None]
            if not found:
                continue
            table = np.array(found)
            ours, lines = np.sqrt(table[:, :2].mean(axis=0))
            worst = float(np.sqrt(table[:, 1] / table[:, 0]).min())
            cells = [f"{ours:.3f}", f"{lines:.3f}", f"{lines / ours:.2f}", f"{worst:.2f}"]
            cells.append(f"{np.median(table[:, 2]):.2f}")
            print(f"| {path.stem} | {name} | {len(found)} | " + " | ".join(cells) + " |", flush=True)


DRIVES: dict[str, tuple[ImuSpec, GnssSpec, PathSpec]] = {
    "IMU 200 Hz, fixes 10 Hz of 0.4 m": (ImuSpec(), GnssSpec(), PathSpec()),
    "fixes 1 Hz of 1.5 m": (ImuSpec(), GnssSpec(rate_hz=1.0, horizontal_sigma=1.5, vertical_sigma=3.0), PathSpec()),
    "poor IMU, 100 Hz": (ImuSpec(100.0, 0.01, 0.001, 0.1, 0.01), GnssSpec(rate_hz=1.0), PathSpec()),
    "fast": (ImuSpec(), GnssSpec(rate_hz=5.0), PathSpec(speeds=(15.0, 30.0), yaw_rate=0.1)),
}


def made_up(seed: int, seconds: float, imu: ImuSpec, gnss: GnssSpec, path: PathSpec) -> tuple[EgoPath, ImuTruth, Scene]:
    """A drive with IMU and fixes only, and the truth behind it."""
    trajectory = path.plan(np.random.default_rng(seed), start_ns=0, duration=seconds)
    times = [np.arange(round(seconds * rate)) * round(SECOND / rate) for rate in (imu.rate_hz, gnss.rate_hz)]
    truth = imu_truth(imu, trajectory, times[0] + 1_300_000, seed=seed)
    sensors = imu_sensor(imu, truth, seed=seed), gnss_sensor(gnss, trajectory, times[1], seed=seed)
    return trajectory, truth, Scene(sensors, source=f"drive {seed}")


def judged(run: GnssImuRun, trajectory: EgoPath, truth: ImuTruth, gnss: GnssSpec) -> np.ndarray:
    """Mean square errors of position across and in height, heading, roll and pitch; NEES; errors of the biases."""
    found, states = run.trajectory, trajectory.at(run.trajectory.timestamps_ns)
    shift = enu_from_geodetic(run.origin_lla, gnss.origin_lla)
    away = found.positions + shift - states.positions
    rotations = rotation_vector_from_quaternion(
        multiply_quaternions(found.quaternions_xyzw, conjugate_quaternion(states.quaternions_xyzw))
    )
    both = np.hstack([rotations, away])
    normal = np.linalg.solve(found.covariances, both[:, :, None])[:, :, 0]
    biases = run.biases[len(run.biases) // 2]
    return np.array(
        [
            (away[:, :2] ** 2).sum(1).mean(),
            (away[:, 2] ** 2).mean(),
            np.degrees(1) ** 2 * (rotations[:, 2] ** 2).mean(),
            np.degrees(1) ** 2 * (rotations[:, :2] ** 2).sum(1).mean(),
            (both * normal).sum(1).mean() / 6.0,
            ((biases[:3] - truth.gyroscope_bias) ** 2).mean(),
            ((biases[3:] - truth.accelerometer_bias) ** 2).mean(),
        ]
    )


def print_made_up(seeds: int, seconds: float) -> None:
    """A line per kind of drive."""
    print("| drive | across [m] | height [m] | heading [deg] | roll, pitch [deg] | NEES | bias [rad/s] | [m/s²] | s |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for name, (imu, gnss, path) in DRIVES.items():
        rows, took = [], []
        for seed in range(seeds):
            trajectory, truth, scene = made_up(seed, seconds, imu, gnss, path)
            began = time.perf_counter()
            run = gnss_imu_motion(scene, settings=SmootherSettings(gravity=GRAVITY))
            took.append(time.perf_counter() - began)
            rows.append(judged(run, trajectory, truth, gnss))
        mean = np.mean(rows, axis=0)
        mean[[0, 1, 2, 3, 5, 6]] = np.sqrt(mean[[0, 1, 2, 3, 5, 6]])
        print(f"| {name} | " + " | ".join(f"{value:.4g}" for value in mean) + f" | {np.median(took):.2f} |", flush=True)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--only", choices=["kitti", "made-up"])
    arguments = parser.parse_args()
    if arguments.only != "made-up":
        print_kitti(arguments.data / "real/kitti_tracking/oxts", arguments.seeds)
    if arguments.only != "kitti":
        print_made_up(arguments.seeds, arguments.seconds)


if __name__ == "__main__":
    main()
