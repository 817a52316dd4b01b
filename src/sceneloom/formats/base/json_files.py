"""Files of JSON that are read whole."""

import re
from codecs import BOM_UTF8
from pathlib import Path
from typing import TypeVar

import msgspec

from sceneloom.errors import DataError
from sceneloom.formats.base.files import read_bytes

_Kind = TypeVar("_Kind")

NO_JSON = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)
"""What msgspec raises of bytes that are no JSON, apart from its `ValidationError` of JSON of another kind."""


def read_json(path: Path, kind: type[_Kind]) -> _Kind:
    """Read a JSON file of one kind.

    Raises:
        DataError: it is missing, no JSON, or a value is missing or of another kind.
    """
    if not path.is_file():
        raise DataError(path, "", "is not there")
    content = read_bytes(path).removeprefix(BOM_UTF8)
    try:
        return msgspec.json.decode(content, type=kind)
    except msgspec.ValidationError as error:
        problem, _, location = str(error).partition(" - at `")
        raise DataError(path, location.rstrip("`"), problem) from error
    except NO_JSON as error:
        raise no_json(path, content, error) from error


def decode_part(path: Path, location: str, part: msgspec.Raw, kind: type[_Kind]) -> _Kind:
    """Decode a part of a JSON file that was kept as it stands there.

    Args:
        path: the file.
        location: of the part in it.
        part: its text.
        kind: what it shall be.

    Raises:
        DataError: it is no JSON, or a value in it is missing or of another kind.
    """
    try:
        return msgspec.json.decode(part, type=kind)
    except msgspec.ValidationError as error:
        problem, _, inner = str(error).partition(" - at `$")
        raise DataError(path, f"{location}{inner.rstrip('`')}", problem) from error
    except NO_JSON as error:
        raise DataError(path, location, f"is no JSON: {error}") from error


def damage_of_json(path: Path) -> str | None:
    """Why a file is no JSON, with line and column; None where it is, or is lines of JSON."""
    try:
        content = read_bytes(path).removeprefix(BOM_UTF8)
        msgspec.json.decode(content, type=msgspec.Raw)
    except DataError:
        return None
    except NO_JSON as error:
        fault = no_json(path, content, error)
        lines = fault.problem.endswith(_FURTHER) and path.suffix.lower() != ".json"
        return None if lines else f"{path.name}: {fault.location}: {fault.problem}"
    return None


def no_json(path: Path, content: bytes, error: Exception) -> DataError:
    """Report where content is no JSON: line and column, and the value that a cut file ends in."""
    at, text = len(content), str(error)
    if found := _BYTE.search(text):
        at, text = int(found[1]), text[: found.start()].removeprefix("JSON is malformed: ")
        at -= text == _FURTHER  # the first of them has been taken
    elif text.startswith("Invalid UTF-8"):
        try:
            content.decode()
        except UnicodeDecodeError as wrong:
            at = wrong.start
    elif text != "Input data was truncated":
        return DataError(path, "", f"is no JSON: {text}")
    if not content.strip():
        text = "the file is empty"
    elif at == len(content):
        text = f"the file ends within {_value_at_end(content)}, it is cut off"
    line, start = content.count(b"\n", 0, at) + 1, content.rfind(b"\n", 0, at) + 1
    column = len(content[start:at].decode("utf-8", "replace")) + 1
    return DataError(path, f"line {line}, column {column}", f"is no JSON: {text}")


_FURTHER = "trailing characters"  # behind a whole value: another line
_BYTE = re.compile(r" \(byte (\d+)\)$")
_TOKENS = re.compile(rb'"[^"\\]*(?:\\.[^"\\]*)*"?|[\[\]{},:]', re.DOTALL)
_LONGEST = 1 << 26  # bytes that are looked through for the value
_SHOWN = 100


def _value_at_end(content: bytes) -> str:
    """The path of the value that content ends in."""
    if len(content) > _LONGEST:
        return "a value"
    above: list[str | int] = []  # of each list or object that is open, the index or name of what is in it
    name = ""
    for found in _TOKENS.finditer(content):
        match found[0]:
            case b"{" | b"[" as opened:
                above.append("" if opened == b"{" else 0)
            case b"}" | b"]":
                del above[-1:]
            case b":":
                above[-1:] = [name]
            case b",":
                above[-1:] = ["" if isinstance(one, str) else one + 1 for one in above[-1:]]
            case text:
                name = text[1:-1].decode("utf-8", "replace")
    path = "".join(f"[{one}]" if isinstance(one, int) else f".{one}" for one in above if one != "").removeprefix(".")
    return (path if len(path) <= _SHOWN else f"…{path[-_SHOWN:]}") or "its first value"
