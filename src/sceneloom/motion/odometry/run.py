"""A scene's trajectory from its lidars."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

from sceneloom.errors import PoseError
from sceneloom.motion.odometry.configuration import OdometryConfiguration
from sceneloom.motion.odometry.knots import trajectory_of
from sceneloom.motion.odometry.lidar_odometry import LidarOdometry, Outcome, PoseEstimate
from sceneloom.motion.odometry.motion_state import MotionState
from sceneloom.motion.odometry.scene_sweeps import EgoCloud, SceneSweeps
from sceneloom.motion.odometry.stitching import OdometryPiece, stitched_estimates, summed_notices
from sceneloom.scene import Notice, NoticeKind, Scene, Trajectory

NAME = "lidar"
"""The trajectory's name."""

LEAD_SECONDS = 10.0
LEAST_LED = 20
"""So long before a part of a drive, and at least so many clouds, the odometry of that part begins."""


@dataclass(frozen=True, slots=True, eq=False)
class OdometryRun:
    """What lidar odometry made of a scene.

    Attributes:
        trajectory: `world_from_ego` under the name "lidar", from the first point's time to the last one's, with
            covariances; the world is the ego's first pose.
        notices: what was assumed, repaired or left out.
    """

    trajectory: Trajectory
    notices: tuple[Notice, ...]


def lidar_odometry(
    scene: Scene,
    *,
    configuration: OdometryConfiguration | None = None,
    progress: Callable[[int, int], None] | None = None,
    lenient: bool = False,
) -> OdometryRun:
    """Find the ego's way through a scene from its lidar sweeps.

    Args:
        configuration: settings; the defaults hold for everything.
        progress: told after each cloud how many are done and how many there are.
        lenient: leave sweeps out that cannot be read, with a notice.

    Raises:
        PoseError: the scene has no lidar sweeps, their points are in the world already, or none has returns.
        DataError: a sweep cannot be read, and this is not lenient.
    """
    piece = odometry_piece(scene, configuration=configuration, progress=progress, lenient=lenient)
    return joined_odometry([piece], source=scene.source, configuration=configuration)


def odometry_piece(
    scene: Scene,
    *,
    span_ns: tuple[int, int] | None = None,
    configuration: OdometryConfiguration | None = None,
    progress: Callable[[int, int], None] | None = None,
    lenient: bool = False,
) -> OdometryPiece:
    """Follow the ego through a part of a drive.

    Args:
        span_ns: [start, stop) of the beginnings of its clouds [ns], None for the whole drive. Those that lead into the
            part, by `LEAD_SECONDS` and at least `LEAST_LED`, are followed, too: the map grows in them, and by them the
            part is laid to the one before.
        configuration, progress, lenient: as of `lidar_odometry`.

    Raises:
        PoseError: the scene has no lidar sweeps, or their points are in the world already.
        DataError: a sweep cannot be read, and this is not lenient.
    """
    sweeps = SceneSweeps.of(scene, lenient=lenient)
    settings = configuration or OdometryConfiguration()
    rows = sweeps.rows_within(span_ns)
    led = (
        0 if span_ns is None else sweeps.rows_within((span_ns[0] - int(LEAD_SECONDS * 1e9), span_ns[1])).start
    )
    led = max(min(led, rows.start - LEAST_LED), 0)
    odometry = LidarOdometry(settings)
    estimates: list[PoseEstimate] = []
    leading = late = 0
    for row, cloud in sweeps.clouds(range(led, rows.stop), counted_from=rows.start):
        estimate = odometry.add(cloud.timestamp_ns, cloud.positions_ego, cloud.timestamps_ns)
        if estimate is not None:
            _append(estimates, estimate, settings)
            leading += row < rows.start
        elif row >= rows.start:
            late += 1
        if progress is not None:
            progress(row + 1 - led, rows.stop - led)
    counted, own = sweeps.counted_notices(), len(estimates)
    if odometry.beginning:
        _learn_beginning(odometry, estimates, sweeps.clouds(range(rows.stop, len(sweeps))), settings)
    return OdometryPiece(tuple(estimates[:own]), leading, late, len(rows), tuple(sweeps.notices), counted)


def _learn_beginning(
    odometry: LidarOdometry,
    estimates: list[PoseEstimate],
    later: Iterable[tuple[int, EgoCloud]],
    settings: OdometryConfiguration,
) -> None:
    """Go on behind a part that ends before anything tells how the ego moved when its map began."""
    for _, cloud in later:
        estimate = odometry.add(cloud.timestamp_ns, cloud.positions_ego, cloud.timestamps_ns)
        if estimate is not None:
            _append(estimates, estimate, settings)
        if not odometry.beginning:
            return


def joined_odometry(
    pieces: Sequence[OdometryPiece], *, source: str = "", configuration: OdometryConfiguration | None = None
) -> OdometryRun:
    """Make one way of the pieces of a drive.

    Args:
        pieces: in the order of time, each clouds after those of the one before.
        source: the drive, for messages.
        configuration: that of the pieces.

    Raises:
        PoseError: none has returns, or two have no sweep in common.
    """
    settings = configuration or OdometryConfiguration()
    estimates, stitched = stitched_estimates(pieces, source)
    if not any(estimate.outcome in _BEGINNINGS for piece in pieces for estimate in piece.estimates):
        raise PoseError(
            f"{source}: none of {sum(piece.clouds for piece in pieces)} lidar sweeps has enough returns to go by; "
            "choose another trajectory with `--trajectory NAME`"
        )
    counts = Counter(estimate.outcome for estimate in estimates)
    if not counts[Outcome.FITTED]:
        estimates = [_of_unknown_motion(estimate, settings) for estimate in estimates]
    late = sum(piece.late for piece in pieces)
    notices = (
        *pieces[0].notices,
        *summed_notices([piece.counted for piece in pieces]),
        *_remarks(counts, late, source),
    )
    return OdometryRun(trajectory_of(NAME, estimates), (*notices, *stitched))


def _append(estimates: list[PoseEstimate], estimate: PoseEstimate, settings: OdometryConfiguration) -> None:
    """Add an estimate; what it tells about the sweep that the map began with replaces what was not known then.

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
    state = first.predicted(earlier.state.timestamp_ns, settings.acceleration, settings.turn_acceleration)
    return replace(earlier, state=state, covariance=state.covariance[:6, :6])


def _of_unknown_motion(estimate: PoseEstimate, settings: OdometryConfiguration) -> PoseEstimate:
    """Say how little is known of where the ego was at the end of a sweep that no other one could be compared with."""
    later = estimate.state.predicted(
        max(estimate.last_ns, estimate.state.timestamp_ns), settings.acceleration, settings.turn_acceleration
    )
    return replace(estimate, covariance=estimate.covariance + later.covariance[:6, :6])


_BEGINNINGS = (Outcome.STARTED, Outcome.RESTARTED)

_REMARKS: Mapping[Outcome, tuple[str, str]] = MappingProxyType(
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
"""Code and message of the notice about each outcome that is not a fit."""


def _remarks(counts: Counter[Outcome], late: int, place: str) -> list[Notice]:
    notices = [
        Notice(kind=NoticeKind.ASSUMED, code=code, place=place, message=message, count=counts[outcome])
        for outcome, (code, message) in _REMARKS.items()
        if counts[outcome]
    ]
    if not counts[Outcome.FITTED]:
        message = "no two sweeps could be compared, so nothing is known of the motion; the ego was taken as standing"
        notices.append(
            Notice(kind=NoticeKind.ASSUMED, code="odometry-without-motion", place=place, message=message)
        )
    if late:
        message = (
            "sweeps whose middle is not later than that of the sweep before were left out of the odometry"
        )
        notices.append(
            Notice(
                kind=NoticeKind.SKIPPED, code="odometry-late-sweep", place=place, message=message, count=late
            )
        )
    return notices
