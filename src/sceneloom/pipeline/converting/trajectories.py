"""A trajectory from one file or scene to a file of its own, and a drive of nothing but a trajectory."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from sceneloom.errors import UnknownFormatError, check_option_names
from sceneloom.formats.loss import Loss, LossReport
from sceneloom.formats.table import claims_of, format_and_location
from sceneloom.formats.trajectories.content import TrajectoryFile
from sceneloom.formats.trajectories.table import (
    TRAJECTORY_FORMS,
    find_form,
    read_trajectory_file,
    split_name,
    write_trajectory,
)
from sceneloom.formats.urls import is_url
from sceneloom.pipeline.converting.field_names import kinds_by_id
from sceneloom.scene.counting import contents_of
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Progress

_WRITING = ("optical", "origin_lla")
_OF_FILES = ("form", "name", "times", "rate_hz", "unit", "origin_lla", "optical", "corrections")
"""Reading options that are about trajectories, not about scenes."""


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
    return form is not None and not claims_of(Path(path))


@dataclass(frozen=True, slots=True, eq=False)
class ChosenTrajectory:
    """A trajectory on its way to a file of its own.

    Attributes:
        content: what is written.
        contents: how much of each field the source holds.
        kinds: of the source's sensors and annotations, as `kinds_by_id` gives them.
        losses: the source's other trajectories.
    """

    content: TrajectoryFile
    contents: Mapping[str, int]
    kinds: Mapping[str, str] = field(default_factory=dict)
    losses: tuple[Loss, ...] = ()

    def write(self, location: Path, *, form: str, overwrite: bool, **writing: Any) -> LossReport:
        """Write the file.

        Raises:
            OptionError: the trajectory lacks what the form needs.
            OutputError: the file exists, or cannot be written.
        """
        return write_trajectory(self.content, location, form=form, overwrite=overwrite, **writing)


def chosen_trajectory(
    source: str | Path,
    name: str | None,
    reading: Mapping[str, Any],
    writing: Mapping[str, Any],
    progress: Progress | None,
) -> ChosenTrajectory:
    """Read the trajectory that is to be written, and see what else its source holds.

    Raises:
        OptionError: an option of writing is one of scenes, or there is no trajectory of that name.
        DataError: the source is wrong.
    """
    check_option_names("writing a trajectory", writing, _WRITING)
    content = read_trajectory_file(source, name=name, progress=progress, **reading)
    if content.form in TRAJECTORY_FORMS:
        return ChosenTrajectory(content, contents_of(_drive(content, str(source), None)))
    form, location = format_and_location(split_name(source)[0], format=content.form)
    with form.open(
        location, **{key: value for key, value in reading.items() if key not in _OF_FILES}
    ) as scene:
        others = [trajectory for trajectory in scene.trajectories if trajectory != content.trajectory.name]
        what = f"not written: the file holds {content.trajectory.name!r}"
        losses = tuple(Loss(field=f"trajectories[{trajectory}]", what=what) for trajectory in others)
        return ChosenTrajectory(content, contents_of(scene), kinds_by_id(scene), losses)


def drive_of(source: str | Path, name: str | None, reading: Mapping[str, Any]) -> Scene:
    """Make a scene that holds nothing but the trajectory of a file.

    Raises:
        DataError: the source is wrong.
    """
    return _drive(read_trajectory_file(source, name=name, **reading), str(source), name)


def _drive(content: TrajectoryFile, source: str, name: str | None) -> Scene:
    if content.fixes is not None:
        fixes = replace(content.fixes, id="gnss")
        return Scene((fixes,), source=source, format=content.form, warnings=content.warnings)
    trajectory = content.trajectory if name is None else replace(content.trajectory, name=name)
    return Scene(
        (),
        trajectories={trajectory.name: trajectory},
        source=source,
        format=content.form,
        warnings=content.warnings,
    )
