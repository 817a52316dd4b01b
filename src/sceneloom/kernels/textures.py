"""What the simulated world looks like: the colour of every surface as a function of where on it a ray ends.

A pattern mixes the three colours of an object's palette. Edges inside a pattern are averaged over the width that a
pixel covers on the surface (a box filter, exact for stripes), and noise fades where it becomes finer than a pixel, so
images do not shimmer and video codecs keep them. Without a pixel (`pixel_angle` 0) edges are 2 cm soft.

Source: the filtered pulse train is that of Apodaca and Gritz, "Advanced RenderMan", 1999, chapter 11.
"""

import math

from numba import njit

from sceneloom.arrays import Float64Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.raycast import INNER

PLAIN, FACADE, BRICK, TILES, FOLIAGE, BARK, CAR_BODY, CAR_CABIN, TYRE, BANDS = range(10)
"""The patterns: see the functions below."""

ALONG_X, ALONG_Y, ALONG_Z, SLANTED = range(4)
"""The faces of a body by the direction of their normal, as far as patterns report them apart."""

_SOFT = 0.02


@kernel("float64(int64, int64, int64)", **INNER)
def _hash(i: int, j: int, salt: int) -> float:
    """A number in [0, 1) that belongs to a lattice point."""
    h = (i * 374761393 + j * 668265263 + salt * 362437) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    return float((h ^ (h >> 16)) / 4294967296.0)


@kernel("float64(float64, float64, int64, float64)", **INNER)
def noise(x: float, y: float, salt: int, width: float) -> float:
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
def band(x: float, low: float, high: float, width: float) -> float:
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
def bands(x: float, period: float, low: float, high: float, width: float) -> float:
    """Share of a window of a width around x that lies in the bands [low, high) of every period."""
    width = max(width, _SOFT)
    span = _covered(x + 0.5 * width, period, low, high) - _covered(x - 0.5 * width, period, low, high)
    return float(span / width)


@njit(**INNER)
def _facade(
    face: int,
    u: float,
    v: float,
    wu: float,
    wv: float,
    half_u: float,
    height: float,
    measures: Float64Array,
    salt: int,
) -> tuple[float, float, float]:
    """Plaster or bricks with rows of windows: glass is the second colour, frames and ledges the third."""
    pitch, storey, bricks = measures[0], measures[1], measures[2]
    light = 1.0 + 0.05 * noise(u / 0.7, v / 0.7, salt, max(wu, wv) / 0.7)
    light *= 1.0 - 0.22 * band(v, -1.0, 0.45, wv)
    if bricks > 0.0:
        row = math.floor(v / 0.28)
        stones = bands(v, 0.28, 0.03, 0.28, wv) * bands(u + 0.3 * (row % 2), 0.6, 0.03, 0.6, wu)
        light *= 1.0 - bricks * (1.0 - stones)
    if face == ALONG_Z:
        return 0.0, 0.0, light
    ledges = bands(v, storey, 0.0, 0.12, wv) * band(v, 0.5, height, wv)
    count = math.floor(2.0 * half_u / pitch)
    inside = band(u, -0.5 * count * pitch, 0.5 * count * pitch, wu) * band(
        v, 0.5, math.floor(height / storey) * storey, wv
    )
    x = u + 0.5 * count * pitch
    low, high = 0.26 * pitch, 0.74 * pitch
    column = math.floor(x / pitch)
    if face == ALONG_Y and v < storey and 2 * column == count - count % 2:
        door = band(x - column * pitch, low, high, wu) * band(v, -1.0, 2.2, wv)
        leaf = band(x - column * pitch, low + 0.1, high - 0.1, wu) * band(v, -1.0, 2.1, wv)
        return 0.75 * leaf, door - leaf, light + leaf * (0.8 - light)
    outer = inside * bands(x, pitch, low, high, wu) * bands(v, storey, 0.32 * storey, 0.82 * storey, wv)
    if outer == 0.0:
        return 0.0, ledges, light
    middle = 0.5 * (low + high)
    panes = bands(x, pitch, low + 0.08, middle - 0.03, wu) + bands(x, pitch, middle + 0.03, high - 0.08, wu)
    glass = inside * panes * bands(v, storey, 0.32 * storey + 0.08, 0.82 * storey - 0.08, wv)
    glass = min(glass, outer)
    tone = 0.75 + 0.7 * _hash(column, math.floor(v / storey), salt)
    return glass, min(1.0 - glass, outer - glass + ledges * (1.0 - outer)), light + glass * (tone - light)


@njit(**INNER)
def _brick(u: float, v: float, wu: float, wv: float, salt: int) -> tuple[float, float, float]:
    """Courses of stones with joints in the second colour, each stone with a tone of its own."""
    row = math.floor(v / 0.25)
    x = u + 0.25 * (row % 2)
    stone = bands(v, 0.25, 0.03, 0.25, wv) * bands(x, 0.5, 0.03, 0.5, wu)
    tone = 0.16 * (_hash(math.floor(x / 0.5), row, salt) - 0.5) * max(0.0, 1.0 - 4.0 * max(wu, wv)) * stone
    return 1.0 - stone, 0.0, 1.0 + tone


@njit(**INNER)
def _tiles(u: float, v: float, wu: float, wv: float, salt: int) -> tuple[float, float, float]:
    """Rows of roof tiles, the second colour in the gaps."""
    gaps = 1.0 - bands(v, 0.4, 0.07, 0.4, wv) * bands(u, 0.5, 0.05, 0.5, wu)
    return 0.8 * gaps, 0.0, 1.0 + 0.1 * noise(u / 1.1, v / 0.8, salt, max(wu, wv))


@kernel("float64(float64, float64, float64, int64, float64)", **INNER)
def _noise_in_space(x: float, y: float, z: float, salt: int, width: float) -> float:
    """Smooth noise of period 1 in [-1, 1] inside a body, from two layers of plane noise."""
    layer = math.floor(z)
    c = z - layer
    c = c * c * (3.0 - 2.0 * c)
    below = noise(x + 0.37 * layer, y + 0.61 * layer, salt + 31 * layer, width)
    above = noise(x + 0.37 * (layer + 1), y + 0.61 * (layer + 1), salt + 31 * (layer + 1), width)
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
    sill = band(v, -1.0, 0.12, wv)
    if face == ALONG_Y:
        doors = band(abs(u - 0.15), 0.0, 0.025, wu) + band(abs(abs(u - 0.15) - 1.0), 0.0, 0.025, wu)
        trim = band(v, 0.33, 0.39, wv)
        return min(1.0, sill + 0.7 * doors + 0.8 * trim), 0.0, 1.0
    if face == ALONG_X:
        lamps = band(abs(u), half_u - 0.42, half_u - 0.1, wu) * band(v, 0.36, 0.54, wv)
        plate = band(abs(u), -1.0, 0.26, wu) * band(v, 0.2, 0.32, wv)
        grille = band(abs(u), -1.0, half_u - 0.5, wu) * band(v, 0.38, 0.5, wv) * front
        return min(1.0, sill + grille), min(1.0 - sill, lamps + plate), 1.0
    return 0.0, 0.0, 1.0


@njit(**INNER)
def _car_cabin(
    face: int, u: float, v: float, wu: float, wv: float, half_u: float, height: float
) -> tuple[float, float, float]:
    """Glass in the second colour between pillars and roof of the first."""
    if face == ALONG_Z:
        return 0.0, 0.0, 1.0
    glass = band(abs(u), -1.0, half_u - 0.09, wu) * band(v, 0.05, height - 0.09, wv)
    pillar = band(abs(u - 0.1), 0.0, 0.05, wu) if face == ALONG_Y else 0.0
    return max(0.0, glass - pillar), 0.0, 1.0


@njit(**INNER)
def _tyre(face: int, u: float, v: float, radius: float, width: float) -> tuple[float, float, float]:
    """Rubber with a hub in the second colour and a dark nave in the third."""
    if face != ALONG_Z:
        return 0.0, 0.0, 1.0
    distance = math.sqrt(u * u + v * v)
    hub, nave = band(distance, -1.0, 0.62 * radius, width), band(distance, -1.0, 0.2 * radius, width)
    return hub - nave, nave, 1.0


@njit(**INNER)
def _mix_vehicle(
    pattern: int, face: int, u: float, v: float, wu: float, wv: float, point: Float64Array, half: Float64Array
) -> tuple[float, float, float]:
    """The patterns of a car's parts."""
    half_u = half[1] if face == ALONG_X else half[0]
    mix: tuple[float, float, float]
    if pattern == CAR_BODY:
        mix = _car_body(face, u, v, wu, wv, half_u, 1.0 if point[0] > 0.0 else 0.0)
    elif pattern == CAR_CABIN:
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
    if pattern == FOLIAGE:
        mix = _foliage(point[0], point[1], point[2], min(wu, wv), salt)
    else:
        mix = 0.5 + 0.5 * noise(u / 0.12, v / 0.5, salt, wu / 0.12), 0.0, 1.0
    return mix


@njit(**INNER)
def mix_palette(
    pattern: int, face: int, u: float, v: float, wu: float, wv: float, point: Float64Array, half: Float64Array,
    measures: Float64Array, salt: int,
) -> tuple[float, float, float]:  # fmt: skip
    """Mix an object's colours at a point of its surface.

    Args:
        pattern, face: one of those above.
        u, v: surface coordinates [m]; v counts from the foot on upright faces.
        wu, wv: width of the ray along them [m].
        point: (3,) [m], in the body's own axes, from its middle.
        half: (3,) [m], half sizes of the body.
        measures: (3,), lengths of the pattern.
        salt: makes the noise of one object differ from another's.

    Returns:
        Share of the palette's second colour, of its third, and brightness.
    """
    mix: tuple[float, float, float]
    if pattern == FACADE:
        half_u = half[1] if face == ALONG_X else half[0]
        mix = _facade(face, u, v, wu, wv, half_u, 2.0 * half[2], measures, salt)
    elif pattern in (CAR_BODY, CAR_CABIN, TYRE):
        mix = _mix_vehicle(pattern, face, u, v, wu, wv, point, half)
    elif pattern in (FOLIAGE, BARK):
        mix = _mix_plant(pattern, u, v, wu, wv, point, salt)
    elif pattern == BRICK:
        mix = _brick(u, v, wu, wv, salt)
    elif pattern == TILES:
        mix = _tiles(u, v, wu, wv, salt)
    else:
        stripes = bands(v, measures[0], 0.0, 0.5 * measures[0], wv) if pattern == BANDS else 0.0
        mix = stripes, 0.0, 1.0 + 0.03 * noise(u / 0.5, v / 0.5, salt, max(wu, wv) / 0.5)
    return mix
