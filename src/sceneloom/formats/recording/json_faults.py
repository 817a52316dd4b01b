"""From what the JSON decoder complains about to messages that name place, value and what was expected."""

import re
from typing import Any

import msgspec

DECODER_FAULTS = (msgspec.MsgspecError, ValueError, RecursionError)
"""What decoding of bytes that nobody checked may raise."""

_PATH = re.compile(r"(?P<what>.*) - at `\$(?P<path>.*)`", re.DOTALL)
_STEP = re.compile(r"\.([^.\[\]]+)|\[(\d+)\]")
_NO_NUMBER = re.compile(rb"\bnan\b|\binf", re.IGNORECASE)
_LONGEST_QUOTE = 60


def json_problem(error: Exception, text: bytes, *, prefix: str = "") -> str:
    """Describe why a text is not the JSON that was expected, path first; `json_fault` describes the arguments."""
    return ": ".join(part for part in json_fault(error, text, prefix=prefix) if part)


def json_fault(error: Exception, text: bytes, *, prefix: str = "") -> tuple[str, str]:
    """Say where a text is not the JSON that was expected, and why.

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
        hint = "; NaN and Infinity are no JSON numbers" if _NO_NUMBER.search(text) else ""
        return prefix, f"{quote(text)}: not a JSON object: {error}{hint}"
    match = _PATH.fullmatch(str(error))
    what, path = (match["what"], match["path"]) if match else (str(error), "")
    return f"{prefix}{path}".lstrip("."), f"{_value_at(path, text)}: {what}"


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
