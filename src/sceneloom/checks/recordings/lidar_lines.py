"""Rules about `lidar` lines and what their files hold."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import FrameInHand, Subject
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.findings import Severity

FARTHEST, NEAREST = 400.0, 0.5
"""Half of a sweep's points lie nearer than the first, and farther than the second [m]."""
_LOOKED_AT = 16
_FEWEST = 20


def _doubled(subject: Subject) -> Iterator[Hit]:
    if subject.recording is None:
        return
    lidars = subject.recording.columns.lidars
    counts = Counter(name for lidar in lidars.values() for name in lidar.files)
    seen: dict[str, int] = {}
    for lidar in lidars.values():
        for name, line in zip(lidar.files, lidar.lines, strict=True):
            if counts[name] > 1 and name in seen:
                reported = (
                    f"lidar.dataFile: {name!r} is that of line {seen[name]}, too; expected one of its own"
                )
                yield Hit(f"data.jsonl: line {line}", reported)
            seen.setdefault(name, line)


@dataclass(slots=True)
class _Ranges:
    """Middle distances of the points of some sweeps of one lidar [m]."""

    path: str
    wanted: frozenset[int]
    found: list[float] = field(default_factory=list)


def _ranges(subject: Subject) -> dict[str, _Ranges]:
    return subject.table("middle ranges of lidars", lambda _: {})


def _look(subject: Subject, frame: FrameInHand) -> Iterator[Hit]:
    """Take the middle distance of some sweeps; what they report is stated at the end."""
    yield from ()
    sweep, lidar = frame.frame, frame.sensor
    if subject.recording is None or not isinstance(lidar, LidarSensor) or not isinstance(sweep, LidarFrame):
        return
    ranges = _ranges(subject).get(frame.sensor_path)
    if ranges is None:
        spread = np.linspace(0, len(lidar.frames) - 1, _LOOKED_AT).astype(int)
        ranges = _ranges(subject)[frame.sensor_path] = _Ranges(frame.sensor_path, frozenset(spread.tolist()))
    if frame.number in ranges.wanted:
        distances = np.linalg.norm(sweep.points.positions.astype(np.float64), axis=1)
        distances = distances[np.isfinite(distances) & (distances > 0)]
        if len(distances) >= _FEWEST:
            ranges.found.append(float(np.median(distances)))


def _absurd(subject: Subject) -> Iterator[Hit]:
    for ranges in _ranges(subject).values():
        middle = float(np.median(ranges.found)) if ranges.found else 1.0
        if NEAREST <= middle <= FARTHEST:
            continue
        meant = (
            "probably millimetres or centimetres" if middle > FARTHEST else "probably kilometres, or noise"
        )
        reported = f"half of the points are farther than {middle:.3g} m; expected {NEAREST:g} to {FARTHEST:g}: {meant}"
        yield Hit(f"{ranges.path}.frames[].points.positions", reported, len(ranges.found))


RULES: tuple[Rule, ...] = (
    Rule(
        "lidar-file-repeated",
        Severity.WARNING,
        "No two `lidar` lines name one file.",
        "Give each sweep its own file; see whether a file was overwritten.",
        find=_doubled,
    ),
    Rule(
        "lidar-range",
        Severity.WARNING,
        f"The middle distance of a lidar's points is {NEAREST:g} to {FARTHEST:g} m.",
        "Write metres.",
        look=_look,
        conclude=_absurd,
    ),
)
