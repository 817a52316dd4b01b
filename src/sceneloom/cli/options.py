"""The options that many verbs share."""

import os
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import reduce, wraps
from pathlib import Path
from typing import Any, TypeVar, cast

import click

from sceneloom.errors import DataError, OptionError, SceneloomError, UnknownFormatError, UnknownOptionError

Command = TypeVar("Command", bound=Callable[..., Any])


READ_WITH = "reading_options"
"""Name of the parameter that holds reading options which have no flag of their own."""


def _stacked(*options: Callable[[Any], Any]) -> Callable[[Command], Command]:
    return lambda command: reduce(lambda inner, option: option(inner), reversed(options), command)


def location(text: str) -> "Path | str":
    """Take an argument as a path, or as the URL of a scene file, whose double slashes a path would lose."""
    from sceneloom.formats.base.files import path_or_url

    found = path_or_url(text)
    return found if isinstance(found, str) else _noted(found)


def _noted(path: Path) -> Path:
    """Take note of an input, so that no output of this run replaces it."""
    from sceneloom.formats.base.output import Source

    context = click.get_current_context(silent=True)
    if context is not None and path.exists():
        context.find_root().meta.setdefault(__name__, []).append(Source(path))
    return path


class _Input(click.Path):
    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if "{name}" in str(value):  # of `batch`, where each drive has its own
            return Path(value)
        return _noted(Path(os.fsdecode(super().convert(value, param, ctx))))


def source(*, exists: bool = False, file_okay: bool = True, dir_okay: bool = True) -> click.Path:
    """The type of an option that names a further input, which is not written to; `exists`: usage that is wrong else."""
    return _Input(exists=exists, path_type=Path, file_okay=file_okay, dir_okay=dir_okay)


def positive(number: str | float) -> float:
    """Take a value as a finite number above 0."""
    try:
        value = float(number)
    except ValueError as error:
        raise click.BadParameter(f"{number!r} is no number") from error
    if not 0.0 < value < float("inf"):
        raise click.BadParameter(f"{number}; expected a number above 0")
    return value


def finite(number: str | float) -> float:
    """Take a value as a number that is neither infinite nor none."""
    try:
        value = float(number)
    except ValueError as error:
        raise click.BadParameter(f"{number!r} is no number") from error
    if not -float("inf") < value < float("inf"):
        raise click.BadParameter(f"{number}; expected a finite number")
    return value


def not_negative(number: str | float) -> float:
    """Take a value as a number of 0 or more."""
    try:
        value = float(number)
    except ValueError as error:
        raise click.BadParameter(f"{number!r} is no number") from error
    if not value >= 0.0:
        raise click.BadParameter(f"{number}; expected 0 or more")
    return value


def target(text: str) -> Path:
    """Take an argument as the path of what is to be written; that of a store is written to disk first."""
    from sceneloom.formats.base.files import is_url

    if is_url(text):
        from sceneloom.cli.uploads import draft_of

        return draft_of(text)
    if text == "-":
        raise click.BadParameter(
            "'-'; nothing is written to standard output: state the name of a file or folder"
        )
    return Path(text)


def lists(words: str) -> Callable[[Any], Any]:
    """Lists of drives in files (`sceneloom.batch.jobs`); `words` state what counts of their lines."""
    return click.option(
        "--list",
        "lists",
        type=source(exists=True, dir_okay=False),
        multiple=True,
        metavar="FILE",
        help=f"Drives by lines: {words}; may be stated again.",
    )


def one_sequence(given: Sequence[str]) -> str | None:
    """The sequence of a data set that is opened as one drive, where it was stated.

    Raises:
        click.UsageError: several were.
    """
    if len(given) > 1:
        raise click.UsageError(
            f"--sequence {' --sequence '.join(given)}: one drive is opened at a time; state one"
        )
    return given[0] if given else None


reading = _stacked(
    click.option(
        "--input-format",
        "format",
        metavar="NAME",
        help="The drive's format, where its content does not decide: a name out of `sceneloom formats`.",
    ),
    click.option(
        "--input-option",
        READ_WITH,
        multiple=True,
        metavar="NAME=VALUE",
        help="An option of the drive's format, such as `world=odom` of bags; each format's page lists its own.",
    ),
    click.option("--lenient", is_flag=True, help="Skip what is broken, count it, and go on."),
    click.option(
        "--points-frame",
        type=click.Choice(["world", "ego", "sensor"]),
        help="The frame of lidar points in a scene file that does not state it. [default: that of its coordinates]",
    ),
    click.option(
        "--euler-unit",
        type=click.Choice(["degrees", "radians"]),
        help="Unit of the boxes' angles in a scene file that does not state it. [default: degrees]",
    ),
    click.option(
        "--euler-order",
        metavar="ORDER",
        help="Order of the boxes' rotations in a scene file that does not state it. [default: xyz]",
    ),
    click.option(
        "--tangential",
        type=click.Choice(["opencv", "brown"]),
        help="What p1 and p2 of `brown_conrady` camera models mean in a scene file that does not state it: `brown` "
        "exchanges "
        "them. [default: opencv]",
    ),
    click.option(
        "--vertices",
        type=click.Choice(["pairs", "triples"]),
        help="How polygons and polylines in space are written in a scene file: x, y pairs or x, y, z triples. "
        "[default: triples where they fit]",
    ),
    click.option(
        "--assume-model",
        is_flag=True,
        help="Compute with camera models whose formulas nothing confirms: `ftheta`, `fisheye_radial_custom`.",
    ),
    click.option(
        "--altitude",
        type=click.Choice(["wgs84", "msl"]),
        help="What a recording's altitudes are above: the ellipsoid or mean sea level. [default: wgs84]",
    ),
    click.option(
        "--image-index",
        type=click.Choice(["auto", "number", "first", "line"]),
        help="Which image of a video a recording's `frames` line means: its `number`, that less the first number, or "
        "each line the next. [default: auto: by the counts, if they agree]",
    ),
    click.option(
        "--camera-shift",
        type=click.Choice(["ignore", "apply", "subtract"]),
        help="What becomes of a recording's `imuToCameraShiftSeconds`: `apply` adds it to the times of the camera's "
        "images, `subtract` takes it off. [default: ignore]",
    ),
    click.option(
        "--sequence",
        multiple=True,
        callback=lambda _context, _parameter, given: one_sequence(given),
        metavar="NAME",
        help="Which drive of a data set that has several.",
    ),
    click.option("--keyframes", is_flag=True, help="Of nuScenes, only what was taken at the samples."),
    click.option(
        "--no-corrections",
        "corrections",
        is_flag=True,
        flag_value="ignore",
        default=None,
        help="Compute without the drive's camera calibrations and localization adjustments, which stay in what is "
        "written. [default: apply them]",
    ),
)
"""On every verb that reads a drive."""

_READING_OPTIONS = click.command()(reading(lambda: None)).params
READING = frozenset(option.name for option in _READING_OPTIONS) - {READ_WITH}
"""The names of these, but for what each format has of its own."""


def trajectory(*, further: str = "") -> Callable[[Command], Command]:
    """On every verb that moves something along the ego trajectory: which one it is; `further` names one more choice."""
    return _stacked(
        click.option(
            "--trajectory",
            metavar="NAME",
            help="The ego trajectory; `gnss`: found from satellite fixes, with IMU and sweeps; `lidar`: from the sweeps"
            f"{further and '; '}{further}. [default: the drive's first, else `gnss`, else `lidar`]",
        ),
        click.option(
            "--orientation-from",
            "heading",
            type=click.Choice(["motion"]),
            help="Derive orientations where the trajectory has positions only.",
        ),
    )


part = _stacked(
    click.option(
        "--start", type=not_negative, metavar="S", help="Begin S seconds after the first timestamp."
    ),
    click.option("--stop", type=not_negative, metavar="S", help="End before S seconds after it."),
)
"""On every verb that can take a part of a drive."""

threads = click.option(
    "--threads",
    type=click.IntRange(1, 256),
    metavar="N",
    help="Threads that share the work on a sweep; what they give is the same. [default: 1]",
)
"""How many processors one sweep may use."""


_PREFIXES = {"opening": ("from_", "est_", "ref_", ""), "writing": ("to_", "")}
"""What names of flags begin with, before the library's name of the option, by what is done."""


def _naming_flags(command: Callable[..., Any], *arguments: Any, **values: Any) -> Any:
    """Call a verb, and name options that a format does not take as the user stated them."""
    try:
        return command(*arguments, **values)
    except UnknownOptionError as error:
        option, *known = (_flag(name, error.doing.split()[0]) for name in (error.option, *error.known))
        if option is None:
            raise
        taken = ", ".join(filter(None, known)) or "no option of this verb"
        reported = OptionError(f"{option} does not count here: {error.doing} takes {taken}")
        reported.remember(error.warnings)
        raise reported from error


def _flag(name: str, doing: str) -> str | None:
    flags = {
        parameter.name: parameter.opts[0]
        for parameter in click.get_current_context().command.params
        if isinstance(parameter, click.Option)
    }
    names = [side + name + several for side in _PREFIXES.get(doing, ("",)) for several in ("", "s")]
    return next((flags[name] for name in names if name in flags), None)


def _uploading(command: Callable[..., Any], *arguments: Any, **values: Any) -> Any:
    """Call a verb, and put what it wrote for a store there if all went well."""
    from sceneloom.cli.uploads import uploads

    with uploads(overwrite=values.get("overwrite", False)):
        return _naming_flags(command, *arguments, **values)


def _telling_warnings(command: Command) -> Command:
    """Print what a lenient reading left out also where a verb ends in an error, and state what to do next."""

    @wraps(command)
    def run(*arguments: Any, **values: Any) -> Any:
        try:
            return _uploading(command, *arguments, **values)
        except SceneloomError as error:
            if error.warnings and values.get("lenient") and not values["quiet"]:
                from sceneloom.cli.printing import print_warnings

                print_warnings(error.warnings, verbose=values["verbose"])
            if not values["quiet"]:
                error.add_note(next_step(error, values) or "")
            raise

    run.__dict__["uploads"] = True  # `cli.uploads` looks for it
    return cast("Command", run)


_NOT_BROKEN = ("no such file", "no lidar in it")
"""What problems of drives state that no rule finds and nothing repairs."""

_DRIVES = ("path", "source", "drive")
"""What verbs call the argument that is a drive."""


def next_step(error: SceneloomError, values: Mapping[str, Any]) -> str | None:
    """What a person could do about an error, where the message does not state it already.

    Args:
        error: what a verb ended with.
        values: the verb's options and arguments, by the names of its parameters.
    """
    if isinstance(error, DataError) and any(words in error.problem for words in _NOT_BROKEN):
        return None
    if isinstance(error, UnknownFormatError):
        return (
            "`sceneloom formats` lists what can be read, and how it is recognised; of clouds and images of your own, "
            "`sceneloom formats --template FOLDER/rig.toml --from FOLDER` begins a manifest"
        )
    if type(error) is not DataError or "lenient" not in values:
        return None
    drive = next((values[name] for name in _DRIVES if isinstance(values.get(name), Path)), None)
    whole = _salvage(drive, error)
    if any(reported in error.problem for reported in ("`--", "`sceneloom ", "\n")):
        return whole  # it names an option or a verb, or lists all that is wrong
    if drive is None or not str(error.file).startswith(str(drive)):
        return None
    lists = f"{whole}; " if whole else ""
    lists += (
        f"`{shlex.join(['sceneloom', 'validate', str(drive), *_as_read(values)])}` lists all that is wrong"
    )
    return lists if values["lenient"] else f"{lists}; `--lenient` goes on without what is broken"


def _salvage(drive: Path | None, error: DataError) -> str | None:
    """How what is whole is taken out of a scene file; None of other drives."""
    if (
        drive is None
        or drive.suffix.lower() != ".sfs"
        or str(error.file) != str(drive)
        or not drive.is_file()
    ):
        return None
    saved = drive.with_name(f"{drive.stem}-salvaged.sfs")
    return f"`{shlex.join(['sceneloom', 'salvage', str(drive), '-o', str(saved)])}` takes out what is whole"


def _as_read(values: Mapping[str, Any]) -> Iterator[str]:
    """The words by which a person stated how the drive is read."""
    sequences = values.get("sequences", ())
    reported = {"sequence": sequences[0], **values} if len(sequences) == 1 else values
    for option in _READING_OPTIONS:
        stated = reported.get(str(option.name))
        if stated and option.name != "lenient":
            for value in stated if isinstance(stated, tuple) else (stated,):
                yield from (
                    option.opts[:1]
                    if isinstance(option, click.Option) and option.is_flag
                    else (option.opts[0], str(value))
                )


printing = _stacked(
    click.option("--json", "as_json", is_flag=True, help="Print the result as JSON."),
    click.option("-q", "--quiet", is_flag=True, help="No progress, no warnings."),
    click.option("-v", "--verbose", is_flag=True, help="Every warning and loss, not only the first ones."),
    _telling_warnings,
)
"""On every verb that has a result."""

writing_scenes = _stacked(
    click.option("--overwrite", is_flag=True, help="Replace outputs that exist."),
    click.option(
        "--profile",
        type=click.Choice(["sfs", "scale"]),
        help="`scale`: a scene file that Scale's own library loads and validates. [default: sfs]",
    ),
    click.option(
        "--time-unit",
        type=click.Choice(["microseconds", "nanoseconds"]),
        help="Unit of all times in a scene file. [default: microseconds]",
    ),
)
"""On every verb that writes `.sfs`."""

rewriting = _stacked(writing_scenes, reading, printing)
"""On every verb that reads a drive and writes one."""


def trajectories(side: str, path: str) -> Callable[[Command], Command]:
    """On every verb that reads a trajectory: how to read that of one argument; the names begin with `side`."""
    return _stacked(
        click.option(
            f"--{side}-form", metavar="FORM", help=f"The form of {path}: tum, kitti, euroc, gnss, csv, jsonl."
        ),
        click.option(
            f"--{side}-times",
            type=source(),
            metavar="FILE",
            help=f"Times of the poses of {path}, one per line, for KITTI files.",
        ),
        click.option(
            f"--{side}-rate",
            f"{side}_rate_hz",
            type=positive,
            metavar="HZ",
            help="Poses per second instead of times.",
        ),
        click.option(
            f"--{side}-unit",
            type=click.Choice(["seconds", "milliseconds", "microseconds", "nanoseconds"]),
            help=f"Unit of the times in {path}. [default: that of its form]",
        ),
        click.option(
            f"--{side}-optical",
            is_flag=True,
            help=f"{path} reports a camera's poses: rotate z forward, y down to x forward, z up.",
        ),
    )


def settings(flag: str, pairs: Iterable[str]) -> dict[str, str]:
    """Options that are written as NAME=VALUE.

    Raises:
        OptionError: one is no such pair.
    """
    found = {}
    for pair in pairs:
        name, sign, value = pair.partition("=")
        if not (name.isidentifier() and sign):
            raise OptionError(f"{flag} {pair!r}; expected NAME=VALUE")
        found[name] = value
    return found


_OF_ALL_FORMATS = {"path", "format", "start", "stop", "storage_options"}
"""What is stated for any drive that is opened, and not as an option of its format."""


def stated(**values: Any) -> dict[str, Any]:
    """The options that the user stated; the others are left to the library's defaults."""
    from sceneloom.formats.base.spec import as_flag

    further = settings("--input-option", values.pop(READ_WITH, ()))
    for name in sorted(_OF_ALL_FORMATS & further.keys()):
        raise OptionError(
            f"--input-option {name}: no format has this option; expected one that its page lists"
        )
    # what is also a flag of its own is true or false there, too
    switched = {
        name: as_flag(name, value) for name, value in further.items() if isinstance(values.get(name), bool)
    }
    kept = {name: value for name, value in values.items() if value is not None and value is not False}
    return {**kept, **further, **switched}
