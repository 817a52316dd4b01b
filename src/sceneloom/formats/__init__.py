"""The formats: one table, each imported on first use; content decides, the suffix only proposes."""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.formats.loss import Loss, LossReport
    from sceneloom.formats.size import size_on_disk
    from sceneloom.formats.spec import FormatSpec
    from sceneloom.formats.table import FORMATS, find_format, open_scene, write_scene
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {
            "FORMATS": "sceneloom.formats.table:FORMATS",
            "FormatSpec": "sceneloom.formats.spec:FormatSpec",
            "Loss": "sceneloom.formats.loss:Loss",
            "LossReport": "sceneloom.formats.loss:LossReport",
            "find_format": "sceneloom.formats.table:find_format",
            "open_scene": "sceneloom.formats.table:open_scene",
            "size_on_disk": "sceneloom.formats.size:size_on_disk",
            "write_scene": "sceneloom.formats.table:write_scene",
        },
    )

__all__ = [
    "FORMATS",
    "FormatSpec",
    "Loss",
    "LossReport",
    "find_format",
    "open_scene",
    "size_on_disk",
    "write_scene",
]
