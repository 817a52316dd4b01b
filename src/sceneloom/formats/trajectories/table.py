"""The table of the forms, and a trajectory read from and written to whatever holds one."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.errors import OptionError, PoseError, UnknownFormatError, check_option_names
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.loss import LossReport
from sceneloom.formats.output import replacing_together
from sceneloom.formats.table import claims_of, format_and_location, format_names
from sceneloom.formats.trajectories import euroc, gnss, jsonl, kitti, named_columns, tum
from sceneloom.formats.trajectories.axes import from_optical, to_optical
from sceneloom.formats.trajectories.content import Reading, TrajectoryFile, TrajectoryForm
from sceneloom.formats.trajectories.first_lines import beginning
from sceneloom.formats.trajectories.scenes import is_scene_name, read_scene_trajectory
from sceneloom.formats.urls import is_url
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.types import Progress

TRAJECTORY_FORMS: Mapping[str, TrajectoryForm] = MappingProxyType(
    {module.FORM.name: module.FORM for module in (tum, kitti, euroc, gnss, named_columns, jsonl)}
)
"""The forms of files by name; of two that recognise a file the first counts."""

FORM_NAMES = tuple(TRAJECTORY_FORMS)

OWN_SUFFIXES = {".tum", ".kitti", ".jsonl"}
"""Suffixes that nothing but one form has."""


_READING = ("form", "name", "times", "rate_hz", "unit", "origin_lla", "optical", "lenient")


def split_name(path: str | Path) -> tuple[str | Path, str | None]:
    """Take `PATH:NAME` apart; a path that exists as it stands has no name in it."""
    text = str(path)
    if is_url(text) or ":" not in text or Path(text).exists():
        return path, None
    before, _, name = text.partition(":")
    while name and not Path(before).exists() and ":" in name:
        further, _, name = name.partition(":")
        before = f"{before}:{further}"
    return (before, name) if name and Path(before).exists() else (path, None)


def read_trajectory_file(
    path: str | Path,
    *,
    form: str | None = None,
    name: str | None = None,
    times: str | Path | None = None,
    rate_hz: float | None = None,
    unit: str | None = None,
    origin_lla: Sequence[float] | None = None,
    optical: bool = False,
    lenient: bool = False,
    progress: Progress | None = None,
    **options: Any,
) -> TrajectoryFile:
    """Read a trajectory with all that its file says of it; `read_trajectory` describes the arguments.

    Raises:
        UnknownFormatError: no form or format fits the path.
        DataError: the content is wrong.
        OptionError: an argument is, or there is no trajectory of that name.
        PoseError: a scene has no trajectory, or it cannot be found.
    """
    where, named = split_name(path)
    reading = Reading(
        name=name or named,
        times=None if times is None else Path(times),
        rate_hz=rate_hz,
        unit=unit,
        origin_lla=None if origin_lla is None else _origin(origin_lla),
    )
    chosen = _form_named(form) if form is not None else find_form(where)
    if form is None and chosen is jsonl.FORM and is_scene_name(reading.name):
        chosen = None
    if times is not None and (chosen is None or chosen.name != "kitti"):
        raise OptionError(
            f"{where}: has its own times; those of {times} would not be used, and are for KITTI's poses"
        )
    _check_used(where, chosen, reading)
    if chosen is None:
        scene_form, location = format_and_location(where, format=form)
        options = {**options, **({"lenient": True} if lenient else {})}
        content = read_scene_trajectory(scene_form, location, reading, options, progress)
    else:
        check_option_names(f"opening a trajectory ({chosen.name})", options, _READING)
        ledger = Ledger(lenient=lenient)
        with ledger.telling():
            content = chosen.read(Path(where), reading, ledger)
        content = replace(content, warnings=ledger.warnings)
    return from_optical(content) if optical else content


def _check_used(path: str | Path, form: TrajectoryForm | None, reading: Reading) -> None:
    """Refuse what would be ignored: a rate or unit of times that are known, an origin of positions in metres.

    Raises:
        OptionError: naming the option, and what it is for.
    """
    what = "scenes" if form is None else f"the form {form.name!r}"
    if reading.rate_hz is not None and form is not kitti.FORM:
        raise OptionError(
            f"{path}: {what} has its own times; the rate {reading.rate_hz:g} Hz would not be used, and is for KITTI's "
            "poses: leave it out"
        )
    if reading.unit is not None and (form is None or (form is kitti.FORM and reading.rate_hz is not None)):
        raise OptionError(
            f"{path}: no times in a text are read here; the unit {reading.unit!r} would not be used: leave it out"
        )
    if reading.origin_lla is not None and form not in (None, gnss.FORM):
        raise OptionError(
            f"{path}: {what} has positions in metres; the origin would not be used, and is for satellite fixes: "
            "leave it out"
        )


def read_trajectory(path: str | Path, **options: Any) -> Trajectory:
    """Read a trajectory from a file of any form, or from a scene or recording.

    Args:
        path: a file or folder; `PATH:NAME` names one of several trajectories.
        options: `form`, a name out of `TRAJECTORY_FORMS` or of a format of scenes, where the content should not
            decide; `name` of one of several trajectories; `times`, a file with one time per line, or `rate_hz`, for
            KITTI files; `unit` of the times in a text ("seconds" … "nanoseconds"); `origin_lla`, latitude [deg],
            longitude [deg] and altitude [m] that positions of fixes are seen from, else their first; `optical`, whether
            the poses are of a camera's axes, to be rotated to x forward, y left, z up; `lenient`, to leave out bad
            lines and second poses of one time; `progress`, reported after each sweep where a trajectory is found from
            the sweeps; others go to the format of a scene.

    Returns:
        Poses of the device in the world, times exact, positions and orientations as the file has them.

    Raises:
        UnknownFormatError: no form or format fits the path.
        DataError: the content is wrong; the message names file and line.
        OptionError: an argument is wrong, or there is no trajectory of that name.
        PoseError: a scene has no trajectory, or it cannot be found.
    """
    return read_trajectory_file(path, **options).trajectory


def write_trajectory(
    trajectory: Trajectory | Poses | TrajectoryFile,
    path: str | Path,
    *,
    form: str | None = None,
    origin_lla: Sequence[float] | None = None,
    optical: bool = False,
    overwrite: bool = False,
) -> LossReport:
    """Write a trajectory to a file.

    Args:
        trajectory: what to write; a `TrajectoryFile` brings what else its file stated.
        path: the file to write; its suffix chooses the form unless `form` does.
        form: a name out of `TRAJECTORY_FORMS`.
        origin_lla: latitude [deg], longitude [deg] and altitude [m] of the world's origin, for the form `gnss`.
        optical: whether to rotate the axes from x forward, y left, z up to those of cameras.
        overwrite: whether a file that exists may be replaced.

    Returns:
        What the form has no field for.

    Raises:
        OptionError: no form has that suffix or name, or the trajectory lacks what the form needs.
        PoseError: a path is one pose for all times.
        OutputError: the file exists, or cannot be written.
    """
    target = Path(path)
    chosen = form_for_output(target) if form is None else _form_named(form)
    if chosen is None:
        raise OptionError(f"form {form!r} is one of scenes; expected one of: {', '.join(FORM_NAMES)}")
    content = content_of(trajectory)
    if origin_lla is not None:
        content = replace(content, origin_lla=_origin(origin_lla))
    content = to_optical(content) if optical else content
    targets = [target] if chosen.beside is None else [target, chosen.beside(target)]
    with replacing_together(targets, overwrite=overwrite) as (draft, *_):
        return LossReport.of(chosen.write(content, draft, target))


def content_of(trajectory: Trajectory | Poses | TrajectoryFile) -> TrajectoryFile:
    """A trajectory or a path of poses with nothing besides; what a file stated as it is.

    Raises:
        PoseError: a path is one pose for all times.
    """
    if isinstance(trajectory, TrajectoryFile):
        return trajectory
    if isinstance(trajectory, Trajectory):
        return TrajectoryFile(trajectory)
    if trajectory.static:
        raise PoseError("a pose that holds at all times is no way; expected poses with a time each")
    return TrajectoryFile(
        Trajectory("poses", trajectory.timestamps_ns, trajectory.positions, trajectory.quaternions_xyzw)
    )


def find_form(path: str | Path) -> TrajectoryForm | None:
    """The form whose look the beginning of a file has; None for what a format of scenes opens.

    Raises:
        UnknownFormatError: the path is missing, or neither a form nor a format knows it.
    """
    if is_url(path) or Path(path).is_dir():
        return None
    where = Path(path)
    if not where.exists():
        raise UnknownFormatError(path, "", "no such file or folder")
    claims = {form.name for form in claims_of(where)}
    if claims - {"recording"}:
        return None
    text = None if where.name == "data.jsonl" else beginning(where)
    if text is not None:
        forms = TRAJECTORY_FORMS.values()
        found = next((form for form in forms if form.recognises(text)), None)
        # a suffix of its own reports the form of a file that is torn, whose fault can then be named
        found = found or next(
            (form for form in forms if where.suffix.lower() in OWN_SUFFIXES & {*form.suffixes}), None
        )
        if found is not None:
            return found
    if claims:
        return None
    known = "; ".join(f"{form.name}, {form.looks_like}" for form in TRAJECTORY_FORMS.values())
    raise UnknownFormatError(
        path, "", f"no trajectory is recognised in it; expected a scene, or one of: {known}"
    )


def form_for_output(path: Path) -> TrajectoryForm:
    """The form that a path to be written asks for by its suffix.

    Raises:
        OptionError: no form has that suffix.
    """
    for form in TRAJECTORY_FORMS.values():
        if path.suffix.lower() in form.suffixes:
            return form
    known = ", ".join(
        f"{form.name} ({' '.join(form.suffixes) or 'by name'})" for form in TRAJECTORY_FORMS.values()
    )
    raise OptionError(
        f"{path}: suffix {path.suffix!r} belongs to no form of trajectories; expected one of: {known}"
    )


def _form_named(name: str) -> TrajectoryForm | None:
    """The form of that name; None for a format of scenes."""
    if name not in TRAJECTORY_FORMS and name not in format_names():
        known = ", ".join((*FORM_NAMES, *format_names()))
        raise OptionError(f"no form of trajectories {name!r}; there are {known}")
    return TRAJECTORY_FORMS.get(name)


def _origin(origin_lla: Sequence[float]) -> Float64Array:
    origin = np.asarray(origin_lla, np.float64)
    inside = origin.shape == (3,) and bool((np.abs(origin) <= (90, 180, 1e8)).all())
    if not inside:
        reported = list(map(float, origin.ravel()))
        raise OptionError(
            f"origin {reported}; expected latitude and longitude in degrees, altitude in metres"
        )
    return origin
