"""Views saved to files: `sceneloom view --save`."""

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from sceneloom.errors import OptionError
from sceneloom.formats.output import check_output, replacing
from sceneloom.formats.shared_options import SharedOptions
from sceneloom.formats.table import open_scene
from sceneloom.scene.scene import Scene
from sceneloom.scene.span import time_span
from sceneloom.scene.types import Progress
from sceneloom.view.drive import DriveView, check_single, log_drive, prepare_drive
from sceneloom.view.layout import layout
from sceneloom.view.report import DriveShown, ViewReport
from sceneloom.view.sdk import sdk
from sceneloom.view.settings import DrivePart, Source, ViewSettings
from sceneloom.view.stream import Stream, is_calendar

_APPLICATION = "sceneloom"
SUFFIX = ".rrd"
MOST_DRIVES = 32
"""So many have a tab each that can still be found."""


@contextmanager
def opened_drives(
    sources: Sequence[Source], settings: ViewSettings, *, progress: Progress | None = None
) -> Iterator[tuple[DriveView, ...]]:
    """Open drives, each under a root of its own name.

    Raises:
        OptionError: an option does not fit, or there is no drive.
        UnknownFormatError: no format fits a path.
        DataError: the content of one is wrong.
        PoseError: the named trajectory cannot be used.
    """
    if not sources:
        raise OptionError("no drive to show; expected one or more paths")
    if len(sources) > MOST_DRIVES:
        raise OptionError(
            f"{len(sources)} drives, or parts of drives; expected no more than {MOST_DRIVES} at once: choose some, as "
            f"`sceneloom catalog query … --limit {MOST_DRIVES}` does"
        )
    check_single(len(sources), settings)
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
            prepare_drive(scene, name, part.settings(settings), progress=progress)
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


def new_recording(views: Sequence[DriveView]) -> Any:
    """A stream of Rerun's whose only times are those of the drives."""
    rr = sdk()
    name = ", ".join(view.name for view in views)
    recording = rr.RecordingStream(_APPLICATION, send_properties=False)
    rr.set_log_tick_enabled(False, recording=recording)
    rr.set_log_time_enabled(False, recording=recording)
    recording.send_recording_name(name)
    return recording


def log_drives(
    views: Sequence[DriveView], recording: Any, *, progress: Progress | None = None
) -> tuple[DriveShown, ...]:
    """Log drives one after another to an open stream.

    Raises:
        DataError: a frame cannot be read, and the reading is not lenient.
    """
    spans = [time_span(view.scene) for view in views]
    calendar = all(is_calendar(None if span is None else span[0]) for span in spans)
    return tuple(
        log_drive(view, Stream(recording, view.facts.root, calendar, view.reference_ns), progress=progress)
        for view in views
    )


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
        settings: what is shown, and how.
        overwrite: whether the file may be replaced.
        progress: reported after each frame.

    Raises:
        MissingExtraError: rerun-sdk is not installed.
        OptionError: an option cannot be followed.
        OutputError: the file exists or cannot be written.
        UnknownFormatError: no format fits a path.
        DataError: a frame cannot be read.
    """
    sdk()
    started, target = time.perf_counter(), Path(output)
    if target.suffix.lower() != SUFFIX:
        raise OptionError(f"{target}: expected a name that ends in {SUFFIX}")
    check_output(target, overwrite=overwrite)
    with (
        opened_drives(sources, settings or ViewSettings(), progress=progress) as views,
        replacing(target, overwrite=overwrite) as draft,
    ):
        recording = new_recording(views)
        recording.save(draft, default_blueprint=layout([view.facts for view in views]))
        try:
            drives = log_drives(views, recording, progress=progress)
            recording.flush()
        finally:
            recording.disconnect()
    return ViewReport(
        output=str(target),
        size_bytes=target.stat().st_size,
        drives=drives,
        seconds=time.perf_counter() - started,
    )
