"""`vio_config.yaml`: settings of the vendor's software, one `key: value` a line, kept as text and looked through."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from difflib import get_close_matches

from sceneloom.formats.recording.vio_config_keys import KNOWN_KEYS

_SETTING = re.compile(
    r"""(?P<quote>["']?)(?P<key>[^\s"':#{}\[\],&*!|>%@`][^"':#]*?)(?P=quote)\s*:(?:\s+(?P<value>.*))?"""
)
_BEGINS_LIST = ("- ", "-\t")
_MARKS = ("---", "...", "%YAML")


@dataclass(frozen=True, slots=True)
class Setting:
    """One setting.

    Attributes:
        key: its name.
        value: the text behind the colon, without a comment; "" where the value stands in the lines below.
        line: where it stands, counted from 1.
    """

    key: str
    value: str
    line: int


@dataclass(frozen=True, slots=True)
class VioConfig:
    """What a text says.

    Attributes:
        settings: in the order of the lines.
        strange: the lines that are no setting, by number; the vendor's software stops at them.
    """

    settings: tuple[Setting, ...]
    strange: Mapping[int, str]


def read_vio_config(text: str) -> VioConfig:
    """Read the settings at the root of a text; lines that are indented, or items of a list, belong to one above."""
    settings: list[Setting] = []
    strange: dict[int, str] = {}
    for number, line in _content(text):
        match = _SETTING.fullmatch(line)
        if match is not None:
            settings.append(Setting(match["key"], match["value"] or "", number))
        elif not (settings and line.startswith(_BEGINS_LIST)):
            strange[number] = line
    return VioConfig(tuple(settings), strange)


def _content(text: str) -> Iterator[tuple[int, str]]:
    """The lines at the root that state something, without their comments."""
    for number, line in enumerate(text.lstrip("\ufeff").splitlines(), start=1):
        stated = _without_comment(line).rstrip()
        if stated and not stated[0].isspace() and not stated.startswith(_MARKS):
            yield number, stated


def _without_comment(line: str) -> str:
    """Cut what stands behind a `#` that begins a comment: one that is in no quotes and follows a blank."""
    quote = ""
    for location, letter in enumerate(line):
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "\"'":
            quote = letter
        elif letter == "#" and (location == 0 or line[location - 1].isspace()):
            return line[:location]
    return line


def unknown_keys(text: str) -> list[str]:
    """The names of settings that are not publicly known, in the order of the lines; the SDK stops at those it lacks."""
    return [setting.key for setting in read_vio_config(text).settings if setting.key not in KNOWN_KEYS]


def repeated_keys(text: str) -> list[str]:
    """The names of settings that stand there more than once; which value counts is not stated."""
    keys = [setting.key for setting in read_vio_config(text).settings]
    return sorted({key for key in keys if keys.count(key) > 1})


def similar_key(key: str) -> str | None:
    """The known name that a name comes closest to, None where none is near."""
    by_letters = {known.lower(): known for known in KNOWN_KEYS}
    near = get_close_matches(key.lower(), by_letters, n=1, cutoff=0.8)
    return by_letters[near[0]] if near else None
