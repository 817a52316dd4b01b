"""Dense depth images: how exact, how fast, and whether the confidence means what it says.

    python -m benchmarks.depth held DATA       # real sweeps and simulated: points, or scan lines, held out
    python -m benchmarks.depth rings DATA      # real sweeps: half the rings in, the other half as truth
    python -m benchmarks.depth window DATA     # the same, hidden points reported by a window of pixels
    python -m benchmarks.depth simulated       # simulated streets: every pixel's truth
    python -m benchmarks.depth confidence DATA # share of right pixels by confidence, each set with the others' table
    python -m benchmarks.depth fit DATA        # the table of `sceneloom.colouring.depth_completion`

`held`: of the visible points of a sweep in an image, a fifth is left out, at random or by whole scan lines (PandaSet
does not tell lines, there bands of elevation as high as the lines' distance), and compared with the depth of the
nearest pixel, where all methods have one. A single roof that one line alone has hit may outweigh all else in three
images; `PARTS` may name all five ways of leaving out each fifth line. Sets: KITTI object, two frames of other mirrors
of KITTI, PandaSet, a longer KITTI drive, and streets of other seeds than those on which the method was chosen.

`rings`: of each frame of the KITTI object set in DATA, rings 0, 2, 4, … from the top go in, seen from the camera with
what is hidden taken out as `fuse` does it; truth are the points of the other rings that the camera sees, as the whole
sweep reports, in their nearest pixels. `window`: of both halves, each by itself, what has anything nearer by more than
1 m and 5 % within 10 columns and 7 rows is left out; with this reading of "visibility-filtered" the peers here come to
the figures that others state for them. RMSE, MAE [mm] and iRMSE [1/km] are over the truth pixels that a method fills,
"shared" is the RMSE over those that all methods fill. Milliseconds are processor time of one thread, the least of
several runs, from the samples (or the sparse image) to the image filled.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.colouring import FusedView, LidarTrajectory
from sceneloom.colouring.algorithms import view_points
from sceneloom.colouring.depth_completion import (
    DISTANCE_STEPS,
    SUPPORT_STEPS,
    TOLERANCE,
    TOLERANCE_SHARE,
    Samples,
    complete_depth,
    fill_surfaces,
    pixels_per_radian,
)
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.pipeline import iter_fused
from sceneloom.simulate import CameraSpec, LidarSpec, TrafficSpec, camera_mount, simulate_street

PINHOLE = Camera("pinhole", 1242, 375, 720.0, 720.0, 620.5, 187.0)
ROWS = {"000000-000002": ("000000", "000001", "000002"), "000114": ("000114",)}
REPETITIONS = 5
WINDOW, NEARER, NEARER_SHARE = (15, 21), 1.0, 0.05  # rows and columns; metres


@dataclass(frozen=True)
class Case:
    """An image with what goes in, and what is true."""

    raw: np.ndarray  # all points that fall into the image, hidden ones too
    view: FusedView
    truth: np.ndarray


def drawn(pixels: np.ndarray, depths: np.ndarray, camera: Camera) -> np.ndarray:
    """Depths in their nearest pixels, the least of each."""
    image = np.zeros((camera.height, camera.width), np.float32)
    column, row = np.rint(pixels).astype(int).clip(0, [camera.width - 1, camera.height - 1]).T
    order = np.argsort(-depths, kind="stable")
    image[row[order], column[order]] = depths[order]
    return image


def view_of(
    points: np.ndarray, camera: Camera, world_from_camera: RigidTransform, rgb: np.ndarray, trajectory
) -> FusedView:
    return view_points(
        np.ascontiguousarray(points, np.float64), camera, world_from_camera, rgb, camera_id="camera",
        timestamp_ns=0, trajectory=trajectory,
    )  # fmt: skip


def through_window(view: FusedView) -> FusedView:
    """The view with those points visible that have nothing much nearer in a window of pixels around them."""
    from scipy.ndimage import minimum_filter

    nearest = drawn(view.pixels, view.depths, view.camera)
    nearest = minimum_filter(np.where(nearest > 0, nearest, np.inf), size=WINDOW)
    column, row = np.rint(view.pixels).astype(int).clip(0, [view.camera.width - 1, view.camera.height - 1]).T
    visible = view.depths <= nearest[row, column] * (1 + NEARER_SHARE) + NEARER
    return replace(view, visible=visible, depth_image=drawn(view.pixels[visible], view.depths[visible], view.camera))


def kitti(folder: Path, name: str, *, window: bool = False) -> Case:
    """Half the rings of a frame of the KITTI object set."""
    points, ring, camera, lidar_from_camera, rgb = kitti_object(folder, name)
    at_once = np.zeros((2, 3)), np.zeros(len(points), np.float32)
    return halved(points, ring, camera, lidar_from_camera, rgb, *at_once, window=window)


def kitti_object(folder: Path, name: str):
    numbers = kitti_numbers(folder / "calib" / f"{name}.txt")
    matrices = numbers["P2"], numbers["R0_rect"].reshape(3, 3), numbers["Tr_velo_to_cam"]
    return kitti_frame(folder / "velodyne" / f"{name}.bin", folder / "image_2" / f"{name}.png", *matrices)


def kitti_numbers(path: Path) -> dict[str, np.ndarray]:
    words = [line.replace(":", " ").split() for line in path.read_text().splitlines() if line.strip()]
    return {key: np.array(values, float) for key, *values in words if not key.endswith("time")}


def kitti_frame(sweep: Path, image: Path, projection, upright, mounting):
    """Points, their rings, the camera, its pose in the lidar's frame and the image."""
    from PIL import Image

    rgb = np.array(Image.open(image).convert("RGB"))
    points = np.fromfile(sweep, np.float32).reshape(-1, 4)[:, :3].astype(float)
    projection = projection.reshape(3, 4)
    k, shift, rectified, mounted = projection[:, :3], np.eye(4), np.eye(4), np.eye(4)
    shift[:3, 3] = np.linalg.solve(k, projection[:, 3])
    rectified[:3, :3], mounted[:3] = upright, mounting.reshape(3, 4)
    camera_from_lidar = shift @ rectified @ mounted
    left, _, right = np.linalg.svd(camera_from_lidar[:3, :3])
    lidar_from_camera = RigidTransform(left @ right, camera_from_lidar[:3, 3]).inverse()
    camera = Camera("pinhole", rgb.shape[1], rgb.shape[0], k[0, 0], k[1, 1], k[0, 2], k[1, 2])
    azimuths = np.arctan2(points[:, 1], points[:, 0])  # each ring is written from straight ahead, once around
    begins = (azimuths[1:] >= 0) & (azimuths[:-1] < 0)
    if np.abs(azimuths).max() < np.pi / 2:  # cut to the camera's view
        begins = np.abs(np.diff(azimuths)) > np.radians(20)
    return points, np.concatenate([[0], np.cumsum(begins)]), camera, lidar_from_camera, rgb


def at_once(points, ring, camera, world_from_camera, rgb) -> tuple[FusedView, np.ndarray]:
    trajectory = LidarTrajectory(np.zeros((2, 3)), np.zeros(len(points), np.float32))
    return view_of(points, camera, world_from_camera, rgb, trajectory), ring


def recorded(data: Path, name: str, step: int, *, first: int = 0) -> Iterator[tuple[FusedView, np.ndarray]]:
    scene = sceneloom.open(str(data / "recordings" / name))
    for number, frame in enumerate(iter_fused(scene)):
        if number % step == first:
            points = scene.lidars[0].frames[number].points
            ring = points.rings.astype(int)
            if not ring.any():
                elevations = np.arcsin(points.positions[:, 2] / np.linalg.norm(points.positions, axis=1))
                ring = np.rint(np.degrees(elevations) * 6).astype(int)
            yield from ((view, ring) for view in frame.views)


def kitti_extra(data: Path) -> Iterator[tuple[FusedView, np.ndarray]]:
    folder = data / "real" / "kitti_object_extra" / "mmdet3d_000008"
    stated = json.loads((folder / "000008_infos.json").read_text())["data_list"][0]["images"]["CAM2"]
    projection, mounting = (np.array(stated[key], float)[:3] for key in ("cam2img", "lidar2cam"))
    yield at_once(*kitti_frame(folder / "000008.bin", folder / "000008.png", projection, np.eye(3), mounting))


def kitti_raw(data: Path) -> Iterator[tuple[FusedView, np.ndarray]]:
    folder = data / "real" / "kitti_raw_sfnd"
    numbers = kitti_numbers(folder / "calib_2011_09_26.txt")
    for number in range(3):
        files = folder / "velodyne" / f"{number:010d}.bin", folder / "image_02" / f"{number:010d}.png"
        matrices = numbers["P2"], numbers["R_rect"].reshape(3, 3), numbers["Tr_velo_cam"]
        yield at_once(*kitti_frame(*files, *matrices))


def streets(seeds: Iterable[int]) -> Iterator[tuple[FusedView, np.ndarray]]:
    for seed in seeds:
        drive = street(seed, 64)
        yield next(iter_fused(drive.scene)).views[0], drive.scene.lidars[0].frames[0].points.rings.astype(int)


SIMULATED = "simulated"

SETS: dict[str, Callable[[Path], Iterable[tuple[FusedView, np.ndarray]]]] = {
    "KITTI object": lambda data: (
        at_once(*kitti_object(data / "real" / "kitti_object", name)) for names in ROWS.values() for name in names
    ),
    "KITTI object 000008": kitti_extra,
    "KITTI raw": kitti_raw,
    "PandaSet": lambda data: recorded(data, "pandaset", 1),
    "KITTI drive": lambda data: recorded(data, "kitti_drive_40", 8, first=4),
    SIMULATED: lambda _: streets(range(400, 404)),
}
"""A view and the scan line of each point of the sweep, for each image."""

PROTOCOLS = ("points", "lines")
PARTS = (("points", 0), ("lines", 2))
"""Which fifths are left out, one after another."""


def held_out(view: FusedView, ring: np.ndarray, protocol: str, part: int) -> tuple[FusedView, np.ndarray, np.ndarray]:
    """The view without some visible points; their nearest pixels (N, 2), column and row; their depths (N,)."""
    numbers = np.flatnonzero(view.visible & (view.depths > 0) & np.isfinite(view.depths))
    if protocol == "points":
        left_out = np.random.default_rng(part).random(len(numbers)) < 0.2
    else:
        lines = ring[view.point_ids[numbers]]
        left_out = np.searchsorted(np.unique(lines), lines) % 5 == part
    visible = np.zeros(len(view.visible), bool)
    visible[numbers[~left_out]] = True
    kept = replace(view, visible=visible, depth_image=drawn(view.pixels[visible], view.depths[visible], view.camera))
    pixels = np.rint(view.pixels[numbers[left_out]]).astype(int)
    return kept, pixels.clip(0, [view.camera.width - 1, view.camera.height - 1]), view.depths[numbers[left_out]]


def depths_at(view: FusedView, pixels: np.ndarray) -> dict[str, np.ndarray]:
    """What each method gives at some pixels."""
    from scipy.interpolate import LinearNDInterpolator
    from scipy.spatial import Delaunay, cKDTree

    samples, depths = view.pixels[view.visible], view.depths[view.visible].astype(float)
    distances, near = cKDTree(samples).query(pixels, k=8)
    weights, triangles = 1 / np.maximum(distances, 0.3) ** 2, Delaunay(samples)
    return {
        "Delaunay, inverse depth": np.nan_to_num(1 / LinearNDInterpolator(triangles, 1 / depths)(pixels)),
        "griddata": np.nan_to_num(LinearNDInterpolator(triangles, depths)(pixels)),
        "nearest": depths[near[:, 0]],
        "inverse distance, 8 nearest": (weights * depths[near]).sum(1) / weights.sum(1),
        "complete_depth": complete_depth(view).depths[pixels[:, 1], pixels[:, 0]],
    }


def compare_held_out(data: Path) -> None:
    """Print a row per set, protocol and method, means over images and parts, and ours as multiple of the best peer."""
    for name, views in SETS.items():
        rows: dict[str, dict[str, list[tuple[float, ...]]]] = {protocol: {} for protocol in PROTOCOLS}
        for view, ring in views(data):
            for protocol, part in PARTS:
                kept, pixels, truth = held_out(view, ring, protocol, part)
                found = depths_at(kept, pixels)
                shared = np.all([depths > 0 for depths in found.values()], axis=0)
                for method, depths in found.items():
                    rmse, mae, _ = errors(depths, truth, shared)
                    row = rmse, mae, 100 * (depths > 0).mean(), shared.sum()
                    rows[protocol].setdefault(method, []).append(row)
        for protocol, methods in rows.items():
            means = {method: np.mean(of_images, axis=0) for method, of_images in methods.items()}
            best = np.min([mean[:2] for method, mean in means.items() if method != "complete_depth"], axis=0)
            per_image = np.array([[row[0] for row in of_images] for of_images in methods.values()])
            wins = int((per_image[-1] < per_image[:-1].min(axis=0)).sum())
            count = int(sum(row[3] for row in methods["complete_depth"]))
            print(f"{name}, {protocol} held out: {per_image.shape[1]} times, {count} points; RMSE, MAE [mm], filled")
            for method, (rmse, mae, filled, _) in means.items():
                print(f"  {method:28} {rmse:6.0f} {mae:5.0f} {filled:6.1f}%")
            ratios = means["complete_depth"][:2] / best
            print(f"  of the best peer: {ratios[0]:.2f} {ratios[1]:.2f}; least RMSE {wins} times", flush=True)


def halved(points, ring, camera, world_from_camera, rgb, ends, fractions, *, window: bool = False) -> Case:
    """Even rings in, the visible points of odd ones as truth."""
    even = ring % 2 == 0
    if window:
        one, other = (
            view_of(points[half], camera, world_from_camera, rgb, LidarTrajectory(ends, fractions[half]))
            for half in (even, ~even)
        )
        kept = through_window(other)
        truth = drawn(kept.pixels[kept.visible], kept.depths[kept.visible], camera)
        return Case(drawn(one.pixels, one.depths, camera), through_window(one), truth)
    whole = view_of(points, camera, world_from_camera, rgb, LidarTrajectory(ends, fractions))
    view = view_of(points[even], camera, world_from_camera, rgb, LidarTrajectory(ends, fractions[even]))
    judged = whole.visible & ~even[whole.point_ids]
    truth = drawn(whole.pixels[judged], whole.depths[judged], camera)
    return Case(drawn(view.pixels, view.depths, camera), view, truth)


def street(seed: int, beams: int):
    return simulate_street(
        seed, frames=2, lidar=LidarSpec(beams=beams), cameras=(CameraSpec(PINHOLE, camera_mount()),),
        traffic=TrafficSpec(),
    )  # fmt: skip


def simulated(seed: int, beams: int = 64, *, half: bool = False) -> Case:
    """A sweep of a simulated street, or half its rings; truth is the depth at every pixel's centre, 0 for the sky."""
    drive = street(seed, beams)
    frame = next(iter_fused(drive.scene))
    view = frame.views[0]
    truth = drive.truth.depth("camera0", 0)
    if half:
        ring = beams - 1 - drive.scene.lidars[0].frames[0].points.rings.astype(int)  # 0 is the highest
        points = frame.points.positions.astype(float)
        away = np.median(drive.truth.clean_points_world(0).positions_world - points, axis=0)
        origins = drive.truth.sweep(0).origins_world
        fractions = np.linspace(0, 1, len(points)).astype(np.float32)
        ends = np.ascontiguousarray(origins[[0, -1]] - away)
        view = halved(points, ring, view.camera, view.world_from_camera, view.rgb, ends, fractions).view
    return Case(drawn(view.pixels, view.depths, view.camera), view, truth)


def ip_basic(sparse: np.ndarray) -> np.ndarray:
    """Hole filling by morphology in the published manner, written from the paper's description.

    Source: Ku, Harakeh and Waslander 2018, "In Defense of Classical Image Processing", section III, with the full
    extent of its fills and Gaussian blur; depths are rotated to 100 m minus depth.
    """
    import cv2

    diamond = np.array([[0, 0, 1, 0, 0], [0, 1, 1, 1, 0], [1, 1, 1, 1, 1], [0, 1, 1, 1, 0], [0, 0, 1, 0, 0]], np.uint8)
    near = np.where(sparse > 0.1, 100.0 - sparse, 0.0).astype(np.float32)
    near = cv2.dilate(near, diamond)
    near = cv2.morphologyEx(near, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    near = np.where(near < 0.1, cv2.dilate(near, np.ones((7, 7), np.uint8)), near)
    top = np.argmax(near > 0.1, axis=0)
    above = np.arange(near.shape[0])[:, None] < top
    near = np.where(above, near[top, np.arange(near.shape[1])], near)
    near = np.where(near < 0.1, cv2.dilate(near, np.ones((31, 31), np.uint8)), near)
    near = cv2.medianBlur(near.astype(np.float32), 5)
    near = np.where(near > 0.1, cv2.GaussianBlur(near, (5, 5), 0), near)
    return np.where(near > 0.1, 100.0 - near, 0.0).astype(np.float32)


def delaunay(view: FusedView) -> np.ndarray:
    """Linear in inverse depth over SciPy's triangles; nothing outside the hull."""
    from scipy.interpolate import LinearNDInterpolator

    rows, columns = np.mgrid[: view.camera.height, : view.camera.width]
    inverse = LinearNDInterpolator(view.pixels[view.visible], 1 / view.depths[view.visible])(columns, rows)
    return np.nan_to_num(1 / inverse).astype(np.float32)


def inverse_distance(view: FusedView, *, nearest: int = 8) -> np.ndarray:
    """Mean of the nearest samples, weighted by the inverse square of their distance, in every pixel."""
    from scipy.spatial import cKDTree

    rows, columns = np.mgrid[: view.camera.height, : view.camera.width]
    locations = np.stack([columns.ravel(), rows.ravel()], axis=1)
    distances, near = cKDTree(view.pixels[view.visible]).query(locations, k=nearest)
    weights = 1 / np.maximum(distances, 0.3) ** 2
    depths = (weights * view.depths[view.visible][near]).sum(1) / weights.sum(1)
    return depths.reshape(rows.shape).astype(np.float32)


SIDES: dict[str, Callable[[Case], np.ndarray]] = {
    "morphology, raw input": lambda case: ip_basic(case.raw),
    "morphology, filtered input": lambda case: ip_basic(case.view.depth_image),
    "Delaunay, inverse depth": lambda case: delaunay(case.view),
    "inverse distance, 4 nearest": lambda case: inverse_distance(case.view, nearest=4),
    "inverse distance, 8 nearest": lambda case: inverse_distance(case.view),
    "complete_depth": lambda case: complete_depth(case.view).depths,
}


def errors(depths: np.ndarray, truth: np.ndarray, among: np.ndarray) -> tuple[float, float, float]:
    """RMSE, MAE [mm] and iRMSE [1/km] over some pixels."""
    found, true = depths[among].astype(float), truth[among].astype(float)
    off = found - true
    return (
        1e3 * float(np.sqrt((off**2).mean())),
        1e3 * float(np.abs(off).mean()),
        1e3 * float(np.sqrt(((1 / found - 1 / true) ** 2).mean())),
    )


def least_ms(run: Callable[[], object]) -> float:
    """Processor time of this thread, the least of some runs."""
    taken = []
    for _ in range(REPETITIONS):
        begun = time.thread_time()
        run()
        taken.append(time.thread_time() - begun)
    return 1e3 * min(taken)


def compare(title: str, cases: list[Case]) -> None:
    """Print a row per method, means over the cases."""
    import cv2

    cv2.setNumThreads(1)
    print(f"{title}\n  {'':28} {'RMSE':>6} {'MAE':>5} {'iRMSE':>6} {'filled':>7} {'shared':>7} {'ms':>6}")
    found = {name: [side(case) for case in cases] for name, side in SIDES.items()}
    for name, side in SIDES.items():
        rows = []
        for k, case in enumerate(cases):
            judged = case.truth > 0
            filled = judged & (found[name][k] > 0)
            shared = np.all([found[other][k] > 0 for other in SIDES], axis=0) & judged
            rows.append(
                [*errors(found[name][k], case.truth, filled), 100 * filled.sum() / judged.sum(),
                 errors(found[name][k], case.truth, shared)[0]]
            )  # fmt: skip
        rmse, mae, irmse, share, together = np.mean(rows, axis=0)
        taken = least_ms(lambda side=side: side(cases[0]))
        print(f"  {name:28} {rmse:6.0f} {mae:5.0f} {irmse:6.2f} {share:6.1f}% {together:7.0f} {taken:6.1f}", flush=True)


def right(depths: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Which pixels are within the tolerance; the sky is wrong."""
    return (truth > 0) & (np.abs(depths - truth) < np.maximum(TOLERANCE, TOLERANCE_SHARE * truth))


SHAPE = len(SUPPORT_STEPS) + 1, len(DISTANCE_STEPS) + 1
BORDERS = np.array([0.0, 0.5, 0.7, 0.8, 0.9, 0.95, 1.01])

Counts = dict[tuple[str, str], np.ndarray]
"""By set and protocol: (2, S, D), how many pixels there are of each cell of the table, and how many are right."""


def cells_of(view: FusedView) -> tuple[np.ndarray, np.ndarray]:
    """The depths of a view, and the cell of the table of each pixel."""
    filled = fill_surfaces(Samples.of_view(view), view.rgb, pixels_per_radian(view.camera))
    support = np.searchsorted(SUPPORT_STEPS, filled.supports, "right")
    return filled.depths, support * SHAPE[1] + np.searchsorted(DISTANCE_STEPS, filled.distances, "right")


def count_cells(data: Path) -> Counts:
    counts: Counts = {}

    def add(key: tuple[str, str], depths: np.ndarray, cell: np.ndarray, truth: np.ndarray) -> None:
        among = depths > 0
        both = cell[among], cell[among & right(depths, truth)]
        found = np.stack([np.bincount(one, minlength=SHAPE[0] * SHAPE[1]).reshape(SHAPE) for one in both])
        counts[key] = counts.get(key, np.zeros((2, *SHAPE))) + found

    for name, views in SETS.items():
        for view, ring in views(data) if name != SIMULATED else ():
            for protocol, part in PARTS:
                kept, pixels, truth = held_out(view, ring, protocol, part)
                at = pixels[:, 1], pixels[:, 0]
                add((name, protocol), *(image[at] for image in cells_of(kept)), truth)
    for seed in range(100, 106):
        for beams in (64, 32):
            case = simulated(seed, beams)
            add((SIMULATED, "every pixel"), *cells_of(case.view), case.truth)
    return counts


def fitted(counts: Counts) -> np.ndarray:
    """The table (S, D) of some sets, each protocol of each with the same weight."""
    count, good = sum(found / found[0].sum() for found in counts.values()) * 1e5
    by_support = good.sum(1, keepdims=True) / np.maximum(count.sum(1, keepdims=True), 1)
    shares, weights = (good + 200 * by_support) / (count + 200), count + 200  # few pixels: as their row
    table = np.empty(SHAPE)
    surfaces = int(np.searchsorted(SUPPORT_STEPS, 1.0)) + 1
    for rows in (slice(0, surfaces), slice(surfaces, None)):
        table[rows] = falling(shares[rows][::-1], weights[rows][::-1])[::-1]
    return table


def falling(shares: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Make a table fall along both axes, by averaging over neighbours that do not, as often as needed."""
    table = shares.copy()
    for _ in range(200):
        for axis in (0, 1):
            first, second = (table[:-1], table[1:]) if axis == 0 else (table[:, :-1], table[:, 1:])
            here, there = (counts[:-1], counts[1:]) if axis == 0 else (counts[:, :-1], counts[:, 1:])
            rising = second > first
            mean = (first * here + second * there) / (here + there)
            first[rising], second[rising] = mean[rising], mean[rising]
    return np.minimum.accumulate(np.minimum.accumulate(table, axis=0), axis=1)


def show_confidence(data: Path) -> None:
    """Print for each set, with the table of the others, the share of right pixels by stated confidence."""
    counts = count_cells(data)
    for name in SETS:
        table = fitted({key: found for key, found in counts.items() if key[0] != name})
        own = {protocol: found for (owner, protocol), found in counts.items() if owner == name}
        for protocol, (count, good) in ({**own, "both": sum(own.values())} if len(own) > 1 else own).items():
            at = np.searchsorted(BORDERS, table, "right") - 1
            total, hits, stated = (
                np.bincount(at.ravel(), one.ravel(), minlength=len(BORDERS) - 1) for one in (count, good, count * table)
            )
            texts = [_reliability(s / n, h, n) if n else "-" for n, h, s in zip(total, hits, stated, strict=True)]
            print(f"  {name:20} {protocol:12} stated: right % (interval; n)  " + "   ".join(texts), flush=True)


RELIABLE = 0.05  # how far the share of right pixels may be from the stated confidence


def interval(hits: float, count: float) -> tuple[float, float]:
    """Where a rate lies with 95 %, of so many hits. Source: Wilson 1927."""
    z2 = 1.96**2
    middle, width = hits + z2 / 2, 1.96 * np.sqrt(hits * (count - hits) / count + z2 / 4)
    return (middle - width) / (count + z2), (middle + width) / (count + z2)


def _reliability(stated: float, hits: float, count: float) -> str:
    """One bin; `!` where it misses, `?` where its pixels are too few to say."""
    low, high = interval(hits, count)
    within = stated - RELIABLE <= low and high <= stated + RELIABLE
    missed = high < stated - RELIABLE or low > stated + RELIABLE
    mark = "" if within else "!" if missed else "?"
    return f"{100 * stated:.0f}: {100 * hits / count:.0f}{mark} ({100 * low:.0f}-{100 * high:.0f}; {count:.0f})"


def fit(data: Path) -> None:
    """Print the table of confidence of all sets."""
    for row in fitted(count_cells(data)):
        print("    (" + ", ".join(f"{value:.3f}" for value in row) + "),")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["held", "rings", "window", "simulated", "confidence", "fit"])
    parser.add_argument("data", nargs="?", type=Path, help="the folder of real data")
    stated = parser.parse_args()
    if stated.what == "simulated":
        compare("simulated streets, 64 beams, every pixel that is no sky", [simulated(seed) for seed in range(20, 24)])
        return
    if stated.data is None:
        parser.error("state where the real data are")
    if stated.what in ("rings", "window"):
        for title, names in ROWS.items():
            folder, heading = (stated.data / "real" / "kitti_object", f"KITTI object {title}, every other ring in")
            compare(heading, [kitti(folder, name, window=stated.what == "window") for name in names])
    else:
        {"held": compare_held_out, "confidence": show_confidence, "fit": fit}[stated.what](stated.data)


if __name__ == "__main__":
    main()
