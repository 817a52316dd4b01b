"""What the points of one frame look like in numbers, found in one pass for all rules, and kept for each sensor."""

import zlib
from dataclasses import dataclass, field

import numpy as np

from sceneloom.arrays import Int64Array, UInt8Array
from sceneloom.checks.subject import FrameInHand, Subject
from sceneloom.scene.clouds import LidarFrame, LidarPoints, RadarFrame, RadarPoints
from sceneloom.scene.types import Identifier, key_of

FAR_M = 10_000.0
"""Beyond it float32 is coarser than a millimetre."""


@dataclass(frozen=True, slots=True, eq=False)
class CloudFacts:
    """The points of one frame.

    Attributes:
        count: how many.
        not_finite: of them, how many have a location that is not finite.
        at_origin: how many lie exactly at the origin.
        far: how many have a coordinate beyond `FAR_M`.
        farthest: the largest coordinate [m], 0 without points.
        levels: (256,) int64, how many have each intensity; None without intensities.
        coloured: how many have a colour.
        white: how many of these are white.
        black: how many are black.
        digest: of the locations.
    """

    count: int
    not_finite: int
    at_origin: int
    far: int
    farthest: float
    levels: Int64Array | None = None
    coloured: int = 0
    white: int = 0
    black: int = 0
    digest: int = 0


@dataclass(slots=True, eq=False)
class SensorFacts:
    """The frames of one sensor, one after the other.

    Attributes:
        path: of the sensor.
        numbers: of the frames that could be read.
        counts: of their points.
        levels: (256,) int64, sums of `CloudFacts.levels`; None without intensities.
        coloured, white, black: sums of these.
        digest: of the latest frame.
        repeated: numbers of frames with the very points of the frame before.
    """

    path: str
    numbers: list[int] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)
    levels: Int64Array | None = None
    coloured: int = 0
    white: int = 0
    black: int = 0
    digest: int | None = None
    repeated: list[int] = field(default_factory=list)

    def add(self, number: int, facts: CloudFacts) -> None:
        """Take in one more frame."""
        self.numbers.append(number)
        self.counts.append(facts.count)
        if facts.levels is not None:
            self.levels = facts.levels if self.levels is None else self.levels + facts.levels
        self.coloured += facts.coloured
        self.white += facts.white
        self.black += facts.black
        if facts.count and facts.digest == self.digest:
            self.repeated.append(number)
        self.digest = facts.digest


SensorKey = tuple[type, Identifier]


def sensor_facts(subject: Subject) -> dict[SensorKey, SensorFacts]:
    """What is known of each sensor with points, by the frames read so far."""
    return subject.table("facts of sensors", lambda _: {})


def cloud_facts(subject: Subject, frame: FrameInHand) -> CloudFacts | None:
    """Give the facts of a frame in hand, found at the first asking; None for images and what cannot be read."""
    if not isinstance(frame.frame, LidarFrame | RadarFrame):
        return None
    latest = subject.table("facts of the frame in hand", lambda _: dict[str, CloudFacts]())
    if frame.path not in latest:
        latest.clear()
        latest[frame.path] = facts = facts_of(frame.frame.points)
        known, key = sensor_facts(subject), key_of(frame.sensor.id)
        known.setdefault(key, SensorFacts(frame.sensor_path)).add(frame.number, facts)
    return latest[frame.path]


def facts_of(points: LidarPoints | RadarPoints) -> CloudFacts:
    """Look through the points of one frame."""
    positions = points.positions
    x, y, z = np.abs(positions).T
    largest = np.maximum(np.maximum(x, y), z)
    finite = np.isfinite(largest)
    colors = points.colors if isinstance(points, LidarPoints) else None
    intensities = points.intensities if isinstance(points, LidarPoints) else None
    return CloudFacts(
        count=len(positions),
        not_finite=int(len(positions) - np.count_nonzero(finite)),
        at_origin=int(np.count_nonzero(largest == 0)),
        far=int(np.count_nonzero(finite & (largest > FAR_M))),
        farthest=float(largest[finite].max(initial=0.0)),
        levels=None if intensities is None else np.bincount(intensities, minlength=256),
        coloured=0 if colors is None else len(colors),
        white=0 if colors is None else _count_of(colors, 255),
        black=0 if colors is None else _count_of(colors, 0),
        digest=zlib.crc32(np.ascontiguousarray(positions).data),
    )


def _count_of(colors: UInt8Array, level: int) -> int:
    """How many points have this level in red, green and blue."""
    red, green, blue = colors.T
    return int(np.count_nonzero((red == level) & (green == level) & (blue == level)))
