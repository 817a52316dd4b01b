"""What a caller of the service meets besides answers: one error for each kind of failure."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import grpc
from google.protobuf.message import DecodeError

from sceneloom.errors import SceneloomError


class ServiceError(SceneloomError):
    """The service did not answer, or answered that it cannot.

    Attributes:
        address: of the service.
        problem: what happened, for people.
    """

    advice = ""
    """What the caller can do about it."""

    def __init__(self, address: str, problem: str) -> None:
        super().__init__(address, problem)
        self.address, self.problem = address, problem

    def __str__(self) -> str:
        return f"{self.address}: {self.problem}" + (f"; {self.advice}" if self.advice else "")


class UnreachableError(ServiceError):
    """Nobody answers at the address, or the connection broke."""

    advice = "is the service there, and are both sides with or both without TLS?"


class UnauthenticatedError(ServiceError):
    """The token is missing or wrong."""

    advice = "state the token that the service was started with"


class TooLargeError(ServiceError):
    """A message is larger than one side takes."""

    advice = "send smaller images or clouds, or raise the limit of the service"


class DeadlineError(ServiceError):
    """The answer did not come in time; whether the call was done is not known."""


_TOO_LARGE = "larger than max"
"""What gRPC says of a message beyond either side's limit; its status is also that of other limits."""

_ERRORS: Mapping[grpc.StatusCode, type[ServiceError]] = MappingProxyType(
    {
        grpc.StatusCode.UNAVAILABLE: UnreachableError,
        grpc.StatusCode.UNAUTHENTICATED: UnauthenticatedError,
        grpc.StatusCode.PERMISSION_DENIED: UnauthenticatedError,
        grpc.StatusCode.DEADLINE_EXCEEDED: DeadlineError,
    }
)


_UNREADABLE = "Exception deserializing response"
"""What gRPC says where a reader of answers gives None."""


def reader_of(reply_type: Any) -> Callable[[bytes], Any]:
    """Give what reads answers of a type; None of bytes that are none, since gRPC logs tracebacks of what is raised."""

    def read(content: bytes) -> Any:
        try:
            return reply_type.FromString(content)
        except DecodeError:
            return None

    return read


def details_of(error: grpc.RpcError) -> str:
    """What is stated for a call that failed."""
    details = str(getattr(error, "details", lambda: "")() or "")
    return "the answer is no message of this service" if _UNREADABLE in details else details


def service_error(address: str, error: grpc.RpcError) -> ServiceError:
    """Give the error of a call that failed."""
    code, details = code_of(error), details_of(error)
    kind = TooLargeError if _TOO_LARGE in details else _ERRORS.get(code, ServiceError)
    problem = f"{code.name.lower().replace('_', ' ')}: {details}" if details else code.name.lower()
    return kind(address, problem)


def code_of(error: grpc.RpcError) -> grpc.StatusCode:
    """The status that a call ended with."""
    code = getattr(error, "code", lambda: None)()
    return code if isinstance(code, grpc.StatusCode) else grpc.StatusCode.UNKNOWN
