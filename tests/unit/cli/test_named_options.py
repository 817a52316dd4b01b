"""What messages, remedies and help report a person to type can be typed."""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import click
import pytest

import sceneloom
from sceneloom.checks.validation import catalogue
from sceneloom.cli.main import sceneloom as command_line

SOURCES = Path(sceneloom.__file__).parent

OPTION = re.compile(r"(?<![\w(-])--[a-z][a-z0-9-]*(?![a-z0-9-]|\s*:)")
"""Colours and lengths of style sheets, as `--ink: #111` and `var(--ink)`, are none."""

OF_OTHER_PROGRAMS = frozenset({Path("view/viewer.py")})
"""Modules that start another program with its own options."""


def commands(
    command: click.Command, words: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    yield words, command
    if isinstance(command, click.Group):
        context = click.Context(command)
        for name in command.list_commands(context):
            found = command.get_command(context, name)
            assert found is not None, name
            yield from commands(found, (*words, name))


@cache
def known_options() -> frozenset[str]:
    own = {name for _, command in commands(command_line) for option in command.params for name in option.opts}
    return frozenset(own | {"--help"})


@cache
def known_verbs() -> frozenset[str]:
    return frozenset(" ".join(words) for words, _ in commands(command_line))


def texts(path: Path) -> Iterator[str]:
    """Every text of a module, its documentation too; a text with values in it as its parts."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


MODULES = sorted(path.relative_to(SOURCES) for path in SOURCES.rglob("*.py"))


@pytest.mark.parametrize("rule", catalogue(), ids=lambda rule: rule.id)
def test_a_remedy_names_no_option_that_there_is_not(rule):
    assert set(OPTION.findall(f"{rule.summary} {rule.remedy}")) <= known_options()


@pytest.mark.few(15)
@pytest.mark.parametrize("room", sorted({path.parts[0] for path in MODULES}))
def test_texts_name_no_option_and_no_verb_that_there_is_not(room):
    for module in (path for path in MODULES if path.parts[0] == room):
        for text in texts(SOURCES / module) if module not in OF_OTHER_PROGRAMS else ():
            unknown = set(OPTION.findall(text)) - known_options()
            assert not unknown, f"{module}: {unknown} in {text!r}"
            for call in re.findall(r"`sceneloom ([a-z][^`]*)`", text):
                assert call_is_known(call), f"{module}: sceneloom {call}"


def call_is_known(call: str) -> bool:
    """Whether a call begins with a verb, and has only options of that verb."""
    words = call.split()
    verb = next((words[:n] for n in (2, 1) if " ".join(words[:n]) in known_verbs()), None)
    if verb is None:
        return False
    command = dict(commands(command_line))[tuple(verb)]
    own = {name for option in command.params for name in option.opts} | {"--help"}
    return set(OPTION.findall(call)) <= own


def test_a_call_with_an_option_of_another_verb_would_be_found():
    assert call_is_known("edit crop --start 3")
    assert not call_is_known("salvage --fix out")
    assert not call_is_known("repair drive")
