"""A street as a dense lidar sees it, the cloud of the benchmarks of fusion."""

import numpy as np

CAMERA_WORLD = np.array([0.0, 0.0, 1.65])
LIDAR_WORLD = CAMERA_WORLD + np.array([-0.3, 0.0, 0.6])
"""Where camera and lidar stand [m], z up from the road."""


def make_street(count: int, *, azimuth_deg: float = 42) -> np.ndarray:
    """Cast a dense lidar's rays on a road, two walls, and boxes along it; (count, 3) points [m].

    The points come as a spinning lidar fires: all elevations of one azimuth, then those of the next, from so far on the
    one side of straight ahead to as far on the other.
    """
    random = np.random.default_rng(0)
    side = round(np.sqrt(count * (1.6 if azimuth_deg < 90 else 2.4)))
    elevation, azimuth = np.meshgrid(
        np.radians(np.linspace(-27, 16, side)), np.radians(np.linspace(-azimuth_deg, azimuth_deg, side))
    )
    elevation, azimuth = elevation.ravel(), azimuth.ravel()
    rays = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    origin = LIDAR_WORLD
    centers = [(40, 14, 5), (40, -12, 5), (90, 0, 8), *((x, y, 0.8) for x in range(7, 70, 7) for y in (-4.5, 4.5))]
    halves = [(80, 0.5, 9), (80, 0.5, 7), (0.5, 15, 8), *([(2.1, 0.9, 0.8)] * 18)]
    with np.errstate(divide="ignore"):
        ranges = np.where(rays[:, 2] < 0, -origin[2] / rays[:, 2], np.inf)
        for center, half in zip(centers, halves, strict=True):
            enter, leave = ((np.array(center) - half - origin) / rays, (np.array(center) + half - origin) / rays)
            near, far = np.minimum(enter, leave).max(axis=1), np.maximum(enter, leave).min(axis=1)
            ranges = np.where((near < far) & (near > 0), np.minimum(ranges, near), ranges)
    hit = np.flatnonzero(ranges < 120)
    hit = np.sort(random.permutation(hit)[:count])
    ranges = ranges[hit] + random.normal(scale=0.02, size=len(hit))
    return origin + rays[hit] * ranges[:, None]
