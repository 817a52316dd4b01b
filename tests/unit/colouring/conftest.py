"""An analytic street: a road, walls, cars, people, poles and a sign over the road, seen by a lidar and a camera.

All bodies are boxes and upright cylinders, so every ray has an exact answer and what the camera sees is known.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project, unproject
from sceneloom.geometry.rigid import RigidTransform

CAMERA_FROM_BODY = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
REACH = 120.0


@dataclass(frozen=True)
class StreetView:
    """Points of a sweep in an image and the truth about them."""

    camera: Camera
    world_from_camera: RigidTransform
    lidar_world: np.ndarray  # (3,), from where the points were measured
    points_world: np.ndarray  # (N, 3), with range noise; all fall into the image
    seen: np.ndarray  # (N,), whether nothing stands between the point's origin and the camera
    counted: np.ndarray  # (N,), whether the point lies 2 px or more from any outline


def street_bodies(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Boxes (x y z length width height yaw) and cylinders (x y radius top) along a road on z = 0."""
    random = np.random.default_rng(seed)
    boxes = [(40, 14, 4, 160, 1, 8, 0), (40, -12, 3, 160, 1, 6, 0), (95, 0, 5, 1, 30, 10, 0)]
    for x in range(6, 80, 7):
        for side in (4.5, -4.5):
            if random.random() < 0.8:
                y, yaw = side + 0.2 * random.normal(), 0.03 * random.normal()
                boxes.append((x + random.normal(), y, 0.9, 4.2, 1.8, 1.35, yaw))
    boxes += [(18, 0.4, 1, 4.2, 1.8, 1.4, 0.1), (34, -1.5, 1.8, 7, 2.4, 3.2, 0), (12, -2.6, 0.9, 4, 1.8, 1.3, 0.5)]
    boxes += [(14, 8, 0.85, 0.6, 0.5, 1.7, 0), (9, -7.5, 0.85, 0.5, 0.5, 1.7, 0), (30, 0, 6.2, 0.3, 6, 1.5, 0)]
    cylinders = [(x, 7, 0.08, 6) for x in range(5, 80, 11)] + [(x, -7, 0.12, 6) for x in range(5, 80, 11)]
    cylinders += [(x, side, 0.25, 5) for x in range(8, 80, 13) for side in (9.5, -9.5)]
    return np.array(boxes, float), np.array(cylinders, float)


def rays_towards(origin: np.ndarray, rays: np.ndarray, center: np.ndarray, radius: float) -> np.ndarray:
    """Numbers of the unit rays that may meet a ball: the others need not be asked about what is inside."""
    away = center - origin
    tangent = away @ away - (1.001 * radius) ** 2
    return np.arange(len(rays)) if tangent <= 0 else np.flatnonzero(rays @ away >= np.sqrt(tangent))


def cast(bodies: tuple[np.ndarray, np.ndarray], origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Range of the first hit of each unit ray, infinite for none, and the number of what it hit; 0 is the road."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ranges = np.where(rays[:, 2] < 0, -origin[2] / rays[:, 2], np.inf)
        ranges[ranges > REACH] = np.inf
        hits = np.where(np.isfinite(ranges), 0, -1)
        for number, (bx, by, bz, *size, yaw) in enumerate(bodies[0], 1):
            towards = rays_towards(origin, rays, np.array([bx, by, bz]), np.linalg.norm(size) / 2)
            c, s = np.cos(yaw), np.sin(yaw)
            rotation = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
            start, along = rotation @ (origin - (bx, by, bz)), rotation @ rays[towards].T
            half = np.array(size)[:, None] / 2
            enter, leave = (-half - start[:, None]) / along, (half - start[:, None]) / along
            near, far = np.minimum(enter, leave).max(axis=0), np.maximum(enter, leave).min(axis=0)
            hit = (near < far) & (near > 0) & (near < np.minimum(ranges[towards], REACH))
            ranges[towards[hit]], hits[towards[hit]] = near[hit], number
        for number, (cx, cy, radius, top) in enumerate(bodies[1], 1 + len(bodies[0])):
            towards = rays_towards(origin, rays, np.array([cx, cy, top / 2]), np.hypot(radius, top / 2))
            x, y, z = rays[towards].T
            dx, dy = origin[0] - cx, origin[1] - cy
            a, b = x * x + y * y, dx * x + dy * y
            near = (-b - np.sqrt(b * b - a * (dx * dx + dy * dy - radius * radius))) / a
            height = origin[2] + near * z
            hit = (near > 0) & (height > 0) & (height < top) & (near < np.minimum(ranges[towards], REACH))
            ranges[towards[hit]], hits[towards[hit]] = near[hit], number
    return ranges, hits


def lidar_rays(elevations_deg: Sequence[float], azimuth_deg: float) -> np.ndarray:
    """Unit rays of a lidar that looks ahead, all azimuths of a beam after the other."""
    elevation, azimuth = np.meshgrid(
        np.radians(elevations_deg), np.radians(np.arange(-75, 75, azimuth_deg)), indexing="ij"
    )
    rays = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
    return np.stack(rays, axis=-1).reshape(-1, 3)


def far_from_outlines(look: Callable[[np.ndarray], np.ndarray], pixels: np.ndarray) -> np.ndarray:
    """Which pixels see one and the same thing in all directions up to 2 px; `look` reports what pixels (N, 2) see."""
    steps = [(du, dv) for du in range(-2, 3) for dv in range(-2, 3) if du * du + dv * dv <= 4]
    around = np.floor(pixels + 0.5).astype(int)[:, None] + steps
    # as one number each: rows of two are sorted many times as slowly
    needed, locations = np.unique(around[..., 0] * 2**20 + around[..., 1] + 2**10, return_inverse=True)
    hits = look(np.stack([needed // 2**20, needed % 2**20 - 2**10], axis=1))[locations.reshape(len(pixels), -1)]
    return (hits == hits[:, :1]).all(axis=1)


def view_street(
    camera, *, lidar_above=(-0.3, 0.0, 0.6), height=1.65, beams=64, pitch_deg=0.42, top_deg=2.0, azimuth_deg=0.17,
    elevations_deg=None, roll=0.0, noise=0.02, seed=0,
):  # fmt: skip
    """Look ahead into the street; `lidar_above` is the lidar's location from the camera (forward, left, up).

    The lines lie evenly from `top_deg` downward, or at `elevations_deg`.
    """
    bodies, center = street_bodies(seed), np.array([0.0, 0.0, height])
    origin, evenly = center + lidar_above, tuple(top_deg - pitch_deg * np.arange(beams))
    rays = lidar_rays(evenly if elevations_deg is None else elevations_deg, azimuth_deg)
    ranges, _ = cast(bodies, origin, rays)
    rays, ranges = rays[np.isfinite(ranges)], ranges[np.isfinite(ranges)]
    noisy = ranges + np.random.default_rng(seed + 1).normal(scale=noise, size=len(ranges))
    rotation = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    world_from_camera = RigidTransform((rotation @ CAMERA_FROM_BODY).T, center)
    pixels, inside = project(camera, world_from_camera.inverse().apply(origin + rays * noisy[:, None]))
    apart = (origin + rays * ranges[:, None] - center)[inside]
    distances = np.linalg.norm(apart, axis=1)
    first, _ = cast(bodies, center, apart / distances[:, None])

    def look(where: np.ndarray) -> np.ndarray:
        rays = unproject(camera, where) @ world_from_camera.rotation.T
        return np.where(np.isnan(rays[:, 0]), -2, cast(bodies, center, np.nan_to_num(rays, nan=0.6))[1])

    points, seen = (origin + rays * noisy[:, None])[inside], first > distances - 0.03 - 1e-3 * distances
    return StreetView(camera, world_from_camera, origin, points, seen, far_from_outlines(look, pixels[inside]))


@pytest.fixture(scope="session")
def street() -> Callable[..., StreetView]:
    """Makes views of the street; each set-up is made once."""
    made: dict[Any, StreetView] = {}

    def make(camera: Camera, **kwargs: Any) -> StreetView:
        key = (camera, tuple(kwargs.items()))
        if key not in made:
            made[key] = view_street(camera, **kwargs)
        return made[key]

    return make
