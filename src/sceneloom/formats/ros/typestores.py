"""Types of ROS messages: as a bag defines them, else as a distribution of ROS does."""

from functools import cache
from typing import Any

from sceneloom.errors import MissingExtraError, OptionError, how_to_install
from sceneloom.formats.ros.bags import Connection
from sceneloom.formats.ros.definitions import DEFINITIONS

try:
    from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore
except ImportError as missing:
    raise MissingExtraError(f"{missing}; install the extra: {how_to_install('ros')}") from missing

USUAL_DISTRO = {"ros1": "noetic", "cdr": "humble"}
"""The distribution whose types are taken where nothing is said, by the encoding of messages."""


def distros() -> tuple[str, ...]:
    """The distributions whose types are known."""
    return tuple(store.value.partition("_")[2] for store in Stores if "_" in store.value)


@cache
def distro_store(distro: str) -> Any:
    """Give the types of a distribution, and those that it lacks.

    Raises:
        OptionError: there is no such distribution.
    """
    found = [store for store in Stores if store.value.partition("_")[2] == distro]
    if not found:
        raise OptionError(f"distro {distro!r}; expected one of {', '.join(distros())}")
    store = get_typestore(found[0])
    for name, text in DEFINITIONS.items():
        if name not in store.fielddefs:
            store.register(get_types_from_msg(text, name))
    return store


def store_of(connection: Connection, distro: str | None) -> Any:
    """Give the types that a connection's messages are read with: the bag's own definition counts.

    Raises:
        ValueError: the bag has no definition of the type, and the distribution does not know it either.
        OptionError: there is no such distribution.
    """
    if connection.definition:
        return _defined(connection.type, connection.definition, connection.form)
    store = distro_store(distro or USUAL_DISTRO[connection.encoding])
    if connection.type not in store.fielddefs:
        raise ValueError(
            f"the bag does not define {connection.type}, and neither does ROS {distro or 'by itself'}"
        )
    return store


@cache
def _defined(name: str, definition: str, form: str) -> Any:
    """The types that a text defines."""
    store = get_typestore(Stores.EMPTY)
    try:
        if form == "ros2idl":
            store.register(get_types_from_idl(definition))
        else:
            store.register(get_types_from_msg(definition, name))
    except (TypesysError, KeyError, ValueError) as error:
        raise ValueError(f"a definition of {name} that cannot be read: {error}") from error
    if name not in store.fielddefs:
        raise ValueError(f"the bag's definition of {name} does not define it")
    return store
