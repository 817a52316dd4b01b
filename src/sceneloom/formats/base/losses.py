"""Supported fields and losses: what a format can hold of a scene.

And the report of what a written file could not hold, field by field.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from enum import StrEnum
from typing import Any

import msgspec

from sceneloom.scene.contents import KINDS, MODEL_FIELDS
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import PlainSensor
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Coordinates


class Support(StrEnum):
    """What becomes of a field of the scene in a target."""

    KEPT = "kept"
    """Read back, it is the same."""
    CONVERTED = "converted"
    """Stated in another way (other units, types, frames), with no more error than the rounding of that."""
    APPROXIMATED = "approximated"
    """Replaced by something near, such as another model of the camera model or a compressed image."""
    DROPPED = "dropped"
    """Not in the target."""


class Holding(msgspec.Struct, frozen=True):
    """What a format makes of one field of the scene, whatever the scene.

    Attributes:
        support: what becomes of it.
        how: how it is converted or approximated, or why it is dropped, for a person; empty if it is kept.
    """

    support: Support
    how: str = ""


Supports = Mapping[str, Holding]
"""Names of fields, or beginnings of them that end at a dot, and what becomes of these; "" is for all the rest."""

KEPT = Holding(Support.KEPT)


def converted(how: str) -> Holding:
    """A field that is stated in another way."""
    return Holding(Support.CONVERTED, how)


def approximated(how: str) -> Holding:
    """A field that is replaced by something near."""
    return Holding(Support.APPROXIMATED, how)


def dropped(why: str) -> Holding:
    """A field that the format has no field for."""
    return Holding(Support.DROPPED, why)


class Loss(msgspec.Struct, frozen=True, kw_only=True):
    """One kind of loss.

    Attributes:
        field: name of the field out of `MODEL_FIELDS`, or a beginning of it where all below is meant; the id of the
            sensor or annotation may stand instead of its kind (`sensors[top].frames[].points.intensities`), the name
            of a trajectory and keys may be in it (`trajectories[vio].covariances`, `metadata.weather`).
        what: what happened to it, for a person ("rounded to microseconds, at most 0.5 µs").
        count: how many values or objects it happened to.
        kept: where the exact value stands in the target all the same ("metadata.sceneloom.imu"), or None.
        support: what became of it.
        largest_error: how far the worst value is off, in the unit that `what` names; None where that means nothing.
    """

    field: str
    what: str
    count: int = 1
    kept: str | None = None
    support: Support = Support.DROPPED
    largest_error: float | None = None

    @property
    def kind(self) -> tuple[str, str, str | None, Support]:
        """What losses that are added up have in common."""
        return self.field, self.what, self.kept, self.support

    def joined(self, other: "Loss") -> "Loss":
        """This and another one of the same kind: counts are added, the largest error counts."""
        errors = [loss.largest_error for loss in (self, other) if loss.largest_error is not None]
        return msgspec.structs.replace(self, count=self.count + other.count, largest_error=max(errors, default=None))


class LossReport(msgspec.Struct, frozen=True):
    """All losses of one writing; empty where the target holds everything."""

    losses: tuple[Loss, ...] = ()

    def __len__(self) -> int:
        return len(self.losses)

    def __iter__(self) -> Iterator[Loss]:
        return iter(self.losses)

    @classmethod
    def of(cls, losses: Iterable[Loss]) -> "LossReport":
        """Collect losses; those of one field and kind are added up, and the largest error of them is reported."""
        together: dict[tuple[str, str, str | None, Support], Loss] = {}
        for loss in losses:
            earlier = together.get(loss.kind)
            together[loss.kind] = loss if earlier is None else earlier.joined(loss)
        return cls(tuple(together.values()))


SEVERITY: Mapping[Support, int] = {support: rank for rank, support in enumerate(Support)}
"""How much of a field a support takes away: the supports are listed in this order."""


def holding_of(supports: Supports, field: str) -> Holding | None:
    """Give what a table says of a field: its own row, else that of the longest beginning; None if it says nothing."""
    name = field
    while name:
        if name in supports:
            return supports[name]
        name = name.rpartition(".")[0]
    return supports.get("")


def unknown_names(supports: Supports) -> list[str]:
    """Give the keys of a table that are neither a field of the model nor a beginning of one: slips of the pen."""
    known = {""}
    for field in MODEL_FIELDS:
        parts = field.split(".")
        known.update(".".join(parts[:count]) for count in range(1, len(parts) + 1))
    return [name for name in supports if name not in known]


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
            yield from _reported(name, holding_of(supports, name), 1 if isinstance(value, int) else len(value))


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
                    f"trajectories[{name}].{field}", holding_of(supports, f"trajectories.{field}"), len(values)
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


class Losses:
    """Collects what a target cannot hold; those of one field and kind are added up, and a count of 0 is no loss."""

    def __init__(self, losses: Iterable[Loss] = ()) -> None:
        """Begin with some losses, or none."""
        self._found: dict[tuple[str, str, str | None, Support], Loss] = {}
        self.extend(losses)

    def __iter__(self) -> Iterator[Loss]:
        return iter(self._found.values())

    @property
    def all(self) -> list[Loss]:
        """All losses, in the order in which they first came up."""
        return [*self]

    def extend(self, losses: Iterable[Loss]) -> None:
        """Add losses that others found."""
        for loss in losses:
            if loss.count > 0:
                earlier = self._found.get(loss.kind)
                self._found[loss.kind] = loss if earlier is None else earlier.joined(loss)

    def dropped(self, field: str, what: str, *, count: int = 1, kept: str | None = None) -> None:
        """Something is not in the target, or stands in it under another name: `kept`."""
        self.extend([Loss(field=field, what=what, count=count, kept=kept)])

    def converted(self, field: str, what: str, *, count: int = 1, error: float | None = None) -> None:
        """Something is stated in another way."""
        self.extend([Loss(field=field, what=what, count=count, support=Support.CONVERTED, largest_error=error)])

    def approximated(self, field: str, what: str, *, count: int = 1, error: float | None = None) -> None:
        """Something is replaced by something near."""
        self.extend([Loss(field=field, what=what, count=count, support=Support.APPROXIMATED, largest_error=error)])

    def kept(self, field: str, what: str) -> None:
        """Something that is worth a remark, though nothing is lost."""
        self.extend([Loss(field=field, what=what, support=Support.KEPT)])
