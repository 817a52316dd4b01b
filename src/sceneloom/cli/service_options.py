"""The options of the verbs that call a service."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

if TYPE_CHECKING:
    from sceneloom.service.client import FusionClient

Command = TypeVar("Command", bound=Callable[..., Any])
_FILE = click.Path(path_type=Path, exists=True, dir_okay=False)

_OPTIONS = (
    click.option(
        "--session", default="", metavar="NAME", help="The rig. [default: the service's default one]"
    ),
    click.option("--token-file", type=_FILE, help="File with the token that the service asks for."),
    click.option("--ca", type=_FILE, help="PEM file: who signed the service's certificate; for TLS."),
    click.option("--client-cert", type=_FILE, help="PEM file: a certificate to show, where it is asked for."),
    click.option("--client-key", type=_FILE, help="PEM file: its key."),
)


def calling(command: Command) -> Command:
    """On every verb that calls a service."""
    return reduce(lambda inner, option: option(inner), reversed(_OPTIONS), command)


@contextmanager
def connected(
    address: str,
    *,
    session: str,
    token_file: Path | None,
    ca: Path | None,
    client_cert: Path | None,
    client_key: Path | None,
) -> Iterator[Callable[[str], "FusionClient"]]:
    """Give what opens clients of sessions; all are closed in the end. The name "" stands for the chosen session."""
    if (client_cert is None) != (client_key is None):
        raise click.UsageError("--client-cert and --client-key belong together")
    from sceneloom.service.client import FusionClient
    from sceneloom.service.security import read_token

    token = None if token_file is None else read_token(token_file)
    certificate = None if client_cert is None or client_key is None else (client_cert, client_key)
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
