"""`sceneloom eval trajectory`, and conversions between files of trajectories."""

import json
import subprocess
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from sceneloom import read_trajectory, write_trajectory
from sceneloom.scene import Trajectory

Call = Callable[..., Any]


@pytest.fixture
def trajectories(tmp_path: Path) -> tuple[Path, Path]:
    """A circle of 20 m radius, and the same one 0.5 m higher and 2 s later on its clock."""
    angles = np.linspace(0, 2 * np.pi, 200)
    rotations = np.stack([np.zeros(200), np.zeros(200), np.sin(angles / 2), np.cos(angles / 2)], axis=1)
    positions = 20 * np.stack([np.sin(angles), 1 - np.cos(angles), np.zeros(200)], axis=1)
    timestamps = 1_400_000_000_123_456_789 + np.arange(200) * 100_000_000
    write_trajectory(Trajectory("true", timestamps, positions, rotations), tmp_path / "true.tum")
    later = Trajectory("found", timestamps + 2_000_000_000, positions + np.array([0, 0, 0.5]), rotations)
    write_trajectory(later, tmp_path / "found.csv")
    return tmp_path / "found.csv", tmp_path / "true.tum"


def test_the_figures_are_printed_as_tables(call: Call, trajectories: tuple[Path, Path]) -> None:
    outcome = call("eval", "trajectory", *trajectories, "--offset", "-2", "--align", "none")
    assert outcome.code == 0
    lines = outcome.out.splitlines()
    assert lines[0] == "found against true"
    assert lines[1].startswith("200 pairs of 200 and 200 poses, 19.900 s from 1400000000.123456789 s, 125.6")
    table = {line.split("  ")[1]: line.split()[2:] for line in lines if "[m]" in line}
    assert table["translation [m]"][:5] == ["0.5"] * 5
    assert any(line.split()[:3] == ["100", "m", "5"] for line in lines), "KITTI's segments of 100 m"


def test_the_figures_are_given_to_machines(call: Call, trajectories: tuple[Path, Path]) -> None:
    found, true = trajectories
    arguments = (
        "--align",
        "yaw",
        "--offset",
        "-2",
        "--start",
        "5",
        "--stop",
        "10",
        "--rpe-delta",
        "2s",
        "--json",
    )
    reported = json.loads(call("eval", "trajectory", found, true, *arguments).out)
    assert reported["pairs"] == 50
    assert reported["start_ns"] == 1_400_000_005_123_456_789
    assert reported["alignment"]["kind"] == "yaw"
    assert reported["absolute"]["translation"]["max"] == pytest.approx(0.0, abs=1e-9)
    assert [step["delta"] for step in reported["relative"]] == ["2s"]
    assert reported["kitti"] is None


def test_ways_without_a_common_time_exit_with_one_and_an_offset(
    call: Call, trajectories: tuple[Path, Path]
) -> None:
    outcome = call("eval", "trajectory", *trajectories, "--offset", "100")
    assert outcome.code == 1
    assert "--offset -102.0" not in outcome.out
    assert "they do not overlap in time" in outcome.err
    assert "add -102.0 s" in outcome.err


def test_a_trajectory_against_itself_or_a_copy_is_remarked(
    call: Call, trajectories: tuple[Path, Path]
) -> None:
    found, true = trajectories
    copy = true.with_name("copy" + true.suffix)
    copy.write_bytes(true.read_bytes())
    for other in (true, copy):
        assert call("eval", "trajectory", true, other).err.count("the same poses at the same times") == 1
    assert "the same poses" not in call("eval", "trajectory", found, true, "--offset", "-2").err


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (("--offset", "soon"), "expected a number"),
        (("--align", "affine"), "affine"),
        (("--rpe-delta", "fast"), "'fast'; expected seconds, metres or poses"),
        (("--est-form", "xls"), "no form of trajectories 'xls'"),
        (("--plot", "out.bmp"), "expected one of .png"),
    ],
)
def test_wrong_options_exit_with_two(
    call: Call, trajectories: tuple[Path, Path], arguments: tuple[str, ...], problem: str
) -> None:
    options = ("--offset", "-2", *arguments) if arguments[0] != "--offset" else arguments
    outcome = call("eval", "trajectory", *trajectories, *options)
    assert outcome.code == 2
    assert problem in outcome.err


def test_a_plot_is_an_image_and_is_not_replaced_unasked(
    call: Call, trajectories: tuple[Path, Path], tmp_path: Path
) -> None:
    arguments = ("eval", "trajectory", *trajectories, "--offset", "-2", "--plot", tmp_path / "errors.png")
    assert call(*arguments).code == 0
    with Image.open(tmp_path / "errors.png") as image:
        assert image.size == (1560, 780)
        colours = image.convert("RGB").getcolors(1 << 24)
    assert colours is not None
    assert len(colours) > 50, "lines and dots of several colours"
    again = call(*arguments)
    assert again.code == 1
    assert "exists already" in again.err
    assert call(*arguments, "--overwrite").code == 0


@pytest.mark.slow
def test_drawing_leaves_the_callers_matplotlib_alone(trajectories: tuple[Path, Path], tmp_path: Path) -> None:
    program = (
        "import sys, sceneloom\n"
        f"trajectory = sceneloom.read_trajectory({str(trajectories[1])!r})\n"
        f"sceneloom.evaluate_trajectory(trajectory, trajectory, plot={str(tmp_path / 'a.png')!r})\n"
        "print('matplotlib.pyplot' in sys.modules)\n"
    )
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", program], capture_output=True, text=True, check=False
    )
    assert done.stdout == "False\n", done.stderr


def test_without_matplotlib_the_extra_is_named(
    call: Call, trajectories: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    outcome = call("eval", "trajectory", *trajectories, "--offset", "-2", "--plot", tmp_path / "errors.png")
    assert outcome.code == 1
    assert "pip install 'sceneloom[report]'" in outcome.err


def test_a_drive_is_compared_with_a_file_by_name(call: Call, recording: Path, tmp_path: Path) -> None:
    assert call("convert", recording, tmp_path / "trajectory.tum").code == 0
    outcome = call(
        "eval",
        "trajectory",
        f"{recording}:groundTruth",
        tmp_path / "trajectory.tum",
        "--align",
        "none",
        "--json",
    )
    reported = json.loads(outcome.out)
    assert reported["absolute"]["translation"]["max"] == 0.0
    # orientations are scaled to length 1 before they are compared
    assert reported["absolute"]["rotation_deg"]["max"] < 1e-10
    unknown = call("eval", "trajectory", recording, tmp_path / "trajectory.tum", "--est-name", "slam")
    assert unknown.code == 2
    assert "there are: groundTruth" in unknown.err


def test_a_trajectory_goes_through_all_forms_and_a_drive(
    call: Call, trajectories: tuple[Path, Path], tmp_path: Path
) -> None:
    locations = [
        trajectories[1],
        *(tmp_path / name for name in ("b.csv", "c.jsonl", "d.txt", "drive", "e.sfs", "f.tum")),
    ]
    for source, target in pairwise(locations):
        outcome = call("convert", source, target)
        assert outcome.code == 0, outcome.err
    first, last = (read_trajectory(path) for path in (locations[0], locations[3]))
    assert np.array_equal(first.timestamps_ns, last.timestamps_ns)
    end = read_trajectory(locations[-1])
    assert np.array_equal(first.positions, end.positions)
    # a recording's times are numbers of 64 bits, which resolve 0.24 µs today: rounded once, and once times 1e9
    assert np.abs(first.timestamps_ns - end.timestamps_ns).max() <= 240


def test_a_kitti_file_is_converted_with_its_rate_and_axes(call: Call, tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 1 2\n", "ascii")
    outcome = call(
        "convert", tmp_path / "poses.txt", tmp_path / "a.tum", "--from-rate", "10", "--from-optical"
    )
    assert outcome.code == 0
    trajectory = read_trajectory(tmp_path / "a.tum")
    assert trajectory.positions.tolist() == [[0, 0, 0], [2, 0, 0]]
    assert trajectory.timestamps_ns.tolist() == [0, 100_000_000]
    back = call("convert", tmp_path / "a.tum", tmp_path / "b.kitti", "--to-optical")
    assert back.code == 0
    assert (tmp_path / "b.kitti").read_text("ascii").splitlines()[1].split()[11] == "2.0"
    assert (tmp_path / "b.times.txt").read_text("ascii") == "0.0\n0.1\n"


def test_options_of_scenes_are_refused_for_files_of_trajectories(
    call: Call, trajectories: tuple[Path, Path], tmp_path: Path
) -> None:
    outcome = call("convert", trajectories[1], tmp_path / "a.csv", "--profile", "scale")
    assert outcome.code == 2
    assert "--profile does not count here: writing a trajectory takes --to-optical, --origin" in outcome.err


def test_a_trajectory_is_written_as_fixes_around_an_origin(
    call: Call, trajectories: tuple[Path, Path], tmp_path: Path
) -> None:
    refused = call("convert", trajectories[1], tmp_path / "fixes.csv", "--to", "gnss")
    assert refused.code == 2
    assert "--origin" in refused.err
    origin = ("--origin", "60.1", "24.9", "12.5")
    outcome = call("convert", trajectories[1], tmp_path / "fixes.csv", "--to", "gnss", *origin)
    assert outcome.code == 0
    assert "quaternions_xyzw: left out (200 times)" in outcome.err
    reported = json.loads(
        call("eval", "trajectory", tmp_path / "fixes.csv", trajectories[1], "--align", "none", "--json").out
    )
    # degrees of 64 bits resolve 2e-9 m
    assert reported["absolute"]["translation"]["max"] < 1e-7


def test_the_trajectory_of_gnss_and_imu_is_compared_with_the_fixes_from_one_origin(
    call: Call, recording: Path
) -> None:
    drive = recording
    outcome = call(
        "eval",
        "trajectory",
        drive,
        drive,
        "--est-name",
        "gnss",
        "--ref-name",
        "fixes",
        "--json",
        "--align",
        "none",
    )
    assert outcome.code == 0, outcome.err
    reported = json.loads(outcome.out)
    assert reported["estimate"] == "gnss"
    assert reported["reference"] == "fixes"
    # fixes of half a metre across and one in height, seen from one origin or kilometres apart
    assert reported["absolute"]["translation"]["max"] < 10


def test_a_log_of_more_than_poses_becomes_a_drive_with_all_of_it(call: Call, tmp_path: Path) -> None:
    lines = (
        '{"sensor":{"type":"gyroscope","values":[0,0,0.1]},"time":1.0}',
        '{"groundTruth":{"position":{"x":1,"y":2,"z":3},"orientation":{"x":0,"y":0,"z":0,"w":1}},"time":1.0}',
    )
    (tmp_path / "log.jsonl").write_text("\n".join(lines) + "\n", "utf-8")
    assert call("convert", tmp_path / "log.jsonl", tmp_path / "drive").code == 0
    assert "gyroscope" in (tmp_path / "drive" / "data.jsonl").read_text("utf-8")


def test_unknown_forms_to_write_are_refused_with_those_that_there_are(call, recording, tmp_path):
    refused = call("convert", recording, tmp_path / "trajectory.tum", "--to", "tun")
    assert refused.code == 2
    assert "'tun'; there are sfs, recording, " in refused.err
    assert ", tum, kitti, euroc, gnss, csv, jsonl" in refused.err


def test_a_drive_that_is_a_trajectory_alone_is_as_long_as_that(call, tmp_path):
    (tmp_path / "trajectory.tum").write_text("1.0 0 0 0 0 0 0 1\n3.5 1 0 0 0 0 0 1\n")
    assert call("convert", tmp_path / "trajectory.tum", tmp_path / "drive").code == 0
    reported = call("info", tmp_path / "drive").out
    assert "recording, 2.500 s" in reported
    assert "\nno sensors\n" in reported


def test_a_trajectory_is_not_named_in_vain_where_a_whole_drive_is_converted(call, recording, tmp_path):
    refused = call("convert", recording, tmp_path / "drive.sfs", "--trajectory", "gnss")
    assert refused.code == 2
    assert "trajectory 'gnss'" in refused.err
    assert not (tmp_path / "drive.sfs").exists()
