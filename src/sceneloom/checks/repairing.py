"""What fixes of annotations share: a scene in which nothing had to be repaired stays the very same object."""

from collections.abc import Callable
from dataclasses import replace

from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.scene import Scene


def repaired_annotations(scene: Scene, repair: Callable[[Annotation], Annotation]) -> Scene:
    """Repair each annotation; `repair` gives back those that need nothing as they are."""
    annotations = tuple(map(repair, scene.annotations))
    if all(new is old for new, old in zip(annotations, scene.annotations, strict=True)):
        return scene
    return replace(scene, annotations=annotations)
