"""The table of trajectory formats; a trajectory read from and written to any of them, or read from a scene."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, read_only
from sceneloom.errors import OptionError, PoseError, UnknownFormatError, check_option_names
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import file_faults, is_url, open_file
from sceneloom.formats.base.losses import LossReport
from sceneloom.formats.base.output import replacing_together
from sceneloom.formats.base.registry import chosen_corrections, claims_of, format_and_location, format_names
from sceneloom.formats.base.spec import FormatSpec
from sceneloom.formats.trajectories.text_formats import of_fixes
from sceneloom.formats.trajectories.trajectory_file import Reading, TrajectoryFile, TrajectoryForm
from sceneloom.lazy import imported
from sceneloom.motion.ego_trajectory import GNSS, RESERVED, usable_fixes
from sceneloom.scene.ego import stated_origin
from sceneloom.scene.motion import GnssSensor
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Corrections, Scene
from sceneloom.scene.types import Progress
from sceneloom.warnings import DataWarning, WarningKind

_BEGINNING = 65_536


def _beginning(path: Path) -> str | None:
    """The first lines of a file that is a text, else None; a line that is cut off is left out."""
    with file_faults(path), open_file(path) as file:
        raw = file.read(_BEGINNING + 1)
    if b"\0" in raw:
        return None
    whole = raw if len(raw) <= _BEGINNING else raw[: raw.rfind(b"\n") + 1]
    try:
        return whole.decode("utf-8-sig")
    except UnicodeDecodeError:
        return None


_FIXES = "fixes"  # name of the positions that the first satellite receiver of a scene reported; of others, `fixes:ID`


def _read_scene_trajectory(
    form: FormatSpec, location: Any, reading: Reading, options: Mapping[str, Any], progress: Progress | None = None
) -> TrajectoryFile:
    """Open a scene and take a trajectory out of it."""
    # `reading.name`: one of `scene.trajectories`; "lidar" or "gnss" to estimate it; "fixes" or "fixes:ID" for what a
    # satellite receiver reported. None: the default one; without it and without a lidar, the fixes as received, since
    # what is compared is what was reported; else what `find_ego_motion` estimates.
    further = dict(options)
    chosen = chosen_corrections(further.pop("corrections", Corrections.APPLY))
    with form.open(location, **further) as opened:
        scene = replace(opened, corrections=chosen).corrected()
        found = _named(scene, reading, progress)
    return TrajectoryFile(
        found.trajectory, form.name, found.fixes, found.origin_lla, found.columns, (*scene.warnings, *found.warnings)
    )


def _named(scene: Scene, reading: Reading, progress: Progress | None) -> TrajectoryFile:
    name = reading.name
    chosen = next(iter(scene.trajectories), None) if name is None else name
    if chosen in scene.trajectories:
        stated = stated_origin(scene)
        return TrajectoryFile(
            scene.trajectories[str(chosen)], origin_lla=None if stated is None else read_only(stated, np.float64)
        )
    receivers = [sensor for sensor in scene.sensors if isinstance(sensor, GnssSensor)]
    if receivers and (name == _FIXES or (name is None and not scene.lidars)):
        return _received(scene, receivers[0], _FIXES, reading)
    for sensor in receivers:
        if name == f"{_FIXES}:{sensor.id}":
            return _received(scene, sensor, name, reading)
    if name is None or name in RESERVED:
        return _computed(scene, name, progress)
    raise OptionError(f"{scene.source}: no trajectory {name!r}; there are: {_choices(scene, receivers)}")


def _received(scene: Scene, sensor: GnssSensor, name: str, reading: Reading) -> TrajectoryFile:
    """The fixes that are positions; one at 0, 0 before reception must not become the origin."""
    location, usable = f"{scene.source}: sensors[{sensor.id}]", usable_fixes(sensor)
    if not usable.any():
        raise PoseError(f"{location}: no usable GNSS fixes in it; expected one or more")
    if usable.all():
        return of_fixes(sensor, origin_lla=reading.origin_lla, name=name)
    kept = GnssSensor(
        sensor.id,
        sensor.timestamps_ns[usable],
        sensor.positions_lla[usable],
        sensor.accuracies[usable],
        sensor.vertical_accuracies[usable],
    )
    lost, message = int((~usable).sum()), "fixes that are no position were left out"
    reported = DataWarning(
        kind=WarningKind.SKIPPED, code="gnss-fixes-left-out", location=location, message=message, count=lost
    )
    return replace(of_fixes(kept, origin_lla=reading.origin_lla, name=name), warnings=(reported,))


def _computed(scene: Scene, name: str | None, progress: Progress | None) -> TrajectoryFile:
    from sceneloom.motion.ego_trajectory import find_ego_motion

    ego = find_ego_motion(scene, name=name, progress=progress)
    path = ego.path
    if path.static:
        raise PoseError(f"{scene.source}: the trajectory {ego.name!r} has no times; nothing can be compared with it")
    trajectory = Trajectory(
        ego.name, path.timestamps_ns, path.positions, path.quaternions_xyzw, covariances=ego.covariances
    )
    origin = None if ego.enu_origin_lla is None else read_only(ego.enu_origin_lla, np.float64)
    return TrajectoryFile(trajectory, origin_lla=origin, warnings=ego.warnings)


def _choices(scene: Scene, receivers: list[GnssSensor]) -> str:
    found = [*scene.trajectories]
    found += ["lidar"] if scene.lidars and "lidar" not in found else []
    found += [name for name in (GNSS, _FIXES) if receivers and name not in found]
    return ", ".join([*found, *(f"{_FIXES}:{sensor.id}" for sensor in receivers[1:])]) or "none"


_VEHICLE_FROM_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""From z forward, y down to x forward, z up."""


def _rotated(content: TrajectoryFile, here_from_there: Float64Array) -> TrajectoryFile:
    """Rotate the axes of world and device, which rounds nothing: the axis of a rotation is rotated as any vector."""
    trajectory, six = content.trajectory, np.kron(np.eye(2), here_from_there)
    quaternions, covariances = trajectory.quaternions_xyzw, trajectory.covariances
    if quaternions is not None:
        quaternions = np.concatenate([quaternions[:, :3] @ here_from_there.T, quaternions[:, 3:]], axis=1)
    trajectory = replace(
        trajectory,
        positions=read_only(trajectory.positions @ here_from_there.T),
        quaternions_xyzw=None if quaternions is None else read_only(quaternions),
        covariances=None if covariances is None else read_only(six @ covariances @ six.T),
    )
    columns = {name: read_only(values @ here_from_there.T) for name, values in content.columns.items()}
    return replace(content, trajectory=trajectory, columns=columns)


_TEXT_FORMATS = "sceneloom.formats.trajectories.text_formats"
_FORM_LOCATIONS = {
    "tum": f"{_TEXT_FORMATS}:TUM",
    "kitti": f"{_TEXT_FORMATS}:KITTI",
    "euroc": f"{_TEXT_FORMATS}:EUROC",
    "gnss": f"{_TEXT_FORMATS}:GNSS",
    "csv": f"{_TEXT_FORMATS}:NAMED_COLUMNS",
    "jsonl": "sceneloom.formats.recording.pose_lines:JSONL",
}


class _Forms(Mapping[str, TrajectoryForm]):
    """The forms by name; each is imported when it is asked for."""

    def __getitem__(self, name: str) -> TrajectoryForm:
        form: TrajectoryForm = imported(_FORM_LOCATIONS[name])
        return form

    def __iter__(self) -> Iterator[str]:
        return iter(_FORM_LOCATIONS)

    def __len__(self) -> int:
        return len(_FORM_LOCATIONS)

    def of_file(self, path: str | Path) -> TrajectoryForm | None:
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
        text = None if where.name == "data.jsonl" else _beginning(where)
        if text is not None:
            forms = self.values()
            found = next((form for form in forms if form.recognises(text)), None)
            # a suffix of its own reports the form of a file that is torn, whose fault can then be named
            found = found or next(
                (form for form in forms if where.suffix.lower() in _OWN_SUFFIXES & {*form.suffixes}), None
            )
            if found is not None:
                return found
        if claims:
            return None
        known = "; ".join(f"{form.name}, {form.looks_like}" for form in self.values())
        raise UnknownFormatError(path, "", f"no trajectory is recognised in it; expected a scene, or one of: {known}")

    def for_output(self, path: Path) -> TrajectoryForm:
        """The form that a path to be written asks for by its suffix.

        Raises:
            OptionError: no form has that suffix.
        """
        for form in self.values():
            if path.suffix.lower() in form.suffixes:
                return form
        known = ", ".join(f"{form.name} ({' '.join(form.suffixes) or 'by name'})" for form in self.values())
        raise OptionError(
            f"{path}: suffix {path.suffix!r} belongs to no form of trajectories; expected one of: {known}"
        )


TRAJECTORY_FORMS = _Forms()
"""The forms of files by name; of two that recognise a file the first counts."""

_FORM_NAMES = tuple(TRAJECTORY_FORMS)
_OWN_SUFFIXES = {".tum", ".kitti", ".jsonl"}  # suffixes that nothing but one form has
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
    chosen = _form_named(form) if form is not None else TRAJECTORY_FORMS.of_file(where)
    computed = reading.name in RESERVED or (reading.name or "").partition(":")[0] == _FIXES
    if form is None and chosen is not None and chosen.name == "jsonl" and computed:
        chosen = None
    if times is not None and (chosen is None or chosen.name != "kitti"):
        raise OptionError(f"{where}: has its own times; those of {times} would not be used, and are for KITTI's poses")
    _check_used(where, chosen, reading)
    if chosen is None:
        scene_form, location = format_and_location(where, format=form)
        options = {**options, **({"lenient": True} if lenient else {})}
        content = _read_scene_trajectory(scene_form, location, reading, options, progress)
    else:
        check_option_names(f"opening a trajectory ({chosen.name})", options, _READING)
        ledger = Ledger(lenient=lenient)
        with ledger.telling():
            content = chosen.read(Path(where), reading, ledger)
        content = replace(content, warnings=ledger.warnings)
    return _rotated(content, _VEHICLE_FROM_OPTICAL) if optical else content


def _check_used(path: str | Path, form: TrajectoryForm | None, reading: Reading) -> None:
    """Refuse what would be ignored: a rate or unit of times that are known, an origin of positions in metres."""
    what = "scenes" if form is None else f"the form {form.name!r}"
    if reading.rate_hz is not None and (form is None or form.name != "kitti"):
        raise OptionError(
            f"{path}: {what} has its own times; the rate {reading.rate_hz:g} Hz would not be used, and is for KITTI's "
            "poses: leave it out"
        )
    if reading.unit is not None and (form is None or (form.name == "kitti" and reading.rate_hz is not None)):
        raise OptionError(
            f"{path}: no times in a text are read here; the unit {reading.unit!r} would not be used: leave it out"
        )
    if reading.origin_lla is not None and form is not None and form.name != "gnss":
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
    chosen = TRAJECTORY_FORMS.for_output(target) if form is None else _form_named(form)
    if chosen is None:
        raise OptionError(f"form {form!r} is one of scenes; expected one of: {', '.join(_FORM_NAMES)}")
    content = TrajectoryFile.of(trajectory)
    if origin_lla is not None:
        content = replace(content, origin_lla=_origin(origin_lla))
    content = _rotated(content, _VEHICLE_FROM_OPTICAL.T) if optical else content
    targets = [target] if chosen.beside is None else [target, chosen.beside(target)]
    with replacing_together(targets, overwrite=overwrite) as (draft, *_):
        return LossReport.of(chosen.write(content, draft, target))


def _form_named(name: str) -> TrajectoryForm | None:
    """The form of that name; None for a format of scenes."""
    if name not in TRAJECTORY_FORMS and name not in format_names():
        known = ", ".join((*_FORM_NAMES, *format_names()))
        raise OptionError(f"no form of trajectories {name!r}; there are {known}")
    return TRAJECTORY_FORMS.get(name)


def _origin(origin_lla: Sequence[float]) -> Float64Array:
    origin = np.asarray(origin_lla, np.float64)
    inside = origin.shape == (3,) and bool((np.abs(origin) <= (90, 180, 1e8)).all())
    if not inside:
        reported = list(map(float, origin.ravel()))
        raise OptionError(f"origin {reported}; expected latitude and longitude in degrees, altitude in metres")
    return origin
