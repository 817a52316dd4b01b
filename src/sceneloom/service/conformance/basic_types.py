"""Clause 5.1: values of each type of table 1 are kept exactly, and what is none is refused and changes nothing."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from sceneloom.service.conformance.bench import Bench, Peer
from sceneloom.service.conformance.catalogue import Catalogue, Look, Seen, same, true

CHECKS = Catalogue("Basic types (clause 5.1, table 1)")

_NAME = "conformance_value"


@dataclass(frozen=True, slots=True)
class _Values:
    """What a type takes and what not.

    Attributes:
        type: of table 1.
        kept: values that it holds; the last one is there when the others are tried.
        refused: values that it does not hold.
        description: of the property.
    """

    type: str
    kept: tuple[Any, ...]
    refused: tuple[Any, ...]
    description: str = "tries a type of table 1"


def _whole(name: str, low: int, high: int) -> _Values:
    wrapping = (low - 1, high + 1, high + 1 + 2**32)
    return _Values(name, (low, high, 1), (*wrapping, 0.5, "1", [1]))


_NO_NUMBERS = (float("nan"), float("inf"), -float("inf"), "1.0")

_TYPES = (
    _Values("bool", (True, False, 1), (2, -1, "true")),
    _whole("int8", -(2**7), 2**7 - 1),
    _whole("uint8", 0, 2**8 - 1),
    _whole("int32", -(2**31), 2**31 - 1),
    _whole("uint32", 0, 2**32 - 1),
    _Values("float", (-1.5, float(np.finfo(np.float32).max), 0.25), (1e39, -1e39, *_NO_NUMBERS)),
    _Values("double", (1595682678.715705, -1e300, 0.1), _NO_NUMBERS),
    _Values("string", ("", "激光雷达 µ", "lidar"), (1, 0.5, True)),
    _Values("enum", (3, -1, 7), (2, 0.5, "blue"), description="red=3, green=-1, white=7"),
)


def _look(values: _Values) -> Look:
    def look(bench: Bench) -> Iterator[Seen]:
        peer = bench.peer()
        added = peer.add(_NAME, values.description, values.type)
        yield true(f"AddProperty type {values.type}", "added", added, agrees=added != 0)
        for value in values.kept:
            yield _kept(peer, value, value)
        if values.type == "enum":
            yield _kept(peer, "white", 7)
        yield from _refused(peer, values)

    return look


def _kept(peer: Peer, value: Any, read: Any) -> Seen:
    status = peer.set(_NAME, value)
    found = peer.value(_NAME) if status else "refused"
    sent = f"SetProperty {value!r}, GetProperty"
    expected = int(read) if isinstance(read, bool) else read
    return true(sent, f"{expected!r}", found, agrees=found == expected and type(found) is type(expected))


def _refused(peer: Peer, values: _Values) -> Iterator[Seen]:
    before = peer.value(_NAME)
    for value in values.refused:
        yield same(f"SetProperty {value!r}", "status 0", f"status {peer.set(_NAME, value)}")
        found = peer.value(_NAME)
        yield same(f"GetProperty after {value!r} was refused", before, found)
        if found != before:
            peer.set(_NAME, before)


for _values in _TYPES:
    _title = (
        f"a property of type {_values.type} keeps what the type can hold, and refuses the rest without change"
    )
    CHECKS.row(1, _values.type, _title)(_look(_values))
