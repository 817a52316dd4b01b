"""`sceneloom eval tracking` and `sceneloom eval detection` on small folders of KITTI's text."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

Call = Callable[..., Any]


def line(frame: int, track: int, label: str, left: float, *, score: float | None = None) -> str:
    """A box of 60 x 50 pixels, and one in space that is a metre to the right for ten pixels."""
    location = f"{left} 100 {left + 60} 150 1.5 1.7 4.2 {left / 10} 1.6 20 0.3"
    return f"{frame} {track} {label} 0 0 -10 {location}" + ("" if score is None else f" {score}")


@pytest.fixture
def sides(tmp_path: Path) -> tuple[Path, Path]:
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


def test_figures_of_tracks_are_printed_as_tables(call: Call, sides: tuple[Path, Path]) -> None:
    outcome = call("eval", "tracking", *sides)
    assert outcome.code == 0, outcome.err
    lines = outcome.out.splitlines()
    assert lines[1] == "2 sequences, similarity 2d, 0.5 for CLEAR and identities"
    assert "car: 2 objects in 20 boxes, 2 tracks in 10" in lines
    # one of two cars found: half of the boxes; with two ids, each half of a track: A = 5 / 10 on both
    shares = {row.split()[0]: row.split()[1:] for row in lines if row.startswith("  all")}
    assert shares["all"]
    hota = lines[lines.index("car: 2 objects in 20 boxes, 2 tracks in 10") + 2].split()
    assert hota[:4] == ["0000", "50.00", "50.00", "50.00"]


def test_figures_of_tracks_are_given_to_machines(call: Call, sides: tuple[Path, Path]) -> None:
    reported = json.loads(call("eval", "tracking", *sides, "--class", "Car", "--json").out)
    assert list(reported["classes"]) == ["Car"]
    clear = reported["classes"]["Car"]["combined"]["clear"]
    counts = {name: clear[name] for name in ("tp", "fn", "fp", "idsw", "frag", "mt", "pt", "ml")}
    assert counts == {"tp": 10, "fn": 10, "fp": 0, "idsw": 1, "frag": 0, "mt": 1, "pt": 0, "ml": 1}
    assert clear["mota"] == pytest.approx(1 - 11 / 20)
    identity = reported["classes"]["Car"]["combined"]["identity"]
    assert (identity["idtp"], identity["idf1"]) == (5, pytest.approx(10 / 30))
    assert len(reported["classes"]["Car"]["combined"]["hota"]["curves"]["hota"]) == 19


@pytest.mark.parametrize("similarity", ["2d", "bev", "3d", "distance"])
def test_every_similarity_calls_equal_tracks_equal(
    call: Call, sides: tuple[Path, Path], similarity: str
) -> None:
    truth = sides[1]
    reported = json.loads(call("eval", "tracking", truth, truth, "--similarity", similarity, "--json").out)
    for label in ("car", "pedestrian"):
        combined = reported["classes"][label]["combined"]
        assert combined["hota"]["hota"] == pytest.approx(1, abs=1e-9)
        assert combined["clear"]["mota"] == combined["identity"]["idf1"] == 1


def test_figures_of_detections_are_printed_as_tables(call: Call, sides: tuple[Path, Path]) -> None:
    outcome = call("eval", "detection", *sides, "--difficulty", "moderate")
    assert outcome.code == 0, outcome.err
    rows = {tuple(row.split()[:3]): row.split()[4:] for row in outcome.out.splitlines() if " > " in row}
    assert set(rows) == {(kind, ">", least) for kind in ("2d", "bev", "3d") for least in ("0.7", "0.5")}
    # half of the cars found, none wrong: precision 1 up to a recall of 0.5
    assert rows["3d", ">", "0.7"][2] == "66.67"
    assert rows["3d", ">", "0.5"][2] == "100.00"


def test_figures_of_detections_are_given_to_machines(call: Call, sides: tuple[Path, Path]) -> None:
    arguments = ("--class", "car", "--similarity", "bev", "--threshold", "0.3", "--json")
    reported = json.loads(call("eval", "detection", *sides, *arguments).out)
    (one,) = reported["classes"]["car"]
    assert (one["similarity"], one["least_overlap"]) == ("bev", 0.3)
    scores = one["difficulties"]["hard"]
    assert (scores["precision"], scores["recall"], scores["true_objects"]) == (1.0, 0.5, 20)
    assert scores["calibration"]["error"] == pytest.approx(1 - 0.855)


@pytest.mark.parametrize("verb", ["tracking", "detection"])
@pytest.mark.few(1)
def test_curves_are_drawn_and_not_replaced_unasked(
    call: Call, sides: tuple[Path, Path], tmp_path: Path, verb: str
) -> None:
    image = tmp_path / "curves.png"
    assert call("eval", verb, *sides, "-o", image).code == 0
    with Image.open(image) as drawn:
        assert min(drawn.size) > 400
        assert len(set(drawn.convert("L").resize((60, 40)).tobytes())) > 10, "something is drawn"
    again = call("eval", verb, *sides, "-o", image)
    assert again.code == 1
    assert "--overwrite" in again.err


@pytest.mark.parametrize(
    ("change", "stated"),
    [
        (
            lambda results, truth: (results / "0001.txt").unlink(),
            "results: no sequence 0001, which the other side has",
        ),
        (
            lambda results, truth: (truth / "label_02" / "0001.txt").unlink(),
            "truth: no sequence 0001, which the other side has",
        ),
        (
            lambda results, truth: (results / "0001.txt").write_text("0 3 Pedestrian 0 0\n"),
            "0001.txt: line 1",
        ),
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
def test_what_cannot_be_compared_exits_with_one_and_says_why(
    call: Call, sides: tuple[Path, Path], change: Callable[[Path, Path], None], stated: str
) -> None:
    change(*sides)
    outcome = call("eval", "tracking", *sides)
    assert outcome.code == 1
    assert stated in outcome.err


def test_chosen_sequences_need_no_others(call: Call, sides: tuple[Path, Path]) -> None:
    results, truth = sides
    (results / "0001.txt").unlink()
    for name in ("0000", "0"):
        reported = json.loads(call("eval", "tracking", results, truth, "--sequence", name, "--json").out)
        assert reported["sequences"] == ["0000"]
    for name, called in (("0099", "0099"), ("", "''")):
        missing = call("eval", "tracking", results, truth, "--sequence", name)
        assert missing.code == 2
        assert f"no sequence {called}, which `--sequence` asks for" in missing.err


def test_empty_results_are_all_missed(call: Call, sides: tuple[Path, Path]) -> None:
    results, truth = sides
    for path in results.iterdir():
        path.write_text("")
    for verb in ("tracking", "detection"):
        reported = json.loads(call("eval", verb, results, truth, "--class", "car", "--json").out)
        if verb == "tracking":
            assert reported["classes"]["car"]["combined"]["clear"]["fn"] == 20
        else:
            assert [one["difficulties"]["easy"]["ap40"] for one in reported["classes"]["car"]] == [0, 0, 0]


def test_results_after_the_last_frame_of_the_truth_are_remarked(call: Call, sides: tuple[Path, Path]) -> None:
    results, truth = sides
    with (results / "0000.txt").open("a") as stream:
        stream.write(line(10, 8, "Car", 120, score=0.5) + "\n")
    outcome = call("eval", "tracking", results, truth)
    assert outcome.code == 0
    assert "results-beyond-truth" in outcome.err or "after the last one of the truth" in outcome.err


def test_boxes_that_one_side_lacks_are_named(call: Call, sides: tuple[Path, Path]) -> None:
    results, truth = sides
    for path in results.iterdir():
        path.write_text(path.read_text().replace("1.5 1.7 4.2", "-1 -1 -1"))
    assert "nothing: " not in call("eval", "tracking", results, truth).err
    outcome = call("eval", "tracking", results, truth, "--similarity", "3d")
    assert outcome.code == 2
    assert "similarity '3d': one side has no such boxes; comparable: 2d" in outcome.err


def test_the_truth_held_against_itself_is_remarked(call: Call, sides: tuple[Path, Path]) -> None:
    truth = sides[1]
    assert "the same files" in call("eval", "tracking", truth / "label_02", truth).err
    assert "the same files" not in call("eval", "tracking", *sides).err


def test_two_files_are_compared_whatever_their_names(
    call: Call, sides: tuple[Path, Path], tmp_path: Path
) -> None:
    results, truth = sides
    one = (results / "0000.txt").rename(tmp_path / "mine.txt")
    reported = json.loads(call("eval", "tracking", one, truth / "label_02" / "0000.txt", "--json").out)
    assert reported["classes"]["car"]["combined"]["clear"]["tp"] == 10


def test_files_of_frames_are_the_object_benchmark(call: Call, tmp_path: Path) -> None:
    for name, score in (("results", " 0.9"), ("label_2", "")):
        (tmp_path / name).mkdir()
        for frame in range(3):
            text = "Car 0.00 0 -1.5 100 100 200 180 1.5 1.7 4.2 1.0 1.6 20.0 0.3" + score
            (tmp_path / name / f"{frame:06d}.txt").write_text(text + "\n")
    reported = json.loads(call("eval", "detection", tmp_path / "results", tmp_path / "label_2", "--json").out)
    for one in reported["classes"]["car"]:
        assert one["difficulties"]["easy"]["true_objects"] == 3
        assert one["difficulties"]["easy"]["max_f1"] == 1


def test_a_class_that_nobody_has_is_named(call: Call, sides: tuple[Path, Path]) -> None:
    for verb in ("tracking", "detection"):
        outcome = call("eval", verb, *sides, "--class", "cat")
        assert outcome.code == 2
        assert (
            "class 'cat' occurs neither in the results nor in the truth, which have car, pedestrian"
            in outcome.err
        )


def test_results_without_ids_are_remarked_or_refused(call: Call, sides: tuple[Path, Path]) -> None:
    results, truth = sides
    with (results / "0000.txt").open("a") as stream:
        stream.write(line(3, -1, "Car", 700, score=0.5) + "\n")
    outcome = call("eval", "tracking", results, truth)
    assert "results-without-id" in outcome.err or "id is below 0" in outcome.err
    for path in results.iterdir():
        path.write_text(line(3, -1, "Car", 700, score=0.5) + "\n")
    outcome = call("eval", "tracking", results, truth)
    assert outcome.code == 2
    assert "no object has an id" in outcome.err
