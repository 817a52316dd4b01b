"""What each format that can be written would make of the drive, by the fields that it holds."""

import msgspec

from sceneloom.formats.listing import list_formats, list_holdings
from sceneloom.formats.loss import Fate
from sceneloom.scene.counting import contents_of
from sceneloom.scene.scene import Scene


class Conversion(msgspec.Struct, frozen=True, kw_only=True):
    """One format.

    Attributes:
        format: its name.
        fates: how many of the fields that the drive holds are kept, converted, approximated, dropped.
        dropped: names of those that it has no place for.
        approximated: names of those that are replaced by something near.
    """

    format: str
    fates: dict[str, int]
    dropped: tuple[str, ...] = ()
    approximated: tuple[str, ...] = ()


def conversions_of(scene: Scene) -> tuple[Conversion, ...]:
    """Look up what becomes of the fields that a scene holds; only the first frame of each sensor is read."""
    fields = list(contents_of(scene))
    return tuple(
        _conversion(form.name, fields) for form in list_formats() if form.writes and not form.trajectory
    )


def _conversion(name: str, fields: list[str]) -> Conversion:
    holdings = list_holdings(name)
    fates = {field: holdings[field].fate if field in holdings else Fate.DROPPED for field in fields}
    return Conversion(
        format=name,
        fates={str(fate): sum(found is fate for found in fates.values()) for fate in Fate},
        dropped=tuple(field for field, fate in fates.items() if fate is Fate.DROPPED),
        approximated=tuple(field for field, fate in fates.items() if fate is Fate.APPROXIMATED),
    )
