"""Logging to Rerun: the SDK (imported on first use, analytics off), entity paths and time."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cache
from typing import Any, SupportsInt

import numpy as np
from numpy.typing import ArrayLike

from sceneloom.arrays import AnyArray, BoolArray, Int64Array
from sceneloom.errors import MissingExtraError, how_to_install
from sceneloom.scene.types import Identifier
from sceneloom.warnings import DataWarning, skipped


@cache
def sdk() -> Any:
    """Import `rerun`.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        import rerun
    except ImportError as error:
        raise MissingExtraError(f"viewing needs rerun-sdk: {how_to_install('view')}") from error
    return rerun


TIME = "time"
"""The timeline of capture times [ns]."""
_FRAME = "frame"
"""The timeline of frame numbers: which sweep of the first lidar (or image of the first camera) was the last one."""
_PENDING_BYTES = 48_000_000
"""So much may wait to be written; then the writer is waited for, which bounds the memory of a long drive."""
WORLD, SENSORS = "world", "sensors"
"""Entities: everything that has a location; the sensors in it."""
EDGES = "majorwireframe"
"""Boxes are drawn as their edges: what is in them stays in view."""


@dataclass(slots=True)
class Stream:
    """Logs one drive.

    Attributes:
        root: the drive's own entity.
        calendar: whether times are shown as times of day, else as seconds.
        reference_ns: (N,) int64 [ns], when each frame begins that is counted as a frame of the drive.
        counts: how many rows of which kind were logged.
        left_out: how many of which kind were not, as the viewer cannot hold their numbers.
    """

    recording: Any
    root: str
    calendar: bool
    reference_ns: Int64Array
    counts: dict[str, int] = field(default_factory=dict)
    left_out: dict[str, int] = field(default_factory=dict)
    _pending: int = 0

    def path(self, *names: Identifier) -> str:
        """The entity of that name below the root; ids may hold any characters."""
        return "/".join([self.root, *(escaped(name) for name in names)])

    def frames_at(self, times_ns: ArrayLike) -> Int64Array:
        """The number of the drive's frame that had begun last at each time."""
        rows = np.searchsorted(self.reference_ns, np.asarray(times_ns, np.int64), side="right") - 1
        return np.maximum(rows, 0).astype(np.int64)

    def log(self, time_ns: int, path: str, *archetypes: Any, kind: str | None = None, size: int = 0) -> None:
        """Log at a time.

        Args:
            time_ns: capture time [ns].
            archetypes: what is there from then on.
            kind: under which it is counted.
            size: in bytes, where it is large.
        """
        named = (
            {"timestamp": np.datetime64(time_ns, "ns")}
            if self.calendar
            else {"duration": np.timedelta64(time_ns, "ns")}
        )
        self.recording.set_time(TIME, **named)
        self.recording.set_time(_FRAME, sequence=int(self.frames_at([time_ns])[0]))
        self.recording.log(path, *archetypes, strict=True)
        self._note(kind, 1, size)

    def static(self, path: str, *archetypes: Any) -> None:
        """Log what holds at all times."""
        self.recording.log(path, *archetypes, static=True, strict=True)

    def columns(self, times_ns: Int64Array, path: str, *columns: Iterable[Any], kind: str | None = None) -> None:
        """Log many times at once: (N,) int64 [ns], and columns of N rows."""
        if len(times_ns) == 0:
            return
        rr = sdk()
        # the least number of 64 bits means "no time" there
        timestamps = np.maximum(np.ascontiguousarray(times_ns, np.int64), -(2**63) + 1)
        named = (
            {"timestamp": timestamps.view("datetime64[ns]")}
            if self.calendar
            else {"duration": timestamps.view("timedelta64[ns]")}
        )
        indexes = [rr.TimeColumn(TIME, **named), rr.TimeColumn(_FRAME, sequence=self.frames_at(timestamps))]
        self.recording.send_columns(path, indexes, [one for many in columns for one in many], strict=True)
        self._note(kind, len(timestamps), 0)

    def count(self, kind: str, rows: int) -> None:
        """Count rows that were logged."""
        self.counts[kind] = self.counts.get(kind, 0) + rows

    def leave_out(self, kind: str, rows: SupportsInt) -> None:
        """Count what is not logged, since `fits` says no."""
        count = int(rows)
        if count:
            self.left_out[kind] = self.left_out.get(kind, 0) + count

    @property
    def warnings(self) -> tuple[DataWarning, ...]:
        """What was left out so far."""
        message = "not shown: their numbers are not finite, or beyond the viewer's float32"
        return tuple(skipped("beyond-the-viewer", kind, message, count=n) for kind, n in self.left_out.items())

    def _note(self, kind: str | None, rows: int, size: int) -> None:
        if kind is not None:
            self.count(kind, rows)
        self._pending += size
        if self._pending > _PENDING_BYTES:
            self.recording.flush()
            self._pending = 0


def fits(values: AnyArray) -> BoolArray:
    """Report of the last axis of (..., D) numbers whether all of them are finite in the viewer's float32."""
    largest = np.finfo(np.float32).max
    return np.asarray(((values >= -largest) & (values <= largest)).all(axis=-1), np.bool_)


def escaped(name: Identifier) -> str:
    """A name as one part of an entity's path."""
    escape = sdk().escape_entity_path_part
    return str(escape(str(name) or "-"))


def one_packed(rgb: tuple[int, int, int]) -> int:
    """Pack one opaque colour as 0xRRGGBBAA."""
    return (rgb[0] << 24) | (rgb[1] << 16) | (rgb[2] << 8) | 255


Report = Callable[[str, str, str], None]
"""Is reported what could not be shown: a code, a location, a message; the same code and location are counted."""


@dataclass(frozen=True, slots=True, eq=False)
class Feed:
    """Moments to be logged one after another.

    Attributes:
        times_ns: (N,) int64 [ns], ascending.
        log: logs moment `k`, with what was prepared for it.
        prepare: does the work on moment `k` that may be done before it is logged, while other feeds are logged; one
            moment of a feed at a time, in their order.
    """

    times_ns: Int64Array
    log: Callable[[int, Any], None]
    prepare: Callable[[int], Any] | None = None

    def __len__(self) -> int:
        return len(self.times_ns)
