"""Fields that a scene has beside those of nuScenes, which its tables have no field for."""

from collections.abc import Iterable, Iterator

from sceneloom.formats.loss import Loss
from sceneloom.formats.nuscenes.keyframes import KEY_FRAMES
from sceneloom.scene.annotations.cuboids import CuboidAnnotation
from sceneloom.scene.annotations.labelled_points import LabeledPointsAnnotation
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.contents import KINDS
from sceneloom.scene.scene import Scene

OF_SENSORS = frozenset({"token", "calibrated_sensor_token", KEY_FRAMES})
OF_FRAMES = frozenset({"file", "token", "sample_token", "is_key_frame"})
_OF_BOXES = frozenset({"tokens"})
_OF_CLASSES = frozenset({"index"})
_OF_SCENES = frozenset({"nuscenes", "sceneloom"})

_WHAT = "the tables have no field for"


def further_fields(scene: Scene) -> Iterator[Loss]:
    """Name those of sensors, annotations and of the scene itself; of frames the writer reports."""
    for sensor in scene.sensors:
        if isinstance(sensor, LidarSensor | RadarSensor | CameraSensor):
            yield from reported(f"{KINDS[type(sensor)]}.extras", sensor.extras, OF_SENSORS)
    for annotation in scene.annotations:
        kind = KINDS[type(annotation)]
        if isinstance(annotation, CuboidAnnotation):
            yield from reported(f"{kind}.path.extras", annotation.path.extras, _OF_BOXES)
        elif isinstance(annotation, LabeledPointsAnnotation):
            yield from reported(f"{kind}.extras", annotation.extras, _OF_CLASSES)
    yield from reported("metadata", scene.metadata, _OF_SCENES)


def reported(field: str, names: Iterable[str], known: frozenset[str]) -> Iterator[Loss]:
    """The loss of fields of other names than those that are known."""
    further = sorted(set(names) - known)
    if further:
        yield Loss(field=field, what=f"{_WHAT} {', '.join(further)}")
