"""How far the trajectory from satellite fixes and IMU is from fixes that were left out.

And from the truth of synthetic drives, and of a receiver beside a better one.

Run with `python -m benchmarks.gnss_imu [--seeds 5] [--data ../shared/data]`. Of KITTI's navigation unit (10 Hz) fixes
are left out, as the table says; the horizontal error at these [m, root of the mean square] stands beside those of
straight lines and of a cubic spline through the fixes that were kept, and of a Kalman smoother (Rauch, Tung, Striebel
1965) of white jerk, whose noises are the most likely ones of each drive. Of synthetic drives everything is known:
errors of position, heading, and roll and pitch, the squared errors in units of the covariance per degree of freedom
(NEES, 1 is right), and of biases; and, for receivers with slow errors, how often the 95 % region of the position holds
the truth, also if the receiver states a half of its errors.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

import sceneloom
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


SIGMAS, JERKS = (1e-3, 3e-3, 0.01, 0.03, 0.1, 1.0), (0.01, 0.03, 0.1, 0.3, 1.0, 3.0)


def smoothed_jerk(times: np.ndarray, values: np.ndarray, wanted: np.ndarray, sigma: float, jerk: float) -> tuple:
    """Positions (W, 2) at wanted times [s] by a Kalman smoother of white jerk, and minus the log likelihood."""
    order = np.argsort(np.concatenate([times, wanted]), kind="stable")
    seconds = np.concatenate([times, wanted])[order]
    means, spread, cost = np.zeros((3, 2)), np.diag([1e2, 30.0**2, 5.0**2]), 0.0
    means[0] = values[0]
    filtered, predicted = [], []
    for k, h in enumerate(np.diff(seconds, prepend=seconds[:1])):
        moved = np.array([[1.0, h, h * h / 2], [0.0, 1.0, h], [0.0, 0.0, 1.0]])
        noise = np.array([[h**5 / 20, h**4 / 8, h**3 / 6], [h**4 / 8, h**3 / 3, h * h / 2], [h**3 / 6, h * h / 2, h]])
        means, spread = moved @ means, moved @ spread @ moved.T + jerk**2 * noise
        predicted.append((means, spread, moved))
        if order[k] < len(times):
            variance, apart = spread[0, 0] + sigma**2, values[order[k]] - means[0]
            cost += (0.5 * apart @ apart / variance + np.log(variance)) * (k > 4)
            gain = spread[:, :1] / variance
            means, spread = means + gain * apart, spread - gain * spread[:1]
        filtered.append((means, spread))
    found = np.empty((len(seconds), 2))
    found[order[-1]] = means[0]
    for k in range(len(seconds) - 2, -1, -1):
        later, later_spread, moved = predicted[k + 1]
        gain = np.linalg.solve(later_spread + 1e-15 * np.eye(3), moved @ filtered[k][1]).T
        means = filtered[k][0] + gain @ (means - later)
        found[order[k]] = means[0]
    return found[len(times) :], cost


def errors(imu: ImuSensor, fixes: GnssSensor, kept: GnssSensor, left: np.ndarray) -> tuple[float, ...]:
    """Mean square horizontal errors at the fixes left out: ours, straight lines, spline, smoother; and our time [s]."""
    began = time.perf_counter()
    run = gnss_imu_motion(Scene((imu, kept), source="kitti"))
    took = time.perf_counter() - began
    truth = enu_from_geodetic(fixes.positions_lla, run.origin_lla)[left, :2]
    times, known_times = fixes.timestamps_ns[left] * 1e-9, kept.timestamps_ns * 1e-9
    trajectory = run.trajectory
    known = enu_from_geodetic(kept.positions_lla, run.origin_lla)[:, :2]

    def lines(at: np.ndarray, values: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(times, at, values[:, k]) for k in range(2)], axis=1)

    noises = [(sigma, jerk) for sigma in SIGMAS for jerk in JERKS]
    costs = [smoothed_jerk(known_times, known, known_times[:1], *one)[1] for one in noises]
    found = (
        lines(trajectory.timestamps_ns * 1e-9, trajectory.positions),
        lines(known_times, known),
        CubicSpline(known_times, known)(times),
        smoothed_jerk(known_times, known, times, *noises[int(np.argmin(costs))])[0],
    )
    return *(float(((one - truth) ** 2).sum(1).mean()) for one in found), took


Cut = Callable[[ImuSensor, GnssSensor, int], tuple[float, ...] | None]


def one_in_ten(imu: ImuSensor, fixes: GnssSensor, seed: int) -> tuple[float, ...] | None:
    """(a) One fix in ten kept, beginning with each of the first ten."""
    rows = np.arange(seed % 10, len(fixes.timestamps_ns), 10)
    left = np.setdiff1d(np.arange(rows[0], rows[-1] + 1), rows)
    return errors(imu, fixes, kept_fixes(fixes, rows), left)


def outage(imu: ImuSensor, fixes: GnssSensor, seed: int) -> tuple[float, ...] | None:
    """(b) Ten seconds without fixes, beginning somewhere, at least 1.5 s from either end."""
    times = (fixes.timestamps_ns - fixes.timestamps_ns[0]) / SECOND
    room = times[-1] - OUTAGE_S - 3.0
    if room < 0:
        return None
    start = 1.5 + room * ((0.5 + 0.381966 * seed) % 1.0)
    inside = (times > start) & (times < start + OUTAGE_S)
    return errors(imu, fixes, kept_fixes(fixes, np.flatnonzero(~inside)), np.flatnonzero(inside))


def noisy(imu: ImuSensor, fixes: GnssSensor, seed: int) -> tuple[float, ...] | None:
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
    print("| sequence | cut | drives | ours [m] | straight lines [m] | cubic spline [m] | smoother [m] | s |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for path in sorted(folder.glob("*.txt")):
        imu, fixes = kitti(path)
        for name, cut in CUTS.items():
            found = [result for seed in range(seeds) if (result := cut(imu, fixes, seed)) is not None]
            if not found:
                continue
            cells = [f"{value:.4f}" for value in np.sqrt(np.mean(found, axis=0)[:4])]
            cells.append(f"{np.median([one[4] for one in found]):.2f}")
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


RECEIVERS = ((0.0, 60.0), (0.5, 20.0), (1.5, 20.0), (1.5, 100.0), (1.0, 300.0), (3.0, 60.0))  # slow error [m], [s]
FIRST_REGION = 5000
IMUS = {"IMU": ImuSpec(), "poor IMU": DRIVES["poor IMU, 100 Hz"][0]}


def held(away: np.ndarray, covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whether the 95 % regions hold positions, (N,) across and in height."""
    across = (away[:, :2] * np.linalg.solve(covariances[:, :2, :2], away[:, :2, None])[:, :, 0]).sum(axis=1)
    return across < 5.991, away[:, 2] ** 2 < 3.841 * covariances[:, 2, 2]


def print_regions(seeds: int, seconds: float) -> None:
    """A line per receiver with slow errors; deviations across beside what is true."""
    print(f"regions: {seeds} drives of {seconds:g} s a line, seeds {FIRST_REGION} to {FIRST_REGION + seeds - 1}")
    print("| IMU | slow error | states | held across | height | σ ours [m] | rms [m] | σ over slow | fixes [m] |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for name, imu in IMUS.items():
        for slow, constant in RECEIVERS:
            gnss = GnssSpec(rate_hz=2.0, correlated_sigma=slow, correlation_time=constant)
            for share in (1.0, 0.5):
                rows = []
                for seed in range(FIRST_REGION, FIRST_REGION + seeds):
                    trajectory, _, scene = made_up(seed, seconds, imu, gnss, PathSpec())
                    fixes = scene.sensors[1]
                    sigmas = share * fixes.accuracies, share * fixes.vertical_accuracies
                    stated = replace(fixes, accuracies=sigmas[0], vertical_accuracies=sigmas[1])
                    settings = SmootherSettings(gravity=GRAVITY)
                    run = gnss_imu_motion(Scene((scene.sensors[0], stated), source="regions"), settings=settings)
                    found = run.trajectory
                    shift = enu_from_geodetic(run.origin_lla, gnss.origin_lla)
                    away = found.positions + shift - trajectory.at(found.timestamps_ns).positions
                    covariances = found.covariances[:, 3:, 3:]
                    reported = enu_from_geodetic(fixes.positions_lla, gnss.origin_lla)
                    reported -= trajectory.at(fixes.timestamps_ns).positions
                    across, height = held(away, covariances)
                    squares = covariances[:, 0, 0].mean(), (away[:, :2] ** 2).mean(), (reported[:, :2] ** 2).mean()
                    rows.append((across.mean(), height.mean(), *squares))
                mean = np.mean(rows, axis=0)
                sigma, true, of_fixes = np.sqrt(mean[2:])
                cells = [f"{value:.3f}" for value in (*mean[:2], sigma, true, sigma / (slow or true), of_fixes)]
                what = f"{slow:g} m, {constant:g} s" if slow else "none"
                print(f"| {name} | {what} | {share:g} of it | " + " | ".join(cells) + " |", flush=True)


def print_beside(folder: Path) -> None:
    """How often the 95 % regions of a receiver alone hold what a better one beside it reports."""
    names = ("MTV.Local1.ublox-F9K.20200206-181434.nmea", "MTV.Local1.SPAN.20200206-181434.gga")
    scene, better = (sceneloom.open(folder / name, lenient=True) for name in names)
    run, truth, fixes = gnss_imu_motion(scene), better.sensors[0], scene.sensors[0]
    times, rows, theirs = np.intersect1d(fixes.timestamps_ns, truth.timestamps_ns, return_indices=True)
    found = run.trajectory
    positions = np.stack([np.interp(times, found.timestamps_ns, one) for one in found.positions.T], axis=1)
    covariances = found.covariances[np.searchsorted(found.timestamps_ns, times), 3:, 3:]
    true = enu_from_geodetic(truth.positions_lla, run.origin_lla)[theirs]
    reported = enu_from_geodetic(fixes.positions_lla, run.origin_lla)[rows] - true
    across, height = held(positions - true, covariances)
    sizes = (float(np.sqrt((one[:, :2] ** 2).sum(1).mean())) for one in (positions - true, reported))
    sigma = float(np.sqrt(np.median(covariances[:, 0, 0] + covariances[:, 1, 1])))
    print("| fixes | held across | height | σ ours [m] | ours [m] | fixes [m] |\n| --- | --- | --- | --- | --- | --- |")
    cells = " | ".join(f"{one:.3f}" for one in (across.mean(), height.mean(), sigma, *sizes))
    print(f"| {len(times)} | {cells} |")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--only", choices=["kitti", "made-up", "regions", "beside"])
    arguments = parser.parse_args()
    only = arguments.only
    if only in {None, "kitti"}:
        print_kitti(arguments.data / "real/kitti_tracking/oxts", arguments.seeds)
    if only in {None, "made-up"}:
        print_made_up(arguments.seeds, arguments.seconds)
    if only in {None, "regions"}:
        print_regions(arguments.seeds, 2.0 * arguments.seconds)
    if only in {None, "beside"}:
        print_beside(arguments.data / "real/strangers/gnss_f9k_span")


if __name__ == "__main__":
    main()
