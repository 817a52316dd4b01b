"""What each format that can be written would make of the drive, by the fields that it holds."""

import msgspec

from sceneloom.formats.listing import list_formats, list_supported_fields
from sceneloom.formats.loss import Support
from sceneloom.scene.counting import contents_of
from sceneloom.scene.scene import Scene


class Conversion(msgspec.Struct, frozen=True, kw_only=True):
    """One format.

    Attributes:
        format: its name.
        supports: how many of the fields that the drive holds are kept, converted, approximated, dropped.
        dropped: names of those that it has no field for.
        approximated: names of those that are replaced by something near.
    """

    format: str
    supports: dict[str, int]
    dropped: tuple[str, ...] = ()
    approximated: tuple[str, ...] = ()


def conversions_of(scene: Scene) -> tuple[Conversion, ...]:
    """Look up what becomes of the fields that a scene holds; only the first frame of each sensor is read."""
    fields = list(contents_of(scene))
    return tuple(
        _conversion(form.name, fields) for form in list_formats() if form.writes and not form.trajectory
    )


def _conversion(name: str, fields: list[str]) -> Conversion:
    supported_fields = list_supported_fields(name)
    supports = {
        field: supported_fields[field].support if field in supported_fields else Support.DROPPED
        for field in fields
    }
    return Conversion(
        format=name,
        supports={str(support): sum(found is support for found in supports.values()) for support in Support},
        dropped=tuple(field for field, support in supports.items() if support is Support.DROPPED),
        approximated=tuple(field for field, support in supports.items() if support is Support.APPROXIMATED),
    )
