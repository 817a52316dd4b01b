"""How a verb runs: its options become a printer and reading options, its outputs are uploaded, its errors explained."""

import shlex
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from functools import wraps
from pathlib import Path
from typing import Any, TextIO, cast

import click

from sceneloom.cli import options
from sceneloom.cli.options import option
from sceneloom.cli.printing import Printer
from sceneloom.errors import DataError, OptionError, SceneloomError, UnknownFormatError, UnknownOptionError

Command = Callable[..., Any]


def verb(command: Command) -> Command:
    """On every verb that has a result, nearest to the function.

    The function gets a `Printer` as `printer`, and the stated options of reading as `reading` if it has these.
    """

    def packed(values: Mapping[str, Any]) -> dict[str, Any]:
        given = dict(values)
        given["printer"] = Printer(given.pop("as_json"), given.pop("quiet"), given.pop("verbose"))
        if options.INPUT_OPTIONS in given:
            stated = {name: given.pop(name) for name in options.READING if name in given}
            given["reading"] = options.stated(**stated)
        return given

    @wraps(command)
    def run(*arguments: Any, **values: Any) -> Any:
        try:
            with _uploads(overwrite=values.get("overwrite", False)), _flags_named():
                return command(*arguments, **packed(values))
        except SceneloomError as error:
            if not values["quiet"]:
                if error.warnings and values.get("lenient"):
                    Printer(verbose=values["verbose"]).warnings(error.warnings)
                error.add_note(next_step(error, values) or "")
            raise

    run.__dict__["uploads"] = True  # `options.target` looks for it
    return _printing(run)


_printing = options.stacked(
    option("--json as_json", "Print the result as JSON.", group="general"),
    option("-q --quiet", "No progress, no warnings.", group="general"),
    option("-v --verbose", "Every warning and loss, not only the first ones.", group="general"),
)


def reading_verb(command: Command) -> Command:
    """On every verb that reads a drive."""
    return options.reading(verb(command))


def rewriting_verb(command: Command) -> Command:
    """On every verb that reads a drive and writes one."""
    return options.writing_scenes(reading_verb(command))


@contextmanager
def _uploads(*, overwrite: bool) -> Iterator[None]:
    """Refuse outputs that are there before much is done; put all of them into their stores after it."""
    drafts: dict[Path, str] = dict(options.drafts(click.get_current_context()))
    if not drafts:
        yield
        return
    from sceneloom.errors import redacted
    from sceneloom.formats.remote.uploads import check_remote_output, upload

    for url in drafts.values():
        check_remote_output(url, overwrite=overwrite)
    names = {str(draft): redacted(url) for draft, url in drafts.items()}
    with redirect_stdout(cast("TextIO", _Renaming(sys.stdout, names))):
        yield
        for draft, url in drafts.items():
            upload(draft, url)


class _Renaming:
    """A stream in which outputs have the names that the user gave them."""

    def __init__(self, stream: TextIO, names: Mapping[str, str]) -> None:
        self._stream, self._names = stream, names

    def write(self, text: str) -> int:
        """Write text with names exchanged."""
        for draft, url in self._names.items():
            text = text.replace(draft, url)
        return self._stream.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


_PREFIXES = {"opening": ("from_", "est_", "ref_", ""), "writing": ("to_", "")}
"""What names of flags begin with, before the library's name of the option, by what is done."""


@contextmanager
def _flags_named() -> Iterator[None]:
    """Name options that a format does not take as the user stated them."""
    try:
        yield
    except UnknownOptionError as error:
        flags, prefixes = options.flags_of_verb(), _PREFIXES.get(error.doing.split()[0], ("",))

        def flag(name: str) -> str | None:
            names = [side + name + several for side in prefixes for several in ("", "s")]
            return next((flags[name] for name in names if name in flags), None)

        option, *known = map(flag, (error.option, *error.known))
        if option is None:
            raise
        taken = ", ".join(filter(None, known)) or "no option of this verb"
        reported = OptionError(f"{option} does not count here: {error.doing} takes {taken}")
        reported.remember(error.warnings)
        raise reported from error


_NOT_BROKEN = ("no such file", "no lidar in it")  # what problems of drives state that no rule finds and nothing repairs
_WITH_DRIVES = dict.fromkeys(
    (".urdf", ".yaml", ".yml"),
    "if it states where sensors are, or camera models, it goes with a drive: `DRIVE --rig {}`",
) | dict.fromkeys((".tum", ".txt", ".csv"), "if it is a trajectory, it goes with a drive: `DRIVE --trajectory {}`")
"""What a file may be that is no drive, by its ending."""
_DRIVES = ("path", "source", "drive")  # what verbs call the argument that is a drive


def next_step(error: SceneloomError, values: Mapping[str, Any]) -> str | None:
    """What a person could do about an error, where the message does not state it already.

    Args:
        values: the verb's options and arguments, by the names of its parameters.
    """
    if isinstance(error, DataError) and any(words in error.problem for words in _NOT_BROKEN):
        return None
    if isinstance(error, UnknownFormatError):
        beside = _WITH_DRIVES.get(Path(str(error.file)).suffix.lower(), "")
        return beside.format(error.file) or (
            "`sceneloom formats` lists what can be read, and how it is recognised; of clouds and images of your own, "
            "`sceneloom formats --template FOLDER/rig.toml --from FOLDER` begins a manifest"
        )
    if type(error) is not DataError or "lenient" not in values:
        return None
    drive = next((values[name] for name in _DRIVES if isinstance(values.get(name), Path)), None)
    salvaging = _salvaging(drive, error)
    if any(reported in error.problem for reported in ("`--", "`sceneloom ", "\n")):
        return salvaging  # it names an option or a verb, or lists all that is wrong
    if drive is None or not str(error.file).startswith(str(drive)):
        return None
    command = shlex.join(["sceneloom", "validate", str(drive), *_as_read(values)])
    lists = "; ".join(filter(None, (salvaging, f"`{command}` lists all that is wrong")))
    return lists if values["lenient"] else f"{lists}; `--lenient` goes on without what is broken"


def _salvaging(drive: Path | None, error: DataError) -> str | None:
    """How what is whole is taken out of a scene file; None of other drives."""
    if drive is None or drive.suffix.lower() != ".sfs" or str(error.file) != str(drive) or not drive.is_file():
        return None
    saved = drive.with_name(f"{drive.stem}-salvaged.sfs")
    return f"`{shlex.join(['sceneloom', 'salvage', str(drive), '-o', str(saved)])}` takes out what is whole"


def _as_read(values: Mapping[str, Any]) -> Iterator[str]:
    """The words by which a person stated how the drive is read."""
    sequences = values.get("sequences", ())
    reported = {"sequence": sequences[0], **values} if len(sequences) == 1 else values
    for option in options.READING_OPTIONS:
        stated = reported.get(str(option.name))
        if stated and option.name != "lenient":
            for value in stated if isinstance(stated, tuple) else (stated,):
                yield option.opts[0]
                if not (isinstance(option, click.Option) and option.is_flag):
                    yield str(value)
