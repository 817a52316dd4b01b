"""What a format makes of each field of the scene, whatever the scene: looked up by the field's name.

A format says it in a table, `FormatSpec.supports`, whose keys are names of `MODEL_FIELDS` or beginnings of them; the
longest that fits counts, and "" is for all the rest.
"""

from collections.abc import Mapping

from sceneloom.formats.loss import Holding, Support, Supports
from sceneloom.scene.contents import MODEL_FIELDS

SEVERITY: Mapping[Support, int] = {support: rank for rank, support in enumerate(Support)}
"""How much of a field a support takes away: the supports are listed in this order."""


def holding_of(supports: Supports, field: str) -> Holding | None:
    """Give what a table says of a field: its own row, else that of the longest beginning; None if it says nothing."""
    name = field
    while name:
        if name in supports:
            return supports[name]
        name = name.rpartition(".")[0]
    return supports.get("")


def unknown_names(supports: Supports) -> list[str]:
    """Give the keys of a table that are neither a field of the model nor a beginning of one: slips of the pen."""
    known = {""}
    for field in MODEL_FIELDS:
        parts = field.split(".")
        known.update(".".join(parts[:count]) for count in range(1, len(parts) + 1))
    return [name for name in supports if name not in known]
