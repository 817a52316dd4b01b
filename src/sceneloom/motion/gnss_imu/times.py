"""Whether the times of a drive can be those of a drive, before its states are laid out over them."""

import numpy as np

from sceneloom.errors import PoseError
from sceneloom.motion.gnss_imu.fixes import GnssFixes
from sceneloom.motion.gnss_imu.samples import InertialSamples

_LONGEST_PERIOD = 1.0
"""Samples of an IMU farther apart on the whole [s] notify nothing of the motion between them."""
_LONGEST_STEP = 60.0
"""Fixes farther apart on the whole [s] notify of a trajectory only where an IMU leads on between."""
_HINT = "are the times in milliseconds, where seconds are expected?"


def check_times(location: str, fixes: GnssFixes, samples: InertialSamples | None) -> None:
    """Refuse times that are too far apart, such as milliseconds taken for seconds.

    Raises:
        PoseError: samples or fixes lie too far apart.
    """
    if samples is not None and samples.period > _LONGEST_PERIOD:
        raise PoseError(
            f"{location}: samples of the IMU lie {samples.period:.6g} s apart (median); expected at most "
            f"{_LONGEST_PERIOD:g} s: {_HINT}"
        )
    times = fixes.timestamps_ns
    step = float(np.median(np.diff(times))) * 1e-9
    if step <= _LONGEST_STEP:
        return
    if samples is not None and samples.is_measured(times[:-1], times[1:]).any():
        return
    raise PoseError(
        f"{location}: GNSS fixes lie {step:.6g} s apart (median), and no IMU measured between; expected at most "
        f"{_LONGEST_STEP:g} s: {_HINT}"
    )
