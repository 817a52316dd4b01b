"""Drives in Rerun's viewer: every sensor, annotation and result on one clock, in one world."""

from sceneloom.view.report import DriveShown, ViewReport
from sceneloom.view.saving import save_view
from sceneloom.view.settings import ColourBy, DrivePart, ViewSettings
from sceneloom.view.showing import Viewer, show_view

__all__ = [
    "ColourBy",
    "DrivePart",
    "DriveShown",
    "ViewReport",
    "ViewSettings",
    "Viewer",
    "save_view",
    "show_view",
]
