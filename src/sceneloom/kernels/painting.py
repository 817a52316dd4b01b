"""The colour of what each ray met: surfaces in sunlight, the street on the ground, haze, sky."""

import math

import numpy as np
from numba import njit, prange

from sceneloom.arrays import Float32Array, Float64Array, Int64Array, UInt8Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.raycast import (
    BOX,
    CYLINDER,
    ELLIPSOID,
    GROUND,
    INNER,
    SKY,
    Int32Array,
    take_into_frame,
)
from sceneloom.kernels.textures import ALONG_X, ALONG_Y, ALONG_Z, SLANTED, band, bands, mix_palette, noise

_SUN = (0.48, -0.56, 0.675)
_AMBIENT, _DIRECT = 0.60, 0.52
_HAZE_START, _HAZE_LENGTH = 120.0, 260.0
_STRIP = 14.0
_HORIZON = (214.0, 226.0, 236.0)


@njit(**INNER)
def _face_of(kind: int, unit: Float64Array) -> int:
    """On which face of its unit body a point lies."""
    ax, ay, az = abs(unit[0]), abs(unit[1]), abs(unit[2])
    if kind == BOX:
        return ALONG_X if ax >= ay and ax >= az else (ALONG_Y if ay >= az else ALONG_Z)
    if kind == CYLINDER:
        return ALONG_Z if az >= math.sqrt(ax * ax + ay * ay) else SLANTED
    if kind == ELLIPSOID:
        return SLANTED
    slope = ay + 0.5 * unit[2] + 0.5
    if ax >= slope and ax >= -unit[2]:
        return ALONG_X
    return SLANTED if slope >= -unit[2] else ALONG_Z


@njit(**INNER)
def _tangent_frame(kind: int, face: int, unit: Float64Array, half: Float64Array, frame: Float64Array) -> None:
    """Write the normal and the u and v directions of a surface point, rows in metres along the body's axes."""
    for i in range(9):
        frame[i // 3, i % 3] = 0.0
    if face != SLANTED:
        frame[0, face] = 1.0 if unit[face] > 0.0 else -1.0
        frame[1, 1 if face == ALONG_X else 0] = 1.0
        frame[2, 1 if face == ALONG_Z else 2] = 1.0
        return
    if kind in (CYLINDER, ELLIPSOID):
        frame[0, 0], frame[0, 1] = unit[0] / half[0], unit[1] / half[1]
        frame[0, 2] = unit[2] / half[2] if kind == ELLIPSOID else 0.0
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
    if kind == CYLINDER and face == SLANTED:
        return math.atan2(unit[1], unit[0]) * half[0], (unit[2] + 1.0) * half[2]
    if face == SLANTED:
        return unit[0] * half[0], math.sqrt((unit[1] * half[1]) ** 2 + ((1.0 - unit[2]) * half[2]) ** 2)
    if face == ALONG_Z:
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
        share = band(d, 1.69, 1.81, wd) * bands(s, 6.0, 0.0, 3.0, ws)
    elif abs(abs(d - 1.75) - 3.53) < 0.08 + wd:
        share = (band(d, -1.83, -1.73, wd) + band(d, 5.23, 5.33, wd)) * bands(s, 2.0, 0.0, 1.0, ws)
    crossing = bands(s, 90.0, 24.0, 27.0, ws)
    if crossing > 0.0:
        share += crossing * bands(d - 0.25, 1.0, 0.0, 0.5, wd) * band(d, -3.75, 7.25, wd)
    return float(share)


@njit(**INNER)
def _ground_weights(s: float, d: float, ws: float, wd: float, weights: Float64Array) -> None:
    """Shares of asphalt, paint, pavement, kerb and grass at `s` along and `d` left of the ego trajectory."""
    road = band(d, -4.0, 7.5, wd)
    paint = min(road, _line_share(s, d, ws, wd)) if road > 0.0 else 0.0
    walk, kerb = 0.0, 0.0
    if road < 1.0:
        kerb = band(d, -4.18, -4.0, wd) + band(d, 7.5, 7.68, wd)
        walk = band(d, -6.9, -4.18, wd) + band(d, 7.68, 10.4, wd)
    weights[0], weights[1], weights[2], weights[3] = road - paint, paint, walk, kerb
    weights[4] = max(0.0, 1.0 - road - walk - kerb)


@njit(**INNER)
def _ground_brightness(
    x: float, y: float, s: float, d: float, w: float, ws: float, wd: float, part: int
) -> float:
    """Grain of each kind of ground."""
    if part == 0:
        return (
            1.0 + 0.07 * noise(x / 0.25, y / 0.25, 1, w / 0.25) + 0.06 * noise(s / 4.0, d / 0.8, 2, w / 0.8)
        )
    if part == 1:
        return float(1.0 + 0.05 * noise(x / 0.3, y / 0.3, 3, w / 0.3))
    if part == 2:
        joints = 1.0 - bands(s, 0.6, 0.025, 0.6, ws) * bands(d, 0.45, 0.025, 0.45, wd)
        return float(1.0 - 0.2 * joints + 0.05 * noise(s / 0.6, d / 0.45, 4, w / 0.45))
    if part == 3:
        return float(1.0 - 0.15 * bands(s, 1.0, 0.0, 0.03, ws))
    return float(
        1.0 + 0.13 * noise(x / 0.35, y / 0.35, 5, w / 0.35) + 0.12 * noise(x / 3.0, y / 3.0, 6, w / 3.0)
    )


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
    density = (
        noise(0.5 * x, 0.5 * y, 11, 0.0)
        + 0.5 * noise(x, y, 12, 0.0)
        + 0.25 * noise(2.1 * x, 2.1 * y, 13, 0.2)
    )
    cloud = min(1.0, max(0.0, 1.1 * density - 0.15)) * min(1.0, height / 0.16)
    hills = 0.022 + 0.012 * noise(3.0 * azimuth, 0.5, 14, 0.0) + 0.006 * noise(9.0 * azimuth, 0.5, 15, 0.0)
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
    wu, wv = (
        footprint * math.sqrt(1.0 + (along / steep) ** 2),
        footprint * math.sqrt(1.0 + (rising / steep) ** 2),
    )
    second, third, bright = mix_palette(
        patterns[hit], face, su, sv, wu, wv, point, half, measures[hit], salts[hit]
    )
    for i in range(3):
        local[i] = (
            m[0, i] * half[0] * frame[0, 0]
            + m[1, i] * half[1] * frame[0, 1]
            + m[2, i] * half[2] * frame[0, 2]
        )
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


@njit(**INNER)
def _paint_chunk(
    start: int, stop: int,
    directions: Float64Array, pose_of_ray: Int32Array, rotations: Float64Array, origins: Float64Array,
    slots: Int64Array, ranges: Float64Array, hits: Int32Array, kinds: UInt8Array, maps: Float64Array,
    frame_of_shape: Int32Array, frames: Float64Array, halves: Float64Array, patterns: UInt8Array,
    palettes: Float64Array, measures: Float64Array, salts: Int64Array, road: Float32Array, corner: Float64Array,
    cell: float, ground_palette: Float64Array, pixel_angle: float, colors: UInt8Array, facings: Float32Array,
) -> None:  # fmt: skip
    """Paint the rays from `start` to `stop`; the other arguments as in `paint_rays`."""
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
            _paint_ground(
                x, y, u, v, w, footprint, road, corner, cell, ground_palette, location, weights, color
            )
            facing = w
        else:
            column = frame_of_shape[hit]
            if column >= 0:
                take_into_frame(frames[pose_of_ray[k], column], x, y, z, u, v, w, own)
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


@kernel(
    "void(float64[:,::1], int32[::1], float64[:,:,::1], float64[:,::1], int64[::1], float64[::1], int32[::1], "
    "uint8[::1], float64[:,:,::1], int32[::1], float64[:,:,:,::1], float64[:,::1], uint8[::1], float64[:,:,::1], "
    "float64[:,::1], int64[::1], float32[:,:,::1], float64[::1], float64, float64[:,::1], float64, "
    "uint8[:,::1], float32[::1])",
    parallel=True,
    nogil=True,
    cache=True,
    error_model="numpy",
)
def paint_rays(
    directions: Float64Array, pose_of_ray: Int32Array, rotations: Float64Array, origins: Float64Array,
    slots: Int64Array, ranges: Float64Array, hits: Int32Array, kinds: UInt8Array, maps: Float64Array,
    frame_of_shape: Int32Array, frames: Float64Array, halves: Float64Array, patterns: UInt8Array,
    palettes: Float64Array, measures: Float64Array, salts: Int64Array, road: Float32Array, corner: Float64Array,
    cell: float, ground_palette: Float64Array, pixel_angle: float, colors: UInt8Array, facings: Float32Array,
) -> None:  # fmt: skip
    """Give the colour that each ray brings back and how squarely it meets the surface.

    Args:
        directions, pose_of_ray, rotations, origins, slots, kinds, maps, frame_of_shape, frames: as in `trace_rays`.
        ranges, hits: (slots,) what `trace_rays` found.
        halves: (P, 3) float64 [m], half sizes along each body's axes.
        patterns: (P,) uint8.
        palettes: (P, 3, 3) float64, three colours of red, green, blue in 0..255.
        measures: (P, 3) float64, the lengths of a pattern.
        salts: (P,) int64, what makes the noise of one object differ from another's.
        road: (X, Y, 4) float32, map of the ground: along [m], left [m], direction (cos, sin) of the road.
        corner: (2,) float64 [m], where the map begins.
        cell: distance of the map's nodes [m].
        ground_palette: (5, 3) float64: asphalt, paint, pavement, kerb, grass.
        pixel_angle: angle between neighbouring rays, 0 for none.
        colors: (slots, 3) uint8, written.
        facings: (slots,) float32, written: cosine between ray and surface normal, 0 for the sky.
    """
    for chunk in prange((len(slots) + 4095) // 4096):
        _paint_chunk(
            4096 * chunk, min(len(slots), 4096 * chunk + 4096),
            directions, pose_of_ray, rotations, origins, slots, ranges, hits,
            kinds, maps, frame_of_shape, frames, halves, patterns, palettes, measures, salts,
            road, corner, cell, ground_palette, pixel_angle, colors, facings,
        )  # fmt: skip
