"""Topics of points as lidars and radars."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray
from sceneloom.errors import DataError
from sceneloom.formats.topics.locations import Locations
from sceneloom.formats.topics.log import Topic
from sceneloom.formats.topics.records import CloudRecord
from sceneloom.formats.topics.survey import Survey
from sceneloom.formats.topics.sweeps import (
    DIRECTION_COLUMNS,
    CloudReader,
    LidarReader,
    RadarReader,
    speed_column,
    understood,
)
from sceneloom.formats.topics.timestamps import in_order
from sceneloom.scene.clouds import LidarSensor, PointsSensor, RadarSensor
from sceneloom.scene.frames import LazyFrames


@dataclass(frozen=True, slots=True, eq=False)
class CloudDraft:
    """A topic of points before it is placed.

    Attributes:
        reader: of its messages.
        frame_id: of its points.
        is_radar: whether its points have speeds along the line of sight.
    """

    reader: CloudReader
    frame_id: str
    is_radar: bool

    def placed(self, sensor_id: str | int, locations: Locations) -> LidarSensor | RadarSensor:
        """The sensor as the frames location it."""
        mount = locations.mount(self.frame_id)
        frame = locations.points_frame(self.frame_id)
        poses = locations.poses(self.frame_id, mount, self.reader.starts_ns)
        return self.sensor(sensor_id, mount=mount, poses=poses, points_frame=frame)

    def sensor(
        self, sensor_id: str | int, *, radar: bool | None = None, **fields: Any
    ) -> LidarSensor | RadarSensor:
        """The sensor, with further fields."""
        times = self.reader.starts_ns
        if self.is_radar if radar is None else radar:
            fields.pop("model", None)
            return RadarSensor(sensor_id, LazyFrames(times, RadarReader(self.reader)), **fields)
        return LidarSensor(sensor_id, LazyFrames(times, LidarReader(self.reader)), **fields)

    def points(self, sensor_id: str | int, **fields: Any) -> PointsSensor:
        """The map that the only message holds."""
        points = self.reader.points(0)[0]
        return PointsSensor(sensor_id, points.positions, points.colors, **fields)


def draft_cloud(survey: Survey, topic: Topic) -> CloudDraft:
    """Find out what a topic of points holds; its first messages are read.

    Raises:
        DataError: the first message is damaged.
    """
    timestamps = survey.times_ns[topic.number]
    location = f"{survey.log.name}: {topic.name}"
    rows = in_order(timestamps, location, survey.ledger)
    first = survey.log.read(topic, int(rows[0]))[0]
    if not isinstance(first, CloudRecord):
        raise DataError(survey.log.name, f"{topic.name}[{int(rows[0])}]", "no points; expected a cloud")
    ours = survey.notes.ours and any(note.get("topic") == topic.name for note in survey.notes.sensors)
    reader = CloudReader(survey.log, topic, rows, timestamps[rows], timestamps[rows], whole=ours)
    names = {field.name: np.zeros(0) for field in first.fields}
    return CloudDraft(understood(reader, survey.ledger), first.frame_id, _is_radar(topic.name, names))


def _is_radar(name: str, columns: dict[str, AnyArray]) -> bool:
    """Whether points are a radar's: they have speeds, and the topic or our own fields report it."""
    reported = "radar" in name.lower() or all(column in columns for column in DIRECTION_COLUMNS)
    return reported and speed_column(columns) is not None
