"""Taking parts out of a header: with each goes what cannot be without it, and nothing else."""

import re
from collections import defaultdict
from collections.abc import Iterable, Mapping
from typing import Any

from sceneloom.formats.sfs.fields import RECORDS, Field, Kind, annotation_record, sensor_record

Keys = tuple[str | int, ...]
"""The path of a value in the header."""

_OURS = ("metadata", "sceneloom")
_RECORD_KINDS = {
    Kind.RECORD,
    Kind.RECORDS,
    Kind.RECORD_OR_RECORDS,
    Kind.RECORD_LISTS,
    Kind.RECORD_MAP,
}
_TYPED_LISTS = {"sensors": sensor_record, "annotations": annotation_record}
_OF_FRAMES = {"frames": ("lengths",), "images": ("camera_of_picture", "mounts", "extras")}
_ANY, _MAP = "any of ", "map of "
_STEP = re.compile(r"\.?([^.\[\]]+)|\[(\d+)\]")


def parse_path(path: str) -> Keys:
    """Take a path such as `sensors[3].frames[12].points` apart."""
    return tuple(int(index) if index else name for name, index in _STEP.findall(path))


def what_goes(header: Mapping[str, Any], keys: Keys) -> Keys | None:
    """Say what has to be taken out where the value at `keys` is lost: it, or the record that needs it.

    Returns:
        The path of a field that may be absent, or of an entry of a list of records; None where there is no such place,
        or the scene cannot be without it.
    """
    removable: Keys | None = None
    node: Any = header
    record: str | None = "scene"
    for depth, key in enumerate(keys):
        if isinstance(node, dict):
            if key not in node:
                needed = _field_of(record, key)
                return removable if needed is not None and needed.required else None
            if record is not None and record.startswith(_MAP):
                record, removable, node = record.removeprefix(_MAP), keys[: depth + 1], node[key]
                continue
            field = _field_of(record, key)
            if field is None or not field.required:
                removable = keys[: depth + 1]
            record = _record_below(record, str(key), field, keys[:depth])
        elif isinstance(node, list) and isinstance(key, int) and key < len(node):
            if record is not None:
                removable = keys[: depth + 1]
                record = _record_of_entry(record, node[key])
        elif isinstance(node, list):
            return None
        else:
            break
        node = node[key]
    return removable


def _field_of(record: str | None, key: str | int) -> Field | None:
    return RECORDS.get(record or "", {}).get(str(key))


def _record_below(record: str | None, name: str, field: Field | None, above: Keys) -> str | None:
    if record in {"scene", "sceneloom"} and name in _TYPED_LISTS:
        return f"{_ANY}{name}"
    if record == "scene" and name == "metadata":
        return None
    if (*above, name) == _OURS:
        return "sceneloom"
    if field is None or field.kind not in _RECORD_KINDS:
        return None
    return f"{_MAP}{field.record}" if field.kind == Kind.RECORD_MAP else str(field.record)


def _record_of_entry(record: str, entry: Any) -> str | None:
    """The record of an entry of a list, which for sensors and annotations depends on its type."""
    if not record.startswith(_ANY):
        return record
    type_name = entry.get("type") if isinstance(entry, dict) else None
    return _TYPED_LISTS[record.removeprefix(_ANY)](type_name if isinstance(type_name, str) else "")


def take_out(header: dict[str, Any], victims: Iterable[Keys]) -> None:
    """Remove fields and entries; what counts the frames or pictures of a sensor is brought into step."""
    parents: dict[Keys, list[str | int]] = defaultdict(list)
    for keys in victims:
        parents[keys[:-1]].append(keys[-1])
    counted: list[tuple[Any, str, list[int], int]] = []
    for parent, names in sorted(parents.items(), key=lambda item: len(item[0]), reverse=True):
        node = _at(header, parent)
        if isinstance(node, dict):
            for name in names:
                gone_with = node.pop(str(name), None)
                if name == "video" and isinstance(gone_with, dict):
                    counted.append((node.get("id"), "images", [], _count_of(gone_with.get("timestamps"))))
            continue
        gone = set(names)
        kept = [k for k in range(len(node)) if k not in gone]
        if parent[-1] in _OF_FRAMES:
            counted.append((_at(header, parent[:-1]).get("id"), str(parent[-1]), kept, len(node)))
        node[:] = [node[k] for k in kept]
    for sensor_id, name, kept, count in counted:
        keep_in_step(header, sensor_id, name, kept, count)


def keep_in_step(header: dict[str, Any], sensor_id: Any, name: str, kept: list[int], count: int) -> None:
    """Follow frames or pictures that were taken out in our notes, and in labelled points.

    Args:
        header: the header, which is changed.
        sensor_id: the sensor that they belong to.
        name: "frames" or "images".
        kept: which of them stay.
        count: how many there were.
    """
    for note in _records(header, (*_OURS, "sensor_notes")):
        if note.get("id") == sensor_id:
            for holder in (note, note.get("pictures")):
                _choose(holder, _OF_FRAMES[name], kept, count)
    if name == "frames":
        places = {old: new for new, old in enumerate(kept)}
        for root in ((), _OURS):
            for annotation in _records(header, (*root, "annotations")):
                _renumber(annotation, sensor_id, places)


def _count_of(values: Any) -> int:
    return len(values) if isinstance(values, list) else 0


def _at(header: dict[str, Any], keys: Keys) -> Any:
    node: Any = header
    for key in keys:
        node = node[key]
    return node


def _choose(holder: Any, names: tuple[str, ...], kept: list[int], count: int) -> None:
    for name in names:
        values = holder.get(name) if isinstance(holder, dict) else None
        if isinstance(values, list) and len(values) == count:
            holder[name] = [values[k] for k in kept]


def _renumber(annotation: dict[str, Any], sensor_id: Any, places: Mapping[int, int]) -> None:
    entries = annotation.get("labeled_points")
    if not isinstance(entries, list):
        return
    annotation["labeled_points"] = [
        {**entry, "sensor_frame": places[entry["sensor_frame"]]} if _counts(entry, sensor_id) else entry
        for entry in entries
        if not _counts(entry, sensor_id) or entry["sensor_frame"] in places
    ]


def _counts(entry: Any, sensor_id: Any) -> bool:
    """Whether labelled points name a frame of this sensor by its number."""
    return (
        isinstance(entry, dict)
        and entry.get("sensor_id") == sensor_id
        and type(entry.get("sensor_frame")) is int
    )


def _records(header: Mapping[str, Any], keys: Keys) -> list[dict[str, Any]]:
    node: Any = header
    for key in keys:
        node = node.get(key) if isinstance(node, dict) else None
    return [entry for entry in node if isinstance(entry, dict)] if isinstance(node, list) else []
