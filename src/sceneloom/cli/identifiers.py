"""Ids of sensors and annotations as they are typed: all of them texts, though `7` may be a number in the scene."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sceneloom.scene.scene import Scene
    from sceneloom.scene.types import Identifier


def known_id(scene: "Scene", stated: str) -> "Identifier":
    """The id of a sensor as the scene has it; the text itself where no sensor has such an id."""
    ids = [sensor.id for sensor in scene.sensors]
    return next((found for found in ids if stated not in ids and str(found) == stated), stated)


def known_id_or_none(scene: "Scene", stated: str | None) -> "Identifier | None":
    """The id of a sensor as the scene has it; None where none was stated."""
    return None if stated is None else known_id(scene, stated)


def known_ids(scene: "Scene", stated: Iterable[str]) -> "tuple[Identifier, ...] | None":
    """The ids of sensors as the scene has them; None where none was stated."""
    return tuple(known_id(scene, one) for one in stated) or None
