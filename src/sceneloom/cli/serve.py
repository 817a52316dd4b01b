"""`sceneloom serve`."""

from pathlib import Path

import click

from sceneloom.cli.options import positive, said
from sceneloom.cli.printing import print_json

_FILE = click.Path(path_type=Path, exists=True, dir_okay=False)


@click.command()
@click.option("--host", default="127.0.0.1", show_default=True, help="Address; others need TLS and a token.")
@click.option("--port", type=click.IntRange(0, 65535), default=0, help="Port. [default: a free one]")
@click.option("--tls-cert", type=_FILE, help="PEM file: the server's certificate.")
@click.option("--tls-key", type=_FILE, help="PEM file: its key.")
@click.option(
    "--tls-client-ca", type=_FILE, help="PEM file: who signs the certificates that clients must show."
)
@click.option("--token-file", type=_FILE, help="File with the token that clients must show.")
@click.option("--max-sessions", type=click.IntRange(min=1), help="Sessions at once. [default: 16]")
@click.option("--idle-minutes", type=positive, help="End unused sessions. [default: 30]")
@click.option("--json", "as_json", is_flag=True, help="Print the address as JSON.")
@click.option("-q", "--quiet", is_flag=True, help="Log warnings only.")
def serve(
    host: str,
    port: int,
    tls_cert: Path | None,
    tls_key: Path | None,
    tls_client_ca: Path | None,
    token_file: Path | None,
    max_sessions: int | None,
    idle_minutes: float | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Serve the fusion interface of DB34/T 4101-2022 over gRPC, until it is told to end."""
    from sceneloom.service.limits import ServiceLimits
    from sceneloom.service.running import serve_until_ended
    from sceneloom.service.security import Security, read_token
    from sceneloom.service.server import FusionServer, ServerSettings

    limits = ServiceLimits(**said(most_sessions=max_sessions, idle_minutes=idle_minutes))
    security = Security(
        tls_certificate=tls_cert,
        tls_key=tls_key,
        tls_client_authority=tls_client_ca,
        token=None if token_file is None else read_token(token_file),
    )

    def tell(server: FusionServer) -> None:
        if as_json:
            print_json({"address": server.address, "port": server.port})
        else:
            click.echo(f"serving at {server.address}")

    settings = ServerSettings(host=host, port=port, limits=limits, security=security)
    serve_until_ended(settings, started=tell, quiet=quiet)
