"""One image for each type of annotation that a scene has, in the view that shows that type best."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from types import MappingProxyType

from sceneloom.images.annotations.above import draw_annotations_above
from sceneloom.images.annotations.corrections import draw_adjustment, draw_calibration
from sceneloom.images.annotations.figures import same_id
from sceneloom.images.annotations.in_image import draw_annotations_in_image
from sceneloom.images.annotations.timeline import draw_timeline
from sceneloom.images.canvas import PilImage
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.corrections import CameraCalibration, LocalizationAdjustment
from sceneloom.scene.annotations.relations import GroupAnnotation, LinkAnnotation, ObjectAnnotation
from sceneloom.scene.sample import Sample
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier

Drawing = tuple[str, Callable[[], PilImage]]
_Draw = Callable[[Scene, Sample | None, str], PilImage]

_REACH = 20.0
"""From the ego to the upper edge of a map that shows how annotations belong together [m]."""


def plots_by_type(scene: Scene, sample: Sample | None) -> Iterator[Drawing]:
    """Name each type of annotation that the scene has, and state how to draw it: alone, and what it belongs to."""
    for type_name in dict.fromkeys(str(annotation.type) for annotation in scene.annotations):
        chosen = [a for a in scene.annotations if str(a.type) == type_name]
        shown = replace(scene, annotations=(*chosen, *_related(scene, chosen)), attributes=())
        draw = _VIEWS.get(type_name, _in_image)
        yield type_name, partial(draw, shown, sample, type_name)


def _related(scene: Scene, chosen: list[Annotation]) -> list[Annotation]:
    """What links join and what belongs to groups and objects."""
    ends: list[Identifier] = []
    parents: list[Identifier] = []
    for annotation in chosen:
        if isinstance(annotation, LinkAnnotation):
            ends += [annotation.from_id, annotation.to_id]
        elif isinstance(annotation, GroupAnnotation | ObjectAnnotation):
            parents.append(annotation.id)
    return [
        a
        for a in scene.annotations
        if not any(a is other for other in chosen)
        and (
            any(same_id(a.id, end) for end in ends)
            or any(same_id(getattr(a, "parent_id", None), parent) for parent in parents)
        )
    ]


def _in_image(scene: Scene, sample: Sample | None, type_name: str) -> PilImage:
    """In the image of the camera that a shape in images names, else of the first one; else from above."""
    seen = [] if sample is None else [key for key, image in sample.images.items() if image is not None]
    if sample is None or not seen:
        return _above(scene, sample, type_name)
    named = [getattr(annotation, "sensor_id", None) for annotation in scene.annotations]
    camera_id = next((key for key in seen if any(same_id(key, name) for name in named)), seen[0])
    return draw_annotations_in_image(scene, sample, camera_id, title=type_name)


def _above(scene: Scene, sample: Sample | None, type_name: str) -> PilImage:
    if sample is None:
        return draw_timeline(scene, title=type_name)
    return draw_annotations_above(scene, sample, title=type_name, reach=_REACH)


def _over_time(scene: Scene, sample: Sample | None, type_name: str) -> PilImage:
    del sample
    return draw_timeline(scene, title=type_name)


def _adjustment(scene: Scene, sample: Sample | None, type_name: str) -> PilImage:
    del sample, type_name
    chosen = next(a for a in scene.annotations if isinstance(a, LocalizationAdjustment))
    return draw_adjustment(scene, chosen)


def _calibration(scene: Scene, sample: Sample | None, type_name: str) -> PilImage:
    chosen = next(a for a in scene.annotations if isinstance(a, CameraCalibration))
    if sample is None or chosen.sensor_id not in sample.cameras:
        return draw_timeline(scene, title=type_name)
    return draw_calibration(sample, chosen)


_VIEWS: Mapping[str, _Draw] = MappingProxyType(
    {
        "link": _above,
        "group": _above,
        "object": _above,
        "event": _over_time,
        "attributes": _over_time,
        "localization_adjustment": _adjustment,
        "camera_calibration": _calibration,
    }
)
"""What shows best from above, over time, or in a view of its own; everything else is shown in an image."""
