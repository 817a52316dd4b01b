"""The command `sceneloom` and the table of its verbs, each imported when it is called."""

import gc
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from io import TextIOWrapper
from types import FrameType, MappingProxyType
from typing import Any, NoReturn

import click

from sceneloom.cli.help import Verbs
from sceneloom.errors import OptionError, SceneloomError, ignore_warnings_of_extreme_numbers
from sceneloom.kernels.cache import reporting_compiling
from sceneloom.version import __version__

VERBS = MappingProxyType(
    {
        "demo": ("fuse", "Simulate a small drive, fuse it, and show the result."),
        "info": ("info", "Report what is in a recording or a scene."),
        "fuse": ("fuse", "Fuse lidar and cameras of a drive into one scene."),
        "track": ("track", "Track objects through a drive by detections."),
        "colour": ("colour", "Colour the points of a drive from all its cameras: one map, or sweep by sweep."),
        "depth": ("depth", "Write depth images, sparse or dense, with a confidence."),
        "view": ("view", "Look at a drive in Rerun's viewer, or save the view to a file."),
        "convert": ("convert", "Write a recording or a scene in another format."),
        "validate": ("validate", "Check a drive or a scene by rules, and repair what can be repaired safely."),
        "salvage": ("validate", "Extract what is whole from a damaged scene file."),
        "report": ("report", "Write a page about a drive that can be sent."),
        "batch": ("batch", "Run one verb over many drives: in parallel, with a record, resumable."),
        "catalog": ("catalog", "Put many drives into tables, and find drives and moments in them."),
        "diff": ("diff", "Report what differs between two drives."),
        "edit": ("edit", "Change one thing of a drive: crop, merge, deskew, …"),
        "eval": ("evaluate", "Evaluate a trajectory, tracks or detections against a reference."),
        "sync": ("sync", "Check whether the clocks of a drive's streams are synchronised, and correct them."),
        "calibrate": ("calibrate", "Check the camera-lidar calibration, and refine it."),
        "serve": ("service", "Serve the fusion interface of DB34/T 4101-2022 over gRPC."),
        "send": ("service", "Send a drive, or a session log, to a fusion service."),
        "get": ("service", "Fetch results from a fusion service."),
        "conformance": ("service", "Check a fusion service against DB34/T 4101-2022."),
        "formats": ("formats", "List the formats that can be read and written."),
        "doctor": ("installation", "Report what this installation can do and what it lacks."),
        "completion": ("installation", "Print what a shell needs to complete verbs and options."),
    }
)
"""The module of each verb, and a line on it for `--help`."""


class _Program(Verbs):
    """Imports a verb only when it is called, so that `--help` is quick."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002 - click's signature
        return list(VERBS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002
        if cmd_name not in VERBS:
            return None
        found = vars(import_module(f"sceneloom.cli.{VERBS[cmd_name][0]}")).values()
        return next(verb for verb in found if isinstance(verb, click.Command) and verb.name == cmd_name)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        with formatter.section("Commands"):
            formatter.write_dl([(name, line) for name, (_, line) in VERBS.items()])


@click.group(cls=_Program, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="sceneloom")
def sceneloom() -> None:
    """Fuse every sensor of a drive into one scene.

    Start with `sceneloom demo`; then `sceneloom info YOUR_DRIVE` and `sceneloom fuse YOUR_DRIVE -o drive.sfs`.
    """


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; exit 0 when done, 1 on bad data, 2 on bad usage."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            # names of files need not be Unicode, and a terminal may know fewer characters than we write
            stream.reconfigure(errors="backslashreplace")
    # thousands of products with 3x3 matrices are all that BLAS gets: its threads would only spin beside ours
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    gc.set_threshold(5_000)  # what starts makes many objects and few cycles: to look for these took 4 % of `validate`
    ignore_warnings_of_extreme_numbers()
    with _ending_cleanly(), reported_compiling():
        sys.exit(_run(arguments))


EXIT_CODES: tuple[tuple[type[BaseException], int], ...] = (
    (OptionError, 2),
    (SceneloomError, 1),
    (OSError, 1),
    (MemoryError, 1),
)
"""What each kind of failure means to the shell; the first that fits counts."""
_SIGNALS = ("SIGTERM", "SIGHUP")
"""What asks a program to end, besides Ctrl-C: `kill`, a container or a batch system, a terminal that closes."""


class _Ended(BaseException):
    """One of the signals came; passes through everything, so that partial outputs are removed."""


def _end(number: int, frame: FrameType | None) -> NoReturn:  # noqa: ARG001 - the signature of a signal's handler
    raise _Ended(number)


@contextmanager
def _ending_cleanly() -> Iterator[None]:
    """Let the signals do what Ctrl-C does; those that the caller ignores or handles are left alone."""
    found = [getattr(signal, name) for name in _SIGNALS if hasattr(signal, name)]
    main_thread = threading.current_thread() is threading.main_thread()
    ours = [number for number in found if main_thread and signal.getsignal(number) is signal.SIG_DFL]
    for number in ours:
        signal.signal(number, _end)
    try:
        yield
    finally:
        for number in ours:
            signal.signal(number, signal.SIG_DFL)


@contextmanager
def reported_compiling() -> Iterator[None]:
    """Say on a terminal that kernels are compiled, and how many are left: a first run is silent for long otherwise."""
    if not sys.stderr.isatty():
        yield
        return
    words, said = "compiling numeric kernels for this machine, once", False

    def report(_: str, left: int) -> None:
        nonlocal said
        if left > 1 or said:
            click.echo(f"\r{words}: {left:3} left", nl=left == 1, err=True)
        else:
            click.echo(f"{words} …", err=True)
        said = True

    with reporting_compiling(report):
        yield


def _run(arguments: list[str] | None) -> int:
    try:
        result: Any = sceneloom.main(args=arguments, prog_name="sceneloom", standalone_mode=False)
    except (click.exceptions.Abort, KeyboardInterrupt, _Ended) as stopped:
        click.echo("sceneloom: stopped; no partial output was left", err=True)
        return 128 + (int(stopped.args[0]) if isinstance(stopped, _Ended) else signal.SIGINT)
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except tuple(kind for kind, _ in EXIT_CODES) as error:
        from sceneloom.cli.printing import marked

        click.echo(f"{marked('sceneloom')}: {_reported(error)}", err=True)
        for step in filter(None, getattr(error, "__notes__", ())):
            click.echo(f"{marked('next')}: {step}", err=True)
        return next(code for kind, code in EXIT_CODES if isinstance(error, kind))
    return result if isinstance(result, int) else 0


def _reported(error: BaseException) -> str:
    """The error in one line, that of the operating system in the form of ours: file, then problem."""
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    text = error.with_sources() if isinstance(error, SceneloomError) else str(error)
    return text or type(error).__name__
