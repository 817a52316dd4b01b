"""Every option of every verb, given a value that it cannot have: one message that names the option, never a trace."""

import re
from collections.abc import Iterator

import click
import pytest

from sceneloom.cli.main import sceneloom as command_line

NEEDED = {
    "demo": ("--keep", "OUT"),
    "info": ("DRIVE",),
    "fuse": ("DRIVE", "-o", "OUT.sfs"),
    "depth": ("DRIVE", "-o", "OUT"),
    "track": ("DRIVE", "-o", "OUT"),
    "view": ("DRIVE", "--save", "OUT.rrd"),
    "convert": ("DRIVE", "OUT.sfs"),
    "validate": ("DRIVE", "--quick"),
    "salvage": ("DRIVE", "-o", "OUT.sfs"),
    "report": ("DRIVE", "-o", "OUT.html"),
    "diff": ("DRIVE", "DRIVE"),
    "batch": ("DRIVE", "-o", "OUT"),
    "catalog build": ("DRIVE", "-o", "OUT"),
    "catalog update": ("OUT",),
    "catalog query": ("OUT",),
    "sync": ("DRIVE",),
    "calibrate": ("DRIVE",),
    "serve": (),
    "send": ("DRIVE", "localhost:1"),
    "conformance": ("localhost:1", "--checks"),
    "eval detection": ("DRIVE", "DRIVE"),
    "eval tracking": ("DRIVE", "DRIVE"),
    "eval trajectory": ("DRIVE", "DRIVE"),
    "edit merge": ("DRIVE", "DRIVE", "-o", "OUT.sfs"),
}
"""What a verb needs beside the option; `edit` verbs take a drive and an output."""

BAD_NUMBERS = ("nan", "-1", "x")


def verbs(command: click.Command, words: tuple[str, ...] = ()) -> Iterator[tuple[str, click.Command]]:
    if isinstance(command, click.Group):
        context = click.Context(command)
        for name in command.list_commands(context):
            found = command.get_command(context, name)
            assert found is not None, name
            yield from verbs(found, (*words, name))
    else:
        yield " ".join(words), command


def bad_values(option: click.Option) -> Iterator[tuple[str, ...]]:
    """Values that an option of such a type cannot have."""
    if option.is_flag:
        return
    kind = option.type
    if isinstance(kind, click.Choice):
        yield ("nope",)
    elif type(kind) is click.types.IntParamType:
        yield from (("nan",), ("x",))
    elif isinstance(kind, click.types.FloatParamType | click.IntRange):
        yield from ((number,) for number in BAD_NUMBERS)
    elif isinstance(kind, click.Tuple):
        yield tuple("x" for _ in kind.types)
        yield tuple("nan" for _ in kind.types)
    elif kind.name == "positive":
        yield from ((number,) for number in (*BAD_NUMBERS, "inf", "0"))
    elif kind.name == "share":
        yield from ((number,) for number in (*BAD_NUMBERS, "0", "1.5"))
    elif kind.name == "not_negative":
        yield from ((number,) for number in BAD_NUMBERS)


CASES = [
    pytest.param(verb, option.opts, value, id=f"{verb} {option.opts[-1]} {' '.join(value)}")
    for verb, command in verbs(command_line)
    for option in command.params
    if isinstance(option, click.Option)
    for value in bad_values(option)
]


def is_a_name_of_ours(word: str) -> bool:
    """Whether a word is the name of a function's argument, not one that a person could type."""
    return re.fullmatch(r"[a-z]+(_[a-z]+)+", word) is not None


@pytest.mark.parametrize(("verb", "names", "value"), CASES)
def test_a_value_that_an_option_cannot_have_is_answered_with_the_option(
    call, recording, tmp_path, verb, names, value
):
    needed = NEEDED.get(verb, ("DRIVE", "-o", "OUT.sfs"))
    words = [word.replace("DRIVE", str(recording)).replace("OUT", str(tmp_path / "out")) for word in needed]
    outcome = call(*verb.split(), *words, names[-1], *value)
    assert outcome.code in (1, 2), outcome.out
    assert "Traceback" not in outcome.err
    last = [line for line in outcome.err.strip().splitlines() if not line.startswith("next: ")][-1]
    bare = names[-1].lstrip("-")
    assert bare in last.lower().replace("_", "-"), last
    ours = [
        word for word in re.findall(r"[a-z_]+", last.replace(str(tmp_path), "")) if is_a_name_of_ours(word)
    ]
    assert not ours, last
