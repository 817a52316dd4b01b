"""What the lines of a lidar report what hides what, and where they end: a bound for `benchmarks.truth`.

A line of sight from the camera to a point passes, at the range of a nearer thing, between two neighbouring lines of the
lidar. Where both met a surface there, the point is hidden; where neither did, it is seen. Where one did and the other
looked past, the surface ends somewhere between: at an edge. Nothing in the cloud reports where; as good a guess as any
    is
how far it is from the line that met the surface to the other one.
"""

import numpy as np
from scipy.spatial import cKDTree

from sceneloom.colouring import FusedView
from sceneloom.simulate import SimulatedDrive

REACH = 1.3
"""How far away in the image things are looked for that may hide, in spacings of the lines."""
SURFACE_DISTANCE = 1.3
"""Four fifths of the camera's height [m]: surfaces that pass it farther away do not hide themselves."""
REPORTED_SEEN, REPORTED_HIDDEN = 2.0, -1.0
"""Instead of a share, for points that lie at no edge."""


def shares_of_gaps(drive: SimulatedDrive, view: FusedView, points_world: np.ndarray) -> np.ndarray:
    """Where lines of sight pass through the gaps between scan lines at edges, for the points of a view.

    Args:
        points_world: (M, 3) [m], where the points of the view truly are.

    Returns:
        (M,) 0 at the line that met the nearer surface, 1 at the line that looked past it; `REPORTED_HIDDEN` and
        `REPORTED_SEEN` for points at no edge.
    """
    eye = drive.truth.world_from_camera(view.camera_id, 0).translation
    apart = points_world - eye
    ranges = np.linalg.norm(apart, axis=1)
    rays = apart / ranges[:, None]
    lines = _Lines(drive)
    point, nearer = _pairs(rays, ranges, REACH * np.radians(lines.spacing_deg))
    locations = eye + rays[point] * ranges[nearer][:, None]
    ids = view.point_ids[point]
    azimuths, elevations, far = lines.seen(locations, ids)
    upper = np.searchsorted(lines.elevations, elevations)
    within = (upper > 0) & (upper < len(lines.elevations))
    point, upper, azimuths, elevations, far, ids = (
        each[within] for each in (point, upper, azimuths, elevations, far, ids)
    )
    below, above = (lines.met(ring, azimuths, far, lines.ranges_of_points[ids]) for ring in (upper - 1, upper))
    low, high = lines.elevations[upper - 1], lines.elevations[upper]
    share = (elevations - low) / (high - low)
    found = np.where(below, share, np.where(above, 1.0 - share, REPORTED_SEEN))
    found[below & above] = REPORTED_HIDDEN
    shares = np.full(len(points_world), REPORTED_SEEN)
    np.minimum.at(shares, point, found)
    return shares


def _pairs(rays: np.ndarray, ranges: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Points, and others beside them that are nearer than one surface would be."""
    tree = cKDTree(rays)
    pairs = tree.query_pairs(reach, output_type="ndarray")
    swap = ranges[pairs[:, 0]] < ranges[pairs[:, 1]]
    point, nearer = np.where(swap, pairs[:, 1], pairs[:, 0]), np.where(swap, pairs[:, 0], pairs[:, 1])
    angles = 2.0 * np.arcsin(np.linalg.norm(rays[point] - rays[nearer], axis=1) / 2.0)
    gain = 1.0 / ranges[nearer] - 1.0 / ranges[point]
    hides = gain > angles / SURFACE_DISTANCE + 0.15 / ranges[point] ** 2 + 0.01 / ranges[point]
    return point[hides], nearer[hides]


class _Lines:
    """The lines of the first sweep of a drive: which way each return lies, and how far."""

    def __init__(self, drive: SimulatedDrive) -> None:
        sweep, spec = drive.truth.sweep(0), drive.truth.lidar.spec
        points = sweep.frame.points
        positions = points.positions.astype(np.float64)
        self._origins = sweep.origins_world
        self._rotations = drive.truth.path.at(points.timestamps_ns).rotations @ spec.mount.rotation
        self.ranges_of_points = np.linalg.norm(positions, axis=1)
        azimuths = np.degrees(np.arctan2(positions[:, 1], positions[:, 0]))
        elevations = np.degrees(np.arcsin(positions[:, 2] / self.ranges_of_points))
        medians = {ring: np.median(elevations[points.rings == ring]) for ring in np.unique(points.rings)}
        order = sorted(medians, key=medians.__getitem__)
        self.elevations = np.array([medians[ring] for ring in order])
        self.spacing_deg = float(np.median(np.diff(self.elevations)))
        self._beside_deg = 1.5 * 360.0 / spec.steps
        rows = np.zeros(max(order) + 1, np.int64)
        rows[order] = np.arange(len(order))
        keys = 1000.0 * rows[points.rings] + azimuths
        sorting = np.argsort(keys)
        self._keys, self._ranges = keys[sorting], self.ranges_of_points[sorting]

    def seen(self, locations: np.ndarray, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Azimuth, elevation [deg] and range [m] of locations, from where the lidar measured the points `ids`."""
        local = np.einsum("nji,nj->ni", self._rotations[ids], locations - self._origins[ids])
        ranges = np.linalg.norm(local, axis=1)
        return (np.degrees(np.arctan2(local[:, 1], local[:, 0])), np.degrees(np.arcsin(local[:, 2] / ranges)), ranges)

    def met(self, rings: np.ndarray, azimuths: np.ndarray, near: np.ndarray, far: np.ndarray) -> np.ndarray:
        """Whether lines met something at a range, and nearer than halfway to what lies behind."""
        wanted = 1000.0 * rings + azimuths
        after = np.searchsorted(self._keys, wanted)
        found = np.zeros(len(wanted), bool)
        for row in (np.clip(after - 1, 0, None), np.clip(after, None, len(self._keys) - 1)):
            beyond = self._ranges[row] - near
            found |= (
                (np.abs(self._keys[row] - wanted) < self._beside_deg)
                & (np.abs(beyond) < 0.3 + 0.03 * near)
                & (beyond < 0.5 * (far - near))
            )
        return found
