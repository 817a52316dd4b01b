"""The visibility rule of `sceneloom.colouring.visibility`, as one would write it in NumPy."""

import numpy as np

from sceneloom.colouring import VisibilitySettings

SECTORS = 8


def map_directions(points: np.ndarray, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions in the equal-area map and inverse ranges, float32."""
    x, y, z = (points @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32).T
    ranges = np.sqrt(x * x + y * y + z * z)
    scale = np.sqrt(2 / (ranges * (ranges + z)))
    return np.stack([x * scale, y * scale], axis=1), 1 / ranges


def location(directions: np.ndarray, cell: float, border: int) -> tuple[np.ndarray, int, int]:
    """Number of each point's cell, columns and rows of the grid."""
    per_cell = np.float32(1 / cell)
    steps = (directions * per_cell + np.float32(2.1) * per_cell).astype(np.int64)
    column, row = (steps - steps.min(axis=0)).T + border
    columns, rows = int(column.max()) + 1 + border, int(row.max()) + 1 + border
    return row * columns + column, columns, rows


def measure_spacing(directions: np.ndarray, cell: float, reach: int, samples: int) -> np.ndarray:
    """Typical steps to the next point along the axes at 0, 45, 90 and 135 degrees."""
    cells, columns, rows = location(directions, cell, reach)
    occupied = np.zeros(columns * rows, bool)
    occupied[cells] = True
    dy, dx = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1)
    distances = np.hypot(dx, dy)
    kept = np.flatnonzero((distances > 0) & (distances <= reach))
    kept = kept[np.argsort(distances[kept], kind="stable")]
    dx, dy, distances = dx[kept], dy[kept], distances[kept]
    sectors = np.floor(SECTORS * np.arctan2(dy, dx) / (2 * np.pi) + 0.5).astype(int) % SECTORS
    around = cells[np.arange(samples) * len(cells) // samples]
    found = np.full((SECTORS, samples), np.nan)
    for sector in range(SECTORS):
        steps, lengths = (dy * columns + dx)[sectors == sector], distances[sectors == sector]
        hits = occupied[around[:, None] + steps]
        found[sector] = np.where(hits.any(axis=1), lengths[hits.argmax(axis=1)], np.nan)
    spacings = np.full(SECTORS // 2, np.nan)
    for axis, values in enumerate(np.concatenate([found[: SECTORS // 2], found[SECTORS // 2 :]], axis=1)):
        known = np.sort(values[~np.isnan(values)])
        if len(known) >= samples:
            spacings[axis] = cell * known[len(known) // 4 : len(known) - len(known) // 4].mean()
    return spacings


def reach_for(spacings: np.ndarray) -> tuple[float, float, float, float]:
    """Window, reach across and along the scan lines, angle of the axis across them; [rad]."""
    pair = int(np.nanargmax(np.abs(np.log(spacings[:2] / spacings[2:]))))
    axis = pair if spacings[pair] > spacings[pair + 2] else pair + 2
    across, along = spacings[axis], spacings[(axis + 2) % 4]
    window = np.clip(1.15 * across, *np.radians([0.3, 3.0]))
    near = np.clip(
        np.array([0.95 * across, 1.3 * along]) - np.radians(0.08),
        [np.radians(0.1), max(np.radians(0.1), window / 6)],
        np.radians(2.4),
    )
    return float(window), float(near[0]), float(near[1]), axis * np.pi / 4


def window_cells(reach: tuple[float, float], radius: float, cell: float) -> list[tuple[int, int, float]]:
    """Steps (dx, dy) to the cells within reach, and their least distance."""
    border = int(np.ceil(max(reach) / cell))
    cells = []
    for dy in range(-border, border + 1):
        for dx in range(-border, border + 1):
            gap = 0.999 * cell * np.maximum(np.abs([dx, dy]) - 1, 0)
            if (gap <= reach).all() and np.hypot(*gap) <= radius:
                cells.append((dx, dy, float(np.hypot(*gap))))
    return cells


def bound(nearest: np.ndarray, border: int, cells: list[tuple[int, int, float]], slope: float) -> np.ndarray:
    """Largest inverse range around each cell, less the slope on the way."""
    rows, columns = nearest.shape
    inner = np.zeros((rows - 2 * border, columns - 2 * border), np.float32)
    for dx, dy, gap in cells:
        shifted = nearest[border + dy : rows - border + dy, border + dx : columns - border + dx]
        np.maximum(inner, shifted - np.float32(slope * gap), out=inner)
    return np.pad(inner, border).ravel()


def find_visible_in_numpy(points: np.ndarray, matrix: np.ndarray, settings: VisibilitySettings) -> np.ndarray:
    """Report which of the points are not hidden by others; settings with a measured window only."""
    directions, inverse = map_directions(points, matrix)
    window, across, along, angle = reach_for(measure_spacing(directions, np.radians(0.1), 25, 256))
    rotation, slope = np.array([np.cos(angle), np.sin(angle)]), 1 / (settings.surface_distance or 0.5)
    form = np.outer(rotation, rotation) / across**2 + (np.eye(2) - np.outer(rotation, rotation)) / along**2
    near = np.sqrt(np.diag(np.linalg.inv(form)))
    cell = max(window / 6, np.radians(0.16))
    border = int(np.ceil(max(window, *near) / cell))
    cells, columns, rows = location(directions, cell, border)
    order = np.lexsort((-inverse, cells))
    first = order[np.flatnonzero(np.diff(cells[order], prepend=-1))]
    nearest, locations = np.zeros(rows * columns, np.float32), np.zeros((rows * columns, 2), np.float32)
    nearest[cells[first]], locations[cells[first]] = inverse[first], directions[first]
    image = nearest.reshape(rows, columns)
    around = window_cells((window, window), window, cell)
    beside = window_cells((float(near[0]), float(near[1])), np.inf, cell)
    quadrants = [
        bound(image, border, [c for c in around if a * c[0] >= 0 and b * c[1] >= 0], slope)
        for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1))
    ]
    opposite = np.maximum(np.minimum(quadrants[0], quadrants[2]), np.minimum(quadrants[1], quadrants[3]))
    margin, share = np.float32(settings.margin), np.float32(settings.margin_share)
    threshold = inverse + margin * inverse * inverse + share * inverse

    def hiding(candidates: np.ndarray, steps: list[tuple[int, int, float]]) -> tuple[np.ndarray, ...]:
        there = cells[candidates][:, None] + np.array([dy * columns + dx for dx, dy, _ in steps])
        x, y = np.moveaxis(locations[there] - directions[candidates][:, None], 2, 0)
        excess = nearest[there] - threshold[candidates][:, None]
        squared, own = x * x + y * y, (directions[candidates] ** 2).sum(axis=1)
        steepest = np.float32(slope * slope) / np.maximum(1 - np.float32(0.25) * own, np.float32(1e-3))
        return (excess > 0) & (excess * excess > steepest[:, None] * squared), x, y, squared

    hidden = np.zeros(len(points), bool)
    candidates = np.flatnonzero(bound(image, border, beside, slope)[cells] > threshold)
    hides, x, y, _ = hiding(candidates, beside)
    p, q, r = np.float32([form[0, 0], 2 * form[0, 1], form[1, 1]])
    hidden[candidates] = (hides & (p * x * x + q * x * y + r * y * y <= 1)).any(axis=1)
    candidates = np.flatnonzero(~hidden & (opposite[cells] > threshold))
    hides, x, y, squared = hiding(candidates, around)
    hides &= squared <= np.float32(window * window)
    first_, second = (hides & (x > 0) & (y >= 0)).any(axis=1), (hides & (x <= 0) & (y > 0)).any(axis=1)
    third, fourth = (hides & (x < 0) & (y <= 0)).any(axis=1), (hides & (x >= 0) & (y < 0)).any(axis=1)
    hidden[candidates] = (first_ & third) | (second & fourth)
    return ~hidden
