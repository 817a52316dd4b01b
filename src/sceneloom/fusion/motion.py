"""The way of the vehicle as it comes in: the last minute of it."""

from dataclasses import dataclass

import numpy as np

from sceneloom.errors import PoseError
from sceneloom.scene.poses import PosePath

_KEPT_NS = 60_000_000_000


@dataclass(slots=True)
class RecentWay:
    """Puts together poses that come piece by piece.

    Positions are counted from the first one that came, so that points far from a map's origin keep their digits.
    """

    _path: PosePath | None = None
    _origin: tuple[float, ...] = ()

    def extended(self, path: PosePath) -> PosePath:
        """Add newer poses, and give the way of the last minute.

        Raises:
            PoseError: they are not newer than those that came before.
        """
        if path.endless or len(path.timestamps_ns) == 0:
            raise PoseError("no poses with times; expected one or more")
        if not self._origin:
            self._origin = tuple(path.positions[0].tolist())
        near = path.moved(np.array(self._origin))
        if self._path is None:
            self._path = near
            return near
        if near.start_ns <= self._path.stop_ns:
            raise PoseError(
                f"a pose at {near.start_ns} ns after one at {self._path.stop_ns} ns; expected newer ones"
            )
        times = np.concatenate([self._path.timestamps_ns, near.timestamps_ns])
        kept = slice(int(np.searchsorted(times, times[-1] - _KEPT_NS)), None)
        self._path = PosePath(
            times[kept],
            np.concatenate([self._path.positions, near.positions])[kept],
            np.concatenate([self._path.quaternions_xyzw, near.quaternions_xyzw])[kept],
        )
        return self._path
