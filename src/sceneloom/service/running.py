"""Runs a server until the process is reported to end, or beside other work in a thread."""

import asyncio
import gc
import logging
import signal
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from sceneloom.fusion.configuration_file import read_configuration_file
from sceneloom.fusion.interface import FusionInterface
from sceneloom.service.limits import ServiceLimits
from sceneloom.service.logs import log_to_standard_error
from sceneloom.service.server import FusionServer, ServerSettings
from sceneloom.service.warming import warm_up

LOG = logging.getLogger(__name__)

_ENDING = (signal.SIGTERM, signal.SIGINT)


def configured(
    path: Path | None, **limits: Any
) -> tuple[ServiceLimits, Callable[[FusionInterface], None] | None]:
    """Read what a server starts from: the limits of its table `[service]`, and what sets up new sessions.

    Args:
        path: of a configuration file, None for the defaults.
        limits: those that count before the file's.

    Raises:
        DataError: it is no such file, or a value in it is refused.
        OSError: it cannot be read.
    """
    if path is None:
        return ServiceLimits(**limits), None
    found = read_configuration_file(path, further=("service",))
    table = found.further.get("service", {})
    ServiceLimits.of(table, file=path, location="service")
    return ServiceLimits(**{**table, **limits}), found.apply


def serve_until_ended(
    settings: ServerSettings,
    *,
    started: Callable[[FusionServer], None],
    quiet: bool = False,
    verbose: bool = False,
) -> tuple[str, ...]:
    """Serve until SIGTERM or Ctrl-C; then fuse what waits, deliver it, and return. A second signal ends at once.

    Args:
        started: reported the server once it listens.
        quiet: log warnings only.
        verbose: log what helps to find faults, too.

    Returns:
        the sessions whose threads hang: Python waits for these for ever, so the process has to be left by `os._exit`.
    """
    log_to_standard_error(quiet=quiet, verbose=verbose)
    return asyncio.run(_serve(settings, started))


@contextmanager
def running_server(settings: ServerSettings | None = None) -> Iterator[FusionServer]:
    """Serve in a thread of this process until the block ends, without waiting for results to be fetched."""
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, name="fusion server", daemon=True)
    thread.start()

    async def begin() -> FusionServer:
        server = FusionServer(settings)
        await server.start()
        return server

    try:
        server = asyncio.run_coroutine_threadsafe(begin(), loop).result()
        try:
            yield server
        finally:
            asyncio.run_coroutine_threadsafe(server.drain(0.0), loop).result()
    finally:
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


async def _serve(settings: ServerSettings, started: Callable[[FusionServer], None]) -> tuple[str, ...]:
    ended = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in _ENDING:
        loop.add_signal_handler(number, ended.set)
    server = FusionServer(settings)
    server.check_ports()  # before the seconds that warming takes
    LOG.info("loading what requests need; the port is closed until then")
    if not await _warmed_up(ended):
        return ()
    gc.freeze()  # what is there now stays: looking through it again and again would stop all sessions
    await server.start()
    started(server)
    await ended.wait()
    for number in _ENDING:
        loop.remove_signal_handler(number)
    return await server.drain()


async def _warmed_up(ended: asyncio.Event) -> bool:
    """Load what requests need; False if the server is reported to end meanwhile, which it does at once."""
    loop = asyncio.get_running_loop()
    done: asyncio.Future[None] = loop.create_future()
    processes: list[subprocess.Popen[str]] = []

    def report(error: BaseException | None) -> None:
        if done.cancelled():
            return
        if error is None:
            done.set_result(None)
        else:
            done.set_exception(error)

    def work() -> None:
        error: BaseException | None = None
        try:
            warm_up(processes.append)
        except BaseException as caught:  # noqa: BLE001 - it is raised where it is waited for
            error = caught
        with suppress(RuntimeError):  # the loop is closed where nobody waits any more
            loop.call_soon_threadsafe(report, error)

    threading.Thread(target=work, name="warming up", daemon=True).start()
    ending = asyncio.ensure_future(ended.wait())
    await asyncio.wait((done, ending), return_when=asyncio.FIRST_COMPLETED)
    ending.cancel()
    if done.done():
        done.result()
        return True
    done.cancel()
    for process in processes:
        process.kill()
    return False
