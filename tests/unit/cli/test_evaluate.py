"""`sceneloom eval`: trajectories, tracks and detections."""

import re
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest
from PIL import Image

from sceneloom import read_trajectory, write_trajectory
from sceneloom.scene import Trajectory


@pytest.fixture
def trajectories(tmp_path):
    """A circle of 20 m radius, and the same one 0.5 m higher and 2 s later on its clock."""
    angles = np.linspace(0, 2 * np.pi, 200)
    rotations = np.stack([np.zeros(200), np.zeros(200), np.sin(angles / 2), np.cos(angles / 2)], axis=1)
    positions = 20 * np.stack([np.sin(angles), 1 - np.cos(angles), np.zeros(200)], axis=1)
    timestamps = 1_400_000_000_123_456_789 + np.arange(200) * 100_000_000
    write_trajectory(Trajectory("true", timestamps, positions, rotations), tmp_path / "true.tum")
    later = Trajectory("found", timestamps + 2_000_000_000, positions + np.array([0, 0, 0.5]), rotations)
    write_trajectory(later, tmp_path / "found.csv")
    return tmp_path / "found.csv", tmp_path / "true.tum"


def test_the_figures_are_printed_as_tables_given_to_machines_and_remarked_on(succeeds, reported, trajectories, call):
    lines = succeeds("eval trajectory", *trajectories, "--offset", "-2", "--align", "none").out.splitlines()
    assert lines[0] == "found against true"
    assert lines[1].startswith("200 pairs of 200 and 200 poses, 19.900 s from 1400000000.123456789 s, 125.6")
    table = {line.split("  ")[1]: line.split()[2:] for line in lines if "[m]" in line}
    assert table["translation [m]"][:5] == ["0.5"] * 5
    assert any(line.split()[:3] == ["100", "m", "5"] for line in lines), "KITTI's segments of 100 m"
    how = ("--align", "yaw", "--offset", "-2", "--start", "5", "--stop", "10", "--rpe-delta", "2s")
    report = reported("eval trajectory", *trajectories, *how)
    assert (report["pairs"], report["start_ns"], report["kitti"]) == (50, 1_400_000_005_123_456_789, None)
    assert report["alignment"]["kind"] == "yaw"
    assert report["absolute"]["translation"]["max"] == pytest.approx(0.0, abs=1e-9)
    assert [step["delta"] for step in report["relative"]] == ["2s"]
    found, true = trajectories
    copy = true.with_name("copy" + true.suffix)
    copy.write_bytes(true.read_bytes())
    for other in (true, copy):
        assert call("eval trajectory", true, other).err.count("the same poses at the same times") == 1
    assert "the same poses" not in call("eval trajectory", found, true, "--offset", "-2").err


@pytest.mark.parametrize(
    ("arguments", "code", "problem"),
    [
        (("--offset", "100"), 1, "they do not overlap in time.*add -102.0 s"),
        (("--offset", "soon"), 2, "expected a number"),
        (("--align", "affine"), 2, "affine"),
        (("--rpe-delta", "fast"), 2, "'fast'; expected seconds, metres or poses"),
        (("--est-form", "xls"), 2, "no form of trajectories 'xls'"),
        (("--plot", "out.bmp"), 2, "expected one of .png"),
    ],
)
def test_wrong_options_exit_with_two_and_trajectories_without_a_common_time_with_one(
    refuses, trajectories, arguments, code, problem
):
    assert re.search(problem, refuses(code, "", "eval trajectory", *trajectories, "--offset", "-2", *arguments).err)


def test_a_plot_is_an_image_not_replaced_unasked_and_without_matplotlib_the_extra_is_named(
    refuses, succeeds, trajectories, tmp_path, monkeypatch
):
    arguments = ("eval trajectory", *trajectories, "--offset", "-2", "--plot", tmp_path / "errors.png")
    succeeds(*arguments)
    with Image.open(tmp_path / "errors.png") as image:
        assert image.size == (1560, 780)
        assert len(image.convert("RGB").getcolors(1 << 24)) > 50, "lines and dots of several colours"
    refuses(1, "exists already", *arguments)
    succeeds(*arguments, "--overwrite")
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    refuses(1, "pip install 'sceneloom[report]'", *arguments, "--overwrite")


@pytest.mark.slow
def test_drawing_leaves_the_callers_matplotlib_alone(trajectories, tmp_path):
    program = (
        "import sys, sceneloom\n"
        f"trajectory = sceneloom.read_trajectory({str(trajectories[1])!r})\n"
        f"sceneloom.evaluate_trajectory(trajectory, trajectory, plot={str(tmp_path / 'a.png')!r})\n"
        "print('matplotlib.pyplot' in sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-W", "error", "-c", program], capture_output=True, text=True, check=False)
    assert done.stdout == "False\n", done.stderr


def test_a_drive_is_compared_with_a_file_by_name(refuses, succeeds, reported, recording, tmp_path):
    trajectory = tmp_path / "trajectory.tum"
    succeeds("convert", recording, trajectory)
    report = reported("eval trajectory", f"{recording}:groundTruth", trajectory, "--align", "none")
    assert report["absolute"]["translation"]["max"] == 0.0
    # orientations are scaled to length 1 before they are compared
    assert report["absolute"]["rotation_deg"]["max"] < 1e-10
    refuses(2, "there are: groundTruth", "eval trajectory", recording, trajectory, "--est-name", "slam")
    how = ("--est-name", "gnss", "--ref-name", "fixes", "--align", "none")
    report = reported("eval trajectory", recording, recording, *how)
    assert (report["estimate"], report["reference"]) == ("gnss", "fixes")
    # fixes of half a metre across and one in height, seen from one origin or kilometres apart
    assert report["absolute"]["translation"]["max"] < 10


def test_a_trajectory_goes_through_all_forms_and_a_drive(refuses, succeeds, reported, trajectories, tmp_path):
    names = ("b.csv", "c.jsonl", "d.txt", "drive", "e.sfs", "f.tum")
    locations = [trajectories[1], *(tmp_path / name for name in names)]
    for source, target in pairwise(locations):
        succeeds("convert", source, target)
    first, last, end = (read_trajectory(locations[k]) for k in (0, 3, -1))
    assert np.array_equal(first.timestamps_ns, last.timestamps_ns)
    assert np.array_equal(first.positions, end.positions)
    # a recording's times are numbers of 64 bits, which resolve 0.24 µs today: rounded once, and once times 1e9
    assert np.abs(first.timestamps_ns - end.timestamps_ns).max() <= 240
    words = ("convert", trajectories[1], tmp_path / "fixes.csv", "--to", "gnss")
    refuses(2, "--origin", *words)
    outcome = succeeds(*words, "--origin", "60.1", "24.9", "12.5")
    assert "quaternions_xyzw: left out (200 times)" in outcome.err
    report = reported("eval trajectory", tmp_path / "fixes.csv", trajectories[1], "--align", "none")
    # degrees of 64 bits resolve 2e-9 m
    assert report["absolute"]["translation"]["max"] < 1e-7


def test_kittis_text_and_logs_are_converted_and_the_rest_refused(succeeds, tmp_path, refuses, recording):
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 1 2\n", "ascii")
    succeeds("convert", tmp_path / "poses.txt", tmp_path / "a.tum", "--from-rate", "10", "--from-optical")
    trajectory = read_trajectory(tmp_path / "a.tum")
    assert trajectory.positions.tolist() == [[0, 0, 0], [2, 0, 0]]
    assert trajectory.timestamps_ns.tolist() == [0, 100_000_000]
    succeeds("convert", tmp_path / "a.tum", tmp_path / "b.kitti", "--to-optical")
    assert (tmp_path / "b.kitti").read_text("ascii").splitlines()[1].split()[11] == "2.0"
    assert (tmp_path / "b.times.txt").read_text("ascii") == "0.0\n0.1\n"
    lines = (
        '{"sensor":{"type":"gyroscope","values":[0,0,0.1]},"time":1.0}',
        '{"groundTruth":{"position":{"x":1,"y":2,"z":3},"orientation":{"x":0,"y":0,"z":0,"w":1}},"time":1.0}',
    )
    (tmp_path / "log.jsonl").write_text("\n".join(lines) + "\n", "utf-8")
    succeeds("convert", tmp_path / "log.jsonl", tmp_path / "log")
    assert "gyroscope" in (tmp_path / "log" / "data.jsonl").read_text("utf-8")
    (tmp_path / "trajectory.tum").write_text("1.0 0 0 0 0 0 0 1\n3.5 1 0 0 0 0 0 1\n")
    succeeds("convert", tmp_path / "trajectory.tum", tmp_path / "drive")
    out = succeeds("info", tmp_path / "drive").out
    assert ("recording, 2.500 s" in out, "\nno sensors\n" in out) == (True, True)
    outcome = refuses(2, "'tun'; there are sfs, recording, ", "convert", recording, tmp_path / "a.tum", "--to", "tun")
    assert ", tum, kitti, euroc, gnss, csv, jsonl" in outcome.err
    refuses(2, "trajectory 'gnss'", "convert", recording, tmp_path / "drive.sfs", "--trajectory", "gnss")
    assert not (tmp_path / "drive.sfs").exists()


def line(frame, track, label, left, *, score=None):
    """A box of 60 x 50 pixels, and one in space that is a metre to the right for ten pixels."""
    location = f"{left} 100 {left + 60} 150 1.5 1.7 4.2 {left / 10} 1.6 20 0.3"
    return f"{frame} {track} {label} 0 0 -10 {location}" + ("" if score is None else f" {score}")


@pytest.fixture
def sides(tmp_path):
    """Two cars over ten frames in 0000, of which one is found, in two chunks; a pedestrian in 0001, found."""
    results, truth = tmp_path / "results", tmp_path / "truth"
    for folder in (results, truth / "label_02"):
        folder.mkdir(parents=True)
    cars = [line(f, k, "Car", 100 + 200 * k + 2 * f) for f in range(10) for k in range(2)]
    (truth / "label_02" / "0000.txt").write_text("\n".join(cars) + "\n")
    (truth / "label_02" / "0001.txt").write_text(line(0, 0, "Pedestrian", 300) + "\n")
    found = [line(f, 7 if f < 5 else 8, "Car", 100 + 2 * f, score=0.9 - 0.01 * f) for f in range(10)]
    (results / "0000.txt").write_text("\n".join(found) + "\n")
    (results / "0001.txt").write_text(line(0, 3, "Pedestrian", 300, score=0.8) + "\n")
    return results, truth


def test_figures_of_tracks_are_printed_as_tables_and_given_to_machines(refuses, succeeds, reported, sides):
    results, truth = sides
    lines = succeeds("eval tracking", *sides).out.splitlines()
    assert lines[1] == "2 sequences, similarity 2d, 0.5 for CLEAR and identities"
    assert any(row.startswith("  all") for row in lines)
    # one of two cars found: half of the boxes; with two ids, each half of a track: A = 5 / 10 on both
    hota = lines[lines.index("car: 2 objects in 20 boxes, 2 tracks in 10") + 2].split()
    assert hota[:4] == ["0000", "50.00", "50.00", "50.00"]
    classes = reported("eval tracking", *sides, "--class", "Car")["classes"]
    assert list(classes) == ["Car"]
    found = classes["Car"]["combined"]
    counts = {name: found["clear"][name] for name in ("tp", "fn", "fp", "idsw", "frag", "mt", "pt", "ml")}
    assert counts == {"tp": 10, "fn": 10, "fp": 0, "idsw": 1, "frag": 0, "mt": 1, "pt": 0, "ml": 1}
    assert found["clear"]["mota"] == pytest.approx(1 - 11 / 20)
    assert (found["identity"]["idtp"], found["identity"]["idf1"]) == (5, pytest.approx(10 / 30))
    assert len(found["hota"]["curves"]["hota"]) == 19
    # chosen sequences need no others, nor two files the same name
    (results / "0001.txt").unlink()
    for name in ("0000", "0"):
        assert reported("eval tracking", *sides, "--sequence", name)["sequences"] == ["0000"]
    for name, called in (("0099", "0099"), ("", "''")):
        refuses(2, f"no sequence {called}, which `--sequence` asks for", "eval tracking", *sides, "--sequence", name)
    one = (results / "0000.txt").rename(results.parent / "mine.txt")
    report = reported("eval tracking", one, truth / "label_02" / "0000.txt")
    assert report["classes"]["car"]["combined"]["clear"]["tp"] == 10


@pytest.mark.parametrize("similarity", ["2d", "bev", "3d", "distance"])
def test_every_similarity_calls_equal_tracks_equal(reported, sides, similarity):
    classes = reported("eval tracking", sides[1], sides[1], "--similarity", similarity)["classes"]
    for combined in (classes[label]["combined"] for label in ("car", "pedestrian")):
        assert combined["hota"]["hota"] == pytest.approx(1, abs=1e-9)
        assert combined["clear"]["mota"] == combined["identity"]["idf1"] == 1


def test_figures_of_detections_are_printed_and_reported(succeeds, reported, sides, tmp_path):
    outcome = succeeds("eval detection", *sides, "--difficulty", "moderate")
    rows = {tuple(row.split()[:3]): row.split()[4:] for row in outcome.out.splitlines() if " > " in row}
    assert set(rows) == {(kind, ">", least) for kind in ("2d", "bev", "3d") for least in ("0.7", "0.5")}
    # half of the cars found, none wrong: precision 1 up to a recall of 0.5
    assert (rows["3d", ">", "0.7"][2], rows["3d", ">", "0.5"][2]) == ("66.67", "100.00")
    how = ("--class", "car", "--similarity", "bev", "--threshold", "0.3")
    (one,) = reported("eval detection", *sides, *how)["classes"]["car"]
    assert (one["similarity"], one["least_overlap"]) == ("bev", 0.3)
    scores = one["difficulties"]["hard"]
    assert (scores["precision"], scores["recall"], scores["true_objects"]) == (1.0, 0.5, 20)
    assert scores["calibration"]["error"] == pytest.approx(1 - 0.855)
    frames = [tmp_path / "frames" / name for name in ("results", "label_2")]  # of the object benchmark
    for folder, score in zip(frames, (" 0.9", ""), strict=True):
        folder.mkdir(parents=True)
        for frame in range(3):
            text = "Car 0.00 0 -1.5 100 100 200 180 1.5 1.7 4.2 1.0 1.6 20.0 0.3" + score
            (folder / f"{frame:06d}.txt").write_text(text + "\n")
    for one in reported("eval detection", *frames)["classes"]["car"]:
        assert one["difficulties"]["easy"]["true_objects"] == 3
        assert one["difficulties"]["easy"]["max_f1"] == 1


@pytest.mark.parametrize("verb", ["tracking", "detection"])
@pytest.mark.few(1)
def test_curves_are_drawn_and_not_replaced_unasked(refuses, succeeds, sides, tmp_path, verb):
    image = tmp_path / "curves.png"
    succeeds("eval", verb, *sides, "-o", image)
    with Image.open(image) as drawn:
        assert min(drawn.size) > 400
        assert len(set(drawn.convert("L").resize((60, 40)).tobytes())) > 10, "something is drawn"
    refuses(1, "--overwrite", "eval", verb, *sides, "-o", image)


@pytest.mark.parametrize(
    ("name", "text", "stated"),
    [
        ("results/0001.txt", None, "results: no sequence 0001, which the other side has"),
        ("truth/label_02/0001.txt", None, "truth: no sequence 0001, which the other side has"),
        ("results/0001.txt", "0 3 Pedestrian 0 0\n", "0001.txt: line 1"),
        ("results/0001.txt", line(0, 3, "Pedestrian", float("nan")), "0001.txt: line 1"),
    ],
)
def test_what_cannot_be_compared_exits_with_one_and_says_why(refuses, sides, tmp_path, name, text, stated):
    if text is None:
        (tmp_path / name).unlink()
    else:
        (tmp_path / name).write_text(text)
    refuses(1, stated, "eval tracking", *sides)


def test_what_is_odd_about_results_is_remarked_and_what_one_side_lacks_named(call, refuses, succeeds, sides):
    results, truth = sides
    assert "the same files" in call("eval tracking", truth / "label_02", truth).err
    assert "the same files" not in call("eval tracking", *sides).err
    with (results / "0000.txt").open("a") as stream:
        stream.write(line(10, 8, "Car", 120, score=0.5) + "\n" + line(3, -1, "Car", 700, score=0.5) + "\n")
    remarked = succeeds("eval tracking", *sides).err
    assert ("after the last one of the truth" in remarked, "id is below 0" in remarked) == (True, True)
    for path in results.iterdir():
        path.write_text(path.read_text().replace("1.5 1.7 4.2", "-1 -1 -1"))
    assert "nothing: " not in call("eval tracking", *sides).err
    stated = "similarity '3d': one side has no such boxes; comparable: 2d"
    refuses(2, stated, "eval tracking", *sides, "--similarity", "3d")
    stated = "class 'cat' occurs neither in the results nor in the truth, which have car, pedestrian"
    for verb in ("tracking", "detection"):
        refuses(2, stated, "eval", verb, *sides, "--class", "cat")
    for path in results.iterdir():
        path.write_text(line(3, -1, "Car", 700, score=0.5) + "\n")
    refuses(2, "no object has an id", "eval tracking", *sides)
