"""The verbs of `sceneloom batch`: those of the command line that take one drive, with the drives in its location."""

import inspect
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from copy import copy
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options
from sceneloom.cli.batch.one_drive import BATCHED, CALL, beside, verb_named
from sceneloom.cli.batch.status import print_summary, status
from sceneloom.cli.printing import print_json

if TYPE_CHECKING:
    from sceneloom.batch.jobs import Further, Input, Outcome
    from sceneloom.batch.running import Reported, RunSummary
    from sceneloom.batch.workers import Executor

_OWN = (
    "inputs",
    "lists",
    "output",
    "record",
    "workers",
    "cluster",
    "metrics",
    "resume",
    "retries",
    "suffix",
    "as_json",
    "quiet",
    "verbose",
)
_LEFT_OUT = ("as_json", "quiet", "verbose", "overwrite")
"""Options of the verbs that the run decides."""

FAILED_CODE = 1
"""The exit code of a run in which drives failed."""


class Verbs(click.Group):
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
            formatter.write_dl([*rows, ("status", "Report how a run stands.")])


@click.group(cls=Verbs)
def batch() -> None:
    """Do one verb for many drives: in parallel, with a record, so that it can be taken up again.

    Drives are paths, patterns in quotes, URLs, or the lines of a list (`--list FILE`, as `sceneloom catalog query`
    writes). A drive that fails does not stop the others.
    """


batch.add_command(status)


def _over_many(name: str) -> click.Command:
    batched, verb = BATCHED[name], verb_named(name)
    theirs = [
        _placed(parameter) if parameter.name in {*batched.folders, *batched.files} else parameter
        for parameter in verb.params
        if parameter.name not in {batched.drive, batched.output, *_LEFT_OUT}
    ]

    def callback(**values: Any) -> int:
        own = {key: values.pop(key) for key in _OWN}
        return _run(name, own, values)

    for option in reversed(_OPTIONS):
        callback = option(callback)
    ours: list[click.Parameter] = list(reversed(callback.__click_params__))  # type: ignore[attr-defined]
    reported = f"{inspect.cleandoc(verb.help or '')}\n\nOver many drives: {_HELP}"
    return click.Command(name, params=[*ours, *theirs], callback=callback, help=reported)


_HELP = (
    "outputs are named by their drives and lie in OUT, a folder or a location in a store, such as s3://bucket/run1/. "
    "What "
    "else is written has the drives' names, too: for a folder DIR that an option names DIR/DRIVE, for a file NAME "
    "DRIVE.NAME beside it. In names of files that are read, such as --truth 'truths/{name}.tum', {name} is what the "
    "drive is called, {drive} its path, {folder} where it lies. The record of the run is OUT/.sceneloom-run, or "
    "--record. Exit code 1 if a drive failed."
)


def target(text: str) -> "Path | str":
    """Take an argument as a folder, or as the location in a store, which workers write to."""
    location = options.location(text)
    return location if isinstance(location, str) else options.target(str(location))


def _placed(parameter: click.Parameter) -> click.Parameter:
    """The option of a further output, which may lie in a store as OUT does."""
    placed = copy(parameter)
    placed.type = click.types.convert_type(target)
    return placed


def _further(name: str, values: dict[str, Any]) -> "tuple[Further, ...]":
    """Take the further outputs that were asked for out of the verb's values, as the run writes them."""
    from sceneloom.batch.jobs import Further

    batched = BATCHED[name]
    wanted = [option for option in (*batched.folders, *batched.files) if values[option] is not None]
    for option in wanted:
        values[option] = str(values[option])
    return tuple(
        Further(option=option, location=values[option], is_folder=option in batched.folders)
        for option in wanted
    )


_OPTIONS = (
    click.argument("inputs", nargs=-1, metavar="DRIVES..."),
    click.option(
        "-o",
        "--output",
        type=target,
        required=True,
        metavar="OUT",
        help="Folder of all outputs, or its URL in a store.",
    ),
    click.option(
        "--record",
        type=click.Path(path_type=Path, file_okay=False),
        metavar="DIR",
        help="Folder of the run's record where OUT is a URL. [default: one in ~/.local/state/sceneloom]",
    ),
    options.lists('a path, or {"path": …, "start": …, "stop": …, OPTION: FILE}'),
    click.option(
        "--workers",
        type=click.IntRange(1, 1024),
        metavar="N",
        help="Processes on this machine, each with one thread. [default: one for each processor]",
    ),
    click.option(
        "--cluster",
        metavar="ADDRESS",
        help="Workers of dask instead: `local`, or those of the scheduler at an address such as tcp://HOST:8786.",
    ),
    click.option(
        "--resume", is_flag=True, help="Go on with an earlier run; what is done and unchanged is skipped."
    ),
    click.option(
        "--retries",
        type=click.IntRange(0, 100),
        default=2,
        show_default=True,
        metavar="N",
        help="So often is tried again what may work another time: a lost worker, a network.",
    ),
    click.option(
        "--metrics",
        type=options.target,
        metavar="FILE",
        help="How the run stands as text for Prometheus, written anew every few seconds.",
    ),
    click.option(
        "--suffix", metavar="TEXT", help="What names of outputs end in. [default: that of the verb]"
    ),
    *(
        click.option("--json", "as_json", is_flag=True, help="Print the result as JSON."),
        click.option("-q", "--quiet", is_flag=True, help="No progress, no warnings."),
        click.option("-v", "--verbose", is_flag=True, help="Every failure, not only the first ones."),
    ),
)


def _run(name: str, own: dict[str, Any], values: dict[str, Any]) -> int:
    from sceneloom.batch.jobs import Job, give_files
    from sceneloom.batch.running import run
    from sceneloom.cli.batch.listed import find_listed
    from sceneloom.formats.base.files import processors

    workers = own["workers"] or processors()
    taken, whole = beside(name), partial(_is_one_task, values)
    stated = {option: values[option] for option in taken if values[option] not in (None, ())}
    found = find_listed(
        name, own["inputs"], own["lists"], files=taken, reading=values, stays=whole,
        quiet=own["quiet"],
    )  # fmt: skip
    inputs, files = give_files(found, stated, taken)
    further = _further(name, values)
    executor = _cluster(own, workers)
    job = Job(
        verb=name,
        call=CALL,
        inputs=inputs,
        options={"verb": name, **values},
        files=files,
        suffix=_suffix(name, own["suffix"], folders=all(map(whole, inputs))),
        retries=own["retries"],
        modules=BATCHED[name].modules,
        further=further,
    )
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
        print_summary(summary, verbose=own["verbose"])
    return FAILED_CODE if summary.failed else 0


def _suffix(name: str, stated: str | None, *, folders: bool) -> str:
    """What names of outputs end in; those of folders, with a file for each drive, in nothing."""
    if stated is None:
        return "" if folders else BATCHED[name].suffix
    return stated


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
    from sceneloom.batch.running import MetricsFile
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
