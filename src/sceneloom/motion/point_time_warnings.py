"""Saying what was made of the times of points."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

from sceneloom.scene.point_times import PointTimes, TimesFound
from sceneloom.scene.warnings import DataWarning, WarningKind


@dataclass(slots=True)
class PointTimesStatistics:
    """Counts what was found out while sweeps pass, and says it."""

    counts: Counter[TimesFound] = field(default_factory=Counter)
    stray_points: int = 0

    def add(self, found: TimesFound) -> None:
        """Count one sweep."""
        self.counts[replace(found, strays=0)] += 1
        self.stray_points += found.strays

    def warnings(self, location: str = "sensors[].frames[].points.timestamps") -> tuple[DataWarning, ...]:
        """What was assumed, repaired or left out, each with the number of sweeps, or of stray points."""
        warnings = [
            _warning(found, location, count) for found, count in self.counts.items() if found.kind in _NOTES
        ]
        if self.stray_points:
            message = (
                "times of single points lie far away from those of their sweep; "
                "the median of the sweep's times was put in their location"
            )
            warnings.append(
                DataWarning(
                    kind=WarningKind.REPAIRED,
                    code="stray-point-times",
                    location=location,
                    message=message,
                    count=self.stray_points,
                )
            )
        return tuple(warnings)


_UNTIMED = "{}; the points were taken as measured at the sweep's time, and their times were left out"

_NOTES: Mapping[PointTimes, tuple[WarningKind, str, str]] = MappingProxyType(
    {
        PointTimes.EQUAL: (
            WarningKind.ASSUMED,
            "times-of-points",
            _UNTIMED.format("all points of a sweep bear one time, and it is not the sweep's own"),
        ),
        PointTimes.RELATIVE: (
            WarningKind.ASSUMED,
            "relative-point-times",
            "point times lie around zero and the sweep's own does not; they were read as counted from the sweep's time",
        ),
        PointTimes.OTHER_CLOCK: (
            WarningKind.ASSUMED,
            "point-times-of-another-clock",
            "point times are not on the clock of their sweep's time; the first of them was taken to be that time",
        ),
        PointTimes.WRONG_UNIT: (
            WarningKind.REPAIRED,
            "unit-of-point-times",
            "point times are {factor} times too {size} for their sweep; they were read in the unit that fits{origin}",
        ),
        PointTimes.UNKNOWN: (
            WarningKind.SKIPPED,
            "unknown-point-times",
            _UNTIMED.format("point times fit neither the sweep's own time nor its period"),
        ),
    }
)
"""Kind, code and message of the warning about each kind of times that is not simply believed."""


def _warning(found: TimesFound, location: str, count: int) -> DataWarning:
    kind, code, message = _NOTES[found.kind]
    too_small = found.factor < 1
    text = message.format(
        factor=int(1 / found.factor if too_small else found.factor),
        size="small" if too_small else "large",
        origin=", counted from the sweep's time" if found.relative else "",
    )
    return DataWarning(kind=kind, code=code, location=location, message=text, count=count)
