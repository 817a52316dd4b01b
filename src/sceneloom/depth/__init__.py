"""Dense depth images out of sparse ones: a depth for each pixel near measured points, and how far it can be trusted."""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.depth.completion import METHODS, complete_depth
    from sceneloom.depth.results import DenseDepth
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {
            "METHODS": "sceneloom.depth.completion:METHODS",
            "DenseDepth": "sceneloom.depth.results:DenseDepth",
            "complete_depth": "sceneloom.depth.completion:complete_depth",
        },
    )

__all__ = [
    "METHODS",
    "DenseDepth",
    "complete_depth",
]
