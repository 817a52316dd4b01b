"""What is wrong, doubtful or worth knowing about a scene, each with its location and what to do about it."""

from enum import StrEnum

import msgspec


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
