"""What an edit leaves behind besides the scene itself: notices, and entries in our part of the metadata."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from sceneloom.scene.notices import Notice, NoticeKind
from sceneloom.scene.scene import Scene

OURS = "sceneloom"
"""Name of our part of a scene's metadata."""


def ours_of(scene: Scene) -> Mapping[str, Any]:
    """Our part of a scene's metadata; empty where there is none."""
    ours = scene.metadata.get(OURS)
    return ours if isinstance(ours, Mapping) else {}


def with_ours(scene: Scene, **entries: Any) -> Scene:
    """The scene with some of our entries of the metadata set; None takes one away."""
    told = {name: value for name, value in {**ours_of(scene), **entries}.items() if value is not None}
    free = {name: value for name, value in scene.metadata.items() if name != OURS}
    return replace(scene, metadata=MappingProxyType({**free, **({OURS: told} if told else {})}))


def with_notices(scene: Scene, notices: Iterable[Notice]) -> Scene:
    """The scene with further notices; those that count nothing are left out."""
    told = tuple(notice for notice in notices if notice.count > 0)
    return replace(scene, notices=(*scene.notices, *told)) if told else scene


def skipped(code: str, place: str, message: str, *, count: int = 1) -> Notice:
    """A notice that something was left out."""
    return Notice(kind=NoticeKind.SKIPPED, code=code, place=place, message=message, count=count)


def assumed(code: str, place: str, message: str, *, count: int = 1) -> Notice:
    """A notice that something is not said and was taken to be so."""
    return Notice(kind=NoticeKind.ASSUMED, code=code, place=place, message=message, count=count)
