"""The formats: one table, each imported on first use; content decides, the suffix only proposes."""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.formats.base.files import size_on_disk
    from sceneloom.formats.base.losses import Loss, LossReport
    from sceneloom.formats.base.registry import FORMATS, open_scene, write_scene
    from sceneloom.formats.base.spec import FormatSpec
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {
            "base.files": "size_on_disk",
            "base.losses": "Loss LossReport",
            "base.registry": "FORMATS open_scene write_scene",
            "base.spec": "FormatSpec",
        },
    )

__all__ = ["FORMATS", "FormatSpec", "Loss", "LossReport", "open_scene", "size_on_disk", "write_scene"]
