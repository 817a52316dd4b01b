"""The annotations of a scene brought from the world onto the ego, or back."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.editing.frame_change import KNOWN, FrameChange
from sceneloom.editing.keyframes import AddedKeyframes, Keyframer, PathKey
from sceneloom.editing.moved_adjustments import led_from
from sceneloom.editing.moved_annotations import AnnotationMover
from sceneloom.editing.record import assumed, ours_of, skipped, with_warnings
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations.plain import PlainAnnotation
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.scene import Scene
from sceneloom.scene.span import frame_times

TO_EGO = "to_ego"
"""Our entry of the metadata that says what bringing a scene onto the ego added, so that it can be taken away again."""


def annotations_moved(
    scene: Scene,
    change: FrameChange,
    before: Mapping[PathKey, AddedKeyframes],
    entry: list[dict[str, Any]] | None = None,
) -> Scene:
    """Move the annotations of a scene.

    Args:
        scene: theirs.
        change: `new_from_old`.
        before: what an earlier change added, to be taken away.
        entry: what is added is written here, as `added_before` reads it.
    """
    times = _known(change, frames_ns(scene))
    span_ns = (int(times[0]), int(times[-1])) if len(times) else None
    keyframer = Keyframer(change, span_ns, times, before)
    mover = AnnotationMover(keyframer, CuboidAngles.of(scene), partial(led_from, change))
    moved = mover.moved(scene.annotations)
    if entry is not None:
        entry.extend(_entry(path, added) for path, added in keyframer.statistics.added.items())
    unknown = sum(isinstance(annotation, PlainAnnotation) for annotation in scene.annotations)
    warnings = (
        skipped(
            "keyframes-beyond-the-trajectory",
            "annotations",
            "keyframes at whose time the ego trajectory is not known",
            count=keyframer.statistics.left_out,
        ),
        skipped(
            "annotations-beyond-the-trajectory",
            "annotations",
            "annotations at none of whose times the ego trajectory is known",
            count=len(scene.annotations) - len(moved),
        ),
        assumed(
            "annotations-not-moved",
            "annotations",
            "annotations of unknown types: it is not known what in them has a location; left as they are",
            count=unknown,
        ),
    )
    return with_warnings(replace(scene, annotations=moved), warnings)


def frames_ns(scene: Scene) -> Int64Array:
    """The times (N,) int64 [ns], ascending, of all sweeps, radar cycles and images of a scene."""
    framed = [
        s
        for s in scene.sensors
        if isinstance(s, LidarSensor | RadarSensor | CameraSensor | DepthCameraSensor)
    ]
    timestamps = [frame_times(sensor) for sensor in framed]
    return np.unique(np.concatenate(timestamps)) if timestamps else np.zeros(0, np.int64)


def _known(change: FrameChange, times_ns: Int64Array) -> Int64Array:
    """Those of the times at which the change is known; those of its own poses where there are none."""
    times = times_ns if len(times_ns) else change.knots_ns
    return times[change.at(times).coverage <= KNOWN]


def _entry(path: PathKey, added: AddedKeyframes) -> dict[str, Any]:
    return {
        "annotation_id": path[1],
        "path": path[2],
        "stationary": added.stationary,
        "added_ns": list(added.timestamps_ns),
    }


def added_before(scene: Scene) -> Mapping[PathKey, AddedKeyframes]:
    """What bringing the scene onto the ego added, as far as the metadata report it in a form that we know."""
    entries = ours_of(scene).get(TO_EGO)
    found: dict[PathKey, AddedKeyframes] = {}
    for entry in entries if isinstance(entries, list) else []:
        if not isinstance(entry, Mapping):
            continue
        identifier, path, times = (entry.get(name) for name in ("annotation_id", "path", "added_ns"))
        if not (isinstance(identifier, str | int) and isinstance(path, int) and isinstance(times, list)):
            continue
        if all(isinstance(time_ns, int) for time_ns in times):
            added = AddedKeyframes(tuple(times), bool(entry.get("stationary")))
            found[type(identifier), identifier, path] = added
    return MappingProxyType(found)
