"""What an edit leaves behind besides the scene itself: warnings, and entries in our part of the metadata."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from sceneloom.scene.scene import Scene
from sceneloom.scene.warnings import DataWarning, WarningKind

OURS = "sceneloom"
"""Name of our part of a scene's metadata."""


def ours_of(scene: Scene) -> Mapping[str, Any]:
    """Our part of a scene's metadata; empty where there is none."""
    ours = scene.metadata.get(OURS)
    return ours if isinstance(ours, Mapping) else {}


def with_ours(scene: Scene, **entries: Any) -> Scene:
    """The scene with some of our entries of the metadata set; None takes one away."""
    reported = {name: value for name, value in {**ours_of(scene), **entries}.items() if value is not None}
    free = {name: value for name, value in scene.metadata.items() if name != OURS}
    return replace(scene, metadata=MappingProxyType({**free, **({OURS: reported} if reported else {})}))


def with_warnings(scene: Scene, warnings: Iterable[DataWarning]) -> Scene:
    """The scene with further warnings; those that count nothing are left out."""
    reported = tuple(warning for warning in warnings if warning.count > 0)
    return replace(scene, warnings=(*scene.warnings, *reported)) if reported else scene


def skipped(code: str, location: str, message: str, *, count: int = 1) -> DataWarning:
    """A warning that something was left out."""
    return DataWarning(kind=WarningKind.SKIPPED, code=code, location=location, message=message, count=count)


def assumed(code: str, location: str, message: str, *, count: int = 1) -> DataWarning:
    """A warning that something is not stated and was taken to be so."""
    return DataWarning(kind=WarningKind.ASSUMED, code=code, location=location, message=message, count=count)
