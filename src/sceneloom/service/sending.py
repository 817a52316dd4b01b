"""Sends a drive as its sensors would have sent it: records in the order of time, at a rate."""

import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Protocol

from sceneloom.errors import DataError, OptionError
from sceneloom.fusion.calibration.camera_models import CAMERA_MODELS
from sceneloom.fusion.messages.calibration_data import CalibrationData
from sceneloom.fusion.messages.records import SentRecord, kind_of
from sceneloom.fusion.outcome import Cause, Outcome
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene
from sceneloom.scene.span import sweep_period_ns, usual_period_ns
from sceneloom.scene.types import Progress
from sceneloom.scene.warnings import DataWarning, WarningKind
from sceneloom.service.sent_records import Piece, chunks_of
from sceneloom.service.sent_rig import (
    CAMERA_AXES,
    LIDAR_AXES,
    SentRig,
    format_camera_models,
    format_sensors,
    sent_rig,
)

_WAITS_S = tuple(0.002 * 2**k for k in range(8))
"""How long a sender waits where the session's queue is full, each time anew: half a second in all."""


PATIENCE_MS = 1000
"""How long a session has to wait for what belongs together at least: reading a drive takes its time, and may pause."""


class Receiver(Protocol):
    """What is sent to: a client of the service, or a fusion interface."""

    def add_property(self, name: str, description: str, type: str) -> Outcome:
        """Clause 5.3."""
        ...

    def set_property(self, name: str, value: Any) -> Outcome:
        """Clause 5.4."""
        ...

    def get_property(self, name: str) -> Any:
        """Clause 5.5."""
        ...

    def set_calibration(self, data: CalibrationData, *, camera_id: int = 0, lidar_id: int = 0) -> Outcome:
        """Table 3."""
        ...

    def send_motion(self, path: Poses) -> Outcome:
        """Report where the vehicle was."""
        ...

    def send(self, record: SentRecord) -> Outcome:
        """Clause 5.6."""
        ...

    def flush(self) -> Any:
        """Fuse what waits."""
        ...


@dataclass(frozen=True, slots=True)
class SendReport:
    """What was sent.

    Attributes:
        source: the drive or the log.
        sensors: what number each sensor has in the session.
        sent: records by kind, and poses as `motion`.
        refused: how many of them were not taken, by cause.
        seconds: how long it took.
        warnings: what was assumed or left out.
    """

    source: str
    sensors: Mapping[str, int]
    sent: Mapping[str, int]
    refused: Mapping[str, int]
    seconds: float
    warnings: tuple[DataWarning, ...] = ()


@dataclass(slots=True)
class Pace:
    """Holds records back until they are due.

    Attributes:
        rate: 1 for as fast as it was, 2 for twice as fast, 0 for as fast as possible.
        clock: seconds, never backwards.
        wait: waits for so many seconds.
    """

    rate: float
    clock: Callable[[], float] = time.monotonic
    wait: Callable[[float], None] = time.sleep
    _begun: tuple[float, int] | None = None

    def until(self, time_ns: int) -> None:
        """Return when something of that time is due."""
        if self.rate <= 0:
            return
        if self._begun is None:
            self._begun = self.clock(), time_ns
        begun_s, first_ns = self._begun
        left_s = begun_s + (time_ns - first_ns) / 1e9 / self.rate - self.clock()
        if left_s > 0:
            self.wait(left_s)


@dataclass(slots=True)
class Statistics:
    """Sends records, and counts them and what was refused."""

    receiver: Receiver
    pace: Pace
    sent: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)

    def send(self, record: SentRecord) -> None:
        """Send one record; as fast as possible means as fast as the session has room."""
        outcome = self.receiver.send(record)
        for wait_s in _WAITS_S if self.pace.rate <= 0 else ():
            if outcome.cause is not Cause.QUEUE_FULL:
                break
            self.pace.wait(wait_s)
            outcome = self.receiver.send(record)
        if self.pace.rate <= 0 and outcome.cause is Cause.QUEUE_FULL:
            # what is there waits for partners that do not come
            self.receiver.flush()
            outcome = self.receiver.send(record)
        self.count(kind_of(record).name, outcome)

    def count(self, name: str, outcome: Outcome, number: int = 1) -> None:
        """Count what was sent."""
        self.sent[name] += number
        if not outcome:
            self.refused[str(outcome.cause) or "no-cause"] += number


def send_scene(
    scene: Scene,
    receiver: Receiver,
    *,
    rate: float = 1.0,
    trajectory: str | None = None,
    heading: str | None = None,
    lenient: bool = False,
    progress: Progress | None = None,
    pace: Pace | None = None,
) -> SendReport:
    """Configure a session for the sensors of a scene and send all that they measured, in the order of time.

    Lidars are numbered from 0, then cameras. Sweeps, images, boxes of the scene's annotations and the ego trajectory
     are sent; times before 0 are moved by whole seconds, for a timestamp cannot state them.

    Args:
        rate: 1 for as fast as it was, 2 for twice as fast, 0 for as fast as the session takes it.
        trajectory: the ego trajectory by name; None for the one that the scene has, if any.
        heading: "motion" to derive orientations where it has positions only.
        lenient: pass over frames that cannot be read.
        progress: reported after each record.
        pace: holds records back; None for one of that rate.

    Raises:
        DataError: the scene has no lidar or no camera, or a frame cannot be read.
        PoseError: it is not known where a sensor is.
        OptionError: the session refuses the configuration.
    """
    begun = time.perf_counter()
    rig = sent_rig(scene, trajectory=trajectory, heading=heading)
    statistics = Statistics(receiver, pace or Pace(rate))
    _configure(receiver, rig)
    skipped: list[DataWarning] = []
    with refusing(receiver, statistics.pace.rate):
        _send_chunks(rig, statistics, skipped if lenient else None, progress)
    receiver.flush()
    return SendReport(
        source=rig.scene.source,
        sensors={str(sensor_id): number for sensor_id, number in rig.numbers.items()},
        sent=dict(sorted(statistics.sent.items())),
        refused=dict(sorted(statistics.refused.items())),
        seconds=time.perf_counter() - begun,
        warnings=(*rig.scene.warnings, *rig.warnings, *skipped),
    )


def _send_chunks(
    rig: SentRig, statistics: Statistics, skipped: list[DataWarning] | None, progress: Progress | None
) -> None:
    total = sum(len(lidar.frames) for lidar in rig.scene.lidars)
    total += sum(len(camera.images) for camera in rig.scene.cameras)
    for done, piece in enumerate(chunks_of(rig), start=1):
        statistics.pace.until(piece.timestamp_ns)
        try:
            records = piece.records()
        except DataError as error:
            if skipped is None:
                raise
            skipped.append(_unreadable(error))
            records = []
        _send_motion(piece, statistics)
        for record in records:
            statistics.send(record)
        if progress is not None:
            progress(done, total)


def _send_motion(piece: Piece, statistics: Statistics) -> None:
    if piece.motion is not None:
        outcome = statistics.receiver.send_motion(piece.motion)
        statistics.count("motion", outcome, len(piece.motion.timestamps_ns))


def _unreadable(error: DataError) -> DataWarning:
    return DataWarning(kind=WarningKind.SKIPPED, code="frame-unreadable", location="", message=str(error))


def _configure(receiver: Receiver, rig: SentRig) -> None:
    """Report what the session has to know: frames, how often sensors measure, camera models and where they are."""
    settings: dict[str, Any] = {
        "camera_axes": CAMERA_AXES,
        "lidar_axes": LIDAR_AXES,
        "sensors": format_sensors(rig),
        "lidar_frequency": _frequency(
            sweep_period_ns(lidar) for lidar in rig.scene.lidars if lidar.id in rig.numbers
        ),
        "camera_frequency": _frequency(
            usual_period_ns(camera.images.timestamps_ns)
            for camera in rig.scene.cameras
            if camera.id in rig.numbers
        ),
    }
    fastest = max(settings["lidar_frequency"], settings["camera_frequency"])
    room = math.ceil(1.5 * fastest * PATIENCE_MS / 1e3) + 16  # what comes while others are waited for
    least = {"pairing_timeout_ms": PATIENCE_MS, "queue_length": room}
    settings |= {name: value for name, value in least.items() if receiver.get_property(name) < value}
    if rig.camera_models:
        receiver.add_property(
            CAMERA_MODELS, "camera models that table 3 cannot state, as JSON by camera_id", "string"
        )
        settings[CAMERA_MODELS] = format_camera_models(rig.camera_models)
    for name, value in settings.items():
        must(receiver.set_property(name, value), f"property {name}")
    for entry in rig.calibrations:
        outcome = receiver.set_calibration(entry.data, camera_id=entry.camera_id, lidar_id=entry.lidar_id)
        must(outcome, f"calibration of camera {entry.camera_id} and lidar {entry.lidar_id}")


def _frequency(periods_ns: Iterable[int]) -> int:
    """Of the slowest sensor of a kind [Hz], at least 1."""
    return max(round(1e9 / max(periods_ns)), 1)


@contextmanager
def refusing(receiver: Receiver, rate: float) -> Iterator[None]:
    """Let a session refuse what it has no room for, rather than drop it, while records come as fast as they can."""
    if rate > 0:
        yield
        return
    before = receiver.get_property("queue_policy")
    must(receiver.set_property("queue_policy", "refuse"), "property queue_policy")
    try:
        yield
    finally:
        receiver.set_property("queue_policy", before)


def must(outcome: Outcome, what: str) -> None:
    """Make an error of what a session refuses and nothing works without.

    Raises:
        OptionError: with the reason.
    """
    if not outcome:
        raise OptionError(f"the session refuses the {what}: {outcome.cause}: {outcome.reason}")
