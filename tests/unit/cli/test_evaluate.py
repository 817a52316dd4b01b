"""`sceneloom eval`: trajectories, tracks and detections."""

import json
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


def test_the_figures_are_printed_as_tables(succeeds, trajectories):
    outcome = succeeds("eval trajectory", *trajectories, "--offset", "-2", "--align", "none")
    lines = outcome.out.splitlines()
    assert lines[0] == "found against true"
    assert lines[1].startswith("200 pairs of 200 and 200 poses, 19.900 s from 1400000000.123456789 s, 125.6")
    table = {line.split("  ")[1]: line.split()[2:] for line in lines if "[m]" in line}
    assert table["translation [m]"][:5] == ["0.5"] * 5
    assert any(line.split()[:3] == ["100", "m", "5"] for line in lines), "KITTI's segments of 100 m"


def test_the_figures_are_given_to_machines(call, trajectories):
    found, true = trajectories
    arguments = ("--align", "yaw", "--offset", "-2", "--start", "5", "--stop", "10", "--rpe-delta", "2s", "--json")
    reported = json.loads(call("eval trajectory", found, true, *arguments).out)
    assert reported["pairs"] == 50
    assert reported["start_ns"] == 1_400_000_005_123_456_789
    assert reported["alignment"]["kind"] == "yaw"
    assert reported["absolute"]["translation"]["max"] == pytest.approx(0.0, abs=1e-9)
    assert [step["delta"] for step in reported["relative"]] == ["2s"]
    assert reported["kitti"] is None


def test_ways_without_a_common_time_exit_with_one_and_an_offset(call, trajectories):
    outcome = call("eval trajectory", *trajectories, "--offset", "100")
    assert outcome.code == 1
    assert "--offset -102.0" not in outcome.out
    assert "they do not overlap in time" in outcome.err
    assert "add -102.0 s" in outcome.err


def test_a_trajectory_against_itself_or_a_copy_is_remarked(call, trajectories):
    found, true = trajectories
    copy = true.with_name("copy" + true.suffix)
    copy.write_bytes(true.read_bytes())
    for other in (true, copy):
        assert call("eval trajectory", true, other).err.count("the same poses at the same times") == 1
    assert "the same poses" not in call("eval trajectory", found, true, "--offset", "-2").err


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
def test_wrong_options_exit_with_two(call, trajectories, arguments, problem):
    options = ("--offset", "-2", *arguments) if arguments[0] != "--offset" else arguments
    outcome = call("eval trajectory", *trajectories, *options)
    assert outcome.code == 2
    assert problem in outcome.err


def test_a_plot_is_an_image_and_is_not_replaced_unasked(call, succeeds, trajectories, tmp_path):
    arguments = ("eval", "trajectory", *trajectories, "--offset", "-2", "--plot", tmp_path / "errors.png")
    succeeds(*arguments)
    with Image.open(tmp_path / "errors.png") as image:
        assert image.size == (1560, 780)
        colours = image.convert("RGB").getcolors(1 << 24)
    assert colours is not None
    assert len(colours) > 50, "lines and dots of several colours"
    again = call(*arguments)
    assert again.code == 1
    assert "exists already" in again.err
    succeeds(*arguments, "--overwrite")


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


def test_without_matplotlib_the_extra_is_named(call, trajectories, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    outcome = call("eval trajectory", *trajectories, "--offset", "-2", "--plot", tmp_path / "errors.png")
    assert outcome.code == 1
    assert "pip install 'sceneloom[report]'" in outcome.err


def test_a_drive_is_compared_with_a_file_by_name(call, succeeds, recording, tmp_path):
    succeeds("convert", recording, tmp_path / "trajectory.tum")
    outcome = call(
        "eval trajectory", f"{recording}:groundTruth", tmp_path / "trajectory.tum", "--align", "none", "--json"
    )
    reported = json.loads(outcome.out)
    assert reported["absolute"]["translation"]["max"] == 0.0
    # orientations are scaled to length 1 before they are compared
    assert reported["absolute"]["rotation_deg"]["max"] < 1e-10
    unknown = call("eval trajectory", recording, tmp_path / "trajectory.tum", "--est-name", "slam")
    assert unknown.code == 2
    assert "there are: groundTruth" in unknown.err


def test_a_trajectory_goes_through_all_forms_and_a_drive(succeeds, trajectories, tmp_path):
    locations = [
        trajectories[1],
        *(tmp_path / name for name in ("b.csv", "c.jsonl", "d.txt", "drive", "e.sfs", "f.tum")),
    ]
    for source, target in pairwise(locations):
        succeeds("convert", source, target)
    first, last = (read_trajectory(path) for path in (locations[0], locations[3]))
    assert np.array_equal(first.timestamps_ns, last.timestamps_ns)
    end = read_trajectory(locations[-1])
    assert np.array_equal(first.positions, end.positions)
    # a recording's times are numbers of 64 bits, which resolve 0.24 µs today: rounded once, and once times 1e9
    assert np.abs(first.timestamps_ns - end.timestamps_ns).max() <= 240


def test_a_kitti_file_is_converted_with_its_rate_and_axes(succeeds, tmp_path):
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 1 2\n", "ascii")
    succeeds("convert", tmp_path / "poses.txt", tmp_path / "a.tum", "--from-rate", "10", "--from-optical")
    trajectory = read_trajectory(tmp_path / "a.tum")
    assert trajectory.positions.tolist() == [[0, 0, 0], [2, 0, 0]]
    assert trajectory.timestamps_ns.tolist() == [0, 100_000_000]
    succeeds("convert", tmp_path / "a.tum", tmp_path / "b.kitti", "--to-optical")
    assert (tmp_path / "b.kitti").read_text("ascii").splitlines()[1].split()[11] == "2.0"
    assert (tmp_path / "b.times.txt").read_text("ascii") == "0.0\n0.1\n"


def test_options_of_scenes_are_refused_for_files_of_trajectories(call, trajectories, tmp_path):
    outcome = call("convert", trajectories[1], tmp_path / "a.csv", "--profile", "scale")
    assert outcome.code == 2
    assert "--profile does not count here: writing a trajectory takes --to-optical, --origin" in outcome.err


def test_a_trajectory_is_written_as_fixes_around_an_origin(call, succeeds, trajectories, tmp_path):
    refused = call("convert", trajectories[1], tmp_path / "fixes.csv", "--to", "gnss")
    assert refused.code == 2
    assert "--origin" in refused.err
    origin = ("--origin", "60.1", "24.9", "12.5")
    outcome = succeeds("convert", trajectories[1], tmp_path / "fixes.csv", "--to", "gnss", *origin)
    assert "quaternions_xyzw: left out (200 times)" in outcome.err
    reported = json.loads(
        call("eval trajectory", tmp_path / "fixes.csv", trajectories[1], "--align", "none", "--json").out
    )
    # degrees of 64 bits resolve 2e-9 m
    assert reported["absolute"]["translation"]["max"] < 1e-7


def test_the_trajectory_of_gnss_and_imu_is_compared_with_the_fixes_from_one_origin(succeeds, recording):
    drive = recording
    outcome = succeeds(
        "eval trajectory", drive, drive, "--est-name", "gnss", "--ref-name", "fixes", "--json", "--align", "none"
    )
    reported = json.loads(outcome.out)
    assert reported["estimate"] == "gnss"
    assert reported["reference"] == "fixes"
    # fixes of half a metre across and one in height, seen from one origin or kilometres apart
    assert reported["absolute"]["translation"]["max"] < 10


def test_a_log_of_more_than_poses_becomes_a_drive_with_all_of_it(succeeds, tmp_path):
    lines = (
        '{"sensor":{"type":"gyroscope","values":[0,0,0.1]},"time":1.0}',
        '{"groundTruth":{"position":{"x":1,"y":2,"z":3},"orientation":{"x":0,"y":0,"z":0,"w":1}},"time":1.0}',
    )
    (tmp_path / "log.jsonl").write_text("\n".join(lines) + "\n", "utf-8")
    succeeds("convert", tmp_path / "log.jsonl", tmp_path / "drive")
    assert "gyroscope" in (tmp_path / "drive" / "data.jsonl").read_text("utf-8")


def test_unknown_forms_to_write_are_refused_with_those_that_there_are(call, recording, tmp_path):
    refused = call("convert", recording, tmp_path / "trajectory.tum", "--to", "tun")
    assert refused.code == 2
    assert "'tun'; there are sfs, recording, " in refused.err
    assert ", tum, kitti, euroc, gnss, csv, jsonl" in refused.err


def test_a_drive_that_is_a_trajectory_alone_is_as_long_as_that(call, succeeds, tmp_path):
    (tmp_path / "trajectory.tum").write_text("1.0 0 0 0 0 0 0 1\n3.5 1 0 0 0 0 0 1\n")
    succeeds("convert", tmp_path / "trajectory.tum", tmp_path / "drive")
    reported = call("info", tmp_path / "drive").out
    assert "recording, 2.500 s" in reported
    assert "\nno sensors\n" in reported


def test_a_trajectory_is_not_named_in_vain_where_a_whole_drive_is_converted(call, recording, tmp_path):
    refused = call("convert", recording, tmp_path / "drive.sfs", "--trajectory", "gnss")
    assert refused.code == 2
    assert "trajectory 'gnss'" in refused.err
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


def test_figures_of_tracks_are_printed_as_tables(succeeds, sides):
    outcome = succeeds("eval tracking", *sides)
    lines = outcome.out.splitlines()
    assert lines[1] == "2 sequences, similarity 2d, 0.5 for CLEAR and identities"
    assert "car: 2 objects in 20 boxes, 2 tracks in 10" in lines
    # one of two cars found: half of the boxes; with two ids, each half of a track: A = 5 / 10 on both
    shares = {row.split()[0]: row.split()[1:] for row in lines if row.startswith("  all")}
    assert shares["all"]
    hota = lines[lines.index("car: 2 objects in 20 boxes, 2 tracks in 10") + 2].split()
    assert hota[:4] == ["0000", "50.00", "50.00", "50.00"]


def test_figures_of_tracks_are_given_to_machines(call, sides):
    reported = json.loads(call("eval tracking", *sides, "--class", "Car", "--json").out)
    assert list(reported["classes"]) == ["Car"]
    clear = reported["classes"]["Car"]["combined"]["clear"]
    counts = {name: clear[name] for name in ("tp", "fn", "fp", "idsw", "frag", "mt", "pt", "ml")}
    assert counts == {"tp": 10, "fn": 10, "fp": 0, "idsw": 1, "frag": 0, "mt": 1, "pt": 0, "ml": 1}
    assert clear["mota"] == pytest.approx(1 - 11 / 20)
    identity = reported["classes"]["Car"]["combined"]["identity"]
    assert (identity["idtp"], identity["idf1"]) == (5, pytest.approx(10 / 30))
    assert len(reported["classes"]["Car"]["combined"]["hota"]["curves"]["hota"]) == 19


@pytest.mark.parametrize("similarity", ["2d", "bev", "3d", "distance"])
def test_every_similarity_calls_equal_tracks_equal(call, sides, similarity):
    truth = sides[1]
    reported = json.loads(call("eval tracking", truth, truth, "--similarity", similarity, "--json").out)
    for label in ("car", "pedestrian"):
        combined = reported["classes"][label]["combined"]
        assert combined["hota"]["hota"] == pytest.approx(1, abs=1e-9)
        assert combined["clear"]["mota"] == combined["identity"]["idf1"] == 1


def test_figures_of_detections_are_printed_as_tables(succeeds, sides):
    outcome = succeeds("eval detection", *sides, "--difficulty", "moderate")
    rows = {tuple(row.split()[:3]): row.split()[4:] for row in outcome.out.splitlines() if " > " in row}
    assert set(rows) == {(kind, ">", least) for kind in ("2d", "bev", "3d") for least in ("0.7", "0.5")}
    # half of the cars found, none wrong: precision 1 up to a recall of 0.5
    assert rows["3d", ">", "0.7"][2] == "66.67"
    assert rows["3d", ">", "0.5"][2] == "100.00"


def test_figures_of_detections_are_given_to_machines(call, sides):
    arguments = ("--class", "car", "--similarity", "bev", "--threshold", "0.3", "--json")
    reported = json.loads(call("eval detection", *sides, *arguments).out)
    (one,) = reported["classes"]["car"]
    assert (one["similarity"], one["least_overlap"]) == ("bev", 0.3)
    scores = one["difficulties"]["hard"]
    assert (scores["precision"], scores["recall"], scores["true_objects"]) == (1.0, 0.5, 20)
    assert scores["calibration"]["error"] == pytest.approx(1 - 0.855)


@pytest.mark.parametrize("verb", ["tracking", "detection"])
@pytest.mark.few(1)
def test_curves_are_drawn_and_not_replaced_unasked(call, succeeds, sides, tmp_path, verb):
    image = tmp_path / "curves.png"
    succeeds("eval", verb, *sides, "-o", image)
    with Image.open(image) as drawn:
        assert min(drawn.size) > 400
        assert len(set(drawn.convert("L").resize((60, 40)).tobytes())) > 10, "something is drawn"
    again = call("eval", verb, *sides, "-o", image)
    assert again.code == 1
    assert "--overwrite" in again.err


@pytest.mark.parametrize(
    ("change", "stated"),
    [
        (lambda results, truth: (results / "0001.txt").unlink(), "results: no sequence 0001, which the other side has"),
        (
            lambda results, truth: (truth / "label_02" / "0001.txt").unlink(),
            "truth: no sequence 0001, which the other side has",
        ),
        (lambda results, truth: (results / "0001.txt").write_text("0 3 Pedestrian 0 0\n"), "0001.txt: line 1"),
        (
            lambda results, truth: (results / "0001.txt").write_text(line(0, 3, "Pedestrian", float("nan"))),
            "0001.txt: line 1",
        ),
        (
            lambda results, truth: (results / "0000.txt").write_text(
                "\n".join([line(4, 2, "Car", 100), line(4, 2, "Car", 200)])
            ),
            "sequence 0000: results: frame 4: two boxes of Car with id 2",
        ),
    ],
)
def test_what_cannot_be_compared_exits_with_one_and_says_why(call, sides, change, stated):
    change(*sides)
    outcome = call("eval tracking", *sides)
    assert outcome.code == 1
    assert stated in outcome.err


def test_chosen_sequences_need_no_others(call, sides):
    results, truth = sides
    (results / "0001.txt").unlink()
    for name in ("0000", "0"):
        reported = json.loads(call("eval tracking", results, truth, "--sequence", name, "--json").out)
        assert reported["sequences"] == ["0000"]
    for name, called in (("0099", "0099"), ("", "''")):
        missing = call("eval tracking", results, truth, "--sequence", name)
        assert missing.code == 2
        assert f"no sequence {called}, which `--sequence` asks for" in missing.err


def test_empty_results_are_all_missed(call, sides):
    results, truth = sides
    for path in results.iterdir():
        path.write_text("")
    for verb in ("tracking", "detection"):
        reported = json.loads(call("eval", verb, results, truth, "--class", "car", "--json").out)
        if verb == "tracking":
            assert reported["classes"]["car"]["combined"]["clear"]["fn"] == 20
        else:
            assert [one["difficulties"]["easy"]["ap40"] for one in reported["classes"]["car"]] == [0, 0, 0]


def test_results_after_the_last_frame_of_the_truth_are_remarked(succeeds, sides):
    results, truth = sides
    with (results / "0000.txt").open("a") as stream:
        stream.write(line(10, 8, "Car", 120, score=0.5) + "\n")
    outcome = succeeds("eval tracking", results, truth)
    assert "results-beyond-truth" in outcome.err or "after the last one of the truth" in outcome.err


def test_boxes_that_one_side_lacks_are_named(call, sides):
    results, truth = sides
    for path in results.iterdir():
        path.write_text(path.read_text().replace("1.5 1.7 4.2", "-1 -1 -1"))
    assert "nothing: " not in call("eval tracking", results, truth).err
    outcome = call("eval tracking", results, truth, "--similarity", "3d")
    assert outcome.code == 2
    assert "similarity '3d': one side has no such boxes; comparable: 2d" in outcome.err


def test_the_truth_held_against_itself_is_remarked(call, sides):
    truth = sides[1]
    assert "the same files" in call("eval tracking", truth / "label_02", truth).err
    assert "the same files" not in call("eval tracking", *sides).err


def test_two_files_are_compared_whatever_their_names(call, sides, tmp_path):
    results, truth = sides
    one = (results / "0000.txt").rename(tmp_path / "mine.txt")
    reported = json.loads(call("eval tracking", one, truth / "label_02" / "0000.txt", "--json").out)
    assert reported["classes"]["car"]["combined"]["clear"]["tp"] == 10


def test_files_of_frames_are_the_object_benchmark(call, tmp_path):
    for name, score in (("results", " 0.9"), ("label_2", "")):
        (tmp_path / name).mkdir()
        for frame in range(3):
            text = "Car 0.00 0 -1.5 100 100 200 180 1.5 1.7 4.2 1.0 1.6 20.0 0.3" + score
            (tmp_path / name / f"{frame:06d}.txt").write_text(text + "\n")
    reported = json.loads(call("eval detection", tmp_path / "results", tmp_path / "label_2", "--json").out)
    for one in reported["classes"]["car"]:
        assert one["difficulties"]["easy"]["true_objects"] == 3
        assert one["difficulties"]["easy"]["max_f1"] == 1


def test_a_class_that_nobody_has_is_named(call, sides):
    for verb in ("tracking", "detection"):
        outcome = call("eval", verb, *sides, "--class", "cat")
        assert outcome.code == 2
        assert "class 'cat' occurs neither in the results nor in the truth, which have car, pedestrian" in outcome.err


def test_results_without_ids_are_remarked_or_refused(call, sides):
    results, truth = sides
    with (results / "0000.txt").open("a") as stream:
        stream.write(line(3, -1, "Car", 700, score=0.5) + "\n")
    outcome = call("eval tracking", results, truth)
    assert "results-without-id" in outcome.err or "id is below 0" in outcome.err
    for path in results.iterdir():
        path.write_text(line(3, -1, "Car", 700, score=0.5) + "\n")
    outcome = call("eval tracking", results, truth)
    assert outcome.code == 2
    assert "no object has an id" in outcome.err
