"""Saying what was made of the times of points."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

from sceneloom.scene.notices import Notice, NoticeKind
from sceneloom.scene.point_times import PointTimes, TimesFound


@dataclass(slots=True)
class PointTimesTally:
    """Counts what was found out while sweeps pass, and says it."""

    counts: Counter[TimesFound] = field(default_factory=Counter)
    stray_points: int = 0

    def add(self, found: TimesFound) -> None:
        """Count one sweep."""
        self.counts[replace(found, strays=0)] += 1
        self.stray_points += found.strays

    def notices(self, place: str = "sensors[].frames[].points.timestamps") -> tuple[Notice, ...]:
        """What was assumed, repaired or left out, each with the number of sweeps, or of stray points."""
        notices = [
            _notice(found, place, count) for found, count in self.counts.items() if found.kind in _REMARKS
        ]
        if self.stray_points:
            message = (
                "times of single points lie far away from those of their sweep; "
                "the median of the sweep's times was put in their place"
            )
            notices.append(
                Notice(
                    kind=NoticeKind.REPAIRED,
                    code="stray-point-times",
                    place=place,
                    message=message,
                    count=self.stray_points,
                )
            )
        return tuple(notices)


_UNTIMED = "{}; the points were taken as measured at the sweep's time, and their times were left out"

_REMARKS: Mapping[PointTimes, tuple[NoticeKind, str, str]] = MappingProxyType(
    {
        PointTimes.EQUAL: (
            NoticeKind.ASSUMED,
            "times-of-points",
            _UNTIMED.format("all points of a sweep bear one time, and it is not the sweep's own"),
        ),
        PointTimes.RELATIVE: (
            NoticeKind.ASSUMED,
            "relative-point-times",
            "point times lie around zero and the sweep's own does not; they were read as counted from the sweep's time",
        ),
        PointTimes.OTHER_CLOCK: (
            NoticeKind.ASSUMED,
            "point-times-of-another-clock",
            "point times are not on the clock of their sweep's time; the first of them was taken to be that time",
        ),
        PointTimes.WRONG_UNIT: (
            NoticeKind.REPAIRED,
            "unit-of-point-times",
            "point times are {factor} times too {size} for their sweep; they were read in the unit that fits{origin}",
        ),
        PointTimes.UNKNOWN: (
            NoticeKind.SKIPPED,
            "unknown-point-times",
            _UNTIMED.format("point times fit neither the sweep's own time nor its period"),
        ),
    }
)
"""Kind, code and message of the notice about each kind of times that is not simply believed."""


def _notice(found: TimesFound, place: str, count: int) -> Notice:
    kind, code, message = _REMARKS[found.kind]
    too_small = found.factor < 1
    text = message.format(
        factor=int(1 / found.factor if too_small else found.factor),
        size="small" if too_small else "large",
        origin=", counted from the sweep's time" if found.relative else "",
    )
    return Notice(kind=kind, code=code, place=place, message=text, count=count)
