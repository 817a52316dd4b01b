"""Pose of a lidar relative to another one, by registration of their clouds over many frames."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import small_gicp

from sceneloom.arrays import Float64Array, spread_rows
from sceneloom.calibrate.extrinsics import MountingEstimate, ground_plane
from sceneloom.calibrate.frames import MOST
from sceneloom.errors import OptionError, PoseError
from sceneloom.geometry.rigid import RigidTransform, quaternion_from_rotation_vector, rotation_vector_from_quaternion
from sceneloom.motion.deskew import BodyKnots
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.poses import Poses, PoseSource
from sceneloom.scene.samples import choose_ego
from sceneloom.scene.scene import Scene, scene_period_ns
from sceneloom.scene.types import Identifier, PointsFrame, Progress, key_of, reporting

_SPACING, _COARSE, _NEIGHBOURS = 0.4, 1.0, 15
"""Clouds are thinned to one point per cell of this size [m], for the fit and for the search over headings."""

_HEADINGS, _FIRST_REACHES, _REACHES = 24, (4.0, 1.5), (2.0, 1.0, 0.5)
"""Points farther apart than this [m] do not match, from the first round to the last."""

_LEAST_OVERLAP, _LEAST_POINTS, _NEAREST, _FARTHEST = 0.15, 300, 1.0, 80.0
_SYSTEMATIC = np.array([*np.full(3, np.radians(0.02)), *np.full(3, 0.005)])
"""Errors that all frames may share [rad], [m]: surfaces that are thinned on both sides."""

_LEAST_AGREEING, _AGREEING = 0.5, np.array([np.radians(0.5), 0.1])
"""Frames whose fit is farther from the median than this [rad], [m] went astray."""


@dataclass(frozen=True, slots=True, eq=False)
class LidarToLidar:
    """Estimated pose of a lidar relative to another one.

    Attributes:
        first_id, second_id: the lidars.
        stated: `first_from_second` as the scene has it, or None.
        mounting: `first_from_second` with its covariance about the first lidar's axes.
        overlap: share of the second lidar's points that are on surfaces that the first one sees.
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
    """Estimate `first_from_second` of two lidars.

    Sweeps are brought to one time by the ego's recorded trajectory where there is one.

    Args:
        first_id, second_id: None for the scene's first two.
        use_stated: begin at the stated extrinsics; without them the ground and a search over headings give a start.
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
    start, started = (stated, "stated") if use_stated and stated is not None else (None, "ground")
    start = start or _ground_start(*pairs[len(pairs) // 2])
    if start is None:
        raise PoseError(f"{scene.source}: no ground in both clouds; expected one, or stated extrinsics to begin with")
    fits = [
        _fit_cloud(_PreparedCloud(target), _PreparedCloud(source), start.matrix, _REACHES)
        for target, source in reporting(pairs, progress, len(pairs))
    ]
    overlap = float(np.median([fit.overlap for fit in fits]))
    if overlap < _LEAST_OVERLAP:
        raise PoseError(
            f"{scene.source}: {100 * overlap:.0f} % of the points find a partner; expected "
            f"{100 * _LEAST_OVERLAP:.0f} % or more: do the lidars see the same, and is the start near enough?"
        )
    mounting, agreeing = _joined(fits, scene.source)
    return LidarToLidar(first.id, second.id, stated, mounting, overlap, len(fits), agreeing, started)


def _chosen(scene: Scene, first_id: Identifier | None, second_id: Identifier | None) -> tuple[LidarSensor, LidarSensor]:
    known, ids = {key_of(lidar.id): lidar for lidar in scene.lidars}, [lidar.id for lidar in scene.lidars]
    first = first_id if first_id is not None else next(iter(ids), None)
    second = second_id if second_id is not None else next((one for one in ids if one != first), None)
    if first is not None and first == second:
        raise OptionError(f"lidar {first!r} is named twice; expected two of them")
    chosen = []
    for wanted in (first, second):
        if wanted is None or key_of(wanted) not in known:
            listed = ", ".join(map(repr, ids)) or "none"
            named = "" if wanted is None else f", and {wanted!r} among them"
            raise OptionError(f"{scene.source}: lidars {listed}; expected two{named}")
        chosen.append(known[key_of(wanted)])
    return chosen[0], chosen[1]


def _clouds(
    scene: Scene, first: LidarSensor, second: LidarSensor, most: int
) -> Iterator[tuple[Float64Array, Float64Array]]:
    """Clouds of both lidars at one time, each in its own frame then."""
    ego = choose_ego(scene, None) if scene.trajectories else None
    reach_ns, times = scene_period_ns(scene), second.frames.timestamps_ns
    for k in spread_rows(len(first.frames), most).tolist() if len(times) else ():
        sweep = first.frames[k]
        other = int(np.argmin(np.abs(times - sweep.timestamp_ns)))
        if abs(int(times[other]) - sweep.timestamp_ns) > reach_ns:
            continue
        clouds = []
        for frame, lidar in ((sweep, first), (second.frames[other], second)):
            points = _at_one_time(frame, lidar, None if ego is None else ego.path, sweep.reference_ns, reach_ns)
            ranges = np.linalg.norm(points, axis=1)
            clouds.append(points[np.isfinite(ranges) & (ranges > _NEAREST) & (ranges < _FARTHEST)])
        if min(map(len, clouds)) >= _LEAST_POINTS:
            yield clouds[0], clouds[1]


def _at_one_time(
    frame: LidarFrame, lidar: LidarSensor, path: Poses | None, time_ns: int, reach_ns: int
) -> Float64Array:
    """The points of a sweep in the lidar's frame at a time, as far as the ego trajectory is known."""
    points = frame.points.positions.astype(np.float64)
    if lidar.points_frame is PointsFrame.WORLD:
        raise PoseError(f"points of lidar {lidar.id!r} are in the world already; expected its own frame")
    if lidar.points_frame is PointsFrame.EGO and lidar.mount is not None:
        points = lidar.mount.inverse().apply(points)
    times = frame.points.timestamps_ns
    if path is None or lidar.mount is None or times is None or len(times) == 0:
        return points
    source = PoseSource(path, lidar.mount, reach_ns)
    here = source.pose_at(time_ns)
    if here is None:
        return points
    try:
        knots = BodyKnots.of(source, int(times.min()), int(times.max()))
    except PoseError:
        return points
    return knots.seen_from(here.inverse()).moved(points.astype(np.float32), times, lidar.mount)


class _PreparedCloud:
    """A cloud, (N, 3) [m], thinned to one point per cell, with the shape of the surface around each."""

    def __init__(self, points: Float64Array, spacing: float = _SPACING) -> None:
        self.points, self.tree = small_gicp.preprocess_points(
            np.ascontiguousarray(points, np.float64), spacing, _NEIGHBOURS, 1
        )


@dataclass(frozen=True, slots=True, eq=False)
class _CloudFit:
    """The fit of a cloud onto another."""

    matrix: Float64Array  # (4, 4) `target_from_source`
    information: Float64Array  # (6, 6) of a small rotation, then a small translation, in the source's own axes
    overlap: float  # share of the source's points that found a partner
    misfit: float  # mean squared distance of these


def _fit_cloud(
    target: _PreparedCloud, source: _PreparedCloud, start: Float64Array, reaches: Sequence[float]
) -> _CloudFit:
    """Fit a cloud onto another from (4, 4) `target_from_source` (Segal et al. 2009, GICP; Koide 2024, "small_gicp")."""
    matrix = start
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
    overlap = found.num_inliers / max(int(source.points.size()), 1)
    misfit = float(found.error) / max(found.num_inliers, 1)
    return _CloudFit(matrix.copy(), np.asarray(found.H, np.float64), overlap, misfit)


def _ground_start(first: Float64Array, second: Float64Array) -> RigidTransform | None:
    """Guess `first_from_second` of two clouds, (N, 3) and (M, 3) [m], seen at one time from one vehicle."""
    from_first, from_second = _level_from_lidar(first), _level_from_lidar(second)
    if from_first is None or from_second is None:
        return None
    target, source = (
        _PreparedCloud(level.apply(points), _COARSE) for level, points in ((from_first, first), (from_second, second))
    )
    fits = []
    for heading in np.arange(_HEADINGS) * (2.0 * np.pi / _HEADINGS):
        start = np.eye(4)
        start[:2, :2] = [[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]
        fits.append(_fit_cloud(target, source, start, _FIRST_REACHES))
    best = max(fits, key=lambda fit: fit.overlap / (0.05 + fit.misfit))
    return from_first.inverse() @ RigidTransform.nearest(best.matrix)[0] @ from_second


def _level_from_lidar(points: Float64Array) -> RigidTransform | None:
    """The frame with the ground at z = 0, z up, and the origin below the sensor; None where no ground is found."""
    ground = ground_plane(points)
    if ground is None:
        return None
    normal, height = ground
    axis = np.cross(normal, [0.0, 0.0, 1.0])
    size = float(np.linalg.norm(axis))
    angle = float(np.arctan2(size, normal[2]))
    vector = axis / size * angle if size > 1e-9 else np.array([angle, 0.0, 0.0])
    return RigidTransform.from_quaternion(np.array([0.0, 0.0, height]), quaternion_from_rotation_vector(vector))


def _joined(fits: list[_CloudFit], source: str) -> tuple[MountingEstimate, int]:
    """One estimate from those of all frames, each by its information, with their scatter as covariance."""
    poses = [RigidTransform.nearest(fit.matrix)[0] for fit in fits]
    locations = np.array([[*pose.translation, *(10.0 * pose.rotation.ravel())] for pose in poses])
    distances = np.linalg.norm(locations[:, None] - locations[None], axis=2)
    middle = poses[int(np.argmin(np.median(distances, axis=1)))]  # the nearest to all others
    between = [middle.inverse() @ pose for pose in poses]
    steps = np.array([[*rotation_vector_from_quaternion(s.quaternion_xyzw), *s.translation] for s in between])
    agreeing = (np.linalg.norm(steps.reshape(-1, 2, 3), axis=2) < _AGREEING).all(axis=1)
    if agreeing.mean() < _LEAST_AGREEING:
        raise PoseError(
            f"{source}: {int(agreeing.sum())} of {len(fits)} frames agree within 0.5 deg and 10 cm; expected half of "
            "them: the start is too far off, or the surfaces that both see do not determine the pose"
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
    step = RigidTransform.from_quaternion(mean[3:], quaternion_from_rotation_vector(mean[:3]))
    return MountingEstimate.of(middle @ step, covariance, "first lidar"), count
