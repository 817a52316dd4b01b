"""What a call can end with besides its answer."""

import grpc

from sceneloom.errors import SceneloomError
from sceneloom.fusion.outcome import Cause


class CallError(SceneloomError):
    """A call cannot be answered; where it answers with a `Status`, that says cause and reason.

    Attributes:
        code: what other calls end with.
        cause: for programs.
        reason: for people.
    """

    def __init__(self, code: grpc.StatusCode, cause: Cause, reason: str) -> None:
        super().__init__(code, cause, reason)
        self.code, self.cause, self.reason = code, cause, reason

    def __str__(self) -> str:
        return self.reason
