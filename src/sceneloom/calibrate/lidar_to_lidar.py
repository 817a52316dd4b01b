"""How two lidars lie to each other, by fitting the clouds of many frames onto one another."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import small_gicp

from sceneloom.arrays import Float64Array
from sceneloom.calibrate.extrinsics import MountingEstimate, ground_plane, unobserved_directions
from sceneloom.errors import OptionError, PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import quaternion_from_rotation_vector, rotation_vector_from_quaternion
from sceneloom.motion.deskew import BodyKnots
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.poses import Poses, PoseSource
from sceneloom.scene.sampling import choose_ego
from sceneloom.scene.scene import Scene, scene_period_ns
from sceneloom.scene.types import Identifier, PointsFrame, Progress, key_of

_SPACING = 0.4


_NEIGHBOURS = 15


@dataclass(frozen=True, slots=True, eq=False)
class _CloudFit:
    """How a cloud fits onto another.

    Attributes:
        matrix: (4, 4) `target_from_source`.
        information: (6, 6) of a small rotation, then a small shift, in the source's own axes.
        overlap: share of the source's points that found a partner.
        misfit: mean squared distance of these.
    """

    matrix: Float64Array
    information: Float64Array
    overlap: float
    misfit: float


class _PreparedCloud:
    """A cloud thinned to one point per cell, with the shape of the surface around each."""

    def __init__(self, points: Float64Array, *, spacing: float = _SPACING) -> None:
        """Prepare (N, 3) points [m]."""
        self.points, self.tree = small_gicp.preprocess_points(
            np.ascontiguousarray(points, np.float64), spacing, _NEIGHBOURS, 1
        )

    def __len__(self) -> int:
        return int(self.points.size())


def _fit_cloud(
    target: _PreparedCloud, source: _PreparedCloud, start: Float64Array, reaches: Sequence[float]
) -> _CloudFit:
    """Fit a cloud onto another.

    Args:
        start: (4, 4) `target_from_source` to begin with.
        reaches: points farther apart than this [m] do not belong together, from the first round to the last.

    Source: Segal, Haehnel and Thrun 2009, "Generalized-ICP"; Koide 2024, "small_gicp".
    """
    matrix, found = np.asarray(start, np.float64), None
    for reach in reaches:
        found = small_gicp.align(
            target.points,
            source.points,
            target.tree,
            matrix,
            registration_type="GICP",
            max_correspondence_distance=reach,
            num_threads=1,
        )
        matrix = np.asarray(found.T_target_source, np.float64)
    if found is None:
        return _CloudFit(matrix, np.zeros((6, 6)), 0.0, np.inf)
    return _CloudFit(
        matrix.copy(),
        np.asarray(found.H, np.float64),
        found.num_inliers / max(len(source), 1),
        float(found.error) / max(found.num_inliers, 1),
    )


_HEADINGS = 24


_COARSE = 1.0


_FIRST_REACHES = (4.0, 1.5)


def _ground_start(first: Float64Array, second: Float64Array) -> RigidTransform | None:
    """Guess `first_from_second` of two clouds, (N, 3) and (M, 3) [m], seen at one time from one vehicle."""
    grounds = ground_plane(first), ground_plane(second)
    if grounds[0] is None or grounds[1] is None:
        return None
    level = [_levelled(normal, height) for normal, height in (grounds[0], grounds[1])]
    target, source = (
        _PreparedCloud(one.apply(points), spacing=_COARSE) for one, points in zip(level, (first, second), strict=True)
    )
    best, stationary = None, -np.inf
    for heading in np.arange(_HEADINGS) * (2.0 * np.pi / _HEADINGS):
        rotated = RigidTransform.from_quaternion(
            np.zeros(3), quaternion_from_rotation_vector(np.array([0.0, 0.0, heading]))
        )
        fit = _fit_cloud(target, source, rotated.matrix, _FIRST_REACHES)
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
    return RigidTransform.from_quaternion(np.array([0.0, 0.0, height]), quaternion_from_rotation_vector(vector))


MOST = 20
_REACHES = (2.0, 1.0, 0.5)
_LEAST_OVERLAP = 0.15
_LEAST_POINTS = 300
_FARTHEST = 80.0
_NEAREST = 1.0
_SYSTEMATIC = np.array([*np.full(3, np.radians(0.02)), *np.full(3, 0.005)])
"""What all frames may share [rad], [m]: surfaces that are thinned on both sides."""
_LEAST_AGREEING = 0.5
_AGREEING = np.array([np.radians(0.5), 0.1])
"""Frames whose fit is farther from the median than this [rad], [m] went astray."""


@dataclass(frozen=True, slots=True, eq=False)
class LidarToLidar:
    """What was found.

    Attributes:
        first_id, second_id: the lidars.
        stated: `first_from_second` as the scene has it, or None.
        mounting: `first_from_second` with its covariance about the first lidar's axes.
        overlap: share of the second lidar's points that lie on what the first one sees.
        frames, agreeing: how many frames were compared, and how many of them agree.
        started: "stated" or "ground": where the search began.
    """

    first_id: Identifier
    second_id: Identifier
    stated: RigidTransform | None
    mounting: MountingEstimate
    overlap: float
    frames: int
    agreeing: int
    started: str


def lidar_to_lidar(
    scene: Scene,
    first_id: Identifier | None = None,
    second_id: Identifier | None = None,
    *,
    use_stated: bool = True,
    most: int = MOST,
    progress: Progress | None = None,
) -> LidarToLidar:
    """Find `first_from_second` of two lidars.

    Sweeps are brought to one time by the ego's recorded trajectory where there is one.

    Args:
        first_id, second_id: None for the scene's first two.
        use_stated: begin at the stated mountings; without them the ground and a search over headings give a start.
        most: so many frames at most, evenly spread.
        progress: reported after each frame.

    Raises:
        OptionError: there are no two such lidars, or `most` is less than 1.
        PoseError: no start is found, the clouds do not overlap, or the frames do not agree.
        DataError: a sweep cannot be read.
    """
    if most < 1:
        raise OptionError(f"{most} frames; expected at least 1")
    first, second = _chosen(scene, first_id, second_id)
    stated = None if first.mount is None or second.mount is None else first.mount.inverse() @ second.mount
    pairs = list(_clouds(scene, first, second, most))
    if not pairs:
        raise PoseError(f"{scene.source}: no sweeps of {first.id!r} and {second.id!r} at one time; expected some")
    start = stated if use_stated else None
    started = "stated" if start is not None else "ground"
    start = start or _ground_start(*pairs[len(pairs) // 2])
    if start is None:
        raise PoseError(f"{scene.source}: no ground in both clouds; expected one, or stated mountings to begin with")
    fits = []
    for done, (target, source) in enumerate(pairs, start=1):
        fits.append(_fit_cloud(_PreparedCloud(target), _PreparedCloud(source), start.matrix, _REACHES))
        if progress is not None:
            progress(done, len(pairs))
    mounting, agreeing = _joined(fits, scene.source)
    overlap = float(np.median([fit.overlap for fit in fits]))
    return LidarToLidar(first.id, second.id, stated, mounting, overlap, len(fits), agreeing, started)


def _chosen(scene: Scene, first_id: Identifier | None, second_id: Identifier | None) -> tuple[LidarSensor, LidarSensor]:
    known = {key_of(lidar.id): lidar for lidar in scene.lidars}
    ids = [lidar.id for lidar in scene.lidars]
    first = first_id if first_id is not None else next(iter(ids), None)
    second = second_id if second_id is not None else next((one for one in ids if one != first), None)
    for wanted in (first, second):
        if wanted is None or key_of(wanted) not in known:
            listed = ", ".join(map(repr, ids)) or "none"
            named = "" if wanted is None else f", and {wanted!r} among them"
            raise OptionError(f"{scene.source}: lidars {listed}; expected two{named}")
    if first == second:
        raise OptionError(f"lidar {first!r} is named twice; expected two of them")
    return known[key_of(first)], known[key_of(second)]  # type: ignore[arg-type]


def _clouds(
    scene: Scene, first: LidarSensor, second: LidarSensor, most: int
) -> Iterator[tuple[Float64Array, Float64Array]]:
    """Clouds of both lidars at one time, each in its own frame then."""
    ego = choose_ego(scene, None) if scene.trajectories else None
    reach_ns = scene_period_ns(scene)
    chosen = np.unique(np.linspace(0, len(first.frames) - 1, min(most, len(first.frames))).round().astype(int))
    times = second.frames.timestamps_ns
    for k in chosen.tolist():
        if len(times) == 0:
            return
        sweep = first.frames[k]
        other = int(np.argmin(np.abs(times - sweep.timestamp_ns)))
        if abs(int(times[other]) - sweep.timestamp_ns) > reach_ns:
            continue
        clouds = [
            _usable(_at_one_time(frame, lidar, None if ego is None else ego.path, sweep.reference_ns, reach_ns))
            for frame, lidar in ((sweep, first), (second.frames[other], second))
        ]
        if min(map(len, clouds)) >= _LEAST_POINTS:
            yield clouds[0], clouds[1]


def _at_one_time(
    frame: LidarFrame, lidar: LidarSensor, path: Poses | None, time_ns: int, reach_ns: int
) -> Float64Array:
    """The points of a sweep where its lidar was at a time, as far as the ego trajectory reports."""
    points = frame.points.positions.astype(np.float64)
    if lidar.points_frame is PointsFrame.WORLD:
        raise PoseError(f"points of lidar {lidar.id!r} are in the world already; expected its own frame")
    if lidar.points_frame is PointsFrame.EGO and lidar.mount is not None:
        points = lidar.mount.inverse().apply(points)
    times = frame.points.timestamps_ns
    if path is None or lidar.mount is None or times is None or len(times) == 0:
        return points
    source = PoseSource(path, lidar.mount, reach_ns)
    at = source.at(np.array([time_ns], np.int64))
    if not np.isfinite(at.positions).all():
        return points
    here = RigidTransform.from_quaternion(at.positions[0], at.quaternions_xyzw[0])
    try:
        knots = BodyKnots.of(source, int(times.min()), int(times.max()))
    except PoseError:
        return points
    return knots.seen_from(here.inverse()).moved(points.astype(np.float32), times, lidar.mount)


def _usable(points: Float64Array) -> Float64Array:
    ranges = np.linalg.norm(points, axis=1)
    usable: Float64Array = points[np.isfinite(ranges) & (ranges > _NEAREST) & (ranges < _FARTHEST)]
    return usable


def _joined(fits: list[_CloudFit], source: str) -> tuple[MountingEstimate, int]:
    """One mounting from those of all frames, each by its information; how they scatter is the covariance.

    Raises:
        PoseError: the clouds do not overlap, or the frames do not agree.
    """
    overlap = float(np.median([fit.overlap for fit in fits]))
    if overlap < _LEAST_OVERLAP:
        raise PoseError(
            f"{source}: {100 * overlap:.0f} % of the points find a partner; expected {100 * _LEAST_OVERLAP:.0f} % or "
            "more: do the lidars see the same, and is the start near enough?"
        )
    poses = [RigidTransform.nearest(fit.matrix)[0] for fit in fits]
    middle = poses[_most_central(poses)]
    steps = np.array([_right_step(middle, pose) for pose in poses])
    agreeing = (np.linalg.norm(steps[:, :3], axis=1) < _AGREEING[0]) & (
        np.linalg.norm(steps[:, 3:], axis=1) < _AGREEING[1]
    )
    if agreeing.mean() < _LEAST_AGREEING:
        raise PoseError(
            f"{source}: {int(agreeing.sum())} of {len(fits)} frames agree within 0.5 deg and 10 cm; expected half of "
            "them: the start is too far off, or what both see does not hold the lidars"
        )
    used = np.flatnonzero(agreeing)
    informations = np.array([fits[k].information for k in used])
    whole = np.linalg.inv(informations.sum(axis=0) + 1e-9 * np.eye(6))
    mean = whole @ np.einsum("fij,fj->i", informations, steps[used])
    pulls = np.einsum("fij,fj->fi", informations, steps[used] - mean)
    count = len(used)
    scatter = whole @ (pulls.T @ pulls * (count / max(count - 1, 1))) @ whole
    axes = np.kron(np.eye(2), middle.rotation)
    covariance = axes @ scatter @ axes.T + np.diag(_SYSTEMATIC**2)
    rotation = RigidTransform.from_quaternion(mean[3:], quaternion_from_rotation_vector(mean[:3]))
    return MountingEstimate(middle @ rotation, covariance, unobserved_directions(covariance, "first lidar")), count


def _most_central(poses: list[RigidTransform]) -> int:
    """The pose that is nearest to all others."""
    locations = np.array([[*pose.translation, *(10.0 * pose.rotation.ravel())] for pose in poses])
    distances = np.linalg.norm(locations[:, None] - locations[None], axis=2)
    return int(np.argmin(np.median(distances, axis=1)))


def _right_step(middle: RigidTransform, pose: RigidTransform) -> Float64Array:
    step = middle.inverse() @ pose
    return np.concatenate([rotation_vector_from_quaternion(step.quaternion_xyzw), step.translation])
