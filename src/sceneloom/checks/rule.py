"""What a rule is: an id, what it says, where it looks, and how it repairs."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import StrEnum

from sceneloom.checks.subject import FrameInHand, Subject
from sceneloom.scene.findings import Severity
from sceneloom.scene.scene import Scene


@dataclass(frozen=True, slots=True)
class Hit:
    """A location where a rule does not hold.

    Attributes:
        path: in the words of the file (`sensors[3].frames[12].points.colors`).
        message: what was found, with the value, and what was expected.
        count: how often, where one hit stands for several.
    """

    path: str
    message: str
    count: int = 1


class CheckProfile(StrEnum):
    """What a scene is checked against."""

    SFS = "sfs"
    """The description of the format."""
    SCALE = "scale"
    """Also what Scale's own library loads and validates."""


ALL_PROFILES = frozenset(CheckProfile)
SCALE_ONLY = frozenset({CheckProfile.SCALE})

Find = Callable[[Subject], Iterable[Hit]]
Look = Callable[[Subject, FrameInHand], Iterable[Hit]]
Fix = Callable[[Scene], Scene]


def unless_recording(find: Find) -> Find:
    """Leave recordings out, of which rules over their lines report the same with the line, and more."""

    def found(subject: Subject) -> Iterable[Hit]:
        return () if subject.recording is not None else find(subject)

    return found


@dataclass(frozen=True, slots=True)
class Rule:
    """One rule; it has `find`, or `look`, or both; `look` with `conclude` judges frames together.

    Attributes:
        id: kebab case, stable ("quaternion-norm").
        severity: how bad a hit is.
        summary: what holds in a sound scene, one sentence for the catalogue.
        remedy: what a person can do about a hit.
        find: looks at the whole scene without reading frames.
        look: looks at one frame or image; each is read once for all rules, and those of a sensor come in order.
        conclude: says at the end what all frames together show; what `look` kept for it is in `Subject.cache`.
        fix: gives the scene repaired: safe, idempotent, changing nothing else; None where a person has to decide.
        profiles: for which profiles it holds.
    """

    id: str
    severity: Severity
    summary: str
    remedy: str
    find: Find | None = None
    look: Look | None = None
    conclude: Find | None = None
    fix: Fix | None = None
    profiles: frozenset[CheckProfile] = ALL_PROFILES
