"""The clock of a file that is being written: its offset is chosen early, and moved if something earlier comes."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import AnyArray
from sceneloom.errors import OptionError
from sceneloom.formats.sfs.drafts import SensorDraft
from sceneloom.formats.sfs.spool import Spool
from sceneloom.formats.sfs.times import FileClock, chosen_offset_ns
from sceneloom.formats.sfs.write_clouds import check_stamps, stamp_dtype


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

        def moved(stamps: AnyArray) -> AnyArray:
            since = stamps.astype(np.int64) + later
            check_stamps(since, clock, "frames[]")
            return since.astype(stamp_dtype(clock))

        for draft in self.drafts:
            for blob in draft.point_times:
                self.spool.change(blob, moved)
