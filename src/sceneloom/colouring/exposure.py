"""Exposure differences between cameras from surfaces that two images show, and the gains that compensate them.

Two images that show the same plain part of a surface give it two colours; their ratio is that of the exposures,
whatever the surface's own colour is. Images are linked in this way within a sweep (two cameras at once) and across
sweeps (the same position some sweeps later, by the same camera or by another, which links cameras whose images never
overlap). The median ratio of a link leaves out what moves, shines or is matched wrongly. All links together give each
image three factors, one for each channel, by robust least squares with a weak pull towards the image before. Levels
near black and white are not used, since they are clipped.

Only ratios can be seen. The rest is fixed for each group of linked cameras: the mean logarithm of its factors, weighted
by the points of its images, is 0, so that the overall brightness stays. A camera that nothing links to another keeps
its mean brightness and is reported as alone.
"""

import itertools
import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numba import boolean, float32, float64, int64, void

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, Int64Array, UInt8Array
from sceneloom.colouring.blending import sample_view
from sceneloom.colouring.results import FusedView
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.signatures import IN_BOOL_1D, IN_F32_1D, IN_F32_2D, IN_U8_3D

_CUBE = 0.15  # side of the cubes by which positions are found again in other sweeps [m]
_DARKEST, _LIGHTEST = 16.0, 240.0  # levels beyond these are clipped, or nearly, in this image or its neighbours
_PLAIN = 14.0  # where a channel changes by more levels around a point, its exact pixel matters too much
_MOST_SAMPLES = 8000
_FARTHEST = 60.0
_BORDER_PX = 3.0
_HALF_KEY = 1 << 20
_LAGS = (1, 4, 12)  # sweeps before one that are compared with it
_FEWEST = 30  # pairs of colours that a link needs
_MOST_PAIRS = 400  # more pairs do not make a link more certain: they share their errors
_NOISE = 0.01  # least standard deviation of a link's median ratio: brightness that depends on the viewing direction
_DRIFT = 0.5  # how far exposures drift, as a factor's logarithm, in a second; the pull towards the image before
_UNCHANGED = 3.0  # the weak pull towards no change, as a factor's logarithm, for what no link determines
_ROUNDS, _ROBUST = 6, 3.0
_MOST_SEAM_PAIRS = 500  # pairs of colours kept of each pair of cameras in each sweep, to judge the result by
_Node = tuple[int, int]  # an image: index of the camera, and time [ns]
_OUTLINE_CELL_DEG = 0.25  # points beside an outline: their gap in the image is a few scan lines at most

_SURFACE_DISTANCE = 1.2
"""Nearly all surfaces pass the camera at this distance or more [m]: roads at the height of the camera."""

_REACH_CELLS = 2.0
_OUTLINE_STEP = 0.3  # least step in depth [m]


def _near_outlines(view: FusedView) -> BoolArray:
    """Which points of an image are beside an outline of something nearer or farther, (M,) bool."""
    found = np.empty(len(view.point_ids), np.bool_)
    focal_px = max(min(view.camera.fx, view.camera.fy), 1.0)
    cell_px = max(math.radians(_OUTLINE_CELL_DEG) * focal_px, 2.0)
    slope = _REACH_CELLS * cell_px / focal_px / _SURFACE_DISTANCE
    mark_outlines(
        view.pixels, view.depths, view.visible, view.camera.width, view.camera.height, cell_px, slope, _OUTLINE_STEP,
        found,
    )  # fmt: skip
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _SurfaceSamples:
    """Points of surfaces in one image."""

    ids: Int64Array  # (K,), rows of the cloud, ascending
    cubes: Int64Array  # (K,), numbers of the cubes of space that they are in, the same in every sweep
    colors: Float32Array  # (K, 3), 0 to 255

    @classmethod
    def of(cls, points_world: Float64Array, view: FusedView) -> "_SurfaceSamples":
        """Take the points (N, 3) [m] that show an image's exposure: visible, of plain and mid-level colour, no edge."""
        u, v = view.pixels.T
        inside = (u >= _BORDER_PX) & (u <= view.camera.width - 1 - _BORDER_PX)
        inside &= (v >= _BORDER_PX) & (v <= view.camera.height - 1 - _BORDER_PX)
        rows = np.flatnonzero(view.visible & inside & (view.depths < _FARTHEST) & ~_near_outlines(view))
        pixels = np.ascontiguousarray(view.pixels[rows])
        rgb, contrasts = np.ascontiguousarray(view.rgb), np.empty(len(rows), np.float32)
        measure_contrasts(pixels, rgb, contrasts)
        plain = contrasts <= _PLAIN
        rows, pixels = rows[plain], pixels[plain]
        colors = sample_view(view, pixels)
        unclipped = ((colors >= _DARKEST) & (colors <= _LIGHTEST)).all(axis=1)
        rows, colors = rows[unclipped], colors[unclipped]
        ids = view.point_ids[rows]
        # the same points are left out of every image, so that pairs stay whole
        kept = ids % max(1, -(-len(rows) // _MOST_SAMPLES)) == 0
        ids = ids[kept]
        cubes = np.floor(points_world[ids] / _CUBE).astype(np.int64) & (2 * _HALF_KEY - 1)
        return cls(ids, (cubes[:, 0] << 42) | (cubes[:, 1] << 21) | cubes[:, 2], colors[kept])


@dataclass(frozen=True, slots=True, eq=False)
class ExposureLink:
    """A surface that two images show.

    Attributes:
        nodes: the two images.
        log_ratio: (3,) float64, median logarithm of the second one's colours over the first one's.
        spread: standard deviation of single ratios.
        pairs: number of ratios.
    """

    nodes: tuple[_Node, _Node]
    log_ratio: Float64Array
    spread: float
    pairs: int


@dataclass(frozen=True, slots=True, eq=False)
class ExposureGains:
    """Factors that compensate the exposures.

    Attributes:
        timestamps_ns: of each camera's linked images, by index: (K,) int64, ascending.
        log_gains: by the camera's index: (K, 3) float64, logarithm of the factors.
        alone: cameras that nothing links to another, by index.
        seam_before, seam_after: median difference of the colours [levels] of points that two cameras show at once,
            over all channels; NaN where there are none.
        seam_pairs: how many points these are of.
    """

    timestamps_ns: Mapping[int, Int64Array]
    log_gains: Mapping[int, Float64Array]
    alone: tuple[int, ...] = ()
    seam_before: float = float("nan")
    seam_after: float = float("nan")
    seam_pairs: int = 0

    def at(self, camera_index: int, timestamp_ns: int) -> Float64Array | None:
        """The (3,) factors for an image, interpolated between its neighbours; None for a camera without links."""
        times = self.timestamps_ns.get(camera_index)
        if times is None or len(times) == 0:
            return None
        logs = self.log_gains[camera_index]
        seconds = (times - times[0]) * 1e-9
        now = (timestamp_ns - int(times[0])) * 1e-9
        return np.asarray(np.exp([np.interp(now, seconds, logs[:, c]) for c in range(3)]), np.float64)

    def for_views(self, views: Sequence[FusedView], camera_indices: Sequence[int]) -> dict[int, Float64Array]:
        """The factors of the images of one sweep, by the camera's index."""
        found = {index: self.at(index, view.timestamp_ns) for view, index in zip(views, camera_indices, strict=True)}
        return {index: gain for index, gain in found.items() if gain is not None}


@dataclass(slots=True)
class ExposureLinks:
    """Links images, sweep after sweep; memory depends on a few sweeps and the number of links."""

    links: list[ExposureLink] = field(default_factory=list)
    _recent: deque[dict[_Node, _SurfaceSamples]] = field(default_factory=lambda: deque(maxlen=_LAGS[-1]))
    _seams: list[tuple[_Node, _Node, Float32Array, Float32Array]] = field(default_factory=list)
    _points: dict[_Node, int] = field(default_factory=dict)

    def add(self, points_world: Float64Array, views: Sequence[FusedView], camera_indices: Sequence[int]) -> None:
        """Take a sweep: its (N, 3) float64 points [m], and the images that show it."""
        now = {
            (index, view.timestamp_ns): _SurfaceSamples.of(points_world, view)
            for view, index in zip(views, camera_indices, strict=True)
        }
        for node, samples in now.items():
            self._points[node] = self._points.get(node, 0) + len(samples.ids)
        for (first, a), (second, b) in itertools.combinations(now.items(), 2):
            self._link(first, second, a, b, at_once=True)
        for lag in _LAGS:
            if lag <= len(self._recent):
                for (first, a), (second, b) in itertools.product(self._recent[-lag].items(), now.items()):
                    if first != second:
                        self._link(first, second, a, b, at_once=False)
        self._recent.append(now)

    def _link(self, first: _Node, second: _Node, a: _SurfaceSamples, b: _SurfaceSamples, *, at_once: bool) -> None:
        key_a, key_b = (a.ids, b.ids) if at_once else (a.cubes, b.cubes)
        _, rows_a, rows_b = np.intersect1d(key_a, key_b, return_indices=True)
        if len(rows_a) < _FEWEST:
            return
        colors_a, colors_b = a.colors[rows_a], b.colors[rows_b]
        ratios = np.log(colors_b / colors_a)
        median = np.median(ratios, axis=0).astype(np.float64)
        spread = 1.4826 * float(np.median(np.abs(ratios - median)))
        self.links.append(ExposureLink((first, second), median, spread, len(rows_a)))
        if at_once and first[0] != second[0]:
            every = -(-len(rows_a) // _MOST_SEAM_PAIRS)
            self._seams.append((first, second, colors_a[::every], colors_b[::every]))

    def solve(self) -> ExposureGains:
        """Find the factors by which all links agree best; without links there are none."""
        cameras = {camera for camera, _ in self._points}
        nodes = sorted({node for link in self.links for node in link.nodes})
        if not nodes:
            return ExposureGains({}, {}, alone=tuple(sorted(cameras)))
        logs = _solved(nodes, self.links)
        groups, alone = _groups(nodes, self.links)
        weights = np.array([self._points.get(node, 1) for node in nodes], np.float64)
        for group in groups:
            rows = [k for k, (camera, _) in enumerate(nodes) if camera in group]
            logs[rows] -= np.average(logs[rows], axis=0, weights=np.maximum(weights[rows], 1.0))
        by_camera = {
            camera: [k for k, node in enumerate(nodes) if node[0] == camera] for camera in {c for c, _ in nodes}
        }
        gains = ExposureGains(
            {camera: np.array([nodes[k][1] for k in rows], np.int64) for camera, rows in by_camera.items()},
            {camera: logs[rows] for camera, rows in by_camera.items()},
            tuple(sorted({*alone, *(cameras - set(by_camera))})),
        )
        # how much two cameras differ at the same points before and after
        before, after = [np.zeros(0)], [np.zeros(0)]
        for first, second, a, b in self._seams:
            one, other = (1.0 if gain is None else gain for gain in (gains.at(*first), gains.at(*second)))
            before.append(np.abs(a - b).ravel())
            after.append(np.abs(a * one - b * other).ravel())
        count = sum(map(len, before))
        if not count:
            return gains
        medians = [float(np.median(np.concatenate(parts))) for parts in (before, after)]
        return replace(gains, seam_before=medians[0], seam_after=medians[1], seam_pairs=count // 3)


def _solved(nodes: Sequence[_Node], links: Sequence[ExposureLink]) -> Float64Array:
    """Logarithms of the factors, (P, 3), by iteratively reweighted least squares."""
    row_of = {node: k for k, node in enumerate(nodes)}
    first = np.array([row_of[link.nodes[0]] for link in links])
    second = np.array([row_of[link.nodes[1]] for link in links])
    wanted = np.stack([link.log_ratio for link in links])
    variances = np.array([_NOISE**2 + link.spread**2 / min(link.pairs, _MOST_PAIRS) for link in links])
    pulls = _pulls(nodes)
    factors = np.ones(len(links))
    logs = np.zeros((len(nodes), 3))
    for _ in range(_ROUNDS):
        normal, right = pulls.copy(), np.zeros((len(nodes), 3))
        weights = factors / variances
        # first's factor over second's is second's colour over first's
        np.add.at(normal, (first, first), weights)
        np.add.at(normal, (second, second), weights)
        np.add.at(normal, (first, second), -weights)
        np.add.at(normal, (second, first), -weights)
        np.add.at(right, first, weights[:, None] * wanted)
        np.add.at(right, second, -weights[:, None] * wanted)
        logs[:] = np.linalg.solve(normal, right)
        misses = np.abs(logs[first] - logs[second] - wanted).max(axis=1) / np.sqrt(variances)
        factors = np.minimum(1.0, _ROBUST / np.maximum(misses, 1e-12))
    return logs


def _pulls(nodes: Sequence[_Node]) -> Float64Array:
    """Normal equations of the pulls towards no change and towards the image before."""
    normal: Float64Array = np.eye(len(nodes)) / _UNCHANGED**2
    for k, ((camera, time_ns), (following, later_ns)) in enumerate(itertools.pairwise(nodes)):
        if camera == following:
            weight = 1.0 / (_DRIFT**2 * max((later_ns - time_ns) * 1e-9, 1e-3))
            normal[k, k] += weight
            normal[k + 1, k + 1] += weight
            normal[k, k + 1] -= weight
            normal[k + 1, k] -= weight
    return normal


def _groups(nodes: Sequence[_Node], links: Sequence[ExposureLink]) -> tuple[list[set[int]], list[int]]:
    """Groups of cameras that links join, and cameras that no link joins to another."""
    groups = [{camera} for camera in sorted({camera for camera, _ in nodes})]
    for link in links:
        a, b = link.nodes[0][0], link.nodes[1][0]
        joined = [group for group in groups if a in group or b in group]
        if len(joined) > 1:
            groups = [group for group in groups if group not in joined] + [joined[0] | joined[1]]
    several = len(groups) > 1 or any(len(group) > 1 for group in groups)
    return groups, [next(iter(group)) for group in groups if len(group) == 1 and several]


_CONTRAST_STEP_PX = 2.0  # distance from a point's pixel at which the contrast is measured [px]


@kernel(void(IN_F32_2D, IN_U8_3D, float32[::1]))
def measure_contrasts(pixels: Float32Array, rgb: UInt8Array, contrasts: Float32Array) -> None:
    """Measure the contrast of an image around positions: the greatest difference of a channel among five pixels.

    `pixels` (M, 2) [px], finite; `rgb` (H, W, 3); `contrasts` (M,), written, 0 to 255.
    """
    height, width = rgb.shape[0], rgb.shape[1]
    for i in range(pixels.shape[0]):
        greatest = 0
        for c in range(3):
            low, high = 255, 0
            for k in range(5):
                du = _CONTRAST_STEP_PX * ((k == 1) - (k == 2))
                dv = _CONTRAST_STEP_PX * ((k == 3) - (k == 4))
                column = min(max(math.floor(pixels[i, 0] + du + 0.5), 0), width - 1)
                row = min(max(math.floor(pixels[i, 1] + dv + 0.5), 0), height - 1)
                value = int(rgb[row, column, c])
                low, high = min(low, value), max(high, value)
            greatest = max(greatest, high - low)
        contrasts[i] = greatest


_LEAST_DEPTH = np.float32(0.05)
"""Points beside or behind the camera, which wide camera models show, too, have no inverse depth to compare [m]."""


@kernel(void(IN_F32_2D, IN_F32_1D, IN_BOOL_1D, int64, int64, float64, float64, float64, boolean[::1]))
def mark_outlines(
    pixels: Float32Array, depths: Float32Array, visible: BoolArray, width: int, height: int, cell_px: float,
    slope: float, margin: float, near_outline: BoolArray,
) -> None:  # fmt: skip
    """Mark points that have a nearer surface, or behind them a farther visible one, beside them in the image.

    On one surface, the inverse depth changes by at most `slope` over the reach of three cells; `margin` [m] is what
    counts as a step besides.

    `pixels` (M, 2) [px]; `depths` (M,) [m]; points that are not in front of the camera model are never marked;
    `visible` (M,); `width`, `height`: of the image [px]; `cell_px`: side of the cells; neighbours are looked for in
    three by three of them; `slope` [1/m]; `margin` [m]; `near_outline` (M,), written.
    """
    columns, rows = int(width / cell_px) + 3, int(height / cell_px) + 3
    nearest = np.zeros((rows, columns), np.float32)
    farthest = np.full((rows, columns), np.float32(np.inf))
    locations = np.empty((pixels.shape[0], 2), np.int32)
    for i in range(pixels.shape[0]):
        column = min(max(int((pixels[i, 0] + 0.5) / cell_px), 0), columns - 3) + 1
        row = min(max(int((pixels[i, 1] + 0.5) / cell_px), 0), rows - 3) + 1
        locations[i, 0], locations[i, 1] = column, row
        if not depths[i] > _LEAST_DEPTH:
            continue
        inverse = float32(1.0) / depths[i]
        nearest[row, column] = max(nearest[row, column], inverse)
        if visible[i]:
            farthest[row, column] = min(farthest[row, column], inverse)
    for i in range(pixels.shape[0]):
        near_outline[i] = False
        if not depths[i] > _LEAST_DEPTH:
            continue
        inverse = float32(1.0) / depths[i]
        step = slope + margin * inverse * inverse
        high, low = inverse, inverse
        for row in range(locations[i, 1] - 1, locations[i, 1] + 2):
            for column in range(locations[i, 0] - 1, locations[i, 0] + 2):
                high = max(high, nearest[row, column])
                low = min(low, farthest[row, column])
        near_outline[i] = (high - inverse > step) | (inverse - low > step)
