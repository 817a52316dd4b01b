"""Places in pictures that nobody is to see: found, and hidden for good."""

from sceneloom.editing.hiding.boxes import Hiding, PictureBox, find_hidings
from sceneloom.editing.hiding.filling import FILLS, filled
from sceneloom.editing.hiding.hide import hide_in_pictures, regions_of
from sceneloom.editing.hiding.regions import HiddenRegions, hidden_regions

__all__ = [
    "FILLS",
    "HiddenRegions",
    "Hiding",
    "PictureBox",
    "filled",
    "find_hidings",
    "hidden_regions",
    "hide_in_pictures",
    "regions_of",
]
