"""The fit as a whole: examples in, `Detectors` out."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from sceneloom.detections.classes import KINDS
from sceneloom.detections.detectors import ClassStatistics, Detectors
from sceneloom.detections.fitting.examples import IGNORED, Columns, LabelledPair, columns_of
from sceneloom.detections.fitting.existence_fit import SUREST_2D, fit_agreement, fit_reported, fit_visibility
from sceneloom.detections.fitting.noise_fit import fit_image_noise, fit_noise, widened
from sceneloom.errors import OptionError


@dataclass(frozen=True, slots=True, kw_only=True)
class FitSettings:
    """How detectors are fitted.

    Attributes:
        overlap: in space, from which on a box is true.
        surest_3d: scores of sweeps are held at these logarithms of odds at the most.
        least_count: classes with fewer boxes that are true or false get no numbers of their own.
        degrees_of_freedom: of the Student distribution of errors.
        weak_recall_2d, weak_share: how poorly a camera may do, and in what share of images; drives by day do not state.
        otherwise: class whose numbers hold for words that no table has. [default: the class with the most boxes]
    """

    overlap: float = 0.5
    surest_3d: float = float("inf")
    least_count: int = 200
    degrees_of_freedom: float = 5.0
    weak_recall_2d: float = 0.7
    weak_share: float = 0.1
    otherwise: str | None = None


DEFAULTS = FitSettings()


def fit_detectors(
    examples: Iterable[LabelledPair],
    *,
    name: str,
    settings: FitSettings = DEFAULTS,
    provenance: Mapping[str, str] | None = None,
) -> Detectors:
    """Fit what two detectors are like to drives of which the truth is known.

    Widths of regions are fitted by leaving out one group after the other, since errors of one drive are alike.

    Args:
        examples: of several groups, best ten or more, in which the detectors did not learn.
        name: of the detectors.
        settings: how.
        provenance: where the examples are from; kept with the numbers.

    Raises:
        OptionError: no class has enough boxes.
    """
    columns = columns_of(examples, overlap=settings.overlap)
    return fit_columns(columns, name=name, settings=settings, provenance=provenance)


def fit_columns(
    columns: Columns,
    *,
    name: str,
    settings: FitSettings = DEFAULTS,
    provenance: Mapping[str, str] | None = None,
) -> Detectors:
    """Fit what two detectors are like to examples that were held against the truth; else as `fit_detectors`."""
    names = tuple(KINDS)
    judged = columns.sweep.kind[columns.sweep.verdict != IGNORED]
    counts = np.bincount(judged, minlength=len(names))[: len(names)]
    kinds = [k for k, count in enumerate(counts.tolist()) if count >= settings.least_count]
    if not kinds:
        raise OptionError(
            f"boxes of one class {counts.max(initial=0)}; expected {settings.least_count} or more"
        )
    classes = {names[kind]: _fit_class(columns, kind, settings) for kind in kinds}
    draft = Detectors(
        name=name,
        classes=MappingProxyType(classes),
        otherwise=settings.otherwise or names[max(kinds, key=lambda kind: int(counts[kind]))],
        degrees_of_freedom=settings.degrees_of_freedom,
        provenance=MappingProxyType(dict(provenance or {})),
    )
    return widened(columns, draft)


def _fit_class(columns: Columns, kind: int, settings: FitSettings) -> ClassStatistics:
    sweep = type(columns.sweep)(*(column[columns.sweep.kind == kind] for column in columns.sweep))
    image = type(columns.image)(*(column[columns.image.kind == kind] for column in columns.image))
    of_sweep = fit_reported(sweep.reported, sweep.verdict, highest=settings.surest_3d)
    of_image = fit_reported(image.reported, image.verdict, highest=SUREST_2D)
    return ClassStatistics(
        sweep=of_sweep,
        image=of_image,
        both=fit_agreement(sweep, of_sweep, of_image),
        visibility=fit_visibility(
            sweep, image, weak_recall_2d=settings.weak_recall_2d, weak_share=settings.weak_share
        ),
        noise=fit_noise(sweep, of_sweep, settings.degrees_of_freedom),
        image_noise=fit_image_noise(sweep),
    )
