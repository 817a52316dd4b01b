"""Runs a server until the process is asked to end, or in a thread.

Kernels are compiled and loaded before it listens.
"""

import asyncio
import gc
import logging
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from sceneloom.cameras.camera import MODELS
from sceneloom.db34t.boxes import Boxes2d, Boxes3d
from sceneloom.db34t.interface import FusionInterface, read_configuration_file
from sceneloom.db34t.records import CalibrationData, ImageData, PointCloudData, SentRecord
from sceneloom.db34t.types import Timestamp
from sceneloom.kernels.cache import compile_kernels, declaring_modules, find_kernel_cache, lacks_kernels
from sceneloom.service.server import FusionServer, ServerSettings
from sceneloom.service.startup import ServiceLimits, log_to_standard_error

_LOG = logging.getLogger(__name__)

_FORWARD = (0.0, 0, 1, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 0, 1)

_WIDTH, _HEIGHT = 64, 48

_Process = subprocess.Popen[str]


def warm_up(started: Callable[[_Process], object] = id) -> int:
    """Compile and load all kernels that requests can reach; gives how many results a small pair of each type gave.

    Every kernel has its types written down. What is imported with the interface is what it can call, and camera
    models, which properties choose.

    Args:
        started: receives each process that compiles, which may be killed: this compiles the rest itself.
    """
    for model in MODELS.values():
        import_module(model.module)
    modules = declaring_modules()
    _compile_apart([name for name in modules if lacks_kernels(name)], started)
    compile_kernels(modules)
    with FusionInterface(inline=True) as fusion:
        fusion.set_calibration(
            CalibrationData(
                image_size=(_WIDTH, _HEIGHT),
                intrinsic_matrix=(50.0, 0, 31.5, 0, 50.0, 23.5, 0, 0, 1),
                reference_frame=0,
                extrinsic_matrix=_FORWARD,
            )
        )
        for record in _records():
            fusion.send(record)
        fusion.flush()
        return fusion.waiting_results


def _compile_apart(modules: list[str], started: Callable[[_Process], object]) -> None:
    """Compile modules in processes side by side, as the compiler takes one thread; they are kept, and loaded here.

    What fails there fails again, and is reported, when it is compiled here.
    """
    processes = min(os.cpu_count() or 1, len(modules))
    if processes < 2 or not find_kernel_cache().writable:
        return
    with ThreadPoolExecutor(processes) as pool:
        list(pool.map(_compile, [modules[k::processes] for k in range(processes)], [started] * processes))


def _compile(modules: list[str], started: Callable[[_Process], object]) -> None:
    """Compile modules in a process of their own."""
    code = (
        "import importlib, sys; from sceneloom.kernels.cache import compile_kernels\n"
        "for name in sys.argv[1:]:\n"
        "    importlib.import_module(name); print(name, flush=True); compile_kernels([name])"
    )
    command = [sys.executable, "-c", code, *modules]
    with subprocess.Popen(  # noqa: S603 - our own program
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as process:
        started(process)
        for line in process.stdout or ():
            _LOG.info("compiling for this machine; it is kept", extra={"fields": {"module": line.strip()}})


def _records() -> list[SentRecord]:
    common: dict[str, Any] = {"sensor_id": 0, "seq": 0, "timestamp": Timestamp(1, 0)}
    of_one: dict[str, Any] = {
        "id": np.zeros(1, np.int32),
        "class_names": ("car",),
        "confidence": np.full(1, 0.5, np.float32),
    }
    point = np.array([[10.0, 0, 0]], np.float32)
    return [
        ImageData(
            **common,
            height=_HEIGHT,
            width=_WIDTH,
            encoding="rgb8",
            channel=3,
            data=np.zeros(_HEIGHT * _WIDTH * 3, np.uint8),
        ),
        PointCloudData(**common, number=1, fields=("x", "y", "z"), fields_number=3, data=point),
        Boxes2d(**common, **of_one, corners_xyxy=np.array([[25, 18, 38, 30]], np.uint32)),
        Boxes3d(
            **common,
            **of_one,
            centers=point,
            sizes_lwh=np.full((1, 3), 2.0, np.float32),
            directions=np.array([[1, 0, 0]], np.float32),
            velocities=np.zeros(1, np.float32),
        ),
    ]


_RUNNING_LOG = logging.getLogger(__name__)

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
    _RUNNING_LOG.info("loading what requests need; the port is closed until then")
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
