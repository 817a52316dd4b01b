"""Where objects may be of which a picture tells alone, by the height at which it shows them."""

import numpy as np
from numba import njit

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.kernels.cache import kernel

PLACES = 5
"""Rays through each box: through its middle, the middles of top and bottom, and those of left and right."""

_TABLE, _VECTOR = "Array(float64, 2, 'C', readonly=True)", "Array(float64, 1, 'C', readonly=True)"
_ROWS, _BLOCKS = "float64[:,::1]", "float64[:,:,::1]"


@kernel("float64[:,::1](float64[:,::1], int64[::1], float64)", nogil=True, cache=True, error_model="numpy")
def ray_places(corners_xyxy: Float64Array, rows: Int64Array, centre_to_corner: float) -> Float64Array:
    """Give the places in a picture through which rays are sent.

    Args:
        corners_xyxy: (M, 4) [px], boxes, corner convention.
        rows: (L,), which of them are asked for.
        centre_to_corner: from the centre convention to that of the corners [px].

    Returns:
        (L * PLACES, 2) float64 [px], centre convention.
    """
    places = np.empty((len(rows) * PLACES, 2))
    for n in range(len(rows)):
        left, top, right, bottom = corners_xyxy[rows[n]]
        middle_u, middle_v, k = (left + right) / 2.0, (top + bottom) / 2.0, n * PLACES
        places[k, 0], places[k, 1] = middle_u, middle_v
        places[k + 1, 0], places[k + 1, 1] = middle_u, top
        places[k + 2, 0], places[k + 2, 1] = middle_u, bottom
        places[k + 3, 0], places[k + 3, 1] = left, middle_v
        places[k + 4, 0], places[k + 4, 1] = right, middle_v
    places -= centre_to_corner
    return places


@njit(nogil=True, error_model="numpy", inline="always")
def _angle(rays, one, other):  # type: ignore[no-untyped-def]
    """Angle between unit vectors [rad], by the chord between them."""
    square = 0.0
    for k in range(3):
        square += (rays[one, k] - rays[other, k]) ** 2
    return 2.0 * np.arcsin(min(np.sqrt(square) / 2.0, 1.0))


@njit(nogil=True, error_model="numpy")
def _spread(corners, n, picture_height, edges, relative, angles):  # type: ignore[no-untyped-def]
    """Variances of an object's place along its ray and across, both as shares of its distance squared."""
    wide, high = corners[n, 2] - corners[n, 0], corners[n, 3] - corners[n, 1]
    edge_share, edge_px, border, cut_sigma = edges
    sideways, upright = (edge_share + edge_px / wide) ** 2, (edge_share + edge_px / high) ** 2
    along = relative * relative + 2.0 * upright
    if corners[n, 1] < border or corners[n, 3] > picture_height - border:
        along += cut_sigma * cut_sigma
    return along, max(sideways * angles[1] * angles[1], upright * angles[0] * angles[0])


@njit(nogil=True, error_model="numpy")
def _put(rays, first, rotation, translation, distance, spread, ray, n, centers, covariances):  # type: ignore[no-untyped-def]
    """Fill in the place of an object and its covariance, in the lidar's frame."""
    along, across = distance * distance * spread[0], distance * distance * spread[1]
    for k in range(3):
        ray[k] = 0.0
        centers[n, k] = 0.0
        for i in range(3):
            ray[k] += rays[first, i] * rotation[i, k]
            centers[n, k] -= rotation[i, k] * translation[i]
        centers[n, k] += distance * ray[k]
    for i in range(3):
        for k in range(3):
            outer = ray[i] * ray[k]
            covariances[n, i, k] = across * ((1.0 if i == k else 0.0) - outer) + along * outer


@kernel(
    f"Tuple((int64[::1], {_ROWS}, {_BLOCKS}, {_ROWS}, {_BLOCKS}, float64[::1]))({_ROWS}, int64[::1], {_ROWS}, "
    f"int64[::1], {_TABLE}, {_TABLE}, {_VECTOR}, float64, UniTuple(float64, 4))",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def place_by_height(
    corners_xyxy: Float64Array,
    rows: Int64Array,
    rays: Float64Array,
    kinds: Int64Array,
    sizes: Float64Array,
    rotation: Float64Array,
    translation: Float64Array,
    picture_height: float,
    edges: tuple[float, float, float, float],
) -> tuple[Int64Array, Float64Array, Float64Array, Float64Array, Float64Array, Float64Array]:
    """Guess where objects are whose boxes in the picture are all that is known.

    Args:
        corners_xyxy: (M, 4) [px], boxes, corner convention, with an area.
        rows: (L,), which of them are asked for.
        rays: (L * PLACES, 3), unit, of `ray_places`, camera's frame; NaN where the lens has none.
        kinds: (M,), rows of `sizes`.
        sizes: (K, 6) [m], usual length, width, height of a kind, and their deviations.
        rotation, translation: (3, 3) and (3,) [m], take the lidar's frame into the camera's.
        picture_height: [px].
        edges: deviation of an edge of a box as a share of its side, and beside that [px]; what comes so near to the
            border [px] may be cut there; deviation of the distance of such a box, as a share of it.

    Returns:
        rows: (P,) int64, those of the given rows for which the lens has rays; then of these
        centers: (P, 3) float64 [m] and covariances (P, 3, 3) [m²], lidar's frame;
        sizes: (P, 3) float64 [m] and covariances (P, 3, 3) [m²];
        distances: (P,) float64 [m], from the camera.
    """
    room, count, ray = len(rows), 0, np.empty(3)
    kept, distances = np.empty(room, np.int64), np.empty(room)
    centers, lengths = np.empty((room, 3)), np.empty((room, 3))
    center_covariances, size_covariances = np.empty((room, 3, 3)), np.zeros((room, 3, 3))
    for n in range(room):
        first = n * PLACES
        angles = (_angle(rays, first + 1, first + 2), _angle(rays, first + 3, first + 4))
        # a ray that is no number makes a sum that is none
        if not (np.isfinite(rays[first : first + PLACES].sum()) and angles[0] > 0.0):
            continue
        size = sizes[kinds[rows[n]]]
        distance = size[2] / (2.0 * np.tan(min(angles[0], 3.0) / 2.0)) + size[1] / 2.0
        spread = _spread(corners_xyxy, rows[n], picture_height, edges, size[5] / size[2], angles)
        _put(rays, first, rotation, translation, distance, spread, ray, count, centers, center_covariances)
        for k in range(3):
            lengths[count, k], size_covariances[count, k, k] = size[k], size[3 + k] ** 2
        kept[count], distances[count] = rows[n], distance
        count += 1
    return (
        kept[:count],
        centers[:count],
        center_covariances[:count],
        lengths[:count],
        size_covariances[:count],
        distances[:count],
    )
