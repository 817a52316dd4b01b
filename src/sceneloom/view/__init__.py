"""Drives in Rerun's viewer: every sensor, annotation and result on one clock, in one world."""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.view.report import DriveShown, ViewReport
    from sceneloom.view.saving import save_view
    from sceneloom.view.settings import ColourBy, DrivePart, ViewSettings
    from sceneloom.view.showing import Viewer, show_view
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {
            "ColourBy": "sceneloom.view.settings:ColourBy",
            "DrivePart": "sceneloom.view.settings:DrivePart",
            "DriveShown": "sceneloom.view.report:DriveShown",
            "ViewReport": "sceneloom.view.report:ViewReport",
            "ViewSettings": "sceneloom.view.settings:ViewSettings",
            "Viewer": "sceneloom.view.showing:Viewer",
            "save_view": "sceneloom.view.saving:save_view",
            "show_view": "sceneloom.view.showing:show_view",
        },
    )

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
