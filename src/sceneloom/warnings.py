"""Data warnings (what was assumed, repaired or left out while reading or writing) and findings of the checks.

Each with its location.
"""

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


def assumed(code: str, location: str, message: str, *, count: int = 1) -> DataWarning:
    """A warning that something is not stated and was assumed."""
    return DataWarning(kind=WarningKind.ASSUMED, code=code, location=location, message=message, count=count)


def repaired(code: str, location: str, message: str, *, count: int = 1) -> DataWarning:
    """A warning that something was brought into order."""
    return DataWarning(kind=WarningKind.REPAIRED, code=code, location=location, message=message, count=count)


def skipped(code: str, location: str, message: str, *, count: int = 1) -> DataWarning:
    """A warning that something was left out."""
    return DataWarning(kind=WarningKind.SKIPPED, code=code, location=location, message=message, count=count)


class Severity(StrEnum):
    """How bad it is."""

    ERROR = "error"
    """Programs will refuse the scene, or compute something wrong from it."""
    WARNING = "warning"
    """Probably a mistake; a person should look."""
    HINT = "hint"
    """Allowed, and still worth knowing."""


class Finding(msgspec.Struct, frozen=True, kw_only=True):
    """One thing that a rule found.

    Attributes:
        rule: id of the rule, kebab case ("quaternion-norm").
        severity: how bad it is.
        path: where, in the words of the file (`sensors[3].frames[12].points.colors`).
        message: what was found, with the value, and what was expected.
        remedy: what a person can do about it.
        count: how often it was found there, where one finding stands for several.
        fixable: whether `sceneloom validate --fix` repairs it.
    """

    rule: str
    severity: Severity
    path: str
    message: str
    remedy: str
    count: int = 1
    fixable: bool = False
