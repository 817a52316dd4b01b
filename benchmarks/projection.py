"""How fast a cloud is fused with one image: projection, visibility, depth image and colours on one thread.

Run with `python -m benchmarks.projection [--points 250000] [--repetitions 15]`. The cloud is a simulated street seen by
a dense lidar 0.6 m above a 1920x1080 camera with five distortion coefficients; nearly all its points fall into the
image. Peers do the same work: the textbook in NumPy, `cv2.projectPoints` with NumPy for the rest, and for the
visibility rule a NumPy version that takes the same decisions; "with trajectory" it is also known from where the lidar
measured. All take rotates; figures are medians of processor time, which other programs on the machine do not stretch.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import time
from collections.abc import Callable

import numpy as np

from benchmarks.street import CAMERA_WORLD, LIDAR_WORLD, make_street
from benchmarks.visibility_in_numpy import find_visible_in_numpy
from sceneloom.cameras.camera import Camera
from sceneloom.colouring import LidarTrajectory, ViewRequest, VisibilitySettings, fuse_by_projection
from sceneloom.geometry.rigid import RigidTransform

WIDTH, HEIGHT = 1920, 1080
CAMERA = Camera("brown_conrady", WIDTH, HEIGHT, 1100.0, 1100.0, 959.5, 539.5, (-0.1, 0.02, 5e-4, -3e-4, 1e-3))
CAMERA_FROM_BODY = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])

Fusion = Callable[[], tuple[np.ndarray, np.ndarray]]


def distort(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The five-coefficient camera model, as textbooks write it."""
    k1, k2, p1, p2, k3 = CAMERA.coefficients
    s, xy = x * x + y * y, x * y
    radial = 1 + s * (k1 + s * (k2 + s * k3))
    u = CAMERA.fx * (x * radial + 2 * p1 * xy + p2 * (s + 2 * x * x)) + CAMERA.cx
    v = CAMERA.fy * (y * radial + p1 * (s + 2 * y * y) + 2 * p2 * xy) + CAMERA.cy
    return u, v


def inside_image(u: np.ndarray, v: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Ids of the points in front of the camera whose pixel is in the image."""
    return np.flatnonzero((z > 0) & (u >= -0.5) & (u < WIDTH - 0.5) & (v >= -0.5) & (v < HEIGHT - 0.5))


def project_with_numpy(points: np.ndarray, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ids, pixel numbers and depths of the points in the image."""
    x, y, z = (points @ matrix[:3, :3].T + matrix[:3, 3]).T
    u, v = distort(x / z, y / z)
    ids = inside_image(u, v, z)
    return (ids, np.floor(v[ids] + 0.5).astype(np.int64) * WIDTH + np.floor(u[ids] + 0.5).astype(np.int64), z[ids])


def project_with_cv2(points: np.ndarray, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same with OpenCV's projection."""
    import cv2

    cv2.setNumThreads(1)
    camera_model = np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]])
    rotation = cv2.Rodrigues(matrix[:3, :3])[0]
    u, v = cv2.projectPoints(points, rotation, matrix[:3, 3], camera_model, np.array(CAMERA.coefficients))[0][:, 0].T
    z = points @ matrix[2, :3] + matrix[2, 3]
    ids = inside_image(u, v, z)
    return (ids, np.floor(v[ids] + 0.5).astype(np.int64) * WIDTH + np.floor(u[ids] + 0.5).astype(np.int64), z[ids])


def draw(ids: np.ndarray, cells: np.ndarray, depths: np.ndarray, rgb: np.ndarray, count: int, seen: np.ndarray | None):
    """Depth image and colours; without `seen`, the nearest points of each pixel are seen."""
    depths = depths.astype(np.float32)
    image = np.full(HEIGHT * WIDTH, np.inf, np.float32)
    if seen is None:
        np.minimum.at(image, cells, depths)
        seen = depths <= image[cells]
    else:
        np.minimum.at(image, cells[seen], depths[seen])
    image[np.isinf(image)] = 0
    colors = np.full((count, 3), 255, np.uint8)
    colors[ids[seen]] = rgb.reshape(-1, 3)[cells[seen]]
    return image.reshape(HEIGHT, WIDTH), colors


def take_rotations(contenders: dict[str, Fusion], repetitions: int) -> dict[str, float]:
    """Median milliseconds of each, run one after the other, again and again."""
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for repetition in range(repetitions + 1):
        for name, run in contenders.items():
            start = time.process_time()
            run()
            if repetition:
                times[name].append(1e3 * (time.process_time() - start))
    return {name: float(np.median(values)) for name, values in times.items()}


def agreement(ours: tuple[np.ndarray, np.ndarray], theirs: tuple[np.ndarray, np.ndarray]) -> str:
    """In words: equal decisions (unseen points have the colour 255, which the image lacks), colours, depths."""
    both = (ours[0] > 0) & (theirs[0] > 0)
    only_one = ((ours[0] > 0) != (theirs[0] > 0)).sum()
    equal = (ours[1] == theirs[1]).all(axis=1).mean()
    decisions = ((ours[1][:, 0] == 255) == (theirs[1][:, 0] == 255)).mean()
    difference = np.abs(ours[0] - theirs[0])[both].max()
    return (
        f"{100 * decisions:.3f} % equal decisions, {100 * equal:.3f} % equal colours, "
        f"depths differ by at most {difference:.1g} m, {only_one} pixels with depth in one only"
    )


def main() -> None:
    """Run all and print our figure, the peer's and the ratio."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=250_000)
    parser.add_argument("--repetitions", type=int, default=15)
    stated = parser.parse_args()
    points = make_street(stated.points)
    rgb = np.random.default_rng(1).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    pose = RigidTransform(CAMERA_FROM_BODY, -CAMERA_FROM_BODY @ CAMERA_WORLD).inverse()
    matrix = pose.inverse().matrix
    request = ViewRequest(
        camera_id="front", camera_index=0, camera=CAMERA, timestamp_ns=0, world_from_camera=pose, rgb=rgb
    )

    trajectory = LidarTrajectory(np.tile(LIDAR_WORLD, (2, 1)), np.zeros(len(points), np.float32))

    def ours(*, enabled: bool) -> tuple[np.ndarray, np.ndarray]:
        fused = fuse_by_projection(points, [request], VisibilitySettings(enabled=enabled))
        return fused.views[0].depth_image, fused.colors

    def ours_with_trajectory() -> tuple[np.ndarray, np.ndarray]:
        fused = fuse_by_projection(points, [request], VisibilitySettings(), trajectory=trajectory)
        return fused.views[0].depth_image, fused.colors

    def windowed_in_numpy() -> tuple[np.ndarray, np.ndarray]:
        ids, cells, depths = project_with_numpy(points, matrix)
        seen = find_visible_in_numpy(points[ids], matrix, VisibilitySettings())
        return draw(ids, cells, depths, rgb, len(points), seen)

    contenders: dict[str, Fusion] = {
        "plain": lambda: ours(enabled=False),
        "windowed": lambda: ours(enabled=True),
        "with trajectory": ours_with_trajectory,
        "textbook NumPy": lambda: draw(*project_with_numpy(points, matrix), rgb, len(points), None),
        "cv2 + NumPy": lambda: draw(*project_with_cv2(points, matrix), rgb, len(points), None),
        "windowed in NumPy": windowed_in_numpy,
    }
    medians = take_rotations(contenders, stated.repetitions)
    results = {name: run() for name, run in contenders.items()}
    share = len(project_with_numpy(points, matrix)[0]) / len(points)
    print(f"{len(points)} points, {100 * share:.0f} % of them in a {WIDTH}x{HEIGHT} image, one thread")
    for name, peer, aim in (
        ("plain", "textbook NumPy", 0.25),
        ("plain", "cv2 + NumPy", 0.12),
        ("windowed", "windowed in NumPy", 0.15),
        ("windowed", "plain", 2.0),
        ("with trajectory", "plain", 2.0),
    ):
        ratio = medians[name] / medians[peer]
        print(f"{name:9} {medians[name]:6.1f} ms, {peer:18} {medians[peer]:6.1f} ms, ratio {ratio:.3f} (aim {aim})")
        if peer != "plain":
            print(f"{'':10}{agreement(results[name], results[peer])}")


if __name__ == "__main__":
    main()
