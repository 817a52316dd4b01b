"""How fast camera models project points and unproject pixels, each model on one thread.

Against OpenCV where it has the model.

Run with `python -m benchmarks.cameras [--points 200000] [--repetitions 15]`. The pixels are spread evenly over the
image, the points lie on their rays at 1 to 50 m. Both sides take and give arrays as their callers have them; ours
decide for each point, too, whether the camera model sees it at all. All take rotates; figures are medians of processor
time, which other programs on the machine do not stretch. The residual says how many pixels the rays are off, at most,
when they are projected again: OpenCV as it comes, and with its iterations reported to go on to 1e-10.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from sceneloom.cameras import Camera, project_unbounded, unproject

SIZE = (1920, 1080, 1100.0, 1105.0, 959.5, 539.5)
WIDE = (1920, 1080, 800.0, 800.0, 959.5, 539.5)
RATIONAL = (0.4461, -0.1213, 1.7e-4, -2.5e-4, 0.0035, 0.8021, -0.0771, 0.0110)
PRISM_AND_TILT = (1e-3, -2e-4, -1.5e-3, 3e-4, 0.02, -0.03)
ASYMMETRIC = (0.01, 0.002, 1e-3, 0.5, 0.3, -0.2, 0.1, 4e-3, -2e-3, 1e-3, 0.2, 0.3, -0.2, 0.1)

CAMERA_MODELS: Mapping[str, Camera] = {
    "pinhole": Camera("pinhole", *SIZE),
    "brown_conrady, 5": Camera("brown_conrady", *SIZE, (-0.3437, 0.1402, 3.1e-4, -8.2e-4, -0.0271)),
    "brown_conrady, 8": Camera("brown_conrady", *SIZE, RATIONAL),
    "brown_conrady, 14": Camera("brown_conrady", *SIZE, (*RATIONAL, 0.0, 0.0, *PRISM_AND_TILT)),
    "fisheye": Camera("fisheye", *WIDE, (-0.0284, 0.0021, -0.0052, 4e-4)),
    "omnidir": Camera("omnidir", 1920, 1080, 2200.0, 2200.0, 959.5, 539.5, (-0.21, 0.034, 1.7, 1.23, 5e-4, -8e-4)),
    "mod_equi_fish": Camera("mod_equi_fish", *WIDE, (0.0, -0.02, 0.004, -0.001)),
    "mod_kannala": Camera("mod_kannala", *WIDE, (0.02, -0.01, 0.002, 0.0)),
    "cylindrical": Camera("cylindrical", *WIDE),
    "equirectangular": Camera("equirectangular", *WIDE),
    "omnidirectional": Camera(
        "omnidirectional", 1920, 1080, 2200.0, 2200.0, 959.5, 539.5, (-0.2, 0.03, 0, 0, 5e-4, -8e-4, 1.2)
    ),
    "fisheye_rad_tan_prism": Camera(
        "fisheye_rad_tan_prism", *WIDE, (-0.03, 2e-3, -5e-3, 4e-4, 0, 0, 5e-4, -3e-4, 1e-3, -2e-4, 5e-4, 1e-4)
    ),
    "fisheye_radial_custom": Camera(
        "fisheye_radial_custom", *WIDE, (-0.03, 2e-3, -5e-3, 4e-4, 0, 0, 5e-4, -3e-4, 1e-3, 2e-3)
    ),
    "ftheta": Camera("ftheta", *WIDE, (0.0, 800.0, -4.0, 1.5, -0.5)),
    "kannala_brandt18": Camera("kannala_brandt18", *WIDE, (-0.0284, 0.0021, -0.0052, 4e-4, *ASYMMETRIC)),
}
AIMS: Mapping[str, tuple[float, float]] = {
    "brown_conrady, 8": (15.0, 1.0),
    "brown_conrady, 14": (15.0, 1.0),
    "fisheye": (4.0, 1.0),
}
"""How many times as fast as OpenCV: projecting, unprojecting."""

EXACT_PX = 1e-6
EXACTLY = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)
ORIGIN = np.zeros(3)

Job = Callable[[], np.ndarray]


@dataclass(frozen=True)
class Peer:
    """What OpenCV does of a model.

    Attributes:
        project: pixels of points.
        unproject: locations on the plane z = 1 of pixels; as it comes.
        exactly: the same with the iterations reported to go on, None where it cannot be reported.
    """

    project: Job
    unproject: Job
    exactly: Job | None = None


def perspective_peer(camera: Camera, points: np.ndarray, pixels: np.ndarray) -> Peer:
    """OpenCV's model with 5, 8 or 14 coefficients."""
    given = camera.coefficients
    numbers = np.array(given if len(given) <= 8 else (*given[:8], *given[10:])) if given else np.zeros(5)
    pixels = pixels[:, None]
    return Peer(
        lambda: cv2.projectPoints(points, ORIGIN, ORIGIN, camera.matrix, numbers)[0],
        lambda: cv2.undistortPoints(pixels, camera.matrix, numbers),
        lambda: (
            cv2.undistortPointsIter(pixels, camera.matrix, numbers, None, None, EXACTLY)
            if hasattr(cv2, "undistortPointsIter")
            else cv2.undistortPoints(pixels, camera.matrix, numbers, criteria=EXACTLY)
        ),
    )


def fisheye_peer(camera: Camera, points: np.ndarray, pixels: np.ndarray) -> Peer:
    """OpenCV's fisheye model."""
    numbers, points, pixels = np.array(camera.coefficients), points[:, None], pixels[:, None]
    return Peer(
        lambda: cv2.fisheye.projectPoints(points, ORIGIN, ORIGIN, camera.matrix, numbers)[0],
        lambda: cv2.fisheye.undistortPoints(pixels, camera.matrix, numbers),
        lambda: cv2.fisheye.undistortPoints(pixels, camera.matrix, numbers, criteria=EXACTLY),
    )


def omnidir_peer(camera: Camera, points: np.ndarray, pixels: np.ndarray) -> Peer:
    """OpenCV's omnidirectional model."""
    k1, k2, skew, xi, p1, p2 = camera.coefficients
    matrix, numbers, strength = camera.matrix, np.array([[k1, k2, p1, p2]]), np.array([xi])
    matrix[0, 1] = skew
    points, pixels = points[:, None], pixels[:, None]
    return Peer(
        lambda: cv2.omnidir.projectPoints(points, ORIGIN, ORIGIN, matrix, xi, numbers)[0],
        lambda: cv2.omnidir.undistortPoints(pixels, matrix, numbers, strength, np.eye(3)),
    )


PEERS: Mapping[str, Callable[[Camera, np.ndarray, np.ndarray], Peer]] = {
    "pinhole": perspective_peer,
    "brown_conrady": perspective_peer,
    "fisheye": fisheye_peer,
    "omnidir": omnidir_peer,
}


def make_points(camera: Camera, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Pixels all over what the camera model sees of the image, (count, 2) [px], and points on their rays, (count.

    3) [m].
    """
    random = np.random.default_rng(0)
    pixels = random.uniform((-0.5, -0.5), (camera.width - 0.5, camera.height - 0.5), (2 * count, 2))
    rays = unproject(camera, pixels)
    seen = np.flatnonzero(np.isfinite(rays).all(axis=1))[:count]
    return pixels[seen], rays[seen] * random.uniform(1.0, 50.0, (len(seen), 1))


def take_rotations(jobs: Mapping[str, Job], repetitions: int) -> dict[str, float]:
    """Median seconds of each, run one after the other, again and again."""
    times: dict[str, list[float]] = {name: [] for name in jobs}
    for repetition in range(repetitions + 1):
        for name, run in jobs.items():
            start = time.process_time()
            run()
            if repetition:
                times[name].append(time.process_time() - start)
    return {name: float(np.median(values)) for name, values in times.items()}


def residual_px(camera: Camera, rays_or_locations: np.ndarray, pixels: np.ndarray) -> float:
    """How far off the pixels are that rays, or locations on the plane z = 1, fall on, at most."""
    found = rays_or_locations.reshape(len(pixels), -1)
    if found.shape[1] == 2:
        found = np.column_stack([found, np.ones(len(found))])
    off = np.hypot(*(project_unbounded(camera, found) - pixels).T)
    return float(np.where(np.isnan(off), np.inf, off).max())


def measure(name: str, camera: Camera, count: int, repetitions: int) -> None:
    """Print the row of one camera model."""
    pixels, points = make_points(camera, count)
    jobs: dict[str, Job] = {
        "project": lambda: project_unbounded(camera, points),
        "unproject": lambda: unproject(camera, pixels),
    }
    peer = PEERS[camera.model](camera, points, pixels) if camera.model in PEERS else None
    if peer is not None:
        jobs |= {"their project": peer.project, "their unproject": peer.unproject}
        jobs |= {"their exact unproject": peer.exactly} if peer.exactly is not None else {}
    seconds = take_rotations(jobs, repetitions)
    rate = {job: count / median / 1e6 for job, median in seconds.items()}
    ours_px = residual_px(camera, unproject(camera, pixels), pixels)
    row = f"{name:22} {rate['project']:8.1f} {rate['unproject']:10.1f} {ours_px:10.1e}"
    if peer is not None:
        row += _compared(name, camera, pixels, peer, rate)
    print(row + ("" if ours_px <= EXACT_PX else f"  BEYOND {EXACT_PX:g} px"))


def _compared(name: str, camera: Camera, pixels: np.ndarray, peer: Peer, rate: Mapping[str, float]) -> str:
    faster = rate["project"] / rate["their project"], rate["unproject"] / rate["their unproject"]
    cells = f" | {rate['their project']:8.1f} {rate['their unproject']:10.1f}"
    cells += f" {residual_px(camera, peer.unproject(), pixels):10.1e} | {faster[0]:6.1f} {faster[1]:6.1f}"
    if peer.exactly is not None:
        exact_px = residual_px(camera, peer.exactly(), pixels)
        cells += f" {rate['unproject'] / rate['their exact unproject']:6.1f} ({exact_px:.0e} px)"
    if name in AIMS:
        kept = all(ratio >= aim for ratio, aim in zip(faster, AIMS[name], strict=True))
        cells += f"  aims {AIMS[name][0]:g} and {AIMS[name][1]:g}: {'kept' if kept else 'MISSED'}"
    return cells


def main() -> None:
    """Print our figures, the peer's and the ratios."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=200_000)
    parser.add_argument("--repetitions", type=int, default=15)
    stated = parser.parse_args()
    cv2.setNumThreads(1)
    print(
        f"{stated.points} points, one thread; million points a second, and pixels that rays are off; OpenCV's; ratios"
    )
    print(
        f"{'':22} {'project':>8} {'unproject':>10} {'residual':>10} | {'project':>8} {'unproject':>10} "
        f"{'residual':>10} | {'project, unproject, unproject reported to go on':>6}"
    )
    for name, camera in CAMERA_MODELS.items():
        measure(name, camera, stated.points, stated.repetitions)


if __name__ == "__main__":
    main()
