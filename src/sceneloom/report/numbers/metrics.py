"""How far what was found is from the truth, where there is one."""

from pathlib import Path

import msgspec

from sceneloom.errors import DataError, SceneloomError
from sceneloom.evaluate.report import TrajectoryReport
from sceneloom.evaluate.tracking.comparison import TrackingReport, compare_tracks
from sceneloom.evaluate.trajectory import evaluate_trajectory
from sceneloom.motion.ego_motion import find_ego_motion
from sceneloom.scene.poses import Trajectory, same_direction
from sceneloom.scene.scene import Scene

TRUTH = "groundTruth"
"""The name of trajectories that are taken for the truth."""


class Metrics(msgspec.Struct, frozen=True, kw_only=True):
    """Comparisons with the truth.

    Attributes:
        trajectories: one per trajectory that was held against a reference.
        tracks: objects of the drive held against those of the truth; None where there are none of both.
        skipped: what could not be compared, and why.
    """

    trajectories: tuple[TrajectoryReport, ...] = ()
    tracks: TrackingReport | None = None
    skipped: tuple[str, ...] = ()


def metrics_of(
    scene: Scene, *, source: Path | str | None, truth: Path | str | None, compare: tuple[str, ...] = ()
) -> Metrics:
    """Compare the trajectories of a scene with its true one, and with a truth that lies elsewhere.

    Args:
        source: where the drive lies, to be held against `truth`; None where it is in memory only.
        truth: a trajectory, or a scene or KITTI's text with the true objects and trajectory; None for none.
        compare: ways to be found and compared, too: "lidar", "gnss".

    Raises:
        DataError: neither the drive's trajectory nor its objects can be compared with `truth`, or nothing can be found
            and compared of `compare`.
    """
    collected = _Collected()
    true_trajectory = scene.trajectories.get(TRUTH)
    reference = (
        true_trajectory if true_trajectory is not None else next(iter(scene.trajectories.values()), None)
    )
    if true_trajectory is not None:
        for name, trajectory in scene.trajectories.items():
            if name != TRUTH and not same_direction(trajectory, true_trajectory):
                collected.compare(trajectory, true_trajectory)
    for name in compare:
        collected.find_and_compare(scene, name, reference)
    if truth is not None:
        collected.against(scene, source, truth)
    return Metrics(
        trajectories=tuple(collected.trajectories), tracks=collected.tracks, skipped=tuple(collected.skipped)
    )


class _Collected:
    """Comparisons so far; what cannot be compared is reported, not raised, but for what was asked for by name."""

    def __init__(self) -> None:
        self.trajectories: list[TrajectoryReport] = []
        self.tracks: TrackingReport | None = None
        self.skipped: list[str] = []

    def compare(self, estimate: Trajectory, reference: Trajectory | Path | str) -> None:
        try:
            self.trajectories.append(evaluate_trajectory(estimate, reference))
        except SceneloomError as error:
            self.skipped.append(f"{estimate.name}: {error}")

    def find_and_compare(self, scene: Scene, name: str, reference: Trajectory | None) -> None:
        try:
            if reference is None:
                raise DataError(scene.source, "", "the drive has no trajectory to be compared with")
            path = find_ego_motion(scene, name=name).path
            found = Trajectory(name, path.timestamps_ns, path.positions, path.quaternions_xyzw)
            self.trajectories.append(evaluate_trajectory(found, reference))
        except SceneloomError as error:
            problem = (
                f"nothing can be compared with what is found from {name}: {getattr(error, 'problem', error)}"
            )
            raise DataError(scene.source, "", f"{problem}; leave `--compare {name}` out") from error

    def against(self, scene: Scene, source: Path | str | None, truth: Path | str) -> None:
        """Hold the drive's trajectory, and its objects, against a truth that may have one of both only."""
        refused: list[str] = []
        before = len(self.trajectories)
        if scene.trajectories:
            reported = len(self.skipped)
            self.compare(next(iter(scene.trajectories.values())), truth)
            refused += self.skipped[reported:]
            del self.skipped[reported:]
        if source is not None:
            try:
                self.tracks = compare_tracks(source, truth)
            except SceneloomError as error:
                refused.append(f"objects: {error}")
        if self.tracks is None and len(self.trajectories) == before:
            reasons = "; ".join(refused) or "the drive has neither a trajectory nor objects"
            raise DataError(
                truth,
                "",
                f"cannot be compared with the drive: {reasons}. Expected a trajectory whose times overlap with the "
                "drive's, or objects of the same frames; name such a file, or leave `--truth` out",
            )
