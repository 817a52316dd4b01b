"""Rays of a sensor cast into the street: what they meet first, how that looks, and silhouettes.

Every shape is one of four unit bodies, brought into the world by an affine map, so that a ray is taken into the
shape's own space and one short test per body suffices. The ray parameter keeps its meaning under the map: with
directions of unit length it is the range in metres.

Rays come in bundles of neighbours (a tile of pixels, a patch of laser shots). For each bundle the shapes outside its
cone are dropped and the rest sorted by distance, so a ray meets a handful of shapes instead of all.

What moves has a frame for each pose of the sensor: its rays are taken into the frame as it lies at that time, and its
bounding spheres hold it at all of them.

A pattern mixes the three colours of an object's palette. Edges inside a pattern are averaged over the width that a
pixel covers on the surface (a box filter, exact for stripes), and noise fades where it becomes finer than a pixel, so
images do not shimmer and video codecs keep them. Without a pixel (`pixel_angle` 0) edges are 2 cm soft.

Source: the filtered pulse train is that of Apodaca and Gritz, "Advanced RenderMan", 1999, chapter 11.
"""

import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from sceneloom.arrays import AnyArray, Float32Array, Float64Array, Int32Array, Int64Array, UInt8Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.thread_pool import Phase, ThreadPool
from sceneloom.simulate import street as simulate_street
from sceneloom.simulate.street import INNER, PALETTE, Street

_BOX, _CYLINDER, _ELLIPSOID, _GABLE = map(int, simulate_street.ShapeKind)
_PLAIN, _FACADE, _BRICK, _TILES, _FOLIAGE, _BARK, _CAR_BODY, _CAR_CABIN, _TYRE, _BANDS = map(
    int, simulate_street.Pattern
)
GROUND = -1
"""The hit number of the plane z = 0."""

SKY = -2
"""The hit number of a ray that meets nothing."""


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
    if kind == _BOX:
        near, far = _clip(near, far, ox - 1.0, dx)
        near, far = _clip(near, far, -ox - 1.0, -dx)
        near, far = _clip(near, far, oy - 1.0, dy)
        near, far = _clip(near, far, -oy - 1.0, -dy)
    elif kind == _CYLINDER:
        near, far = _clip_round(near, far, dx * dx + dy * dy, ox * dx + oy * dy, ox * ox + oy * oy - 1.0)
    elif kind == _ELLIPSOID:
        near, far = _clip_round(
            near, far, dx * dx + dy * dy + dz * dz, ox * dx + oy * dy + oz * dz, ox * ox + oy * oy + oz * oz - 1.0
        )
    else:
        near, far = _clip(near, far, ox - 1.0, dx)
        near, far = _clip(near, far, -ox - 1.0, -dx)
        near, far = _clip(near, far, oy + 0.5 * oz - 0.5, dy + 0.5 * dz)
        near, far = _clip(near, far, -oy + 0.5 * oz - 0.5, -dy + 0.5 * dz)
    if kind != _ELLIPSOID and near < far:
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
def _take_into_frame(
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
    """Trace the rays from `start` to `stop`, which share one cone; arguments as in `_trace_rays`."""
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
                _take_into_frame(frames[pose_of_ray[k], frame_of_shape[chosen[c]]], x, y, z, u, v, w, own)
                t = _meet_shape(kinds[chosen[c]], maps[chosen[c]], own[0], own[1], own[2], own[3], own[4], own[5], best)
            if t < best:
                best, hit = t, chosen[c]
        ranges[slots[k]] = best if hit != SKY else 0.0
        hits[slots[k]] = hit


@kernel(
    "void(int64, int64, float64[:,::1], int32[::1], float64[:,:,::1], float64[:,::1], int64[::1], int64[::1], "
    "uint8[::1], float64[:,:,::1], int32[::1], float64[:,:,:,::1], float64[:,::1], int32[::1], float64, "
    "float64[::1], int32[::1])"
)
def _trace_rays(
    first: int, last: int,
    directions: Float64Array, pose_of_ray: Int32Array, rotations: Float64Array, origins: Float64Array,
    bundle_starts: Int64Array, slots: Int64Array, kinds: UInt8Array, maps: Float64Array, frame_of_shape: Int32Array,
    frames: Float64Array, spheres: Float64Array, candidates: Int32Array, reach: float, ranges: Float64Array,
    hits: Int32Array,
) -> None:  # fmt: skip
    """Find what each ray of some bundles meets first, from `first` to before `last`.

    Arrays as in `Rays`, `PackedShapes`, `Moving` and `Hits`, whose two are written.

    Shapes are entered from outside: a ray that starts inside one does not see it.
    """
    for bundle in range(first, last):
        _trace_bundle(
            directions, pose_of_ray, rotations, origins, bundle_starts[bundle], bundle_starts[bundle + 1], slots,
            kinds, maps, frame_of_shape, frames, spheres, candidates, reach, ranges, hits,
        )  # fmt: skip


@njit(**INNER)
def _count_bundle(
    directions: Float64Array, pose_of_ray: Int32Array, rotations: Float64Array, origins: Float64Array,
    start: int, stop: int, kinds: UInt8Array, maps: Float64Array, object_of_shape: Int32Array,
    frame_of_shape: Int32Array, frames: Float64Array, spheres: Float64Array, candidates: Int32Array, reach: float,
    counts: Int64Array,
) -> None:  # fmt: skip
    """Count the rays from `start` to `stop`; arguments as in `_count_silhouettes`."""
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
                _take_into_frame(frames[pose_of_ray[k], frame_of_shape[shape]], x, y, z, u, v, w, own)
                t = _meet_shape(kinds[shape], maps[shape], own[0], own[1], own[2], own[3], own[4], own[5], reach)
            if t < reach:
                counts[thing] += 1
                met = thing


@kernel(
    "void(int64, int64, float64[:,::1], int32[::1], float64[:,:,::1], float64[:,::1], int64[::1], uint8[::1], "
    "float64[:,:,::1], int32[::1], int32[::1], float64[:,:,:,::1], float64[:,::1], int32[::1], float64, "
    "int64[:,::1])"
)
def _count_silhouettes(
    first: int, last: int,
    directions: Float64Array, pose_of_ray: Int32Array, rotations: Float64Array, origins: Float64Array,
    bundle_starts: Int64Array, kinds: UInt8Array, maps: Float64Array, object_of_shape: Int32Array,
    frame_of_shape: Int32Array, frames: Float64Array, spheres: Float64Array, candidates: Int32Array, reach: float,
    counts: Int64Array,
) -> None:  # fmt: skip
    """Count for each object the rays that would meet it if it were alone, as `_trace_rays` takes them.

    The shapes of one object, (P,) counted from 0, follow each other; the sum over the rows of `counts` (W, objects),
    each of which is filled from its share of the bundles, is the answer. The rows from `first` to before `last` are.
    """
    workers, bundles = counts.shape[0], len(bundle_starts) - 1
    for worker in range(first, last):
        for bundle in range(worker, bundles, workers):
            _count_bundle(
                directions, pose_of_ray, rotations, origins, bundle_starts[bundle], bundle_starts[bundle + 1], kinds,
                maps, object_of_shape, frame_of_shape, frames, spheres, candidates, reach, counts[worker],
            )  # fmt: skip


_ALONG_X, _ALONG_Y, _ALONG_Z, _SLANTED = range(4)
"""The faces of a body by the direction of their normal, as far as patterns report them apart."""

_SOFT = 0.02


@kernel("float64(int64, int64, int64)", **INNER)
def _hash(i: int, j: int, salt: int) -> float:
    """A number in [0, 1) that belongs to a lattice point."""
    h = (i * 374761393 + j * 668265263 + salt * 362437) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    return float((h ^ (h >> 16)) / 4294967296.0)


@kernel("float64(float64, float64, int64, float64)", **INNER)
def _noise(x: float, y: float, salt: int, width: float) -> float:
    """Smooth noise of period 1 in [-1, 1], fading as a pixel grows over the lattice."""
    fade = 1.4 - 2.0 * width
    if fade <= 0.0:
        return 0.0
    i, j = math.floor(x), math.floor(y)
    a, b = x - i, y - j
    a, b = a * a * (3.0 - 2.0 * a), b * b * (3.0 - 2.0 * b)
    low = _hash(i, j, salt) * (1.0 - a) + _hash(i + 1, j, salt) * a
    high = _hash(i, j + 1, salt) * (1.0 - a) + _hash(i + 1, j + 1, salt) * a
    return float(min(1.0, fade) * (2.0 * (low * (1.0 - b) + high * b) - 1.0))


@kernel("float64(float64, float64, float64, float64)", **INNER)
def _band(x: float, low: float, high: float, width: float) -> float:
    """Share of a window of a width around x that lies between low and high."""
    width = max(width, _SOFT)
    upper, lower = min(x + 0.5 * width, high), max(x - 0.5 * width, low)
    return max(0.0, upper - lower) / width


@kernel("float64(float64, float64, float64, float64)", **INNER)
def _covered(x: float, period: float, low: float, high: float) -> float:
    """Length of the bands [low, high) of every period between 0 and x."""
    whole = math.floor(x * (1.0 / period))
    return float(whole * (high - low) + min(max(x - whole * period - low, 0.0), high - low))


@kernel("float64(float64, float64, float64, float64, float64)", **INNER)
def _bands(x: float, period: float, low: float, high: float, width: float) -> float:
    """Share of a window of a width around x that lies in the bands [low, high) of every period."""
    width = max(width, _SOFT)
    span = _covered(x + 0.5 * width, period, low, high) - _covered(x - 0.5 * width, period, low, high)
    return float(span / width)


@njit(**INNER)
def _facade(
    face: int, u: float, v: float, wu: float, wv: float, half_u: float, height: float, measures: Float64Array, salt: int
) -> tuple[float, float, float]:
    """Plaster or bricks with rows of windows: glass is the second colour, frames and ledges the third."""
    pitch, storey, bricks = measures[0], measures[1], measures[2]
    light = 1.0 + 0.05 * _noise(u / 0.7, v / 0.7, salt, max(wu, wv) / 0.7)
    light *= 1.0 - 0.22 * _band(v, -1.0, 0.45, wv)
    if bricks > 0.0:
        row = math.floor(v / 0.28)
        stones = _bands(v, 0.28, 0.03, 0.28, wv) * _bands(u + 0.3 * (row % 2), 0.6, 0.03, 0.6, wu)
        light *= 1.0 - bricks * (1.0 - stones)
    if face == _ALONG_Z:
        return 0.0, 0.0, light
    ledges = _bands(v, storey, 0.0, 0.12, wv) * _band(v, 0.5, height, wv)
    count = math.floor(2.0 * half_u / pitch)
    inside = _band(u, -0.5 * count * pitch, 0.5 * count * pitch, wu) * _band(
        v, 0.5, math.floor(height / storey) * storey, wv
    )
    x = u + 0.5 * count * pitch
    low, high = 0.26 * pitch, 0.74 * pitch
    column = math.floor(x / pitch)
    if face == _ALONG_Y and v < storey and 2 * column == count - count % 2:
        door = _band(x - column * pitch, low, high, wu) * _band(v, -1.0, 2.2, wv)
        leaf = _band(x - column * pitch, low + 0.1, high - 0.1, wu) * _band(v, -1.0, 2.1, wv)
        return 0.75 * leaf, door - leaf, light + leaf * (0.8 - light)
    outer = inside * _bands(x, pitch, low, high, wu) * _bands(v, storey, 0.32 * storey, 0.82 * storey, wv)
    if outer == 0.0:
        return 0.0, ledges, light
    middle = 0.5 * (low + high)
    panes = _bands(x, pitch, low + 0.08, middle - 0.03, wu) + _bands(x, pitch, middle + 0.03, high - 0.08, wu)
    glass = inside * panes * _bands(v, storey, 0.32 * storey + 0.08, 0.82 * storey - 0.08, wv)
    glass = min(glass, outer)
    tone = 0.75 + 0.7 * _hash(column, math.floor(v / storey), salt)
    return glass, min(1.0 - glass, outer - glass + ledges * (1.0 - outer)), light + glass * (tone - light)


@njit(**INNER)
def _brick(u: float, v: float, wu: float, wv: float, salt: int) -> tuple[float, float, float]:
    """Courses of stones with joints in the second colour, each stone with a tone of its own."""
    row = math.floor(v / 0.25)
    x = u + 0.25 * (row % 2)
    stone = _bands(v, 0.25, 0.03, 0.25, wv) * _bands(x, 0.5, 0.03, 0.5, wu)
    tone = 0.16 * (_hash(math.floor(x / 0.5), row, salt) - 0.5) * max(0.0, 1.0 - 4.0 * max(wu, wv)) * stone
    return 1.0 - stone, 0.0, 1.0 + tone


@njit(**INNER)
def _tiles(u: float, v: float, wu: float, wv: float, salt: int) -> tuple[float, float, float]:
    """Rows of roof tiles, the second colour in the gaps."""
    gaps = 1.0 - _bands(v, 0.4, 0.07, 0.4, wv) * _bands(u, 0.5, 0.05, 0.5, wu)
    return 0.8 * gaps, 0.0, 1.0 + 0.1 * _noise(u / 1.1, v / 0.8, salt, max(wu, wv))


@kernel("float64(float64, float64, float64, int64, float64)", **INNER)
def _noise_in_space(x: float, y: float, z: float, salt: int, width: float) -> float:
    """Smooth noise of period 1 in [-1, 1] inside a body, from two layers of plane noise."""
    layer = math.floor(z)
    c = z - layer
    c = c * c * (3.0 - 2.0 * c)
    below = _noise(x + 0.37 * layer, y + 0.61 * layer, salt + 31 * layer, width)
    above = _noise(x + 0.37 * (layer + 1), y + 0.61 * (layer + 1), salt + 31 * (layer + 1), width)
    return float(below + c * (above - below))


@njit(**INNER)
def _foliage(x: float, y: float, z: float, width: float, salt: int) -> tuple[float, float, float]:
    """Clumps of leaves in the first and second colour, the third where light comes through, dark gaps between."""
    coarse = _noise_in_space(1.8 * x, 1.8 * y, 1.8 * z, salt, 1.8 * width)
    fine = _noise_in_space(5.5 * y + 2.0 * x, 5.5 * z, 5.5 * x - 2.0 * y, salt + 7, 6.0 * width)
    density = 0.55 * coarse + 0.75 * fine
    mix = min(1.0, max(0.0, 0.5 + 0.9 * density))
    spark = min(1.0, max(0.0, 2.0 * (density - 0.55)))
    shade = 1.0 - 0.5 * min(1.0, max(0.0, -1.4 * density - 0.15))
    return mix * (1.0 - spark), spark, shade


@njit(**INNER)
def _car_body(
    face: int, u: float, v: float, wu: float, wv: float, half_u: float, front: float
) -> tuple[float, float, float]:
    """Lacquer with a dark sill and door gaps in the second colour; lamps and number plates in the third."""
    sill = _band(v, -1.0, 0.12, wv)
    if face == _ALONG_Y:
        access = _band(abs(u - 0.15), 0.0, 0.025, wu) + _band(abs(abs(u - 0.15) - 1.0), 0.0, 0.025, wu)
        trim = _band(v, 0.33, 0.39, wv)
        return min(1.0, sill + 0.7 * access + 0.8 * trim), 0.0, 1.0
    if face == _ALONG_X:
        lamps = _band(abs(u), half_u - 0.42, half_u - 0.1, wu) * _band(v, 0.36, 0.54, wv)
        plate = _band(abs(u), -1.0, 0.26, wu) * _band(v, 0.2, 0.32, wv)
        grille = _band(abs(u), -1.0, half_u - 0.5, wu) * _band(v, 0.38, 0.5, wv) * front
        return min(1.0, sill + grille), min(1.0 - sill, lamps + plate), 1.0
    return 0.0, 0.0, 1.0


@njit(**INNER)
def _car_cabin(
    face: int, u: float, v: float, wu: float, wv: float, half_u: float, height: float
) -> tuple[float, float, float]:
    """Glass in the second colour between pillars and roof of the first."""
    if face == _ALONG_Z:
        return 0.0, 0.0, 1.0
    glass = _band(abs(u), -1.0, half_u - 0.09, wu) * _band(v, 0.05, height - 0.09, wv)
    pillar = _band(abs(u - 0.1), 0.0, 0.05, wu) if face == _ALONG_Y else 0.0
    return max(0.0, glass - pillar), 0.0, 1.0


@njit(**INNER)
def _tyre(face: int, u: float, v: float, radius: float, width: float) -> tuple[float, float, float]:
    """Rubber with a hub in the second colour and a dark nave in the third."""
    if face != _ALONG_Z:
        return 0.0, 0.0, 1.0
    distance = math.sqrt(u * u + v * v)
    hub, nave = _band(distance, -1.0, 0.62 * radius, width), _band(distance, -1.0, 0.2 * radius, width)
    return hub - nave, nave, 1.0


@njit(**INNER)
def _mix_vehicle(
    pattern: int, face: int, u: float, v: float, wu: float, wv: float, point: Float64Array, half: Float64Array
) -> tuple[float, float, float]:
    """The patterns of a car's parts."""
    half_u = half[1] if face == _ALONG_X else half[0]
    mix: tuple[float, float, float]
    if pattern == _CAR_BODY:
        mix = _car_body(face, u, v, wu, wv, half_u, 1.0 if point[0] > 0.0 else 0.0)
    elif pattern == _CAR_CABIN:
        mix = _car_cabin(face, u, v, wu, wv, half_u, 2.0 * half[2])
    else:
        mix = _tyre(face, u, v, half[0], max(wu, wv))
    return mix


@njit(**INNER)
def _mix_plant(
    pattern: int, u: float, v: float, wu: float, wv: float, point: Float64Array, salt: int
) -> tuple[float, float, float]:
    """The patterns of leaves and trunks."""
    mix: tuple[float, float, float]
    if pattern == _FOLIAGE:
        mix = _foliage(point[0], point[1], point[2], min(wu, wv), salt)
    else:
        mix = 0.5 + 0.5 * _noise(u / 0.12, v / 0.5, salt, wu / 0.12), 0.0, 1.0
    return mix


@njit(**INNER)
def _mix_palette(
    pattern: int, face: int, u: float, v: float, wu: float, wv: float, point: Float64Array, half: Float64Array,
    measures: Float64Array, salt: int,
) -> tuple[float, float, float]:  # fmt: skip
    """Mix an object's colours at (u, v) [m] of a face, v from the foot, for a ray as wide there as (wu, wv) [m].

    `point` (3,) and half sizes `half` (3,) in the body's own axes [m]; gives the shares of the palette's second and
    third colour, and the brightness.
    """
    mix: tuple[float, float, float]
    if pattern == _FACADE:
        half_u = half[1] if face == _ALONG_X else half[0]
        mix = _facade(face, u, v, wu, wv, half_u, 2.0 * half[2], measures, salt)
    elif pattern in (_CAR_BODY, _CAR_CABIN, _TYRE):
        mix = _mix_vehicle(pattern, face, u, v, wu, wv, point, half)
    elif pattern in (_FOLIAGE, _BARK):
        mix = _mix_plant(pattern, u, v, wu, wv, point, salt)
    elif pattern == _BRICK:
        mix = _brick(u, v, wu, wv, salt)
    elif pattern == _TILES:
        mix = _tiles(u, v, wu, wv, salt)
    else:
        stripes = _bands(v, measures[0], 0.0, 0.5 * measures[0], wv) if pattern == _BANDS else 0.0
        mix = stripes, 0.0, 1.0 + 0.03 * _noise(u / 0.5, v / 0.5, salt, max(wu, wv) / 0.5)
    return mix


_SUN = (0.48, -0.56, 0.675)
_AMBIENT, _DIRECT = 0.60, 0.52
_HAZE_START, _HAZE_LENGTH = 120.0, 260.0
_STRIP = 14.0
_HORIZON = (214.0, 226.0, 236.0)


@njit(**INNER)
def _face_of(kind: int, unit: Float64Array) -> int:
    """On which face of its unit body a point lies."""
    ax, ay, az = abs(unit[0]), abs(unit[1]), abs(unit[2])
    if kind == _BOX:
        return _ALONG_X if ax >= ay and ax >= az else (_ALONG_Y if ay >= az else _ALONG_Z)
    if kind == _CYLINDER:
        return _ALONG_Z if az >= math.sqrt(ax * ax + ay * ay) else _SLANTED
    if kind == _ELLIPSOID:
        return _SLANTED
    slope = ay + 0.5 * unit[2] + 0.5
    if ax >= slope and ax >= -unit[2]:
        return _ALONG_X
    return _SLANTED if slope >= -unit[2] else _ALONG_Z


@njit(**INNER)
def _tangent_frame(kind: int, face: int, unit: Float64Array, half: Float64Array, frame: Float64Array) -> None:
    """Write the normal and the u and v directions of a surface point, rows in metres along the body's axes."""
    for i in range(9):
        frame[i // 3, i % 3] = 0.0
    if face != _SLANTED:
        frame[0, face] = 1.0 if unit[face] > 0.0 else -1.0
        frame[1, 1 if face == _ALONG_X else 0] = 1.0
        frame[2, 1 if face == _ALONG_Z else 2] = 1.0
        return
    if kind in (_CYLINDER, _ELLIPSOID):
        frame[0, 0], frame[0, 1] = unit[0] / half[0], unit[1] / half[1]
        frame[0, 2] = unit[2] / half[2] if kind == _ELLIPSOID else 0.0
        frame[1, 0], frame[1, 1] = -frame[0, 1], frame[0, 0]
    else:
        frame[0, 1], frame[0, 2] = (1.0 if unit[1] > 0.0 else -1.0) / half[1], 0.5 / half[2]
        frame[1, 0] = 1.0
    length = math.sqrt(frame[0, 0] ** 2 + frame[0, 1] ** 2 + frame[0, 2] ** 2)
    level = max(1e-9, math.sqrt(frame[1, 0] ** 2 + frame[1, 1] ** 2))
    for i in range(3):
        frame[0, i] /= length
        frame[1, i] /= level
    frame[2, 0] = frame[0, 1] * frame[1, 2] - frame[0, 2] * frame[1, 1]
    frame[2, 1] = frame[0, 2] * frame[1, 0] - frame[0, 0] * frame[1, 2]
    frame[2, 2] = frame[0, 0] * frame[1, 1] - frame[0, 1] * frame[1, 0]


@njit(**INNER)
def _surface_point(kind: int, face: int, unit: Float64Array, half: Float64Array) -> tuple[float, float]:
    """Surface coordinates (u, v) in metres; v counts from the body's foot on upright faces."""
    if kind == _CYLINDER and face == _SLANTED:
        return math.atan2(unit[1], unit[0]) * half[0], (unit[2] + 1.0) * half[2]
    if face == _SLANTED:
        return unit[0] * half[0], math.sqrt((unit[1] * half[1]) ** 2 + ((1.0 - unit[2]) * half[2]) ** 2)
    if face == _ALONG_Z:
        return unit[0] * half[0], unit[1] * half[1]
    return unit[1 - face] * half[1 - face], (unit[2] + 1.0) * half[2]


@njit(**INNER)
def _sunlight(x: float, y: float, z: float) -> float:
    """Brightness of a surface by its normal."""
    direct = x * _SUN[0] + y * _SUN[1] + z * _SUN[2]
    return float(_AMBIENT + _DIRECT * max(0.0, direct) + 0.08 * z)


@njit(**INNER)
def _line_share(s: float, d: float, ws: float, wd: float) -> float:
    """Share of paint on the road: dashed lines along it, stripes of crossings."""
    share = 0.0
    if abs(d - 1.75) < 0.08 + wd:
        share = _band(d, 1.69, 1.81, wd) * _bands(s, 6.0, 0.0, 3.0, ws)
    elif abs(abs(d - 1.75) - 3.53) < 0.08 + wd:
        share = (_band(d, -1.83, -1.73, wd) + _band(d, 5.23, 5.33, wd)) * _bands(s, 2.0, 0.0, 1.0, ws)
    crossing = _bands(s, 90.0, 24.0, 27.0, ws)
    if crossing > 0.0:
        share += crossing * _bands(d - 0.25, 1.0, 0.0, 0.5, wd) * _band(d, -3.75, 7.25, wd)
    return float(share)


@njit(**INNER)
def _ground_weights(s: float, d: float, ws: float, wd: float, weights: Float64Array) -> None:
    """Shares of asphalt, paint, pavement, kerb and grass at `s` along and `d` left of the ego trajectory."""
    road = _band(d, -4.0, 7.5, wd)
    paint = min(road, _line_share(s, d, ws, wd)) if road > 0.0 else 0.0
    walk, kerb = 0.0, 0.0
    if road < 1.0:
        kerb = _band(d, -4.18, -4.0, wd) + _band(d, 7.5, 7.68, wd)
        walk = _band(d, -6.9, -4.18, wd) + _band(d, 7.68, 10.4, wd)
    weights[0], weights[1], weights[2], weights[3] = road - paint, paint, walk, kerb
    weights[4] = max(0.0, 1.0 - road - walk - kerb)


@njit(**INNER)
def _ground_brightness(x: float, y: float, s: float, d: float, w: float, ws: float, wd: float, part: int) -> float:
    """Grain of each kind of ground."""
    if part == 0:
        return 1.0 + 0.07 * _noise(x / 0.25, y / 0.25, 1, w / 0.25) + 0.06 * _noise(s / 4.0, d / 0.8, 2, w / 0.8)
    if part == 1:
        return float(1.0 + 0.05 * _noise(x / 0.3, y / 0.3, 3, w / 0.3))
    if part == 2:
        joints = 1.0 - _bands(s, 0.6, 0.025, 0.6, ws) * _bands(d, 0.45, 0.025, 0.45, wd)
        return float(1.0 - 0.2 * joints + 0.05 * _noise(s / 0.6, d / 0.45, 4, w / 0.45))
    if part == 3:
        return float(1.0 - 0.15 * _bands(s, 1.0, 0.0, 0.03, ws))
    return float(1.0 + 0.13 * _noise(x / 0.35, y / 0.35, 5, w / 0.35) + 0.12 * _noise(x / 3.0, y / 3.0, 6, w / 3.0))


@njit(**INNER)
def _road_coordinates(
    x: float, y: float, road: Float32Array, corner: Float64Array, cell: float, out: Float64Array
) -> None:
    """Read `s`, `d` and the road's direction off the map of the ground, linear between its nodes."""
    u, v = (x - corner[0]) / cell, (y - corner[1]) / cell
    i, j = math.floor(u), math.floor(v)
    if i < 0 or j < 0 or i >= road.shape[0] - 1 or j >= road.shape[1] - 1:
        out[0], out[1], out[2], out[3] = 0.0, 1e3, 1.0, 0.0
        return
    a, b = u - i, v - j
    # Beyond the strip that was drawn nothing is between the nodes: left and right of the trajectory meet there.
    edge = max(abs(road[i, j, 1]), abs(road[i + 1, j, 1]), abs(road[i, j + 1, 1]), abs(road[i + 1, j + 1, 1]))
    if edge >= _STRIP:
        out[0], out[1], out[2], out[3] = 0.0, 1e3, 1.0, 0.0
        return
    for k in range(4):
        low = road[i, j, k] * (1.0 - a) + road[i + 1, j, k] * a
        out[k] = low * (1.0 - b) + (road[i, j + 1, k] * (1.0 - a) + road[i + 1, j + 1, k] * a) * b


@njit(**INNER)
def _paint_ground(
    x: float, y: float, u: float, v: float, w: float, footprint: float, road: Float32Array, corner: Float64Array,
    cell: float, palette: Float64Array, location: Float64Array, weights: Float64Array, color: Float64Array,
) -> None:  # fmt: skip
    """Write the colour of a ground point (x, y) seen along the direction (u, v, w)."""
    _road_coordinates(x, y, road, corner, cell, location)
    s, d, along = location[0], location[1], location[2] * u + location[3] * v
    across = location[2] * v - location[3] * u
    ws = footprint * math.sqrt(1.0 + (along / w) ** 2)
    wd = footprint * math.sqrt(1.0 + (across / w) ** 2)
    grain = 0.5 * (min(ws, wd) + math.sqrt(ws * wd))
    _ground_weights(s, d, ws, wd, weights)
    light = _sunlight(0.0, 0.0, 1.0)
    color[0], color[1], color[2] = 0.0, 0.0, 0.0
    for part in range(5):
        if weights[part] > 0.0:
            amount = light * weights[part] * _ground_brightness(x, y, s, d, grain, ws, wd, part)
            for i in range(3):
                color[i] += amount * palette[part, i]


@njit(**INNER)
def _paint_sky(u: float, v: float, w: float, color: Float64Array) -> None:
    """Write the colour of the sky along a direction: a gradient, soft clouds, a line of far hills."""
    azimuth = math.atan2(v, u)
    height = max(0.0, w)
    blue = 1.0 - math.exp(-4.0 * height)
    color[0] = _HORIZON[0] + (96.0 - _HORIZON[0]) * blue
    color[1] = _HORIZON[1] + (150.0 - _HORIZON[1]) * blue
    color[2] = _HORIZON[2] + (214.0 - _HORIZON[2]) * blue
    x, y = 1.6 * u / (height + 0.12), 1.6 * v / (height + 0.12)
    density = _noise(0.5 * x, 0.5 * y, 11, 0.0) + 0.5 * _noise(x, y, 12, 0.0) + 0.25 * _noise(2.1 * x, 2.1 * y, 13, 0.2)
    cloud = min(1.0, max(0.0, 1.1 * density - 0.15)) * min(1.0, height / 0.16)
    hills = 0.022 + 0.012 * _noise(3.0 * azimuth, 0.5, 14, 0.0) + 0.006 * _noise(9.0 * azimuth, 0.5, 15, 0.0)
    hill = min(1.0, max(0.0, (hills - w) / 0.004))
    for i in range(3):
        color[i] += (247.0 - color[i]) * 0.8 * cloud
    color[0] += (142.0 - color[0]) * hill
    color[1] += (160.0 - color[1]) * hill
    color[2] += (162.0 - color[2]) * hill


@njit(**INNER)
def _paint_shape(
    x: float, y: float, z: float, u: float, v: float, w: float, footprint: float, hit: int, kinds: UInt8Array,
    maps: Float64Array, halves: Float64Array, patterns: UInt8Array, palettes: Float64Array, measures: Float64Array,
    salts: Int64Array, scratch: Float64Array, color: Float64Array,
) -> float:  # fmt: skip
    """Write the colour of a shape's bare surface at (x, y, z) seen along (u, v, w) and, in `scratch[1]`, its normal.

    All in the frame that the shape's map starts from. Gives the signed cosine of incidence.
    """
    m, half, kind = maps[hit], halves[hit], kinds[hit]
    unit, local, point, frame = scratch[0], scratch[1], scratch[2], scratch[3:6]
    for i in range(3):
        unit[i] = m[i, 0] * x + m[i, 1] * y + m[i, 2] * z + m[i, 3]
        local[i] = (m[i, 0] * u + m[i, 1] * v + m[i, 2] * w) * half[i]
        point[i] = unit[i] * half[i]
    face = _face_of(kind, unit)
    _tangent_frame(kind, face, unit, half, frame)
    facing = frame[0, 0] * local[0] + frame[0, 1] * local[1] + frame[0, 2] * local[2]
    along = frame[1, 0] * local[0] + frame[1, 1] * local[1] + frame[1, 2] * local[2]
    rising = frame[2, 0] * local[0] + frame[2, 1] * local[1] + frame[2, 2] * local[2]
    steep = max(1e-3, abs(facing))
    su, sv = _surface_point(kind, face, unit, half)
    wu, wv = (footprint * math.sqrt(1.0 + (along / steep) ** 2), footprint * math.sqrt(1.0 + (rising / steep) ** 2))
    second, third, bright = _mix_palette(patterns[hit], face, su, sv, wu, wv, point, half, measures[hit], salts[hit])
    for i in range(3):
        local[i] = m[0, i] * half[0] * frame[0, 0] + m[1, i] * half[1] * frame[0, 1] + m[2, i] * half[2] * frame[0, 2]
    for i in range(3):
        base = palettes[hit, 0, i] * (1.0 - second - third)
        color[i] = bright * (base + palettes[hit, 1, i] * second + palettes[hit, 2, i] * third)
    return float(facing)


@njit(**INNER)
def _rotation_to_world(frame: Float64Array, normal: Float64Array) -> None:
    """Rotate a normal (3,) from a frame (3, 4) `frame_from_world` into the world."""
    x, y, z = normal[0], normal[1], normal[2]
    for i in range(3):
        normal[i] = frame[0, i] * x + frame[1, i] * y + frame[2, i] * z


@kernel(
    "void(int64, int64, float64[:,::1], int32[::1], float64[:,:,::1], float64[:,::1], int64[::1], float64[::1], "
    "int32[::1], "
    "uint8[::1], float64[:,:,::1], int32[::1], float64[:,:,:,::1], float64[:,::1], uint8[::1], float64[:,:,::1], "
    "float64[:,::1], int64[::1], float32[:,:,::1], float64[::1], float64, float64[:,::1], float64, "
    "uint8[:,::1], float32[::1])"
)
def _paint_rays(
    start: int, stop: int,
    directions: Float64Array, pose_of_ray: Int32Array, rotations: Float64Array, origins: Float64Array,
    slots: Int64Array, ranges: Float64Array, hits: Int32Array, kinds: UInt8Array, maps: Float64Array,
    frame_of_shape: Int32Array, frames: Float64Array, halves: Float64Array, patterns: UInt8Array,
    palettes: Float64Array, measures: Float64Array, salts: Int64Array, road: Float32Array, corner: Float64Array,
    cell: float, ground_palette: Float64Array, pixel_angle: float, colors: UInt8Array, facings: Float32Array,
) -> None:  # fmt: skip
    """Write `Paint`, colours and facings, of what rays met: arrays as in `Rays`, `Hits`, `PackedShapes`, `GroundMap`.

    `salts` (P,) make the noise of one object differ from another's; `ground_palette` (5, 3): asphalt, paint, pavement,
    kerb, grass.
    """
    color, location, weights = np.empty(3), np.empty(4), np.empty(5)
    scratch, own = np.empty((6, 3)), np.empty(6)
    for k in range(start, stop):
        r, origin, slot = rotations[pose_of_ray[k]], origins[pose_of_ray[k]], slots[k]
        u = r[0, 0] * directions[k, 0] + r[0, 1] * directions[k, 1] + r[0, 2] * directions[k, 2]
        v = r[1, 0] * directions[k, 0] + r[1, 1] * directions[k, 1] + r[1, 2] * directions[k, 2]
        w = r[2, 0] * directions[k, 0] + r[2, 1] * directions[k, 1] + r[2, 2] * directions[k, 2]
        hit, t, facing = hits[slot], ranges[slot], 0.0
        x, y, z, footprint = origin[0] + t * u, origin[1] + t * v, origin[2] + t * w, pixel_angle * t
        if hit == SKY:
            _paint_sky(u, v, w, color)
        elif hit == GROUND:
            _paint_ground(x, y, u, v, w, footprint, road, corner, cell, ground_palette, location, weights, color)
            facing = w
        else:
            column = frame_of_shape[hit]
            if column >= 0:
                _take_into_frame(frames[pose_of_ray[k], column], x, y, z, u, v, w, own)
                x, y, z, u, v, w = own[0], own[1], own[2], own[3], own[4], own[5]
            facing = _paint_shape(
                x, y, z, u, v, w, footprint, hit,
                kinds, maps, halves, patterns, palettes, measures, salts, scratch, color,
            )  # fmt: skip
            normal = scratch[1]
            if column >= 0:
                _rotation_to_world(frames[pose_of_ray[k], column], normal)
            light = _sunlight(normal[0], normal[1], normal[2])
            color[0], color[1], color[2] = light * color[0], light * color[1], light * color[2]
        facings[slot] = abs(facing)
        haze = 0.0
        if t > _HAZE_START and pixel_angle > 0.0:
            haze = 1.0 - math.exp((_HAZE_START - t) / _HAZE_LENGTH)
        for i in range(3):
            colors[slot, i] = np.uint8(min(255.0, max(0.0, color[i] + (_HORIZON[i] - color[i]) * haze + 0.5)))


SKY_INSTANCE, GROUND_INSTANCE = -1, 0
"""What instance images state where there is no object."""

_WORKERS = 16  # rows that count at the same time
_POOL = ThreadPool(int(os.environ.get("NUMBA_NUM_THREADS") or os.cpu_count() or 1))
_BLOCK, _SHARES = 64, 8
"""Bundles are dealt out in blocks (a row of tiles or so) to this many shares, so that threads finish together."""


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """Directions in a sensor's frame, sorted into bundles of neighbours.

    Attributes:
        directions: (N, 3) float64, unit.
        pose_of_ray: (N,) int32, which of the sensor's poses a ray starts from.
        bundle_starts: (B + 1,) int64, the first ray of each bundle and N.
        slots: (N,) int64, where a ray's answer goes.
        slot_count: length of the answers; slots without a ray stay empty.
    """

    directions: Float64Array
    pose_of_ray: AnyArray
    bundle_starts: Int64Array
    slots: Int64Array
    slot_count: int

    @classmethod
    def bundled(
        cls, directions: Float64Array, bundle_of_ray: Int64Array, *, pose_of_ray: Int64Array | None = None
    ) -> "Rays":
        """Sort rays by the bundle they belong to; rays that are not finite are left out.

        Args:
            directions: (N, 3) float64, unit; ray k answers in slot k.
            bundle_of_ray: (N,) int64, any numbers, equal for neighbours.
            pose_of_ray: (N,) int64, None where all rays share one pose.
        """
        used = np.flatnonzero(np.isfinite(directions).all(axis=1))
        _, bundle = np.unique(bundle_of_ray[used], return_inverse=True)
        bundle = bundle + (bundle // _BLOCK % _SHARES) * len(directions)
        rotation = np.argsort(bundle, kind="stable")
        order, edges = used[rotation], np.flatnonzero(np.diff(bundle[rotation])) + 1
        starts = np.concatenate([[0], edges, [len(order)]]) if len(order) else np.zeros(1)
        poses = np.zeros(len(order)) if pose_of_ray is None else pose_of_ray[order]
        return cls(
            np.ascontiguousarray(directions[order], np.float64),
            poses.astype(np.int32),
            starts.astype(np.int64),
            order.astype(np.int64),
            len(directions),
        )

    def spread(self) -> Float64Array:
        """The directions by slot, (slot_count, 3) float64; undefined in slots without a ray."""
        directions = np.empty((self.slot_count, 3))
        directions[self.slots] = self.directions
        return directions


@dataclass(frozen=True, slots=True, eq=False)
class Moving:
    """What is near a sensor, and where it is at each of its poses if it moves.

    Attributes:
        frame_of_shape: (P,) int32, for each body of the street the column of `frames`, -1 where it is stationary or is
            too far away.
        frames: (M, F, 3, 4) float64 `frame_from_world`.
        spheres: (P, 4) float64 [m], balls that hold the bodies at all of the poses' times.
        candidates: (C,) int32, the bodies that are near enough.
    """

    frame_of_shape: AnyArray
    frames: Float64Array
    spheres: Float64Array
    candidates: AnyArray


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """What rays met, one answer per slot.

    Attributes:
        ranges: (S,) float64 [m], 0 where nothing was met.
        shapes: (S,) int32, number of the shape among the street's bodies, or `GROUND` or `SKY` of the ray caster.
        moving: where what moves was at the times of the rays.
    """

    ranges: Float64Array
    shapes: AnyArray
    moving: Moving


@dataclass(frozen=True, slots=True, eq=False)
class Paint:
    """How the met surfaces look, one answer per slot.

    Attributes:
        colors: (S, 3) uint8.
        facings: (S,) float32, cosine between ray and normal, 0 where nothing was met.
    """

    colors: UInt8Array
    facings: Float32Array


def cast(
    street: Street, rays: Rays, rotations: Float64Array, origins: Float64Array, times_ns: Int64Array, *, reach: float
) -> Hits:
    """Find what each ray meets first.

    Args:
        rotations: (M, 3, 3) float64 `world_from_sensor`, one per pose.
        origins: (M, 3) float64 [m], world frame.
        times_ns: (M,) int64 [ns], when each pose holds: what moves is met where it is then.
        reach: how far the rays go [m].
    """
    ranges = np.zeros(rays.slot_count)
    shapes = np.full(rays.slot_count, SKY, np.int32)
    bodies = street.bodies
    moving = _moving(street, origins, times_ns, reach=reach)
    _side_by_side(
        _trace_rays, len(rays.bundle_starts) - 1, rays.directions, rays.pose_of_ray,
        np.ascontiguousarray(rotations, np.float64), np.ascontiguousarray(origins, np.float64),
        rays.bundle_starts, rays.slots, bodies.kinds, bodies.maps,
        moving.frame_of_shape, moving.frames, moving.spheres, moving.candidates, float(reach), ranges, shapes,
    )  # fmt: skip
    return Hits(ranges, shapes, moving)


def silhouettes(
    street: Street, rays: Rays, rotations: Float64Array, origins: Float64Array, times_ns: Int64Array, *, reach: float
) -> Int64Array:
    """Count for each object, whatever stands or moves, the rays that would meet it if it were alone.

    Args:
        rotations, origins, times_ns, reach: as in `cast`.

    Returns:
        (I,) int64, by instance number - 1.
    """
    bodies = street.bodies
    moving = _moving(street, origins, times_ns, reach=reach)
    counts = np.zeros((_WORKERS, len(street.objects) + len(street.movers)), np.int64)
    _side_by_side(
        _count_silhouettes, _WORKERS, rays.directions, rays.pose_of_ray,
        np.ascontiguousarray(rotations, np.float64), np.ascontiguousarray(origins, np.float64),
        rays.bundle_starts, bodies.kinds, bodies.maps, (bodies.instances - 1).astype(np.int32),
        moving.frame_of_shape, moving.frames, moving.spheres, moving.candidates, float(reach), counts,
    )  # fmt: skip
    totals: Int64Array = counts.sum(axis=0)
    return totals


def _side_by_side(work: Callable[..., None], length: int, *arguments: Any) -> None:
    """Call a kernel in all threads, with the bounds of shares of a length before its arguments."""
    _POOL.share(Phase(length, lambda _, start, stop: work(start, stop, *arguments), _SHARES))


def _moving(street: Street, origins: Float64Array, times_ns: Int64Array, *, reach: float) -> Moving:
    """Find what rays of a length can meet from origins (M, 3) at (M,) times, and where what moves is then."""
    middle = origins.mean(axis=0)
    within = reach + float(np.linalg.norm(origins - middle, axis=1).max())
    movers, first = street.movers, len(street.shapes)
    frame_of_shape = np.full(len(street.bodies), -1, np.int32)
    frames, spheres = np.zeros((len(times_ns), 0, 3, 4)), street.bodies.spheres
    candidates = np.flatnonzero(np.linalg.norm(spheres[:first, :3] - middle, axis=1) < within + spheres[:first, 3])
    near = movers.near(middle, times_ns, within=within)
    if len(near):
        placed = movers.placed(near, times_ns)
        frames, spheres = placed.frames, spheres.copy()
        frame_of_shape[first + placed.shapes] = placed.frame_of_shape
        spheres[first + placed.shapes] = placed.spheres
        candidates = np.concatenate([candidates, first + placed.shapes])
    return Moving(frame_of_shape, frames, spheres, candidates.astype(np.int32))


def paint(
    street: Street, rays: Rays, rotations: Float64Array, origins: Float64Array, hits: Hits, *, pixel_angle: float = 0.0
) -> Paint:
    """Colour what the rays met, with the poses that they were cast with.

    Args:
        rotations, origins: as in `cast`; what moves stays where `hits` found it.
        pixel_angle: width of a ray [rad], 0 for the bare surface.
    """
    colors = np.zeros((rays.slot_count, 3), np.uint8)
    facings = np.zeros(rays.slot_count, np.float32)
    shapes = street.bodies
    _side_by_side(
        _paint_rays, len(rays.slots), rays.directions, rays.pose_of_ray,
        np.ascontiguousarray(rotations, np.float64), np.ascontiguousarray(origins, np.float64),
        rays.slots, hits.ranges, hits.shapes, shapes.kinds, shapes.maps, hits.moving.frame_of_shape,
        hits.moving.frames, shapes.halves, shapes.patterns, shapes.palettes, shapes.measures, shapes.instances,
        street.ground.nodes, street.ground.corner, street.ground.cell,
        np.array(PALETTE, np.float64), float(pixel_angle), colors, facings,
    )  # fmt: skip
    return Paint(colors, facings)


def instances_of(street: Street, hits: Hits) -> AnyArray:
    """Give the instance number of each hit, (S,) int32."""
    numbers = np.append(street.bodies.instances, [SKY_INSTANCE, GROUND_INSTANCE]).astype(np.int32)
    # The ray caster's SKY and GROUND are -2 and -1, so they index the two entries at the end.
    return numbers[hits.shapes]


def bundles_by_direction(directions: Float64Array, *, across: int = 64) -> Int64Array:
    """Put unit directions (N, 3) that point nearly the same way under one number: cells of a cube's faces."""
    largest = np.argmax(np.abs(directions), axis=1)
    rows = np.arange(len(directions))
    scaled = directions / np.maximum(1e-300, np.abs(directions[rows, largest]))[:, None]
    cells = np.clip(((scaled + 1.0) * (0.5 * across)).astype(np.int64), 0, across - 1)
    face = 2 * largest + (directions[rows, largest] > 0)
    a, b = cells[rows, (largest + 1) % 3], cells[rows, (largest + 2) % 3]
    numbers: Int64Array = (face * across + a) * across + b
    return numbers
