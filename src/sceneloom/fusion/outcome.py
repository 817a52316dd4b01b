"""What an interface of the standard answers: 1 for done, 0 for failed, and why."""

from dataclasses import dataclass
from enum import StrEnum


class Cause(StrEnum):
    """Why something was refused, for programs; the reason beside it is for people."""

    NONE = ""
    KNOWN_NAME = "known-name"
    """A property of that name is there already."""
    UNKNOWN_NAME = "unknown-name"
    """There is no property of that name."""
    ILL_TYPED = "ill-typed"
    """A value or a type that is none of table 1, or not the one that was declared."""
    OUT_OF_RANGE = "out-of-range"
    """A value of the right type that the property cannot take."""
    TOO_MANY = "too-many"
    """A limit on the number or size of things is reached."""
    BAD_RECORD = "bad-record"
    """A field of a record is missing, wrong or contradicts another."""
    BAD_CALIBRATION = "bad-calibration"
    """Numbers that are no camera model or no rigid transform."""
    NO_CALIBRATION = "no-calibration"
    """A sensor of which no calibration is known."""
    UNKNOWN_SENSOR = "unknown-sensor"
    """A sensor that is not declared, or as another kind."""
    DUPLICATE = "duplicate"
    """The sensor has sent that sequence number already."""
    TIME_BACKWARDS = "time-backwards"
    """A record older than what was fused already."""
    QUEUE_FULL = "queue-full"
    """A queue is full and its policy is to refuse."""
    UNKNOWN_ALGORITHM = "unknown-algorithm"
    """No algorithm of that name is installed."""
    BAD_MOTION = "bad-motion"
    """Poses that are no path."""
    CLOSED = "closed"
    """The session has ended."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """The answer of a call that does something.

    Attributes:
        status: 1 done, 0 failed.
        cause: why it failed, for programs.
        reason: why it failed, for people: the value, and what was expected.

    Source: DB34/T 4101-2022, clauses 5.3.3, 5.4.3 and 5.6.3.
    """

    status: int
    cause: Cause = Cause.NONE
    reason: str = ""

    def __bool__(self) -> bool:
        return self.status == 1


DONE = Outcome(1)


def refused(cause: Cause, reason: object) -> Outcome:
    """The answer 0, with the reason."""
    return Outcome(0, cause, str(reason))
