"""How upright boxes in space overlap, frame by frame, exactly: rectangles are cut along the edges of one another.

Boxes, `starts` and flat pairs are laid out as in `frame_overlaps`.
"""

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.kernels.cache import kernel

_MOST_CORNERS = 8
"""Of what two rectangles share."""

_LOCATIONS = "float64[:,::1], float64[:,::1], int64[::1], int64[::1], int64[::1]"


@kernel("int64(float64[:,::1], int64, float64[:,::1], int64, float64, float64)", nogil=True, cache=True)
def _cut(outline: Float64Array, count: int, kept: Float64Array, axis: int, side: float, limit: float) -> int:
    """Keep what of a convex outline has side · coordinate <= limit; give the number of its corners."""
    left = 0
    for k in range(count):
        after = k + 1 if k + 1 < count else 0
        here = limit - side * outline[k, axis]
        there = limit - side * outline[after, axis]
        if here >= 0.0:
            kept[left, 0], kept[left, 1] = outline[k, 0], outline[k, 1]
            left += 1
        if (here > 0.0 and there < 0.0) or (here < 0.0 and there > 0.0):
            share = here / (here - there)
            for d in range(2):
                kept[left, d] = outline[k, d] + share * (outline[after, d] - outline[k, d])
            left += 1
    return left


@kernel(
    "float64(float64[:,::1], int64, float64[:,::1], int64, float64[:,::1], float64[:,::1])",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def _shared_ground(
    first: Float64Array,
    i: int,
    second: Float64Array,
    j: int,
    outline: Float64Array,
    kept: Float64Array,
) -> float:
    """The area that two boxes share as seen from above [m²].

    Args:
        outline, kept: (16, 2), scratch.

    Source: Sutherland and Hodgman 1974 for the cuts, the shoelace formula for the area.
    """
    east, north = second[j, 0] - first[i, 0], second[j, 1] - first[i, 1]
    reach = np.sqrt(first[i, 3] ** 2 + first[i, 4] ** 2) + np.sqrt(second[j, 3] ** 2 + second[j, 4] ** 2)
    if 4.0 * (east * east + north * north) > reach * reach:
        return 0.0
    cosine, sine = np.cos(first[i, 6]), np.sin(first[i, 6])
    along, across = cosine * east + sine * north, cosine * north - sine * east
    rotation_of_vector = second[j, 6] - first[i, 6]
    rotated_x, rotated_y = np.cos(rotation_of_vector) / 2.0, np.sin(rotation_of_vector) / 2.0
    for k in range(4):
        forward = second[j, 3] if (k + 1) % 4 < 2 else -second[j, 3]
        leftward = second[j, 4] if k < 2 else -second[j, 4]
        outline[k, 0] = along + rotated_x * forward - rotated_y * leftward
        outline[k, 1] = across + rotated_y * forward + rotated_x * leftward
    count = _cut(outline, 4, kept, 0, 1.0, first[i, 3] / 2.0)
    count = _cut(kept, count, outline, 0, -1.0, first[i, 3] / 2.0)
    count = _cut(outline, count, kept, 1, 1.0, first[i, 4] / 2.0)
    count = _cut(kept, count, outline, 1, -1.0, first[i, 4] / 2.0)
    area = 0.0
    for k in range(count):
        after = k + 1 if k + 1 < count else 0
        area += outline[k, 0] * outline[after, 1] - outline[after, 0] * outline[k, 1]
    return max(area / 2.0, 0.0)


@kernel(f"float64[::1]({_LOCATIONS})", nogil=True, cache=True, error_model="numpy")
def overlaps_from_above(
    first: Float64Array,
    second: Float64Array,
    first_starts: Int64Array,
    second_starts: Int64Array,
    starts: Int64Array,
) -> Float64Array:
    """Give the intersection over the union of the ground that boxes stand on.

    Args:
        first, second: (N, 7) and (M, 7), middle, length, width, height [m] and heading about z [rad]; finite.
        first_starts, second_starts, starts: (F + 1,), of the boxes and of the pairs.

    Returns:
        (P,) float64, 0 to 1; 0 where a length or width is not above 0.
    """
    overlaps = np.zeros(starts[-1])
    outline, kept = np.empty((2 * _MOST_CORNERS, 2)), np.empty((2 * _MOST_CORNERS, 2))
    for f in range(len(starts) - 1):
        k = starts[f]
        for i in range(first_starts[f], first_starts[f + 1]):
            for j in range(second_starts[f], second_starts[f + 1]):
                if min(first[i, 3], first[i, 4], second[j, 3], second[j, 4]) > 0.0:
                    common = _shared_ground(first, i, second, j, outline, kept)
                    both = first[i, 3] * first[i, 4] + second[j, 3] * second[j, 4]
                    overlaps[k] = min(common / (both - common), 1.0)
                k += 1
    return overlaps


@kernel(f"float64[::1]({_LOCATIONS})", nogil=True, cache=True, error_model="numpy")
def overlaps_in_space(
    first: Float64Array,
    second: Float64Array,
    first_starts: Int64Array,
    second_starts: Int64Array,
    starts: Int64Array,
) -> Float64Array:
    """Give the intersection over the union of the room that boxes take.

    Args:
        first, second, first_starts, second_starts, starts: as above.

    Returns:
        (P,) float64, 0 to 1; 0 where a size is not above 0.
    """
    overlaps = np.zeros(starts[-1])
    outline, kept = np.empty((2 * _MOST_CORNERS, 2)), np.empty((2 * _MOST_CORNERS, 2))
    for f in range(len(starts) - 1):
        k = starts[f]
        for i in range(first_starts[f], first_starts[f + 1]):
            own = first[i, 3] * first[i, 4] * first[i, 5]
            for j in range(second_starts[f], second_starts[f + 1]):
                top = min(first[i, 2] + first[i, 5] / 2.0, second[j, 2] + second[j, 5] / 2.0)
                high = top - max(first[i, 2] - first[i, 5] / 2.0, second[j, 2] - second[j, 5] / 2.0)
                if high > 0.0 and min(first[i, 3], first[i, 4], second[j, 3], second[j, 4]) > 0.0:
                    common = high * _shared_ground(first, i, second, j, outline, kept)
                    both = own + second[j, 3] * second[j, 4] * second[j, 5]
                    overlaps[k] = min(common / (both - common), 1.0)
                k += 1
    return overlaps
