"""The algorithms of both fusions by name: those built in, and those that other packages bring."""

from collections.abc import Mapping
from enum import IntEnum
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from types import MappingProxyType
from typing import Any

from sceneloom.errors import OptionError


class FusionType(IntEnum):
    """What is fused.

    Source: DB34/T 4101-2022, table 2, row 1.
    """

    SENSOR_DATA = 0
    DETECTIONS = 1


ENTRY_POINT_GROUPS: Mapping[FusionType, str] = MappingProxyType(
    {
        FusionType.SENSOR_DATA: "sceneloom.sensor_data_fusion",
        FusionType.DETECTIONS: "sceneloom.detection_fusion",
    }
)
"""Under which group of entry points a package offers an algorithm of each type.

What it names is called as `colouring.algorithms.FusionAlgorithm` or `detections.DetectionAlgorithm`.
"""

BUILT_IN: Mapping[FusionType, Mapping[str, str]] = MappingProxyType(
    {
        FusionType.SENSOR_DATA: {
            "projection": "sceneloom.colouring.algorithms:fuse_by_projection",
            "blending": "sceneloom.colouring.algorithms:fuse_by_blending",
        },
        FusionType.DETECTIONS: {"projection": "sceneloom.detections.projection:fuse_by_projection"},
    }
)
"""Algorithms of our own, by type and name."""

NEEDS: Mapping[str, str] = MappingProxyType(
    {
        "MV3d": "a trained network of Chen et al. 2017 (Multi-View 3D Object Detection), which no package here "
        "provides; a plug-in can, as an entry point of that name",
    }
)
"""Algorithms that are known by name and not built in, and what they need.

Source: DB34/T 4101-2022, table 2, row 7 gives MV3d as its example.
"""


def names(fusion_type: FusionType) -> tuple[str, ...]:
    """All algorithms of a type that are installed, those built in first."""
    brought = sorted(entry.name for entry in _brought(fusion_type))
    return tuple(dict.fromkeys((*BUILT_IN[fusion_type], *brought)))


def algorithm(fusion_type: FusionType, name: str) -> Any:
    """Give an algorithm by its name; one that is built in is never replaced.

    Raises:
        OptionError: none of that name is installed, or what brings it cannot be loaded.
    """
    target = BUILT_IN[fusion_type].get(name)
    if target is not None:
        module, attribute = target.split(":")
        return getattr(import_module(module), attribute)
    found = [entry for entry in _brought(fusion_type) if entry.name == name]
    if not found:
        needs = f"; {name} needs {NEEDS[name]}" if name in NEEDS else ""
        raise OptionError(f"fusion_algorithm {name!r}; there are {', '.join(names(fusion_type))}{needs}")
    try:
        return found[0].load()
    except Exception as error:  # whatever a foreign package does while it is imported
        raise OptionError(
            f"fusion_algorithm {name!r} of {found[0].value} cannot be loaded: {error}"
        ) from error


def _brought(fusion_type: FusionType) -> tuple[EntryPoint, ...]:
    return tuple(entry_points(group=ENTRY_POINT_GROUPS[fusion_type]))
