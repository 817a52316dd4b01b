"""Sensors on their trajectory into a file: what of them stands in the header, in nanoseconds.

Arrays already spooled.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sceneloom.errors import OptionError
from sceneloom.formats.loss import Loss, Support, joined
from sceneloom.formats.sfs.poses import mount_rows
from sceneloom.formats.sfs.spool import Blob
from sceneloom.formats.sfs.times import FileClock
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.poses import Poses
from sceneloom.scene.types import Identifier

_LATEST_STATIONARY_NS = 100_000_000_000


class Losses:
    """Counts what a file cannot hold, by field."""

    def __init__(self) -> None:
        """Start without losses."""
        self._found: dict[tuple[str, str, str | None, Support], Loss] = {}

    def add(
        self,
        field: str,
        what: str,
        *,
        count: int = 1,
        kept: str | None = None,
        support: Support = Support.DROPPED,
        largest_error: float | None = None,
    ) -> None:
        """Note a loss."""
        if count:
            reported = Loss(
                field=field, what=what, count=count, kept=kept, support=support, largest_error=largest_error
            )
            self._add(reported)

    def add_all(self, others: "Losses") -> None:
        """Note the losses of another count."""
        for loss in others.all():
            self._add(loss)

    def _add(self, loss: Loss) -> None:
        key = (loss.field, loss.what, loss.kept, loss.support)
        earlier = self._found.get(key)
        self._found[key] = loss if earlier is None else joined(earlier, loss)

    def all(self) -> list[Loss]:
        """All losses, those of one field and kind added up."""
        return list(self._found.values())


@dataclass(slots=True)
class SensorDraft:
    """One sensor.

    Attributes:
        id, type: as in the file.
        fields: what stands in its record besides poses and frames.
        note: what stands about it in our metadata.
        points_frame: the frame of its points, where it has any.
        poses: where it was; None: not known.
        mount: `ego_from_sensor`, where it is known.
        coordinates: the frame that `poses` lead into; None for sensors without.
        further_poses: unknown fields of `poses`.
        frames: records of its frames so far; None where it has none.
        point_times: the spooled times of points.
        lengths: of radar points, one entry per frame, where the profile has no field for them.
        streamed: whether frames may still come.
    """

    id: Identifier
    type: str
    fields: dict[str, Any]
    note: dict[str, Any] = field(default_factory=dict)
    points_frame: str | None = None
    poses: Poses | None = None
    mount: RigidTransform | None = None
    coordinates: str | None = None
    further_poses: Mapping[str, Any] = field(default_factory=dict)
    frames: list[dict[str, Any]] | None = None
    point_times: list[Blob] = field(default_factory=list)
    lengths: list[Any] = field(default_factory=list)
    streamed: bool = True

    @property
    def location(self) -> str:
        """Path of the sensor, for losses and messages."""
        return f"sensors[{self.id}]"

    def first_ns(self) -> int | None:
        """The earliest timestamp that stands in the sensor's record so far [ns]."""
        timestamps = [frame["timestamp"] for frame in self.frames or []]
        # sensors of unknown types may have fields of these names that are something else
        fields = self.fields if self.type == "camera" else {}
        timestamps += [image["timestamp"] for image in fields.get("images") or []]
        video = fields.get("video")
        if video is not None and len(video["timestamps"]):
            timestamps.append(int(min(video["timestamps"])))
        if self.poses is not None and not self.poses.static:
            timestamps.append(self.poses.start_ns)
        return min(timestamps, default=None)

    def record(self, clock: FileClock, losses: Losses) -> dict[str, Any]:
        """Make the sensor's record; poses get the file's resolution here."""
        record: dict[str, Any] = {"id": self.id, "type": self.type}
        if self.coordinates is not None:
            record |= self._position_in_world(clock, losses)
        elif self.poses is not None:
            record["poses"] = self._poses(self.poses, clock, losses)
        if self.poses is not None and len(self.poses.timestamps_ns) == 1:
            self.note["poses_static"] = self.poses.static
        if self.frames is not None:
            record["frames"] = self.frames
        if any(length is not None for length in self.lengths):
            self.note["lengths"] = self.lengths
        return {**record, **{name: value for name, value in self.fields.items() if name not in record}}

    def _position_in_world(self, clock: FileClock, losses: Losses) -> dict[str, Any]:
        """Write `coordinates` and `poses`; a sensor of which only the mounting is known is placed on the ego."""
        if self.mount is not None:
            self.note["mount"] = mount_rows(self.mount)
        if self.poses is not None:
            return {"coordinates": self.coordinates, "poses": self._poses(self.poses, clock, losses)}
        if self.mount is None:
            losses.add(
                f"{self.location}.poses", "not known, left out; the format wants them", support=Support.KEPT
            )
            return {"coordinates": self.coordinates}
        what = "not known; the mounting is written, in ego coordinates"
        losses.add(f"{self.location}.poses", what, support=Support.KEPT)
        self.note |= {"poses_from_mount": True, "coordinates": self.coordinates}
        values = [[*self.mount.translation.tolist(), *self.mount.quaternion_xyzw.tolist()]]
        return {"coordinates": "ego", "poses": {"timestamps": [self._stationary_ns(clock)], "values": values}}

    def _poses(self, path: Poses, clock: FileClock, losses: Losses) -> dict[str, Any]:
        """Write a path; of poses that fall on one timestamp the first stays."""
        rows = np.hstack([path.positions, path.quaternions_xyzw])
        if path.static:
            return with_further(
                {"timestamps": [self._stationary_ns(clock)], "values": rows}, self.further_poses
            )
        timestamps, _ = clock.timestamp_array(path.timestamps_ns)
        kept = np.concatenate([[True], np.diff(timestamps) > 0])
        what = "left out: within one tick of the pose before"
        losses.add(f"{self.location}.poses", what, count=int((~kept).sum()))
        return with_further(
            {"timestamps": path.timestamps_ns[kept], "values": rows[kept]}, self.further_poses
        )

    def _stationary_ns(self, clock: FileClock) -> int:
        """The time to be written for a pose that holds at all times."""
        if self.poses is not None and 0 <= self.poses.start_ns - clock.offset_ns <= _LATEST_STATIONARY_NS:
            return self.poses.start_ns
        timestamps = [frame["timestamp"] for frame in self.frames or []]
        timestamps += [image["timestamp"] for image in self.fields.get("images") or []]
        return min(timestamps, default=max(clock.offset_ns, 0))


def with_further(record: dict[str, Any], further: Mapping[str, Any]) -> dict[str, Any]:
    """Add fields that the model carries along to a record, whose own fields win."""
    return {**record, **{name: value for name, value in further.items() if record.get(name) is None}}


def check_new(drafts: Mapping[tuple[type, Identifier], SensorDraft], identifier: Identifier) -> None:
    """Refuse an id that stands for a sensor already.

    Raises:
        OptionError: it does.
    """
    if (type(identifier), identifier) in drafts:
        raise OptionError(f"sensor {identifier!r} is in the file already; expected an id of its own")
