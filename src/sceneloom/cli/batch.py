"""`sceneloom batch`: the verbs that take one drive, done for many drives, and how a run stands."""

import inspect
import io
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from copy import copy
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import click

from sceneloom.batch.jobs import READING, FileOption
from sceneloom.cli import options
from sceneloom.cli.help import Verb, Verbs
from sceneloom.cli.options import option
from sceneloom.cli.printing import SHOWN, print_json, print_table, several
from sceneloom.errors import OptionError

if TYPE_CHECKING:
    from sceneloom.batch.jobs import Input, Outcome
    from sceneloom.batch.record import Row
    from sceneloom.batch.running import Executor, Reported, RunSummary

CALL = "sceneloom.cli.batch:run_verb"
"""How workers find the function below."""


@dataclass(frozen=True, slots=True)
class Batched:
    """A verb that can be done over many drives.

    Attributes:
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
    beside: tuple[str, ...] = ("rig",)


BATCHED: Mapping[str, Batched] = MappingProxyType(
    {
        "fuse": Batched(
            *("path", "output", ".sfs", ("sceneloom.cli.fuse", "sceneloom.pipeline.fusing")),
            folders=("depth", "images"),
            beside=("boxes3d", "boxes2d", "detectors", "rig"),
        ),
        "convert": Batched(
            *("source", "target", ".sfs", ("sceneloom.cli.convert", "sceneloom.pipeline.converting")),
            files=("loss",),
            beside=("from_times", "rig"),
        ),
        "validate": Batched(
            *("path", "", ".json", ("sceneloom.cli.validate", "sceneloom.checks.validation")), files=("fix",)
        ),
        "track": Batched(
            *("path", "output", ".sfs", ("sceneloom.cli.track", "sceneloom.pipeline.tracking")),
            folders=("images",),
            beside=("boxes3d", "boxes2d", "detectors", "rig"),
        ),
        "report": Batched(
            *("path", "output", ".html", ("sceneloom.cli.report", "sceneloom.report.page")),
            files=("numbers",),
            beside=("truth", "losses", "rig"),
        ),
    }
)


_NAMED = "detectors"  # of those that name files, the one that takes a name, too: verbs take it as text
_LEFT_OUT = ("as_json", "quiet", "verbose", "overwrite")  # options of the verbs that the run decides


class _Verbs(Verbs):
    """Makes a verb over many drives of one over a single drive when it is called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names of the verbs, then what is about runs."""
        return [*BATCHED, *super().list_commands(ctx)]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Make a verb."""
        return _over_many(cmd_name) if cmd_name in BATCHED else super().get_command(ctx, cmd_name)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        """List the verbs without importing them."""
        rows = [(name, f"`sceneloom {name}` over many drives.") for name in BATCHED]
        with formatter.section("Commands"):
            formatter.write_dl([*rows, ("status", "Report the state of a run.")])


@click.group(cls=_Verbs)
def batch() -> None:
    """Run one verb over many drives: in parallel, with a record, so that it can be resumed.

    Drives are paths, patterns in quotes, URLs, or the lines of a list (`--list FILE`, as `sceneloom catalog query`
    writes). A drive that fails does not stop the others.
    """


def target(text: str) -> "Path | str":
    """Take an argument as a folder, or as the location in a store, which workers write to."""
    location = options.location(text)
    return location if isinstance(location, str) else options.target(str(location))


_options = options.stacked(
    click.argument("inputs", nargs=-1, metavar="DRIVES..."),
    option("-o --output=OUT", "Folder of all outputs, or its URL in a store.", target, required=True, group="output"),
    option(
        "--record=DIR",
        "Folder of the run's record where OUT is a URL. [default: one in ~/.local/state/sceneloom]",
        click.Path(path_type=Path, file_okay=False),
    ),
    options.lists('a path, or {"path": …, "start": …, "stop": …, OPTION: FILE}'),
    option(
        "--workers=N",
        "Processes on this machine, each with one thread. [default: one for each processor]",
        click.IntRange(1, 1024),
    ),
    option(
        "--cluster=ADDRESS",
        "Workers of dask instead: `local`, or those of the scheduler at an address such as tcp://HOST:8786.",
    ),
    option("--resume", "Continue an earlier run; what is done and unchanged is skipped."),
    option(
        "--retries=N",
        "Tries again after errors that may pass: a lost worker, a network.",
        click.IntRange(0, 100),
        default=2,
    ),
    option(
        "--metrics=FILE", "Progress of the run as text for Prometheus, rewritten every few seconds.", options.target
    ),
    option("--suffix=TEXT", "Suffix of the outputs. [default: that of the verb]"),
    option("--json as_json", "Print the result as JSON.", group="general"),
    option("-q --quiet", "No progress, no warnings.", group="general"),
    option("-v --verbose", "Every failure, not only the first ones.", group="general"),
)


def _over_many(name: str) -> click.Command:
    batched, verb = BATCHED[name], verb_named(name)
    theirs = []
    for parameter in verb.params:
        if parameter.name in {*batched.folders, *batched.files}:
            parameter = copy(parameter)  # noqa: PLW2901 - which may lie in a store as OUT does
            parameter.type = click.types.convert_type(target)
        if parameter.name not in {batched.drive, batched.output, *_LEFT_OUT}:
            theirs.append(parameter)

    def callback(**values: Any) -> int:
        own = {option.name: values.pop(option.name) for option in ours}
        return _run(name, own, values)

    ours = click.command()(_options(lambda: None)).params
    reported = f"{inspect.cleandoc(verb.help or '')}\n\nOver many drives: {_HELP}"
    return Verb(name, params=[*ours, *theirs], callback=callback, help=reported)


_HELP = (
    "outputs are named by their drives and lie in OUT, a folder or a location in a store, such as s3://bucket/run1/. "
    "Other outputs have the drives' names, too: for a folder DIR that an option names DIR/DRIVE, for a file NAME "
    "DRIVE.NAME beside it. In names of files that are read, such as --truth 'truths/{name}.tum', {name} is the drive's "
    "name, {drive} its path, {folder} its folder. The record of the run is OUT/.sceneloom-run, or --record. Exit code "
    "1 if a drive failed."
)


def _run(name: str, own: dict[str, Any], values: dict[str, Any]) -> int:
    from sceneloom.batch.jobs import Further, Job, give_files
    from sceneloom.batch.running import run
    from sceneloom.formats.base.files import processors

    workers = own["workers"] or processors()
    taken, whole = _beside(name), partial(_is_one_task, values)
    stated = {option: values[option] for option in taken if values[option] not in (None, ())}
    reading, batched = options.stated(**values), BATCHED[name]
    found = find_listed(
        name, own["inputs"], own["lists"], files=taken, reading=reading, stays=whole, quiet=own["quiet"]
    )
    inputs, files = give_files(found, stated, taken)
    outputs = [option for option in (*batched.folders, *batched.files) if values[option] is not None]
    values |= {option: str(values[option]) for option in outputs}
    # names of folders, with a file for each drive, end in nothing
    suffix = "" if all(map(whole, inputs)) else batched.suffix
    job = Job(
        verb=name,
        call=CALL,
        inputs=inputs,
        options={"verb": name, **values},
        files=files,
        suffix=suffix if own["suffix"] is None else own["suffix"],
        retries=own["retries"],
        modules=batched.modules,
        further=tuple(
            Further(option=option, location=values[option], is_folder=option in batched.folders) for option in outputs
        ),
    )
    executor = _cluster(own, workers)
    with _progress(name, len(job.inputs), quiet=own["quiet"]) as reported:
        summary = run(
            job,
            own["output"],
            record=own["record"],
            workers=workers,
            executor=executor,
            resume=own["resume"],
            reported=_all_reported(reported, own["metrics"]),
        )
    if own["as_json"]:
        print_json(summary)
    else:
        _print_summary(summary, verbose=own["verbose"])
    return int(bool(summary.failed))


def _is_one_task(values: Mapping[str, Any], drive: "Input") -> bool:
    """Whether a verb does all sequences of a folder of KITTI's at once, since detections lie beside them."""
    takes = values.get("fusion_type") == "detection" if "fusion_type" in values else "boxes3d" in values
    lists = any(values.get(name) or drive.files.get(name) for name in ("boxes3d", "boxes2d"))
    if not takes or lists:
        return False
    from sceneloom.formats.kitti.tracking_reader import is_tracking_folder

    return Path(drive.location).is_dir() and is_tracking_folder(Path(drive.location))


def _all_reported(reported: "Reported | None", metrics: Path | None) -> "Reported | None":
    """Report the file of metrics, too, if there is one."""
    if metrics is None:
        return reported
    from sceneloom.batch.figures import MetricsFile
    from sceneloom.formats.base.output import check_output

    check_output(metrics, overwrite=True)
    file = MetricsFile(metrics)

    def both(summary: "RunSummary", outcome: "Outcome") -> None:
        file.reported(summary, outcome)
        if reported is not None:
            reported(summary, outcome)

    return both


def _cluster(own: dict[str, Any], workers: int) -> "Executor | None":
    """The workers of dask that were asked for, and where dask shows them."""
    if own["cluster"] is None:
        return None
    from sceneloom.batch.cluster import open_cluster

    cluster = open_cluster(own["cluster"], workers)
    if cluster.dashboard and not own["quiet"]:
        click.echo(f"dask's dashboard: {cluster.dashboard}", err=True)
    return cluster


@contextmanager
def _progress(name: str, total: int, *, quiet: bool) -> Iterator["Reported | None"]:
    """A bar with the rate and what is left, on a terminal; failures are reported above it at once."""
    import sys

    if quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(), TextColumn("{task.fields[failed]}"),
    )  # fmt: skip
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        row = bar.add_task(name, total=total, rate="", failed="")

        def reported(summary: "RunSummary", outcome: "Outcome") -> None:
            ended = summary.done + summary.failed - summary.skipped
            rate = f"{60.0 * ended / summary.seconds:.1f}/min" if summary.seconds else ""
            failed = f"{summary.failed} failed" if summary.failed else ""
            bar.update(row, completed=ended + summary.skipped, rate=rate, failed=failed)
            if outcome.error:
                bar.console.print(f"{outcome.error.strip().splitlines()[-1]}", markup=False, highlight=False)

        yield reported


# the drives


def find_listed(
    verb: str,
    locations: Sequence[str],
    lists: Sequence[Path],
    *,
    files: "Mapping[str, FileOption] | None" = None,
    reading: Mapping[str, Any] | None = None,
    stays: "Callable[[Input], bool]" = lambda _: False,
    quiet: bool = False,
) -> "tuple[Input, ...]":
    """Find the drives of a command, and report what lists state for other verbs.

    Args:
        locations, lists, files: as of `find_inputs`.
        reading: the stated options of reading; each drive of a data set is then found for itself, unless they name one.
        stays: which data sets are not split so, since the verb does all their drives at once.
    """
    from sceneloom.batch.jobs import find_inputs

    others = {option for batched in BATCHED.values() for option in batched.beside}
    found = find_inputs(locations, lists, files=files or {}, others=others)
    unread = sorted({option for drive in found for option in drive.unread})
    if unread and not quiet:
        flags = ", ".join(f"--{option.replace('_', '-')}" for option in unread)
        click.echo(f"not read by {verb}: what the lists state for {flags}", err=True)
    if reading is None:
        return found
    if reading.get("sequence") or reading.get("sequences"):
        return found
    drives: list[Input] = []
    for one in found:
        several = (one,) if stays(one) else one.drives(read_as=reading.get("format"))
        if len(several) > 1 and not quiet:
            click.echo(f"{one.name}: {len(several)} drives; --sequence chooses one", err=True)
        drives += several
    return tuple(drives)


def options_of(drive: "Input") -> dict[str, Any]:
    """How a list states that a drive is opened."""
    return {name.removeprefix(READING): value for name, value in drive.options.items() if name.startswith(READING)}


# one drive


def _beside(name: str) -> dict[str, FileOption]:
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
        values: of the verb's other parameters, its name as `verb`.

    Raises:
        SceneloomError: the verb refuses the drive.
    """
    given = dict(values)
    name = given.pop("verb")
    batched, command = BATCHED[name], verb_named(name)
    fixed = {"as_json": True, "quiet": True, "verbose": True, "overwrite": False}
    given |= {parameter.name: fixed[parameter.name] for parameter in command.params if parameter.name in fixed}
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
    reported: Any = printed.getvalue()
    try:
        reported = json.loads(reported)
    except ValueError:
        reported = reported.strip()
    if not batched.output:  # without times, which the record has: the same drive gives the same file
        result = reported
        if isinstance(reported, dict):
            result = {name: value for name, value in reported.items() if name != "stages"}
        with output.open("w", encoding="utf-8") as file, redirect_stdout(file):
            print_json(result)
    return reported


def _read_as_listed(given: dict[str, Any], command: click.Command) -> None:
    """Put what a list says of reading a drive where the verb has it, instead of what is stated for all."""
    names = {parameter.name for parameter in command.params} & options.READING
    sequences = any(parameter.name == "sequences" for parameter in command.params)
    for own in [name for name in given if name.startswith(READING)]:
        name, value = own.removeprefix(READING), given.pop(own)
        if name == "sequence" and sequences:
            given["sequences"] = (value,)
        elif name in names - {options.INPUT_OPTIONS}:
            given[name] = value
        else:
            given[options.INPUT_OPTIONS] = (*given.get(options.INPUT_OPTIONS, ()), f"{name}={value}")


# how a run stands


@batch.command(examples=("fused/", "fused/ --json"))
@click.argument("output", type=options.location)
@option(
    "--record=DIR",
    "Folder of the record of a run into a store, if it is not where it is by default.",
    click.Path(path_type=Path, file_okay=False),
)
@option("--html=FILE", "Write a page about the run as well.", options.target)
@option("--overwrite", "Replace outputs that exist.")
@option("--json as_json", "Print the result as JSON.", group="general")
@option("-q --quiet", "Only how many, no failures.")
@option("-v --verbose", "Every drive, not only the failures.")
def status(output: Path | str, record: Path | None, html: Path | None, overwrite: bool, **shown: bool) -> None:
    """Report the state of the run into OUTPUT, a folder or a URL, while it goes on, too."""
    from sceneloom.batch.figures import RunFigures
    from sceneloom.batch.jobs import State
    from sceneloom.batch.record import Record
    from sceneloom.errors import redacted

    folder = record or (Record.folder_for(output) if isinstance(output, str) else output)
    with Record.opened(folder) as opened:
        reported, rows = opened.reported(), opened.rows()
    figures = RunFigures.read(folder)
    if html is not None:
        figures.write_page(html, overwrite=overwrite)
    if shown["as_json"]:
        print_json({"run": reported, "stages": figures.stages, "drives": [asdict(row) for row in rows]})
        return
    counts = {state: sum(row.state is state for row in rows) for state in State}
    parts = ", ".join(f"{count} {state}" for state, count in counts.items() if count)
    click.echo(f"{redacted(output)}: {reported.get('verb', '')} over {several(len(rows), 'drive')}: {parts or 'none'}")
    if shown["quiet"]:
        return
    stages = sorted(figures.stages.items(), key=lambda stage: -stage[1])
    if stages:
        click.echo("  " + ", ".join(f"{name} {seconds:.1f} s" for name, seconds in stages))
    listed = rows if shown["verbose"] else [row for row in rows if row.state is State.FAILED]
    print_table(
        [(row.state, row.name, "" if row.seconds is None else f"{row.seconds:.1f} s", _why(row)) for row in listed]
    )
    if html is not None:
        click.echo(f"page: {html}")


def _print_summary(summary: "RunSummary", *, verbose: bool) -> None:
    """Report how a run ended, and what to do about failures."""
    from sceneloom.batch.jobs import State
    from sceneloom.batch.record import Record

    parts = [f"{summary.done} done"]
    parts += [f"{summary.skipped} of them before and unchanged"] if summary.skipped else []
    parts += [f"{summary.failed} failed"] if summary.failed else []
    parts += [several(summary.retried, "further try", "further tries")] if summary.retried else []
    click.echo(f"{summary.verb}: {several(summary.total, 'drive')} in {summary.seconds:.1f} s: {', '.join(parts)}")
    together = summary.record == summary.output
    click.echo(f"outputs{' and record' if together else ''}: {summary.output}")
    if not together:
        click.echo(f"record: {summary.record}")
    if not summary.failed:
        return
    with Record.opened(Path(summary.record)) as record:
        failed = record.rows(State.FAILED)
    for row in failed if verbose else failed[:SHOWN]:
        click.echo(f"failed: {row.name}: {_why(row)}", err=True)
    if not verbose and len(failed) > SHOWN:
        click.echo(f"… and {len(failed) - SHOWN} more: `sceneloom batch status {summary.record}`", err=True)
    click.echo("next: repair what failed, then state the same with `--resume`", err=True)


def _why(row: "Row") -> str:
    """The last line of an error, without the drive that it begins with."""
    lines = (row.error or "").strip().splitlines()
    return lines[-1].removeprefix(f"{row.input}: ") if lines else ""
