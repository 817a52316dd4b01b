"""The options of the verbs that call a service."""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from sceneloom.cli import options

if TYPE_CHECKING:
    from sceneloom.service.client import FusionClient

Command = TypeVar("Command", bound=Callable[..., Any])
_ADDRESS = re.compile(r"unix:.+|(dns:.*)?([^:\s]+|\[[0-9A-Fa-f:.]+\]):[0-9]{1,5}")
_FILE = options.source(exists=True, dir_okay=False)

_DOORS = (
    click.option("--token-file", type=_FILE, help="File with the token that the service asks for."),
    click.option("--ca", type=_FILE, help="PEM file: who signed the service's certificate; for TLS."),
    click.option("--client-cert", type=_FILE, help="PEM file: a certificate to show, where it is asked for."),
    click.option("--client-key", type=_FILE, help="PEM file: its key."),
)


def host_and_port(text: str) -> str:
    """Take an argument as the address of a service: without a port gRPC would try 443."""
    if _ADDRESS.fullmatch(text) is None:
        raise click.BadParameter(f"{text!r}; expected HOST:PORT, such as 127.0.0.1:50051")
    return text


def let_in(command: Command) -> Command:
    """On every verb that reaches a service."""
    return reduce(lambda inner, option: option(inner), reversed(_DOORS), command)


def calling(command: Command) -> Command:
    """On every verb that works in a session of a service."""
    session = click.option(
        "--session", default="", metavar="NAME", help="The rig. [default: the service's default one]"
    )
    return session(let_in(command))


def certificate_of(client_cert: Path | None, client_key: Path | None) -> tuple[Path, Path] | None:
    """Give the certificate that a client shows, with its key; None for none."""
    if client_cert is not None and client_key is not None:
        return client_cert, client_key
    if client_cert is None and client_key is None:
        return None
    raise click.UsageError("--client-cert and --client-key belong together")


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
    certificate = certificate_of(client_cert, client_key)
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
