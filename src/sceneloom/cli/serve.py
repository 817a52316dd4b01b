"""`sceneloom serve`."""

import os
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click

from sceneloom.cli import options
from sceneloom.cli.options import positive, stated
from sceneloom.cli.printing import print_json

if TYPE_CHECKING:
    from sceneloom.service.server import FusionServer

_FILE = options.source(exists=True, dir_okay=False)
_PORT = click.IntRange(0, 65535)


@click.command()
@click.option(
    "--config", type=_FILE, help="TOML file: properties, sensors and calibrations of new sessions, limits."
)
@click.option("--host", default="127.0.0.1", show_default=True, help="Address; others need TLS and a token.")
@click.option("--port", type=_PORT, default=0, help="Port; 0 for a free one. [default: 0]")
@click.option("--tls-cert", type=_FILE, help="PEM file: the server's certificate.")
@click.option("--tls-key", type=_FILE, help="PEM file: its key.")
@click.option(
    "--tls-client-ca", type=_FILE, help="PEM file: who signs the certificates that clients must show."
)
@click.option("--token-file", type=_FILE, help="File with the token that clients must show.")
@click.option(
    "--metrics-port", type=_PORT, help="Answer `GET /metrics` here, for Prometheus on this machine."
)
@click.option("--max-sessions", type=click.IntRange(min=1), help="Sessions at once. [default: 16]")
@click.option(
    "--idle-minutes", type=positive, help="End sessions that nobody used for so long. [default: 30]"
)
@click.option(
    "--log",
    type=click.Path(path_type=Path, dir_okay=False),
    help="MCAP file: all that comes in and goes out.",
)
@click.option("--overwrite", is_flag=True, help="Replace the log if it exists.")
@click.option("--json", "as_json", is_flag=True, help="Print the address as JSON.")
@click.option("-q", "--quiet", is_flag=True, help="Log warnings only.")
@click.option("-v", "--verbose", is_flag=True, help="Log what helps to find faults, too.")
def serve(
    config: Path | None,
    host: str,
    port: int,
    tls_cert: Path | None,
    tls_key: Path | None,
    tls_client_ca: Path | None,
    token_file: Path | None,
    metrics_port: int | None,
    max_sessions: int | None,
    idle_minutes: float | None,
    log: Path | None,
    overwrite: bool,
    as_json: bool,
    quiet: bool,
    verbose: bool,
) -> None:
    """Serve the fusion interface of DB34/T 4101-2022 over gRPC, until it is reported to end.

    The first start on a machine compiles for minutes, and logs what; the port is closed until then.
    """
    from sceneloom.kernels.cache import reporting_compiling
    from sceneloom.service.startup import check_port, log_to_standard_error

    check_port(host, port)
    logger = log_to_standard_error(quiet=quiet, verbose=verbose)

    def report(module: str) -> None:
        logger.info("compiling for this machine; it is kept", extra={"fields": {"module": module}})

    with ExitStack() as stack:
        stack.enter_context(reporting_compiling(report))
        from sceneloom.db34t.transport import read_token
        from sceneloom.service.running import configured, serve_until_ended
        from sceneloom.service.server import Security, ServerSettings

        limits, configure = configured(
            config, **stated(most_sessions=max_sessions, idle_minutes=idle_minutes)
        )
        security = Security(
            tls_certificate=tls_cert,
            tls_key=tls_key,
            tls_client_authority=tls_client_ca,
            token=None if token_file is None else read_token(token_file),
        )
        security.check_host(host)
        observe: Any = None
        if log is not None:
            from sceneloom.service.session_log import SessionLog

            observe = stack.enter_context(SessionLog(log, overwrite=overwrite)).session
        settings = ServerSettings(
            host=host,
            port=port,
            metrics_port=metrics_port,
            limits=limits,
            security=security,
            configure=configure,
            observe=observe,
        )
        started = _print_json if as_json else _print
        hanging = serve_until_ended(settings, started=started, quiet=quiet, verbose=verbose)
    if hanging:
        _leave(hanging)


def _leave(hanging: tuple[str, ...]) -> NoReturn:
    """End the process at once: threads that hang would keep it for ever."""
    reported = f"left with the fusion of {', '.join(hanging)} hanging; what waited there is lost"
    click.echo(f"Error: {reported}", err=True)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(1)


def _print(server: "FusionServer") -> None:
    click.echo(f"serving at {server.address}")
    if server.metrics_port:
        click.echo(f"metrics at http://127.0.0.1:{server.metrics_port}/metrics")


def _print_json(server: "FusionServer") -> None:
    print_json({"address": server.address, "port": server.port, "metrics_port": server.metrics_port or None})
