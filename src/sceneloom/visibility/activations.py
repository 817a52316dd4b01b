"""When a sensor sees a cuboid: runs of its frames, as the activations of the format."""

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.scene.annotations.cuboids import Activation
from sceneloom.scene.span import usual_period_ns
from sceneloom.scene.types import Identifier


def activation_of(
    sensor_id: Identifier,
    timestamps_ns: Int64Array,
    seen: BoolArray,
    cuboids: Float64Array | None = None,
) -> Activation | None:
    """Give the times in which a sensor sees a cuboid; None where it never does.

    Each begins with a frame that sees it, and lasts until the next frame that does not; after the last frame of all, as
    long as it usually is from frame to frame.

    Args:
        sensor_id: the sensor.
        timestamps_ns: (F,) int64 [ns], its frames in order.
        seen: (F,) bool, which of them see the cuboid.
        cuboids: (F, 9) float64, the cuboid at each frame, to be reported where each time begins.
    """
    steps = np.diff(np.concatenate([[False], seen, [False]]).astype(np.int8))
    first, beyond = np.flatnonzero(steps == 1), np.flatnonzero(steps == -1)
    if len(first) == 0:
        return None
    end_ns = min(int(timestamps_ns[-1]) + int(usual_period_ns(timestamps_ns)), 2**63 - 1)
    stops = np.append(timestamps_ns, np.int64(end_ns))[beyond]
    return Activation(
        sensor_id,
        timestamps_ns[first],
        tuple((stops - timestamps_ns[first]).view(np.uint64).tolist()),  # which holds any difference
        None if cuboids is None else cuboids[first],
    )
