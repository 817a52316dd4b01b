"""Says before a server starts why it could not listen: gRPC says that it cannot, and not why."""

import socket

from sceneloom.errors import OptionError


def check_port(host: str, port: int, *, option: str = "port") -> None:
    """Check that a server may listen at an address.

    Args:
        port: 0 for a free one.
        option: what the port is of, for the message.

    Raises:
        OptionError: this machine does not have the address, or another program listens there.
    """
    reasons: list[str] = []
    for family, address in _addresses(host, port):
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # what just closed is no hindrance
            try:
                probe.bind(address)
            except OSError as error:
                reasons.append(_advice(error, option))
            else:
                return
    raise OptionError(f"cannot listen at {host}:{port}: {reasons[0]}")


def _addresses(host: str, port: int) -> list[tuple[int, tuple[object, ...]]]:
    try:
        found = socket.getaddrinfo(host.strip("[]"), port, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError) as error:
        problem = "no such host; expected an address or a name of this machine"
        raise OptionError(f"cannot listen at {host}:{port}: {problem}") from error
    return [(family, address) for family, _, _, _, address in found]


def _advice(error: OSError, option: str) -> str:
    reported = (error.strerror or str(error)).lower()
    return f"{reported}; choose another {option} (0 for a free one), or an address of this machine"
