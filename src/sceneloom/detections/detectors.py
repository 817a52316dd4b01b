"""Detector models: matching class names, statistics of each class, independent detectors, and their TOML files.

Words are compared without regard to case, blanks, dashes, dots and underscores. What is in no table is kept as it came.

The numbers are fitted to data (`detections.fitting`) and kept in small files (`detections.detector_files`); this module
says what they mean. A score reports the logarithm of the odds that it names, x = log(s / (1 - s)) of a probability, or
the logit itself, held between `low` and `high`, between which it was seen.

A location where a detector could report something holds an object (e) with the prior probability π. A score is what it
says: of the boxes with the score s the share s is true. By Bayes' theorem a box with the score s has reported

    P(box, s | e) / P(box, s | not e) = [s / (1 - s)] / [π / (1 - π)].

Given what is there, detectors err independently of one another, so the ratios of both multiply:

    odds(e | both) = odds(s_3d) odds(s_2d) / odds(π).

Two false boxes seldom coincide: the smaller π, the more an agreement says. A detector that had to see the
object and reports nothing reports too, with its chance D to find what is there:

    odds(e | box, none) = odds(s) (1 - D),

since where nothing is, it was all but certain to report nothing.

Source: Bayes' theorem under conditional independence: Chen et al. 2022, "Multimodal Object Detection via Probabilistic
Ensembling", eq. 4 for the agreement; Thrun, Burgard and Fox 2005, "Probabilistic Robotics", ch. 4.2 for log odds.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, read_only


class _Kind(NamedTuple):
    """One class of objects."""

    family: str
    words: tuple[str, ...]
    size_lwh: tuple[float, float, float]  # typical [m]
    size_sigmas: tuple[float, float, float]  # standard deviations from one object to the next [m]


_VEHICLES, _PEOPLE = "vehicles", "people"

KINDS: Mapping[str, _Kind] = MappingProxyType(
    {
        "car": _Kind(
            _VEHICLES,
            ("vehicle", "passengercar", "sedan", "suv", "taxi", "policecar", "regularvehicle", "auto"),
            (4.2, 1.8, 1.55),
            (0.5, 0.15, 0.15),
        ),
        "van": _Kind(_VEHICLES, ("minivan", "pickup", "pickuptruck"), (5.0, 1.95, 2.1), (0.7, 0.15, 0.3)),
        "truck": _Kind(
            _VEHICLES,
            ("lorry", "boxtruck", "truckcab", "semitruck", "largevehicle", "constructionvehicle"),
            (9.0, 2.5, 3.2),
            (3.0, 0.3, 0.5),
        ),
        "bus": _Kind(_VEHICLES, ("coach", "schoolbus", "articulatedbus"), (11.0, 2.6, 3.3), (2.5, 0.2, 0.3)),
        "trailer": _Kind(_VEHICLES, ("vehiculartrailer",), (10.0, 2.5, 3.5), (3.0, 0.3, 0.7)),
        "tram": _Kind(_VEHICLES, ("train", "streetcar", "railedvehicle"), (16.0, 2.5, 3.5), (6.0, 0.3, 0.3)),
        "pedestrian": _Kind(
            _PEOPLE,
            ("person", "people", "human", "adult", "child", "walker", "personsitting", "stroller"),
            (0.8, 0.65, 1.72),
            (0.25, 0.15, 0.15),
        ),
        "cyclist": _Kind(_PEOPLE, ("bicyclist", "bicycle", "bike", "rider"), (1.75, 0.6, 1.7), (0.2, 0.15, 0.15)),
        "motorcyclist": _Kind(
            _PEOPLE, ("motorcycle", "motorbike", "scooter", "moped"), (2.1, 0.75, 1.6), (0.3, 0.15, 0.2)
        ),
    }
)
"""The classes that are known. A van is often taken for a car and a cyclist for a pedestrian, a bus for neither.

Source: sizes are the means of KITTI's labels, rounded, and common dimensions of road vehicles where it has none.
"""

SAYS_NOTHING = frozenset({"", "unknown", "object", "misc", "other", "generic", "dontcare", "unclassified"})
"""Words by which a detector says that something is there, and not what."""

UNLISTED = len(KINDS)
"""The number of the first class that is in no table, and the row of such classes in tables."""

_OTHERWISE = _Kind("", (), (2.0, 1.2, 1.6), (1.5, 0.6, 0.5))
_NONE = -1

_KIND_OF = {name: name for name in KINDS} | {word: name for name, kind in KINDS.items() for word in kind.words}

_FAMILIES = tuple(dict.fromkeys(kind.family for kind in KINDS.values()))
_DROPPED = str.maketrans("", "", " -_.")

FAMILIES: Int64Array = read_only([*(_FAMILIES.index(kind.family) for kind in KINDS.values()), _NONE], np.int64)
"""(K + 1,), the family of each class of `KINDS`, and -1 for whatever else there is."""

SIZES: Float64Array = read_only([(*kind.size_lwh, *kind.size_sigmas) for kind in (*KINDS.values(), _OTHERWISE)])
"""(K + 1, 6) float64 [m]: usual length, width and height of each class, and how much they differ; of words in no table
wide enough to hold a person and a car."""


@lru_cache(maxsize=4096)
def kind_name(label: str) -> str:
    """The name under which a word is compared: that of its class, or of an unlisted word its letters."""
    plain = label.casefold().translate(_DROPPED)
    return _KIND_OF.get(plain, plain)


def numbers_of(labels_3d: Sequence[str], labels_2d: Sequence[str]) -> tuple[Int64Array, Int64Array]:
    """The classes of two detectors as numbers that can be compared.

    Returns:
        (N,) and (M,) int64, equal for equal classes: their place in `KINDS`, or UNLISTED and more.
    """
    others: dict[str, int] = {}

    def number(label: str) -> int:
        known = _number(label)
        return UNLISTED + others.setdefault(kind_name(label), len(others)) if known is None else known

    return np.array([*map(number, labels_3d)], np.int64), np.array([*map(number, labels_2d)], np.int64)


@lru_cache(maxsize=4096)
def _number(label: str) -> int | None:
    return _NUMBERS.get(kind_name(label))


_NUMBERS = {name: k for k, name in enumerate(KINDS)}


def table_rows(numbers: Int64Array) -> Int64Array:
    """The rows of tables with one row for each of `KINDS` and a last one for whatever else there is."""
    rows: Int64Array = np.minimum(numbers, UNLISTED)
    return rows


_Three = tuple[float, float, float]
_Four = tuple[float, float, float, float]


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
        lasting: share of the variances of middles and of sizes in which the boxes of one object err alike for a second.
    """

    scores: tuple[float, float]
    center_base: _Three
    center_by_score: _Three
    center_by_range: _Three
    size_base: _Three
    size_by_score: _Three
    size_by_range: _Three
    yaw: _Three
    agreed: tuple[float, float] = (1.0, 1.0)
    lasting: tuple[float, float] = (0.4, 0.8)


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageNoise:
    """How far off boxes of images are: a deviation [px], and beside that a share of the box's own size there.

    Attributes:
        across: of the middle, and of the width.
        upright: of the middle, and of the height.
        height: of the height, and of the height.
        usual, spread: what boxes that people draw differ by from outlines of true boxes, mean and deviation: by shifts
            of the middle, as shares of width and height, and logarithms of the factors of both sides.
        error: deviation by which the detector's boxes differ from those, likewise.
    """

    across: tuple[float, float]
    upright: tuple[float, float]
    height: tuple[float, float]
    usual: _Four = (0.0, 0.0, 0.0, 0.0)
    spread: _Four = (0.1, 0.02, 0.2, 0.02)
    error: _Four = (0.05, 0.03, 0.08, 0.05)


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


INDEPENDENT = "independent"

CENTER_SIGMAS = (0.05, 0.03)
"""Deviation of a middle along an axis of its box: this share of its usual size along that axis, plus so much [m]."""

SIZE_SIGMAS = (0.06, 0.04)
"""Deviation of a size: this share of the usual one, plus so much [m]."""

YAW_SIGMA = 0.1
"""Deviation of a heading [rad]."""

BY_RANGE = 0.5
"""Deviations grow with the root of the range."""

IMAGE_SIGMAS = ImageNoise(across=(2.0, 0.03), upright=(2.0, 0.03), height=(2.0, 0.06))
"""Clocks and calibration leave two pixels."""

SUREST = 14.0
"""Scores beyond these logarithms of odds report no more."""


@lru_cache(maxsize=8)
def independent_detectors(
    *, prior: float = 0.1, recall_2d: float = 0.9, recall_3d: float = 0.5, least_height_px: float = 25.0
) -> Detectors:
    """Detectors of whom nothing is known but what they find.

    Args:
        prior: share of the locations at which a detector could report something that hold an object.
        recall_2d, recall_3d: share of the objects in its view that the detector of images and that of sweeps finds.
        least_height_px: what is less high in the image need not have been found there [px].
    """
    heights_px = least_height_px, least_height_px
    visibility = Visibility(
        recall_2d=recall_2d, recall_3d=recall_3d, weak_recall_2d=recall_2d, heights_px=heights_px, prior=prior
    )
    reported = Reported(low=-SUREST, high=SUREST, base=0.0, slope=1.0)
    both = Agreement(base=-math.log(prior / (1.0 - prior)), sweep=1.0, image=1.0, overlap=0.0)

    def logs(sigmas: tuple[float, float], kind: _Kind) -> _Three:
        x, y, z = (math.log(sigmas[0] * side + sigmas[1]) for side in kind.size_lwh)
        return x, y, z

    classes = {
        name: ClassStatistics(
            sweep=reported,
            image=reported,
            both=both,
            visibility=visibility,
            noise=BoxNoise(
                scores=(0.0, 0.0),
                center_base=logs(CENTER_SIGMAS, kind),
                center_by_score=(0.0, 0.0, 0.0),
                center_by_range=(BY_RANGE, BY_RANGE, BY_RANGE),
                size_base=logs(SIZE_SIGMAS, kind),
                size_by_score=(0.0, 0.0, 0.0),
                size_by_range=(BY_RANGE, BY_RANGE, BY_RANGE),
                yaw=(math.log(YAW_SIGMA), 0.0, 0.0),
            ),
            image_noise=IMAGE_SIGMAS,
        )
        for name, kind in KINDS.items()
    }
    provenance = MappingProxyType({"data": "none: scores are taken for probabilities of independent detectors"})
    return Detectors(name=INDEPENDENT, classes=MappingProxyType(classes), otherwise="car", provenance=provenance)


FOLDER = Path(__file__).parent / "fitted"
"""Where the package keeps its files."""

DEFAULT = "simulated"
"""The detectors that are taken for granted: made up, and known exactly."""


def detector_names() -> tuple[str, ...]:
    """Names of the detectors whose numbers come with the package."""
    return (*sorted(path.stem for path in FOLDER.glob("*.toml")), INDEPENDENT)


def format_detectors(detectors: Detectors) -> str:
    """The text of the file of detectors."""
    lines = [
        f"name = {_text(detectors.name)}",
        f"otherwise = {_text(detectors.otherwise)}",
        f"degrees_of_freedom = {_text(detectors.degrees_of_freedom)}",
        "",
        "[provenance]",
        *(f"{key} = {_text(value)}" for key, value in detectors.provenance.items()),
    ]
    for name, own in detectors.classes.items():
        for part, numbers in asdict(own).items():
            lines += ["", f"[classes.{name}.{part}]"]
            lines += [f"{key} = {_text(value)}" for key, value in numbers.items()]
    return "\n".join(lines) + "\n"


def _text(value: Any) -> str:
    if isinstance(value, str):
        return msgspec.json.encode(value).decode()
    if isinstance(value, (tuple, list)):
        return f"[{', '.join(_text(inner) for inner in value)}]"
    number = f"{value:.5g}"
    return number if any(sign in number for sign in ".en") else f"{number}.0"
