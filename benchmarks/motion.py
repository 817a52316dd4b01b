"""How far lidar odometry drifts, how fast it is, and what deskewing by it brings, beside small_gicp and kiss-icp.

Run with `python -m benchmarks.motion [TABLE ...] [--metres 600] [--seeds 20 21] [--stand 60] [--kitti DIR]`. Tables:

drift: simulated drives with rotates and traffic, 64 beams, 120,000 rays a sweep. end: distance from the truth at the
end, in percent of the trajectory. trans, rot: KITTI's errors of all chunks of 100, 200, … m (Geiger 2012): the mean
distance in percent of their length, and the mean angle per 100 m. ms: time of this process per sweep, and wall time.
Below: the squared error at the end in units of its covariance, per degree of freedom (1 is honest).
lidars: the same for other lidars and ways of driving, over a quarter of the trajectory.
stationary: how far a car that stands among traffic seems to move.
deskew: distance of the points in the world from where they truly come from, with point times and without.
kitti: 12 real sweeps: length of the trajectory, mean distance between neighbouring points of consecutive sweeps.
together: odometry and fusion of the same sweeps, one after another.
"""

import argparse
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import small_gicp
from scipy.spatial import cKDTree

import sceneloom
from sceneloom.geometry.rigid import matrix_from_quaternion, quaternion_from_matrix
from sceneloom.motion.deskew import points_to_world
from sceneloom.motion.odometry import LidarOdometry, lidar_odometry
from sceneloom.pipeline import iter_fused
from sceneloom.scene import CameraImage, LazyFrames, LidarFrame, LidarPoints, Poses, Scene
from sceneloom.scene.poses import PoseSource
from sceneloom.simulate import (
    CameraSpec,
    LidarSpec,
    PathSpec,
    Rosette,
    SimulatedDrive,
    SolidStateSpec,
    Stop,
    TrafficSpec,
    simulate_street,
)

SPEED = 5.5
"""The simulated ego is seldom slower than that on the mean [m/s], so drives get as long as asked, or longer."""
CHUNKS = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
BUSY = TrafficSpec(cars=4.0, cyclists=2.0, pedestrians=6.0)
DENSE = LidarSpec(steps=1875)
STEPS_BETWEEN_CHUNKS = 10


@dataclass
class SmoothedTrajectory:
    """A trajectory that was found, sweep by sweep.

    Attributes:
        name: of the method.
        times_ns, rotations, positions: one per sweep, to which the pose belongs.
        cpu, wall: seconds spent on each sweep.
    """

    name: str
    times_ns: list[int] = field(default_factory=list)
    rotations: list[np.ndarray] = field(default_factory=list)
    positions: list[np.ndarray] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)
    wall: list[float] = field(default_factory=list)
    covariance: np.ndarray | None = None

    def take(self, add: Callable[[], tuple[int, np.ndarray, np.ndarray]]) -> None:
        """Time one sweep and keep its pose."""
        cpu, wall = time.process_time(), time.perf_counter()
        pose = add()
        self.cpu.append(time.process_time() - cpu)
        self.wall.append(time.perf_counter() - wall)
        for held, value in zip((self.times_ns, self.rotations, self.positions), pose, strict=True):
            held.append(value)

    def milliseconds(self) -> tuple[float, float]:
        """Medians of processor and wall time per sweep [ms]."""
        return 1e3 * float(np.median(self.cpu)), 1e3 * float(np.median(self.wall))


class Ours:
    """Lidar odometry fed with sweeps; poses hold in the middle of a sweep."""

    name = "sceneloom"

    def __init__(self) -> None:
        self.odometry = LidarOdometry()
        self.covariance = np.zeros((6, 6))

    def add(self, points: np.ndarray, frame: LidarFrame) -> tuple[int, np.ndarray, np.ndarray]:
        """Take a sweep in the ego frame."""
        estimate = self.odometry.add(frame.timestamp_ns, points, frame.points.timestamps_ns)
        assert estimate is not None
        self.covariance = estimate.covariance
        return estimate.state.timestamp_ns, estimate.state.rotation, estimate.state.position


class Kiss:
    """kiss-icp with its defaults; poses hold at the end of a sweep, to which it deskews."""

    name = "kiss-icp"

    def __init__(self) -> None:
        from kiss_icp.config import load_config
        from kiss_icp.kiss_icp import KissICP

        self.icp = KissICP(load_config(None))

    def add(self, points: np.ndarray, frame: LidarFrame) -> tuple[int, np.ndarray, np.ndarray]:
        """Take a sweep in the ego frame."""
        times = frame.points.timestamps_ns
        assert times is not None
        span = max(int(times[-1]) - int(times[0]), 1)
        self.icp.register_frame(points.astype(np.float64), (times - times[0]) / span)
        return int(times[-1]), self.icp.last_pose[:3, :3].copy(), self.icp.last_pose[:3, 3].copy()


class Gicp:
    """small_gicp against its map of voxels, with the numbers of its example; it does not deskew: poses hold halfway."""

    name = "small_gicp"

    def __init__(self) -> None:
        self.voxels = small_gicp.GaussianVoxelMap(1.0)
        self.voxels.set_lru(horizon=100, clear_cycle=10)
        self.pose, self.step, self.begun = np.eye(4), np.eye(4), False

    def add(self, points: np.ndarray, frame: LidarFrame) -> tuple[int, np.ndarray, np.ndarray]:
        """Take a sweep in the ego frame."""
        cloud, _ = small_gicp.preprocess_points(points.astype(np.float64), downsampling_resolution=0.25)
        if self.begun:
            found = small_gicp.align(self.voxels, cloud, self.pose @ self.step).T_target_source
            self.pose, self.step = found, np.linalg.inv(self.pose) @ found
        self.voxels.insert(cloud, self.pose)
        self.begun, times = True, frame.points.timestamps_ns
        assert times is not None
        return int(np.median(times)), self.pose[:3, :3].copy(), self.pose[:3, 3].copy()


def methods() -> list[type]:
    """Ours, small_gicp, and kiss-icp where it is installed."""
    if find_spec("kiss_icp") is None:
        print("kiss-icp is not installed: `pip install kiss-icp` puts it beside ours\n")
        return [Ours, Gicp]
    return [Ours, Kiss, Gicp]


def follow(drive: SimulatedDrive, kinds: list[type], mount: Any) -> list[SmoothedTrajectory]:
    """Feed the sweeps of a drive to every method; each sweep is simulated once."""
    runs = [(kind(), SmoothedTrajectory(kind.name)) for kind in kinds]
    for frame in drive.scene.lidars[0].frames:
        points = mount.apply(frame.points.positions).astype(np.float32)
        for method, trajectory in runs:
            trajectory.take(lambda method=method, points=points, frame=frame: method.add(points, frame))
    for method, trajectory in runs:
        trajectory.covariance = getattr(method, "covariance", None)
    return [trajectory for _, trajectory in runs]


@dataclass(frozen=True)
class Errors:
    """How far a trajectory is from the truth."""

    length: float
    end: float
    end_vector: np.ndarray
    chunks: np.ndarray

    def row(self) -> str:
        """The table's columns."""
        if not len(self.chunks):
            return f"{self.length:7.0f} m {self.end:7.3f} m = {100 * self.end / self.length:6.3f} %" + " " * 28
        translation, rotation = self.chunks.mean(axis=0)
        return (
            f"{self.length:7.0f} m {self.end:7.3f} m = {100 * self.end / self.length:6.3f} % "
            f"{translation:9.3f} % {rotation:9.3f} deg"
        )


def errors_of(trajectory: SmoothedTrajectory, drive: SimulatedDrive) -> Errors:
    """Compare a trajectory with the truth, both relative to their first pose.

    Source: Geiger, Lenz and Urtasun 2012, section 3.1.
    """
    truth = drive.truth.world_from_ego(np.array(trajectory.times_ns))
    true_rotations, true_positions = from_first(matrix_from_quaternion(truth.quaternions_xyzw), truth.positions)
    rotations, positions = from_first(np.array(trajectory.rotations), np.array(trajectory.positions))
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(true_positions, axis=0), axis=1))])
    chunks = []
    for length in CHUNKS:
        for first in range(0, len(along), STEPS_BETWEEN_CHUNKS):
            last = int(np.searchsorted(along, along[first] + length))
            if last >= len(along):
                break
            rotation = rotations[first].T @ rotations[last]
            true_rotation = true_rotations[first].T @ true_rotations[last]
            shift = rotations[first].T @ (positions[last] - positions[first])
            true_shift = true_rotations[first].T @ (true_positions[last] - true_positions[first])
            cosine = np.clip((np.trace(rotation.T @ true_rotation) - 1) / 2, -1, 1)
            apart = float(np.linalg.norm(shift - true_shift))
            chunks.append((100 * apart / length, 100 * np.degrees(np.arccos(cosine)) / length))
    error = positions[-1] - true_positions[-1]
    return Errors(float(along[-1]), float(np.linalg.norm(error)), error, np.array(chunks))


def from_first(rotations: np.ndarray, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses as seen from the first one."""
    return rotations[0].T @ rotations, (positions - positions[0]) @ rotations[0]


def frames_for(metres: float, spec: PathSpec | None = None) -> int:
    """About how many sweeps a trajectory takes."""
    speed = SPEED if spec is None else 0.45 * sum(spec.speeds)
    return max(20, int(10 * metres / speed))


HEADINGS = f"{'':34s}{'trajectory':>9s} {'end':>19s} {'trans':>13s} {'rot/100m':>12s} {'ms cpu':>8s} {'wall':>6s}"


def print_trajectories(
    label: str, drive: SimulatedDrive, mount: Any, kinds: list[type]
) -> list[tuple[SmoothedTrajectory, Errors]]:
    """Follow a drive and print a row for each method."""
    found = [(trajectory, errors_of(trajectory, drive)) for trajectory in follow(drive, kinds, mount)]
    for trajectory, errors in found:
        cpu, wall = trajectory.milliseconds()
        print(f"{label:22s}{trajectory.name:12s}{errors.row()} {cpu:8.1f} {wall:6.1f}", flush=True)
    return found


def drift(options: argparse.Namespace) -> None:
    """Long drives with rotates and traffic."""
    print("drift\n" + HEADINGS)
    kinds = methods()
    ratios: dict[str, list[float]] = {kind.name: [] for kind in kinds[1:]}
    nees = []
    for seed in options.seeds:
        drive = simulate_street(seed, frames=frames_for(options.metres), lidar=DENSE, cameras=(), traffic=BUSY)
        found = print_trajectories(f"seed {seed}", drive, DENSE.mount, kinds)
        nees.append(squared_error(*found[0]))
        for peer, _ in found[1:]:
            ratios[peer.name].append(peer.milliseconds()[1] / found[0][0].milliseconds()[1])
    for name, shares in ratios.items():
        print(f"wall time of {name} over ours: {np.mean(shares):.1f}")
    print(f"squared error at the end over its covariance, per degree of freedom: {np.round(nees, 2)}\n")


def squared_error(trajectory: SmoothedTrajectory, errors: Errors) -> float:
    """The final shift's error in units of its covariance, per degree of freedom."""
    assert trajectory.covariance is not None
    return float(errors.end_vector @ np.linalg.solve(trajectory.covariance[3:, 3:], errors.end_vector)) / 3


LIDARS: dict[str, tuple[Any, PathSpec | None]] = {
    "16 beams": (LidarSpec(beams=16, elevations_deg=(-15.0, 15.0)), None),
    "32 beams": (LidarSpec(beams=32, elevations_deg=(-25.0, 15.0)), None),
    "128 beams": (LidarSpec(beams=128, elevations_deg=(-25.0, 15.0)), None),
    "solid state, raster": (SolidStateSpec(), None),
    "solid state, rosette": (SolidStateSpec(pattern=Rosette()), None),
    "64 beams, 60 deg/s": (DENSE, PathSpec(yaw_rate=1.05, speeds=(4.0, 10.0))),
    "64 beams, 20-33 m/s": (DENSE, PathSpec(speeds=(20.0, 33.0))),
    "64 beams, stops": (DENSE, PathSpec(stops=(Stop(4.0, 3.0), Stop(15.0, 3.0)), ramp=2.0)),
}


def lidars(options: argparse.Namespace) -> None:
    """Other lidars and ways of driving."""
    print("lidars\n" + HEADINGS)
    for label, (spec, path) in LIDARS.items():
        frames = frames_for(options.metres / 4, path)
        drive = simulate_street(options.seeds[0], frames=frames, lidar=spec, cameras=(), traffic=BUSY, path=path)
        print_trajectories(label, drive, spec.mount, methods())
    print()


def stationary(options: argparse.Namespace) -> None:
    """A car that stands among traffic."""
    print("stationary: distance from the first pose [cm], at the end and at most")
    path = PathSpec(stops=(Stop(0.0, options.stand + 10.0),))
    for beams in (16, 64):
        spec = LidarSpec(beams=beams, elevations_deg=(-15.0, 15.0) if beams == 16 else (-24.8, 2.0))
        drive = simulate_street(
            options.seeds[0], frames=int(10 * options.stand), lidar=spec, cameras=(), traffic=BUSY, path=path
        )
        for trajectory in follow(drive, methods(), spec.mount):
            _, positions = from_first(np.array(trajectory.rotations), np.array(trajectory.positions))
            apart = 100 * np.linalg.norm(positions, axis=1)
            print(f"{beams} beams {trajectory.name:12s} {apart[-1]:6.2f} {apart.max():6.2f}", flush=True)
    print()


def deskew(options: argparse.Namespace) -> None:
    """Points in the world against where they come from."""
    print("deskew: distance of world points from the truth [cm], mean and 95th percentile, range noise 0")
    spec = replace(DENSE, range_sigma=0.0)
    drive = simulate_street(
        options.seeds[0], frames=frames_for(options.metres / 8), lidar=spec, cameras=(), traffic=BUSY
    )
    run = lidar_odometry(drive.scene)
    frames = drive.scene.lidars[0].frames
    truth = drive.truth.world_from_ego(run.trajectory.timestamps_ns[:1])
    origin = PoseSource(truth, spec.mount).path
    world = matrix_from_quaternion(origin.quaternions_xyzw[0]), origin.positions[0]
    for label, with_times in (("by point times", True), ("one pose a sweep", False)):
        distances = []
        for k in range(2, len(frames), 5):
            frame = frames[k]
            if not with_times:
                middle = int(np.median(frame.points.timestamps_ns))
                frame = replace(frame, timestamp_ns=middle, points=LidarPoints(frame.points.positions))
            points, _ = points_to_world(frame, PoseSource(run.trajectory.poses, spec.mount))
            clean = drive.truth.clean_points_world(k)
            distances.append(np.linalg.norm(points @ world[0].T + world[1] - clean.positions_world, axis=1))
        every = 100 * np.concatenate(distances)
        print(f"{label:18s} {every.mean():6.2f} {np.quantile(every, 0.95):6.2f}", flush=True)
    print()


def kitti(options: argparse.Namespace) -> None:
    """Real sweeps without truth."""
    if not options.kitti.is_dir():
        print(f"kitti: {options.kitti} is not there\n")
        return
    print(
        "kitti: trajectory [m] from the middle of the first sweep to that of the last; mean distance to the nearest "
        "point of"
    )
    print("the sweep before [cm], all points; those with a partner within 0.5 m")
    with sceneloom.open(options.kitti) as scene:
        lidar = scene.lidars[0]
        frames = list(lidar.frames)
        paths = {"sceneloom": lidar_odometry(scene).trajectory.poses}
        for kind in methods()[1:]:
            paths[kind.name] = path_of(kind(), frames, lidar.mount)
        for name, path in paths.items():
            print(f"{name:12s} {trajectory_between(path, frames):6.3f} " + neighbours(frames, path, lidar.mount))
    print()


def path_of(method: Any, frames: list[LidarFrame], mount: Any) -> Poses:
    """The path that another method finds."""
    poses = [method.add(mount.apply(frame.points.positions), frame) for frame in frames]
    times, rotations, positions = zip(*poses, strict=True)
    return Poses(np.array(times), np.array(positions), quaternion_from_matrix(np.array(rotations)))


def trajectory_between(path: Poses, frames: list[LidarFrame]) -> float:
    """Length of the trajectory from the middle of the first sweep to that of the last [m]."""
    middles = np.array([int(np.median(frame.points.timestamps_ns)) for frame in frames])
    positions = path.interpolate(middles, reach_ns=200_000_000).positions
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())


def neighbours(frames: list[LidarFrame], path: Poses, mount: Any) -> str:
    """Mean distances between the neighbouring points of consecutive sweeps in the world."""
    source = PoseSource(path, mount, reach_ns=200_000_000)
    clouds = [points_to_world(frame, source)[0] for frame in frames]
    apart = np.concatenate([cKDTree(a).query(b)[0] for a, b in pairwise(clouds)])
    return f"{100 * apart.mean():6.3f} {100 * apart[apart < 0.5].mean():6.3f}"


def together(options: argparse.Namespace) -> None:
    """Odometry and fusion of the same sweeps and images, held in memory."""
    print("together: time per sweep, odometry and fusion one after another")
    drive = simulate_street(options.seeds[0], frames=40, lidar=DENSE, cameras=(CameraSpec(),), traffic=BUSY)
    scene = in_memory(drive.scene)
    for label, clock in (("", time.perf_counter), ("wall", time.perf_counter), ("cpu", time.process_time)):
        begun = clock()
        run = lidar_odometry(scene)
        found = clock()
        moved = replace(scene, trajectories={"lidar": run.trajectory})
        fused = sum(1 for _ in iter_fused(moved))
        done = clock()
        if label:  # the first round warms up
            per = [1e3 * (found - begun) / fused, 1e3 * (done - found) / fused]
            print(f"{label:5s} odometry {per[0]:.1f} ms, fusion {per[1]:.1f} ms, both {sum(per):.1f} of 100 ms")
    print()


def in_memory(scene: Scene) -> Scene:
    """The same scene with its sweeps and images made already."""

    def held(frames: Any, made: Callable[[Any], Any] = lambda frame: frame) -> Any:
        return LazyFrames.of([made(frame) for frame in frames], frames.timestamps_ns.tolist())

    def sensors() -> Iterator[Any]:
        for sensor in scene.sensors:
            if hasattr(sensor, "images"):
                yield replace(sensor, images=held(sensor.images, CameraImage.loaded))
            elif hasattr(sensor, "frames"):
                yield replace(sensor, frames=held(sensor.frames))
            else:
                yield sensor

    return replace(scene, sensors=tuple(sensors()))


TABLES = {
    "kitti": kitti,
    "together": together,
    "deskew": deskew,
    "stationary": stationary,
    "lidars": lidars,
    "drift": drift,
}


def main() -> None:
    """Print the tables that are asked for."""
    parser = argparse.ArgumentParser(description="Drift and speed of lidar odometry.")
    parser.add_argument("tables", nargs="*", choices=[[], *TABLES], help="all by default")
    parser.add_argument("--metres", type=float, default=100.0)
    parser.add_argument("--seeds", type=int, nargs="+", default=[20])
    parser.add_argument("--stand", type=float, default=60.0, help="seconds of stationary")
    data = Path(os.environ.get("SCENELOOM_DATA", "../shared/data")) / "recordings" / "kitti_drive"
    parser.add_argument("--kitti", type=Path, default=data, help="the recording kitti_drive")
    options = parser.parse_args()
    for name in options.tables or TABLES:
        TABLES[name](options)


if __name__ == "__main__":
    main()
