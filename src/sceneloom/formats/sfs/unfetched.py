"""Arrays of a file behind a URL before their values are there."""

from collections.abc import Iterator
from typing import Any, NoReturn

import numpy as np

from sceneloom.arrays import AnyArray
from sceneloom.errors import DataError
from sceneloom.formats.sfs.items import RawBytes


class Unfetched(np.ndarray[Any, Any]):
    """The location of an array in a file: shape and dtype are known, and looking at values is an error.

    Its memory is a part of the file's placeholder, so that its address reports where in the file it is.
    """

    def _refuse(self, *_: Any, **__: Any) -> NoReturn:
        raise DataError("", "", f"the values of an array {self.shape} of a remote file were not asked for")

    __getitem__ = __array_ufunc__ = __array_function__ = _refuse
    __iter__ = __reduce__ = __copy__ = __deepcopy__ = _refuse
    tolist = tobytes = item = copy = sum = min = max = any = all = _refuse


class UnfetchedBytes(RawBytes, Unfetched):
    """The same for an item that names no dtype."""


def unfetched(array: AnyArray) -> Unfetched:
    """Keep others from looking at the values of an array that has none yet."""
    return array.view(UnfetchedBytes if isinstance(array, RawBytes) else Unfetched)


def arrays_in(value: Any) -> Iterator[Unfetched]:
    """All arrays without values inside objects and lists."""
    if isinstance(value, Unfetched):
        yield value
    elif isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from arrays_in(part)


def replaced(value: Any, filled: dict[int, AnyArray]) -> Any:
    """Copy objects and lists with arrays put in the locations of those without values; by `id` of the latter."""
    if isinstance(value, Unfetched):
        return filled[id(value)]
    if isinstance(value, dict):
        return {key: replaced(part, filled) for key, part in value.items()}
    if isinstance(value, list):
        return [replaced(part, filled) for part in value]
    return value
