"""Help: groups of options, examples that the verbs accept, and verbs that were meant."""

import shlex

import click
import pytest
from click.shell_completion import ShellComplete
from click.testing import CliRunner
from tests.unit.cli.conftest import verbs

from sceneloom.cli.help import Verb
from sceneloom.cli.main import sceneloom


def test_every_verb_ends_with_two_examples_that_its_options_fit(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name, verb in verbs(sceneloom):
        if name.startswith("batch ") and name != "batch status":
            continue  # they stand elsewhere, too
        assert isinstance(verb, Verb), name
        assert len(verb.examples) == 2, name
        examples = verb.lines_of(f"sceneloom {name}")
        for example in examples:
            if name == "completion":
                continue  # they are of shells
            words = shlex.split(example.partition(" > ")[0])
            assert words[: 1 + len(name.split())] == ["sceneloom", *name.split()], example
            context = click.Context(verb, help_option_names=["-h", "--help"])
            verb.make_parser(context).parse_args(words[1 + len(name.split()) :])
        assert CliRunner().invoke(sceneloom, [*name.split(), "--help"]).output.count(examples[1]) == 1


def test_rare_options_are_shown_by_help_all_and_in_their_group() -> None:
    usual, whole = (CliRunner().invoke(sceneloom, ["fuse", flag]).output for flag in ("--help", "--help-all"))
    assert "--euler-unit" not in usual
    groups = [line for line in usual.splitlines() if line and not line.startswith(" ")]
    assert groups[1:] == ["Options:", "Input:", "Output:", "General:", "Examples:"]
    assert "--euler-unit" in whole.split("\nInput:")[1].split("\nOutput:")[0]
    assert usual.split("\nGeneral:")[1].index("--help-all") < usual.split("\nGeneral:")[1].index("-h, --help")


@pytest.mark.parametrize(
    ("words", "meant"),
    [(["fsue"], "fuse"), (["edit", "corp"], "crop"), (["eval", "track"], "tracking"), (["batch", "covert"], "convert")],
)
def test_a_verb_that_is_none_names_those_that_it_resembles(words, meant) -> None:
    result = CliRunner().invoke(sceneloom, words)
    assert result.exit_code == 2
    assert f"Did you mean {meant}" in result.output


def test_names_of_formats_trajectories_and_sensors_are_completed(recording) -> None:
    def completed(arguments: list[str], incomplete: str) -> list[str]:
        found = ShellComplete(sceneloom, {}, "sceneloom", "_X").get_completions(arguments, incomplete)
        return [item.value for item in found]

    drive = str(recording)
    assert completed(["fuse", drive, "--input-format"], "ro") == ["ros1", "ros2"]
    assert completed(["convert", drive, "x", "--to"], "nus") == ["nuscenes", "nuscenes-bin"]
    assert completed(["fuse", drive, "--trajectory"], "l") == ["lidar"]
    assert completed(["edit", "crop", drive, "--sensor"], "cam") == ["camera0"]
    assert completed(["edit", "crop", "nothing.sfs", "--sensor"], "cam") == []
