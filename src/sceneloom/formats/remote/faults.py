"""What back ends raise as errors of ours: without secrets, and saying whether the cause may pass."""

import errno
from collections.abc import Iterator
from contextlib import contextmanager

from sceneloom.errors import DataError, MissingExtraError, SceneloomError, how_to_install
from sceneloom.redaction import redacted

EXTRA = f"files behind URLs need {how_to_install('cloud')}"

_PASSING_STATUS = {408, 425, 429, 500, 502, 503, 504}
"""Source: RFC 9110, clauses 15.5.9 and 15.6; RFC 6585, clause 4; RFC 8470, clause 5.2."""

_PASSING_ERRNO = {
    errno.EBUSY,
    errno.EAGAIN,
    errno.ECONNRESET,
    errno.ECONNREFUSED,
    errno.EPIPE,
    errno.ETIMEDOUT,
}
_PASSING_KINDS = (ConnectionError, TimeoutError, InterruptedError, BlockingIOError)
_PASSING_NAMES = frozenset(
    {
        *("ClientConnectionError", "ClientPayloadError"),  # aiohttp
        *("HTTPClientError", "IncompleteReadError", "ResponseStreamingError"),  # botocore
        *("ServiceRequestError", "ServiceResponseError", "IncompleteReadError"),  # azure
        *("TransportError", "ServerDisconnectedError"),  # google
    }
)
"""Classes of libraries that are not imported for their errors alone."""


class CutShortError(ConnectionError):
    """A server gave fewer bytes than it was asked for."""


class NoRangesError(ValueError):
    """A server gives all of a file for a part of it."""


def may_pass(error: BaseException | None) -> bool:
    """Whether what a back end raised can be gone at the next try: a busy or slow server, a connection that was cut."""
    while error is not None:
        if isinstance(error, SceneloomError):
            return error.passing
        if _passes(error):
            return True
        error = error.__cause__
    return False


def _passes(error: BaseException) -> bool:
    status = _status(error)
    if status is not None:
        return status in _PASSING_STATUS
    if isinstance(error, _PASSING_KINDS) or _PASSING_NAMES & {kind.__name__ for kind in type(error).__mro__}:
        return True
    return isinstance(error, OSError) and error.errno in _PASSING_ERRNO


def _status(error: BaseException) -> int | None:
    """What a server answered, by the names that libraries have for it."""
    for name in ("status", "status_code", "code"):
        value = getattr(error, name, None)
        if isinstance(value, int | str) and str(value).isdigit() and 100 <= int(value) < 600:
            return int(value)
    answer = getattr(error, "response", None)
    reported = answer.get("ResponseMetadata", {}).get("HTTPStatusCode") if isinstance(answer, dict) else None
    return reported if isinstance(reported, int) else None


@contextmanager
def faults(url: str, location: str, *, doing: str = "read") -> Iterator[None]:
    """Rotate whatever a back end raises into errors of ours; what it stated stands in them without secrets.

    Raises:
        DataError: it failed; `passing` says whether another try may do.
        MissingExtraError: what reads such addresses is not installed.
    """
    ours: SceneloomError | None = None
    try:
        yield
    except SceneloomError:
        raise
    except Exception as error:  # noqa: BLE001 - back ends raise what the libraries of their protocols raise
        ours = _ours(error, redacted(url), location, doing)
    if ours is None:
        return
    try:
        raise ours
    finally:
        # what the back end raised is left behind: it has addresses with all their secrets, and handlers of errors
        # that look around, and processes that an error is sent to, would find them
        ours.__cause__ = ours.__context__ = None


def _ours(error: Exception, url: str, location: str, doing: str) -> SceneloomError:
    if isinstance(error, ImportError):
        return MissingExtraError(f"{url}: {error}; {EXTRA}")
    found = DataError(url, location, _problem(error, doing))
    if isinstance(error, NoRangesError):
        found = DataError(url, "", "its server answers no ranges (`Range`); download the file first")
    found.passing = may_pass(error)
    return found


def _problem(error: Exception, doing: str) -> str:
    if isinstance(error, FileNotFoundError):
        # back ends report it, too, where no server answers
        return f"cannot be found{f': {redacted(error.__cause__)}' if error.__cause__ else ''}"
    if isinstance(error, CutShortError):
        return redacted(error)
    return f"cannot be {'read' if doing == 'read' else doing}: {redacted(error) or type(error).__name__}"
