"""The formats: one table, each imported on first use; content decides, the suffix only proposes."""

from sceneloom.formats.loss import Loss, LossReport
from sceneloom.formats.size import size_on_disk
from sceneloom.formats.table import FORMATS, Format, find_format, open_scene, write_scene

__all__ = [
    "FORMATS",
    "Format",
    "Loss",
    "LossReport",
    "find_format",
    "open_scene",
    "size_on_disk",
    "write_scene",
]
