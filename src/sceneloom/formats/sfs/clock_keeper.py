"""The clock of a file that is being written: its offset is chosen early, and moved if something earlier comes."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray
from sceneloom.errors import OptionError
from sceneloom.formats.sfs.drafts import SensorDraft
from sceneloom.formats.sfs.spool import Spool
from sceneloom.formats.sfs.times import UINT32_MAX, UINT64_MAX, FileClock, chosen_offset_ns


@dataclass(slots=True)
class ClockKeeper:
    """Chooses the offset.

    Attributes:
        tick_ns: length of the file's unit [ns].
        offset_ns: the offset; None until the first time is known.
        fixed: whether the caller chose the offset, so that it cannot move.
        spool: holds point times that have to follow when it moves.
        drafts: the sensors so far.

    Raises:
        OptionError: the offset is no whole number of ticks.
    """

    tick_ns: int
    offset_ns: int | None
    fixed: bool
    spool: Spool
    drafts: Iterable[SensorDraft]

    def __post_init__(self) -> None:
        if self.offset_ns is not None and self.offset_ns % self.tick_ns:
            raise OptionError(f"time_offset_ns {self.offset_ns}; expected whole microseconds")

    def clock_for(self, first_ns: int) -> FileClock:
        """Give the clock, which after this call can hold times from `first_ns` on.

        Raises:
            OptionError: the caller's offset is later, or point times written before do not fit any more.
        """
        if self.offset_ns is None:
            self.offset_ns = chosen_offset_ns(first_ns)
        elif first_ns < self.offset_ns:
            self._move(first_ns)
        return FileClock(self.tick_ns, self.offset_ns)

    @property
    def clock(self) -> FileClock:
        """The clock as it is; with offset 0 where no time is known."""
        return FileClock(self.tick_ns, self.offset_ns or 0)

    def _move(self, first_ns: int) -> None:
        old_ns, new_ns = self.clock.offset_ns, chosen_offset_ns(first_ns)
        if self.fixed:
            raise OptionError(
                f"time_offset_ns {old_ns}; expected at most {first_ns}, the earliest time of the scene"
            )
        later = (old_ns - new_ns) // self.tick_ns
        self.offset_ns = new_ns
        clock = self.clock

        for draft in self.drafts:
            for number, blob in enumerate(draft.point_times):
                location = f"{draft.location}.frames[{number}]"
                self.spool.change(blob, partial(_moved, later=later, clock=clock, location=location))


def _moved(timestamps: AnyArray, *, later: int, clock: FileClock, location: str) -> AnyArray:
    if abs(later) >= 2**63:
        raise OptionError(f"{location}: point times {later} ticks later do not fit 64 bits")
    since = timestamps.astype(np.int64) + later
    if since.size:
        check_timestamps(int(since.min()), int(since.max()), clock, location)
    return since.astype(timestamp_dtype(clock))


def timestamp_dtype(clock: FileClock) -> type[np.unsignedinteger[Any]]:
    """The type of point times, as in `point_times_dtype`."""
    return np.uint64 if clock.tick_ns == 1 else np.uint32


def check_timestamps(lowest: int, highest: int, clock: FileClock, location: str) -> None:
    """Refuse point times, of which the first and the last timestamp are given, that the file's integers cannot hold.

    Raises:
        OptionError: naming what would hold them.
    """
    limit = UINT64_MAX if clock.tick_ns == 1 else UINT32_MAX
    if lowest < 0 or highest > limit:
        seconds = (lowest if lowest < 0 else highest) * clock.tick_ns / 1e9
        raise OptionError(
            f"{location}.points.timestamps: {seconds:.3f} s after the clock's zero; microseconds in 32 bits hold 0 to "
            "4294.967 s: choose another time offset, or `--time-unit nanoseconds`"
        )
