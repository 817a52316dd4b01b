"""`sceneloom get`."""

from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import msgspec

from sceneloom.cli import options
from sceneloom.cli.printing import print_json
from sceneloom.cli.service_options import calling, connected, host_and_port
from sceneloom.errors import OptionError

if TYPE_CHECKING:
    from sceneloom.db34t.queues import Result
    from sceneloom.service.client import FusionClient

_TYPES = {"sensor": 0, "detection": 1}


@click.command()
@click.argument("address", type=host_and_port, metavar="HOST:PORT")
@click.option("--type", "kind", type=click.Choice(list(_TYPES)), required=True, help="Which fusion.")
@click.option(
    "-o",
    "--output",
    type=options.target,
    help="Of detections a file of JSON lines; of sensor data a folder for depth images, images and points, or a "
    "scene file (.sfs) for the coloured points. [default: a line each on standard output]",
)
@click.option("--overwrite", is_flag=True, help="Replace outputs that exist.")
@click.option("--count", type=click.IntRange(min=1), metavar="N", help="End after N results.")
@click.option("--follow", is_flag=True, help="Go on until the session ends, or Ctrl-C.")
@click.option("--track", is_flag=True, help="With --follow: follow objects from sweep to sweep, by id.")
@click.option(
    "--wait",
    type=options.not_negative,
    default=0.0,
    metavar="S",
    help="Wait up to S seconds for each result.",
)
@calling
@options.printing
def get(
    address: str,
    kind: str,
    output: Path | None,
    overwrite: bool,
    count: int | None,
    follow: bool,
    track: bool,
    wait: float,
    as_json: bool,
    quiet: bool,
    verbose: bool,
    **calls: Any,
) -> None:
    """Fetch results from a fusion service: those that are there, or as they come."""
    if track and (kind != "detection" or not follow):
        raise click.UsageError("--track needs --type detection and --follow")
    from sceneloom.service.result_files import described, open_sink

    del verbose
    fetched: Counter[str] = Counter()
    with connected(address, **calls) as open_client, ExitStack() as stack:
        sink = None
        if output is not None:
            sink = stack.enter_context(open_sink(output, detections=kind == "detection", overwrite=overwrite))
        try:
            client = open_client("")
            if follow and not quiet and not _has_received(client):
                click.echo(f"session {_name(client)!r} has received no records yet; waiting", err=True)
            for result in _results(client, _TYPES[kind], count, wait, follow=follow, track=track):
                fetched[kind] += 1
                if sink is not None:
                    sink.add(result)
                elif not as_json:
                    click.echo(msgspec.json.encode(described(result)).decode())
        except KeyboardInterrupt:
            if not quiet:
                click.echo("stopped; what was fetched is kept", err=True)
        else:
            if not follow and not fetched[kind] and not _has_received(client):
                problem = (
                    f"session {_name(client)!r} has received no records; expected one that data were sent to"
                )
                raise OptionError(f"{problem} (--session)")
    summary = {"address": address, "type": kind, "results": fetched[kind], "output": output}
    if as_json:
        print_json(summary | {"output": None if output is None else str(output)})
    elif output is not None:
        click.echo(f"{fetched[kind]} results of {kind} fusion: {output}")


def _has_received(client: "FusionClient") -> bool:
    """Whether anything was sent to the session, whatever became of it: the service begins one with any name."""
    return any(name.startswith(("received.", "refused.")) for name in client.counters())


def _name(client: "FusionClient") -> str:
    return client.session or "default"


def _results(
    client: "FusionClient",
    fusion_type: int,
    count: int | None,
    wait_s: float,
    *,
    follow: bool,
    track: bool,
) -> "Iterator[Result]":
    if follow:
        yield from client.subscribe(fusion_type, most=count or 0, track=track)
        return
    fetched = 0
    while count is None or fetched < count:
        result = client.get(fusion_type, timeout_s=wait_s)
        if result is None:
            return
        fetched += 1
        yield result
