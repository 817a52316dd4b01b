"""Runs a server until the process is asked to end, or in a thread; reads its configuration file.

Kernels are compiled and loaded before it listens.
"""

import asyncio
import gc
import logging
import signal
import subprocess
import threading
import tomllib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

from sceneloom.cameras.camera import MODELS
from sceneloom.db34t.interface import FusionInterface
from sceneloom.db34t.records import Boxes2d, Boxes3d, CalibrationData, ImageData, PointCloudData
from sceneloom.db34t.setting import CAMERA_MODELS, CalibrationEntry, entry_of, parse_sensors
from sceneloom.db34t.types import Outcome, Timestamp
from sceneloom.errors import CalibrationError, DataError
from sceneloom.formats.base.files import read_settings
from sceneloom.kernels.cache import compile_kernels, compiling_ahead, declared_kernels, reporting_compiling
from sceneloom.service.server import FusionServer, ServerSettings
from sceneloom.service.startup import ServiceLimits, log_to_standard_error

_LOG = logging.getLogger(__name__)
_FORWARD = (0.0, 0, 1, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 0, 1)
_WIDTH, _HEIGHT = 64, 48
_Process = subprocess.Popen[str]
_TABLE_3 = ("pinhole", "brown_conrady")  # what its records can state
_RARE = (
    "sceneloom.kernels.boxes:find_points_in_boxes",
    "sceneloom.colouring.cuboid_projection:count_observations",
    "sceneloom.colouring.cuboid_projection:count_evidence",
)
"""Kernels that come with those that requests call, and take long to compile."""


def warm_up(
    started: Callable[[_Process], object] = id,
    ready: Callable[[], object] = dict,
    configure: Callable[[FusionInterface], None] | None = None,
    ended: Callable[[], bool] = bool,
) -> int:
    """Compile and load all kernels that requests can reach; gives how many results a small pair of each type gave.

    Every kernel has its types written down. What is imported with the interface is what it can call, and camera
    models, which properties choose: those that new sessions do not have come last.

    Args:
        started: receives each process that compiles, which may be killed: this compiles the rest itself.
        ready: called once all is loaded but the kernels of those camera models.
        configure: sets up new sessions.
        ended: whether nobody needs them any more.
    """
    for model in MODELS.values():
        import_module(model.module)
    with FusionInterface(inline=True) as fusion:
        if configure is not None:
            configure(fusion)
        stated = [row.value for row in fusion.list_properties() if row.name == CAMERA_MODELS]
    usual = [name for name in MODELS if name in _TABLE_3 or f'"{name}"' in str(stated)]
    classes = tuple(name.title().replace("_", "") + "." for name in usual)
    names = declared_kernels()
    cameras = {name for name in names if name.startswith("sceneloom.cameras.")}
    later = {name for name in cameras if not name.partition(":")[2].startswith(classes)}.union(_RARE)
    first = [name for name in names if name not in later]
    with reporting_compiling(_log_compiling):
        with compiling_ahead([*first, *names], started=started) as wait:
            wait(first)
            if ended():
                return 0
            compile_kernels(first)
            results = _fuse_a_pair()
            ready()
        compile_kernels(() if ended() else names)
    return results


def _fuse_a_pair() -> int:
    """Send one record of each type, and give how many results they had."""
    with FusionInterface(inline=True) as fusion:
        size, intrinsics = (_WIDTH, _HEIGHT), (50.0, 0, 31.5, 0, 50.0, 23.5, 0, 0, 1)
        fusion.set_calibration(
            CalibrationData(image_size=size, intrinsic_matrix=intrinsics, reference_frame=0, extrinsic_matrix=_FORWARD)
        )
        common: dict[str, Any] = {"sensor_id": 0, "seq": 0, "timestamp": Timestamp(1, 0)}
        one: dict[str, Any] = {
            "id": np.zeros(1, np.int32),
            "class_names": ("car",),
            "confidence": np.full(1, 0.5, np.float32),
        }
        point, pixels = np.array([[10.0, 0, 0]], np.float32), np.zeros(_HEIGHT * _WIDTH * 3, np.uint8)
        fusion.send(ImageData(**common, height=_HEIGHT, width=_WIDTH, encoding="rgb8", channel=3, data=pixels))
        fusion.send(PointCloudData(**common, number=1, fields=("x", "y", "z"), fields_number=3, data=point))
        fusion.send(Boxes2d(**common, **one, corners_xyxy=np.array([[25, 18, 38, 30]], np.uint32)))
        shape: dict[str, Any] = {
            "sizes_lwh": np.full((1, 3), 2.0, np.float32),
            "directions": np.array([[1, 0, 0]], np.float32),
        }
        fusion.send(Boxes3d(**common, **one, **shape, centers=point, velocities=np.zeros(1, np.float32)))
        fusion.flush()
        return fusion.waiting_results


def _log_compiling(name: str, left: int) -> None:
    _LOG.info("compiling for this machine; it is kept", extra={"fields": {"kernel": name, "left": left}})


_ENDING = (signal.SIGTERM, signal.SIGINT)


def configured(path: Path | None, **limits: Any) -> tuple[ServiceLimits, Callable[[FusionInterface], None] | None]:
    """Read what a server starts from: the limits of its table `[service]`, and what sets up new sessions.

    Args:
        path: of a configuration file, None for the defaults.

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
    settings: ServerSettings, *, started: Callable[[FusionServer], None], quiet: bool = False, verbose: bool = False
) -> tuple[str, ...]:
    """Serve until SIGTERM or Ctrl-C; then fuse what waits, deliver it, and return. A second signal ends at once.

    Args:
        started: called with the server once it listens.

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
    _LOG.info("loading what requests need; the port is closed until then")
    processes: list[_Process] = []
    if not await _warmed_up(ended, settings.configure, processes):
        return ()
    gc.freeze()  # what is there now stays: looking through it again and again would stop all sessions
    await server.start()
    started(server)
    await ended.wait()
    for number in _ENDING:
        loop.remove_signal_handler(number)
    for process in processes:
        process.kill()
    return await server.drain()


async def _warmed_up(
    ended: asyncio.Event, configure: Callable[[FusionInterface], None] | None, processes: list[_Process]
) -> bool:
    """Load what requests need; False if the server has to end meanwhile, which it does at once.

    What a session has to ask for is loaded further in a thread, by processes that are added to the list.
    """
    loop = asyncio.get_running_loop()
    done: asyncio.Future[None] = loop.create_future()

    def report(error: BaseException | None = None) -> None:
        if done.done():
            return
        if error is None:
            done.set_result(None)
        else:
            done.set_exception(error)

    def work() -> None:
        with suppress(RuntimeError):  # where the loop is closed
            try:
                warm_up(processes.append, partial(loop.call_soon_threadsafe, report), configure, ended.is_set)
            except BaseException as caught:  # noqa: BLE001 - it is raised where it is waited for
                loop.call_soon_threadsafe(report, caught)

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


@dataclass(frozen=True, slots=True, kw_only=True)
class ConfigurationFile:
    """What a file says; read and tried by `read_configuration_file`.

    Attributes:
        path: of the file.
        properties: values of predefined properties, in the file's order.
        added: properties of clause 5.3: name, description, type and perhaps value.
        sensors: the text of the property `sensors`, "" for none.
        calibrations: the records of table 3.
        further: tables that are not of the fusion system.
    """

    path: Path
    properties: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    added: tuple[Mapping[str, Any], ...] = ()
    sensors: str = ""
    calibrations: tuple[CalibrationEntry, ...] = ()
    further: Mapping[str, Mapping[str, Any]] = field(default_factory=lambda: MappingProxyType({}))

    def apply(self, fusion: FusionInterface) -> None:
        """Set what the file says.

        Raises:
            DataError: something is refused.
        """
        for k, row in enumerate(self.added):
            location = f"added[{k}]"
            self._check(location, fusion.add_property(row["name"], row.get("description", ""), row["type"]))
            if "value" in row:
                self._check(f"{location}.value", fusion.set_property(row["name"], row["value"]))
        for name, value in self.properties.items():
            self._check(f"properties.{name}", fusion.set_property(name, value))
        if self.sensors:
            self._check("sensors", fusion.set_property("sensors", self.sensors))
        for k, entry in enumerate(self.calibrations):
            outcome = fusion.set_calibration(entry.data, camera_id=entry.camera_id, lidar_id=entry.lidar_id)
            self._check(f"calibrations[{k}]", outcome)

    def _check(self, location: str, outcome: Outcome) -> None:
        if not outcome:
            raise DataError(self.path, location, outcome.reason)


def read_configuration_file(path: Path | str, *, further: tuple[str, ...] = ()) -> ConfigurationFile:
    """Read a file and try whether a fusion system takes what it says.

    Raises:
        DataError: it is no TOML, has something unknown in it, or a value is refused.
        OSError: it cannot be read.

    Source: DB34/T 4101-2022, clause 5.2, tables 2 and 3.
    """
    path = Path(path)
    try:
        content = tomllib.loads(read_settings(path).decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise DataError(path, "", f"no TOML: {error}") from error
    for name, table in content.items():
        if name not in (*_TABLES, *further):
            raise DataError(path, name, f"unknown; expected one of {', '.join((*_TABLES, *further))}")
        if not isinstance(table, list if name in ("added", "calibrations") else dict):
            wanted = f"[[{name}]]" if name in ("added", "calibrations") else f"[{name}]"
            raise DataError(path, name, f"{table!r}; expected a table {wanted}")
    properties = content.get("properties", {})
    for name, own in (("sensors", "[sensors.ID]"), ("calibration", "[[calibrations]]")):
        if name in properties:
            raise DataError(path, f"properties.{name}", f"a property with tables of its own; expected {own}")
    found = ConfigurationFile(
        path=path,
        properties=MappingProxyType(properties),
        added=tuple(_added(path, k, row) for k, row in enumerate(content.get("added", ()))),
        sensors=_sensors(path, content.get("sensors", {})),
        calibrations=_calibrations(path, content.get("calibrations", ())),
        further=MappingProxyType({name: content[name] for name in further if name in content}),
    )
    with FusionInterface(inline=True) as tried:
        found.apply(tried)
    return found


_TABLES = ("properties", "added", "sensors", "calibrations")


_ADDED = ("name", "description", "type", "value")


def _added(path: Path, k: int, row: Any) -> Mapping[str, Any]:
    location = f"added[{k}]"
    if not isinstance(row, dict):
        raise DataError(path, location, f"{row!r}; expected a table")
    for name in row:
        if name not in _ADDED:
            raise DataError(path, f"{location}.{name}", f"unknown; expected one of {', '.join(_ADDED)}")
    for name in ("name", "type"):
        if name not in row:
            raise DataError(path, f"{location}.{name}", "missing; expected as clause 5.3 has it")
    for name in ("name", "description", "type"):
        if not isinstance(row.get(name, ""), str):
            raise DataError(path, f"{location}.{name}", f"{row[name]!r}; expected a string")
    return MappingProxyType(row)


def _sensors(path: Path, table: dict[str, Any]) -> str:
    text = msgspec.json.encode(table, enc_hook=str).decode() if table else ""
    try:
        parse_sensors(text)
    except DataError as error:
        raise DataError(path, ".".join(filter(None, ("sensors", error.location))), error.problem) from error
    return text


def _calibrations(path: Path, rows: Any) -> tuple[CalibrationEntry, ...]:
    entries: list[CalibrationEntry] = []
    for k, row in enumerate(rows):
        try:
            entry = entry_of(row, f"[{k}]")
        except DataError as error:
            raise DataError(path, f"calibrations{error.location}", error.problem) from error
        except CalibrationError as error:
            raise DataError(path, f"calibrations[{k}]", str(error)) from error
        if any((entry.camera_id, entry.lidar_id) == (known.camera_id, known.lidar_id) for known in entries):
            pair = f"camera {entry.camera_id} and lidar {entry.lidar_id}"
            raise DataError(path, f"calibrations[{k}]", f"{pair} again; expected each pair once")
        entries.append(entry)
    return tuple(entries)
