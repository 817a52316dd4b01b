"""A record that was taken: what is fused of it, and by which configuration."""

from dataclasses import dataclass, field

from sceneloom.formats.recording.lidar_files import XYZIRT
from sceneloom.fusion.calibration.axes import SensorKind
from sceneloom.fusion.ledger import Stream, Ticket
from sceneloom.fusion.messages.boxes import Boxes2d, Boxes3d
from sceneloom.fusion.messages.records import kind_of, size_of
from sceneloom.fusion.messages.sensor_data import ImageData, PointCloudData, RawData
from sceneloom.fusion.setting import Setting
from sceneloom.scene.cameras import CameraImage
from sceneloom.scene.clouds import LidarFrame

WholeRecord = RawData | ImageData | PointCloudData | Boxes3d | Boxes2d
"""What is sent of one frame."""

Received = LidarFrame | CameraImage | Boxes3d | Boxes2d
"""What is fused."""

CLOCK_JUMP_NS = 10_000_000_000
"""A record that is so much older than the newest one was not late: its sensor's clock was set back."""


@dataclass(frozen=True, slots=True, eq=False)
class Accepted:
    """A record that was taken.

    Attributes:
        sensor_id: who sent it.
        kind: camera or lidar.
        record: as it was sent.
        received: what is fused.
        setting: the configuration in force when it came.
        ticket: what becomes of it.
        timestamp_ns: of the record [ns].
    """

    sensor_id: int
    kind: SensorKind
    record: WholeRecord
    received: Received
    setting: Setting
    ticket: Ticket = field(init=False)
    timestamp_ns: int = field(init=False)

    def __post_init__(self) -> None:
        stream = kind_of(self.record).name, self.sensor_id
        object.__setattr__(self, "ticket", Ticket(stream, size=size_of(self.record)))
        object.__setattr__(self, "timestamp_ns", self.record.timestamp.nanoseconds)

    @property
    def left_out(self) -> int:
        """How many points of a cloud are not fused, because a number of theirs is not finite."""
        if not isinstance(self.received, LidarFrame):
            return 0
        record = self.record
        sent = record.length // XYZIRT.itemsize if isinstance(record, RawData) else 0
        return (record.number if isinstance(record, PointCloudData) else sent) - len(self.received.points)

    @property
    def stream(self) -> Stream:
        """Which queue it waits in: the kind of record and the sensor."""
        return self.ticket.stream
