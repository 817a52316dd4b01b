"""The options that many verbs share, and how what was stated becomes arguments of the library."""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields
from functools import partial, reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from sceneloom.cli.help import Option
from sceneloom.errors import OptionError

if TYPE_CHECKING:
    from sceneloom.scene.scene import Scene
    from sceneloom.scene.types import Identifier

Command = TypeVar("Command", bound=Callable[..., Any])
Options = TypeVar("Options")
INPUT_OPTIONS = "input_options"
"""Name of the parameter that holds reading options which have no flag of their own."""


def stacked(*options: Callable[[Any], Any]) -> Callable[[Command], Command]:
    """One decorator of several, in the order in which `--help` lists them."""
    return lambda command: reduce(lambda inner, option: option(inner), reversed(options), command)


def option(
    flags: str,
    help: str,  # noqa: A002 - click's word
    kind: Any = None,
    *,
    default: Any = None,
    metavar: str | None = None,
    **more: Any,
) -> Callable[[Command], Command]:
    """An option of a verb, in a group of its help (`cli.help.GROUPS`).

    Args:
        flags: as `--camera=ID… cameras` or `--method=fast|quality`: flags, what their value is called or the words to
            choose from, `…` where they may be repeated, and the name of the parameter where it is another one.
        kind: type of the value: a function, or words to choose from; None for text, or for a switch where the value has
            no name.
        default: what it is without; shown in the help.
        metavar: what the value is called, where that has spaces or commas.
    """
    words = flags.split()
    named = [word.rstrip("…").partition("=") for word in words if word.startswith("-")]
    metavar = metavar or next((value for _, _, value in named if value), None)
    if metavar is not None and "|" in metavar and metavar.islower():
        kind, metavar = metavar.split("|"), None
    is_switch = kind is None and metavar is None and "callback" not in more
    choices = isinstance(kind, Sequence) and isinstance(kind[0], str)
    return click.option(
        *(flag for flag, _, _ in named),
        *(word for word in words if not word.startswith("-")),
        help=help,
        type=click.Choice(kind) if choices else kind,
        is_flag=is_switch,
        multiple=any(word.endswith("…") for word in words),
        metavar=metavar,
        default=False if is_switch else default,
        show_default=default not in (None, ""),
        cls=Option,
        **more,
    )


# types of arguments and options


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
    """The type of an option that names another input; with `exists` one that is missing is wrong usage."""
    return _Input(exists=exists, path_type=Path, file_okay=file_okay, dir_okay=dir_okay)


def target(text: str) -> Path:
    """Take an argument as the path of an output; one in a store is written to disk first."""
    from sceneloom.formats.base.files import is_url

    if is_url(text):
        return _draft_of(text)
    if text == "-":
        raise click.BadParameter("'-'; nothing is written to standard output: give the name of a file or folder")
    return Path(text)


def drafts(context: click.Context) -> dict[Path, str]:
    """The outputs of a verb whose own paths are URLs, by where they are written first."""
    found: dict[Path, str] = context.meta.setdefault(f"{__name__}.drafts", {})
    return found


def _draft_of(url: str) -> Path:
    """Give a path on disk for an output whose own is a URL; it is gone when the verb ends."""
    from tempfile import TemporaryDirectory

    from sceneloom.errors import OutputError
    from sceneloom.formats.remote.uploads import output_name

    context = click.get_current_context()
    if not getattr(context.command.callback, "uploads", False):
        raise click.BadParameter(f"{url} is a URL; this verb writes to disk only")
    try:
        name = output_name(url)
    except OutputError as error:
        raise click.BadParameter(str(error)) from error
    folder = context.with_resource(TemporaryDirectory(prefix="sceneloom-"))
    draft = Path(folder) / name
    drafts(context)[draft] = url
    return draft


def number(text: str | float, holds: Callable[[float], bool], expected: str) -> float:
    """Take a value as a number for which `holds` is true."""
    try:
        value = float(text)
    except ValueError as error:
        raise click.BadParameter(f"{text!r} is no number") from error
    if not holds(value):
        raise click.BadParameter(f"{text}; expected {expected}")
    return value


def positive(text: str | float) -> float:
    """Take a value as a finite number above 0."""
    return number(text, lambda value: 0.0 < value < float("inf"), "a number above 0")


def finite(text: str | float) -> float:
    """Take a value as a finite number."""
    return number(text, lambda value: abs(value) < float("inf"), "a finite number")


def not_negative(text: str | float) -> float:
    """Take a value as a number of 0 or more."""
    return number(text, lambda value: value >= 0.0, "0 or more")


# options of reading and writing


def one_sequence(given: Sequence[str]) -> str | None:
    """The sequence of a data set that is opened as one drive, where it was stated; several are wrong usage."""
    if len(given) > 1:
        raise click.UsageError(f"--sequence {' --sequence '.join(given)}: one drive is opened at a time; give one")
    return given[0] if given else None


no_corrections = click.option(
    "--no-corrections",
    "corrections",
    cls=Option,
    group="input",
    is_flag=True,
    flag_value="ignore",
    default=None,
    help="Ignore the drive's camera calibrations and localization adjustments when computing; they stay in what is "
    "written. [default: apply them]",
)

_input = partial(option, group="input")
_rare = partial(_input, rare=True)
_output = partial(option, group="output")

lenient = _input("--lenient", "Skip what is broken, count it, and go on.")

reading = stacked(
    _input(
        "--input-format=NAME format",
        "Format of the drive, where its content is ambiguous: a name from `sceneloom formats`.",
    ),
    click.option(
        "--input-option",
        INPUT_OPTIONS,
        cls=Option,
        group="input",
        multiple=True,
        metavar="NAME=VALUE",
        help="An option of the drive's format, such as `world=odom` for bags; each format's page lists its own.",
    ),
    lenient,
    _input(
        "--rig=FILE…",
        "Mountings and camera models that the drive does not state: URDF, Kalibr, OpenCV or camera_info YAML, Autoware "
        "kits, basalt JSON, tf_static of a bag, rig.toml; may be repeated.",
        source(exists=True),
        callback=lambda _context, _parameter, given: given or None,
    ),
    _rare(
        "--rig-name=SENSOR=NAME… rig_names",
        "What the rig calls a sensor (its frame or camera), where that is not the sensor's id or the frame of its "
        "messages; `ego=NAME` for the ego.",
        callback=lambda _context, _parameter, given: given or None,
    ),
    _rare(
        "--points-frame=world|ego|sensor",
        "Frame of the lidar points of a scene file that does not state it. [default: that of its coordinates]",
    ),
    _rare(
        "--euler-unit=degrees|radians",
        "Unit of the boxes' angles in a scene file that does not state it. [default: degrees]",
    ),
    _rare(
        "--euler-order=ORDER", "Order of the boxes' rotations in a scene file that does not state it. [default: xyz]"
    ),
    _rare(
        "--tangential=opencv|brown",
        "What p1 and p2 of `brown_conrady` camera models mean in a scene file that does not state it: `brown` "
        "exchanges them. [default: opencv]",
    ),
    _rare(
        "--vertices=pairs|triples",
        "How a scene file writes polygons and polylines in space: x, y pairs or x, y, z triples. "
        "[default: triples where they fit]",
    ),
    _rare(
        "--assume-model",
        "Compute with camera models whose formulas are not confirmed: `ftheta`, `fisheye_radial_custom`.",
    ),
    _rare(
        "--altitude=wgs84|msl",
        "What a recording's altitudes are above: the ellipsoid or mean sea level. [default: wgs84]",
    ),
    _rare(
        "--image-index=auto|number|first|line",
        "Which image of a video a recording's `frames` line means: its `number`, that less the first number, or "
        "each line the next. [default: auto: by the counts, if they agree]",
    ),
    _rare(
        "--camera-shift=ignore|apply|subtract",
        "How to use a recording's `imuToCameraShiftSeconds`: `apply` adds it to the timestamps of the camera's "
        "images, `subtract` subtracts it. [default: ignore]",
    ),
    _input(
        "--sequence=NAME…",
        "Which drive of a data set that has several.",
        callback=lambda _context, _parameter, given: one_sequence(given),
    ),
    _rare("--keyframes", "Read only the samples of nuScenes, not the sweeps between."),
    no_corrections,
)
"""On every verb that reads a drive; it is then called with the stated ones as `reading`."""
READING_OPTIONS = click.command()(reading(lambda: None)).params
READING = frozenset(str(option.name) for option in READING_OPTIONS)
overwrite = _output("--overwrite", "Replace outputs that exist.")
writing_scenes = stacked(
    overwrite,
    _output("--profile=sfs|scale", "`scale`: a file that Scale's own library loads and validates. [default: sfs]"),
    _output("--time-unit=microseconds|nanoseconds", "Unit of all times in a scene file. [default: microseconds]"),
)
"""On every verb that writes `.sfs`."""
part = stacked(
    _input("--start=S", "Begin S seconds after the first timestamp.", not_negative),
    _input("--stop=S", "End before S seconds after it.", not_negative),
)
"""On every verb that can take a part of a drive."""
threads = option(
    "--threads=N",
    "Size of the thread pool for per-cloud kernels; results do not depend on it. [default: 1]",
    click.IntRange(1, 256),
    group="general",
)


def trajectory(more: str = "") -> Callable[[Command], Command]:
    """On every verb that moves something along the ego trajectory: which one it is; `more` names one more choice."""
    return stacked(
        option(
            "--trajectory=NAME",
            "Trajectory to use. `gnss`: GNSS/IMU smoothing; `lidar`: lidar odometry"
            f"{more and '; '}{more}. [default: the drive's first, else `gnss`, else `lidar`]",
        ),
        option(
            "--orientation-from heading", "Derive orientations where the trajectory has positions only.", ("motion",)
        ),
    )


STATIONARY = "`identity`: stationary"
"""One more choice of trajectories."""


def trajectory_file(side: str, path: str) -> Callable[[Command], Command]:
    """On every verb that reads a trajectory: how to read that of one argument; the names begin with `side`."""
    units = ("seconds", "milliseconds", "microseconds", "nanoseconds")
    return stacked(
        option(f"--{side}-form=FORM", f"Format of {path}: tum, kitti, euroc, gnss, csv, jsonl."),
        option(f"--{side}-times=FILE", f"Times of the poses of {path}, one per line, for KITTI files.", source()),
        option(f"--{side}-rate=HZ {side}_rate_hz", "Poses per second instead of times.", positive),
        option(f"--{side}-unit", f"Unit of the times in {path}. [default: that of its format]", units),
        option(f"--{side}-optical", f"{path} has a camera's poses: rotate z forward, y down to x forward, z up."),
    )


def output(help: str, *, required: bool = True) -> Callable[[Command], Command]:  # noqa: A002 - click's word
    """The output of a verb."""
    return option("-o --output", help, target, required=required, group="output")


def visualize(
    help: str = "Draw images to look at into DIR.",  # noqa: A002 - click's word
) -> Callable[[Command], Command]:
    """On every verb that can draw what it did."""
    return option("--visualize=DIR images", help, target, group="output")


def lists(lines: str) -> Callable[[Command], Command]:
    """Lists of drives in files (`sceneloom.batch.jobs`); `lines` states what they hold."""
    text = f"A list of drives, one per line: {lines}; may be repeated."
    return option("--list=FILE… lists", text, source(exists=True, dir_okay=False))


# from options to arguments

_OF_ALL_FORMATS = {"path", "format", "start", "stop", "storage_options"}
"""What is stated for any drive that is opened, and not as an option of its format."""


def stated(**values: Any) -> dict[str, Any]:
    """The options that the user stated; the others are left to the library's defaults."""
    from sceneloom.formats.base.spec import as_flag

    others = pairs("--input-option", values.pop(INPUT_OPTIONS, ()))
    for name in sorted(_OF_ALL_FORMATS & others.keys()):
        raise OptionError(f"--input-option {name}: no format has this option; expected one that its page lists")
    # what is also a flag of its own is true or false there, too
    switched = {name: as_flag(name, value) for name, value in others.items() if isinstance(values.get(name), bool)}
    kept = {name: value for name, value in values.items() if value is not None and value is not False}
    return {**kept, **others, **switched}


def of_side(given: dict[str, Any], prefix: str) -> dict[str, Any]:
    """Take the options whose names have a prefix out of all of a verb; they are named without it."""
    return {name.removeprefix(prefix): given.pop(name) for name in list(given) if name.startswith(prefix)}


def take(options: type[Options], given: dict[str, Any], **fixed: Any) -> Options:
    """Make an options object of the library: what its fields name is taken out of `given`."""
    own = {field.name: given.pop(field.name) for field in fields(options) if field.name in given}  # type: ignore[arg-type]
    return options(**stated(**own), **fixed)


def pairs(flag: str, texts: Iterable[str]) -> dict[str, str]:
    """Options that are written as NAME=VALUE; anything else is an `OptionError`."""
    found = {}
    for text in texts:
        name, sign, value = text.partition("=")
        if not (name.isidentifier() and sign):
            raise OptionError(f"{flag} {text!r}; expected NAME=VALUE")
        found[name] = value
    return found


def names(text: str | None) -> tuple[str, ...] | None:
    """Names with commas between them; None for none."""
    return None if text is None else tuple(map(str.strip, text.split(",")))


def refuse(given: Mapping[str, Any], named: Iterable[str], why: str) -> None:
    """Refuse options that have no effect on such an input, if one was stated."""
    flags = flags_of_verb()
    for name in named:
        if given.get(name):
            raise click.UsageError(f"{flags.get(name, f'--{name}')} does not count here: {why}")


def flags_of_verb() -> dict[str, str]:
    """The flag of each option of the verb that runs, by the name of its parameter."""
    parameters = click.get_current_context().command.params
    return {str(one.name): one.opts[0] for one in parameters if isinstance(one, click.Option)}


def needs(option: str, value: object, needed: str, other: object) -> None:
    """Refuse an option that does nothing without another one, if it was stated alone."""
    if value is not None and other is None:
        raise click.UsageError(f"{option} {value} does nothing without {needed}")


def known_id(scene: "Scene", text: str | None) -> "Identifier | None":
    """The id of a sensor as the scene has it, where `7` may be a number; the text itself where no sensor has it."""
    return None if text is None else known(text, [sensor.id for sensor in scene.sensors])


def scene_options(given: dict[str, Any]) -> dict[str, Any]:
    """How a scene file is written, as far as it was stated; taken out of `given`."""
    return stated(**{name: given.pop(name) for name in ("profile", "time_unit")})


def known_ids(scene: "Scene", texts: Iterable[str]) -> "tuple[Identifier, ...] | None":
    """The ids of sensors as the scene has them; None where none was stated."""
    ids = [sensor.id for sensor in scene.sensors]
    return tuple(known(text, ids) for text in texts) or None


def known(text: str, ids: "Sequence[Identifier]") -> "Identifier":
    """The one of several ids that was typed as `text`."""
    return next((one for one in ids if text not in ids and str(one) == text), text)
