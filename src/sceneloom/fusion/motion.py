"""The trajectory of the vehicle as it comes in: the last minute of it."""

from dataclasses import dataclass

import numpy as np

from sceneloom.errors import PoseError
from sceneloom.fusion.accepted import CLOCK_JUMP_NS
from sceneloom.scene.poses import Poses

KEPT_NS = 60_000_000_000
"""So much of the trajectory is kept."""

_MOST_POSES = 100_000
"""Of one minute: a sender that reports more than 1600 poses a second is stopped."""


@dataclass(slots=True)
class RecentTrajectory:
    """Puts together poses that come piece by piece."""

    _path: Poses | None = None

    def extended(self, path: Poses) -> Poses:
        """Add newer poses, and give the trajectory of the last minute.

        Poses that are very much older begin another way: a clock was set back. Positions are counted from the newest
        one, so that points far from a map's origin keep their digits.

        Raises:
            PoseError: they are not newer than those that came before, or too many.
        """
        if path.static or len(path.timestamps_ns) == 0:
            raise PoseError("no poses with times; expected one or more")
        before = self._path
        if before is not None and path.start_ns < before.stop_ns - CLOCK_JUMP_NS:
            before = None
        if before is not None and path.start_ns <= before.stop_ns:
            raise PoseError(
                f"a pose at {path.start_ns} ns after one at {before.stop_ns} ns; expected newer ones"
            )
        parts = [path] if before is None else [before, path]
        times = np.concatenate([part.timestamps_ns for part in parts])
        kept = slice(int(np.searchsorted(times, times[-1] - KEPT_NS)), None)
        if len(times[kept]) > _MOST_POSES:
            raise PoseError(f"{len(times[kept])} poses in a minute; expected at most {_MOST_POSES}")
        self._path = Poses(
            times[kept],
            np.concatenate([part.positions for part in parts])[kept],
            np.concatenate([part.quaternions_xyzw for part in parts])[kept],
        )
        return self._path.moved(self._path.positions[-1])
