"""Rules about fields of a scene file: those that the description requires are there, and none is misspelt."""

from collections.abc import Iterator, Mapping
from difflib import get_close_matches
from typing import Any, NamedTuple

from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import Subject
from sceneloom.formats.sfs.container import format_keys
from sceneloom.formats.sfs.fields import RECORDS, annotation_record, sensor_record
from sceneloom.scene.findings import Severity

_ALIKE = 0.8
"""How like a known name an unknown one has to be, to be taken for it."""

_TYPED = {"sensors": sensor_record, "annotations": annotation_record}
_EXPECTED = {
    record: tuple(name for name, field in fields.items() if field.expected)
    for record, fields in RECORDS.items()
}
_INNER = {
    record: tuple((name, field.record) for name, field in fields.items() if field.record)
    for record, fields in RECORDS.items()
}


class _Found(NamedTuple):
    """An object of the header: the keys that lead to it, the name of its record, and its fields."""

    keys: tuple[str | int, ...]
    record: str
    fields: Mapping[str, Any]


def _objects(subject: Subject) -> Iterator[_Found]:
    """All objects of the header whose record is known."""
    header = subject.header
    if header is None:
        return
    yield _Found((), "scene", header)
    yield from _below(header.get("attributes"), "attribute", ("attributes",))
    for name, record_of in _TYPED.items():
        listed = header.get(name)
        for k, thing in enumerate(listed if isinstance(listed, list) else ()):
            kind = thing.get("type") if isinstance(thing, dict) else None
            if isinstance(kind, str):
                yield from _below(thing, record_of(kind), (name, k))


def _below(node: Any, record: str, keys: tuple[str | int, ...]) -> Iterator[_Found]:
    if isinstance(node, list):
        for k, entry in enumerate(node):
            yield from _below(entry, record, (*keys, k))
    elif isinstance(node, dict):
        yield _Found(keys, record, node)
        for name, inner in _INNER[record]:
            if name in node:
                yield from _below(node[name], inner, (*keys, name))


def _missing(subject: Subject) -> Iterator[Hit]:
    for keys, record, fields in _objects(subject):
        if record.startswith("unknown"):
            continue
        for name in _EXPECTED[record]:
            if fields.get(name) is None and not _may_be_absent(record, name, fields):
                expected = RECORDS[record][name].kind.value
                yield Hit(format_keys((*keys, name)), f"missing; expected {expected}")


def _may_be_absent(record: str, name: str, fields: Mapping[str, Any]) -> bool:
    """Whether a field says nothing here: a static attribute holds at all times."""
    return record == "attribute" and name == "timestamps" and fields.get("static") is True


def _misspelt(subject: Subject) -> Iterator[Hit]:
    for keys, record, fields in _objects(subject):
        known = RECORDS[record]
        for name in fields:
            if name in known or record.startswith("unknown"):
                continue
            absent = [other for other in known if fields.get(other) is None]
            near = get_close_matches(name, absent, n=1, cutoff=_ALIKE)
            if near:
                problem = f"{name!r} is no field of the format; {near[0]!r} is, and is not there"
                yield Hit(format_keys((*keys, name)), problem)


RULES: tuple[Rule, ...] = (
    Rule(
        "fields-required",
        Severity.WARNING,
        "Fields that the description requires are there, also where a file can be read without them.",
        "Write the field: programs that follow the description need it.",
        find=_missing,
    ),
    Rule(
        "fields-spelling",
        Severity.WARNING,
        "No field has a name that is nearly one of the format, which is missing.",
        "Correct the name, or choose another one for a field of your own.",
        find=_misspelt,
    ),
)
