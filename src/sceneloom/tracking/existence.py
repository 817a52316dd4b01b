r"""How likely it is that an object is there, from moment to moment.

The probability p that an object exists falls with time, as objects leave, p ← p exp(-t / lifetime). A box of the object
with the probability s of its own moment, where π is the prior one, changes the odds of p by

    odds ← odds · ([s / (1 - s)] / [π / (1 - π)])ʷ,

and a moment without any box, where detectors had the chances D to find it, by

    odds ← odds · ((1 - D_2d) (1 - D_3d))ʷ.

The exponent w is below 1 since moments are not independent: what was mistaken or hidden once is likely to be again.

Source: Thrun, Burgard and Fox 2005, "Probabilistic Robotics", ch. 4.2 for log odds; Musicki, Evans and Stankovic 1994,
"Integrated Probabilistic Data Association", for existence that is lost with time and by missed detections.
"""

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.detections.outlines import Outlines
from sceneloom.tracking.settings import TrackerSettings


def probabilities(log_odds: Float64Array) -> Float64Array:
    """Give logarithms of odds as probabilities."""
    shares: Float64Array = 1.0 / (1.0 + np.exp(-log_odds))
    return shares


def log_odds(share: float) -> float:
    """Give a probability between 0 and 1 as a logarithm of odds."""
    with np.errstate(divide="ignore"):
        return float(np.log(share) - np.log1p(-share))


def aged(odds: Float64Array, seconds: float, lifetime: float) -> Float64Array:
    """Logarithms of odds after so long without a look."""
    likely = probabilities(odds) * np.exp(-seconds / lifetime)
    older: Float64Array = np.log(likely / (1.0 - likely)) if seconds > 0.0 else odds
    return older


def missed(lines: Outlines, distances: Float64Array, settings: TrackerSettings) -> Float64Array:
    """How little it says of each object that neither detector finds it, by what one camera sees: logarithms of 1 - D.

    Args:
        lines: where the image shows the objects, and how openly.
        distances: (N,) float64 [m], from the lidar.
        settings: what the detectors find.

    Returns:
        (N, 2) float64, of images and of sweeps.
    """
    corners = lines.corners_xyxy
    tall = corners[:, 3] - corners[:, 1] >= settings.least_height_px
    near = distances < settings.farthest_3d
    recalls = np.column_stack([settings.recall_2d * tall, settings.recall_3d * near])
    chances: Float64Array = np.log1p(-recalls * lines.seen_shares[:, None])
    return chances
