"""What was assumed, repaired or left out while a scene was made, each with its location."""

from enum import StrEnum

import msgspec


class WarningKind(StrEnum):
    """What happened to the data."""

    ASSUMED = "assumed"
    """The source leaves it open; this reading was taken."""
    REPAIRED = "repaired"
    """The source is slightly wrong; it was brought into order."""
    SKIPPED = "skipped"
    """Something was left out."""


class DataWarning(msgspec.Struct, frozen=True, kw_only=True):
    """One note about the data, to be shown to a person and counted by a machine.

    Attributes:
        code: a short stable name, kebab case ("lines-sorted").
        location: file and line, or the path inside the data.
        message: what was found and what was done.
        count: how many times.
    """

    kind: WarningKind
    code: str
    location: str
    message: str
    count: int = 1
