"""Tracking: Kalman prediction and updates of many objects, association gains, duplicate tracks, keyframes of a track.

A state is x = (middle 3, size 3, heading, velocity 3, yaw rate).
"""

import math

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.overlaps import box_area, common_area
from sceneloom.kernels.signatures import inlined, part

SIZE, MEASURED = 11, 7
_YAW, _ROTATION = 6, 10


@inlined
def _wrapped(angle):  # type: ignore[no-untyped-def]
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


@part
def _move(mean, slope, vehicle, seconds, rotation_time):  # type: ignore[no-untyped-def]
    """Move one state on in place, and write its slopes."""
    slope[:] = 0.0
    for k in range(SIZE):
        slope[k, k] = 1.0
    x, y, rate = mean[7], mean[8], mean[_ROTATION]
    angle = rate * seconds if vehicle else 0.0
    lever = seconds if vehicle else 0.0
    cosine, sine = np.cos(angle), np.sin(angle)
    rotated_x, rotated_y = cosine * x - sine * y, sine * x + cosine * y
    half = seconds / 2.0
    mean[0] += half * (x + rotated_x)
    mean[1] += half * (y + rotated_y)
    mean[2] += seconds * mean[9]
    mean[_YAW] = _wrapped(mean[_YAW] + rate * seconds)
    mean[7], mean[8] = rotated_x, rotated_y
    decay = np.exp(-seconds / rotation_time)
    mean[_ROTATION] = rate * decay
    slope[0, 7], slope[0, 8] = half * (1.0 + cosine), -half * sine
    slope[1, 7], slope[1, 8] = half * sine, half * (1.0 + cosine)
    slope[0, _ROTATION], slope[1, _ROTATION] = -half * lever * rotated_y, half * lever * rotated_x
    slope[2, 9] = seconds
    slope[_YAW, _ROTATION] = seconds
    slope[7, 7], slope[7, 8], slope[7, _ROTATION] = cosine, -sine, -lever * rotated_y
    slope[8, 7], slope[8, 8], slope[8, _ROTATION] = sine, cosine, lever * rotated_x
    slope[_ROTATION, _ROTATION] = decay


@part
def _shake(covariance, heading, seconds, variances):  # type: ignore[no-untyped-def]
    """Add to one covariance what white noise of accelerations does in so long."""
    along, across, climb, sizes = variances[0], variances[1], variances[2], variances[3]
    yaw, turn = variances[4], variances[5]
    cosine, sine = np.cos(heading), np.sin(heading)
    xx = along * cosine * cosine + across * sine * sine
    yy = along * sine * sine + across * cosine * cosine
    xy = (along - across) * cosine * sine
    cubed, squared = seconds**3 / 3.0, seconds**2 / 2.0
    for i, j, value in ((0, 0, xx), (0, 1, xy), (1, 0, xy), (1, 1, yy), (2, 2, climb)):
        covariance[i, j] += value * cubed
        covariance[i, 7 + j] += value * squared
        covariance[7 + i, j] += value * squared
        covariance[7 + i, 7 + j] += value * seconds
    for k in range(3, 6):
        covariance[k, k] += sizes * seconds
    covariance[_YAW, _YAW] += yaw * seconds + turn * cubed
    covariance[_YAW, _ROTATION] += turn * squared
    covariance[_ROTATION, _YAW] += turn * squared
    covariance[_ROTATION, _ROTATION] += turn * seconds


@kernel(
    "Tuple((float64[:,::1], float64[:,:,::1], float64[:,:,::1]))(float64[:,::1], float64[:,:,::1], boolean[::1], "
    "float64, float64, float64[:,::1])"
)
def predict(
    means: Float64Array, covariances: Float64Array, vehicles: BoolArray, seconds: float, rotation_time: float,
    variances: Float64Array,
) -> tuple[Float64Array, Float64Array, Float64Array]:  # fmt: skip
    """Predict states `seconds` later, with the noise of that time.

    `means`, `covariances` (N, 11) and (N, 11, 11); `vehicles` (N,), whether their velocity rotates with them;
    `rotation_time` [s], after which rotation has died down; `variances` (2, 6), of people and of vehicles: densities of
    the noise of acceleration along the heading, across it and upwards, of sizes, of the heading and of rotation.
    Returns means and covariances afterwards, and the slopes (N, 11, 11) of the means.
    """
    count = len(means)
    moved, spread = means.copy(), np.zeros((count, SIZE, SIZE))
    slopes, half = np.empty((count, SIZE, SIZE)), np.empty((SIZE, SIZE))
    for n in range(count):
        noise = variances[1 if vehicles[n] else 0]
        _move(moved[n], slopes[n], vehicles[n], seconds, rotation_time)
        half[:] = 0.0
        for i in range(SIZE):
            for k in range(SIZE):
                if slopes[n, i, k] != 0.0:
                    for j in range(SIZE):
                        half[i, j] += slopes[n, i, k] * covariances[n, k, j]
        for j in range(SIZE):
            for k in range(SIZE):
                if slopes[n, j, k] != 0.0:
                    for i in range(SIZE):
                        spread[n, i, j] += half[i, k] * slopes[n, j, k]
        _shake(spread[n], means[n, _YAW], seconds, noise)
    return moved, spread, slopes


@part
def _factored(matrix, root):  # type: ignore[no-untyped-def]
    """Write Cholesky's lower triangle of a matrix; False where it is not positive."""
    size = len(matrix)
    for i in range(size):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= root[i, k] * root[j, k]
            if i > j:
                root[i, j] = total / root[j, j]
            elif total > 0.0:
                root[i, i] = np.sqrt(total)
            else:
                return False
    return True


@part
def _solve(root, vector):  # type: ignore[no-untyped-def]
    """Solve L Lᵀ x = v in place."""
    size = len(vector)
    for i in range(size):
        for k in range(i):
            vector[i] -= root[i, k] * vector[k]
        vector[i] /= root[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            vector[i] -= root[k, i] * vector[k]
        vector[i] /= root[i, i]


@part
def _weighed(covariance, noise, apart, root, spread, solved, freedom):  # type: ignore[no-untyped-def]
    """Factor the covariance of a box, wider for one that is far off; False where it is none."""
    wider = 1.0
    for attempt in range(2):
        for i in range(MEASURED):
            for j in range(MEASURED):
                spread[i, j] = covariance[i, j] + noise[i, j] * wider
        if not _factored(spread, root):
            return False
        if attempt == 0:
            # number by number: to assign a whole array takes the compiler three seconds, for its error's text
            for i in range(MEASURED):
                solved[i] = apart[i]
            _solve(root, solved)
            off = 0.0
            for i in range(MEASURED):
                off += apart[i] * solved[i]
            wider = (freedom + off) / (freedom + MEASURED)
            if wider <= 1.0:
                break
    return True


@part
def _read(mean, covariance, apart, root, crossed, gain):  # type: ignore[no-untyped-def]
    """Kalman's update of one state, in place."""
    for i in range(SIZE):
        for j in range(MEASURED):
            crossed[i, j] = gain[i, j] = covariance[i, j]
        _solve(root, gain[i])
        for j in range(MEASURED):
            mean[i] += gain[i, j] * apart[j]
    for i in range(SIZE):
        for j in range(i + 1):
            for k in range(MEASURED):
                covariance[i, j] -= gain[i, k] * crossed[j, k]
            covariance[j, i] = covariance[i, j]
    mean[_YAW] = _wrapped(mean[_YAW])


@kernel("void(float64[:,::1], float64[:,:,::1], int64[::1], float64[:,::1], float64[:,:,::1], int64[::1], float64)")
def read_boxes(
    means: Float64Array, covariances: Float64Array, rows: Int64Array, measures: Float64Array, noises: Float64Array,
    columns: Int64Array, freedom: float,
) -> None:  # fmt: skip
    """Read a box of each of some states, in place.

    Headings that are off by more than a right angle are taken the other way round; boxes that are further off than
    their covariances state are taken for less sure, as under Student's distribution.

    `means`, `covariances` (N, 11) and (N, 11, 11), are changed; `rows` (K,), which of them; `measures`, `noises` (M, 7)
    and (M, 7, 7); `columns` (K,), the box of each; `freedom`: degrees of freedom.
    """
    root, spread = np.zeros((MEASURED, MEASURED)), np.empty((MEASURED, MEASURED))
    apart, solved = np.empty(MEASURED), np.empty(MEASURED)
    crossed, gain = np.empty((SIZE, MEASURED)), np.empty((SIZE, MEASURED))
    for k in range(len(rows)):
        n, m = rows[k], columns[k]
        for i in range(MEASURED):
            apart[i] = measures[m, i] - means[n, i]
        turn = _wrapped(apart[_YAW])
        apart[_YAW] = turn - np.pi * np.round(turn / np.pi)
        if _weighed(covariances[n], noises[m], apart, root, spread, solved, freedom):
            _read(means[n], covariances[n], apart, root, crossed, gain)


@kernel("void(float64[:,::1], float64[:,:,::1], boolean[::1], float64)")
def read_no_slip(means: Float64Array, covariances: Float64Array, vehicles: BoolArray, variance: float) -> None:
    """Read of vehicles that their velocity across their heading is 0, in place.

    `means`, `covariances` (N, 11) and (N, 11, 11), are changed; `vehicles` (N,); `variance`: of that velocity [m²/s²].
    """
    spread = np.empty(SIZE)
    for n in range(len(means)):
        if not vehicles[n]:
            continue
        cosine, sine = np.cos(means[n, _YAW]), np.sin(means[n, _YAW])
        along = cosine * means[n, 7] + sine * means[n, 8]
        across = cosine * means[n, 8] - sine * means[n, 7]
        total = variance
        for i in range(SIZE):
            row = covariances[n, i]
            spread[i] = cosine * row[8] - sine * row[7] - along * row[_YAW]
        total += cosine * spread[8] - sine * spread[7] - along * spread[_YAW]
        for i in range(SIZE):
            means[n, i] -= spread[i] * across / total
            for j in range(SIZE):
                covariances[n, i, j] -= spread[i] * spread[j] / total
        means[n, _YAW] = _wrapped(means[n, _YAW])


@inlined
def _heavy(square, count, freedom):  # type: ignore[no-untyped-def]
    """Squares of deviations as heavy tails take them: near 0 as they are, far away as their logarithm."""
    return (freedom + count) * np.log1p(square / freedom)


@inlined
def _may_be_one(a, i, b, j):  # type: ignore[no-untyped-def]
    """Whether classes are equal, of one family, or one of them says nothing."""
    if a[i, 0] == b[j, 0] or a[i, 0] < 0 or b[j, 0] < 0:
        return True
    return a[i, 1] == b[j, 1] and a[i, 1] >= 0


@inlined
def _trace(matrices, i):  # type: ignore[no-untyped-def]
    return matrices[i, 0, 0] + matrices[i, 1, 1] + matrices[i, 2, 2]


@part
def _with_room(column, room):  # type: ignore[no-untyped-def]
    """The same numbers, and room for more behind them."""
    wider = np.empty(room, column.dtype)
    for k in range(len(column)):
        wider[k] = column[k]
    return wider


@kernel(
    "Tuple((int64[::1], int64[::1], float64[::1]))(float64[:,::1], float64[:,:,::1], int64[:,::1], float64[::1], "
    "float64[:,::1], float64[:,:,::1], int64[:,::1], float64[::1], float64, float64, float64)"
)
def gains_in_space(
    locations: Float64Array, spreads: Float64Array, codes: Int64Array, expected: Float64Array,
    seen_positions: Float64Array, seen_spreads: Float64Array, seen_codes: Int64Array, seen_doubts: Float64Array,
    least_variance: float, freedom: float, most: float,
) -> tuple[Int64Array, Int64Array, Float64Array]:  # fmt: skip
    """Compare where objects are expected with where boxes are.

    Args:
        locations, spreads: (N, 3) and (N, 3, 3) [m, m²], of objects.
        codes: (N, 2), class and family, -1 for none.
        expected: (N,), logarithm of how many boxes of other things lie around each [1/m²].
        seen_positions, seen_spreads, seen_codes: the same of M boxes.
        seen_doubts: (M,), what is added for each box.
        least_variance: is added along each axis [m²].
        freedom: degrees of freedom of Student's distribution.
        most: how much images can add later; pairs that will stay below 0 are left out.

    Returns:
        The pairs that may be one: (K,) int64 objects, rising, (K,) int64 boxes, and (K,) float64 logarithms of ratios
        of likelihoods on the ground.
    """
    count = len(seen_positions)
    xs, ys, zs = seen_positions[:, 0].copy(), seen_positions[:, 1].copy(), seen_positions[:, 2].copy()
    reach = np.empty(count)
    for j in range(count):
        reach[j] = _trace(seen_spreads, j) + 3.0 * least_variance
    room, found = 4 * (len(locations) + count), 0
    rows, columns, gains = np.empty(room, np.int64), np.empty(room, np.int64), np.empty(room)
    near = np.empty(count, np.int64)
    for i in range(len(locations)):
        # no pair is worth more than one whose locations are known as well as can be; farther ones are hopeless
        best = most - expected[i] - np.log(2.0 * np.pi * least_variance)
        farthest = freedom * np.expm1(max(2.0 * best, 0.0) / (freedom + 3.0))
        own, nearby = _trace(spreads, i), 0
        for j in range(count):
            x, y, z = xs[j] - locations[i, 0], ys[j] - locations[i, 1], zs[j] - locations[i, 2]
            near[nearby] = j
            nearby += x * x + y * y + z * z <= farthest * (own + reach[j])
        if found + nearby > room:
            room = 2 * (found + nearby)
            rows, columns, gains = _with_room(rows, room), _with_room(columns, room), _with_room(gains, room)
        for k in range(nearby):
            j = near[k]
            if not _may_be_one(codes, i, seen_codes, j):
                continue
            x = seen_positions[j, 0] - locations[i, 0]
            y = seen_positions[j, 1] - locations[i, 1]
            z = seen_positions[j, 2] - locations[i, 2]
            a = spreads[i, 0, 0] + seen_spreads[j, 0, 0] + least_variance
            b = spreads[i, 0, 1] + seen_spreads[j, 0, 1]
            c = spreads[i, 0, 2] + seen_spreads[j, 0, 2]
            d = spreads[i, 1, 1] + seen_spreads[j, 1, 1] + least_variance
            e = spreads[i, 1, 2] + seen_spreads[j, 1, 2]
            f = spreads[i, 2, 2] + seen_spreads[j, 2, 2] + least_variance
            area = a * d - b * b
            # the adjugate of the symmetric matrix, row by row
            r, s, t = d * f - e * e, c * e - b * f, b * e - c * d
            whole = a * r + b * s + c * t
            square = x * x * r + y * y * (a * f - c * c) + z * z * area
            square += 2.0 * (x * y * s + x * z * t + y * z * (b * c - a * e))
            far = _heavy(square / whole, 3.0, freedom)
            gain = seen_doubts[j] - expected[i] - np.log(2.0 * np.pi) - 0.5 * (np.log(area) + far)
            if gain > -most:
                rows[found], columns[found], gains[found] = i, j, gain
                found += 1
    return rows[:found].copy(), columns[:found].copy(), gains[:found].copy()


@kernel(
    "void(int64[::1], int64[::1], float64[::1], float64[:,::1], float64[:,::1], boolean[::1], float64, float64, "
    "float64, float64)"
)
def add_gains_in_image(
    rows: Int64Array, columns: Int64Array, gains: Float64Array, foreseen: Float64Array, corners: Float64Array,
    measured: BoolArray, sigma: float, usual: float, least: float, freedom: float,
) -> None:  # fmt: skip
    """Add to gains what boxes in an image state.

    Args:
        rows, columns: (K,), pairs of objects and boxes.
        gains: (K,), are changed in place; -inf for what cannot be one.
        foreseen, corners: (N, 4) and (M, 4) [px], where objects are expected and where boxes are, NaN for none.
        measured: (M,), whether there is a box in space behind the one in the image.
        sigma: deviation of the share by which boxes of one object fail to overlap.
        usual: the share of overlap that says nothing.
        least: a box in the image alone that overlaps less is not of the object.
        freedom: degrees of freedom of Student's distribution.
    """
    neutral = _heavy(((1.0 - usual) / sigma) ** 2, 1.0, freedom)
    for k in range(len(gains)):
        i, j = rows[k], columns[k]
        own, area = box_area(foreseen, i), box_area(corners, j)
        if not area > 0.0:
            continue
        share = usual
        if own > 0.0:
            common = common_area(foreseen, i, corners, j)
            share = common / (own + area - common)
            gains[k] += 0.5 * (neutral - _heavy(((1.0 - share) / sigma) ** 2, 1.0, freedom))
        if not measured[j] and (share < least or not own > 0.0):
            gains[k] = -np.inf


@inlined
def _overlap_more(a, i, b, j, least):  # type: ignore[no-untyped-def]
    """Whether two boxes of an image overlap by more than a share; those with NaN do not."""
    common = common_area(a, i, b, j)
    return common > 0.0 and common > least * (box_area(a, i) + box_area(b, j) - common)


@kernel(
    "int64[::1](int64[::1], float64[:,::1], boolean[::1], float64[:,:,::1], float64[:,::1], boolean[::1], "
    "float64[:,:,::1], float64, float64)"
)
def without_twins(
    rows: Int64Array, locations: Float64Array, measured: BoolArray, corners: Float64Array,
    known_locations: Float64Array, known_measured: BoolArray, known_corners: Float64Array, share: float, overlap: float,
) -> Int64Array:  # fmt: skip
    """Leave out boxes that are second boxes of a thing that is known, or of a box before them that was kept.

    A box that a sweep placed is one of a thing if their middles are nearer to each other on the ground than a share of
    the thing's width. Where a sweep did not place both, they are one if their boxes in some image overlap; of two
    that sweeps place apart one may stand before the other, however they overlap there.

    `rows` (K,), which boxes, the surest first; `locations` (M, 3) [m], middles on the ground and widths of the boxes;
    `measured` (M,), whether a sweep placed them; `corners` (C, M, 4) [px], in each image; NaN where there is none;
    `known_locations`, `known_measured`, `known_corners`: the same of N things that are known; `share`: of a width;
    `overlap`: intersection over union. Returns those of the rows that are kept.
    """
    kept, count = np.empty(len(rows), np.int64), 0
    for k in range(len(rows)):
        row, is_new = rows[k], True
        for n in range(len(known_locations) + count):
            known = n < len(known_locations)
            i = n if known else kept[n - len(known_locations)]
            others, boxes = (known_locations, known_corners) if known else (locations, corners)
            placed = known_measured[i] if known else measured[i]
            if measured[row]:
                x, y = locations[row, 0] - others[i, 0], locations[row, 1] - others[i, 1]
                if x * x + y * y < (share * others[i, 2]) ** 2:
                    is_new = False
            if is_new and not (measured[row] and placed):
                for c in range(len(corners)):
                    if _overlap_more(corners[c], row, boxes[c], i, overlap):
                        is_new = False
            if not is_new:
                break
        if is_new:
            kept[count] = row
            count += 1
    return kept[:count].copy()


_NEAR_HALF_ROTATION = math.radians(179.0)  # beyond this, rounding decides which way round is shorter [rad]


@inlined
def _shortest(angle):  # type: ignore[no-untyped-def]
    """The same rotation, from -π to π [rad]."""
    return angle - 2.0 * math.pi * math.floor(angle / (2.0 * math.pi) + 0.5)


@part
def _gives_between(times, boxes, location, turn, a, b):  # type: ignore[no-untyped-def]
    """Whether two keyframes give all rows between them: centre and size linearly, the heading the shorter way round."""
    if b == a + 1:
        return True
    rotated = _shortest(boxes[b, 6] - boxes[a, 6])
    if abs(rotated) > _NEAR_HALF_ROTATION:
        return False
    for k in range(a + 1, b):
        share = (times[k] - times[a]) / (times[b] - times[a])
        away = larger = 0.0
        for c in range(3):
            away += (boxes[a, c] + share * (boxes[b, c] - boxes[a, c]) - boxes[k, c]) ** 2
            larger += (boxes[a, c + 3] + share * (boxes[b, c + 3] - boxes[a, c + 3]) - boxes[k, c + 3]) ** 2
        apart = abs(_shortest(boxes[a, 6] + share * rotated - boxes[k, 6]))
        if not (away <= location * location and larger <= location * location and apart <= turn):
            return False
    return True


@kernel("int64[::1](int64[::1], float64[:,::1], float64, float64)")
def fewest_keyframes(times: Int64Array, boxes: Float64Array, location: float, turn: float) -> Int64Array:
    """Choose the fewest rows of a box over time from which interpolation gives all others within tolerances.

    The rows are joined wherever two of them report all between them, and the path of the fewest joints from the
    first to the last is taken: a search in breadth, which looks at the farthest row first.

    `times` (K,) int64, rising; `boxes` (K, 7), centre and size [m] and heading [rad]; `location`: largest distance of
    centres, and of sizes as vectors [m]; `turn`: largest difference of headings [rad]. Returns (N,) int64, rising, the
    first and the last row among them.

    Source: Imai and Iri 1988, "Polygonal approximations of a curve", which the shortest path over such joints is.
    """
    count = len(times)
    if count < 3:
        return np.arange(count)
    before, queue = np.full(count, -1), np.zeros(count, np.int64)
    head, tail = 0, 1
    while head < tail and before[count - 1] < 0:
        a = queue[head]
        head += 1
        for b in range(count - 1, a, -1):
            if before[b] < 0 and _gives_between(times, boxes, location, turn, a, b):
                before[b], queue[tail] = a, b
                tail += 1
    kept, row = np.empty(count, np.int64), count - 1
    found = 0
    while row > 0:
        kept[found] = row
        found, row = found + 1, before[row]
    kept[found] = 0
    return kept[: found + 1][::-1].copy()
