"""The poses that a reader gives its sensors: along the default trajectory."""

from collections.abc import Mapping
from typing import Any

from sceneloom.formats.ledger import Ledger
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
