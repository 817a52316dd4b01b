"""A trajectory from one file or scene to a file of its own, and a drive of nothing but a trajectory."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from sceneloom.errors import UnknownFormatError, check_option_names
from sceneloom.formats.loss import LossReport
from sceneloom.formats.table import format_named, format_names
from sceneloom.formats.trajectories import (
    TRAJECTORY_FORMS,
    TrajectoryFile,
    find_form,
    form_for_output,
    read_trajectory_file,
    write_trajectory,
)
from sceneloom.formats.urls import is_url
from sceneloom.scene import Notice, Scene
from sceneloom.scene.types import Progress

_WRITING = ("optical", "origin_lla")
Told = tuple[str, str, tuple[Notice, ...], LossReport]
"""Form of the source and of the target, notices of the reading, losses of the writing."""


def is_trajectory_file(path: Path) -> bool:
    """Whether a path to be written has the suffix of a form of trajectories."""
    return any(path.suffix.lower() in form.suffixes for form in TRAJECTORY_FORMS.values())


def holds_trajectory_only(path: str | Path) -> bool:
    """Whether what is there is a file of a trajectory, and no scene; logs of JSON lines are both, thus scenes."""
    if is_url(path) or not Path(path).is_file():
        return False
    try:
        form = find_form(path)
    except UnknownFormatError:
        return False
    return form is not None and not any(
        known.recognises(Path(path)) for known in map(format_named, format_names())
    )


def write_trajectory_file(
    source: str | Path,
    target: Path,
    *,
    name: str | None,
    to: str | None,
    overwrite: bool,
    reading: Mapping[str, Any],
    writing: Mapping[str, Any],
    progress: Progress | None = None,
) -> Told:
    """Take a trajectory out of a file or a scene and write it to a file of its own.

    Raises:
        OptionError: an option of writing is one of scenes, or there is no trajectory of that name.
        DataError: the source is wrong.
        OutputError: the target exists, or cannot be written.
    """
    check_option_names("writing a trajectory", writing, _WRITING)
    form = form_for_output(target).name if to is None else to
    content = read_trajectory_file(source, name=name, progress=progress, **reading)
    losses = write_trajectory(content, target, form=form, overwrite=overwrite, **writing)
    return content.form, form, content.notices, losses


def write_drive(
    source: str | Path,
    write: Callable[[Scene], LossReport],
    *,
    name: str | None,
    reading: Mapping[str, Any],
) -> Told:
    """Write a scene that holds nothing but the trajectory of a file.

    Raises:
        DataError: the source is wrong.
        OutputError: the target exists, or cannot be written.
    """
    content = read_trajectory_file(source, name=name, **reading)
    losses = write(_drive_of(content, str(source), name))
    return content.form, "", content.notices, losses


def _drive_of(content: TrajectoryFile, source: str, name: str | None) -> Scene:
    if content.fixes is not None:
        fixes = replace(content.fixes, id="gnss")
        return Scene((fixes,), source=source, format=content.form, notices=content.notices)
    way = content.trajectory if name is None else replace(content.trajectory, name=name)
    return Scene(
        (), trajectories={way.name: way}, source=source, format=content.form, notices=content.notices
    )
