"""Drives in Rerun's viewer: every sensor, annotation and result on one clock, in one world."""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.view.settings import ColourBy, DrivePart, DriveShown, ViewReport, ViewSettings
    from sceneloom.view.viewer import Viewer, save_view, show_view
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {
            "ColourBy": "sceneloom.view.settings:ColourBy",
            "DrivePart": "sceneloom.view.settings:DrivePart",
            "DriveShown": "sceneloom.view.settings:DriveShown",
            "ViewReport": "sceneloom.view.settings:ViewReport",
            "ViewSettings": "sceneloom.view.settings:ViewSettings",
            "Viewer": "sceneloom.view.viewer:Viewer",
            "save_view": "sceneloom.view.viewer:save_view",
            "show_view": "sceneloom.view.viewer:show_view",
        },
    )

__all__ = ["ColourBy", "DrivePart", "DriveShown", "ViewReport", "ViewSettings", "Viewer", "save_view", "show_view"]
