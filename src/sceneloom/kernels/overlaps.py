"""Overlaps (IoU) of boxes: in an image, from above and in space, between two lists or frame by frame.

Lists are sorted by frame; `first_starts`, `second_starts` (F + 1,) are the rows where the boxes of each frame begin.
Values of pairs are in one flat array (P,): frame after frame, and in each the first list's boxes as rows and the
second's as columns; `starts` (F + 1,) is where the pairs of each frame begin. Boxes of an image are (N, 4) [px], left,
top, right, bottom; boxes in space (N, 7), centre, length, width, height [m] and heading about z [rad], finite.
"""

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.signatures import inlined


@inlined
def common_area(a, i, b, j):  # type: ignore[no-untyped-def]
    """The common area of two boxes [px²]."""
    wide = min(a[i, 2], b[j, 2]) - max(a[i, 0], b[j, 0])
    high = min(a[i, 3], b[j, 3]) - max(a[i, 1], b[j, 1])
    return wide * high if wide > 0.0 and high > 0.0 else 0.0


@inlined
def box_area(a, i):  # type: ignore[no-untyped-def]
    """The area of a box [px²]."""
    return (a[i, 2] - a[i, 0]) * (a[i, 3] - a[i, 1])


@kernel(
    "float64[:,::1](float64[:,::1], float64[:,::1], int64[::1], int64[::1], Array(int64, 1, 'C', readonly=True), "
    "float64[::1], float64[::1], float64, float64, float64, float64)"
)
def pair_gains(
    first: Float64Array, second: Float64Array, first_classes: Int64Array, second_classes: Int64Array,
    families: Int64Array, first_shares: Float64Array, second_shares: Float64Array, least_iou: float, same_family: float,
    one_unknown: float, surer: float,
) -> Float64Array:  # fmt: skip
    """The gain (N, M) of matching boxes of two lists as the same object.

    Args:
        first, second: (N, 4) and (M, 4) [px], finite.
        first_classes, second_classes: (N,) and (M,), numbers of classes; those beyond the families have the last.
        families: (K,), of classes; -1 for none.
        first_shares, second_shares: (N,) and (M,), 0 to 1, confidence of each box.
        least_iou: boxes that overlap less, or not at all, have no gain.
        same_family, one_unknown: factors for different classes of one family, and where one has no family.
        surer: two boxes of full confidence gain this share more.

    Returns:
        (N, M) float64: (1 + GIoU) / 2 times those factors, 0 for boxes of classes that are never the same.
    """
    gains, last = np.zeros((len(first), len(second))), len(families) - 1
    for i in range(len(first)):
        family = families[min(first_classes[i], last)]
        for j in range(len(second)):
            if first[i, 2] <= second[j, 0] or second[j, 2] <= first[i, 0]:
                continue
            common = common_area(first, i, second, j)
            if common <= 0.0:
                continue
            both = box_area(first, i) + box_area(second, j) - common
            if common < least_iou * both:
                continue
            other = families[min(second_classes[j], last)]
            if first_classes[i] == second_classes[j]:
                weight = 1.0
            elif family < 0 or other < 0:
                weight = one_unknown
            elif family == other:
                weight = same_family
            else:
                continue
            hull = (max(first[i, 2], second[j, 2]) - min(first[i, 0], second[j, 0])) * (
                max(first[i, 3], second[j, 3]) - min(first[i, 1], second[j, 1])
            )
            worth = (1.0 + common / both - (hull - both) / hull) / 2.0
            gains[i, j] = worth * weight * (1.0 + surer * (first_shares[i] + second_shares[j]) / 2.0)
    return gains


_NOTHING = float(np.finfo(np.float64).eps)
"""Areas up to this are none, as in the evaluations that results are compared with."""


@kernel("int64[::1](int64[::1], int64[::1])")
def pair_starts(first_starts: Int64Array, second_starts: Int64Array) -> Int64Array:
    """Where the pairs of each frame begin, (F + 1,) int64."""
    starts = np.zeros(len(first_starts), np.int64)
    for f in range(len(first_starts) - 1):
        rows = first_starts[f + 1] - first_starts[f]
        starts[f + 1] = starts[f] + rows * (second_starts[f + 1] - second_starts[f])
    return starts


@kernel("float64[::1](float64[:,::1], float64[:,::1], int64[::1], int64[::1], int64[::1])")
def image_overlaps(
    first: Float64Array, second: Float64Array, first_starts: Int64Array, second_starts: Int64Array, starts: Int64Array
) -> Float64Array:
    """Intersection over union (P,) of boxes of an image, 0 to 1; 0 where a box has no area."""
    overlaps = np.zeros(starts[-1])
    for f in range(len(starts) - 1):
        k = starts[f]
        for i in range(first_starts[f], first_starts[f + 1]):
            for j in range(second_starts[f], second_starts[f + 1]):
                own, other, common = box_area(first, i), box_area(second, j), common_area(first, i, second, j)
                if own > _NOTHING and other > _NOTHING:
                    overlaps[k] = common / (own + other - common)
                k += 1
    return overlaps


@kernel("float64[::1](float64[:,::1], float64[:,::1], int64[::1], int64[::1], int64[::1])")
def image_shares(
    regions: Float64Array, boxes: Float64Array, region_starts: Int64Array, box_starts: Int64Array, starts: Int64Array
) -> Float64Array:
    """The share (P,) of each box of an image that is in each region, 0 to 1; 0 where a box has no area."""
    shares = np.zeros(starts[-1])
    for f in range(len(starts) - 1):
        k = starts[f]
        for i in range(region_starts[f], region_starts[f + 1]):
            for j in range(box_starts[f], box_starts[f + 1]):
                area = box_area(boxes, j)
                if area > _NOTHING:
                    shares[k] = common_area(regions, i, boxes, j) / area
                k += 1
    return shares


@kernel("float64[::1](float64[:,::1], float64[:,::1], int64[::1], int64[::1], int64[::1], float64)")
def nearnesses(
    first: Float64Array, second: Float64Array, first_starts: Int64Array, second_starts: Int64Array, starts: Int64Array,
    reach: float,
) -> Float64Array:  # fmt: skip
    """Nearness (P,) of positions (N, D) and (M, D) [m]: 1 for equal ones, falling with the distance to 0 at `reach`."""
    near = np.zeros(starts[-1])
    for f in range(len(starts) - 1):
        k = starts[f]
        for i in range(first_starts[f], first_starts[f + 1]):
            for j in range(second_starts[f], second_starts[f + 1]):
                square = 0.0
                for d in range(first.shape[1]):
                    square += (first[i, d] - second[j, d]) ** 2
                near[k] = max(0.0, 1.0 - np.sqrt(square) / reach)
                k += 1
    return near


_MOST_CORNERS = 8  # of what two rectangles share
_LOCATIONS = "float64[:,::1], float64[:,::1], int64[::1], int64[::1], int64[::1]"


@kernel("int64(float64[:,::1], int64, float64[:,::1], int64, float64, float64)")
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


@kernel("float64(float64[:,::1], int64, float64[:,::1], int64, float64[:,::1], float64[:,::1])")
def _shared_ground(
    first: Float64Array, i: int, second: Float64Array, j: int, outline: Float64Array, kept: Float64Array
) -> float:
    """The area that two boxes share as seen from above [m²].

    `outline`, `kept` (16, 2), scratch.

    Source: Sutherland and Hodgman 1974 for the cuts, the shoelace formula for the area.
    """
    east, north = second[j, 0] - first[i, 0], second[j, 1] - first[i, 1]
    reach = np.sqrt(first[i, 3] ** 2 + first[i, 4] ** 2) + np.sqrt(second[j, 3] ** 2 + second[j, 4] ** 2)
    if 4.0 * (east * east + north * north) > reach * reach:
        return 0.0
    cosine, sine = np.cos(first[i, 6]), np.sin(first[i, 6])
    along, across = cosine * east + sine * north, cosine * north - sine * east
    yaw_between = second[j, 6] - first[i, 6]
    rotated_x, rotated_y = np.cos(yaw_between) / 2.0, np.sin(yaw_between) / 2.0
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


@kernel(f"float64[::1]({_LOCATIONS})")
def overlaps_from_above(
    first: Float64Array, second: Float64Array, first_starts: Int64Array, second_starts: Int64Array, starts: Int64Array
) -> Float64Array:
    """Intersection over union (P,) of boxes seen from above, 0 to 1; 0 where a length or width is not above 0."""
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


@kernel(f"float64[::1]({_LOCATIONS})")
def overlaps_in_space(
    first: Float64Array, second: Float64Array, first_starts: Int64Array, second_starts: Int64Array, starts: Int64Array
) -> Float64Array:
    """Intersection over union (P,) of boxes in space, 0 to 1; 0 where a size is not above 0."""
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
