"""Help, and options: they mean the same on every verb, and answer values that they cannot have."""

import re
import shlex

import click
import pytest
from click.shell_completion import ShellComplete
from click.testing import CliRunner
from tests.unit.cli import test_odd_scenes as odd_scenes
from tests.unit.cli.conftest import verbs

from sceneloom.cli.help import Verb
from sceneloom.cli.main import sceneloom as command_line
from sceneloom.fusion import system


def test_every_verb_ends_with_two_examples_that_its_options_fit(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, verb in VERBS.items():
        if name.startswith("batch ") and name != "batch status":
            continue  # they stand elsewhere, too
        assert (isinstance(verb, Verb), len(verb.examples)) == (True, 2), name
        examples = verb.lines_of(f"sceneloom {name}")
        for example in examples:
            if name == "completion":
                continue  # they are of shells
            words = shlex.split(example.partition(" > ")[0])
            assert words[: 1 + len(name.split())] == ["sceneloom", *name.split()], example
            context = click.Context(verb, help_option_names=["-h", "--help"])
            verb.make_parser(context).parse_args(words[1 + len(name.split()) :])
        assert CliRunner().invoke(command_line, [*name.split(), "--help"]).output.count(examples[1]) == 1


def test_rare_options_are_shown_by_help_all_and_a_verb_that_is_none_names_those_that_it_resembles():
    usual, whole = (CliRunner().invoke(command_line, ["fuse", flag]).output for flag in ("--help", "--help-all"))
    assert "--euler-unit" not in usual
    groups = [line for line in usual.splitlines() if line and not line.startswith(" ")]
    assert groups[1:] == ["Options:", "Input:", "Output:", "General:", "Examples:"]
    assert "--euler-unit" in whole.split("\nInput:")[1].split("\nOutput:")[0]
    assert usual.split("\nGeneral:")[1].index("--help-all") < usual.split("\nGeneral:")[1].index("-h, --help")
    for words, meant in {
        "fsue": "fuse",
        "edit corp": "crop",
        "eval track": "tracking",
        "batch covert": "convert",
    }.items():
        result = CliRunner().invoke(command_line, words.split())
        assert (result.exit_code, f"Did you mean {meant}" in result.output) == (2, True)


def test_names_of_formats_trajectories_and_sensors_are_completed(recording):
    for words, incomplete, expected in (
        (("fuse", recording, "--input-format"), "ro", ["ros1", "ros2"]),
        (("convert", recording, "x", "--to"), "nus", ["nuscenes", "nuscenes-bin"]),
        (("fuse", recording, "--trajectory"), "l", ["lidar"]),
        (("edit", "crop", recording, "--sensor"), "cam", ["camera0"]),
        (("edit", "crop", "nothing.sfs", "--sensor"), "cam", []),
    ):
        complete = ShellComplete(command_line, {}, "sceneloom", "_X").get_completions
        assert [item.value for item in complete(list(map(str, words)), incomplete)] == expected


VERBS = dict(verbs(command_line))
OPTIONS = [
    (verb, option, name)
    for verb, command in VERBS.items()
    for option in command.params
    if isinstance(option, click.Option)
    for name in option.opts
]
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
    "--rig": (LOCATION, "Mountings and camera models that the drive does not state"),
    "--rig-name": (TEXT, "What the rig calls a sensor"),
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


def takes(option):
    """What an option is given, in the words of the table."""
    kind = option.type
    if option.is_flag:
        return FLAG
    if isinstance(kind, click.Choice):
        return CHOICE
    if isinstance(kind, click.IntRange | click.types.IntParamType):
        return WHOLE
    if isinstance(kind, click.types.FloatParamType) or kind.name in {"positive", "not_negative", "share", "finite"}:
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
def test_options_of_every_verb_have_help_in_sentences_and_usual_short_names(verb):
    options = {name: option for on, option, name in OPTIONS if on == verb}
    if verb != "completion":  # which prints a text for a program, and nothing about it
        assert {"--json", "--quiet", "-q", "--verbose", "-v"} <= options.keys()
    for name, option in options.items():
        text = option.help or " "
        assert text[0].isupper() or text[0] in "`1", f"{verb} {name}: {text}"
        assert text.rstrip().endswith((".", "]")), f"{verb} {name}: {text}"
        if name in SHORT and not (name == "-o" and verb.startswith("eval ")):  # which writes nothing but an image
            assert SHORT[name] in option.opts, f"{verb} {name}"


def test_no_colours_and_no_bar_where_plain_and_what_to_do_next_with_a_broken_drive(
    call, succeeds, recording, tmp_path, monkeypatch
):
    words = ("edit", "thin", recording, "--every", "2", "-o")
    piped = succeeds(*words, tmp_path / "piped.sfs")
    with monkeypatch.context() as patch:
        patch.setenv("NO_COLOR", "1")
        patch.setattr("sys.stderr.isatty", lambda: True)
        plain = succeeds(*words, tmp_path / "plain.sfs")
    for outcome in (piped, plain):
        assert not re.search(r"\x1b\[[0-9;]*[1-9][0-9]*m", outcome.out + outcome.err)  # marks that set a colour
    assert "\r" not in piped.err
    (broken := tmp_path / "drive").mkdir()
    (broken / "calibration.json").write_text((recording / "calibration.json").read_text())
    (broken / "data.jsonl").write_text('{"time": 0.0}\n{"x":\n')
    outcome = call("info", broken)
    assert outcome.code == 1
    assert f"next: `sceneloom validate {broken}` lists all that is wrong; `--lenient` goes on" in outcome.err
    assert "next:" not in call("info", broken, "--quiet").err
    stranger = tmp_path / "stranger.xyz"
    stranger.write_text("?")
    assert "next: `sceneloom formats` lists what can be read" in call("info", stranger).err
    (rig := tmp_path / "car.urdf").write_text("<robot name='car'><link name='base'/></robot>")
    assert f"goes with a drive: `DRIVE --rig {rig}`" in call("info", rig).err
    way = tmp_path / "way.tum"
    way.write_text("0.0 0 0 0 0 0 0 1\n")
    assert f"goes with a drive: `DRIVE --trajectory {way}`" in call("info", way).err
    assert "next:" not in call("info", tmp_path / "none").err
    poses = tmp_path / "poses.txt"
    poses.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    without_times = call("convert", poses, tmp_path / "trajectory.tum")
    assert ("`--from-times FILE`" in without_times.err, "next:" in without_times.err) == (True, False)


NEEDED = {
    **{" ".join(odd_scenes.words_of(case)): words for case, words in reversed(odd_scenes.CASES.items())},
    "demo": ("--keep", "OUT"),
    "serve": (),
    "get": ("localhost:1", "-o", "OUT"),
    "track": ("DRIVE", "-o", "OUT"),
    "conformance": ("localhost:1", "--checks"),
    "catalog update": ("OUT",),
    "catalog query": ("OUT",),
}
"""What a verb needs beside the option."""
KNOWN = {"SOUND": "DRIVE", "ADDRESS": "localhost:1"}

FURTHER_NUMBERS = {"positive": ("inf", "0"), "share": ("0", "1.5"), "not_negative": ()}
"""What numbers of such types cannot be beside those that none can be."""


def bad_values(option):
    """Values that an option of such a type cannot have."""
    kind, numbers = option.type, ("nan", "-1", "x")
    if option.is_flag:
        return []
    if isinstance(kind, click.Choice):
        return [("nope",)]
    if isinstance(kind, click.Tuple):
        return [("x",) * len(kind.types), ("nan",) * len(kind.types)]
    if type(kind) is click.types.IntParamType:
        numbers = ("nan", "x")
    elif kind.name in FURTHER_NUMBERS:
        numbers += FURTHER_NUMBERS[kind.name]
    elif not isinstance(kind, click.types.FloatParamType | click.IntRange):
        return []
    return [(number,) for number in numbers]


CASES = [
    pytest.param(verb, name, value, id=f"{verb} {name} {' '.join(value)}")
    for verb, option, name in OPTIONS
    if name == option.opts[-1]
    for value in bad_values(option)
]


@pytest.mark.parametrize(("verb", "name", "value"), CASES)
def test_a_value_that_an_option_cannot_have_is_answered_with_the_option(call, recording, tmp_path, verb, name, value):
    words = (KNOWN.get(word, word).replace("OUT", str(tmp_path / "out")) for word in NEEDED.get(verb, ()))
    words = [word.replace("DRIVE", str(recording)) for word in words]
    outcome = call(*verb.split(), *words, name, *value)
    assert (outcome.code in (1, 2), "Traceback" in outcome.err) == (True, False), outcome
    last = [line for line in outcome.err.strip().splitlines() if not line.startswith("next: ")][-1]
    assert name.lstrip("-") in last.lower().replace("_", "-"), last
    named = re.findall(r"(?<![a-z_])[a-z]+(?:_[a-z]+)+(?![a-z_])", last.replace(str(tmp_path), ""))
    assert not named, f"arguments of functions, which nobody could type: {last}"


@pytest.mark.parametrize("words", ["fuse -o out.sfs", "depth -o out --method sparse", "colour -o map.ply"])
def test_so_many_threads_share_each_sweep(succeeds, recording, tmp_path, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    asked = set()
    resolve = system.algorithm

    def noting(kind, name):
        def run(points_world, requests, visibility, **named):
            asked.add(visibility.threads)
            return resolve(kind, name)(points_world, requests, visibility, **named)

        return run

    monkeypatch.setattr("sceneloom.fusion.system.algorithm", noting)
    verb, *others = words.split()
    succeeds(verb, recording, *others, "--threads", "2")
    assert asked == {2}
