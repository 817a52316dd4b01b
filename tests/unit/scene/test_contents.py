"""The table of the model's fields against the classes of the model."""

import dataclasses
import types
import typing
from collections.abc import Iterator
from typing import Any

from sceneloom.cameras.camera import Camera
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import AttributePath, Poses, Scene, Sensor, Trajectory, VideoContent
from sceneloom.scene.annotations import Annotation
from sceneloom.scene.contents import IMU_STREAMS, KINDS, MODEL_FIELDS, NO_DATA

WHOLE = {Camera, RigidTransform, Poses, VideoContent, AttributePath}
"""Classes that are one field, as the table's first lines state."""

OTHER_NAMES = {"images.decode": "images.rgb", "frames.decode": "frames.depth"}
"""Functions that make an image are called by what they make."""


def classes_in(hint: Any) -> Iterator[type]:
    """The classes of a type hint, of its alternatives and of what it holds."""
    if isinstance(hint, type) and not isinstance(hint, types.GenericAlias):
        yield hint
    for part in typing.get_args(hint):
        yield from classes_in(part)


def paths_of(cls: type, trajectory: str) -> Iterator[str]:
    hints = typing.get_type_hints(cls)
    for field in dataclasses.fields(cls):
        if field.name.startswith("_"):
            continue
        name = f"{trajectory}.{field.name}"
        deeper = [c for c in classes_in(hints[field.name]) if dataclasses.is_dataclass(c) and c not in WHOLE]
        if name == "sensors.imu.streams":
            for stream in (*IMU_STREAMS, "other"):
                yield from paths_of(deeper[0], f"{name}.{stream}")
        elif deeper:
            for inner in deeper:
                yield from paths_of(inner, name)
        else:
            yield next((name.replace(old, new) for old, new in OTHER_NAMES.items() if old in name), name)


def fields_of_the_model() -> set[str]:
    found = {path for cls, kind in KINDS.items() for path in paths_of(cls, kind)}
    found |= set(paths_of(Trajectory, "trajectories"))
    found |= {field.name for field in dataclasses.fields(Scene)} - NO_DATA
    return found - {"sensors", "annotations", "trajectories"}


def test_the_table_has_every_field_of_every_class_of_the_model_and_no_other():
    orders = {"sensors.order", "annotations.order", "trajectories.order"}
    assert set(MODEL_FIELDS) - orders == fields_of_the_model()
    assert orders < set(MODEL_FIELDS)


def test_every_kind_of_sensor_and_annotation_has_a_name():
    assert set(KINDS) == {*typing.get_args(Sensor), *typing.get_args(Annotation)}


def test_every_field_is_explained_in_one_line():
    assert all(words and "\n" not in words and len(words) < 80 for words in MODEL_FIELDS.values())
