"""Settings of detection fusion, with the tables of existence probability and box noise.

A score names the logarithm of odds x. What comes true of boxes with such scores is fitted to data with few numbers,
all of which grow with the scores (`detectors` names them, `fitting` fits them, `kernels.existence`
computes):

    log odds(e | box of the sweep)       = a + b x
    log odds(e | boxes of both)          = a' + b' x + c' y + d' (IoU - 0.7)
    log odds(e | box of the sweep alone) = a + b x + log(1 - D v),

D the share of objects shown openly that the detector of images finds, v how openly the image shows the location: in
full from some height in pixels and some seen share on, not at all for what is tiny, hidden or out of the image. A
score that is no number carries no information.

A camera may be worse than it was when D was fitted: by night, in rain, or with another network behind it. So D is of
two kinds, with the odds w that an image is of the poor kind (recall D') or not, by all other objects of the sweep:
each sure one that has no box speaks for the poor kind, each one that has a box against it,

    log w = log w₀ + Σ_found p log(D' / D) + Σ_missed log[(1 - p D' v) / (1 - p D v)],

p how likely each object is by its sweep. With an empty image of many sure objects missing boxes state little at all.

Source: Platt 1999, "Probabilistic Outputs for Support Vector Machines", for scores as logistic functions; Thrun,
Burgard and Fox 2005, "Probabilistic Robotics", ch. 4.2, for log odds. `independent` derives the form from Bayes'
theorem.

Deviations along the axes of a box and of its sizes fall with the score and grow with the range,

    σ = exp(base + by_score x + by_range log(range / 20 m)),

fitted for each class (`detectors.BoxNoise`); a class without numbers of its own has those of its family, in proportion
to its usual size. What a detector reports counts instead where it is a covariance: finite, with variances
above 0.

Errors have heavier tails than a Gaussian's: one car in twenty is longer by half a metre than the box of its visible
half. So the matrices go with a Student distribution of `Detectors.degrees_of_freedom` ν: the region that holds the
share p of the errors e is eᵀ C⁻¹ e <= 3 F (ν - 2) / ν, F the quantile of the F distribution with 3 and ν.
"""

import math
import tomllib
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import msgspec
import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array, read_only
from sceneloom.detections.detectors import (
    DEFAULT,
    FOLDER,
    INDEPENDENT,
    KINDS,
    ClassStatistics,
    Detectors,
    detector_names,
    independent_detectors,
    kind_name,
)
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.files import read_settings
from sceneloom.kernels import box_fusion
from sceneloom.kernels import existence as columns


def read_detectors(path: str | Path) -> Detectors:
    """Read the statistics of detectors.

    Raises:
        DataError: the file cannot be read, or is faulty.
    """
    try:
        raw = tomllib.loads(read_settings(Path(path)).decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise DataError(path, "", f"{error}; expected the TOML of detectors") from None
    try:
        found = msgspec.convert(raw, _File)
    except (msgspec.ValidationError, OverflowError) as error:
        raise DataError(path, "", f"{error}; expected the numbers of detectors") from None
    for location, problem in _faults(found):
        raise DataError(path, location, problem)
    return Detectors(
        name=found.name,
        classes=MappingProxyType({kind_name(name): statistics for name, statistics in found.classes.items()}),
        otherwise=kind_name(found.otherwise),
        degrees_of_freedom=found.degrees_of_freedom,
        provenance=MappingProxyType(found.provenance),
    )


class _File(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The file's own form."""

    name: str
    otherwise: str
    classes: dict[str, ClassStatistics]
    degrees_of_freedom: float = float("inf")
    provenance: dict[str, str] = {}


def _faults(found: _File) -> Iterator[tuple[str, str]]:
    """Locations and what is wrong there."""
    if found.otherwise not in found.classes:
        yield "otherwise", f"{found.otherwise!r}; expected one of {', '.join(found.classes)}"
    if not found.degrees_of_freedom > 2.0:
        yield "degrees_of_freedom", f"{found.degrees_of_freedom}; expected more than 2"
    for name, own in found.classes.items():
        if kind_name(name) not in KINDS:
            yield f"classes.{name}", f"no known class; expected one of {', '.join(KINDS)}"
        for location, value in _numbers(asdict(own), f"classes.{name}"):
            if not math.isfinite(value):
                yield location, f"{value}; expected a finite number"
        visibility = own.visibility
        for key in ("recall_2d", "recall_3d", "weak_recall_2d", "weak_share", "seen_share", "prior"):
            value = getattr(visibility, key)
            if not 0.0 <= value <= 1.0 or (key == "prior" and value in {0.0, 1.0}):
                yield f"classes.{name}.visibility.{key}", f"{value}; expected 0 to 1"
        if not all(0.0 <= share <= 1.0 for share in own.noise.lasting):
            yield f"classes.{name}.noise.lasting", f"{list(own.noise.lasting)}; expected 0 to 1"


def _numbers(value: Any, location: str) -> Iterator[tuple[str, float]]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _numbers(inner, f"{location}.{key}")
    elif isinstance(value, (tuple, list)):
        for k, inner in enumerate(value):
            yield from _numbers(inner, f"{location}[{k}]")
    elif isinstance(value, (int, float)):
        yield location, float(value)


def find_detectors(name: str | Detectors) -> Detectors:
    """Find detectors by their name, or by the path of a file; what is known of some stays as it is.

    Raises:
        OptionError: there are none of that name, and no such file.
        DataError: the file is faulty.
    """
    if isinstance(name, Detectors):
        return name
    if name == INDEPENDENT:
        return independent_detectors()
    if name in detector_names():
        return _read_kept(FOLDER / f"{name}.toml")
    path = Path(name)
    if path.suffix != ".toml" and not path.is_file():
        known = ", ".join(detector_names())
        raise OptionError(f"detectors {name!r}; expected one of {known}, or the path of a TOML file")
    return read_detectors(path)


_read_kept = lru_cache(maxsize=16)(read_detectors)


_SUREST = 0.9995  # no detector finds a larger share than this

_LEAST = 1e-3


def existence_table(
    detectors: Detectors, *, recall_2d: float | None = None, recall_3d: float | None = None
) -> Float64Array:
    """The table that the compiled formulas of existence take: (K + 1, COLUMNS) float64 of `kernels.existence`.

    It has a row for each class of `detectors.KINDS` and a last one for whatever else there is. `recall_2d` and
    `recall_3d` replace those of the detectors; 0 where the other one's silence shall state nothing.
    """
    rows = [_row(statistics_of(detectors, name), recall_2d, recall_3d) for name in (*KINDS, "")]
    return read_only(np.array(rows))


def statistics_of(detectors: Detectors, name: str) -> ClassStatistics:
    """The statistics of a class; where there are none, those of a class of its family, else of `otherwise`."""
    if name in detectors.classes:
        return detectors.classes[name]
    family = KINDS[name].family if name in KINDS else None
    relatives = [other for other in detectors.classes if other in KINDS and KINDS[other].family == family]
    return detectors.classes[relatives[0] if relatives else detectors.otherwise]


def _row(own: ClassStatistics, recall_2d: float | None, recall_3d: float | None) -> Float64Array:
    visibility, row = own.visibility, np.empty(columns.COLUMNS)
    found_2d = visibility.recall_2d if recall_2d is None else recall_2d
    poorly_2d = visibility.weak_recall_2d if recall_2d is None else recall_2d
    row[columns.PRIOR] = math.log(visibility.prior / (1.0 - visibility.prior))
    for first, reported in ((columns.SWEEP_LOW, own.sweep), (columns.IMAGE_LOW, own.image)):
        row[first : first + 4] = reported.low, reported.high, reported.base, reported.slope
    both = own.both
    row[columns.BOTH_BASE : columns.BOTH_OVERLAP + 1] = both.base, both.sweep, both.image, both.overlap
    row[columns.RECALL_2D] = min(found_2d, _SUREST)
    row[columns.WEAK_RECALL_2D] = min(poorly_2d, _SUREST)
    # a missing detection that carries no information says nothing about the camera, either
    row[columns.WEAK_SHARE] = visibility.weak_share if found_2d > poorly_2d else 0.0
    row[columns.LOW_PX], row[columns.HIGH_PX] = visibility.heights_px
    row[columns.SEEN_SHARE] = max(visibility.seen_share, _LEAST)
    row[columns.RECALL_3D] = min(visibility.recall_3d if recall_3d is None else recall_3d, _SUREST)
    row[columns.FARTHEST_3D] = visibility.farthest_3d
    return row


def noise_table(detectors: Detectors) -> Float64Array:
    """The table that `box_covariances` takes: (K + 1, COLUMNS) float64 of `kernels.box_fusion`.

    It has a row for each class of `detectors.KINDS` and a last one for whatever else there is.
    """
    rows = []
    for name in (*KINDS, ""):
        own, growth = statistics_of(detectors, name), np.zeros(3)
        source = next(other for other, statistics in detectors.classes.items() if statistics is own)
        if name in KINDS and source in KINDS and name not in detectors.classes:
            # logarithms of how much larger the class is than the one whose numbers it has, along each axis
            growth = np.log(np.array(KINDS[name].size_lwh) / np.array(KINDS[source].size_lwh))
        rows.append(_noise_row(own, growth))
    return read_only(np.array(rows))


def _noise_row(own: ClassStatistics, growth: Float64Array) -> Float64Array:
    noise, row = own.noise, np.empty(box_fusion.COLUMNS)
    row[box_fusion.LOW], row[box_fusion.HIGH] = noise.scores
    for first, (centers, sizes, yaw) in (
        (box_fusion.BASE, (noise.center_base + growth, noise.size_base + growth, noise.yaw[0])),
        (box_fusion.BY_SCORE, (noise.center_by_score, noise.size_by_score, noise.yaw[1])),
        (box_fusion.BY_RANGE, (noise.center_by_range, noise.size_by_range, noise.yaw[2])),
    ):
        row[first : first + 7] = *centers, *sizes, yaw
    row[box_fusion.AGREED : box_fusion.AGREED + 2] = noise.agreed
    reported = own.image_noise
    row[box_fusion.IMAGE : box_fusion.IMAGE + 6] = *reported.across, *reported.upright, *reported.height
    return row


def image_sigmas(table: Float64Array, kinds: Int64Array, *, added_px: float = 0.0) -> Float64Array:
    """How far off boxes of images are, (N, 6), by the rows of the table.

    `added_px` is the deviation of locations in the image by a calibration that is not exact [px].
    """
    sigmas: Float64Array = table[kinds, box_fusion.IMAGE :]
    if added_px > 0.0:
        for column in (0, 2):
            sigmas[:, column] = np.sqrt(sigmas[:, column] ** 2 + added_px**2)
    return sigmas


def box_covariances(
    boxes: Float64Array,
    scores: Float64Array,
    reported: Float64Array,
    rows: Int64Array,
    kinds: Int64Array,
    table: Float64Array,
) -> tuple[Float64Array, Float64Array, BoolArray]:
    """The covariances of middles and sizes of boxes, and the variances of headings.

    Args:
        boxes: (N, 7), middle, size [m] and heading [rad], in the frame of the sensor.
        scores: (N,), logarithms of odds as the detector reports them; NaN for no numbers.
        reported: covariances of the detector, (A, 7, 7) of all of its boxes, or (0, 7, 7).
        rows: (N,), which of them these are.
        kinds, table: (N,) rows of the table, and the (K, COLUMNS) table.

    Returns:
        (N, 6, 6) float64 [m²]: middle in the frame of the boxes, then length, width, height; (N,) float64 [rad²], and
        (N,) bool, whether they are the detector's own.
    """
    found, of_yaws = box_fusion.usual_covariances(boxes, scores, kinds, table)
    own = np.zeros(len(boxes), np.bool_)
    if len(reported):
        # halves first: no sum of finite numbers is infinite then
        halves = reported[rows, :6, :6] / 2.0
        symmetric = halves + halves.transpose(0, 2, 1)
        own = np.asarray(np.isfinite(symmetric).all(axis=(1, 2)))
        for k in np.flatnonzero(own).tolist():
            try:
                np.linalg.cholesky(symmetric[k])
            except np.linalg.LinAlgError:  # not positive definite
                own[k] = False
        found[own] = symmetric[own]
        yaws_reported = reported[rows, 6, 6]
        known = own & (yaws_reported > 0.0) & np.isfinite(yaws_reported)
        of_yaws[known] = yaws_reported[known]
    return found, of_yaws, own


def radius_squared(level: float, *, degrees_of_freedom: float, dimensions: int = 3) -> float:
    """How large eᵀ C⁻¹ e is on the border of the region that holds the share `level` of the errors e.

    `degrees_of_freedom` are those of `Detectors`, more than 2; infinite for a Gaussian.

    Source: Kotz and Nadarajah 2004, "Multivariate t Distributions and Their Applications", section 1.7.
    """
    from scipy import stats

    if math.isinf(degrees_of_freedom):
        return float(stats.chi2.ppf(level, dimensions))
    share = (degrees_of_freedom - 2.0) / degrees_of_freedom
    return float(dimensions * stats.f.ppf(level, dimensions, degrees_of_freedom) * share)


@dataclass(frozen=True, slots=True, kw_only=True)
class ProjectionSettings:
    """What `fuse_by_projection` takes for granted.

    Attributes:
        detectors: how often detectors are right, and how far off: `Detectors`, a name out of `detector_names()`, or the
            path of a file.
        least_iou: boxes that overlap less in the image than this are not one object, 0 to 1.
        recall_2d, recall_3d: share of the objects in its view that the detector of images and that of sweeps finds, 0
            to 1 (excluded), for all classes; 0 where its silence shall state nothing. [default: by `detectors`]
        keep_camera_only: whether boxes of the image without one in the sweep become objects.
        rotation_sigma_deg: how well the rotation from lidar to camera is known, beyond what images of such detectors
            show anyway [°].
        time_sigma: how well the time of a box is known; objects with a velocity are as uncertain along it [s].

    Raises:
        OptionError: a number is out of bounds.
    """

    detectors: str | Detectors = DEFAULT
    least_iou: float = 0.3
    recall_2d: float | None = None
    recall_3d: float | None = None
    keep_camera_only: bool = True
    rotation_sigma_deg: float = 0.0
    time_sigma: float = 0.0

    def __post_init__(self) -> None:
        for name, (low, high) in _BOUNDS.items():
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise OptionError(f"{name} {value!r}; expected {low:g} to {high:g}")


_BOUNDS = {
    "least_iou": (0.0, 1.0),
    "recall_2d": (0.0, 0.999),
    "recall_3d": (0.0, 0.999),
    "rotation_sigma_deg": (0.0, 90.0),
    "time_sigma": (0.0, float("inf")),
}


class Tables(NamedTuple):
    """What detectors are like, as compiled formulas take it.

    Attributes:
        existence: columns of `kernels.existence`.
        noise: columns of `kernels.box_fusion`.
        degrees_of_freedom: of errors.
    """

    existence: Float64Array
    noise: Float64Array
    degrees_of_freedom: float


@lru_cache(maxsize=64)
def tables_of(settings: ProjectionSettings) -> Tables:
    """The tables of some settings.

    Raises:
        OptionError: no detectors have that name.
        DataError: their file is faulty.
    """
    detectors = find_detectors(settings.detectors)
    existence = existence_table(detectors, recall_2d=settings.recall_2d, recall_3d=settings.recall_3d)
    return Tables(existence, noise_table(detectors), detectors.degrees_of_freedom)
