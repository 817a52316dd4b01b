"""Workers of dask, on this machine or wherever a running scheduler has them."""

import logging
import os
import pickle
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, Self

import msgspec

from sceneloom.batch.jobs import Outcome, Task
from sceneloom.batch.running import LOST, NUMBA, OUTCOME, THREADS, run_task
from sceneloom.errors import MissingExtraError, OptionError, how_to_install
from sceneloom.formats.base.files import is_url
from sceneloom.version import __version__

try:
    import dask
    from distributed import Client, Future, KilledWorker, LocalCluster
except ImportError as missing:
    raise MissingExtraError(f"{missing}; install the extra: {how_to_install('cluster')}") from missing

LOCAL = "local"

_DATA = ["dask", "msgpack"]  # ways in which dask sends data that need no pickling

_ALLOCATION = {
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": None,
    "distributed.nanny.pre-spawn-environ.MALLOC_ARENA_MAX": 1,
}
"""Keep dask from giving memory back whenever 64 KB are free, and the thread that works from a heap of its own, which
does the same: arrays come and go with each frame, and seven times as many page faults cost a third more time."""

_WATCHING = {
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "5s",
    "distributed.admin.system-monitor.gil.enabled": False,
}  # keep dask from looking a hundred times a second at what its workers do: it takes as long as scheduling

_METHOD = "distributed.worker.multiprocessing-method"

_LASTING = {"distributed.deploy.lost-worker-timeout": "365 days"}
"""Keep dask from giving a worker up for good that was lost and, so long after (15 s by default), is not there again:
one that is being started anew then, since it was lost once more, never would be."""

_CONNECTING_SECONDS = 60.0
_COUNTING_SECONDS = 2.0
_CLOSING_SECONDS = 5.0
_ONE_AT_A_TIME = threading.Lock()


class DaskCluster:
    """Runs tasks on workers of dask, one at a time on each, which has the next one at hand."""

    def __init__(self, client: "Client", cluster: LocalCluster | None = None, ending: ExitStack | None = None) -> None:
        """Use a client, and the workers of this machine if there are any; see `local` and `at`."""
        self._client, self._cluster, self._ending = client, cluster, ending or ExitStack()
        self._ended: SimpleQueue[Future[bytes]] = SimpleQueue()  # futures, as dask's threads report
        self._tasks: dict[Any, tuple[Task, Future[bytes]]] = {}
        self._room, self._counted = 0, -_COUNTING_SECONDS

    @classmethod
    def local(cls, workers: int) -> Self:
        """Start a scheduler and so many workers on this machine, each with one thread."""
        environment = {name: os.environ.get(name, "1") for name in THREADS}
        with ExitStack() as stack:
            # until the end: dask starts a worker anew where one was lost
            settings = {**_ALLOCATION, **_WATCHING, **_LASTING, _METHOD: "spawn"}
            stack.enter_context(dask.config.set(settings))
            cluster = LocalCluster(
                n_workers=workers, threads_per_worker=1, memory_limit=0, dashboard_address="127.0.0.1:0",
                silence_logs=logging.CRITICAL, env=environment,
            )  # fmt: skip
            stack.callback(_close, cluster)
            return cls(_client(cluster.scheduler_address), cluster, stack.pop_all())

    @classmethod
    def at(cls, address: str, *, seconds: float = _CONNECTING_SECONDS) -> Self:
        """Use the workers of a scheduler that is running, once it has one.

        Args:
            address: such as `tcp://host:8786`.
            seconds: how long is waited for it and for its first worker.

        Raises:
            OptionError: there is none, or it has no workers.
        """
        try:
            client = _client(address, seconds)
        except (OSError, ValueError) as error:
            raise OptionError(f"--cluster {address}: {error}; expected `local` or a running scheduler") from error
        try:
            client.wait_for_workers(1, timeout=seconds)
        except TimeoutError as error:
            client.close()
            raise OptionError(f"--cluster {address}: the scheduler has no workers; start some") from error
        return cls(client)

    @property
    def dashboard(self) -> str:
        """Address of dask's page about its workers; "" where there is none."""
        return str(self._client.dashboard_link or "")

    @property
    def free(self) -> int:
        """How many more tasks it takes now: workers come and go."""
        if self._client.status in {"closing", "closed"}:
            raise OptionError("dask's scheduler is gone; `--resume` goes on where the run was")
        if time.monotonic() - self._counted >= _COUNTING_SECONDS:
            threads = self._client.nthreads().values()
            # a worker of one thread has the next task at hand; one of more would begin that beside the first
            self._room, self._counted = sum(2 if count == 1 else 1 for count in threads), time.monotonic()
        return max(self._room - len(self._tasks), 0)

    def submit(self, task: Task) -> None:
        """Begin a task."""
        if not task.target:
            task.draft.parent.parent.mkdir(parents=True, exist_ok=True)
        sent = task if self._cluster is not None else _anywhere(task)
        future = self._client.submit(
            run_packed, __version__, pickle.dumps(sent), key=f"sceneloom-{task.draft.parent.name}", retries=0
        )
        self._tasks[future.key] = (task, future)
        future.add_done_callback(self._ended.put)

    def finished(self, seconds: float) -> Sequence[tuple[Task, Outcome]]:
        """Wait, at most so long, for tasks that have ended, well or with their worker."""
        ended, found = [], []
        with suppress(Empty):
            ended.append(self._ended.get(timeout=seconds))
            while True:
                ended.append(self._ended.get_nowait())
        for future in ended:
            task, _ = self._tasks.pop(future.key)
            found.append((task, _outcome(task, future)))
        return found

    def stop(self) -> None:
        """End all workers of ours at once; take back what those of others have not begun."""
        if self._client.status == "closed":
            return
        with suppress(OSError, TimeoutError):
            if self._tasks:
                self._client.cancel([future for _, future in self._tasks.values()], force=True)
            self._tasks.clear()
            self._client.close(timeout=_CLOSING_SECONDS)
        self._ending.close()


def _close(cluster: LocalCluster) -> None:
    with suppress(OSError, TimeoutError):
        cluster.close(timeout=_CLOSING_SECONDS)


def open_cluster(location: str, workers: int) -> DaskCluster:
    """Use workers of dask: so many of our own if `location` is `local`, else those of the scheduler there."""
    return DaskCluster.local(workers) if location == LOCAL else DaskCluster.at(location)


def run_packed(version: str, packed: bytes) -> bytes:
    """Do a task in a worker of dask.

    Args:
        version: ours, where the run is.
        packed: the pickled task.

    Returns:
        the outcome as JSON.
    """
    number = -1
    if version != __version__:
        reported = f"this worker has sceneloom {__version__}, the run {version}; expected the same"
        return msgspec.json.encode(Outcome(number=number, error=reported, kind="OptionError"))
    for name in THREADS:
        if name != NUMBA or "numba" not in sys.modules:  # it takes no other number once it is at work
            os.environ.setdefault(name, "1")
    task: Task = pickle.loads(packed)  # noqa: S301 - of the run that uses this worker
    with _ONE_AT_A_TIME:  # what a verb prints belongs to the process
        return msgspec.json.encode(_run_once(task))


def _run_once(task: Task) -> Outcome:
    """Do a task unless a worker that is gone has begun it."""
    # what is sent to a store appears whole however many have begun it, and workers need share no folder for it
    if task.target:
        return run_task(task)
    folder = task.draft.parent
    try:
        folder.mkdir()
    except FileExistsError:
        return _left(task)
    except FileNotFoundError:
        reported = f"{folder.parent}: is not there for the worker; expected a file system that all workers share"
        return Outcome(number=task.number, error=reported, kind="FileNotFoundError")
    outcome = run_task(task)
    with suppress(OSError):  # else the try is lost if the worker goes now, as it would be a moment earlier
        (folder / OUTCOME).write_bytes(msgspec.json.encode(outcome))
    return outcome


def _left(task: Task) -> Outcome:
    """What a worker came to that is gone since; half of what it left word of cannot be read."""
    try:
        return msgspec.json.decode((task.draft.parent / OUTCOME).read_bytes(), type=Outcome)
    except (OSError, msgspec.MsgspecError):
        return _lost(task, "ended from outside, out of memory, or crashed")


def _client(address: str, seconds: float = _CONNECTING_SECONDS) -> Client:
    return Client(
        address, timeout=seconds, set_as_default=False, serializers=_DATA, deserializers=_DATA,
        name="sceneloom-batch",
    )  # fmt: skip


def _anywhere(task: Task) -> Task:
    """Name files so that they are found from other folders and machines, too."""
    location = task.location if is_url(task.location) else str(_whole(Path(task.location)))
    draft = task.draft if task.target else task.draft.absolute()
    options, files = (
        {name: _whole(value) for name, value in reported.items()} for reported in (task.options, task.files)
    )
    return replace(task, location=location, draft=draft, options=options, files=files)


def _whole(value: Any) -> Any:
    """A path, or several, as they are called from the root; whatever else it is, as it is."""
    if isinstance(value, tuple):
        return tuple(map(_whole, value))
    return Path(os.path.abspath(value)) if isinstance(value, Path) else value  # noqa: PTH100 - links stay


def _outcome(task: Task, future: Future[bytes]) -> Outcome:
    if future.status != "finished":
        error = future.exception() if future.status == "error" else None
        if error is None or isinstance(error, KilledWorker):
            return _lost(task, str(error or future.status))
        return Outcome(number=task.number, error=str(error), kind=type(error).__name__)
    try:
        found: Any = future.result()
        outcome = msgspec.json.decode(found, type=Outcome)
    except (OSError, TimeoutError, KilledWorker) as error:  # its worker went with the result
        return _lost(task, str(error))
    except (msgspec.MsgspecError, TypeError) as error:
        return Outcome(number=task.number, error=f"a worker gave no outcome: {error}", kind="DataError")
    return msgspec.structs.replace(outcome, number=task.number)


def _lost(task: Task, how: str) -> Outcome:
    return Outcome(number=task.number, error=f"the worker is gone ({how})", kind=LOST, passing=True)
