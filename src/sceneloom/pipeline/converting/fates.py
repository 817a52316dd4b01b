"""What became of each field of a scene that was written: what its format always does, and what this writing told."""

from collections.abc import Iterable, Mapping

import msgspec

from sceneloom.formats.holdings import SEVERITY, holding_of
from sceneloom.formats.loss import Fate, Holding, Loss, Supports
from sceneloom.pipeline.converting.field_names import fields_meant
from sceneloom.scene.contents import MODEL_FIELDS

LOSSES = (Fate.APPROXIMATED, Fate.DROPPED)
"""The fates that lose something: what is converted is off by no more than the rounding of its new form."""


class FieldFate(msgspec.Struct, frozen=True, kw_only=True):
    """One field of the source, and what became of it.

    Attributes:
        field: its name out of `MODEL_FIELDS`; the place that a format told of where it is none of them.
        is_: what it is, for a person.
        count: how many objects or frames of the source hold it.
        fate: the worst that happened to one of them.
        how: how they were converted or approximated, or why they were dropped; empty where all are kept.
        largest_error: how far the worst value is off, in the unit that `how` names; None where that means nothing.
    """

    field: str
    is_: str = msgspec.field(name="is")
    count: int
    fate: Fate
    how: tuple[str, ...] = ()
    largest_error: float | None = None


def field_fates(
    contents: Mapping[str, int], supports: Supports, losses: Iterable[Loss], kinds: Mapping[str, str]
) -> tuple[FieldFate, ...]:
    """Say of every field that a scene holds what became of it.

    Args:
        contents: how many objects or frames hold each field.
        supports: what the format does with each field, whatever the scene.
        losses: what the writing told.
        kinds: of the scene's sensors and annotations, as `kinds_by_id` gives them.

    Returns:
        One for each field of `contents`, then one for each loss that is about none of them.
    """
    told: dict[str, list[Loss]] = {}
    for loss in losses:
        meant = [field for field in fields_meant(loss.field, kinds) if field in contents]
        for field in meant or [loss.field]:
            told.setdefault(field, []).append(loss)
    known = [
        _fate(field, count, holding_of(supports, field), told.pop(field, []))
        for field, count in contents.items()
    ]
    return (*known, *(_beside(place, lines) for place, lines in told.items()))


def lost(fates: Iterable[FieldFate]) -> tuple[FieldFate, ...]:
    """Those that are not wholly in the target."""
    return tuple(fate for fate in fates if fate.fate in LOSSES)


def _fate(field: str, count: int, holding: Holding | None, lines: list[Loss]) -> FieldFate:
    fates = [Fate.KEPT if line.kept else line.fate for line in lines]
    how = [_said(line, field) for line in lines]
    if holding is not None:
        fates.append(holding.fate)
        how += [holding.how] if holding.how and holding.how not in {line.what for line in lines} else []
    return FieldFate(
        field=field,
        is_=MODEL_FIELDS.get(field, ""),
        count=count,
        fate=max(fates, key=SEVERITY.__getitem__, default=Fate.KEPT),
        how=tuple(dict.fromkeys(how)),
        largest_error=max(
            (line.largest_error for line in lines if line.largest_error is not None), default=None
        ),
    )


def _beside(place: str, lines: list[Loss]) -> FieldFate:
    return _fate(place, sum(line.count for line in lines), None, lines)


def _said(line: Loss, field: str) -> str:
    """What happened, and where unless that is what the field is called."""
    place = "" if line.field == field else f"{line.field}: "
    times = f" ({line.count} times)" if line.count > 1 else ""
    return f"{place}{line.what}{times}" + (f"; it is in {line.kept}" if line.kept else "")
