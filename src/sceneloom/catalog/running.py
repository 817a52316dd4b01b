"""Many drives into a catalogue: workers read them, and what was read is put into parts, some drives at a time."""

import shutil
import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import msgspec

from sceneloom.batch.jobs import Outcome, Task
from sceneloom.batch.pool import LOST, Executor, ProcessPool
from sceneloom.batch.warming import Warming
from sceneloom.batch.working import run_task
from sceneloom.catalog.drives import Checks, Drive, looked_at
from sceneloom.catalog.parts import PART_ROWS, Entry, Fresh, Parts
from sceneloom.errors import OutputError
from sceneloom.formats.processors import processors
from sceneloom.scene.types import Progress

_CALL = "sceneloom.catalog.drives:read_drive"
_LOOK_SECONDS = 0.5
_PATIENCE_SECONDS = 20.0
"""After so long what was read is put into parts, though they have room: a run that is killed loses no more."""
_TRIES = 3
_DRIVES_OF_WORKER = 8
"""So many short drives take as long as a process to start."""


class Failure(msgspec.Struct, frozen=True, kw_only=True):
    """A drive that could not be read, and why."""

    path: str
    error: str


class Run:
    """One going through drives; only one goes on in a catalogue at a time (`Layout.held`).

    Attributes:
        read: the drives that were read and put into parts.
        failed: those that could not be read.
    """

    def __init__(
        self,
        parts: Parts,
        drafts: Path,
        checks: Checks,
        *,
        workers: int | None = 1,
        progress: Progress | None = None,
    ) -> None:
        """Have nothing read yet.

        Args:
            parts: where scenes are put.
            drafts: folder in which they are written before.
            checks: how much is checked.
            workers: processes; None for as many as are worth it.
            progress: reported the number of drives done and of all.
        """
        self._parts, self._drafts, self._checks = parts, drafts, checks
        self._workers, self._progress = workers, progress
        self._waiting: dict[str, tuple[Drive, Fresh]] = {}
        self._put_at = time.monotonic()
        self.read: list[Drive] = []
        self.failed: list[Failure] = []

    def go(self, drives: Sequence[Drive], files: Mapping[str, str], *, done: int = 0) -> None:
        """Read drives, and those whose rows were lost with damaged files of the same parts.

        Args:
            drives: each once.
            files: of them, as `looked_at` gives them.
            done: how many more are done already.

        Raises:
            OutputError: the catalogue cannot be written.
        """
        tried: set[str] = set()
        due = list(drives)
        while due:
            tried |= {drive.name for drive in due}
            lost = self._read(due, files, done) - tried
            done += len(due)
            due = [
                Drive(entry.path, entry.options)
                for scene, entry in self._parts.entries.items()
                if scene in lost
            ]
            files = looked_at(due)

    def _read(self, drives: Sequence[Drive], files: Mapping[str, str], before: int) -> set[str]:
        """Read drives and put them in; the names of scenes whose rows are lost."""
        workers = self._workers or min(processors(), -(-len(drives) // _DRIVES_OF_WORKER))
        executor: Executor = ProcessPool(workers) if min(workers, len(drives)) > 1 else _Here()
        lost: set[str] = set()
        tasks = [self._task(number, drive, files[drive.path]) for number, drive in enumerate(drives)]
        try:
            for done, (task, outcome) in enumerate(_finished(tasks, executor), start=1):
                self._take(drives[task.number], task, outcome)
                if self._is_time():
                    lost |= self._put()
                if self._progress is not None:
                    self._progress(before + done, before + len(drives))
        finally:  # what was read is kept, too, when the run is stopped
            executor.stop()
            lost |= self._put()
        return lost

    def _task(self, number: int, drive: Drive, files: str) -> Task:
        options = {
            "scene": drive.name,
            "timestamp": drive.timestamp(self._checks, files),
            "checks": self._checks.value,
            "reading": dict(drive.reading),
        }
        draft = self._drafts / drive.name
        return Task(number=number, attempt=1, call=_CALL, location=drive.path, draft=draft, options=options)

    def _take(self, drive: Drive, task: Task, outcome: Outcome) -> None:
        if outcome.kind == OutputError.__name__:
            raise OutputError(outcome.error)  # what befell the catalogue befalls all drives
        if outcome.error:
            shutil.rmtree(task.draft, ignore_errors=True)
            self.failed.append(Failure(path=drive.path, error=outcome.error))
            return
        entry = Entry(drive.path, dict(drive.reading), task.options["timestamp"])
        self._waiting[drive.name] = drive, Fresh(drive.name, entry, task.draft, outcome.report)

    def _is_time(self) -> bool:
        rows = sum(fresh.rows for _, fresh in self._waiting.values())
        return rows >= PART_ROWS or time.monotonic() - self._put_at > _PATIENCE_SECONDS

    def _put(self) -> set[str]:
        waiting = list(self._waiting.values())
        lost = self._parts.put(fresh for _, fresh in waiting)
        for drive, fresh in waiting:
            self.read.append(drive)
            shutil.rmtree(fresh.folder, ignore_errors=True)
        self._waiting.clear()
        self._put_at = time.monotonic()
        return lost


class _Here:
    """Does tasks in this process, one after another."""

    def __init__(self) -> None:
        self._ended: list[tuple[Task, Outcome]] = []

    @property
    def free(self) -> int:
        return int(not self._ended)

    def submit(self, task: Task) -> None:
        self._ended.append((task, run_task(task)))

    def finished(self, seconds: float) -> list[tuple[Task, Outcome]]:  # noqa: ARG002 - as all executors
        ended, self._ended = self._ended, []
        return ended

    def stop(self) -> None:
        self._ended.clear()


def _finished(tasks: Iterable[Task], executor: Executor) -> Iterator[tuple[Task, Outcome]]:
    """Have tasks done, and give each when it has ended; those of workers that are gone are done again."""
    due, running, warming = deque(tasks), 0, Warming()
    while due or running:
        while due and executor.free and not (running and warming.goes_on()):
            executor.submit(due.popleft())
            running += 1
        for task, outcome in executor.finished(_LOOK_SECONDS):
            running -= 1
            warming.end()
            if outcome.kind == LOST and task.attempt < _TRIES:
                due.appendleft(_again(task))
            else:
                yield task, outcome


def _again(task: Task) -> Task:
    shutil.rmtree(task.draft, ignore_errors=True)
    return replace(task, attempt=task.attempt + 1)
