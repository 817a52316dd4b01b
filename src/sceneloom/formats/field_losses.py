"""What becomes of the fields that a scene has, by a format's table: for writers whose targets hold only a part."""

from collections import Counter
from collections.abc import Iterator
from typing import Any

from sceneloom.formats.loss import Holding, Loss, Support, Supports
from sceneloom.formats.supported_fields import holding_of
from sceneloom.scene.contents import KINDS, MODEL_FIELDS
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.plain import PlainSensor
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Coordinates

_ROOT = ("attributes", "metadata", "time_offset_ns", "extras")
_OF_THE_TRAJECTORY = ("file_seconds", "covariances", "quaternions_xyzw", "positions", "timestamps_ns")


def field_losses(scene: Scene, supports: Supports) -> Iterator[Loss]:
    """Name the fields of a scene that the table does not call kept, as far as the scene has them.

    What stands in frames, in annotations of a kind that is held, or in a sensor's camera model is for the writer to
    report.

    Args:
        scene: what is written.
        supports: the table of the format.
    """
    for sensor in scene.sensors:
        yield from _of_sensor(sensor, supports)
    yield from _of_annotations(scene, supports)
    yield from _of_trajectories(scene, supports)
    for name in _ROOT:
        value = getattr(scene, name)
        if value:
            yield from _reported(
                name, holding_of(supports, name), 1 if isinstance(value, int) else len(value)
            )


def _of_sensor(sensor: Any, supports: Supports) -> Iterator[Loss]:
    kind = KINDS[type(sensor)]
    whole = _of_all(kind, supports)
    if whole is not None:
        yield from _reported(f"sensors[{sensor.id}]", whole, 1)
        return
    if isinstance(sensor, PlainSensor):
        return
    for name in type(sensor).__dataclass_fields__:
        field = f"{kind}.{name}"
        value = getattr(sensor, name)
        if field in MODEL_FIELDS and _is_stated(value):
            yield from _reported(f"sensors[{sensor.id}].{name}", holding_of(supports, field), 1)
        elif isinstance(value, LazyFrames) and len(value):
            frames = _of_all(field, supports)
            yield from _reported(f"sensors[{sensor.id}].{name}", frames, len(value))


def _of_annotations(scene: Scene, supports: Supports) -> Iterator[Loss]:
    counts = Counter(KINDS[type(annotation)] for annotation in scene.annotations)
    for kind, count in counts.items():
        whole = _of_all(kind, supports)
        if whole is not None:
            yield from _reported(kind, whole, count)


def _of_trajectories(scene: Scene, supports: Supports) -> Iterator[Loss]:
    whole = _of_all("trajectories", supports)
    for name, trajectory in scene.trajectories.items():
        if whole is not None:
            yield from _reported(f"trajectories[{name}]", whole, len(trajectory.timestamps_ns))
            continue
        for field in _OF_THE_TRAJECTORY:
            values = getattr(trajectory, field)
            if values is not None:
                yield from _reported(
                    f"trajectories[{name}].{field}",
                    holding_of(supports, f"trajectories.{field}"),
                    len(values),
                )


def _of_all(kind: str, supports: Supports) -> Holding | None:
    """What is stated for all fields of a kind, where that is the same: it is dropped as a whole."""
    found = {holding_of(supports, field) for field in MODEL_FIELDS if field.startswith(f"{kind}.")}
    only = next(iter(found))
    return only if len(found) == 1 and only is not None and only.support is Support.DROPPED else None


def _is_stated(value: Any) -> bool:
    if value is None or value is Coordinates.WORLD:
        return False
    return not hasattr(value, "__len__") or len(value) > 0


def _reported(field: str, holding: Holding | None, count: int) -> Iterator[Loss]:
    if holding is not None and holding.support is not Support.KEPT:
        yield Loss(field=field, what=holding.how, count=count, support=holding.support)
