"""What rules look at: a scene, and a frame of it that is in memory."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from sceneloom.scene import Annotation, Identifier, LidarFrame, Picture, RadarFrame, Scene, Sensor


@dataclass(frozen=True, slots=True)
class FrameInHand:
    """A frame or picture that was read, or could not be.

    Attributes:
        sensor: whose it is.
        sensor_path: `sensors[3]`.
        number: of the frame within its sensor.
        frame: None where it could not be read.
        fault: why it could not.
    """

    sensor: Sensor
    sensor_path: str
    number: int
    frame: LidarFrame | RadarFrame | Picture | None
    fault: str | None = None

    @property
    def path(self) -> str:
        """`sensors[3].frames[12]`, or `sensors[3].pictures[12]`."""
        return (
            f"{self.sensor_path}.{'pictures' if isinstance(self.frame, Picture) else 'frames'}[{self.number}]"
        )


@dataclass(frozen=True)
class Subject:
    """A scene under examination.

    Attributes:
        scene: as far as it could be read.
        header: the file's own header where it is an `.sfs` file, else None.
        cache: tables that several rules need, each made once (`cached_property` of theirs).
    """

    scene: Scene
    header: Mapping[str, Any] | None = None
    cache: dict[str, Any] = field(default_factory=dict)

    def sensor_path(self, sensor: Sensor) -> str:
        """`sensors[3]`."""
        return f"sensors[{next(i for i, other in enumerate(self.scene.sensors) if other is sensor)}]"

    def annotation_path(self, annotation: Annotation) -> str:
        """`annotations[3]`."""
        return f"annotations[{next(i for i, a in enumerate(self.scene.annotations) if a is annotation)}]"

    def has_sensor(self, sensor_id: Identifier) -> bool:
        """Whether the scene has a sensor of that id, of that very type."""
        return any(s.id == sensor_id and type(s.id) is type(sensor_id) for s in self.scene.sensors)
