"""Differences between two scenes, field by field, with tolerances."""

from sceneloom.editing.differences.report import Change, Difference, SceneDifferences
from sceneloom.editing.differences.scenes import diff_scenes
from sceneloom.editing.differences.tolerances import Tolerances

__all__ = ["Change", "Difference", "SceneDifferences", "Tolerances", "diff_scenes"]
