"""What became of each field of a scene that was written: what its format always does.

And what this writing reported.
"""

from collections.abc import Iterable, Mapping

import msgspec

from sceneloom.formats.loss import Holding, Loss, Support, Supports
from sceneloom.formats.supported_fields import SEVERITY, holding_of
from sceneloom.pipeline.converting.field_names import fields_meant
from sceneloom.scene.contents import MODEL_FIELDS

LOSSES = (Support.APPROXIMATED, Support.DROPPED)
"""The supports that lose something: what is converted is off by no more than the rounding of its new form."""


class FieldSupport(msgspec.Struct, frozen=True, kw_only=True):
    """One field of the source, and what became of it.

    Attributes:
        field: its name out of `MODEL_FIELDS`; the location that a format reported where it is none of them.
        is_: what it is, for a person.
        count: how many objects or frames of the source hold it.
        support: the worst that happened to one of them.
        how: how they were converted or approximated, or why they were dropped; empty where all are kept.
        largest_error: how far the worst value is off, in the unit that `how` names; None where that means nothing.
    """

    field: str
    is_: str = msgspec.field(name="is")
    count: int
    support: Support
    how: tuple[str, ...] = ()
    largest_error: float | None = None


def field_supports(
    contents: Mapping[str, int], supports: Supports, losses: Iterable[Loss], kinds: Mapping[str, str]
) -> tuple[FieldSupport, ...]:
    """Report of every field that a scene holds what became of it.

    Args:
        contents: how many objects or frames hold each field.
        supports: what the format does with each field, whatever the scene.
        losses: what the writing reported.
        kinds: of the scene's sensors and annotations, as `kinds_by_id` gives them.

    Returns:
        One for each field of `contents`, then one for each loss that is about none of them.
    """
    reported: dict[str, list[Loss]] = {}
    for loss in losses:
        meant = [field for field in fields_meant(loss.field, kinds) if field in contents]
        for field in meant or [loss.field]:
            reported.setdefault(field, []).append(loss)
    known = [
        _support(field, count, holding_of(supports, field), reported.pop(field, []))
        for field, count in contents.items()
    ]
    return (*known, *(_beside(location, lines) for location, lines in reported.items()))


def lost(supports: Iterable[FieldSupport]) -> tuple[FieldSupport, ...]:
    """Those that are not wholly in the target."""
    return tuple(support for support in supports if support.support in LOSSES)


def _support(field: str, count: int, holding: Holding | None, lines: list[Loss]) -> FieldSupport:
    supports = [Support.KEPT if line.kept else line.support for line in lines]
    how = [_stated(line, field) for line in lines]
    if holding is not None:
        supports.append(holding.support)
        how += [holding.how] if holding.how and holding.how not in {line.what for line in lines} else []
    return FieldSupport(
        field=field,
        is_=MODEL_FIELDS.get(field, ""),
        count=count,
        support=max(supports, key=SEVERITY.__getitem__, default=Support.KEPT),
        how=tuple(dict.fromkeys(how)),
        largest_error=max(
            (line.largest_error for line in lines if line.largest_error is not None), default=None
        ),
    )


def _beside(location: str, lines: list[Loss]) -> FieldSupport:
    return _support(location, sum(line.count for line in lines), None, lines)


def _stated(line: Loss, field: str) -> str:
    """What happened, and where unless that is what the field is called."""
    location = "" if line.field == field else f"{line.field}: "
    times = f" ({line.count} times)" if line.count > 1 else ""
    return f"{location}{line.what}{times}" + (f"; it is in {line.kept}" if line.kept else "")
