"""A sequence whose timestamps are known at once and whose contents are made when asked for."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, Generic, TypeVar, overload

import numpy as np

from sceneloom.arrays import AnyArray, Int64Array, as_array, check_array, read_only
from sceneloom.errors import ArrayError
from sceneloom.stages import in_stage

Item_co = TypeVar("Item_co", covariant=True)
Array_co = TypeVar("Array_co", bound=AnyArray, covariant=True)


def _read_chosen(read: Callable[[int], Any], rows: "range | Int64Array", k: int) -> Any:
    return read(int(rows[k]))


def _read_mapped(frames: "LazyFrames[Any]", change: Callable[[Any], Any], k: int) -> Any:
    return change(frames[k])


class LazyFrames(Sequence[Item_co], Generic[Item_co]):
    """Frames of one sensor in the order of their time; nothing is read before it is asked for, nothing kept.

    They can be pickled if the function that reads them can: let it be a method of an object that can, a `partial`
    of a function of a module, or an instance with `__call__`; no lambda and no inner function.

    Attributes:
        timestamps_ns: (N,) int64 [ns], one per frame.
    """

    def __init__(
        self, timestamps_ns: Int64Array, read: Callable[[int], Item_co], *, stage: str | None = "reading"
    ) -> None:
        """Hold the timestamps and the function that makes frame `k` (0 <= k < N).

        The time of making one counts as the stage; None where next to nothing is read, as for images, which are decoded
        later.
        """
        timestamps_ns = as_array("frames.timestamps_ns", timestamps_ns, (None,), np.int64)
        check_array("frames.timestamps_ns", timestamps_ns, (None,), np.int64)
        self.timestamps_ns: Int64Array = read_only(timestamps_ns)
        self._read, self._stage = read, stage

    @classmethod
    def of(cls, items: Sequence[Item_co], timestamps_ns: Sequence[int]) -> "LazyFrames[Item_co]":
        """Wrap frames that are already in memory."""
        kept = tuple(items)
        times_ns = as_array("frames.timestamps_ns", timestamps_ns, (None,), np.int64)
        if times_ns.shape != (len(kept),):
            raise ArrayError(f"frames.timestamps_ns: {times_ns.shape} for {len(kept)} frames; expected as many of both")
        return cls(times_ns, kept.__getitem__)

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(LazyFrames, stage=self._stage), (self.timestamps_ns, self._read)

    def __repr__(self) -> str:
        return f"<{len(self)} frames, read when asked for>"

    def __len__(self) -> int:
        return len(self.timestamps_ns)

    @overload
    def __getitem__(self, index: int) -> Item_co: ...
    @overload
    def __getitem__(self, index: slice) -> "LazyFrames[Item_co]": ...
    def __getitem__(self, index: int | slice) -> "Item_co | LazyFrames[Item_co]":
        if isinstance(index, slice):
            return self._of(self.timestamps_ns[index], range(len(self))[index])
        number = range(len(self))[index]
        return self._read(number) if self._stage is None else in_stage(self._stage, self._read, number)

    def __iter__(self) -> Iterator[Item_co]:
        return map(self.__getitem__, range(len(self)))

    def chosen(self, numbers: Int64Array) -> "LazyFrames[Item_co]":
        """Give the frames with these numbers, (M,) int64, in that order; itself where these are all of them."""
        if np.array_equal(numbers, np.arange(len(self))):
            return self
        return self._of(self.timestamps_ns[numbers], numbers)

    def _of(self, timestamps_ns: Int64Array, numbers: "range | Int64Array") -> "LazyFrames[Item_co]":
        return LazyFrames(timestamps_ns, partial(_read_chosen, self._read, numbers), stage=self._stage)

    def mapped(self, change: Callable[[Any], Any], *, timestamps_ns: Int64Array | None = None) -> "LazyFrames[Any]":
        """Give frames that are changed when they are read.

        Args:
            change: makes the new frame of an old one; to be pickled as the constructor's function is.
            timestamps_ns: (N,) int64 [ns], where the change moves the frames in time.
        """
        times_ns = self.timestamps_ns if timestamps_ns is None else timestamps_ns
        return LazyFrames(times_ns, partial(_read_mapped, self, change), stage=self._stage)
