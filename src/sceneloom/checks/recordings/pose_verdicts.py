"""Whether the poses of a trajectory agree with the IMU as they are, and what they probably mean where they do not."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.checks.recordings.imu_evidence import FEWEST_INTERVALS, Gravity, Turning
from sceneloom.checks.recordings.likely_readings import most_likely
from sceneloom.checks.recordings.orientation_readings import (
    AS_GIVEN,
    OrientationReading,
    orientation_readings,
    read_orientations,
)
from sceneloom.checks.recordings.turning import CleanSamples, PoseIntervals, orientation_noise
from sceneloom.checks.subject import Subject
from sceneloom.scene import ImuSensor, Trajectory, VectorSamples

LEAST_CORRELATION = 0.8
"""Turn rates of orientations and of the gyroscope that correlate less do not tell the same motion."""
GREATEST_TILT_DEG = 25.0
"""So far off up the mean of the accelerometer may be: a vehicle that brakes all the time leaves 20°."""
LEAST_COHERENCE = 0.6
"""The accelerometer's mean in the world has to be this part of its mean length: gravity does not turn with a device,
and hard turns all the time leave 0.8."""


@dataclass(frozen=True, slots=True, eq=False)
class Agreement:
    """How well one reading of orientations agrees with the IMU.

    Attributes:
        reading: which.
        correlations: (S,) of the turn rates, for each shift of time; empty where the turning does not tell.
        up: (3,) mean of the accelerometer in the world, of length `coherence`; None where not known.
    """

    reading: OrientationReading
    correlations: Float64Array
    up: Float64Array | None

    @property
    def correlation(self) -> float:
        """The best one over all shifts; 1 where the turning does not tell."""
        return float(self.correlations.max()) if len(self.correlations) else 1.0

    @property
    def coherence(self) -> float:
        """1 where the accelerometer's mean does not turn with the device."""
        return 1.0 if self.up is None else float(np.linalg.norm(self.up))

    @property
    def tilt_deg(self) -> float:
        """Angle between the mean and up [deg]."""
        if self.up is None or self.coherence == 0:
            return 0.0
        return float(np.degrees(np.arccos(np.clip(self.up[2] / self.coherence, -1.0, 1.0))))

    @property
    def turns_alike(self) -> bool:
        """Whether the turn rates agree, so far as they tell."""
        return self.correlation >= LEAST_CORRELATION

    @property
    def stands_upright(self) -> bool:
        """Whether gravity is where it should be, so far as it is known."""
        return self.tilt_deg <= GREATEST_TILT_DEG and self.coherence >= LEAST_COHERENCE


@dataclass(frozen=True, slots=True, eq=False)
class PoseVerdict:
    """What an IMU says of one trajectory.

    Attributes:
        name: of the trajectory.
        given: the agreement as the file has it.
        better: correlations under the reading that explains what does not agree as given; None for none.
        probably: what is probably wrong, "" where nothing explains it.
        shifts: (S,) float64 [s], by which the IMU's times were taken to be later; empty where turning does not tell.
        tolerance: shorter shifts than the samples are apart are not told [s].
        measured, told: (M, 3) turn rates of the gyroscope and of the orientations as given, less their means [rad/s].
    """

    name: str
    given: Agreement
    better: Float64Array | None = None
    probably: str = ""
    shifts: Float64Array = field(default_factory=lambda: np.zeros(0))
    tolerance: float = 0.0
    measured: Float64Array = field(default_factory=lambda: np.zeros((0, 3)))
    told: Float64Array = field(default_factory=lambda: np.zeros((0, 3)))


def pose_verdicts(subject: Subject) -> Sequence[PoseVerdict]:
    """The verdict on each trajectory with orientations; none without an IMU."""
    return subject.table("verdicts of the IMU on poses", _verdicts)


def _verdicts(subject: Subject) -> list[PoseVerdict]:
    imus = [sensor for sensor in subject.scene.sensors if isinstance(sensor, ImuSensor)]
    if not imus:
        return []
    streams = imus[0].streams
    found = []
    for way in subject.scene.trajectories.values():
        if way.quaternions_xyzw is not None:
            case = _Case.of(way, streams.get("gyroscope"), streams.get("accelerometer"))
            found.append(None if case is None else case.verdict(subject))
    return [verdict for verdict in found if verdict is not None]


@dataclass(frozen=True, slots=True, eq=False)
class _Case:
    """One trajectory beside what the IMU tells of it.

    Attributes:
        way: the trajectory.
        quaternions_xyzw: (N, 4) its orientations, `world_from_device` if they are told as they should be.
        intervals: those between its poses that are compared.
        turning: what the gyroscope measured over them; None where that is too little to tell from noise.
        gravity: what the accelerometer measured over them, or None.
    """

    way: Trajectory
    quaternions_xyzw: Float64Array
    intervals: PoseIntervals
    turning: Turning | None
    gravity: Gravity | None

    @classmethod
    def of(cls, way: Trajectory, rates: VectorSamples | None, forces: VectorSamples | None) -> "_Case | None":
        intervals = PoseIntervals.of(way)
        if len(intervals) < FEWEST_INTERVALS:
            return None
        origin_ns = int(way.timestamps_ns[0])
        turning = Turning.of(intervals, CleanSamples.of(rates, origin_ns))
        quaternions = read_orientations(AS_GIVEN, way.poses.quaternions_xyzw)
        if turning is not None and not turning.is_above(orientation_noise(quaternions)):
            turning = None
        gravity = Gravity.of(intervals, CleanSamples.of(forces, origin_ns))
        if turning is None and gravity is None:
            return None
        return cls(way, way.poses.quaternions_xyzw, intervals, turning, gravity)

    def verdict(self, subject: Subject) -> PoseVerdict:
        given = self.agreement(AS_GIVEN)
        better, probably = None, ""
        if not (given.turns_alike and given.stands_upright):
            better, probably = self.explanation(subject)
        if self.turning is None:
            return PoseVerdict(self.way.name, given, better, probably)
        return PoseVerdict(
            self.way.name,
            given,
            better,
            probably,
            self.turning.shifts,
            self.turning.tolerance(self.way),
            *self.turning.both(read_orientations(AS_GIVEN, self.quaternions_xyzw)),
        )

    def agreement(self, reading: OrientationReading) -> Agreement:
        quaternions = read_orientations(reading, self.quaternions_xyzw)
        correlations = np.zeros(0) if self.turning is None else self.turning.correlations(quaternions)
        return Agreement(
            reading, correlations, None if self.gravity is None else self.gravity.up(quaternions)
        )

    def explanation(self, subject: Subject) -> tuple[Float64Array | None, str]:
        """The correlations (3,) under the reading that explains all, and what it says is wrong, or None and ""."""
        tried = [
            self.agreement(reading) for reading in orientation_readings(subject) if reading is not AS_GIVEN
        ]
        found = [a for a in tried if a.turns_alike and a.stands_upright]
        if not found:
            return None, ""
        # correlations that are alike do not choose: the usual mistake comes first
        best = max(found, key=lambda a: round(a.correlation, 1))
        told = most_likely(best.reading, {a.reading for a in found}, self.way, self.intervals, self.gravity)
        return best.correlations, told
