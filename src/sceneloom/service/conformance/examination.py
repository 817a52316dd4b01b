"""Runs the checks of the kit against a server, and what came out of it."""

import secrets
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum

from sceneloom.errors import OptionError
from sceneloom.service.conformance import (
    basic_types,
    calibration,
    detection_results,
    extensions,
    fetching,
    frames,
    properties,
    receiving,
    sensor_results,
    sent_rows,
    surroundings,
)
from sceneloom.service.conformance.bench import Bench, NoResultError
from sceneloom.service.conformance.catalogue import Catalogue, Check, Seen
from sceneloom.service.conformance.transport import CallFailedError, Transport

PARTS: tuple[Catalogue, ...] = tuple(
    part.CHECKS
    for part in (
        *(basic_types, properties, calibration, frames, receiving, sent_rows),
        *(fetching, sensor_results, detection_results, extensions, surroundings),
    )
)
"""The parts of the kit, in the order of the standard."""

CHECKS: tuple[Check, ...] = tuple(check for part in PARTS for check in part.checks)
"""All checks."""


class Verdict(StrEnum):
    """What came out of a check."""

    PASSED = "passed"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class Finding:
    """One check with what it saw.

    Attributes:
        check: which.
        verdict: whether all was as expected.
        seen: what it looked at, in order; after a failure that ends it nothing more.
    """

    check: Check
    verdict: Verdict
    seen: tuple[Seen, ...]

    @property
    def failures(self) -> tuple[Seen, ...]:
        """What was not as expected."""
        return tuple(seen for seen in self.seen if not seen.agrees)


@dataclass(frozen=True, slots=True)
class Examination:
    """What came out of all checks.

    Attributes:
        address: of the server.
        findings: of the checks that were run, in order.
    """

    address: str
    findings: tuple[Finding, ...]

    @property
    def passed(self) -> bool:
        """Whether no check failed."""
        return all(finding.verdict is Verdict.PASSED for finding in self.findings)

    @property
    def counts(self) -> dict[str, int]:
        """How many checks passed and failed."""
        found = Counter(finding.verdict for finding in self.findings)
        return {str(verdict): found[verdict] for verdict in Verdict}

    @property
    def failed_ids(self) -> tuple[str, ...]:
        """The checks that failed."""
        return tuple(f.check.id for f in self.findings if f.verdict is Verdict.FAILED)


def chosen(ids: Iterable[str]) -> tuple[Check, ...]:
    """The checks with these ids, or whose clause or table they name ("5.4", "T9"); all where none are stated.

    Raises:
        OptionError: there is none of that name.
    """
    wanted = tuple(ids)
    for name in wanted:
        if not any(_is_of(check, name) for check in CHECKS):
            parts = ", ".join(dict.fromkeys(check.id.split("-")[0] for check in CHECKS))
            raise OptionError(f"check {name!r}; there are those of {parts}, each with -1, -2, …")
    return tuple(check for check in CHECKS if not wanted or any(_is_of(check, name) for name in wanted))


def _is_of(check: Check, name: str) -> bool:
    return name in (check.id, check.id.split("-")[0])


def examine(
    transport: Transport,
    *,
    address: str = "",
    only: Iterable[str] = (),
    progress: Callable[[int, int], None] | None = None,
) -> Examination:
    """Run checks against a server, each in sessions of its own that are ended after it.

    Args:
        transport: carries the calls.
        address: of the server, for the report.
        only: ids of checks, or of clauses and tables; all where none are stated.
        progress: reported how many checks are done, and of how many.

    Raises:
        OptionError: there is no such check.
    """
    checks = chosen(only)
    bench = Bench(transport, f"conformance-{secrets.token_hex(4)}")
    findings = []
    for number, check in enumerate(checks):
        findings.append(_run(check, bench))
        if progress is not None:
            progress(number + 1, len(checks))
    return Examination(address, tuple(findings))


def _run(check: Check, bench: Bench) -> Finding:
    seen: list[Seen] = []
    try:
        for each in check.look(bench):
            seen.append(each)  # noqa: PERF402 - what was seen before an error counts
    except (CallFailedError, NoResultError) as error:
        seen.append(Seen(_after(seen), "an answer", str(error), agrees=False))
    except Exception as error:  # noqa: BLE001 - whatever a server answers, the other checks go on
        found = f"an answer that cannot be read: {type(error).__name__}: {error}"
        seen.append(Seen(_after(seen), "an answer", found, agrees=False))
    finally:
        bench.end_sessions()
    passed = bool(seen) and all(each.agrees for each in seen)
    return Finding(check, Verdict.PASSED if passed else Verdict.FAILED, tuple(seen))


def _after(seen: Sequence[Seen]) -> str:
    return f"what comes after: {seen[-1].sent}" if seen else "what the check begins with"
