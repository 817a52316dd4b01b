"""`sceneloom report` on the command line."""

import json

import pytest


def test_a_page_and_its_numbers(succeeds, recording, tmp_path):
    page, numbers = tmp_path / "r.html", tmp_path / "r.json"
    outcome = succeeds("report", recording, "-o", page, "--numbers", numbers)
    assert outcome.out.startswith("drive: ")
    assert f"page: {page}" in outcome.out
    reported = json.loads(numbers.read_text("utf-8"))
    assert reported["validation"]["frames_read"] is True
    assert reported["provenance"]["hashed"] == "folder"
    assert "</html>" in page.read_text("utf-8")


def test_numbers_alone_are_printed(call, recording, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    outcome = call("report", recording, "--json", "--quick")
    assert json.loads(outcome.out)["verdict"]["state"] in {"sound", "look", "faulty"}
    assert list(tmp_path.iterdir()) == []


def test_a_drive_whose_lines_are_broken_is_reported_to_be_faulty(succeeds, recording, tmp_path):
    import shutil

    broken = tmp_path / "drive"
    shutil.copytree(recording, broken)
    with (broken / "data.jsonl").open("a") as lines:
        lines.write('{"time": 1.0, "sens\n')
    outcome = succeeds("report", broken, "--quick", "-o", tmp_path / "r.html")
    assert "that will break downstream tools" in outcome.out


def test_a_path_that_is_not_there_is_an_error(call, tmp_path):
    outcome = call("report", tmp_path / "nothing", "-o", tmp_path / "r.html")
    assert outcome.code == 1
    assert "no such file" in outcome.err


def test_a_truth_that_is_not_there_is_an_error(refuses, recording, tmp_path):
    refuses(
        1,
        "no.tum: no such file or folder",
        "report",
        recording,
        "-o",
        tmp_path / "page.html",
        "--truth",
        tmp_path / "no.tum",
    )
    assert not (tmp_path / "page.html").exists()


@pytest.mark.parametrize("kind", ["another time", "another kind"])
def test_a_truth_that_cannot_be_compared_is_an_error_that_says_why(call, recording, tmp_path, kind):
    truth = tmp_path / "truth.tum"
    if kind == "another time":
        truth.write_text("".join(f"{9e8 + k} {k} 0 0 0 0 0 1\n" for k in range(5)))
    else:
        truth.write_text("a letter to somebody\n")
    outcome = call("report", recording, "--quick", "-o", tmp_path / "page.html", "--truth", truth)
    assert outcome.code == 1, outcome.out
    assert f"{truth}: cannot be compared with the drive: " in outcome.err
    assert "leave `--truth` out" in outcome.err
    assert not (tmp_path / "page.html").exists()
