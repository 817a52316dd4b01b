"""Ray casting kernels: first hits on the ground and on convex shapes, frames of moving bodies, silhouettes.

Every shape is one of four unit bodies, brought into the world by an affine map, so that a ray is taken into the
shape's own space and one short test per body suffices. The ray parameter keeps its meaning under the map: with
directions of unit length it is the range in metres.

Rays come in bundles of neighbours (a tile of pixels, a patch of laser shots). For each bundle the shapes outside its
cone are dropped and the rest sorted by distance, so a ray meets a handful of shapes instead of all.

What moves has a frame for each pose of the sensor: its rays are taken into the frame as it lies at that time, and its
bounding spheres hold it at all of them.
"""

import math
from typing import Any

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from sceneloom.arrays import BoolArray, Float64Array, Int64Array, UInt8Array
from sceneloom.kernels.cache import kernel

Int32Array = NDArray[np.int32]

BOX, CYLINDER, ELLIPSOID, GABLE = range(4)
"""The unit bodies: the cube abs(x), abs(y), abs(z) <= 1; a disc of radius 1 over abs(z) <= 1; a ball of radius 1; a
roof whose ridge runs along x at z = 1, over the square at z = -1."""

GROUND = -1
"""The hit number of the plane z = 0."""

SKY = -2
"""The hit number of a ray that meets nothing."""

INNER: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"contract", "arcp", "nsz"},
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
}
"""Options of functions that only compiled functions call; without wrappers they compile faster."""


@njit(**INNER)
def _clip(near: float, far: float, value: float, slope: float) -> tuple[float, float]:
    """Cut the interval (near, far) down to where `value + t slope <= 0`."""
    if slope == 0.0:
        return (near, far) if value <= 0.0 else (1.0, 0.0)
    t = -value / slope
    if slope < 0.0:
        return (t, far) if t > near else (near, far)
    return (near, t) if t < far else (near, far)


@njit(**INNER)
def _clip_round(near: float, far: float, a: float, b: float, c: float) -> tuple[float, float]:
    """Cut the interval (near, far) down to where `a t² + 2 b t + c <= 0`, a >= 0."""
    if a == 0.0:
        return (near, far) if c <= 0.0 else (1.0, 0.0)
    discriminant = b * b - a * c
    if discriminant <= 0.0:
        return 1.0, 0.0
    root = math.sqrt(discriminant)
    return max(near, (-b - root) / a), min(far, (-b + root) / a)


@njit(**INNER)
def _enter_unit_body(
    kind: int, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, reach: float
) -> float:
    """Parameter at which a ray enters a unit body, or `reach` where it does not before."""
    near, far = 0.0, reach
    if kind == BOX:
        near, far = _clip(near, far, ox - 1.0, dx)
        near, far = _clip(near, far, -ox - 1.0, -dx)
        near, far = _clip(near, far, oy - 1.0, dy)
        near, far = _clip(near, far, -oy - 1.0, -dy)
    elif kind == CYLINDER:
        near, far = _clip_round(near, far, dx * dx + dy * dy, ox * dx + oy * dy, ox * ox + oy * oy - 1.0)
    elif kind == ELLIPSOID:
        near, far = _clip_round(
            near, far, dx * dx + dy * dy + dz * dz, ox * dx + oy * dy + oz * dz, ox * ox + oy * oy + oz * oz - 1.0
        )
    else:
        near, far = _clip(near, far, ox - 1.0, dx)
        near, far = _clip(near, far, -ox - 1.0, -dx)
        near, far = _clip(near, far, oy + 0.5 * oz - 0.5, dy + 0.5 * dz)
        near, far = _clip(near, far, -oy + 0.5 * oz - 0.5, -dy + 0.5 * dz)
    if kind != ELLIPSOID and near < far:
        near, far = _clip(near, far, oz - 1.0, dz)
        near, far = _clip(near, far, -oz - 1.0, -dz)
    return near if 0.0 < near < far else reach


@njit(**INNER)
def _meet_shape(
    kind: int, m: Float64Array, x: float, y: float, z: float, u: float, v: float, w: float, reach: float
) -> float:
    """Range at which the ray from (x, y, z) along (u, v, w) enters the shape of a map (3, 4), or `reach`."""
    return float(
        _enter_unit_body(
            kind,
            m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3],
            m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3],
            m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3],
            m[0, 0] * u + m[0, 1] * v + m[0, 2] * w,
            m[1, 0] * u + m[1, 1] * v + m[1, 2] * w,
            m[2, 0] * u + m[2, 1] * v + m[2, 2] * w,
            reach,
        )
    )


@njit(**INNER)
def take_into_frame(
    frame: Float64Array, x: float, y: float, z: float, u: float, v: float, w: float, own: Float64Array
) -> None:
    """Write a world point and a direction in the coordinates of a frame (3, 4) into `own` (6,)."""
    for i in range(3):
        own[i] = frame[i, 0] * x + frame[i, 1] * y + frame[i, 2] * z + frame[i, 3]
        own[3 + i] = frame[i, 0] * u + frame[i, 1] * v + frame[i, 2] * w


@njit(**INNER)
def _cull(
    axis: Float64Array, cosine: float, anchor: Float64Array, spread: float, spheres: Float64Array,
    candidates: Int32Array, reach: float, chosen: Int32Array, nears: Float64Array,
) -> int:  # fmt: skip
    """List the shapes whose bounding spheres touch a bundle's cone, nearest first; give their number."""
    sine = math.sqrt(max(0.0, 1.0 - cosine * cosine))
    count = 0
    for k in candidates:
        vx, vy, vz = spheres[k, 0] - anchor[0], spheres[k, 1] - anchor[1], spheres[k, 2] - anchor[2]
        radius = spheres[k, 3] + spread
        along = vx * axis[0] + vy * axis[1] + vz * axis[2]
        if along < -radius and cosine > 0.0:
            continue
        squared = vx * vx + vy * vy + vz * vz
        across = math.sqrt(max(0.0, squared - along * along))
        if cosine > 0.0 and across * cosine - along * sine > radius:
            continue
        near = math.sqrt(squared) - radius
        if near > reach:
            continue
        location = count
        while location > 0 and nears[location - 1] > near:
            nears[location], chosen[location] = nears[location - 1], chosen[location - 1]
            location -= 1
        nears[location], chosen[location] = near, k
        count += 1
    return count


@njit(**INNER)
def _bundle_cone(
    directions: Float64Array, pose_of_ray: Int32Array, rotations: Float64Array, origins: Float64Array,
    start: int, stop: int, rays: Float64Array, axis: Float64Array,
) -> tuple[float, float]:  # fmt: skip
    """Rotate a bundle's directions into the world; give the cone around them: axis, cosine, spread of the origins."""
    axis[0], axis[1], axis[2] = 0.0, 0.0, 0.0
    anchor, spread = origins[pose_of_ray[start]], 0.0
    for k in range(start, stop):
        rotation, origin, row = rotations[pose_of_ray[k]], origins[pose_of_ray[k]], k - start
        for i in range(3):
            rays[row, i] = (
                rotation[i, 0] * directions[k, 0]
                + rotation[i, 1] * directions[k, 1]
                + rotation[i, 2] * directions[k, 2]
            )
            axis[i] += rays[row, i]
        apart = (origin[0] - anchor[0]) ** 2 + (origin[1] - anchor[1]) ** 2 + (origin[2] - anchor[2]) ** 2
        spread = max(spread, apart)
    length = max(1e-300, math.sqrt(axis[0] ** 2 + axis[1] ** 2 + axis[2] ** 2))
    axis[0], axis[1], axis[2] = axis[0] / length, axis[1] / length, axis[2] / length
    cosine = 1.0
    for row in range(stop - start):
        cosine = min(cosine, rays[row, 0] * axis[0] + rays[row, 1] * axis[1] + rays[row, 2] * axis[2])
    return cosine, math.sqrt(spread)


@njit(**INNER)
def _trace_bundle(
    directions: Float64Array, pose_of_ray: Int32Array, rotations: Float64Array, origins: Float64Array,
    start: int, stop: int, slots: Int64Array, kinds: UInt8Array, maps: Float64Array, frame_of_shape: Int32Array,
    frames: Float64Array, spheres: Float64Array, candidates: Int32Array, reach: float, ranges: Float64Array,
    hits: Int32Array,
) -> None:  # fmt: skip
    """Trace the rays from `start` to `stop`, which share one cone; arguments as in `trace_rays`."""
    rays, axis, own = np.empty((stop - start, 3)), np.empty(3), np.empty(6)
    cosine, spread = _bundle_cone(directions, pose_of_ray, rotations, origins, start, stop, rays, axis)
    chosen, nears = np.empty(len(candidates), np.int32), np.empty(len(candidates))
    count = _cull(axis, cosine, origins[pose_of_ray[start]], spread, spheres, candidates, reach, chosen, nears)
    for k in range(start, stop):
        x, y, z = origins[pose_of_ray[k], 0], origins[pose_of_ray[k], 1], origins[pose_of_ray[k], 2]
        u, v, w = rays[k - start, 0], rays[k - start, 1], rays[k - start, 2]
        best, hit = reach, SKY
        if w * z < 0.0 and -z / w < reach:
            best, hit = -z / w, GROUND
        for c in range(count):
            if nears[c] > best:
                break
            if frame_of_shape[chosen[c]] < 0:
                t = _meet_shape(kinds[chosen[c]], maps[chosen[c]], x, y, z, u, v, w, best)
            else:
                take_into_frame(frames[pose_of_ray[k], frame_of_shape[chosen[c]]], x, y, z, u, v, w, own)
                t = _meet_shape(kinds[chosen[c]], maps[chosen[c]], own[0], own[1], own[2], own[3], own[4], own[5], best)
            if t < best:
                best, hit = t, chosen[c]
        ranges[slots[k]] = best if hit != SKY else 0.0
        hits[slots[k]] = hit


@kernel(
    "void(float64[:,::1], int32[::1], float64[:,:,::1], float64[:,::1], int64[::1], int64[::1], "
    "uint8[::1], float64[:,:,::1], int32[::1], float64[:,:,:,::1], float64[:,::1], int32[::1], float64, "
    "float64[::1], int32[::1])",
    parallel=True,
)
def trace_rays(
    directions: Float64Array, pose_of_ray: Int32Array, rotations: Float64Array, origins: Float64Array,
    bundle_starts: Int64Array, slots: Int64Array, kinds: UInt8Array, maps: Float64Array, frame_of_shape: Int32Array,
    frames: Float64Array, spheres: Float64Array, candidates: Int32Array, reach: float, ranges: Float64Array,
    hits: Int32Array,
) -> None:  # fmt: skip
    """Find what each ray meets first.

    Args:
        directions: (N, 3) float64, unit, sensor frame, neighbours together.
        pose_of_ray: (N,) int32, the row of `rotations` and `origins` that holds for a ray.
        rotations: (M, 3, 3) float64 `world_from_sensor`.
        origins: (M, 3) float64 [m], world frame.
        bundle_starts: (B + 1,) int64, the first ray of each bundle and N.
        slots: (N,) int64, where the answer of a ray goes.
        kinds: (P,) uint8, the unit body of each shape.
        maps: (P, 3, 4) float64, world, or the frame of what moves, to the space of the unit body.
        frame_of_shape: (P,) int32, the column of `frames` that a shape moves with, -1 where it is stationary.
        frames: (M, F, 3, 4) float64 `frame_from_world` at the time of each pose.
        spheres: (P, 4) float64 [m], centre and radius of a ball around each shape, world frame; around all its
            locations where it moves.
        candidates: (C,) int32, the shapes to look at.
        reach: rays end here [m].
        ranges: (slots,) float64 [m], written: range of the first hit, 0 where there is none.
        hits: (slots,) int32, written: the shape's number, `GROUND` or `SKY`.

    Shapes are entered from outside: a ray that starts inside one does not see it.
    """
    for bundle in prange(len(bundle_starts) - 1):
        _trace_bundle(
            directions, pose_of_ray, rotations, origins, bundle_starts[bundle], bundle_starts[bundle + 1], slots,
            kinds, maps, frame_of_shape, frames, spheres, candidates, reach, ranges, hits,
        )  # fmt: skip


_FAR = 1e7  # where rays are taken to in the frame of something that is not there [m]: no ray reaches back


@njit(**INNER)
def _swing_back(frame: Float64Array, angle: float, x: float, z: float) -> None:
    """Rotate a frame (3, 4) backwards about an axis along y through (x, z), as a part has swung forwards."""
    cosine, sine = math.cos(angle), math.sin(angle)
    for i in range(4):
        forward, upward = frame[0, i], frame[2, i]
        if i == 3:
            forward, upward = forward - x, upward - z
        frame[0, i] = cosine * forward + sine * upward
        frame[2, i] = cosine * upward - sine * forward
    frame[0, 3] += x
    frame[2, 3] += z


@kernel(
    "void(float64[:,:,::1], boolean[:,::1], int32[::1], float64[:,::1], float64[::1], float64[::1], "
    "float64[:,:,:,::1])",
    parallel=True,
)
def put_parts(
    states: Float64Array, there: BoolArray, mover_of_part: Int32Array, hinges: Float64Array, swings: Float64Array,
    leads: Float64Array, frames: Float64Array,
) -> None:  # fmt: skip
    """Write `part_from_world` of every part at every time.

    Args:
        states: (M, K, 4) float64, x, y [m], yaw and gait [rad] of K movers at M times.
        there: (M, K) bool; the frames of what is not there lie out of reach of any ray.
        mover_of_part: (F,) int32, column of `states`.
        hinges: (F, 3) float64 [m]; swings, leads: (F,) float64 [rad]: a part swings forwards by its swing times the
            sine of gait and lead, about an axis along y through its hinge.
        frames: (M, F, 3, 4) float64, written.
    """
    for time in prange(len(states)):
        for part in range(len(mover_of_part)):
            mover, frame = mover_of_part[part], frames[time, part]
            x, y, yaw = states[time, mover, 0], states[time, mover, 1], states[time, mover, 2]
            cosine, sine = math.cos(yaw), math.sin(yaw)
            if not there[time, mover]:
                x, y, cosine, sine = -_FAR, -_FAR, 1.0, 0.0
            frame[0, 0], frame[0, 1], frame[0, 2], frame[0, 3] = cosine, sine, 0.0, -(cosine * x + sine * y)
            frame[1, 0], frame[1, 1], frame[1, 2], frame[1, 3] = -sine, cosine, 0.0, sine * x - cosine * y
            frame[2, 0], frame[2, 1], frame[2, 2], frame[2, 3] = 0.0, 0.0, 1.0, 0.0
            if swings[part] != 0.0 and there[time, mover]:
                angle = swings[part] * math.sin(states[time, mover, 3] + leads[part])
                _swing_back(frame, angle, hinges[part, 0], hinges[part, 2])


@njit(**INNER)
def _count_bundle(
    directions: Float64Array, pose_of_ray: Int32Array, rotations: Float64Array, origins: Float64Array,
    start: int, stop: int, kinds: UInt8Array, maps: Float64Array, object_of_shape: Int32Array,
    frame_of_shape: Int32Array, frames: Float64Array, spheres: Float64Array, candidates: Int32Array, reach: float,
    counts: Int64Array,
) -> None:  # fmt: skip
    """Count the rays from `start` to `stop`; arguments as in `count_silhouettes`."""
    rays, axis, own = np.empty((stop - start, 3)), np.empty(3), np.empty(6)
    cosine, spread = _bundle_cone(directions, pose_of_ray, rotations, origins, start, stop, rays, axis)
    chosen, nears = np.empty(len(candidates), np.int32), np.empty(len(candidates))
    count = _cull(axis, cosine, origins[pose_of_ray[start]], spread, spheres, candidates, reach, chosen, nears)
    # The shapes of an object follow each other, so a ray that has met it once is known by the object before.
    chosen = np.sort(chosen[:count])
    for k in range(start, stop):
        x, y, z = origins[pose_of_ray[k], 0], origins[pose_of_ray[k], 1], origins[pose_of_ray[k], 2]
        u, v, w = rays[k - start, 0], rays[k - start, 1], rays[k - start, 2]
        met = -1
        for shape in chosen:
            thing = object_of_shape[shape]
            if thing == met:
                continue
            if frame_of_shape[shape] < 0:
                t = _meet_shape(kinds[shape], maps[shape], x, y, z, u, v, w, reach)
            else:
                take_into_frame(frames[pose_of_ray[k], frame_of_shape[shape]], x, y, z, u, v, w, own)
                t = _meet_shape(kinds[shape], maps[shape], own[0], own[1], own[2], own[3], own[4], own[5], reach)
            if t < reach:
                counts[thing] += 1
                met = thing


@kernel(
    "void(float64[:,::1], int32[::1], float64[:,:,::1], float64[:,::1], int64[::1], uint8[::1], float64[:,:,::1], "
    "int32[::1], int32[::1], float64[:,:,:,::1], float64[:,::1], int32[::1], float64, int64[:,::1])",
    parallel=True,
)
def count_silhouettes(
    directions: Float64Array, pose_of_ray: Int32Array, rotations: Float64Array, origins: Float64Array,
    bundle_starts: Int64Array, kinds: UInt8Array, maps: Float64Array, object_of_shape: Int32Array,
    frame_of_shape: Int32Array, frames: Float64Array, spheres: Float64Array, candidates: Int32Array, reach: float,
    counts: Int64Array,
) -> None:  # fmt: skip
    """Count for each object the rays that would meet it if it were alone.

    Args:
        object_of_shape: (P,) int32, counted from 0; the shapes of one object follow each other.
        counts: (W, objects) int64, added to: the sum over the rows is the answer; W workers share the bundles.

    The other arguments are those of `trace_rays`.
    """
    workers, bundles = counts.shape[0], len(bundle_starts) - 1
    for worker in prange(workers):
        for bundle in range(worker, bundles, workers):
            _count_bundle(
                directions, pose_of_ray, rotations, origins, bundle_starts[bundle], bundle_starts[bundle + 1], kinds,
                maps, object_of_shape, frame_of_shape, frames, spheres, candidates, reach, counts[worker],
            )  # fmt: skip
