"""One try at one drive, in whatever process it happens."""

import os
import socket
import sys
import time
import traceback
from importlib import import_module
from pathlib import Path
from tempfile import gettempdir
from typing import Any

from sceneloom.batch.files import with_files
from sceneloom.batch.further import bring, drafts_of
from sceneloom.batch.jobs import Outcome, Task
from sceneloom.batch.outputs import send
from sceneloom.errors import SceneloomError, ignore_warnings_of_extreme_numbers
from sceneloom.formats.fingerprints import late_fingerprint
from sceneloom.redaction import redacted
from sceneloom.stages import stage, timed

NUMBA = "NUMBA_NUM_THREADS"
THREADS = (
    *("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS"),
    *("VECLIB_MAXIMUM_THREADS", "NUMEXPR_NUM_THREADS", NUMBA),
)
"""What says to libraries how many threads they may start, before they are imported: as many processes as processors,
each with one thread, is the fastest that many drives are done."""

_PASSING = (ConnectionError, TimeoutError, InterruptedError, BlockingIOError)


def run_task(task: Task) -> Outcome:
    """Do one drive; whatever goes wrong with it is reported, not raised, and without secrets of addresses."""
    begun, busy = time.perf_counter(), time.process_time()
    reported: dict[str, Any] = {}
    ignore_warnings_of_extreme_numbers()
    try:
        with timed() as stages:
            reported = _done(task)
        if stages and isinstance(reported.get("report"), dict):
            reported["report"]["stages"] = {name: round(seconds, 6) for name, seconds in stages.items()}
    except (SceneloomError, OSError, MemoryError) as error:
        reported = {
            "error": redacted(_message(error)) or type(error).__name__,
            "kind": type(error).__name__,
            "passing": may_pass(error),
        }
    except Exception as error:  # noqa: BLE001 - a fault in one drive must not end the others
        reported = {
            "error": redacted("".join(traceback.format_exception(error))),
            "kind": type(error).__name__,
        }
    return Outcome(
        number=task.number,
        seconds=time.perf_counter() - begun,
        processor_seconds=time.process_time() - busy,
        peak_bytes=peak_bytes(),
        worker=f"{socket.gethostname()}:{os.getpid()}",
        **reported,
    )


def _message(error: BaseException) -> str:
    return error.with_sources() if isinstance(error, SceneloomError) else str(error)


def _done(task: Task) -> dict[str, Any]:
    """Do the verb, and send what it wrote to where it belongs if that is a store; gives what is reported it."""
    seen = with_files(late_fingerprint(task.location), task.files)
    draft = draft_of(task)
    draft.parent.mkdir(parents=True, exist_ok=True)
    further = drafts_of(draft, task.further)
    for location in further.values():
        location.parent.mkdir(parents=True, exist_ok=True)
    module, _, name = task.call.partition(":")
    values = {**task.options, **task.files, **further}
    report = getattr(import_module(module), name)(task.location, draft, values)
    if not draft.exists():
        return {
            "error": f"{redacted(task.location)}: ended without its output {draft.name}",
            "kind": "Missing",
        }
    if task.target:
        with stage("sending"):
            bring(draft, task.further)
            send(draft, task.target)
    if isinstance(report, dict) and any(location.exists() for location in further.values()):
        report["further"] = {
            option: task.further[option] for option, location in further.items() if location.exists()
        }
    return {"report": _without_secrets(report), "fingerprint": seen}


def draft_of(task: Task) -> Path:
    """Where the output of a task is written on this machine."""
    return Path(gettempdir()) / task.draft if task.target else task.draft


def _without_secrets(reported: Any) -> Any:
    if isinstance(reported, str):
        return redacted(reported)
    if isinstance(reported, dict):
        return {name: _without_secrets(value) for name, value in reported.items()}
    return [_without_secrets(value) for value in reported] if isinstance(reported, list | tuple) else reported


def may_pass(error: BaseException | None) -> bool:
    """Whether the cause of an error may be gone another time: of a network, not of data."""
    while error is not None:
        if isinstance(error, _PASSING) or getattr(error, "passing", False):
            return True
        error = error.__cause__ or error.__context__
    return False


def peak_bytes() -> int:
    """The most memory that this process ever had; 0 where the system does not report."""
    try:
        import resource
    except ImportError:
        return 0
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else most * 1024
