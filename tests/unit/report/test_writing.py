"""Writing a report: what goes where, what is refused, and what it says of its source."""

import hashlib
import sys

import msgspec
import pytest

from sceneloom.errors import DataError, MissingExtraError, OptionError, OutputError
from sceneloom.formats.base.losses import Loss, LossReport, Support
from sceneloom.report import ReportSettings, drive_report, write_report
from sceneloom.report.page import read_losses
from sceneloom.scene import Scene


def test_page_and_numbers_are_written_beside_one_another(tmp_path):
    page, numbers = tmp_path / "r.html", tmp_path / "r.json"
    found = write_report(Scene((), source="empty"), page, numbers=numbers)
    assert page.read_text("utf-8").startswith("<!DOCTYPE html>")
    assert msgspec.json.decode(numbers.read_bytes())["name"] == found.name == "empty"


def test_outputs_are_refused_before_anything_is_read(tmp_path):
    with pytest.raises(OptionError, match=r"ends in \.html"):
        write_report("missing", tmp_path / "r.pdf")
    (tmp_path / "r.html").touch()
    with pytest.raises(OutputError, match="overwrite"):
        write_report("missing", tmp_path / "r.html")


def test_without_jinja2_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "jinja2", None)
    with pytest.raises(MissingExtraError, match=r"sceneloom\[report\]"):
        write_report(Scene(()), tmp_path / "r.html")
    assert write_report(Scene(()), numbers=tmp_path / "r.json").verdict.state  # numbers need no template


@pytest.mark.parametrize(
    ("settings", "reported"), [({"images": -1}, "images -1"), ({"compare": ("sun",)}, "compare 'sun'")]
)
def test_settings_that_cannot_be_followed_are_refused(settings, reported):
    with pytest.raises(OptionError, match=reported):
        ReportSettings(**settings)


def test_the_hash_of_a_file_is_what_sha256sum_gives(tmp_path):
    file = tmp_path / "drive.sfs"
    file.write_bytes(b"abc" * 1000)
    assert drive_report.hash_of(file) == (hashlib.sha256(b"abc" * 1000).hexdigest(), "file", 3000)


def test_the_hash_of_a_folder_changes_with_names_and_contents(tmp_path):
    (tmp_path / "a").write_bytes(b"1")
    (tmp_path / "b").write_bytes(b"2")
    first = drive_report.hash_of(tmp_path)[0]
    (tmp_path / "b").rename(tmp_path / "c")
    second = drive_report.hash_of(tmp_path)[0]
    (tmp_path / "c").write_bytes(b"3")
    assert len({first, second, drive_report.hash_of(tmp_path)[0]}) == 3


def test_a_large_drive_is_hashed_by_its_ends(tmp_path, monkeypatch):
    monkeypatch.setattr(drive_report, "MOST_HASHED", 10)
    file = tmp_path / "large"
    file.write_bytes(b"0123456789abcdef")
    digest, kind, size = drive_report.hash_of(file)
    assert (kind, size) == ("ends", 16)
    file.write_bytes(b"0123456789abcdeX")
    assert drive_report.hash_of(file)[0] != digest


def test_losses_are_read_as_a_conversion_reports_them(tmp_path):
    losses = (Loss(field="a", what="rounded", count=3, support=Support.CONVERTED, largest_error=0.5),)
    file = tmp_path / "loss.json"
    for reported in (losses, LossReport(losses), {"output": "x", "losses": LossReport(losses)}):
        file.write_bytes(msgspec.json.encode(reported))
        assert read_losses(file) == losses


@pytest.mark.parametrize("content", [b"", b"{}", b"[1]", b'{"losses": 3}', b"\xff"])
def test_what_is_no_loss_report_is_refused(tmp_path, content):
    file = tmp_path / "loss.json"
    file.write_bytes(content)
    with pytest.raises(DataError, match="loss"):
        read_losses(file)


def test_losses_stand_in_the_report(tmp_path):
    file = tmp_path / "loss.json"
    file.write_bytes(msgspec.json.encode(LossReport((Loss(field="sensors[x]", what="left out"),))))
    page = tmp_path / "r.html"
    write_report(Scene(()), page, settings=ReportSettings(losses=file))
    assert "sensors[x]" in page.read_text("utf-8")
