"""What is wrong with a text that should be JSON, in plain words."""

import re
from pathlib import Path
from typing import Any

import msgspec

from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.warnings import WarningKind

FARTHEST_TIME = 9.2e9
"""Times within plus or minus this fit into int64 nanoseconds [s]."""

DECODER_FAULTS = (msgspec.MsgspecError, ValueError, RecursionError)
"""What decoding of bytes that nobody checked may raise."""

_PATH = re.compile(r"(?P<what>.*) - at `\$(?P<path>.*)`", re.DOTALL)
_STEP = re.compile(r"\.([^.\[\]]+)|\[(\d+)\]")
_NO_NUMBER = re.compile(rb"\bnan\b|\binf", re.IGNORECASE)
_LONGEST_QUOTE = 60

_TYPE_COMPLAINT = re.compile(
    r"Expected `(?P<wanted>[a-z |]+)`(?: (?P<bound>[<>]=?) (?P<number>\S+)|, got `(?P<got>\w+)`)"
)

_TYPES = {
    "float": "a number",
    "int": "a whole number",
    "str": "a text",
    "bool": "true or false",
    "object": "an object",
    "array": "a list",
}

_BOUNDS = {"<=": " of at most ", ">=": " of at least ", "<": " below ", ">": " above "}
BYTE_ORDER_MARK = b"\xef\xbb\xbf"

_OTHER_FILES = {
    b"\xff\xfe": "is text in UTF-16",
    b"\xfe\xff": "is text in UTF-16",
    b"\x1f\x8b": "is compressed by gzip",
    b"PK\x03\x04": "is a zip archive",
    b"SQLite format 3\0": "is a database",
    b"\x28\xb5\x2f\xfd": "is compressed by zstd",
    b"BZh": "is compressed by bzip2",
    b"\xfd7zXZ\0": "is compressed by xz",
}
"""How files begin that are none of text in UTF-8."""

_OTHER_BEGINNINGS = {BYTE_ORDER_MARK: "begins with a byte order mark", **_OTHER_FILES}

_UNITS = ((1e18, "nanoseconds"), (1e15, "microseconds"), (1e12, "milliseconds"))
"""Times of our days are beyond these numbers, in these units."""


def json_problem(error: Exception, text: bytes, *, prefix: str = "") -> str:
    """Describe why a text is not the JSON that was expected, path first; `json_fault` describes the arguments."""
    return ": ".join(part for part in json_fault(error, text, prefix=prefix) if part)


def json_fault(error: Exception, text: bytes, *, prefix: str = "") -> tuple[str, str]:
    """Report where a text is not the JSON that was expected, and why.

    Args:
        error: what the decoder raised.
        text: what it was given.
        prefix: path of the text inside the data.

    Returns:
        The path of the value that is wrong, and the value with what was expected; where the text is no JSON at all,
        the prefix and the beginning of the text.
    """
    if isinstance(error, RecursionError):
        return prefix, f"{quote(text)}: nested too deeply"
    if not isinstance(error, msgspec.ValidationError):
        return prefix, _no_json(error, text)
    match = _PATH.fullmatch(str(error))
    what, path = (match["what"], match["path"]) if match else (str(error), "")
    value = _value_at(path, text)
    return f"{prefix}{path}".lstrip("."), f"{value}: {_in_words(what, value)}"


def note_mark(text: bytes, path: Path, ledger: Ledger) -> None:
    """Note a byte order mark at the beginning of a file of JSON, which is read over it."""
    if text.startswith(BYTE_ORDER_MARK):
        message = "begins with a byte order mark, which JSON must not have; it was skipped"
        ledger.note(WarningKind.REPAIRED, "byte-order-mark", str(path), message)


def other_file(beginning: bytes) -> str | None:
    """Report what a file is that does not begin as text in UTF-8 does; None where nothing is known of that.

    Args:
        beginning: its first bytes, 16 or more where it has so many.
    """
    halves = {bytes(byte != 0 for byte in beginning[start:4:2]) for start in (0, 1)}
    if len(beginning) >= 4 and halves == {b"\0\0", b"\1\1"}:
        return "is text in UTF-16"
    return next((reported for start, reported in _OTHER_FILES.items() if beginning.startswith(start)), None)


def _no_json(error: Exception, text: bytes) -> str:
    if not text.strip():
        return "empty; expected a JSON object"
    for beginning, reported in _OTHER_BEGINNINGS.items():
        if text.startswith(beginning):
            return f"{reported}; expected plain JSON in UTF-8"
    hint = "; NaN and Infinity are no JSON numbers" if _NO_NUMBER.search(text) else ""
    if text.rstrip().endswith(b"},") or text.strip() == b"[":
        hint = "; a log is no list: expected one object a line, and no commas between them"
    elif text.strip() == b"{":
        hint = "; expected each object in one line"
    return f"{quote(text)}: not a JSON object: {error}{hint}"


def _in_words(complaint: str, value: str) -> str:
    """The decoder's complaint about a value, types by their names in everyday words, not a programming language's."""
    match = _TYPE_COMPLAINT.fullmatch(complaint)
    if match is None:
        return complaint
    if match["number"] is not None and abs(float(match["number"])) == FARTHEST_TIME:
        return f"expected seconds, within ±{FARTHEST_TIME:g}{_unit_in_question(value)}"
    types = [_TYPES.get(name, name) for name in match["wanted"].split(" | ") if name != "null"]
    got = f", not {_TYPES.get(match['got'], match['got'])}" if match["got"] else ""
    return f"expected {' or '.join(types)}{_BOUNDS.get(match['bound'], '')}{match['number'] or ''}{got}"


def _unit_in_question(value: str) -> str:
    try:
        number = float(value)
    except ValueError:
        return ""
    return next((f"; this looks like {unit}" for least, unit in _UNITS if number > least), "")


def _value_at(path: str, text: bytes) -> str:
    try:
        value: Any = msgspec.json.decode(text)
        for key, index in _STEP.findall(path):
            value = value[key] if key else value[int(index)]
        return quote(msgspec.json.encode(value))
    except (*DECODER_FAULTS, KeyError, IndexError, TypeError):
        return quote(text)


def quote(text: bytes) -> str:
    """Show the beginning of a text that may be anything, in one line."""
    shown = " ".join(text.decode("utf-8", "backslashreplace").split())
    return shown if len(shown) <= _LONGEST_QUOTE else f"{shown[:_LONGEST_QUOTE]}…"
