"""The poses that a reader gives its sensors, and what writers in the world do without any."""

from collections.abc import Mapping
from typing import Any

from sceneloom.formats.ledger import Ledger
from sceneloom.formats.loss import Fate, Loss
from sceneloom.scene import NoticeKind, PosePath, Trajectory


def default_poses(trajectories: Mapping[Any, Trajectory], place: str, ledger: Ledger) -> PosePath | None:
    """Give `world_from_ego` of the first trajectory; None, with a notice at `place`, where it has no orientations.

    None as well where there is no trajectory.
    """
    default = next(iter(trajectories.values()), None)
    if default is None:
        return None
    if default.quaternions_xyzw is None:
        message = (
            f"trajectory {default.name!r} holds positions without orientations, so the sensors have no poses"
        )
        ledger.note(NoticeKind.SKIPPED, "orientations-missing", place, message)
        return None
    return default.poses


def standing_ego() -> Loss:
    """What every target that places things in the world reports of a drive whose trajectory is not known."""
    what = "not known: the ego is taken to stand at the world's origin"
    return Loss(field="trajectories.positions", what=what, fate=Fate.APPROXIMATED)
