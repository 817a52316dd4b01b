"""What a format makes of each field of the scene, whatever the scene: looked up by the field's name.

A format says it in a table, `FORMAT.holds`, whose keys are names of `MODEL_FIELDS` or beginnings of them that end at a
dot; the longest that fits counts, and "" is for all the rest.
"""

from collections.abc import Mapping

from sceneloom.formats.loss import Fate, Holding
from sceneloom.scene.contents import MODEL_FIELDS

Holds = Mapping[str, Holding]
"""Names of fields, or beginnings of them, and what becomes of these."""

SEVERITY: Mapping[Fate, int] = {fate: rank for rank, fate in enumerate(Fate)}
"""How much of a field a fate takes away: the fates are listed in this order."""


def holding_of(holds: Holds, field: str) -> Holding | None:
    """Give what a table says of a field: its own row, else that of the longest beginning; None if it says nothing."""
    name = field
    while name:
        if name in holds:
            return holds[name]
        name = name.rpartition(".")[0]
    return holds.get("")


def unknown_names(holds: Holds) -> list[str]:
    """Give the keys of a table that are neither a field of the model nor a beginning of one: slips of the pen."""
    known = {""}
    for field in MODEL_FIELDS:
        parts = field.split(".")
        known.update(".".join(parts[:count]) for count in range(1, len(parts) + 1))
    return [name for name in holds if name not in known]
