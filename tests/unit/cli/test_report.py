"""`sceneloom report` on the command line."""

import json
import shutil

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
    broken = shutil.copytree(recording, tmp_path / "drive")
    with (broken / "data.jsonl").open("a") as lines:
        lines.write('{"time": 1.0, "sens\n')
    outcome = succeeds("report", broken, "--quick", "-o", tmp_path / "r.html")
    assert "that will break downstream tools" in outcome.out


def test_what_is_not_there_is_an_error(refuses, recording, tmp_path):
    page = tmp_path / "page.html"
    refuses(1, "no such file", "report", tmp_path / "nothing", "-o", page)
    refuses(1, "no.tum: no such file or folder", "report", recording, "-o", page, "--truth", tmp_path / "no.tum")
    assert not page.exists()


@pytest.mark.parametrize("text", ["".join(f"{9e8 + k} {k} 0 0 0 0 0 1\n" for k in range(5)), "a letter to somebody\n"])
def test_a_truth_of_another_time_or_kind_is_an_error_that_says_why(refuses, recording, tmp_path, text):
    page, truth = tmp_path / "page.html", tmp_path / "truth.tum"
    truth.write_text(text)
    stated = f"{truth}: cannot be compared with the drive: "
    outcome = refuses(1, stated, "report", recording, "--quick", "-o", page, "--truth", truth)
    assert "leave `--truth` out" in outcome.err
    assert not page.exists()
