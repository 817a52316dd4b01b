"""Properties whose text is JSON: what they hold, and the sensors that they are of."""

from typing import Any

import msgspec

from sceneloom.errors import DataError


def read_json(text: str, owner: str) -> Any:
    """Read the text of a property; None for an empty one.

    Raises:
        DataError: it is no JSON.
    """
    if not text.strip():
        return None
    try:
        return msgspec.json.decode(text)
    except (msgspec.DecodeError, RecursionError) as error:
        raise DataError(owner, "", f"no JSON: {error}") from error


def read_by_sensor(text: str, owner: str, example: str) -> dict[int, Any]:
    """Read the text of a property that says something of each sensor: an object whose names are numbers of sensors.

    Args:
        example: what such an object looks like.

    Raises:
        DataError: it is none, or a name is no number from 0 to 255.
    """
    found = read_json(text, owner)
    if found is None:
        return {}
    if not isinstance(found, dict):
        raise DataError(owner, "", f"{text[:40]!r}; expected an object as {example}")
    return {sensor_id_of(int(name) if _is_number(name) else name, owner, name): found[name] for name in found}


def sensor_id_of(value: Any, owner: str, location: str) -> int:
    """Give the number of a sensor.

    Raises:
        DataError: it is no whole number from 0 to 255.
    """
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= 255:
        raise DataError(owner, location, f"{value!r}; expected a number of a sensor, 0 to 255")
    return value


def _is_number(name: str) -> bool:
    return name.isascii() and name.isdigit() and len(name) <= 3
