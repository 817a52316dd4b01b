"""`sceneloom report` on the command line."""

import json
import shutil


def test_a_page_and_its_numbers_also_of_a_broken_drive(succeeds, reported, recording, tmp_path, monkeypatch):
    page, numbers = tmp_path / "r.html", tmp_path / "r.json"
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    outcome = succeeds("report", recording, "-o", page, "--numbers", numbers)
    assert outcome.out.startswith("drive: ")
    assert f"page: {page}" in outcome.out
    found = json.loads(numbers.read_text("utf-8"))
    assert (found["validation"]["frames_read"], found["provenance"]["hashed"]) == (True, "folder")
    assert "</html>" in page.read_text("utf-8")
    assert reported("report", recording, "--quick")["verdict"]["state"] in {"sound", "look", "faulty"}
    assert list((tmp_path / "here").iterdir()) == []
    broken = shutil.copytree(recording, tmp_path / "drive")
    with (broken / "data.jsonl").open("a") as lines:
        lines.write('{"time": 1.0, "sens\n')
    outcome = succeeds("report", broken, "--quick", "-o", page, "--overwrite")
    assert "that will break downstream tools" in outcome.out


def test_what_is_not_there_and_a_truth_of_another_time_or_kind_are_errors_that_say_why(refuses, recording, tmp_path):
    page, truth = tmp_path / "page.html", tmp_path / "truth.tum"
    refuses(1, "no such file", "report", tmp_path / "nothing", "-o", page)
    words = ("report", recording, "--quick", "-o", page, "--truth", truth)
    refuses(1, "truth.tum: no such file or folder", *words)
    for text in ("".join(f"{9e8 + k} {k} 0 0 0 0 0 1\n" for k in range(5)), "a letter to somebody\n"):
        truth.write_text(text)
        assert "leave `--truth` out" in refuses(1, f"{truth}: cannot be compared with the drive: ", *words).err
    assert not page.exists()
