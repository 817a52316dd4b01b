"""Rows of many objects over many moments, cut into the moments again as the viewer wants them."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Int64Array
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.annotations.cuboids import Activation
from sceneloom.scene.at import attribute_at
from sceneloom.scene.types import Identifier
from sceneloom.view.sdk import sdk
from sceneloom.view.stream import Stream

_SHORT = 12
_SHOWN = 8


class Layer(Protocol):
    """Annotations of one kind."""

    def log(self, times_ns: Int64Array) -> None:
        """Log them at times (M,) [ns], ascending."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """What is logged to one entity.

    Attributes:
        stream: where to.
        path: of the entity.
        annotations: all that are drawn there.
        colour: 0xRRGGBBAA.
        links: texts on the links of annotations, by id.
    """

    stream: Stream
    path: str
    annotations: tuple[Any, ...]
    colour: int
    links: Mapping[Identifier, str]

    def details(self, there: BoolArray, times_ns: Int64Array) -> Iterable[Any]:
        """What is stated for each object that is there, as columns; one row for each in each moment.

        Args:
            there: (A, M) bool, which annotation is there when.
            times_ns: (M,) int64 [ns].
        """
        if not there.any():
            return ()
        rows = np.argwhere(there.T)
        stated = [attributes_at(annotation, times_ns) for annotation in self.annotations]
        seen = [_seen_by(annotation, times_ns) for annotation in self.annotations]
        values = {
            "id": [str(self.annotations[a].id) for _, a in rows.tolist()],
            "attributes": [stated[a][m] for m, a in rows.tolist()],
            "parent": [str(self.annotations[a].parent_id or "") for _, a in rows.tolist()],
            "links": [self.links.get(self.annotations[a].id, "") for _, a in rows.tolist()],
            "seen_by": [seen[a][m] for m, a in rows.tolist()],
        }
        kept = {name: column for name, column in values.items() if name == "id" or any(column)}
        columns: Iterable[Any] = sdk().AnyValues.columns(**kept).partition(there.sum(axis=0))
        return columns

    def lasting_details(self) -> Any:
        """What is stated for annotations that hold at all times."""
        first = np.zeros(1, np.int64)
        return sdk().AnyValues(
            id=[str(one.id) for one in self.annotations],
            attributes=[attributes_at(one, first)[0] for one in self.annotations],
            links=[self.links.get(one.id, "") for one in self.annotations],
        )


def by_moment(values: AnyArray, there: BoolArray) -> AnyArray:
    """Take the rows of objects that are there, moment after moment: (A, M, …) to (R, …)."""
    rows: AnyArray = np.swapaxes(values, 0, 1)[there.T]
    return rows


def chosen_by_moment(values: Sequence[Any], there: BoolArray) -> list[Any]:
    """Repeat what is stated for each of A objects for the moments in which it is there."""
    return [values[a] for _, a in np.argwhere(there.T).tolist()]


def grouped(annotations: Iterable[Annotation], name: Callable[[Any], str]) -> dict[str, tuple[Any, ...]]:
    """Put annotations of one name together, in their order."""
    groups: dict[str, list[Annotation]] = {}
    for annotation in annotations:
        groups.setdefault(name(annotation), []).append(annotation)
    return {key: tuple(members) for key, members in groups.items()}


def label_of(annotation: Any) -> str:
    """The class of an annotation, or its type."""
    return str(getattr(annotation, "label", None) or annotation.type)


def name_of(annotation: Any) -> str:
    """The class and the id, whose beginning is enough where it is long; the id alone where it begins with the class."""
    label, identifier = label_of(annotation), str(annotation.id)
    if len(label) < len(identifier) <= len(label) + _SHORT and identifier.startswith(label):
        return identifier
    return f"{label} {identifier if len(identifier) <= _SHORT else identifier[:_SHOWN]}"


def attributes_at(annotation: Any, times_ns: Int64Array) -> list[str]:
    """What the attributes of an annotation state at times (M,) [ns], each time in a line."""
    attributes: tuple[AttributePath, ...] = getattr(annotation, "attributes", ())
    if not attributes:
        return [""] * len(times_ns)
    values = {attribute_name(attribute): attribute_at(attribute, times_ns) for attribute in attributes}
    return [
        attribute_text({name: column[m] for name, column in values.items() if column[m] is not None})
        for m in range(len(times_ns))
    ]


def _seen_by(annotation: Any, times_ns: Int64Array) -> list[str]:
    """The sensors whose activations state that they see an annotation at times (M,) [ns]."""
    activations: tuple[Activation, ...] = getattr(annotation, "activations", ())
    sensors: list[list[str]] = [[] for _ in times_ns]
    for activation in activations:
        starts = activation.timestamps_ns
        lasts = (0,) * len(starts) if activation.durations_ns is None else activation.durations_ns
        stops = starts.astype(np.float64) + np.array(lasts, np.float64)  # may lie beyond int64
        active = (starts[:, None] <= times_ns) & (times_ns <= stops[:, None])
        for m in np.flatnonzero(active.any(axis=0)).tolist():
            sensors[m].append(str(activation.sensor_id))
    return [", ".join(found) for found in sensors]


def attribute_name(attribute: AttributePath) -> str:
    """The name of an attribute, with what it is limited to."""
    limits = [str(limit) for limit in (attribute.sensor_id, attribute.point_index) if limit is not None]
    return f"{attribute.name} ({', '.join(limits)})" if limits else attribute.name


def attribute_text(values: Mapping[str, Any]) -> str:
    """Attributes in a line: `colour red, doors 4`."""
    return ", ".join(
        f"{name} {value if isinstance(value, str) else json.dumps(value, default=str)}"
        for name, value in values.items()
    )
