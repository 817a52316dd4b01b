"""A fusion service: `sceneloom serve`, data sent to it, results fetched from it, and its conformance checked."""

import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import groupby, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import msgspec

from sceneloom.cli import options
from sceneloom.cli.help import Verb
from sceneloom.cli.options import option
from sceneloom.cli.printing import Printer, print_json
from sceneloom.cli.running import reading_verb, verb
from sceneloom.errors import OptionError

if TYPE_CHECKING:
    from sceneloom.db34t.conformance.catalogue import Check
    from sceneloom.db34t.conformance.examination import Examination
    from sceneloom.db34t.events import Result
    from sceneloom.service.client import FusionClient
    from sceneloom.service.sending import SendReport
    from sceneloom.service.server import FusionServer

_ADDRESS = re.compile(r"unix:.+|(dns:.*)?([^:\s]+|\[[0-9A-Fa-f:.]+\]):[0-9]{1,5}")
_FILE = options.source(exists=True, dir_okay=False)
_PORT = click.IntRange(0, 65535)


# serve


@click.command(cls=Verb, examples=("--port 50051", "--config service.toml"))
@option("--config", "TOML file: properties, sensors and calibrations of new sessions, limits.", _FILE)
@option("--host=ADDRESS", "Address; others need TLS and a token.", default="127.0.0.1")
@option("--port", "Port; 0 for a free one.", _PORT, default=0)
@option("--tls-cert", "PEM file: the server's certificate.", _FILE)
@option("--tls-key", "PEM file: its key.", _FILE)
@option("--tls-client-ca", "PEM file: who signs the certificates that clients must show.", _FILE)
@option("--token-file", "File with the token that clients must show.", _FILE)
@option("--metrics-port", "Answer `GET /metrics` here, for Prometheus on this machine.", _PORT)
@option("--max-sessions", "Sessions at once. [default: 16]", click.IntRange(min=1))
@option("--idle-minutes", "End sessions that were unused for so long. [default: 30]", options.positive)
@option(
    "--log",
    "MCAP file for the session log: all that comes in and goes out.",
    click.Path(path_type=Path, dir_okay=False),
)
@option("--overwrite", "Replace the log if it exists.")
@option("--json as_json", "Print the address as JSON.")
@option("-q --quiet", "Log warnings only.")
@option("-v --verbose", "Also log what helps to find faults.")
def serve(
    host: str, port: int, log: Path | None, as_json: bool, quiet: bool, verbose: bool, overwrite: bool, **given: Any
) -> None:
    """Serve the fusion interface of DB34/T 4101-2022 over gRPC, until it is told to end.

    The first start on a machine compiles for minutes, and logs what; the port is closed until then.
    """
    from sceneloom.service.startup import check_port, log_to_standard_error

    check_port(host, port)
    log_to_standard_error(quiet=quiet, verbose=verbose)

    with ExitStack() as stack:
        from sceneloom.db34t.transport import Security, read_token
        from sceneloom.service.running import configured, serve_until_ended
        from sceneloom.service.server import ServerSettings

        stated = options.stated(most_sessions=given["max_sessions"], idle_minutes=given["idle_minutes"])
        limits, configure = configured(given["config"], **stated)
        security = Security(
            tls_certificate=given["tls_cert"],
            tls_key=given["tls_key"],
            tls_client_authority=given["tls_client_ca"],
            token=None if given["token_file"] is None else read_token(given["token_file"]),
        )
        security.check_host(host)
        observe: Any = None
        if log is not None:
            from sceneloom.service.session_log import SessionLog

            observe = stack.enter_context(SessionLog(log, overwrite=overwrite)).session
        address: dict[str, Any] = {"host": host, "port": port, "metrics_port": given["metrics_port"]}
        settings = ServerSettings(**address, limits=limits, security=security, configure=configure, observe=observe)

        def started(server: "FusionServer") -> None:
            if as_json:
                metrics_port = server.metrics_port or None
                print_json({"address": server.address, "port": server.port, "metrics_port": metrics_port})
                return
            click.echo(f"serving at {server.address}")
            if server.metrics_port:
                click.echo(f"metrics at http://127.0.0.1:{server.metrics_port}/metrics")

        hanging = serve_until_ended(settings, started=started, quiet=quiet, verbose=verbose)
    if hanging:  # the process ends at once: threads that hang would keep it for ever
        reported = f"left with the fusion of {', '.join(hanging)} hanging; what waited there is lost"
        click.echo(f"Error: {reported}", err=True)
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(1)


# the options of clients


def _host_and_port(text: str) -> str:
    """Take an argument as the address of a service: without a port gRPC would try 443."""
    if _ADDRESS.fullmatch(text) is None:
        raise click.BadParameter(f"{text!r}; expected HOST:PORT, such as 127.0.0.1:50051")
    return text


_access = options.stacked(
    option("--token-file", "File with the token that the service asks for.", _FILE),
    option("--ca", "PEM file: who signed the service's certificate; for TLS.", _FILE),
    option("--client-cert", "PEM file: a certificate to show, where it is asked for.", _FILE),
    option("--client-key", "PEM file: its key.", _FILE),
)  # on every verb that reaches a service
_calling = options.stacked(
    _access, option("--session=NAME", "The session. [default: the service's default one]", default="")
)
_CALLING = ("session", "token_file", "ca", "client_cert", "client_key")  # the parameters that `_connected` takes


def _certificate(given: dict[str, Any]) -> tuple[Path, Path] | None:
    """The certificate that a client shows, with its key, taken out of the options; None for none."""
    certificate, key = given.pop("client_cert"), given.pop("client_key")
    if (certificate is None) is not (key is None):
        raise click.UsageError("--client-cert and --client-key belong together")
    return None if certificate is None else (certificate, key)


@contextmanager
def _connected(
    address: str, *, session: str, token_file: Path | None, ca: Path | None, **given: Any
) -> Iterator[Callable[[str], "FusionClient"]]:
    """Give what opens clients of sessions; all are closed in the end. The name "" stands for the chosen session."""
    certificate = _certificate(given)
    from sceneloom.db34t.transport import read_token
    from sceneloom.service.client import FusionClient

    token = None if token_file is None else read_token(token_file)
    opened: list[FusionClient] = []

    def open_client(name: str) -> FusionClient:
        client = FusionClient(address, token=token, ca=ca, certificate=certificate, session=name or session)
        opened.append(client)
        return client

    try:
        yield open_client
    finally:
        for client in opened:
            client.close()


# send


@click.command(cls=Verb, examples=("drive/ 127.0.0.1:50051", "drive/ 127.0.0.1:50051 --rate 0"))
@click.argument("path", type=options.location)
@click.argument("address", type=_host_and_port, metavar="HOST:PORT")
@option(
    "--rate=N",
    "Speed: 1 for real time, 2 for twice that, 0 for as fast as the service accepts it.",
    options.not_negative,
    default=1.0,
)
@options.trajectory(options.STATIONARY)
@options.part
@_calling
@reading_verb
def send(path: Path | str, address: str, rate: float, printer: Printer, reading: dict[str, Any], **given: Any) -> None:
    """Send a drive to a fusion service as its sensors would have sent it, or replay a session log of `serve --log`."""
    from sceneloom.service.session_log import is_log

    calls = {name: given.pop(name) for name in _CALLING}
    session = calls["session"]
    with _connected(address, **calls) as open_client, printer.progress("sending") as progress:
        if isinstance(path, Path) and is_log(path):
            for name in options.stated(**given):
                raise click.UsageError(f"--{name} says nothing of a log, which is sent as it is")
            from sceneloom.service.sending import send_log

            report = send_log(path, lambda name: open_client(session or name.replace("#", "-")), rate=rate)
        else:
            from sceneloom.formats.base.registry import open_scene
            from sceneloom.scene.time_range import cut_scene
            from sceneloom.service.sending import send_scene

            with open_scene(path, **reading) as scene:
                report = send_scene(
                    cut_scene(scene, start=given.pop("start"), stop=given.pop("stop")),
                    open_client(""),
                    rate=rate,
                    lenient="lenient" in reading,
                    progress=progress,
                    **given,
                )
    printer.show(report, _print_sent, address)


def _print_sent(report: "SendReport", address: str, printer: Printer) -> None:
    sent = ", ".join(f"{count} {kind}" for kind, count in report.sent.items()) or "nothing"
    click.echo(f"{report.source}: sent {sent} to {address} in {report.seconds:.1f} s")
    if report.sensors:
        click.echo("numbered: " + ", ".join(f"{name} is {number}" for name, number in report.sensors.items()))
    refused = ", ".join(f"{count} {cause}" for cause, count in report.refused.items())
    click.echo(f"refused: {refused or 'none'}")
    printer.warnings(report.warnings)


# get


_TYPES = {"sensor": 0, "detection": 1}


@click.command(
    cls=Verb,
    examples=("127.0.0.1:50051 --type sensor --follow -o fused/", "127.0.0.1:50051 --type detection --count 10"),
)
@click.argument("address", type=_host_and_port, metavar="HOST:PORT")
@option("--type kind", "Which fusion.", list(_TYPES), required=True)
@option(
    "-o --output",
    "Of detections a file of JSON lines; of sensor data a folder for depth images, images and points, or a "
    "scene file (.sfs) for the coloured points. [default: a line each on standard output]",
    options.target,
)
@options.overwrite
@option("--count=N", "End after N results.", click.IntRange(min=1))
@option("--follow", "Go on until the session ends, or Ctrl-C.")
@option("--track", "With --follow: follow objects from sweep to sweep, by id.")
@option("--wait=S", "Wait up to S seconds for each result.", options.not_negative, default=0.0)
@_calling
@verb
def get(
    address: str, kind: str, output: Path | None, overwrite: bool, follow: bool, printer: Printer, **given: Any
) -> None:
    """Fetch results from a fusion service: those that are there, or as they come."""
    count, track, wait = (given.pop(name) for name in ("count", "track", "wait"))
    if track and (kind != "detection" or not follow):
        raise click.UsageError("--track needs --type detection and --follow")
    from sceneloom.service.result_files import described, open_sink

    def has_received(client: "FusionClient") -> bool:
        """Whether anything was sent to the session, whatever became of it: the service begins one with any name."""
        return any(name.startswith(("received.", "refused.")) for name in client.counters())

    def results(client: "FusionClient") -> "Iterator[Result]":
        if follow:
            return client.subscribe(_TYPES[kind], most=count or 0, track=track)
        return islice(iter(lambda: client.get(_TYPES[kind], timeout_s=wait), None), count)

    fetched = 0
    with _connected(address, **given) as open_client, ExitStack() as stack:
        sink = None
        if output is not None:
            sink = stack.enter_context(open_sink(output, detections=kind == "detection", overwrite=overwrite))
        try:
            client = open_client("")
            session = f"session {client.session or 'default'!r}"
            if follow and not printer.quiet and not has_received(client):
                click.echo(f"{session} has received no records yet; waiting", err=True)
            for result in results(client):
                fetched += 1
                if sink is not None:
                    sink.add(result)
                elif not printer.as_json:
                    click.echo(msgspec.json.encode(described(result)).decode())
        except KeyboardInterrupt:
            if not printer.quiet:
                click.echo("stopped; what was fetched is kept", err=True)
        else:
            if not follow and not fetched and not has_received(client):
                problem = "has received no records; expected one that data were sent to (--session)"
                raise OptionError(f"{session} {problem}")
    if printer.as_json:
        written = None if output is None else str(output)
        print_json({"address": address, "type": kind, "results": fetched, "output": written})
    elif output is not None:
        click.echo(f"{fetched} results of {kind} fusion: {output}")


# conformance


@click.command(cls=Verb, examples=("127.0.0.1:50051", "127.0.0.1:50051 --only T9 --report report.html"))
@click.argument("address", type=_host_and_port, metavar="HOST:PORT", required=False)
@option("--report=FILE", "Write all that was sent, expected and found to a .json, .md or .html file.", options.target)
@options.overwrite
@option("--only=ID…", "Run this check (5.4-3), or those of a clause or table (5.4, T9); may be repeated.")
@option("--checks list_checks", "List the checks and stop.")
@_access
@verb
def conformance(
    address: str | None,
    report: Path | None,
    overwrite: bool,
    only: tuple[str, ...],
    list_checks: bool,
    printer: Printer,
    **given: Any,
) -> None:
    """Check a fusion service against DB34/T 4101-2022, clause by clause and row by row; exit 1 where a check fails.

    Any server of the project's .proto can be checked, whoever wrote it. Each check works in a session of its own,
    which is ended after it.
    """
    from sceneloom.db34t.conformance.examination import Examination, GrpcTransport, chosen, examine
    from sceneloom.formats.base.output import check_output

    checks = chosen(only)
    if list_checks:
        _print_checks(checks, printer)
        return
    if address is None:
        raise click.UsageError("Missing argument 'HOST:PORT'.", click.get_current_context())
    access = {"ca": given["ca"], "token_file": given["token_file"], "certificate": _certificate(given)}
    if report is not None:
        Examination.check_name(report)
        check_output(report, overwrite=overwrite)
    with GrpcTransport.connected(address, **access) as transport, printer.progress("checking") as progress:
        examination = examine(transport, address=address, only=only, progress=progress)
    if report is not None:
        examination.write(report, overwrite=overwrite)
    if printer.as_json:
        print_json(examination.as_builtins())
    else:
        _print_examination(examination, verbose=printer.verbose, report=report)
    if not examination.passed:
        click.get_current_context().exit(1)


def _print_checks(checks: "tuple[Check, ...]", printer: Printer) -> None:
    if printer.as_json:
        print_json(
            [
                {
                    "id": check.id,
                    "location": check.location,
                    "title": check.title,
                    "basis": str(check.basis),
                    "english": check.quote.english,
                    "chinese": check.quote.chinese,
                }
                for check in checks
            ]
        )
        return
    for check in checks:
        click.echo(f"{check.id:8} {check.title} ({check.basis}: {check.location})")


def _print_examination(examination: "Examination", *, verbose: bool, report: Path | None) -> None:
    shown = [finding for finding in examination.findings if verbose or finding.failures]
    for part, findings in groupby(shown, key=lambda finding: finding.check.id.split("-")[0]):
        click.echo(part)
        for finding in findings:
            check = finding.check
            click.echo(f"  {check.id:7} {finding.verdict}  {check.title} ({check.location})")
            if finding.failures:
                click.echo(f"          {check.quote.english}\n          {check.quote.chinese}")
            for seen in finding.failures:
                click.echo(f"          sent {seen.sent}: expected {seen.expected}, found {seen.found}")
    counts = ", ".join(f"{count} {verdict}" for verdict, count in examination.counts.items())
    click.echo(f"{examination.address}: {len(examination.findings)} checks: {counts}")
    if report is not None:
        click.echo(f"written: {report}")
