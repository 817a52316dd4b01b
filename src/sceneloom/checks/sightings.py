"""What rules saw in single frames, told once for each sensor."""

from collections.abc import Iterator
from dataclasses import dataclass

from sceneloom.checks.rule import Find, Hit
from sceneloom.checks.subject import FrameInHand, Subject


@dataclass(slots=True)
class _Sighting:
    """The first frame of a sensor in which something was seen, and how many there are."""

    path: str
    problem: str
    frames: int = 0


def note_sighting(subject: Subject, rule: str, frame: FrameInHand, field: str, problem: str) -> None:
    """Remember that something was seen in a field of a frame; the first problem of a sensor is the one that is told."""
    sightings = _sightings(subject, rule)
    seen = sightings.setdefault(frame.sensor_path, _Sighting(f"{frame.path}.{field}", problem))
    seen.frames += 1


def sightings_of(rule: str) -> Find:
    """Tell what was remembered for a rule: one hit for each sensor."""

    def conclude(subject: Subject) -> Iterator[Hit]:
        for seen in _sightings(subject, rule).values():
            yield Hit(seen.path, seen.problem, seen.frames)

    return conclude


def _sightings(subject: Subject, rule: str) -> dict[str, _Sighting]:
    found: dict[str, _Sighting] = subject.table(f"sightings of {rule}", lambda _: {})
    return found
