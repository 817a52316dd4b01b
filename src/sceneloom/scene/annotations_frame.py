"""The frame in which a scene's annotations have their locations."""

from collections.abc import Mapping
from typing import Any

from sceneloom.errors import DataError, OptionError
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Coordinates

ANNOTATIONS_FRAME = "annotations_frame"
"""Our entry of the metadata that names it."""


def annotations_frame(scene: Scene) -> Coordinates:
    """The frame that the metadata name, else the world.

    Raises:
        DataError: what they name is no frame.
    """
    ours: Any = scene.metadata.get("sceneloom")
    named = ours.get(ANNOTATIONS_FRAME) if isinstance(ours, Mapping) else None
    if named is None:
        return Coordinates.WORLD
    if named not in tuple(Coordinates):
        location = f"metadata.sceneloom.{ANNOTATIONS_FRAME}"
        raise DataError(scene.source, location, f"{named!r}; expected one of {', '.join(Coordinates)}")
    return Coordinates(named)


def not_in_world(source: str) -> OptionError:
    """What to state of a scene of that name whose annotations are on the ego, where they are needed in the world."""
    return OptionError(
        f"{source}: its annotations are in the ego frame; bring them into the world first: `sceneloom edit to-world`"
    )
