"""Drives in Rerun's viewer: every sensor, annotation and result on one clock, in one world."""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.view.settings import ColourBy, DrivePart, DriveShown, ViewReport, ViewSettings
    from sceneloom.view.viewer import Viewer, save_view, show_view
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {"settings": "ColourBy DrivePart DriveShown ViewReport ViewSettings", "viewer": "Viewer save_view show_view"},
    )

__all__ = ["ColourBy", "DrivePart", "DriveShown", "ViewReport", "ViewSettings", "Viewer", "save_view", "show_view"]
