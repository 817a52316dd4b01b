"""Checks of clauses 5.1 to 5.5: basic types, predefined properties, and adding, setting and reading properties."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from sceneloom.db34t.conformance.catalogue import (
    Bench,
    CallFailedError,
    Catalogue,
    Look,
    Peer,
    Seen,
    added,
    refused,
    reported,
    same,
    true,
)

CHECKS = Catalogue()
_NAME = "conformance_value"


@dataclass(frozen=True, slots=True)
class _Values:
    """What a type takes and what not."""

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
        status = peer.add(_NAME, values.description, values.type)
        yield true(f"AddProperty type {values.type}", "added", status, agrees=status != 0)
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
        yield refused(f"SetProperty {value!r}", peer.set(_NAME, value))
        found = peer.value(_NAME)
        yield same(f"GetProperty after {value!r} was refused", before, found)
        if found != before:
            peer.set(_NAME, before)


for _values in _TYPES:
    _title = f"a property of type {_values.type} keeps what the type can hold, and refuses the rest without change"
    CHECKS.row(1, _values.type, _title)(_look(_values))

_TRIPLE = "(int8,int8,int8)"

_TABLE_2: dict[str, tuple[str, Any, tuple[Any, ...], tuple[Any, ...]]] = {
    "fusion_type": ("bool", 0, (1, 0), (2, -1, "0")),
    "chirality": ("bool", 0, (1, 0), (2, -1, "0")),
    "camera_coordinate": (_TRIPLE, [2, 0, -1], ([0, -1, 2], [1, 0, -2]), ([0, 0, 1], [0, 1], [0, 1, 3], [0, 1, 258])),
    "lidar_coordinate": (_TRIPLE, [0, -1, 2], ([1, 0, 2], [2, 0, -1]), ([0, 0, 1], [0, 1], [0, 1, 3], [0, 1, 258])),
    "camera_frequency": ("uint32", 10, (20, 2**32 - 1, 1), (-1, 2**32, 10.5, "10")),
    "lidar_frequency": ("uint32", 10, (20, 2**32 - 1, 1), (-1, 2**32, 10.5, "10")),
    "fusion_algorithm": ("string", None, (), (1, "", "there is no such algorithm")),
}  # type, value at the start (the example of the table; of the algorithm any), and values taken and refused


def _properties_look(name: str) -> Look:
    kind, default, kept, wrong = _TABLE_2[name]

    def look(bench: Bench) -> Iterator[Seen]:
        peer = bench.peer()
        found = peer.get(name)
        yield same(f"GetProperty {name}: name", name, found.name)
        yield same(f"GetProperty {name}: type", kind, found.type.replace(" ", ""))
        start = peer.value(name)
        if default is None:
            yield true(f"GetProperty {name}: value", "a name", start, agrees=isinstance(start, str) and bool(start))
        else:
            yield same(f"GetProperty {name}: value", default, start)
        for value in (*kept, start):
            status = peer.set(name, value)
            yield same(f"SetProperty {value!r}, GetProperty", value, peer.value(name) if status else "refused")
        for value in wrong:
            yield refused(f"SetProperty {value!r}", peer.set(name, value))
            yield same(f"GetProperty after {value!r} was refused", start, peer.value(name))

    return look


for _name in _TABLE_2:
    CHECKS.row(2, _name, f"{_name} is there, of its type, with the table's example; what is none is refused")(
        _properties_look(_name)
    )


@CHECKS.clause("5.3-1", "5.3.1", "a property that was added is there with its description and its type")
def _added(bench: Bench) -> Iterator[Seen]:
    peer = bench.peer()
    name, description, kind = "frequency", "the capture frequency of sensor", "uint32"
    sent = f"AddProperty ({name}, {description!r}, {kind})"
    status = peer.add(name, description, kind)
    yield added(sent, status)
    found = peer.get(name)
    yield same(f"{sent}, GetProperty", (name, description, kind), (found.name, found.description, found.type))


@CHECKS.clause("5.3-2", "5.3.2", "a property needs a name and a type that the standard knows")
def _inputs_of_add(bench: Bench) -> Iterator[Seen]:
    peer = bench.peer()
    for name, kind in (("", "uint32"), ("a", ""), ("b", "int64"), ("c", "uint32[0]"), ("d", "(int8, text)")):
        yield refused(f"AddProperty name {name!r} type {kind!r}", peer.add(name, "", kind))


@CHECKS.clause("5.3-3", "5.3.3", "adding returns 1, and 0 where the name is taken")
def _status_of_add(bench: Bench) -> Iterator[Seen]:
    peer = bench.peer()
    yield same("AddProperty speed", 1, peer.add("speed", "of the vehicle", "double"))
    yield same("AddProperty speed again", 0, peer.add("speed", "of the vehicle", "double"))
    yield same("AddProperty camera_frequency", 0, peer.add("camera_frequency", "", "uint32"))


@CHECKS.clause("5.3-4", "5.3.2", "types are tuples and arrays, too, as tables 2 and 3 write them", reading=True)
def _compound_types(bench: Bench) -> Iterator[Seen]:
    peer = bench.peer()
    cases: tuple[tuple[str, list[Any], list[Any]], ...] = (
        ("(int8, int8, int8)", [1, -2, 0], [1, 2]),
        ("double[3]", [0.5, -1.0, 2.5], [0.5, 1.0]),
        ("uint32[]", [2**32 - 1, 0], [-1]),
        ("string[]", ["x", "y"], [1]),
    )
    for k, (kind, kept, wrong) in enumerate(cases):
        name = f"compound_{k}"
        yield added(f"AddProperty type {kind}", peer.add(name, "", kind))
        status = peer.set(name, kept)
        yield same(f"SetProperty {kept}, GetProperty", kept, peer.value(name) if status else "refused")
        yield refused(f"SetProperty {wrong}", peer.set(name, wrong))


@CHECKS.clause("5.4-1", "5.4.1", "what is set is the named property, and no other")
def _set(bench: Bench) -> Iterator[Seen]:
    peer = bench.peer()
    status = peer.set("camera_frequency", 20)
    yield true("SetProperty (camera_frequency, 20)", "set", f"status {status}", agrees=status != 0)
    yield same("GetProperty camera_frequency", 20, peer.value("camera_frequency"))
    yield same("GetProperty lidar_frequency", 10, peer.value("lidar_frequency"))


@CHECKS.clause("5.4-2", "5.4.2", "a property that is not there, or no value, is refused")
def _inputs_of_set(bench: Bench) -> Iterator[Seen]:
    peer = bench.peer()
    yield refused("SetProperty of an unknown name", peer.set("conformance_unknown", 1))
    reply = peer.call("SetProperty", name="camera_frequency")
    yield refused("SetProperty camera_frequency without a value", reply.status)


@CHECKS.clause("5.4-3", "5.4.3", "setting returns 1, and 0 where the value is not set")
def _status_of_set(bench: Bench) -> Iterator[Seen]:
    peer = bench.peer()
    yield same("SetProperty lidar_frequency 20", 1, peer.set("lidar_frequency", 20))
    yield same("SetProperty lidar_frequency 'often'", 0, peer.set("lidar_frequency", "often"))


@CHECKS.clause("5.5-1", "5.5.1", "getting gives the value that was set last, as often as it is asked for")
def _got(bench: Bench) -> Iterator[Seen]:
    peer = bench.peer()
    for value in (15, 25):
        peer.set("camera_frequency", value)
        found = [peer.value("camera_frequency") for _ in range(3)]
        yield same(f"SetProperty camera_frequency {value}, GetProperty three times", [value] * 3, found)


@CHECKS.clause("5.5-2", "5.5.2", "getting a property that is not there is the error NOT_FOUND", reading=True)
def _unknown(bench: Bench) -> Iterator[Seen]:
    sent = "GetProperty of an unknown name"
    try:
        found = reported(bench.peer().get("conformance_unknown"))
    except CallFailedError as error:
        yield same(sent, "error NOT_FOUND", f"error {error.code}")
        return
    yield same(sent, "error NOT_FOUND", f"an answer: {found}")


@CHECKS.clause("5.5-3", "5.5.3", "a value comes back as what its type says: whole, broken, text or list")
def _kinds(bench: Bench) -> Iterator[Seen]:
    peer = bench.peer()
    for name, kinds in (
        ("fusion_type", ("integer_value", "bool_value")),
        ("camera_coordinate", ("list_value",)),
        ("lidar_frequency", ("integer_value",)),
        ("fusion_algorithm", ("string_value",)),
    ):
        found = peer.get(name).value.WhichOneof("kind")
        yield true(f"GetProperty {name}", " or ".join(kinds), found, agrees=found in kinds)
