"""Rules about what cannot be read."""

from collections.abc import Iterator

from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import FrameInHand, Subject
from sceneloom.scene import Severity


def _unreadable(subject: Subject, frame: FrameInHand) -> Iterator[Hit]:
    del subject
    if frame.fault is not None:
        yield Hit(frame.path, frame.fault)


RULES: tuple[Rule, ...] = (
    Rule(
        "frame-readable",
        Severity.ERROR,
        "Every frame can be read and every picture decoded.",
        "Record or export the frame again, or leave it out.",
        look=_unreadable,
    ),
)
