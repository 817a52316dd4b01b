"""The command `sceneloom` and the table of its verbs, each imported when it is called."""

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from io import TextIOWrapper
from types import FrameType, MappingProxyType
from typing import Any, NoReturn

import click

from sceneloom.cli.first_run import telling_of_compiling
from sceneloom.cli.verb_group import VerbGroup
from sceneloom.errors import OptionError, SceneloomError, ignore_warnings_of_extreme_numbers
from sceneloom.version import __version__

VERBS = MappingProxyType(
    {
        "demo": "Make a small drive, fuse it, show what came out.",
        "info": "Report what is in a recording or a scene.",
        "fuse": "Fuse lidar and cameras of a drive into one scene.",
        "track": "Follow objects through a drive by what detectors found in it.",
        "colour": "Colour the points of a drive from all its cameras: one map, or sweep by sweep.",
        "depth": "Write depth images, sparse or dense, with a confidence.",
        "view": "Look at a drive in Rerun's viewer, or save the view to a file.",
        "convert": "Write a recording or a scene in another format.",
        "validate": "Check a drive or a scene by rules, and repair what can be repaired safely.",
        "salvage": "Take out of a damaged scene file what is whole.",
        "report": "Make a page about a drive that can be sent.",
        "batch": "Do one verb for many drives: in parallel, with a record, resumable.",
        "catalog": "Put many drives into tables, and find drives and moments in them.",
        "diff": "Report what differs between two drives.",
        "edit": "Change one thing of a drive: crop, merge, deskew, …",
        "eval": "Report how good an estimate is: a trajectory, tracks or detections, against a reference.",
        "sync": "Report whether the clocks of a drive's streams are in step, and correct them.",
        "calibrate": "Report whether camera and lidar lie to one another as the calibration says, and repair it.",
        "serve": "Serve the fusion interface of DB34/T 4101-2022 over gRPC.",
        "send": "Send a drive, or a log, to a fusion service.",
        "get": "Fetch results from a fusion service.",
        "conformance": "Check a fusion service against DB34/T 4101-2022.",
        "formats": "List the formats that can be read and written.",
        "doctor": "Report what this installation can do and what it lacks.",
        "completion": "Print what a shell needs to complete verbs and options.",
    }
)


@click.group(
    cls=VerbGroup, verbs=VERBS, room="sceneloom.cli", context_settings={"help_option_names": ["-h", "--help"]}
)
@click.version_option(__version__, prog_name="sceneloom")
def sceneloom() -> None:
    """Weave every sensor of a drive into one scene.

    Start with `sceneloom demo`; then `sceneloom info YOUR_DRIVE` and `sceneloom fuse YOUR_DRIVE -o drive.sfs`.
    """


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; exit 0 when done, 1 on bad data, 2 on bad usage."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            # names of files may be no Unicode, and a terminal may know fewer characters than we write
            stream.reconfigure(errors="backslashreplace")
    ignore_warnings_of_extreme_numbers()
    with _ending_cleanly(), telling_of_compiling():
        sys.exit(_run(arguments))


EXIT_CODES: tuple[tuple[type[BaseException], int], ...] = (
    (OptionError, 2),
    (SceneloomError, 1),
    (OSError, 1),
    (MemoryError, 1),
)
"""What each kind of failure means to the shell; the first that fits counts."""


ENDING_SIGNALS = ("SIGTERM", "SIGHUP")
"""What asks a program to end, besides Ctrl-C: `kill`, a container or a batch system, a terminal that closes."""


class Ended(BaseException):
    """One of the ending signals came; passes through everything, so that half written outputs are taken away."""


def _end(number: int, frame: FrameType | None) -> NoReturn:  # noqa: ARG001 - the signature of a signal's handler
    raise Ended(number)


@contextmanager
def _ending_cleanly() -> Iterator[None]:
    """Let the ending signals do what Ctrl-C does; those that the caller ignores or handles are left alone."""
    found = [getattr(signal, name) for name in ENDING_SIGNALS if hasattr(signal, name)]
    main_thread = threading.current_thread() is threading.main_thread()
    ours = [number for number in found if main_thread and signal.getsignal(number) is signal.SIG_DFL]
    for number in ours:
        signal.signal(number, _end)
    try:
        yield
    finally:
        for number in ours:
            signal.signal(number, signal.SIG_DFL)


def _run(arguments: list[str] | None) -> int:
    try:
        result: Any = sceneloom.main(args=arguments, prog_name="sceneloom", standalone_mode=False)
    except (click.exceptions.Abort, KeyboardInterrupt):
        click.echo("sceneloom: stopped; nothing was left half written", err=True)
        return 128 + signal.SIGINT
    except Ended as ended:
        click.echo("sceneloom: stopped; nothing was left half written", err=True)
        return 128 + int(ended.args[0])
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except tuple(kind for kind, _ in EXIT_CODES) as error:
        click.echo(f"sceneloom: {_reported(error)}", err=True)
        for step in filter(None, getattr(error, "__notes__", ())):
            click.echo(f"next: {step}", err=True)
        return next(code for kind, code in EXIT_CODES if isinstance(error, kind))
    return result if isinstance(result, int) else 0


def _reported(error: BaseException) -> str:
    """The error in one line, that of the operating system in the form of ours: file, then problem."""
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    text = error.with_sources() if isinstance(error, SceneloomError) else str(error)
    return text or type(error).__name__
