"""A sequence whose time stamps are known at once and whose contents are made when asked for."""

from collections.abc import Callable, Iterator, Sequence
from typing import Generic, TypeVar, overload

import numpy as np

from sceneloom.arrays import Int64Array, check_array, read_only

Item_co = TypeVar("Item_co", covariant=True)


class LazyFrames(Sequence[Item_co], Generic[Item_co]):
    """Frames of one sensor in the order of their time; nothing is read before it is asked for, nothing kept.

    Attributes:
        timestamps_ns: (N,) int64 [ns], one per frame.
    """

    def __init__(self, timestamps_ns: Int64Array, read: Callable[[int], Item_co]) -> None:
        """Hold the stamps and the function that makes frame `k` (0 <= k < N)."""
        check_array("frames.timestamps_ns", timestamps_ns, (None,), np.int64)
        self.timestamps_ns: Int64Array = read_only(timestamps_ns)
        self._read = read

    @classmethod
    def of(cls, items: Sequence[Item_co], timestamps_ns: Sequence[int]) -> "LazyFrames[Item_co]":
        """Wrap frames that are already in memory."""
        kept = tuple(items)
        return cls(np.asarray(timestamps_ns, dtype=np.int64).reshape(-1), kept.__getitem__)

    def __len__(self) -> int:
        return len(self.timestamps_ns)

    @overload
    def __getitem__(self, index: int) -> Item_co: ...
    @overload
    def __getitem__(self, index: slice) -> "LazyFrames[Item_co]": ...
    def __getitem__(self, index: int | slice) -> "Item_co | LazyFrames[Item_co]":
        if isinstance(index, slice):
            chosen = range(len(self))[index]
            return LazyFrames(self.timestamps_ns[index], lambda k: self._read(chosen[k]))
        return self._read(range(len(self))[index])

    def __iter__(self) -> Iterator[Item_co]:
        return (self._read(k) for k in range(len(self)))
