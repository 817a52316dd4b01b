"""Options that several verbs have mean the same everywhere, and every verb minds the manners of the shell."""

import re
from collections.abc import Iterator

import click
import pytest

from sceneloom.cli.main import sceneloom as command_line


def verbs(command: click.Command, words: tuple[str, ...] = ()) -> Iterator[tuple[str, click.Command]]:
    if isinstance(command, click.Group):
        context = click.Context(command)
        for name in command.list_commands(context):
            found = command.get_command(context, name)
            assert found is not None, name
            yield from verbs(found, (*words, name))
    else:
        yield " ".join(words), command


VERBS = dict(verbs(command_line))
OPTIONS = [
    (verb, option, name)
    for verb, command in VERBS.items()
    for option in command.params
    if isinstance(option, click.Option)
    for name in option.opts
]

WITHOUT_A_RESULT = {"completion"}
"""Verbs that print a text for a program, and nothing about it."""

FLAG, TEXT, NUMBER, WHOLE, CHOICE, LOCATION = "flag", "text", "number", "whole number", "choice", "location"

MEANINGS = {
    "--altitude": (CHOICE, "What a recording's altitudes are above"),
    "--annotations-in": (CHOICE, "The frame of the annotations"),
    "--assume-model": (FLAG, "Compute with camera models whose formulas are not confirmed"),
    "--boxes2d": (LOCATION, "Boxes detected in images"),
    "--boxes3d": (LOCATION, "Boxes detected in sweeps"),
    "--ca": (LOCATION, "PEM file: who signed the service's certificate"),
    "--camera-shift": (CHOICE, "How to use a recording's `imuToCameraShiftSeconds`"),
    "--class": (TEXT, "A class to evaluate"),
    "--client-cert": (LOCATION, "PEM file: a certificate to show"),
    "--client-key": (LOCATION, "PEM file: its key"),
    "--euler-order": (TEXT, "Order of the boxes' rotations"),
    "--euler-unit": (CHOICE, "Unit of the boxes' angles"),
    "--image-index": (CHOICE, "Which image of a video a recording's `frames` line means"),
    "--orientation-from": (CHOICE, "Derive orientations"),
    "--json": (FLAG, "Print "),
    "--label": (TEXT, ""),
    "--lenient": (FLAG, "Skip what is broken"),
    "--lidar": (TEXT, ""),
    "--camera": (TEXT, ""),
    "--sensor": (TEXT, "The only sensors"),
    "--output": (LOCATION, ""),
    "--overwrite": (FLAG, "Replace "),
    "--points-frame": (CHOICE, "Frame of the lidar points"),
    "--profile": (CHOICE, "`scale`: "),
    "--quiet": (FLAG, ""),
    "--input-format": (TEXT, "Format of the drive"),
    "--input-option": (TEXT, "An option of the drive's format"),
    "--sequence": (TEXT, ""),
    "--session": (TEXT, "The session"),
    "--start": (NUMBER, "Begin S seconds after the first timestamp"),
    "--stop": (NUMBER, "End before S seconds after it"),
    "--tangential": (CHOICE, "What p1 and p2"),
    "--threads": (WHOLE, "Size of the thread pool"),
    "--time-unit": (CHOICE, "Unit of all times"),
    "--token-file": (LOCATION, "File with the token"),
    "--tolerance-deg": (NUMBER, ""),
    "--tolerance-m": (NUMBER, ""),
    "--trajectory": (TEXT, ""),
    "--verbose": (FLAG, ""),
}
"""What each of them takes, and how its help begins, whatever verb it stands on."""

SHORT = {"-q": "--quiet", "-v": "--verbose", "-o": "--output"}


def takes(option: click.Option) -> str:
    """What an option is given, in the words of the table."""
    kind = option.type
    if option.is_flag:
        return FLAG
    if isinstance(kind, click.Choice):
        return CHOICE
    if isinstance(kind, click.IntRange | click.types.IntParamType):
        return WHOLE
    if isinstance(kind, click.types.FloatParamType) or kind.name in {
        "positive",
        "not_negative",
        "share",
        "finite",
    }:
        return NUMBER
    return LOCATION if isinstance(kind, click.Path) or kind.name == "target" else TEXT


@pytest.mark.parametrize("name", MEANINGS)
def test_an_option_means_the_same_on_every_verb_that_has_it(name):
    kind, begins = MEANINGS[name]
    found = [(verb, option) for verb, option, called in OPTIONS if called == name]
    assert found, f"no verb has {name}"
    for verb, option in found:
        # a further drive's folder, and an image of a curve, are locations too, whatever they are made of
        assert takes(option) == kind, f"{verb} {name} takes a {takes(option)}"
        assert (option.help or "").startswith(begins), f"{verb} {name}: {option.help}"


@pytest.mark.parametrize("verb", VERBS)
def test_every_option_has_help_that_is_a_sentence(verb):
    for _, option, name in (row for row in OPTIONS if row[0] == verb):
        text = option.help or ""
        assert text, f"{verb} {name}"
        assert text[0].isupper() or text[0] in "`1", f"{verb} {name}: {text}"
        assert text.rstrip().endswith((".", "]")), f"{verb} {name}: {text}"


@pytest.mark.parametrize("verb", sorted(set(VERBS) - WITHOUT_A_RESULT))
def test_every_verb_prints_for_machines_and_can_be_quiet_or_state_more(verb):
    names = {name for on, _, name in OPTIONS if on == verb}
    assert {"--json", "--quiet", "-q", "--verbose", "-v"} <= names


def test_short_names_stand_for_one_long_name_each():
    for verb, option, name in OPTIONS:
        if name in SHORT and not (
            name == "-o" and verb.startswith("eval ")
        ):  # which writes nothing but an image
            assert SHORT[name] in option.opts, f"{verb} {name}"


def test_what_is_piped_or_asked_to_be_plain_has_no_colours_and_no_bar(call, recording, tmp_path, monkeypatch):
    words = ("edit", "thin", recording, "--every", "2", "-o")
    piped = call(*words, tmp_path / "piped.sfs")
    monkeypatch.setenv("NO_COLOR", "1")
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    plain = call(*words, tmp_path / "plain.sfs")
    for reported in (piped, plain):
        assert reported.code == 0, reported.err
        assert not re.search(
            r"\x1b\[[0-9;]*[1-9][0-9]*m", reported.out + reported.err
        )  # marks that set a colour
    assert "\r" not in piped.err


def test_a_drive_that_is_broken_is_answered_with_what_to_do_next(call, recording, tmp_path):
    broken = tmp_path / "drive"
    broken.mkdir()
    (broken / "calibration.json").write_text((recording / "calibration.json").read_text())
    (broken / "data.jsonl").write_text('{"time": 0.0}\n{"x":\n')
    outcome = call("info", broken)
    assert outcome.code == 1
    assert f"next: `sceneloom validate {broken}` lists all that is wrong; `--lenient` goes on" in outcome.err
    assert "next:" not in call("info", broken, "--quiet").err
    stranger = tmp_path / "stranger.xyz"
    stranger.write_text("?")
    assert "next: `sceneloom formats` lists what can be read" in call("info", stranger).err
    assert "next:" not in call("info", tmp_path / "none").err
    poses = tmp_path / "poses.txt"
    poses.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    without_times = call("convert", poses, tmp_path / "trajectory.tum")
    assert ("`--from-times FILE`" in without_times.err, "next:" in without_times.err) == (True, False)
