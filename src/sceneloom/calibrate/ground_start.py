"""A first guess of how two lidars lie to each other, from the ground that both see and a search over headings."""

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import quaternion_from_rotation_vector
from sceneloom.motion.cloud_registration import PreparedCloud, fit_cloud

_DRAWS = 400
_NEAR_PLANE = 0.12
_STEEPEST = np.cos(np.radians(50.0))
_REACH = 25.0
_HEADINGS = 24
_COARSE = 1.0
_REACHES = (4.0, 1.5)
_SEED = 5


def ground_plane(points: Float64Array) -> tuple[Float64Array, float] | None:
    """Find the ground in a lidar's cloud, (N, 3) [m]: the plane below the sensor with the most points near it.

    Returns:
        (3,) unit normal that points up to the sensor, and the sensor's height above the plane [m]; None without one.

    Source: Fischler and Bolles 1981, "Random Sample Consensus".
    """
    near = points[np.linalg.norm(points, axis=1) < _REACH]
    if len(near) < 100:
        return None
    rng = np.random.default_rng(_SEED)
    thinned = near[rng.choice(len(near), min(len(near), 4000), replace=False)]
    drawn = thinned[rng.integers(0, len(thinned), (_DRAWS, 3))]
    normals = np.cross(drawn[:, 1] - drawn[:, 0], drawn[:, 2] - drawn[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals = normals[lengths > 1e-6] / lengths[lengths > 1e-6, None]
    heights = -(normals * drawn[lengths > 1e-6, 0]).sum(axis=1)
    normals, heights = normals * np.sign(heights)[:, None], np.abs(heights)
    below = (heights > 0.3) & (heights < 6.0)
    counts = (np.abs(thinned @ normals.T + heights) < _NEAR_PLANE).sum(axis=0) * below
    # walls hold many points, too, but the ground lies below whatever trajectory is up for the sensor
    counts = np.where(np.abs(normals[:, 2]) > _STEEPEST, counts, 0)
    best = int(np.argmax(counts))
    if counts[best] < 0.05 * len(thinned):
        return None
    inliers = thinned[np.abs(thinned @ normals[best] + heights[best]) < _NEAR_PLANE]
    middle = inliers.mean(axis=0)
    normal = np.linalg.svd(inliers - middle, full_matrices=False)[2][2]
    normal = normal * np.sign(-normal @ middle)
    return normal, float(-normal @ middle)


def ground_start(first: Float64Array, second: Float64Array) -> RigidTransform | None:
    """Guess `first_from_second` of two clouds, (N, 3) and (M, 3) [m], seen at one time from one vehicle."""
    grounds = ground_plane(first), ground_plane(second)
    if grounds[0] is None or grounds[1] is None:
        return None
    level = [_levelled(normal, height) for normal, height in (grounds[0], grounds[1])]
    target, source = (
        PreparedCloud(one.apply(points), spacing=_COARSE)
        for one, points in zip(level, (first, second), strict=True)
    )
    best, stationary = None, -np.inf
    for heading in np.arange(_HEADINGS) * (2.0 * np.pi / _HEADINGS):
        rotated = RigidTransform.from_quaternion(
            np.zeros(3), quaternion_from_rotation_vector(np.array([0.0, 0.0, heading]))
        )
        fit = fit_cloud(target, source, rotated.matrix, _REACHES)
        value = fit.overlap / (0.05 + fit.misfit)
        if value > stationary:
            best, stationary = fit.matrix, value
    if best is None:
        return None
    return level[0].inverse() @ RigidTransform.nearest(best)[0] @ level[1]


def _levelled(normal: Float64Array, height: float) -> RigidTransform:
    """`level_from_lidar`: the ground at z = 0, up along z, the origin below the sensor."""
    axis = np.cross(normal, [0.0, 0.0, 1.0])
    size = float(np.linalg.norm(axis))
    angle = float(np.arctan2(size, normal[2]))
    vector = axis / size * angle if size > 1e-9 else np.array([angle, 0.0, 0.0])
    return RigidTransform.from_quaternion(
        np.array([0.0, 0.0, height]), quaternion_from_rotation_vector(vector)
    )
