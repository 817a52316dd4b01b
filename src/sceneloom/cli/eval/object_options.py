"""What both evaluations of objects take: two sides, classes, sequences, an image."""

from collections.abc import Callable
from functools import reduce
from typing import Any, TypeVar

import click

from sceneloom.cli import options

Command = TypeVar("Command", bound=Callable[..., Any])


def share(number: str | float) -> float:
    """Take a value as a number above 0, at most 1."""
    try:
        value = float(number)
    except ValueError as error:
        raise click.BadParameter(f"{number!r} is no number") from error
    if not 0.0 < value <= 1.0:
        raise click.BadParameter(f"{number}; expected a number above 0, at most 1")
    return value


_OPTIONS: tuple[Callable[[Any], Any], ...] = (
    click.argument("results", type=options.location, metavar="RESULTS"),
    click.argument("truth", type=options.location, metavar="TRUTH"),
    click.option(
        "--class",
        "classes",
        multiple=True,
        metavar="NAME",
        help="A class to evaluate; may be stated again. [default: KITTI's of the truth; of scenes all]",
    ),
    click.option(
        "--sequence",
        "sequences",
        multiple=True,
        metavar="NAME",
        help="A sequence to take, such as 0003; may be stated again of KITTI's text. [default: all of the truth]",
    ),
    click.option(
        "-o",
        "--plot",
        type=options.target,
        metavar="OUT.png",
        help="Draw the curves (.png, .svg, .pdf; needs sceneloom[report]).",
    ),
    click.option("--overwrite", is_flag=True, help="Replace an image that exists."),
    click.option(
        "--no-corrections",
        "corrections",
        is_flag=True,
        flag_value="ignore",
        default=None,
        help="Of scenes, compare without their localization adjustments. [default: apply them]",
    ),
    click.option("--lenient", is_flag=True, help="Skip what is broken, count it, and go on."),
)


def sides_to_compare(command: Command) -> Command:
    """Give a verb RESULTS, TRUTH and what is to be stated of both."""
    return reduce(lambda inner, option: option(inner), reversed(_OPTIONS), command)
