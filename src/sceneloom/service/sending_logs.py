"""Sends a log of sessions once more: what came into its sessions, under the same configurations."""

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sceneloom.fusion.messages.protobuf_form import from_protobuf
from sceneloom.fusion.outcome import Cause
from sceneloom.fusion.properties.store import Property
from sceneloom.service.motion_form import path_of
from sceneloom.service.received import property_of
from sceneloom.service.replay import LogEntry, read_log
from sceneloom.service.sending import Pace, Receiver, SendReport, Statistics, must
from sceneloom.service.values import value_from_protobuf


def send_log(
    path: str | Path,
    open_session: Callable[[str], Receiver],
    *,
    rate: float = 1.0,
    pace: Pace | None = None,
) -> SendReport:
    """Send what was taken in the sessions of a log, in its order.

    What was refused or dropped is not sent again. Results are the same byte for byte as long as the receiving sessions
    drop nothing and no pause lets them fuse what waits earlier than it was; `replay` excludes both.

    Args:
        open_session: gives what is sent to, by the name of the session in the log.
        rate: 1 for as fast as it came, 2 for twice as fast, 0 for as fast as the sessions take it.
        pace: holds records back; None for one of that rate.

    Raises:
        DataError: the file is no log, or what stands in it is faulty.
        OptionError: a session refuses the configuration.
    """
    begun = time.perf_counter()
    kept = pace or Pace(rate)
    sessions: dict[str, _Sending] = {}
    for entry in read_log(Path(path)):
        step = _STEPS.get(entry.what)
        if step is None:
            continue
        if entry.session not in sessions:
            sessions[entry.session] = _Sending(Statistics(open_session(entry.session), kept))
        kept.until(entry.log_time_ns)
        step(sessions[entry.session], entry)
    for sending in sessions.values():
        sending.end()
    sent: Counter[str] = sum((sending.statistics.sent for sending in sessions.values()), Counter())
    refused: Counter[str] = sum((sending.statistics.refused for sending in sessions.values()), Counter())
    return SendReport(
        source=str(path),
        sensors={},
        sent=dict(sorted(sent.items())),
        refused=dict(sorted(refused.items())),
        seconds=time.perf_counter() - begun,
    )


@dataclass(slots=True)
class _Sending:
    """One session of a log that is sent again."""

    statistics: Statistics
    _known: dict[str, Property] = field(default_factory=dict)
    _policy: str | None = None

    @property
    def receiver(self) -> Receiver:
        """What is sent to."""
        return self.statistics.receiver

    def properties(self, entry: LogEntry) -> None:
        """Add and set what is not so yet; the algorithms follow by themselves."""
        for found in map(property_of, entry.message.properties):
            known = self._known.get(found.name)
            if not found.predefined and known is None:
                outcome = self.receiver.add_property(found.name, found.description, str(found.type))
                if outcome.cause is not Cause.KNOWN_NAME:
                    must(outcome, f"property {found.name}")
            if found.name == _POLICY and self.statistics.pace.rate <= 0:
                # as fast as possible, what there is no room for is sent again; in the end it is as it was
                self._policy = found.value
                must(self.receiver.set_property(_POLICY, "refuse"), f"property {_POLICY}")
            elif found.value is not None and found.name != _ALGORITHM and self._differs(found):
                must(self.receiver.set_property(found.name, found.value), f"property {found.name}")
            self._known[found.name] = found

    def algorithms(self, entry: LogEntry) -> None:
        """Set the algorithms of both types; the type that the log says is set last."""
        chosen = self.receiver.get_property(_TYPE)
        for number, name in enumerate(value_from_protobuf(entry.message)):
            must(self.receiver.set_property(_TYPE, number), f"property {_TYPE}")
            must(self.receiver.set_property(_ALGORITHM, name), f"property {_ALGORITHM}")
        must(self.receiver.set_property(_TYPE, chosen), f"property {_TYPE}")

    def calibration(self, entry: LogEntry) -> None:
        """Set or replace a calibration."""
        message = entry.message
        outcome = self.receiver.set_calibration(
            from_protobuf(message.calibration), camera_id=message.camera_id, lidar_id=message.lidar_id
        )
        must(outcome, f"calibration of camera {message.camera_id} and lidar {message.lidar_id}")

    def record(self, entry: LogEntry) -> None:
        """Send a record."""
        self.statistics.send(from_protobuf(entry.message))

    def motion(self, entry: LogEntry) -> None:
        """Send poses."""
        path = path_of(entry.message)
        self.statistics.count("motion", self.receiver.send_motion(path), len(path.timestamps_ns))

    def flush(self, _: LogEntry) -> None:
        """Fuse what waits."""
        self.receiver.flush()

    def end(self) -> None:
        """Leave the session as the log left it."""
        if self._policy is not None:
            self.receiver.set_property(_POLICY, self._policy)

    def _differs(self, found: Property) -> bool:
        known = self._known.get(found.name)
        before: Any = self.receiver.get_property(found.name) if known is None else known.value
        return bool(before != found.value)


_POLICY, _TYPE, _ALGORITHM = "queue_policy", "fusion_type", "fusion_algorithm"

_STEPS: dict[str, Callable[[_Sending, LogEntry], None]] = {
    "properties": _Sending.properties,
    "algorithms": _Sending.algorithms,
    "calibration": _Sending.calibration,
    "record": _Sending.record,
    "motion": _Sending.motion,
    "flush": _Sending.flush,
}
"""What is sent of each entry of a log; the others only report."""
