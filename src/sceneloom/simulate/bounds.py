"""The check that the numbers of a synthetic device can be."""

from collections.abc import Iterable, Iterator, Sequence

from sceneloom.errors import OptionError


def check_bounds(device: str, bounds: Iterable[tuple[str, float, float, float]]) -> None:
    """Check numbers against the least and the greatest that each may be.

    Args:
        device: what they belong to, for the message.
        bounds: name, value, least, greatest.

    Raises:
        OptionError: one is out of bounds, or not a number.
    """
    for name, value, low, high in bounds:
        if not low <= value <= high:
            raise OptionError(f"{device}.{name}: {value}; expected {low} to {high}")


def each_of(
    name: str, values: Sequence[float], low: float, high: float
) -> Iterator[tuple[str, float, float, float]]:
    """Give the same bounds to each of several numbers, for `check_bounds`."""
    return ((f"{name}[{index}]", value, low, high) for index, value in enumerate(values))


def check_fan(device: str, name: str, fan_deg: tuple[float, float], limit_deg: float) -> None:
    """Check that a range of angles goes upwards and stays within `limit_deg` to either side [deg].

    Raises:
        OptionError: it does not.
    """
    low, high = fan_deg
    if not -limit_deg <= low < high <= limit_deg:
        raise OptionError(
            f"{device}.{name}: {fan_deg}; expected two rising angles within {limit_deg} degrees"
        )
