"""What was assumed, repaired or left out while a scene was made, each with its place."""

from enum import StrEnum

import msgspec


class NoticeKind(StrEnum):
    """What happened to the data."""

    ASSUMED = "assumed"
    """The source leaves it open; this reading was taken."""
    REPAIRED = "repaired"
    """The source is slightly wrong; it was brought into order."""
    SKIPPED = "skipped"
    """Something was left out."""


class Notice(msgspec.Struct, frozen=True, kw_only=True):
    """One remark about the data, to be shown to a person and counted by a machine.

    Attributes:
        code: a short stable name, kebab case ("lines-sorted").
        place: file and line, or the path inside the data.
        message: what was found and what was done.
        count: how many times.
    """

    kind: NoticeKind
    code: str
    place: str
    message: str
    count: int = 1
