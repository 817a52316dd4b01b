"""How well offsets and skews between clocks are found on synthetic streets, and whether their uncertainty is true.

Run with `python -m benchmarks.clock [--seeds 4] [--first 0] [--only NAME]`. In every drive the clock of one stream is
set off by -1 to 1 s (a third of them by nothing) and made up to 200 ppm too fast or slow. Errors are those of the
offset in the middle of the drive. z: root mean square of the errors in standard deviations as reported, 1 where true.
within: offsets whose true value is in the confidence interval (of 99 %), of those found. verdicts: in step, off, cannot
tell; wrong: in step with a true offset beyond the tolerance, or off with one within, at begin and end of the drive.
bound: what no unbiased estimate can be better than (Cramer 1946, Rao 1945), as root mean square over the drives, for
fixes with white noise against a trajectory without errors whose location and heading on earth, antenna and skew are
not known. The peer is plain cross-correlation of yaw rates' magnitude
(of speeds for ways) at the slower stream's samples, its peak between samples by a parabola, without any skew.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sceneloom.cameras import Camera
from sceneloom.editing.retime import ClockCorrection, retimed_scene
from sceneloom.geometry.geodesy import enu_from_geodetic, geodetic_from_enu
from sceneloom.geometry.rigid import multiply_quaternions, quaternion_from_rotation_vector
from sceneloom.motion.clock.comparison import TOLERANCE_NS, ClockVerdict
from sceneloom.motion.clock.signals import Fixes, RotationCurve
from sceneloom.motion.clock.streams import Stream, StreamKind, TrajectoryCurve, compare_streams, streams_of
from sceneloom.scene import Scene
from sceneloom.scene.types import key_of
from sceneloom.simulate import CameraSpec, GnssSpec, LidarSpec, PathSpec, simulate_street


@dataclass(frozen=True)
class Row:
    """One pair of streams on one kind of drive."""

    name: str
    reference: str
    stream: str
    make: Callable[[int], Scene]
    lever: float = 1.0
    sigma: float | None = None
    """Noise of the fixes [m], where the bound is reported."""


def plain(seed: int, *, seconds: int = 60, sigma: float = 0.4, rate_hz: float = 10.0, **more: object) -> Scene:
    """A drive without sweeps worth to look at."""
    small = LidarSpec(beams=1, steps=4, elevations_deg=(-1.0, 1.0))
    gnss = GnssSpec(horizontal_sigma=sigma, rate_hz=rate_hz)
    return simulate_street(seed, frames=10 * seconds, lidar=small, gnss=gnss, **more).scene


def lasting(seed: int, seconds: float = 30.0) -> Scene:
    """A drive whose fixes have errors of 0.4 m that last: their correlation falls to 1/e in some seconds."""
    scene = plain(seed, sigma=0.0)
    receiver = scene.sensor("gnss")
    errors = 0.4 * np.random.default_rng(seed).standard_normal(receiver.positions_lla.shape)
    kept = np.exp(-0.1 / seconds)
    for k in range(1, len(errors)):
        errors[k] = kept * errors[k - 1] + np.sqrt(1.0 - kept**2) * errors[k]
    origin = receiver.positions_lla[0]
    moved = replace(
        receiver, positions_lla=geodetic_from_enu(enu_from_geodetic(receiver.positions_lla, origin) + errors, origin)
    )
    return replace(scene, sensors=tuple(moved if s is receiver else s for s in scene.sensors))


def shaken(seed: int, sigma: float, hz: float) -> Scene:
    """A drive whose trajectory has white errors of rotation [rad] at a rate."""
    scene = plain(seed, trajectory_hz=hz)
    trajectory = scene.trajectories["groundTruth"]
    rotations = sigma * np.random.default_rng(seed).standard_normal((len(trajectory.timestamps_ns), 3))
    rotated = multiply_quaternions(trajectory.quaternions_xyzw, quaternion_from_rotation_vector(rotations))
    return replace(scene, trajectories={"groundTruth": replace(trajectory, quaternions_xyzw=rotated)})


def seen(seed: int, readout_ns: int) -> Scene:
    """A drive with images."""
    camera_model = Camera("brown_conrady", 480, 300, 300.0, 300.0, 239.5, 149.5, (-0.1, 0.03, 0.0004, -0.0003, -0.004))
    camera = CameraSpec(camera_model, supersampling=2, readout_ns=readout_ns)
    return plain(seed, seconds=12, cameras=(camera,), path=PathSpec(yaw_rate=0.4))


def swept(seed: int) -> Scene:
    """A drive with sweeps of 32 beams."""
    return simulate_street(seed, frames=150, lidar=LidarSpec(beams=32, steps=900)).scene


ROWS = (
    Row("gyroscope, trajectory 100 Hz", "imu", "groundTruth", plain),
    Row("gyroscope, trajectory 10 Hz", "imu", "groundTruth", lambda seed: plain(seed, trajectory_hz=10.0)),
    Row("gyroscope, trajectory 20 Hz, 0.1 deg", "imu", "groundTruth", lambda seed: shaken(seed, 0.0017, 20.0)),
    Row("trajectory, GNSS 10 Hz, 0.4 m", "groundTruth", "gnss", plain, sigma=0.4),
    Row("trajectory, GNSS 10 Hz, 0.4 m for 30 s", "groundTruth", "gnss", lasting),
    Row("trajectory, GNSS 10 Hz, 0.4 m, antenna at the origin", "groundTruth", "gnss", plain, lever=0.0, sigma=0.4),
    Row(
        "trajectory, GNSS 10 Hz, 0.4 m, 5 min", "groundTruth", "gnss", lambda seed: plain(seed, seconds=300), sigma=0.4
    ),
    Row("trajectory, GNSS 10 Hz, 2 cm", "groundTruth", "gnss", lambda seed: plain(seed, sigma=0.02), sigma=0.02),
    Row(
        "trajectory, GNSS 1 Hz, 2 cm",
        "groundTruth",
        "gnss",
        lambda seed: plain(seed, sigma=0.02, rate_hz=1.0),
        sigma=0.02,
    ),
    Row("IMU, GNSS 10 Hz, 0.4 m", "imu", "gnss", plain),
    Row("IMU, GNSS 10 Hz, 2 cm", "imu", "gnss", lambda seed: plain(seed, sigma=0.02)),
    Row("gyroscope, lidar", "imu", "lidar", swept),
    Row("gyroscope, camera 10 Hz", "imu", "camera0", lambda seed: seen(seed, 0)),
    Row("gyroscope, rolling shutter 30 ms", "imu", "camera0", lambda seed: seen(seed, 30_000_000)),
)


def set_off(scene: Scene, name: str, correction: ClockCorrection) -> Scene:
    """The scene with a stream's clock off by what the correction would take away."""
    stream = next(stream for stream in streams_of(scene) if stream.name == name)
    if stream.kind is StreamKind.TRAJECTORY:
        return retimed_scene(scene, trajectories={name: correction})
    return retimed_scene(scene, sensors={key_of(stream.source.id): correction})


def bound(scene: Scene, row: Row) -> float:
    """The least standard deviation of an offset of fixes against the trajectory [s]."""
    fixes = Fixes.of_receiver(scene.sensor("gnss"))
    origin_ns = int(fixes.timestamps_ns[0])
    trajectory = TrajectoryCurve(scene.trajectories["groundTruth"], origin_ns)
    seconds = (fixes.timestamps_ns - origin_ns) * 1e-9
    reported = trajectory.at((0.0, 0.0), seconds)
    known = np.isfinite(reported.locations)
    locations, since = (
        reported.locations[known] - reported.locations[known].mean(),
        seconds[known] - seconds[known].mean(),
    )
    # the skew is drawn within 200 ppm, whose deviation is 115
    priors = [(reported.velocities[known] * since, 115e-6)]
    if row.lever:
        priors += [(axis, row.lever) for axis in reported.axes[known].T]
    free = [reported.velocities[known], np.ones_like(locations), 1j * np.ones_like(locations), 1j * locations]
    columns = np.stack([*free, *(column * sigma for column, sigma in priors)], axis=1) / row.sigma
    lengths = np.linalg.norm(columns, axis=0) + 1e-300
    rows = np.vstack([columns.real, columns.imag])
    information = rows.T @ rows + np.diag([0.0] * len(free) + [1.0] * len(priors))
    inverse = np.linalg.pinv(information / np.outer(lengths, lengths), rcond=1e-13)
    return float(np.sqrt(inverse[0, 0]) / lengths[0])


def peer(reference: Stream, stream: Stream) -> float:
    """The offset by plain cross-correlation [s]."""
    reported = reference.motion(), stream.motion()
    steps = [
        np.median(np.diff(t.orientations.timestamps_ns if t.orientations else t.fixes.timestamps_ns)) for t in reported
    ]
    step = max(steps) * 1e-9
    origin_ns = max(s.span_ns[0] for s in (reference, stream))
    length = min(s.span_ns[1] for s in (reference, stream)) - origin_ns
    edges = np.arange(0.0, length * 1e-9, step)
    by_rotation = reported[0].orientations is not None and reported[1].orientations is not None
    a, b = (_rotating(t, origin_ns, edges) if by_rotation else _speeds(t, origin_ns, edges) for t in reported)
    known = np.isfinite(a) & np.isfinite(b)
    a, b = (np.where(known, x - x[known].mean(), 0.0) for x in (a, b))
    products = np.correlate(b, a, "full")
    reach = int(2.0 / step)
    middle = len(a) - 1
    k = middle - reach + int(np.argmax(products[middle - reach : middle + reach + 1]))
    before, at, after = products[k - 1 : k + 2]
    return (k - middle + 0.5 * (before - after) / (before - 2 * at + after)) * step


def _rotating(reported: object, origin_ns: int, edges: np.ndarray) -> np.ndarray:
    rotations = RotationCurve(reported.orientations, origin_ns).rotations(edges[:-1], edges[1:])
    return np.linalg.norm(rotations, axis=1)


def _speeds(reported: object, origin_ns: int, edges: np.ndarray) -> np.ndarray:
    if reported.fixes is None:
        trajectory = reported.trajectory(origin_ns)
        return np.abs(trajectory.at((float(edges[0]), float(edges[-1])), edges[:-1]).velocities)
    locations = np.interp(edges, (reported.fixes.timestamps_ns - origin_ns) * 1e-9, reported.fixes.locations)
    return np.abs(np.diff(locations)) / np.diff(edges)


def row_of(row: Row, seeds: range) -> str:
    """One line of the table."""
    errors, peers, sigmas, z, skews, clocked, bounds = [], [], [], [], [], [], []
    unknown = within = wrongly = 0
    verdicts = dict.fromkeys((ClockVerdict.IN_STEP, ClockVerdict.OFF, ClockVerdict.CANNOT_TELL), 0)
    for seed in seeds:
        draw = np.random.default_rng(1000 + seed)
        scene = row.make(seed)
        bounds += [] if row.sigma is None else [bound(scene, row) * 1e3]
        offset_ns, skew = (0.0, 0.0) if seed % 3 == 0 else (draw.uniform(-1e9, 1e9), draw.uniform(-200, 200))
        middle_ns = int(np.mean(next(s for s in streams_of(scene) if s.name == row.stream).span_ns))
        wrong = set_off(scene, row.stream, ClockCorrection(-offset_ns, -skew, middle_ns))
        found = {stream.name: stream for stream in streams_of(wrong)}
        begun = time.perf_counter()
        _, estimate = compare_streams(found[row.reference], found[row.stream], lever_sigma=row.lever)
        clocked.append(time.perf_counter() - begun)
        if estimate.offset_ns is None:
            unknown += 1
            continue
        truth_ns = offset_ns + skew * 1e-6 * (estimate.at_ns - middle_ns)
        errors.append(abs(estimate.offset_ns - truth_ns) / 1e6)
        sigmas.append(estimate.offset_sigma_ns / 1e6)
        z.append((estimate.offset_ns - truth_ns) / estimate.offset_sigma_ns)
        if estimate.skew_ppm is not None:
            skews.append((estimate.skew_ppm - skew) / estimate.skew_sigma_ppm)
        peers.append(abs(peer(found[row.reference], found[row.stream]) - truth_ns * 1e-9) * 1e3)
        low, high = estimate.interval_ns
        within += low <= truth_ns <= high
        verdicts[estimate.verdict] += 1
        largest = max(abs(truth_ns + sign * skew * 1e-6 * estimate.span_ns / 2) for sign in (-1, 1))
        wrongly += estimate.verdict is (ClockVerdict.OFF if largest <= TOLERANCE_NS else ClockVerdict.IN_STEP)
    cells = (
        row.name,
        f"{np.median(errors):.2f}",
        f"{max(errors):.2f}",
        f"{np.median(sigmas):.2f}",
        f"{np.sqrt(np.mean(np.square(errors))):.2f}",
        f"{np.sqrt(np.mean(np.square(bounds))):.2f}" if bounds else "",
        f"{np.sqrt(np.mean(np.square(z))):.2f}",
        f"{within} of {len(z)}",
        f"{np.sqrt(np.mean(np.square(skews))):.2f}" if skews else "",
        ", ".join(map(str, verdicts.values())),
        f"{wrongly}",
        f"{unknown}",
        f"{np.median(peers):.1f}",
        f"{np.median(clocked):.2f}",
    )
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Print the table."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--seeds", type=int, default=4)
    arguments.add_argument("--first", type=int, default=0, help="the first seed")
    arguments.add_argument("--only", default="", help="rows whose name holds this")
    chosen = arguments.parse_args()
    print(
        "| pair | median error [ms] | largest | sigma | rms error | bound | z | within | "
        "z of the skew | verdicts | wrong | unknown | peer [ms] | time [s] |"
    )
    print("|" + " --- |" * 14)
    for row in ROWS:
        if chosen.only in row.name:
            print(row_of(row, range(chosen.first, chosen.first + chosen.seeds)), flush=True)


if __name__ == "__main__":
    main()
