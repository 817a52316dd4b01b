"""One drive of a run: the verb itself, called as the command line would, its result taken as JSON."""

import io
import json
from collections.abc import Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import click

from sceneloom.batch.jobs import READING, FileOption
from sceneloom.cli import options
from sceneloom.cli.printing import print_json
from sceneloom.errors import OptionError

CALL = "sceneloom.cli.batch.one_drive:run_verb"
"""How workers find the function below."""


@dataclass(frozen=True, slots=True)
class Batched:
    """A verb that can be done over many drives.

    Attributes:
        drive: name of its parameter that is the drive.
        output: name of the one that is its output; "" if it only prints, which is then what is written.
        suffix: what names of outputs end in, unless the user says otherwise.
        modules: what it imports when it is called and takes long to import.
        folders, files: names of those that are further outputs.
        beside: names of those that name files which it reads beside the drive.
    """

    drive: str
    output: str
    suffix: str
    modules: tuple[str, ...]
    folders: tuple[str, ...] = ()
    files: tuple[str, ...] = ()
    beside: tuple[str, ...] = ()


BATCHED: Mapping[str, Batched] = MappingProxyType(
    {
        "fuse": Batched(
            *("path", "output", ".sfs", ("sceneloom.cli.fuse", "sceneloom.pipeline.fusing")),
            folders=("depth", "images"),
            beside=("boxes3d", "boxes2d", "detectors"),
        ),
        "convert": Batched(
            *("source", "target", ".sfs", ("sceneloom.cli.convert", "sceneloom.pipeline.converting")),
            files=("loss",),
            beside=("from_times",),
        ),
        "validate": Batched(
            *("path", "", ".json", ("sceneloom.cli.validate", "sceneloom.checks.validation")), files=("fix",)
        ),
        "track": Batched(
            *("path", "output", ".sfs", ("sceneloom.cli.track", "sceneloom.pipeline.detection_jobs")),
            folders=("images",),
            beside=("boxes3d", "boxes2d", "detectors"),
        ),
        "report": Batched(
            *("path", "output", ".html", ("sceneloom.cli.report", "sceneloom.report.page")),
            files=("numbers",),
            beside=("truth", "losses"),
        ),
    }
)


_NAMED = "detectors"
"""Of those that name files, the one that takes a name, too: verbs take it as text."""


def beside(name: str) -> dict[str, FileOption]:
    """The options of a verb that name files which it reads beside a drive."""
    from sceneloom.detections.detectors import detector_names

    wanted = BATCHED[name].beside
    return {
        option.name: FileOption(
            several=getattr(option, "multiple", False),
            names=frozenset(detector_names() if option.name == _NAMED else ()),
        )
        for option in verb_named(name).params
        if option.name in wanted
    }


def verb_named(name: str) -> click.Command:
    """Import a verb of the command line."""
    from sceneloom.cli.main import sceneloom

    command = sceneloom.get_command(click.Context(sceneloom), name)
    if command is None:
        raise OptionError(f"no verb {name!r}")
    return command


def run_verb(location: str, output: Path, values: Mapping[str, Any]) -> Any:
    """Do a verb for one drive, quietly, and give what it prints as JSON.

    Args:
        location: path or URL of the drive.
        output: the file or folder to write.
        values: of the verb's other parameters, its name as `verb`.

    Raises:
        SceneloomError: the verb refuses the drive.
    """
    given = dict(values)
    name = given.pop("verb")
    batched, command = BATCHED[name], verb_named(name)
    fixed = {"as_json": True, "quiet": True, "verbose": True, "overwrite": False}
    given |= {
        parameter.name: fixed[parameter.name] for parameter in command.params if parameter.name in fixed
    }
    given[batched.drive] = options.location(location)
    if batched.output:
        given[batched.output] = output
    if isinstance(given.get(_NAMED), Path):
        given[_NAMED] = str(given[_NAMED])
    _read_as_listed(given, command)
    printed = io.StringIO()
    with click.Context(command, info_name=f"sceneloom {name}") as context, redirect_stdout(printed):
        try:
            context.invoke(command.callback, **given)  # type: ignore[arg-type]
        except click.exceptions.Exit as ended:
            if ended.exit_code and not printed.getvalue():
                raise OptionError(f"{name} ended with code {ended.exit_code}") from ended
        except click.ClickException as error:
            raise OptionError(error.format_message()) from error
    reported = _reported(printed.getvalue())
    if not batched.output:  # without times, which the record has: the same drive gives the same file
        result = (
            {name: value for name, value in reported.items() if name != "stages"}
            if isinstance(reported, dict)
            else reported
        )
        with output.open("w", encoding="utf-8") as file, redirect_stdout(file):
            print_json(result)
    return reported


def _reported(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text.strip()


def _read_as_listed(given: dict[str, Any], command: click.Command) -> None:
    """Put what a list says of reading a drive where the verb has it, instead of what is stated for all."""
    names = {parameter.name for parameter in command.params}
    for own in [name for name in given if name.startswith(READING)]:
        name, value = own.removeprefix(READING), given.pop(own)
        if name == "sequence" and "sequences" in names:
            given["sequences"] = (value,)
        elif name in names & options.READING:
            given[name] = value
        else:
            given[options.READ_WITH] = (*given.get(options.READ_WITH, ()), f"{name}={value}")
