"""Drives that tell neither where nor, on request, when they were: all is counted from their own beginning."""

from sceneloom.editing.relative.clock import clock_from_zero
from sceneloom.editing.relative.fields import FieldSweep, Telltale
from sceneloom.editing.relative.places import FIXES, places_from_start
from sceneloom.editing.relative.scene import DATES, relative_scene

__all__ = [
    "DATES",
    "FIXES",
    "FieldSweep",
    "Telltale",
    "clock_from_zero",
    "places_from_start",
    "relative_scene",
]
