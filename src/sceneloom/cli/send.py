"""`sceneloom send`."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options
from sceneloom.cli.printing import print_json, print_warnings, progress_bar
from sceneloom.cli.service_options import calling, connected, host_and_port

if TYPE_CHECKING:
    from sceneloom.service.sending import SendReport

_CALLING = ("session", "token_file", "ca", "client_cert", "client_key")


@click.command()
@click.argument("path", type=options.location)
@click.argument("address", type=host_and_port, metavar="HOST:PORT")
@click.option(
    "--rate",
    type=options.not_negative,
    default=1.0,
    show_default=True,
    metavar="N",
    help="1: as fast as it was, 2: twice as fast, 0: as fast as the service takes it.",
)
@options.trajectory(further="`identity`: it was stationary")
@options.part
@calling
@options.reading
@options.printing
def send(
    path: Path | str,
    address: str,
    rate: float,
    trajectory: str | None,
    heading: str | None,
    start: float | None,
    stop: float | None,
    as_json: bool,
    quiet: bool,
    verbose: bool,
    lenient: bool,
    **further: Any,
) -> None:
    """Send a drive to a fusion service as its sensors would have sent it; or a log of `serve --log` once more."""
    from sceneloom.service.session_log import is_log

    calls = {name: further.pop(name) for name in _CALLING}
    with connected(address, **calls) as open_client, progress_bar("sending", quiet=quiet) as progress:
        if isinstance(path, Path) and is_log(path):
            stated = options.stated(trajectory=trajectory, heading=heading, start=start, stop=stop)
            report = _send_log(path, open_client, rate, calls["session"], stated)
        else:
            from sceneloom.formats.base.registry import open_scene
            from sceneloom.scene.time_range import cut_scene
            from sceneloom.service.sending import send_scene

            with open_scene(path, **options.stated(lenient=lenient, **further)) as scene:
                report = send_scene(
                    cut_scene(scene, start=start, stop=stop),
                    open_client(""),
                    rate=rate,
                    trajectory=trajectory,
                    heading=heading,
                    lenient=lenient,
                    progress=progress,
                )
    if as_json:
        print_json(report)
    else:
        _print_report(report, address)
        if not quiet:
            print_warnings(report.warnings, verbose=verbose)


def _send_log(
    path: Path, open_client: Any, rate: float, session: str, stated: dict[str, Any]
) -> "SendReport":
    if stated:
        raise click.UsageError(f"--{next(iter(stated))} says nothing of a log, which is sent as it is")
    from sceneloom.service.sending import send_log

    return send_log(path, lambda name: open_client(session or name.replace("#", "-")), rate=rate)


def _print_report(report: "SendReport", address: str) -> None:
    sent = ", ".join(f"{count} {kind}" for kind, count in report.sent.items()) or "nothing"
    click.echo(f"{report.source}: sent {sent} to {address} in {report.seconds:.1f} s")
    if report.sensors:
        click.echo("numbered: " + ", ".join(f"{name} is {number}" for name, number in report.sensors.items()))
    refused = ", ".join(f"{count} {cause}" for cause, count in report.refused.items())
    click.echo(f"refused: {refused or 'none'}")
