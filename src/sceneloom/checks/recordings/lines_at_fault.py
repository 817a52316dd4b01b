"""Faults of single lines; one that a great part of a log has is reported once, with its count and first locations."""

import re
from collections.abc import Iterable, Iterator, Sequence

from sceneloom.checks.rule import Find, Hit
from sceneloom.checks.subject import Subject
from sceneloom.formats.faults import PlacedFault

GREAT_PART = 0.25
"""Where so many of all lines are at fault, that lies not in them but in what wrote them."""
FEWEST = 4
"""Fewer lines with a fault of one kind are listed singly even then."""

CODES = frozenset({"broken-lines", "unfit-lines"})
"""The codes of what is wrong with single lines."""

_LOCATIONS = 3
_LINE = re.compile(r"(?P<file>.*): line (?P<number>\d+)")
_BYTE = re.compile(r" \(byte \d+\)|in position \d+| 0x[0-9a-f]{2}")


def lines_at_fault(code: str) -> Find:
    """Report the faults of a code that lines have: singly, or where a great part of all lines is so, by their kinds."""

    def find(subject: Subject) -> Iterator[Hit]:
        lines = 0 if subject.recording is None else len(subject.recording.columns.log.codes)
        at_fault = sum(fault.count for fault in subject.faults if fault.code in CODES)
        is_wholly_wrong = lines > 0 and at_fault >= GREAT_PART * lines
        for alike in _kinds(subject.faults, code):
            count = sum(fault.count for fault in alike)
            if is_wholly_wrong and count >= FEWEST:
                yield _as_one(alike, count, lines)
            else:
                yield from (Hit(fault.where, fault.problem, fault.count) for fault in alike)

    return find


def _kinds(faults: Iterable[PlacedFault], code: str) -> Iterable[list[PlacedFault]]:
    kinds: dict[str, list[PlacedFault]] = {}
    for fault in faults:
        if fault.code == code:
            kinds.setdefault(_kind(fault), []).append(fault)
    return kinds.values()


def _kind(fault: PlacedFault) -> str:
    """The path in the line, where the problem begins with one, and what was expected, without the value between."""
    problem = fault.problem
    if fault.count > 1:
        problem = problem.partition(": ")[2]
    first, *between, last = ["", *problem.split(": ")]
    is_path = len(between) > 1 and re.fullmatch(r"[A-Za-z][\w.\[\]]*", between[0]) is not None
    return f"{first}{between[0] if is_path else ''}: {_BYTE.sub('', last)}"


def _as_one(alike: Sequence[PlacedFault], count: int, lines: int) -> Hit:
    found = [match for fault in alike if (match := _LINE.fullmatch(fault.path))]
    if not found:
        return Hit(alike[0].where, alike[0].problem, count)
    numbers = [match["number"] for match in found]
    shown = ", ".join(numbers[:_LOCATIONS])
    location = f"{found[0]['file']}: lines {shown}, … {numbers[-1]}"
    return Hit(location, f"{alike[0].problem}; such are {count} of {lines} lines", count)
