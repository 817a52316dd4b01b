"""What is kept of a recording's lines word by word, cut to the part of the drive that stays."""

import json
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from sceneloom.editing.retimed_lines import LINES, SHARED, TEXTS, streams_of
from sceneloom.scene.part_annotations import Interval
from sceneloom.scene.scene import Scene

_OTHER, _ANCHORS, _FRAMES = "other_lines", "other_seconds", "frame_lines"


def cut_lines(scene: Scene, part: Interval | None) -> Mapping[str, Any]:
    """Give a scene's metadata without lines of other times, and of sensors and trajectories that are gone.

    Lines of unknown content stay where their time does, those without one where that of the line before does: it is not
    known what they are of.

    Args:
        scene: the part that stays.
        part: its times [ns]; None where it was not cut in time.
    """
    kept = scene.metadata.get(LINES)
    if not isinstance(kept, Mapping):
        return scene.metadata
    there = {f"trajectories.{name}" for name in scene.trajectories}
    there |= {name for sensor in scene.sensors for name in streams_of(sensor)}
    changed = {**kept, **_other_lines(kept, part)}
    texts, shared = kept.get(TEXTS), kept.get(SHARED)
    if isinstance(texts, Mapping):
        changed[TEXTS] = {
            name: {key: text for key, text in lines.items() if _is_key_inside(key, part)}
            for name, lines in texts.items()
            if name in there and isinstance(lines, Mapping)
        }
    if isinstance(shared, list):
        changed[SHARED] = [line for line in shared if _stays(line, there, part)]
    if part is not None:
        changed.pop(_FRAMES, None)
    left = {name: value for name, value in changed.items() if value or value == kept.get(name)}
    return MappingProxyType({**scene.metadata, LINES: MappingProxyType(left)})


def _other_lines(kept: Mapping[str, Any], part: Interval | None) -> dict[str, Any]:
    """Lines that nothing computes with, with the times of those that have none of their own."""
    lines, anchors = kept.get(_OTHER), kept.get(_ANCHORS)
    if part is None or not isinstance(lines, list):
        return {}
    seconds = anchors if isinstance(anchors, Mapping) else {}
    chosen = []
    for location, text in enumerate(lines):
        anchor = seconds.get(str(location))
        time = anchor if anchor is not None else _seconds_of(text)
        if time is None or _is_inside(round(time * 1e9), part):
            chosen.append((text, anchor))
    found = {str(location): anchor for location, (_, anchor) in enumerate(chosen) if anchor is not None}
    return {_OTHER: [text for text, _ in chosen], **({_ANCHORS: found} if _ANCHORS in kept else {})}


def _stays(line: Any, there: set[str], part: Interval | None) -> bool:
    """Whether a line that several streams have a part in is of the part, and of streams all of which stay."""
    records = line.get("records") if isinstance(line, Mapping) else None
    pairs = [record for record in records or () if len(record) == 2]
    return all(stream in there and _is_key_inside(key, part) for stream, key in pairs)


def _is_key_inside(key: str, part: Interval | None) -> bool:
    timestamp = key.partition("#")[0]
    return part is None or (timestamp.removeprefix("-").isdecimal() and _is_inside(int(timestamp), part))


def _is_inside(time_ns: int, part: Interval) -> bool:
    return part[0] <= time_ns < part[1]


def _seconds_of(text: Any) -> float | None:
    try:
        line = json.loads(text)
    except (TypeError, ValueError, RecursionError):
        return None
    seconds = line.get("time") if isinstance(line, dict) else None
    return float(seconds) if isinstance(seconds, int | float) and abs(seconds) < 9.2e9 else None
