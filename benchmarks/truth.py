"""How far the fused drive is from what was really there: visibility, depths and colours over many synthetic streets.

Run with `python -m benchmarks.truth [ROW ...] [--seeds 10] [--first 0] [--hidden 1000]`. Every row is a lidar pattern,
a location of the lidar and some cameras; one sweep of each street is fused, and streets are added until `--seeds` of
them hold `--hidden` hidden points. Only points at least 2 px from the outlines in the true image count.

hidden: points in the image behind something else. coloured: how many of them got a colour all the same; "known": of
those whose concealing surface the lidar could see where it conceals (it lies in the lidar's field of view and nothing
stands before it); "reported": of those behind a surface that two lines beside each other met
(`benchmarks.truth_edges`).
unseen: which share of the known hidden points lies where no line met what conceals them. The others lie at edges,
between the last line on a thing and the next, which misses it. lost: points in plain view that got no colour from that
image; "reported": without those at edges; "least": what a method would lose that is right but at edges, and takes the
best cut there that lets 1 % of the known hidden points pass, the unseen not counted. depth: difference from the true
depth, 99th percentile, at 2 cm of range noise. colour: share of coloured points whose colour lies within one level of
the range of the 3x3 true pixels around the location where they truly are.
"""

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from benchmarks.truth_edges import REPORTED_HIDDEN, REPORTED_SEEN, shares_of_gaps
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.pipeline import iter_fused
from sceneloom.simulate import CameraSpec, LidarSpec, SimulatedDrive, camera_mount, sensor_mount, simulate_street
from sceneloom.simulate.casting import Rays, bundles_by_direction, cast

AIM_PERCENT, AIM_DEPTH = 3.0, 0.02 + 3 * 0.02
MOST_SEEDS = 60

PINHOLE = Camera("pinhole", 1242, 375, 720.0, 720.0, 620.5, 187.0)
LONG = Camera("pinhole", 1920, 1080, 1970.0, 1970.0, 959.5, 539.5)
WIDE = Camera("pinhole", 1280, 800, 500.0, 500.0, 639.5, 399.5)
BROWN = Camera("brown_conrady", 1280, 720, 800.0, 800.0, 639.5, 359.5, (-0.12, 0.04, 0.0004, -0.0003, -0.006))
FISHEYE = Camera("fisheye", 1280, 960, 400.0, 400.0, 639.5, 479.5, (0.03, -0.008, 0.002, -0.0004))

LIDAR_16 = LidarSpec(beams=16, elevations_deg=(-15.0, 15.0))
LIDAR_32 = LidarSpec(beams=32, elevations_deg=(-25.0, 15.0), steps=1200)
LIDAR_64 = LidarSpec()
LIDAR_128 = LidarSpec(beams=128, elevations_deg=(-25.0, 15.0))

FINE_IN_THE_MIDDLE = (
    *np.arange(-25.0, -14.0, 3.7),
    *np.arange(-14.0, -6.0, 1.0),
    *np.arange(-6.0, 2.0, 1 / 6),
    *np.arange(2.0, 15.1, 1.0),
)
UNEVEN = LidarSpec(beams=len(FINE_IN_THE_MIDDLE), elevations_deg=FINE_IN_THE_MIDDLE)


def mount(x: float, y: float, z: float) -> RigidTransform:
    """A lidar's location on the ego, a little off square."""
    return sensor_mount(position=(x, y, z), roll_deg=0.3, pitch_deg=-0.5, yaw_deg=0.8)


ROOF, ABOVE, BESIDE = mount(0.25, 0.02, 1.78), mount(0.5, 0.02, 2.9), mount(0.55, 1.2, 1.7)
BEHIND, HIGH_BEHIND = mount(-0.9, 0.05, 1.9), mount(-0.6, 0.3, 2.4)


def ahead(camera: Camera) -> tuple[CameraSpec, ...]:
    """One camera that looks ahead from (0.55, 0.06, 1.62)."""
    return (CameraSpec(camera, camera_mount(yaw_deg=-0.4, pitch_deg=0.6, roll_deg=0.2)),)


AROUND = (
    *ahead(BROWN),
    CameraSpec(FISHEYE, camera_mount(position=(0.35, 0.45, 1.6), yaw_deg=70.0), 30_000_000),
    CameraSpec(WIDE, camera_mount(position=(0.3, -0.45, 1.6), yaw_deg=-75.0), 75_000_000),
)


@dataclass(frozen=True)
class Row:
    """A rig."""

    lidar: LidarSpec
    location: RigidTransform
    cameras: tuple[CameraSpec, ...]


ROWS = {
    "64 roof": Row(LIDAR_64, ROOF, ahead(PINHOLE)),
    "64 roof, counter": Row(replace(LIDAR_64, clockwise=False), ROOF, ahead(PINHOLE)),
    "64 above": Row(LIDAR_64, ABOVE, ahead(PINHOLE)),
    "64 beside": Row(LIDAR_64, BESIDE, ahead(PINHOLE)),
    "64 behind": Row(LIDAR_64, BEHIND, ahead(PINHOLE)),
    "64 roof, long camera model": Row(LIDAR_64, ROOF, ahead(LONG)),
    "64 above, long camera model": Row(LIDAR_64, ABOVE, ahead(LONG)),
    "64 beside, long camera model": Row(LIDAR_64, BESIDE, ahead(LONG)),
    "64 high behind, wide": Row(LIDAR_64, HIGH_BEHIND, ahead(WIDE)),
    "64 high behind, brown": Row(LIDAR_64, HIGH_BEHIND, ahead(BROWN)),
    "64 high behind, fisheye": Row(LIDAR_64, HIGH_BEHIND, ahead(FISHEYE)),
    "128 roof": Row(LIDAR_128, ROOF, ahead(PINHOLE)),
    "128 above": Row(LIDAR_128, ABOVE, ahead(PINHOLE)),
    "128 high behind, long": Row(LIDAR_128, HIGH_BEHIND, ahead(LONG)),
    "32 roof": Row(LIDAR_32, ROOF, ahead(PINHOLE)),
    "32 above": Row(LIDAR_32, ABOVE, ahead(PINHOLE)),
    "32 beside, counter": Row(replace(LIDAR_32, clockwise=False), BESIDE, ahead(PINHOLE)),
    "32 high behind, long": Row(LIDAR_32, HIGH_BEHIND, ahead(LONG)),
    "32 high behind, three": Row(LIDAR_32, HIGH_BEHIND, AROUND),
    "uneven above, wide": Row(UNEVEN, ABOVE, ahead(WIDE)),
    "uneven high behind": Row(UNEVEN, HIGH_BEHIND, ahead(BROWN)),
    "uneven beside, wide": Row(UNEVEN, BESIDE, ahead(WIDE)),
    "16 roof": Row(LIDAR_16, ROOF, ahead(PINHOLE)),
    "16 above": Row(LIDAR_16, ABOVE, ahead(PINHOLE)),
    "16 beside": Row(LIDAR_16, BESIDE, ahead(PINHOLE)),
}


@dataclass
class Statistics:
    """Counts over all streets of a row."""

    seeds: int = 0
    hidden: int = 0
    coloured: int = 0
    known: int = 0
    known_coloured: int = 0
    visible: int = 0
    lost: int = 0
    unseen: int = 0
    reported: np.ndarray = field(default_factory=lambda: np.zeros((2, 2), np.int64))
    gaps: tuple[list[np.ndarray], list[np.ndarray]] = field(default_factory=lambda: ([], []))
    depths: list[np.ndarray] = field(default_factory=list)
    colours: list[np.ndarray] = field(default_factory=list)

    def line(self) -> str:
        """The row of the table."""
        depth = 100 * np.percentile(np.concatenate(self.depths), 99)
        outside = np.concatenate(self.colours)
        return (
            f"{self.seeds:5} {self.hidden:7} {percent(self.coloured, self.hidden):8.2f} "
            f"{percent(self.known_coloured, self.known):8.2f} {percent(*self.reported[0]):6.2f} "
            f"{percent(self.unseen, self.known):7.2f} "
            f"{self.visible:9} {percent(self.lost, self.visible):6.2f} {percent(*self.reported[1]):6.2f} "
            f"{self.least():6.2f} "
            f"{depth:7.1f} {100 * (outside <= 1).mean():9.2f}"
        )

    def least(self) -> float:
        """What the best cut through the gaps at edges loses, where 1 % of the known hidden points may pass [%]."""
        hidden, visible = (np.concatenate(shares) for shares in self.gaps)
        passed = np.sort(hidden)[::-1]
        most = int(0.01 * (self.known - self.unseen))
        cut = passed[most] if most < len(passed) else 0.0
        return percent(int((visible <= cut).sum()), self.visible)

    def misses(self) -> str:
        """Which aims are missed."""
        depth = np.percentile(np.concatenate(self.depths), 99)
        found = {
            "coloured": percent(self.coloured, self.hidden) > AIM_PERCENT,
            "known": percent(self.known_coloured, self.known) > AIM_PERCENT,
            "lost": percent(self.lost, self.visible) > AIM_PERCENT,
            "depth": depth > AIM_DEPTH,
        }
        return " ".join(name for name, missed in found.items() if missed)


def percent(part: int, whole: int) -> float:
    """Part of the whole, 0 of nothing."""
    return 100 * part / max(1, whole)


def seen_by_lidar(drive: SimulatedDrive, points_world: np.ndarray, ids: np.ndarray) -> np.ndarray:
    """Whether the lidar could see surface points from where it measured the points `ids` of its first sweep."""
    lidar, spec = drive.truth.lidar, drive.truth.lidar.spec
    origins = drive.truth.sweep(0).origins_world[ids]
    apart = points_world - origins
    ranges = np.maximum(np.linalg.norm(apart, axis=1), 1e-9)
    directions = apart / ranges[:, None]
    rays = Rays.bundled(directions, bundles_by_direction(directions), pose_of_ray=np.arange(len(ids)))
    upright = np.broadcast_to(np.eye(3), (len(ids), 3, 3))
    times = lidar.frame(0).points.timestamps_ns[ids]
    hits = cast(drive.truth.street, rays, upright, origins, times, reach=float(ranges.max()) + 1.0)
    rotations = drive.truth.path.at(times).rotations @ spec.mount.rotation
    elevations = np.degrees(np.arcsin(np.einsum("nji,nj->ni", rotations, directions)[:, 2].clip(-1, 1)))
    low, high = spec.elevations_deg[0], spec.elevations_deg[-1]
    free = (hits.ranges == 0) | (hits.ranges > ranges - 0.03)
    return free & (elevations > low) & (elevations < high) & (ranges > spec.min_range)


def first_surface(
    drive: SimulatedDrive, origin: np.ndarray, points_world: np.ndarray, times_ns: np.ndarray
) -> np.ndarray:
    """Where the lines of sight to points behind something end."""
    apart = points_world - origin
    ranges = np.linalg.norm(apart, axis=1)
    directions = apart / ranges[:, None]
    rays = Rays.bundled(directions, bundles_by_direction(directions))
    hits = cast(
        drive.truth.street, rays, np.eye(3)[None], origin[None].copy(), times_ns, reach=float(ranges.max()) + 1.0
    )
    return origin + directions * np.where(hits.ranges == 0, ranges, hits.ranges)[:, None]


def colour_excess(truth: np.ndarray, pixels: np.ndarray, colours: np.ndarray) -> np.ndarray:
    """By how many levels colours lie outside the range of the 3x3 pixels around exact locations, the worst channel."""
    height, width = truth.shape[:2]
    column, row = np.rint(pixels).astype(int).T
    steps = np.mgrid[-1:2, -1:2].reshape(2, -1)
    around = truth[
        (row[:, None] + steps[0]).clip(0, height - 1), (column[:, None] + steps[1]).clip(0, width - 1)
    ].astype(int)
    below, above = around.min(axis=1) - colours.astype(int), colours.astype(int) - around.max(axis=1)
    return np.maximum(np.maximum(below, above), 0).max(axis=1)


def measure(drive: SimulatedDrive, statistics: Statistics) -> None:
    """Fuse the first sweep of a drive and add what is right and wrong to the statistics."""
    statistics.seeds += 1
    fused = next(iter_fused(drive.scene))
    clean = drive.truth.clean_points_world(0)
    for index, view in enumerate(fused.views):
        truth, pose = drive.truth.image(view.camera_id, 0), drive.truth.world_from_camera(view.camera_id, 0)
        points_world = clean.positions_world[view.point_ids]
        free = drive.truth.visible(view.camera_id, 0, clean.positions_world)[view.point_ids]
        edges = drive.truth.edges(view.camera_id, 0)
        column, row = np.rint(view.pixels).astype(int).clip(0, np.array(edges.shape)[::-1] - 1).T
        counted = ~edges[row, column]
        hidden, plain, seen = counted & ~free, counted & free, view.visible
        times_ns = drive.truth.cameras[view.camera_id].timestamps_ns[:1]
        surface = first_surface(drive, pose.translation, points_world[hidden], times_ns)
        known = seen_by_lidar(drive, surface, view.point_ids[hidden])
        statistics.hidden += int(hidden.sum())
        statistics.coloured += int((hidden & seen).sum())
        shares = shares_of_gaps(drive, view, points_world)
        edge = (shares != REPORTED_SEEN) & (shares != REPORTED_HIDDEN)
        is_known = np.zeros_like(hidden)
        is_known[hidden] = known
        statistics.unseen += int((is_known & (shares == REPORTED_SEEN)).sum())
        ours = (is_known, REPORTED_HIDDEN, seen), (plain, REPORTED_SEEN, ~seen)
        for kind, (of_kind, reported, wrong) in enumerate(ours):
            of_reported = of_kind & (shares == reported)
            statistics.reported[kind] += (of_reported & wrong).sum(), of_reported.sum()
            statistics.gaps[kind].append(shares[of_kind & edge])
        statistics.known += int(known.sum())
        statistics.known_coloured += int((known & seen[hidden]).sum())
        statistics.visible += int(plain.sum())
        statistics.lost += int((plain & ~seen).sum())
        in_camera = pose.inverse().apply(points_world)
        statistics.depths.append(np.abs(in_camera[:, 2] - view.depths)[plain & seen])
        mine = plain & seen & (fused.points.camera_index[view.point_ids] == index)
        exact = project(view.camera, in_camera[mine])[0]
        whole = np.isfinite(exact).all(axis=1)
        colours = fused.points.colors[view.point_ids[mine]]
        statistics.colours.append(colour_excess(truth.colors, exact[whole], colours[whole]))


def drives(row: Row, first: int) -> Iterator[SimulatedDrive]:
    """One sweep in each of many streets."""
    for seed in range(first, first + MOST_SEEDS):
        yield simulate_street(seed, frames=1, lidar=replace(row.lidar, mount=row.location), cameras=row.cameras)


def main() -> None:
    """Print a line per row."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rows", nargs="*", help=f"some of: {', '.join(ROWS)}")
    parser.add_argument("--seeds", type=int, default=10, help="at least so many streets")
    parser.add_argument("--first", type=int, default=0, help="the seed of the first street")
    parser.add_argument("--hidden", type=int, default=1000, help="at least so many hidden points, where 60 streets do")
    stated = parser.parse_args()
    if unknown := [name for name in stated.rows if name not in ROWS]:
        parser.error(f"{unknown[0]!r}; rows are {', '.join(ROWS)}")
    heads = "seeds  hidden coloured    known   reported  unseen   visible   lost   reported  least   depth    colour"
    print(f"{'':24} {heads}\n{'':24} {'':13} {'%':>8} {'%':>8} {'%':>6} {'%':>7} {'':9} {'%':>6} {'%':>6} {'%':>6} "
          f"{'p99 cm':>7} {'within %':>9}")  # fmt: skip
    started = time.perf_counter()
    for name in stated.rows or ROWS:
        statistics = Statistics()
        for drive in drives(ROWS[name], stated.first):
            measure(drive, statistics)
            if statistics.seeds >= stated.seeds and statistics.hidden >= stated.hidden:
                break
        print(f"{name:24} {statistics.line()}  {statistics.misses()}", flush=True)
    print(f"aims: coloured and lost under {AIM_PERCENT} %, depth under {100 * AIM_DEPTH:.0f} cm; "
          f"{time.perf_counter() - started:.0f} s")  # fmt: skip


if __name__ == "__main__":
    main()
