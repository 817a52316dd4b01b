"""Views saved to a file, shown in Rerun's window, or served to a browser on this machine."""

import http.client
import importlib.util
import os
import platform
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import quote

from sceneloom.errors import MissingExtraError, OptionError, OutputError, how_to_install
from sceneloom.formats.base.output import check_output, replacing
from sceneloom.formats.base.registry import SharedOptions, open_scene
from sceneloom.scene.scene import Scene, time_span
from sceneloom.scene.types import Progress
from sceneloom.view.drive import DriveView
from sceneloom.view.settings import DrivePart, DriveShown, Source, ViewReport, ViewSettings
from sceneloom.view.stream import sdk

_APPLICATION = "sceneloom"
_SUFFIX = ".rrd"

_SINCE_EPOCH_NS = 100_000_000_000_000_000
"""Timestamps from here on (March 1973) count from 1970; smaller ones from the beginning of the drive."""

_MOST_DRIVES = 32
"""More tabs would be hard to find."""


@contextmanager
def _opened_drives(
    sources: Sequence[Source], settings: ViewSettings, *, progress: Progress | None = None
) -> Iterator[tuple[DriveView, ...]]:
    """Open drives, each under a root of its own name."""
    if not sources:
        raise OptionError("no drive to show; expected one or more paths")
    if len(sources) > _MOST_DRIVES:
        raise OptionError(
            f"{len(sources)} drives, or parts of drives; expected no more than {_MOST_DRIVES} at once: choose some, as "
            f"`sceneloom catalog query … --limit {_MOST_DRIVES}` does"
        )
    settings.check_drives(len(sources))
    parts = [source if isinstance(source, DrivePart) else DrivePart(source) for source in sources]
    shared = SharedOptions(settings.reading)
    with ExitStack() as stack:
        scenes = [
            part.source
            if isinstance(part.source, Scene)
            else stack.enter_context(shared.read(partial(_open, part.source, part.reading)))
            for part in parts
        ]
        shared.check()
        yield tuple(
            DriveView.of(scene, name, part.settings(settings), progress=progress)
            for scene, name, part in zip(scenes, _roots(parts), parts, strict=True)
        )


def _open(location: str | Path, own: Mapping[str, Any], **reading: Any) -> Scene:
    return open_scene(location, **{**reading, **own})


def _roots(parts: Sequence[DrivePart]) -> list[str]:
    """The names of drives, each once."""
    roots: list[str] = []
    for part in parts:
        taken = sum(root == part.name or root.startswith(f"{part.name} (") for root in roots)
        roots.append(f"{part.name} ({taken + 1})" if taken else part.name)
    return roots


def _new_recording(views: Sequence[DriveView]) -> Any:
    """A stream of Rerun's whose only times are those of the drives."""
    rr = sdk()
    name = ", ".join(view.name for view in views)
    recording = rr.RecordingStream(_APPLICATION, send_properties=False)
    rr.set_log_tick_enabled(False, recording=recording)
    rr.set_log_time_enabled(False, recording=recording)
    recording.send_recording_name(name)
    return recording


def _log_drives(
    views: Sequence[DriveView], recording: Any, *, progress: Progress | None = None
) -> tuple[DriveShown, ...]:
    """Log drives one after another to an open stream."""
    spans = [time_span(view.scene) for view in views]
    calendar = all(span is not None and span[0] >= _SINCE_EPOCH_NS for span in spans)
    return tuple(view.log(recording, calendar=calendar, progress=progress) for view in views)


def save_view(
    sources: Sequence[Source],
    output: str | Path,
    *,
    settings: ViewSettings | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> ViewReport:
    """Save drives with a layout of the viewer to a file that `rerun FILE` opens.

    Args:
        sources: paths of recordings, scenes, …, scenes that are open, or parts of either; each is under a root of its
            own.
        output: the file, which ends in `.rrd`.

    Raises:
        MissingExtraError: rerun-sdk is not installed.
        OptionError: an option cannot be followed.
        OutputError: the file exists or cannot be written.
        UnknownFormatError: no format fits a path.
        DataError: a frame cannot be read.
    """
    sdk()
    started, target = time.perf_counter(), Path(output)
    if target.suffix.lower() != _SUFFIX:
        raise OptionError(f"{target}: expected a name that ends in {_SUFFIX}")
    check_output(target, overwrite=overwrite)
    with (
        _opened_drives(sources, settings or ViewSettings(), progress=progress) as views,
        replacing(target, overwrite=overwrite) as draft,
    ):
        recording = _new_recording(views)
        recording.save(draft, default_blueprint=DriveView.layout(views))
        try:
            drives = _log_drives(views, recording, progress=progress)
            recording.flush()
        finally:
            recording.disconnect()
    return ViewReport(
        output=str(target), size_bytes=target.stat().st_size, drives=drives, seconds=time.perf_counter() - started
    )


_LOOPBACK = "127.0.0.1"
"""Nobody but this machine is answered."""

_TILES = "https://tile.openstreetmap.org https://*.tile.openstreetmap.org"
_PASSED_ON = ("Content-Type", "rerun-final-length")
_PIECE = 1 << 20
_ANSWER_SECONDS = 60.0


def policy(sink_port: int, *, map_tiles: bool) -> str:
    """What the page may fetch: itself, the data of this machine, and map tiles where they are wanted.

    Source: W3C "Content Security Policy Level 3".
    """
    connect = f"'self' http://{_LOOPBACK}:{sink_port} data: blob:" + (f" {_TILES}" if map_tiles else "")
    return "; ".join(
        (
            "default-src 'self'",
            "script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob:",
            "style-src 'self' 'unsafe-inline'",
            "img-src 'self' data: blob:",
            "worker-src 'self' blob:",
            f"connect-src {connect}",
            "frame-ancestors 'none'",
            "form-action 'none'",
        )
    )


def _handler(page_port: int, stated: str) -> type[BaseHTTPRequestHandler]:
    class Forwarding(BaseHTTPRequestHandler):
        """Passes requests on to Rerun's own server, and its answers back with the policy."""

        def do_GET(self) -> None:
            upstream = http.client.HTTPConnection(_LOOPBACK, page_port, timeout=_ANSWER_SECONDS)
            try:
                upstream.request("GET", self.path)
                answer = upstream.getresponse()
                self._pass_on(answer)
            except (OSError, http.client.HTTPException):
                self.close_connection = True
            finally:
                upstream.close()

        def _pass_on(self, answer: http.client.HTTPResponse) -> None:
            content = answer.read()
            self.send_response(answer.status)
            for name in _PASSED_ON:
                if (value := answer.getheader(name)) is not None:
                    self.send_header(name, value)
            self.send_header("Content-Length", str(len(content)))
            self.send_header("Content-Security-Policy", stated)
            self.send_header("Referrer-Policy", "no-referrer")
            self.end_headers()
            for start in range(0, len(content), _PIECE):
                self.wfile.write(content[start : start + _PIECE])

        def log_message(self, format: str, *arguments: object) -> None:
            """Report nothing: the library does not print."""

    return Forwarding


@contextmanager
def guarded_page(page_port: int, sink_port: int, *, map_tiles: bool = False) -> Iterator[int]:
    """Serve Rerun's page on this machine with the policy; gives the port.

    Args:
        page_port: where Rerun serves it.
        sink_port: where the page gets its data.
        map_tiles: let it fetch tiles of OpenStreetMap.
    """
    server = ThreadingHTTPServer((_LOOPBACK, 0), _handler(page_port, policy(sink_port, map_tiles=map_tiles)))
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield int(server.server_address[1])
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


_FOLDERS = ("XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_CACHE_HOME", "XDG_STATE_HOME")
"""Where programs of a desktop keep what they remember.

Source: XDG Base Directory Specification 0.8.
"""

_PROXIES = ("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY")

_NOBODY = "http://127.0.0.1:1"
"""A proxy that is not there: what would go through it goes nowhere."""

_NEAR = "127.0.0.1,localhost"


def viewer_command(*options: str) -> list[str]:
    """The words that run Rerun's own program, which is installed with its SDK.

    The program itself and not the Python module that starts it: a program that is ended would leave its child behind.

    Raises:
        MissingExtraError: it is not installed.
    """
    sdk()
    found = importlib.util.find_spec("rerun_cli")
    if found is None or found.origin is None:
        raise MissingExtraError(f"Rerun's viewer is missing: {how_to_install('view')}")
    name = "rerun.exe" if platform.system() == "Windows" else "rerun"
    return [str(Path(found.origin).with_name(name)), *options]


def silent_environment(folder: Path, given: Mapping[str, str] | None = None, *, offline: bool = True) -> dict[str, str]:
    """Give an environment in which Rerun's program sends no usage data and writes to `folder` only.

    The program sends none after its own command `analytics disable`, which it keeps in its folder of settings: that is
    a folder of ours here, so that nothing is written to the home folder, and what a person has set there stays as is.
    It would still ask for its newest version and for examples; that goes to a proxy that is not there.

    Args:
        folder: an empty folder that lives as long as the program.
        given: the environment to begin with; None for this process's.
        offline: let the program reach this machine only.
    """
    environment = {**(os.environ if given is None else given), **dict.fromkeys(_FOLDERS, str(folder))}
    if offline:
        # both spellings are in use, and the small one counts more
        for name in _PROXIES:
            environment |= {name: _NOBODY, name.lower(): _NOBODY}
        environment |= {"NO_PROXY": _NEAR, "no_proxy": _NEAR}
    if platform.system() == "Darwin":
        environment["HOME"] = str(folder)
    subprocess.run(  # noqa: S603 - our own words
        viewer_command("analytics", "disable"),
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        check=True,
    )
    return environment


_SERVER_MEMORY = "2GiB"
"""What the browser's server holds for it; beyond that the earliest frames go."""

_PATIENCE = 30.0
_POLL = 0.05


@dataclass(frozen=True, slots=True)
class Viewer:
    """A viewer's program that runs.

    Attributes:
        sink: where it takes what is logged.
        address: where a browser finds it, or None of one with a window of its own.
    """

    process: "subprocess.Popen[bytes]"
    sink: str
    address: str | None


def has_screen(environment: Mapping[str, str] | None = None) -> bool:
    """Whether a window can be opened, as far as the environment reports."""
    if platform.system() in {"Darwin", "Windows"}:
        return True
    known = os.environ if environment is None else environment
    return bool(known.get("DISPLAY") or known.get("WAYLAND_DISPLAY"))


def show_view(
    sources: Sequence[Source],
    *,
    settings: ViewSettings | None = None,
    web: bool = False,
    ready: Callable[[Viewer], None] | None = None,
    progress: Progress | None = None,
) -> ViewReport:
    """Show drives in the viewer, and wait until it is closed.

    The viewer listens on this machine only, sends no usage data and writes nothing to the home folder.

    Args:
        sources: paths of recordings, scenes, …, scenes that are open, or parts of either; each is under a root of its
            own.
        web: in a browser instead of a window: until the program is interrupted.
        ready: reported when the viewer runs, before anything is logged.

    Raises:
        MissingExtraError: rerun-sdk is not installed.
        OptionError: an option cannot be followed, or there is no screen for a window.
        OutputError: the viewer does not start.
        UnknownFormatError: no format fits a path.
        DataError: a frame cannot be read.
    """
    sdk()
    if not web and not has_screen():
        raise OptionError(
            "there is no screen to open a window on; state `--save FILE.rrd` to keep the view in a file, or `--web` to "
            "look at it in a browser"
        )
    started = time.perf_counter()
    wanted = settings or ViewSettings()
    with (
        _opened_drives(sources, wanted, progress=progress) as views,
        _viewer(web=web, map_tiles=wanted.map_tiles) as viewer,
    ):
        if ready is not None:
            ready(viewer)
        recording = _new_recording(views)
        recording.connect_grpc(viewer.sink, default_blueprint=DriveView.layout(views))
        try:
            drives = _log_drives(views, recording, progress=progress)
            recording.flush()
        finally:
            recording.disconnect()
        report = ViewReport(output=None, size_bytes=0, drives=drives, seconds=time.perf_counter() - started)
        _wait(viewer)
    return report


def _wait(viewer: Viewer) -> None:
    """Wait until the window is closed, or the program interrupted: all has been shown by then."""
    try:
        viewer.process.wait()
    except KeyboardInterrupt:
        return


@contextmanager
def _viewer(*, web: bool, map_tiles: bool) -> Iterator[Viewer]:
    """Start Rerun's program, and end it in the end."""
    port, page = _free_ports()
    options = ["--bind", _LOOPBACK, "--port", str(port), "--hide-welcome-screen"]
    if web:
        options += ["--serve-web", "--web-viewer-port", str(page), "--server-memory-limit", _SERVER_MEMORY]
    else:
        options += ["--expect-data-soon"]
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="sceneloom-view-"))
        process = subprocess.Popen(  # noqa: S603 - our own words
            viewer_command(*options),
            env=silent_environment(Path(folder), offline=not map_tiles),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        stack.callback(_end, process)
        sink = f"rerun+http://{_LOOPBACK}:{port}/proxy"
        _await_port(process, port)
        if not web:
            yield Viewer(process, sink, None)
            return
        _await_port(process, page)
        guarded = stack.enter_context(guarded_page(page, port, map_tiles=map_tiles))
        query = f"url={quote(sink, safe=':/')}&hide_welcome_screen=1"
        yield Viewer(process, sink, f"http://{_LOOPBACK}:{guarded}/?{query}")


def _end(process: "subprocess.Popen[bytes]") -> None:
    process.terminate()
    try:
        process.wait(timeout=5)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _free_ports() -> tuple[int, int]:
    """Two ports of this machine that nobody listens on."""
    with socket.create_server((_LOOPBACK, 0)) as one, socket.create_server((_LOOPBACK, 0)) as other:
        return one.getsockname()[1], other.getsockname()[1]


def _await_port(process: "subprocess.Popen[bytes]", port: int) -> None:
    """Wait until the program listens."""
    deadline = time.monotonic() + _PATIENCE
    while process.poll() is None and time.monotonic() < deadline:
        try:
            socket.create_connection((_LOOPBACK, port), timeout=1.0).close()
        except OSError:
            time.sleep(_POLL)
        else:
            return
    reported = "ended at once" if process.poll() is not None else f"did not listen within {_PATIENCE:.0f} s"
    raise OutputError(
        f"Rerun's viewer {reported}; look at `{' '.join(viewer_command('--version'))}`, or state `--save`"
    )
