"""Scenes brought into the world and the words of another one, before they are merged with it."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.editing.frame_change import FrameChange
from sceneloom.editing.moved_world import moved_world
from sceneloom.editing.record import assumed, ours_of, with_notices, with_ours
from sceneloom.editing.sameness import is_same
from sceneloom.errors import CalibrationError, DataError, OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import Annotation, CuboidAnnotation, CuboidPath, Scene
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations_frame import annotations_frame

WORLD_FROM_FILE = "world_from_file"
"""Our entry of the metadata with the transform that an earlier edit took off all places in the world."""

_SAME_WORLD = 1e-9
"""Transforms that differ by no more are one [m], [rad]."""


def in_world_of(scene: Scene, first: Scene) -> Scene:
    """Give a scene in the world of another one, as far as their metadata tell how the two are related.

    Raises:
        DataError: the metadata of one hold no rigid transform where they should.
    """
    mine, other = world_from_file(scene), world_from_file(first)
    if mine is None and other is None:
        return scene
    here = RigidTransform.identity() if mine is None else mine
    there = RigidTransform.identity() if other is None else other
    first_from_here = there.inverse() @ here
    told = scene
    if mine is None or other is None:
        which = scene if mine is None else first
        what = "nothing says that its origin was moved; taken to be the world that the others were moved from"
        told = with_notices(scene, [assumed("worlds-related", which.source, what)])
    if np.abs(first_from_here.matrix - np.eye(4)).max() > _SAME_WORLD:
        told = moved_world(told, FrameChange.constant(first_from_here))
    entry = ours_of(first).get(WORLD_FROM_FILE)
    return with_ours(told, **{WORLD_FROM_FILE: entry})


def world_from_file(scene: Scene) -> RigidTransform | None:
    """The transform that was taken off a scene's places; None where none is named.

    Raises:
        DataError: what is named is no rigid transform.
    """
    named: Any = ours_of(scene).get(WORLD_FROM_FILE)
    if named is None:
        return None
    place = f"metadata.sceneloom.{WORLD_FROM_FILE}"
    try:
        matrix: Float64Array = np.array(named, np.float64)
        return RigidTransform.nearest(matrix)[0]
    except (TypeError, ValueError, CalibrationError):
        raise DataError(scene.source, place, f"{named!r}; expected a rigid 4x4 matrix") from None


def in_words_of(scene: Scene, first: Scene) -> Scene:
    """Give a scene whose cuboids have their angles in the unit and order of another one.

    Raises:
        OptionError: the annotations of one are in the world and those of the other on the ego.
    """
    frames = {annotations_frame(one) for one in (scene, first) if one.annotations}
    if len(frames) > 1:
        raise OptionError(
            f"{scene.source}: its annotations are in the {annotations_frame(scene)} frame, those of {first.source} in "
            f"the {annotations_frame(first)} frame; bring both into the world first: `sceneloom edit to-world`"
        )
    mine, theirs = CuboidAngles.of(scene), CuboidAngles.of(first)
    there = any(isinstance(annotation, CuboidAnnotation) for annotation in scene.annotations)
    if mine == theirs or not there:
        return scene
    annotations = tuple(_said_otherwise(annotation, mine, theirs) for annotation in scene.annotations)
    changed = replace(scene, annotations=annotations)
    return with_ours(changed, euler_unit=str(theirs.unit), euler_order=theirs.order)


def _said_otherwise(annotation: Annotation, mine: CuboidAngles, theirs: CuboidAngles) -> Annotation:
    if not isinstance(annotation, CuboidAnnotation):
        return annotation
    path = annotation.path
    return replace(
        annotation,
        path=CuboidPath(path.timestamps_ns, _rows(path.values, mine, theirs), path.extras),
        activations=tuple(
            entry if entry.cuboids is None else replace(entry, cuboids=_rows(entry.cuboids, mine, theirs))
            for entry in annotation.activations
        ),
        projections=tuple(
            entry if entry.cuboids is None else replace(entry, cuboids=_rows(entry.cuboids, mine, theirs))
            for entry in annotation.projections
        ),
    )


def _rows(rows: Float64Array, mine: CuboidAngles, theirs: CuboidAngles) -> Float64Array:
    said = rows.copy()
    there = np.isfinite(rows[:, 6:]).all(axis=1)
    said[there, 6:] = theirs.from_quaternions(mine.quaternions(rows[there, 6:]))
    return said


def merged_metadata(first: Mapping[str, Any], second: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """The fields of both; of those that differ the first's. Gives the names of these, too."""
    differing = [name for name in first.keys() & second.keys() if not is_same(first[name], second[name])]
    return {**second, **first}, sorted(differing)
