"""Dense depth images: how exact, how fast, and whether the confidence means what it says.

    python -m benchmarks.depth rings DATA      # real sweeps: half the rings in, the other half as truth
    python -m benchmarks.depth window DATA     # the same, hidden points reported by a window of pixels
    python -m benchmarks.depth simulated       # simulated streets: every pixel's truth
    python -m benchmarks.depth confidence DATA # share of right pixels by confidence
    python -m benchmarks.depth fit             # the tables of `sceneloom.colouring.depth_completion`

`rings`: of each frame of the KITTI object set in DATA, rings 0, 2, 4, … from the top go in, seen from the camera with
what is hidden taken out as `fuse` does it; truth are the points of the other rings that the camera sees, as the whole
sweep reports, in their nearest pixels. `window`: of both halves, each by itself, what has anything nearer by more than
1 m and 5 % within 10 columns and 7 rows is left out; with this reading of "visibility-filtered" the peers here come to
the figures that others state for them. RMSE, MAE [mm] and iRMSE [1/km] are over the truth pixels that a method fills,
"shared" is the RMSE over those that all methods fill. Milliseconds are processor time of one thread, the least of
several runs, from the samples (or the sparse image) to the image filled.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sceneloom.cameras.camera import Camera
from sceneloom.colouring import FusedView, LidarTrajectory
from sceneloom.colouring.algorithms import view_points
from sceneloom.colouring.depth_completion import (
    DOUBT_STEPS,
    GAP_STEPS,
    METHODS,
    SLOPE_SHARE,
    TOLERANCE,
    TOLERANCE_SHARE,
    Samples,
    complete_depth,
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
    from PIL import Image

    calib = dict(line.split(":", 1) for line in (folder / "calib" / f"{name}.txt").read_text().splitlines() if line)
    numbers = {key: np.array(text.split(), float) for key, text in calib.items()}
    rgb = np.array(Image.open(folder / "image_2" / f"{name}.png").convert("RGB"))
    points = np.fromfile(folder / "velodyne" / f"{name}.bin", np.float32).reshape(-1, 4)[:, :3].astype(float)
    projection = numbers["P2"].reshape(3, 4)
    k, shift = projection[:, :3], np.eye(4)
    shift[:3, 3] = np.linalg.solve(k, projection[:, 3])
    upright, mounting = np.eye(4), np.eye(4)
    upright[:3, :3], mounting[:3] = numbers["R0_rect"].reshape(3, 3), numbers["Tr_velo_to_cam"].reshape(3, 4)
    camera_from_lidar = shift @ upright @ mounting
    left, _, right = np.linalg.svd(camera_from_lidar[:3, :3])
    lidar_from_camera = RigidTransform(left @ right, camera_from_lidar[:3, 3]).inverse()
    camera = Camera("pinhole", rgb.shape[1], rgb.shape[0], k[0, 0], k[1, 1], k[0, 2], k[1, 2])
    azimuths = np.arctan2(points[:, 1], points[:, 0])  # each ring is written from straight ahead, once around
    ring = np.concatenate([[0], np.cumsum((azimuths[1:] >= 0) & (azimuths[:-1] < 0))])
    at_once = np.zeros((2, 3)), np.zeros(len(points), np.float32)
    return halved(points, ring, camera, lidar_from_camera, rgb, *at_once, window=window)


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


def simulated(seed: int, beams: int = 64, *, half: bool = False) -> Case:
    """A sweep of a simulated street, or half its rings; truth is the depth at every pixel's centre, 0 for the sky."""
    drive = simulate_street(
        seed, frames=2, lidar=LidarSpec(beams=beams), cameras=(CameraSpec(PINHOLE, camera_mount()),),
        traffic=TrafficSpec(),
    )  # fmt: skip
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
    "fast": lambda case: complete_depth(case.view, method="fast").depths,
    "quality": lambda case: complete_depth(case.view, method="quality").depths,
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


def show_confidence(title: str, cases: list[Case], *, sky: bool) -> None:
    """Print the share of right pixels by confidence."""
    borders = np.array([0.0, 0.5, 0.7, 0.8, 0.9, 0.95, 1.01])
    print(title)
    for method in METHODS:
        total, good, stated = np.zeros(6), np.zeros(6), np.zeros(6)
        for case in cases:
            dense = complete_depth(case.view, method=method)
            among = (dense.depths > 0) if sky else (dense.depths > 0) & (case.truth > 0)
            at = np.searchsorted(borders, dense.confidence[among], "right") - 1
            total += np.bincount(at, minlength=6)
            good += np.bincount(at, right(dense.depths, case.truth)[among], minlength=6)
            stated += np.bincount(at, dense.confidence[among], minlength=6)
        cells = [
            f"{100 * stated[k] / total[k]:.0f}: {100 * good[k] / total[k]:.1f} ({100 * total[k] / total.sum():.0f})"
            if total[k] else "-" for k in range(6)
        ]  # fmt: skip
        print(f"  {method:8} stated: right % (of all %)  " + "   ".join(cells))


def bins(method: str, view: FusedView) -> tuple[np.ndarray, np.ndarray]:
    """The depths of a method, and the cell of the confidence table of each pixel."""
    filled = METHODS[method](Samples.of_view(view), view.rgb, pixels_per_radian(view.camera))
    share = 1 - filled.trusts * (1 - SLOPE_SHARE)
    allowed = np.maximum(TOLERANCE, TOLERANCE_SHARE * filled.depths)
    doubt = np.searchsorted(DOUBT_STEPS, share * filled.spreads / allowed, "right")
    gap = np.searchsorted(GAP_STEPS, filled.gaps / max(filled.spacing, 1.0), "right")
    return filled.depths, doubt * (len(GAP_STEPS) + 1) + gap


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


def training_cases() -> Iterator[Case]:
    """Streets of other seeds than the tables of results are made of."""
    for seed in range(100, 106):
        for beams, half in ((64, False), (64, True), (32, False)):
            yield simulated(seed, beams, half=half)


def fit() -> None:
    """Print the tables of confidence."""
    cells = (len(DOUBT_STEPS) + 1) * (len(GAP_STEPS) + 1)
    counts, good = ({method: np.zeros(cells) for method in METHODS} for _ in range(2))
    for case in training_cases():
        for method in METHODS:
            depths, cell = bins(method, case.view)
            among = depths > 0
            counts[method] += np.bincount(cell[among], minlength=cells)
            good[method] += np.bincount(cell[among], right(depths, case.truth)[among], minlength=cells)
    for method in METHODS:
        shape = (len(DOUBT_STEPS) + 1, len(GAP_STEPS) + 1)
        count, hits = counts[method].reshape(shape), good[method].reshape(shape)
        by_doubt = hits.sum(1, keepdims=True) / np.maximum(count.sum(1, keepdims=True), 1)
        table = falling((hits + 200 * by_doubt) / (count + 200), count + 200)  # few pixels: as their row
        print(f'        "{method}": (')
        for row in table:
            print("            (" + ", ".join(f"{value:.3f}" for value in row) + "),")
        print("        ),")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["rings", "window", "simulated", "confidence", "fit"])
    parser.add_argument("data", nargs="?", type=Path, help="the folder of real data")
    stated = parser.parse_args()
    if stated.what == "fit":
        fit()
    if stated.what == "simulated":
        compare("simulated streets, 64 beams, every pixel that is no sky", [simulated(seed) for seed in range(20, 24)])
    if stated.what == "confidence":
        show_confidence("simulated streets, whole sweeps", [simulated(seed) for seed in range(20, 24)], sky=True)
    if stated.what in ("rings", "window", "confidence"):
        if stated.data is None:
            parser.error("state where the real data are")
        for title, names in ROWS.items():
            folder, heading = (stated.data / "real" / "kitti_object", f"KITTI object {title}, every other ring in")
            cases = [kitti(folder, name, window=stated.what == "window") for name in names]
            if stated.what == "confidence":
                show_confidence(heading, cases, sky=False)
            else:
                compare(heading, cases)


if __name__ == "__main__":
    main()
