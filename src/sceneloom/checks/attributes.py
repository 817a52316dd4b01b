"""Rules about attributes: values that the format has, and static ones with one value."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

from sceneloom.arrays import read_only
from sceneloom.checks.repairing import repaired_annotations
from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import Subject
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.findings import Severity
from sceneloom.scene.scene import Scene


class Stated(NamedTuple):
    """An attribute, wherever it stands: its location, its values, and whether it is static."""

    path: str
    name: Any
    values: tuple[Any, ...]
    time_count: int | None
    static: bool


def _attributes(subject: Subject) -> list[Stated]:
    """All attributes of the scene and of its annotations."""
    return subject.table("attributes", lambda inner: list(_all_attributes(inner)))


def _all_attributes(subject: Subject) -> Iterator[Stated]:
    for k, attribute in enumerate(subject.scene.attributes):
        yield _stated(f"attributes[{k}]", attribute)
    for path, annotation in subject.annotations():
        for k, attribute in enumerate(getattr(annotation, "attributes", ())):
            yield _stated(f"{path}.attributes[{k}]", attribute)


def _stated(path: str, attribute: AttributePath | Mapping[str, Any]) -> Stated:
    if isinstance(attribute, AttributePath):
        times = attribute.timestamps_ns
        count = None if times is None else len(times)
        return Stated(path, attribute.name, attribute.values, count, bool(attribute.static))
    timestamps, values = attribute.get("timestamps"), attribute.get("values")
    return Stated(
        path,
        attribute.get("name"),
        tuple(values) if values is not None else (),
        None if timestamps is None else len(timestamps),
        bool(attribute.get("static")),
    )


def _is_usual(value: Any) -> bool:
    if isinstance(value, tuple | list):
        return all(isinstance(text, str) for text in value)
    return isinstance(value, str | int | float) and not isinstance(value, bool)


def _same(one: Any, other: Any) -> bool:
    """Whether two values are equal; of what is no value of the format only the very object is."""
    return one is other or (_is_usual(one) and _is_usual(other) and bool(one == other))


def _unusual(subject: Subject) -> Iterator[Hit]:
    for stated in _attributes(subject):
        odd = [k for k, value in enumerate(stated.values) if not _is_usual(value)]
        if odd:
            value = stated.values[odd[0]]
            message = f"{stated.name!r} is {value!r}; expected text, a number or a list of texts"
            yield Hit(f"{stated.path}.values[{odd[0]}]", message, count=len(odd))


def _kind(value: Any) -> str:
    if isinstance(value, str):
        return "text"
    return "a list" if isinstance(value, tuple | list) else "a number"


def _of_several_kinds(subject: Subject) -> Iterator[Hit]:
    for stated in _attributes(subject):
        kinds = dict.fromkeys(_kind(value) for value in stated.values if _is_usual(value))
        if len(kinds) > 1:
            yield Hit(f"{stated.path}.values", f"{stated.name!r} is {' and '.join(kinds)} alternately")


def _static_changes(subject: Subject) -> Iterator[Hit]:
    for stated in _attributes(subject):
        different = [k for k, value in enumerate(stated.values) if not _same(value, stated.values[0])]
        if stated.static and different:
            message = (
                f"{stated.name!r} is static and {stated.values[0]!r}, then {stated.values[different[0]]!r}"
            )
            yield Hit(f"{stated.path}.values[{different[0]}]", message, count=len(different))


def _static_repeats(subject: Subject) -> Iterator[Hit]:
    for stated in _attributes(subject):
        if (
            stated.static
            and len(stated.values) > 1
            and all(_same(value, stated.values[0]) for value in stated.values)
        ):
            message = f"{stated.name!r} is static and reported {len(stated.values)} times; once is enough"
            yield Hit(stated.path, message)


def _static_once(scene: Scene) -> Scene:
    """Keep the first of the equal values of static attributes of annotations."""
    return repaired_annotations(scene, _with_static_once)


def _with_static_once(annotation: Any) -> Any:
    attributes = getattr(annotation, "attributes", ())
    kept = tuple(_once(a) if isinstance(a, AttributePath) else a for a in attributes)
    same = all(new is old for new, old in zip(kept, attributes, strict=True))
    return annotation if same else replace(annotation, attributes=kept)


def _once(attribute: AttributePath) -> AttributePath:
    values, times = attribute.values, attribute.timestamps_ns
    if not attribute.static or len(values) < 2 or not all(_same(value, values[0]) for value in values):
        return attribute
    return replace(
        attribute, values=values[:1], timestamps_ns=None if times is None else read_only(times[:1])
    )


def _without_times(subject: Subject) -> Iterator[Hit]:
    for stated in _attributes(subject):
        if stated.static:
            continue
        if stated.time_count is None and len(stated.values) > 1:
            yield Hit(stated.path, f"{stated.name!r} has {len(stated.values)} values and no timestamps")
        elif stated.time_count is not None and stated.time_count != len(stated.values):
            message = f"{stated.name!r} has {stated.time_count} timestamps and {len(stated.values)} values"
            yield Hit(stated.path, message)


RULES: tuple[Rule, ...] = (
    Rule(
        "attribute-value-type",
        Severity.WARNING,
        "The value of an attribute is text, a number or a list of texts.",
        "Write truth values as text or as 0 and 1, and leave out what is not known.",
        find=_unusual,
    ),
    Rule(
        "attribute-kinds-mixed",
        Severity.HINT,
        "All values of an attribute are of one kind.",
        "Write them all as text, or all as numbers.",
        find=_of_several_kinds,
    ),
    Rule(
        "attribute-static-changes",
        Severity.WARNING,
        "A static attribute has one value.",
        "Take `static` out, or decide which value holds.",
        find=_static_changes,
    ),
    Rule(
        "attribute-static-repeats",
        Severity.HINT,
        "A static attribute is reported once.",
        "Keep the first of the equal values.",
        find=_static_repeats,
        fix=_static_once,
    ),
    Rule(
        "attribute-times",
        Severity.ERROR,
        "An attribute that changes has a timestamp for each value.",
        "Give each value its time.",
        find=_without_times,
    ),
)
