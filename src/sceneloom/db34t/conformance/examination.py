"""Runs the conformance checks against a server, and writes the outcome as JSON, Markdown or HTML."""

import json
import secrets
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from enum import StrEnum
from html import escape
from pathlib import Path
from typing import Any, Self

import grpc
from google.protobuf.message import Message
from grpc_health.v1 import health_pb2
from grpc_reflection.v1alpha import reflection_pb2

from sceneloom.db34t.conformance import (
    calibration_checks,
    extension_checks,
    property_checks,
    record_checks,
    result_checks,
)
from sceneloom.db34t.conformance.catalogue import Bench, CallFailedError, Check, Seen, Transport
from sceneloom.db34t.transport import calls_of, details_of, open_channel, read_token, reader_of
from sceneloom.db34t.wire import fusion_pb2
from sceneloom.errors import OptionError, SceneloomError
from sceneloom.formats.base.output import replacing
from sceneloom.scene.types import Progress, reporting

CHECKS: tuple[Check, ...] = tuple(
    check
    for part in (property_checks, calibration_checks, record_checks, result_checks, extension_checks)
    for check in part.CHECKS.checks
)
"""All checks, in the order of the standard."""


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

    def as_builtins(self) -> dict[str, Any]:
        """Give it as plain values."""
        checks = [
            {
                "id": finding.check.id,
                "verdict": str(finding.verdict),
                "basis": str(finding.check.basis),
                "location": finding.check.location,
                "title": finding.check.title,
                "english": finding.check.quote.english,
                "chinese": finding.check.quote.chinese,
                "seen": [asdict(seen) for seen in finding.seen],
            }
            for finding in self.findings
        ]
        return {"address": self.address, "passed": self.passed, "counts": self.counts, "checks": checks}

    @staticmethod
    def check_name(path: Path) -> None:
        """Check that a report can be written into a file of that name.

        Raises:
            OptionError: its suffix is none of .json, .md and .html.
        """
        if path.suffix.lower() not in _FORMATS:
            raise OptionError(f"report {path}; expected a name that ends with one of {', '.join(_FORMATS)}")

    def write(self, path: Path, *, overwrite: bool = False) -> None:
        """Write a report in the format that the file's suffix says.

        Raises:
            OptionError: the suffix is none of .json, .md and .html.
            OutputError: the file exists already, or cannot be written.
        """
        self.check_name(path)
        text = _FORMATS[path.suffix.lower()](self)
        with replacing(path, overwrite=overwrite) as draft:
            draft.write_text(text, "utf-8")


def chosen(ids: Iterable[str]) -> tuple[Check, ...]:
    """The checks with these ids, or whose clause or table they name ("5.4", "T9"); all where none are stated.

    Raises:
        OptionError: there is none of that name.
    """
    wanted = set(ids)
    names = {check.id: {check.id, check.id.split("-")[0]} for check in CHECKS}
    unknown = sorted(wanted - set().union(*names.values()))
    if unknown:
        parts = ", ".join(dict.fromkeys(check.id.split("-")[0] for check in CHECKS))
        raise OptionError(f"check {unknown[0]!r}; there are those of {parts}, each with -1, -2, …")
    return tuple(check for check in CHECKS if not wanted or wanted & names[check.id])


def examine(
    transport: Transport, *, address: str = "", only: Iterable[str] = (), progress: Progress | None = None
) -> Examination:
    """Run checks against a server, each in sessions of its own that are ended after it.

    Args:
        only: ids of checks, or of clauses and tables; all where none are stated.
        progress: called with how many checks are done, and of how many.

    Raises:
        OptionError: there is no such check.
    """
    checks = chosen(only)
    bench = Bench(transport, f"conformance-{secrets.token_hex(4)}")
    return Examination(address, tuple(_run(check, bench) for check in reporting(checks, progress, len(checks))))


def _run(check: Check, bench: Bench) -> Finding:
    seen = tuple(check.seen(bench))
    passed = bool(seen) and all(each.agrees for each in seen)
    return Finding(check, Verdict.PASSED if passed else Verdict.FAILED, seen)


def _markdown_lines(examination: Examination) -> Iterator[str]:
    """A table of all checks, and what was found by those that failed."""
    yield f"# DB34/T 4101-2022: conformance of {examination.address or 'a server'}\n"
    yield f"{_summary(examination)}\n"
    yield "| check | verdict | basis | location | what has to be so |"
    yield "| --- | --- | --- | --- | --- |"
    for finding in examination.findings:
        check = finding.check
        yield _table_row((check.id, str(finding.verdict), str(check.basis), check.location, check.title))
    for finding in examination.findings:
        if finding.failures:
            check = finding.check
            yield f"\n## {check.id}: {check.title}"
            yield f"> {check.quote.english}\n>\n> {check.quote.chinese}\n"
            yield "| sent | expected | found |"
            yield "| --- | --- | --- |"
            for seen in finding.failures:
                yield _table_row((seen.sent, seen.expected, seen.found))


def _table_row(cells: Iterable[str]) -> str:
    """A row of a table, whatever a server wrote into its cells."""
    reported = (" ".join(escape(cell, quote=False).replace("|", "&#124;").split()) for cell in cells)
    return f"| {' | '.join(reported)} |"


def _as_html(examination: Examination) -> str:
    """Give an examination as one page without anything from elsewhere: each check opens to what it saw."""
    rows = "\n".join(_html_of(finding) for finding in examination.findings)
    title = f"DB34/T 4101-2022: conformance of {escape(examination.address or 'a server')}"
    return (
        f'<!doctype html>\n<html lang="en">\n<meta charset="utf-8">\n<title>{title}</title>\n<style>{_STYLE}</style>\n'
        f"<h1>{title}</h1>\n<p>{escape(_summary(examination))}</p>\n{rows}\n</html>\n"
    )


_STYLE = (
    "body{font:15px/1.45 sans-serif;max-width:75em;margin:2em auto;padding:0 1em}"
    "summary{padding:.2em 0}.failed summary{color:#a00;font-weight:bold}.passed summary{color:#060}"
    "table{border-collapse:collapse;margin:.5em 0 1em 1.5em}td,th{border:1px solid #ccc;padding:.2em .5em;"
    "text-align:left;vertical-align:top}.no td{background:#fee}blockquote{margin:.3em 0 .3em 1.5em;color:#444}"
)


def _html_of(finding: Finding) -> str:
    check = finding.check
    rows = "".join(
        f"<tr{'' if seen.agrees else ' class=no'}>"
        + "".join(f"<td>{escape(cell)}</td>" for cell in (seen.sent, seen.expected, seen.found))
        + "</tr>"
        for seen in finding.seen
    )
    opened = " open" if finding.failures else ""
    return (
        f'<details class="{finding.verdict}"{opened}><summary>{check.id} {finding.verdict}: {escape(check.title)}'
        f"</summary><blockquote>{escape(check.location)} ({check.basis})<br>{escape(check.quote.english)}"
        f'<br><span lang="zh">{escape(check.quote.chinese)}</span></blockquote>'
        f"<table><tr><th>sent<th>expected<th>found</tr>{rows}</table></details>"
    )


def _summary(examination: Examination) -> str:
    reported = ", ".join(f"{count} {verdict}" for verdict, count in examination.counts.items())
    return f"{len(examination.findings)} checks: {reported}"


_FORMATS: Mapping[str, Callable[[Examination], str]] = {
    ".json": lambda examination: json.dumps(examination.as_builtins(), indent=2, ensure_ascii=False) + "\n",
    ".md": lambda examination: "\n".join(_markdown_lines(examination)) + "\n",
    ".html": _as_html,
}  # by the suffix of the file


class GrpcTransport:
    """Calls over a gRPC channel, with stubs made from the service's descriptor. Use it in `with`, or close it.

    Attributes:
        channel: the connection.
    """

    def __init__(self, channel: grpc.Channel, *, metadata: tuple[tuple[str, str], ...] = ()) -> None:
        """Make the stubs; nothing is sent yet."""
        self.channel = channel
        self._metadata = metadata
        self._calls = calls_of(channel)

    @classmethod
    def connected(
        cls,
        address: str,
        *,
        ca: Path | None = None,
        token_file: Path | None = None,
        certificate: tuple[Path, Path] | None = None,
    ) -> "GrpcTransport":
        """Connect to a server.

        Args:
            ca: file of the certificate (PEM) that the server's is signed with; None for no encryption.
            token_file: file of the bearer token; None for none.
            certificate: files (PEM) of the certificate and the key that the kit shows to servers that ask.

        Raises:
            NobodyAnswersError: no server answers there, or it does not let the kit in.
            OptionError: there is a token, but no encryption to keep it secret on the way to another machine.
            DataError: a file holds no token, or no certificate.
            OSError: a file cannot be read.
        """
        token = None if token_file is None else read_token(token_file)
        channel = open_channel(address, ca=ca, certificate=certificate, token=token)
        try:
            grpc.channel_ready_future(channel).result(timeout=PATIENCE_S / 3)
        except grpc.FutureTimeoutError:
            channel.close()
            advice = "is it running, and are both sides with or both without TLS (--ca)?"
            raise NobodyAnswersError(f"{address}: no server answers there; {advice}") from None
        metadata = () if token is None else (("authorization", f"Bearer {token}"),)
        transport = cls(channel, metadata=metadata)
        try:
            transport.call("CloseSession", fusion_pb2.CloseSessionRequest(session="conformance-knocks"))
        except CallFailedError as error:
            if error.code in _SHUT:
                channel.close()
                reported = "state the token that it was started with (--token-file)"
                raise NobodyAnswersError(f"{address}: {error.code}: {error.details}; {reported}") from None
        return transport

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.channel.close()

    def call(self, method: str, request: Message | Iterator[Message]) -> Any:
        """Call a method that gives one message."""
        try:
            return self._calls[method](request, timeout=PATIENCE_S, metadata=self._metadata)
        except grpc.RpcError as error:
            raise _reported(error) from error

    def send_stream(self, requests: Iterable[Message]) -> Any:
        """Call SendStream."""
        return self.call("SendStream", iter(list(requests)))

    def subscribe(self, request: Message) -> Iterator[Any]:
        """Call Subscribe."""
        try:
            yield from self._calls["Subscribe"](request, timeout=PATIENCE_S, metadata=self._metadata)
        except grpc.RpcError as error:
            raise _reported(error) from error

    def health(self, service: str) -> str:
        """Ask the health service how a service is, by its full name, or "" for all: SERVING and so on.

        Source: the gRPC health checking protocol, github.com/grpc/grpc/blob/master/doc/health-checking.md.
        """
        call = self.channel.unary_unary(
            "/grpc.health.v1.Health/Check",
            request_serializer=health_pb2.HealthCheckRequest.SerializeToString,
            response_deserializer=reader_of(health_pb2.HealthCheckResponse),
        )
        request = health_pb2.HealthCheckRequest(service=service)
        try:
            reply = call(request, timeout=PATIENCE_S, metadata=self._metadata)
        except grpc.RpcError as error:
            raise _reported(error) from error
        name: str = health_pb2.HealthCheckResponse.ServingStatus.Name(reply.status)
        return name

    def services(self) -> set[str]:
        """Ask by reflection for the full names of the services."""
        reply = self._reflected(reflection_pb2.ServerReflectionRequest(list_services=""))
        return {service.name for service in reply.list_services_response.service}

    def files_with(self, symbol: str) -> list[bytes]:
        """Ask by reflection for the descriptors of the file that describes a symbol, perhaps with its imports."""
        reply = self._reflected(reflection_pb2.ServerReflectionRequest(file_containing_symbol=symbol))
        return list(reply.file_descriptor_response.file_descriptor_proto)

    def _reflected(self, request: Message) -> Any:
        """Ask the reflection service of either version (github.com/grpc/grpc/blob/master/doc/server-reflection.md)."""
        failed: CallFailedError | None = None
        for version in ("v1", "v1alpha"):
            call = self.channel.stream_stream(
                f"/grpc.reflection.{version}.ServerReflection/ServerReflectionInfo",
                request_serializer=reflection_pb2.ServerReflectionRequest.SerializeToString,
                response_deserializer=reader_of(reflection_pb2.ServerReflectionResponse),
            )
            try:
                replies = list(call(iter([request]), timeout=PATIENCE_S, metadata=self._metadata))
            except grpc.RpcError as error:
                failed = _reported(error)
                if failed.code != "UNIMPLEMENTED":
                    break
            else:
                return _only(replies)
        raise failed or CallFailedError("UNIMPLEMENTED", "")


def _reported(error: Any) -> CallFailedError:
    return CallFailedError(error.code().name, details_of(error))


def _only(replies: list[Any]) -> Any:
    if len(replies) != 1:
        raise CallFailedError("INTERNAL", f"{len(replies)} answers to one question of reflection")
    if replies[0].HasField("error_response"):
        error = replies[0].error_response
        raise CallFailedError(f"code {error.error_code}", error.error_message)
    return replies[0]


_SHUT = ("UNAUTHENTICATED", "PERMISSION_DENIED")
"""Answered to who does not show the token: it would fail every check alike."""


class NobodyAnswersError(SceneloomError):
    """No server answers at an address, or it does not let the kit in."""


PATIENCE_S = 30.0
"""How long an answer may take."""
