"""A scene's trajectory from its lidars."""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

from sceneloom.errors import PoseError
from sceneloom.motion.odometry.configuration import OdometryConfiguration
from sceneloom.motion.odometry.knots import trajectory_of
from sceneloom.motion.odometry.lidar_odometry import LidarOdometry, Outcome, PoseEstimate
from sceneloom.motion.odometry.motion_state import MotionState
from sceneloom.motion.odometry.scene_sweeps import SceneSweeps
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene
from sceneloom.scene.warnings import DataWarning, WarningKind

NAME = "lidar"
"""The trajectory's name."""


@dataclass(frozen=True, slots=True, eq=False)
class OdometryRun:
    """What lidar odometry made of a scene.

    Attributes:
        trajectory: `world_from_ego` under the name "lidar", from the first point's time to the last one's, with
            covariances; the world is the ego's first pose.
        warnings: what was assumed, repaired or left out.
    """

    trajectory: Trajectory
    warnings: tuple[DataWarning, ...]


def lidar_odometry(
    scene: Scene,
    *,
    configuration: OdometryConfiguration | None = None,
    progress: Callable[[int, int], None] | None = None,
    lenient: bool = False,
) -> OdometryRun:
    """Find the ego trajectory through a scene from its lidar sweeps.

    Args:
        configuration: settings; the defaults hold for everything.
        progress: reported after each cloud how many are done and how many there are.
        lenient: leave sweeps out that cannot be read, with a warning.

    Raises:
        PoseError: the scene has no lidar sweeps, their points are in the world already, or none has returns.
        DataError: a sweep cannot be read, and this is not lenient.
    """
    sweeps = SceneSweeps.of(scene, lenient=lenient)
    settings = configuration or OdometryConfiguration()
    odometry = LidarOdometry(settings)
    estimates: list[PoseEstimate] = []
    late = 0
    for row, cloud in sweeps.clouds():
        estimate = odometry.add(cloud.timestamp_ns, cloud.positions_ego, cloud.timestamps_ns)
        if estimate is None:
            late += 1
        else:
            _append(estimates, estimate, settings)
        if progress is not None:
            progress(row + 1, len(sweeps))
    if not any(estimate.outcome in _BEGINNINGS for estimate in estimates):
        raise PoseError(
            f"{scene.source}: none of {len(sweeps)} lidar sweeps has enough returns to go by; "
            "choose another trajectory with `--trajectory NAME`"
        )
    counts = Counter(estimate.outcome for estimate in estimates)
    if not counts[Outcome.FITTED]:
        estimates = [_of_unknown_motion(estimate, settings) for estimate in estimates]
    warnings = (*sweeps.warnings, *sweeps.counted_warnings(), *_notes(counts, late, scene.source))
    return OdometryRun(trajectory_of(NAME, estimates), warnings)


def _append(estimates: list[PoseEstimate], estimate: PoseEstimate, settings: OdometryConfiguration) -> None:
    """Add an estimate; what it reports about the sweep that the map began with replaces what was not known then.

    Sweeps before the very first map get the poses from which its motion comes.
    """
    first = estimate.first_state
    if first is not None:
        begun_at = max(k for k, earlier in enumerate(estimates) if earlier.outcome in _BEGINNINGS)
        estimates[begun_at] = replace(estimates[begun_at], state=first)
        if estimates[begun_at].outcome is Outcome.STARTED:
            estimates[:begun_at] = [_led_back(earlier, first, settings) for earlier in estimates[:begun_at]]
    estimates.append(estimate)


def _led_back(earlier: PoseEstimate, first: MotionState, settings: OdometryConfiguration) -> PoseEstimate:
    state = first.predicted(earlier.state.timestamp_ns, settings.acceleration, settings.yaw_acceleration)
    return replace(earlier, state=state, covariance=state.covariance[:6, :6])


def _of_unknown_motion(estimate: PoseEstimate, settings: OdometryConfiguration) -> PoseEstimate:
    """Report how little is known of where the ego was at the end of a sweep that no other one could be compared with."""
    later = estimate.state.predicted(
        max(estimate.last_ns, estimate.state.timestamp_ns), settings.acceleration, settings.yaw_acceleration
    )
    return replace(estimate, covariance=estimate.covariance + later.covariance[:6, :6])


_BEGINNINGS = (Outcome.STARTED, Outcome.RESTARTED)

_NOTES: Mapping[Outcome, tuple[str, str]] = MappingProxyType(
    {
        Outcome.TOO_FEW: (
            "odometry-too-few-points",
            "sweeps with too few usable points: their poses go on with the motion before, and their covariances grow",
        ),
        Outcome.MISFIT: (
            "odometry-misfit",
            "sweeps that do not fit onto the map: their poses go on with the motion before, and their covariances grow",
        ),
        Outcome.RESTARTED: (
            "odometry-restarted",
            "a gap in time or many misfits: new map begun where the motion before leads, with grown covariances",
        ),
    }
)
"""Code and message of the warning about each outcome that is not a fit."""


def _notes(counts: Counter[Outcome], late: int, location: str) -> list[DataWarning]:
    warnings = [
        DataWarning(
            kind=WarningKind.ASSUMED, code=code, location=location, message=message, count=counts[outcome]
        )
        for outcome, (code, message) in _NOTES.items()
        if counts[outcome]
    ]
    if not counts[Outcome.FITTED]:
        message = "no two sweeps could be compared, so nothing is known of the motion; the ego was taken as stationary"
        warnings.append(
            DataWarning(
                kind=WarningKind.ASSUMED, code="odometry-without-motion", location=location, message=message
            )
        )
    if late:
        message = (
            "sweeps whose middle is not later than that of the sweep before were left out of the odometry"
        )
        warnings.append(
            DataWarning(
                kind=WarningKind.SKIPPED,
                code="odometry-late-sweep",
                location=location,
                message=message,
                count=late,
            )
        )
    return warnings
