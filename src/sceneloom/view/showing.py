"""Views shown at once: in Rerun's own window, or in a browser on this machine."""

import os
import platform
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from sceneloom.errors import OptionError, OutputError
from sceneloom.scene.types import Progress
from sceneloom.view.layout import layout
from sceneloom.view.page import LOOPBACK, guarded_page
from sceneloom.view.report import ViewReport
from sceneloom.view.saving import log_drives, new_recording, opened_drives
from sceneloom.view.sdk import sdk, silent_environment, viewer_command
from sceneloom.view.settings import Source, ViewSettings

_SERVER_MEMORY = "2GiB"
"""What the browser's server holds for it; beyond that the earliest frames go."""
_PATIENCE = 30.0
_POLL = 0.05


@dataclass(frozen=True, slots=True)
class Viewer:
    """A viewer's program that runs.

    Attributes:
        process: the program.
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
        settings: what is shown, and how.
        web: in a browser instead of a window: until the program is interrupted.
        ready: reported when the viewer runs, before anything is logged.
        progress: reported after each frame.

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
        opened_drives(sources, wanted, progress=progress) as views,
        _viewer(web=web, map_tiles=wanted.map_tiles) as viewer,
    ):
        if ready is not None:
            ready(viewer)
        recording = new_recording(views)
        recording.connect_grpc(viewer.sink, default_blueprint=layout([view.facts for view in views]))
        try:
            drives = log_drives(views, recording, progress=progress)
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
    """Start Rerun's program, and end it in the end.

    Raises:
        OutputError: it does not start.
    """
    port, page = _free_ports()
    options = ["--bind", LOOPBACK, "--port", str(port), "--hide-welcome-screen"]
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
        sink = f"rerun+http://{LOOPBACK}:{port}/proxy"
        _await_port(process, port)
        if not web:
            yield Viewer(process, sink, None)
            return
        _await_port(process, page)
        guarded = stack.enter_context(guarded_page(page, port, map_tiles=map_tiles))
        query = f"url={quote(sink, safe=':/')}&hide_welcome_screen=1"
        yield Viewer(process, sink, f"http://{LOOPBACK}:{guarded}/?{query}")


def _end(process: "subprocess.Popen[bytes]") -> None:
    process.terminate()
    try:
        process.wait(timeout=5)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _free_ports() -> tuple[int, int]:
    """Two ports of this machine that nobody listens on."""
    with socket.create_server((LOOPBACK, 0)) as one, socket.create_server((LOOPBACK, 0)) as other:
        return one.getsockname()[1], other.getsockname()[1]


def _await_port(process: "subprocess.Popen[bytes]", port: int) -> None:
    """Wait until the program listens.

    Raises:
        OutputError: it ended, or does not listen in time.
    """
    deadline = time.monotonic() + _PATIENCE
    while process.poll() is None and time.monotonic() < deadline:
        try:
            socket.create_connection((LOOPBACK, port), timeout=1.0).close()
        except OSError:
            time.sleep(_POLL)
        else:
            return
    reported = "ended at once" if process.poll() is not None else f"did not listen within {_PATIENCE:.0f} s"
    raise OutputError(
        f"Rerun's viewer {reported}; look at `{' '.join(viewer_command('--version'))}`, or state `--save`"
    )
