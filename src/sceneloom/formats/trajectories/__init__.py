"""Trajectories in files of their own: TUM, KITTI, EuRoC, GNSS, named columns, lines of JSON; or out of a scene."""

from sceneloom.formats.trajectories.content import TrajectoryFile, TrajectoryForm
from sceneloom.formats.trajectories.table import (
    TRAJECTORY_FORMS,
    find_form,
    form_for_output,
    read_trajectory,
    read_trajectory_file,
    split_name,
    write_trajectory,
)

__all__ = [
    "TRAJECTORY_FORMS",
    "TrajectoryFile",
    "TrajectoryForm",
    "find_form",
    "form_for_output",
    "read_trajectory",
    "read_trajectory_file",
    "split_name",
    "write_trajectory",
]
