"""What rules saw in single frames, reported once for each sensor."""

from collections.abc import Iterator
from dataclasses import dataclass

from sceneloom.checks.rule import Find, Hit
from sceneloom.checks.subject import FrameInHand, Subject


@dataclass(slots=True)
class _Observation:
    """The first frame of a sensor in which something was seen, and how many there are."""

    path: str
    problem: str
    frames: int = 0


def note_observation(subject: Subject, rule: str, frame: FrameInHand, field: str, problem: str) -> None:
    """Remember that something was seen in a field of a frame.

    The first problem of a sensor is the one that is reported.
    """
    observations = _observations(subject, rule)
    seen = observations.setdefault(frame.sensor_path, _Observation(f"{frame.path}.{field}", problem))
    seen.frames += 1


def observations_of(rule: str) -> Find:
    """Report what was remembered for a rule: one hit for each sensor."""

    def conclude(subject: Subject) -> Iterator[Hit]:
        for seen in _observations(subject, rule).values():
            yield Hit(seen.path, seen.problem, seen.frames)

    return conclude


def _observations(subject: Subject, rule: str) -> dict[str, _Observation]:
    found: dict[str, _Observation] = subject.table(f"observations of {rule}", lambda _: {})
    return found
