"""Dense depth images out of sparse ones: a depth for each pixel near measured points, and how far it can be trusted."""

from sceneloom.depth.completion import METHODS, complete_depth
from sceneloom.depth.results import DenseDepth

__all__ = ["METHODS", "DenseDepth", "complete_depth"]
