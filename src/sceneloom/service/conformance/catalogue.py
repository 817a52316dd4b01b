"""What a check of the kit is: a number, the position of the standard that it stands for, and what it looks at."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Any

from sceneloom.fusion.messages.tables import TABLES
from sceneloom.service.conformance.quotes import CLAUSES, PROPERTY_ROWS, ROWS, TYPE_ROWS, Quote

if TYPE_CHECKING:
    from sceneloom.service.conformance.bench import Bench


class Basis(StrEnum):
    """What a check rests on."""

    TEXT = "text"
    """The words of the standard."""
    READING = "reading"
    """Our reading of a location that the standard leaves open; docs/db34t-4101.md says which."""
    EXTENSION = "extension"
    """The service's own calls and fields, which the standard does not have."""


@dataclass(frozen=True, slots=True)
class Seen:
    """One thing that a check looked at.

    Attributes:
        sent: what was sent.
        expected: what the answer has to be.
        found: what it was.
        agrees: whether it is as expected.
    """

    sent: str
    expected: str
    found: str
    agrees: bool


Look = Callable[["Bench"], Iterator[Seen]]
"""What a check does: talks to the server, and reports one thing after the other."""


@dataclass(frozen=True, slots=True)
class Check:
    """One numbered check.

    Attributes:
        id: clause and number ("5.4-3"), table and row ("T6-7"), or an extension's number ("X-2").
        location: of the standard, in words.
        title: what has to be so.
        basis: what it rests on.
        quote: what stands there, in English and Chinese.
        look: finds out.
    """

    id: str
    location: str
    title: str
    basis: Basis
    quote: Quote
    look: Look


@dataclass(slots=True)
class Catalogue:
    """The checks of one part of the standard, in order.

    Attributes:
        title: of the part.
        checks: gathered as they are declared.
    """

    title: str
    checks: list[Check] = field(default_factory=list)

    def clause(
        self, number: str, of_clause: str, title: str, *, basis: Basis = Basis.TEXT
    ) -> Callable[[Look], Look]:
        """Declare what looks whether a clause is kept."""
        return self._declare(number, f"clause {of_clause}", title, basis, CLAUSES[of_clause])

    def row(self, table: int, name: str, title: str, *, basis: Basis = Basis.TEXT) -> Callable[[Look], Look]:
        """Declare what looks at a row of a table."""
        row_number, quote = _row(table, name)
        return self._declare(
            f"T{table}-{row_number}", f"table {table}, row {row_number} ({name})", title, basis, quote
        )

    def extension(self, number: int, location: str, title: str) -> Callable[[Look], Look]:
        """Declare what looks at something that the standard does not have."""
        quote = Quote("not in the standard", "本文件未规定")
        return self._declare(f"X-{number}", location, title, Basis.EXTENSION, quote)

    def _declare(
        self, number: str, location: str, title: str, basis: Basis, quote: Quote
    ) -> Callable[[Look], Look]:
        def declared(look: Look) -> Look:
            self.checks.append(Check(number, location, title, basis, quote, look))
            return look

        return declared


def _row(table: int, name: str) -> tuple[int, Quote]:
    if table == 1:
        return list(TYPE_ROWS).index(name) + 1, TYPE_ROWS[name]
    if table == 2:
        return list(PROPERTY_ROWS).index(name) + 1, PROPERTY_ROWS[name]
    row = TABLES[table].row(name)
    unit = f" [{row.unit}]" if row.unit else ""
    return row.number, Quote(f"{name}: {row.type}{unit}: {row.meaning}", ROWS[table][name])


def same(sent: str, expected: Any, found: Any) -> Seen:
    """See whether two values are equal."""
    return Seen(sent, short(expected), short(found), bool(expected == found))


def true(sent: str, expected: str, found: Any, *, agrees: bool) -> Seen:
    """See whether something holds that is stated in words."""
    return Seen(sent, expected, short(found), agrees)


def near(sent: str, expected: float, found: float, tolerance: float) -> Seen:
    """See whether a number is as near to another as it has to be."""
    agrees = abs(found - expected) <= tolerance
    return Seen(sent, f"{expected:.6g} ± {tolerance:g}", f"{found:.6g}", agrees)


def short(value: Any) -> str:
    """A value in a report, cut where it is long."""
    text = value if isinstance(value, str) else repr(value)
    return text if len(text) <= 200 else f"{text[:197]}…"
