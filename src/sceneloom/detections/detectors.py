"""What two detectors are like: how often they are right, and how far off their boxes are, class by class.

The numbers are fitted to data (`detections.fitting`) and kept in small files (`detections.detector_files`); this module
says what they mean. A score reports the logarithm of the odds that it names, x = log(s / (1 - s)) of a probability, or
the logit itself, held between `low` and `high`, between which it was seen.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

Three = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Reported:
    """What the scores x of one detector come to: a box exists with the odds exp(base + slope x).

    Attributes:
        low, high: between which x is held.
        base, slope: of the logarithm of the odds.
    """

    low: float
    high: float
    base: float
    slope: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Agreement:
    """What two boxes of one object come to: odds exp(base + sweep x + image y + overlap (IoU - 0.7)).

    Attributes:
        base: at scores of 0 and an overlap of 0.7 in the image.
        sweep, image: by the scores x and y of both, each held as `Reported` says.
        overlap: by how well they fit.
    """

    base: float
    sweep: float
    image: float
    overlap: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Visibility:
    """What objects the detectors find.

    Attributes:
        recall_2d: share of the objects shown openly of which the detector of images has a box, 0 to 1 (excluded).
        weak_recall_2d: that share where it works poorly: by night, in rain, or with another network.
        weak_share: share of the images in which it does, 0 for a detector that is always the same.
        heights_px: up to the first height it finds nothing, from the second one on all that it ever does [px].
        seen_share: an object is shown openly from this share of it on.
        recall_3d: share of the objects of which the detector of sweeps has a box, 0 to 1 (excluded).
        farthest_3d: up to here [m].
        prior: share of locations at which a detector could report something that hold an object, for scores that are no
            numbers.
    """

    recall_2d: float
    recall_3d: float
    weak_recall_2d: float = 0.6
    weak_share: float = 0.0
    heights_px: tuple[float, float] = (25.0, 25.0)
    seen_share: float = 1.0
    farthest_3d: float = 70.0
    prior: float = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class BoxNoise:
    """How far off boxes of sweeps are: σ = exp(base + by_score x + by_range log(range / 20 m)) for each number.

    Attributes:
        scores: how low and how high scores x count.
        center_base, center_by_score, center_by_range: of the middle [m], along the length, width and height of the box.
        size_base, size_by_score, size_by_range: of length, width and height [m].
        yaw: base, by score and by range of the heading [rad].
        agreed: by how much the covariances of middles and of sizes are multiplied after an update by the image.
    """

    scores: tuple[float, float]
    center_base: Three
    center_by_score: Three
    center_by_range: Three
    size_base: Three
    size_by_score: Three
    size_by_range: Three
    yaw: Three
    agreed: tuple[float, float] = (1.0, 1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageNoise:
    """How far off boxes of images are: a deviation [px], and beside that a share of the box's own size there.

    Attributes:
        across: of the middle, and of the width.
        upright: of the middle, and of the height.
        height: of the height, and of the height.
    """

    across: tuple[float, float]
    upright: tuple[float, float]
    height: tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class ClassStatistics:
    """What both detectors are like with one class.

    Attributes:
        sweep, image: what the scores of each come to.
        both: what both together come to.
        visibility: what they find.
        noise: how far off boxes of sweeps are.
        image_noise: how far off boxes of images are.
    """

    sweep: Reported
    image: Reported
    both: Agreement
    visibility: Visibility
    noise: BoxNoise
    image_noise: ImageNoise


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Detectors:
    """A detector of sweeps and one of images.

    Attributes:
        name: of the two.
        classes: by name, as in `detections.classes.KINDS`.
        otherwise: name of the class whose numbers hold for words that no table has.
        degrees_of_freedom: of the Student distribution of errors; infinite for a Gaussian one.
        provenance: what the numbers were fitted to, and with what.
    """

    name: str
    classes: Mapping[str, ClassStatistics]
    otherwise: str
    degrees_of_freedom: float = float("inf")
    provenance: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
