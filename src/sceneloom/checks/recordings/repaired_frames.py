"""Repairing what is kept of a recording's `frames` lines, by which they would be written as they were."""

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import msgspec

from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.scene import Scene


def counted_anew(scene: Scene) -> Scene:
    """Let `frames` lines be numbered from 0."""
    return _with_notes(scene, lambda notes: {**notes, "first": 0})


def with_all_cameras(scene: Scene) -> Scene:
    """Let lines that lack images report it of every camera."""
    cameras = {
        int(found[1])
        for sensor in scene.sensors
        if isinstance(sensor, CameraSensor | DepthCameraSensor)
        and (found := re.fullmatch(r"camera(\d+)", str(sensor.id)))
    }

    def listed(text: str) -> str:
        line = msgspec.json.decode(text)
        entries = line.get("frames")
        if not isinstance(entries, list):
            return text
        missing = sorted(cameras - {entry["cameraInd"] for entry in entries})
        more = [{"cameraInd": index, "missingBitmap": True} for index in missing]
        return msgspec.json.encode({**line, "frames": [*entries, *more]}).decode()

    return _with_notes(
        scene, lambda notes: {**notes, "texts": [listed(text) for text in notes.get("texts", [])]}
    )


def _with_notes(scene: Scene, change: Callable[[Mapping[str, Any]], dict[str, Any]]) -> Scene:
    """Change what is kept of `frames` lines; the same scene where that changes nothing."""
    kept = scene.metadata.get("recording")
    notes = kept.get("frame_lines") if isinstance(kept, Mapping) else None
    if not isinstance(kept, Mapping) or not isinstance(notes, Mapping) or change(notes) == notes:
        return scene
    recording = MappingProxyType({**kept, "frame_lines": change(notes)})
    return replace(scene, metadata=MappingProxyType({**scene.metadata, "recording": recording}))
