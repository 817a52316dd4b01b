"""What is stated over time: events, and attributes of the scene and of annotations, as states and curves."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.annotations.relations import EventAnnotation
from sceneloom.scene.scene import Scene
from sceneloom.view.annotations.rows import attribute_name, attribute_text, attributes_at, label_of, name_of
from sceneloom.view.colours import colour_of_name
from sceneloom.view.sdk import sdk
from sceneloom.view.stream import Stream

EVENTS, ATTRIBUTES, LIST = "events", "attributes", "annotations"
_MOST_ROWS = 1_000


def show_events(stream: Stream, annotations: Sequence[Annotation]) -> int:
    """Show events as lines of a log and as states that last; give their number."""
    events = [one for one in annotations if isinstance(one, EventAnnotation)]
    for event in events:
        start_ns = event.start_ns
        stated = attributes_at(event, np.array([start_ns], np.int64))[0]
        where = "" if event.sensor_id is None else f" (sensor {event.sensor_id})"
        text = f"{name_of(event)}{where}{': ' if stated else ''}{stated}"
        line = sdk().TextLog(text, level="INFO", color=colour_of_name(label_of(event)))
        path = stream.path(EVENTS, event.id)
        state = sdk().StateChange(state=label_of(event))
        stream.log(start_ns, path, line, state, kind="events")
        if event.duration_ns:
            stream.log(start_ns + round(event.duration_ns), path, sdk().StateChange(state=""))
    return len(events)


def show_attributes(stream: Stream, scene: Scene) -> int:
    """Show attributes of the scene and its sensors: numbers as curves, words as states; give how many have times."""
    timed = [attribute for attribute in scene.attributes if attribute.is_timed and attribute.values]
    for attribute in timed:
        path = stream.path(ATTRIBUTES, attribute_name(attribute))
        timestamps = np.asarray(attribute.timestamps_ns, np.int64)
        numbers = _numbers(attribute)
        columns: Iterable[Any]
        if numbers is None:
            columns = sdk().StateChange.columns(state=[_word(value) for value in attribute.values])
        else:
            columns = sdk().Scalars.columns(scalars=numbers)
        stream.columns(timestamps, path, columns, kind="attributes")
    return len(timed)


def _numbers(attribute: AttributePath) -> np.ndarray | None:
    if all(isinstance(value, int | float) and not isinstance(value, bool) for value in attribute.values):
        return np.array(attribute.values, np.float64)
    return None


def _word(value: Any) -> str:
    return ", ".join(map(str, value)) if isinstance(value, tuple | list) else str(value)


def list_annotations(stream: Stream, scene: Scene) -> bool:
    """Show a table of all annotations with their attributes, and of those that hold for the scene; whether any."""
    fixed = [one for one in scene.attributes if not one.is_timed]
    rows = [f"| {kind} | {text} |" for kind, text in ((attribute_name(a), _word(a.values)) for a in fixed)]
    parts = (
        ["# Attributes of the scene\n| attribute | value |\n| --- | --- |\n" + "\n".join(rows)]
        if rows
        else []
    )
    if scene.annotations:
        head = "| type | label | id | parent | attributes |\n| --- | --- | --- | --- | --- |\n"
        listed = [_row(one) for one in scene.annotations[:_MOST_ROWS]]
        more = len(scene.annotations) - len(listed)
        rest = f"\n\n… and {more} more" if more else ""
        parts.append(f"# Annotations\n{head}" + "\n".join(listed) + rest)
    if parts:
        stream.static(stream.path(LIST), sdk().TextDocument("\n\n".join(parts), media_type="text/markdown"))
    return bool(parts)


def _row(annotation: Any) -> str:
    attributes: tuple[AttributePath, ...] = getattr(annotation, "attributes", ())
    stated = attribute_text({attribute_name(one): _word(one.values) for one in attributes[:8]})
    parent = "" if annotation.parent_id is None else str(annotation.parent_id)
    cells = (annotation.type, getattr(annotation, "label", None) or "", annotation.id, parent, stated)
    return "| " + " | ".join(str(cell).replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"
