"""Reports hold all that was sent, expected and found, whatever a server wrote into it."""

import json
from html.parser import HTMLParser

import pytest

from sceneloom.db34t.conformance.examination import examine
from sceneloom.errors import OptionError, OutputError

from .defects import Broken, status_two
from .peers import HereTransport


def renamed(_, method, request, reply):
    if method == "GetProperty":
        reply.description = "<script>alert(1)</script> | & \n # x"
    return reply


@pytest.fixture(scope="module")
def examination():
    only = ["5.3", "T10-5"]
    return examine(Broken(HereTransport(), outgoing=status_two), address="127.0.0.1:1", only=only)


def test_json_holds_every_check_with_what_it_saw(examination, tmp_path):
    examination.write(tmp_path / "r.json")
    found = json.loads((tmp_path / "r.json").read_text("utf-8"))
    assert (found["address"], found["passed"], found["counts"]) == (
        "127.0.0.1:1",
        False,
        {"passed": 4, "failed": 1},
    )
    failed = next(check for check in found["checks"] if check["verdict"] == "failed")
    assert failed["id"] == "5.3-3"
    assert "1—添加成功" in failed["chinese"]
    assert {"sent": "AddProperty speed", "expected": "1", "found": "2", "agrees": False} in failed["seen"]


def test_markdown_has_a_row_for_each_check_and_a_section_for_each_that_failed(examination, tmp_path):
    examination.write(tmp_path / "r.md")
    lines = (tmp_path / "r.md").read_text("utf-8").splitlines()
    assert sum(line.startswith(("| 5.3-", "| T10-")) for line in lines) == len(examination.findings)
    assert [line for line in lines if line.startswith("## ")] == [
        "## 5.3-3: adding returns 1, and 0 where the name is taken"
    ]
    assert "| AddProperty speed | 1 | 2 |" in lines


class Page(HTMLParser):
    """Counts the elements of a page."""

    def __init__(self):
        super().__init__()
        self.tags = []

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)


def test_html_shows_each_check_and_runs_nothing_that_a_server_wrote(tmp_path):
    found = examine(Broken(HereTransport(), outgoing=renamed), address="<b>", only=["5.3-1"])
    assert found.failed_ids == ("5.3-1",)
    for suffix in (".html", ".md"):
        found.write(tmp_path / f"r{suffix}")
    page = Page()
    page.feed((tmp_path / "r.html").read_text("utf-8"))
    assert page.tags.count("details") == 1
    assert not {"script", "b"} & set(page.tags)
    table = (tmp_path / "r.md").read_text("utf-8").split("| sent |")[1]
    assert all(line.count(" | ") == 2 for line in table.splitlines()[2:] if line)


def test_other_suffixes_and_files_that_are_there_are_refused(examination, tmp_path):
    with pytest.raises(OptionError, match=r"\.json, \.md, \.html"):
        examination.write(tmp_path / "r.pdf")
    (tmp_path / "r.md").write_text("mine")
    with pytest.raises(OutputError, match="exists already"):
        examination.write(tmp_path / "r.md")
    examination.write(tmp_path / "r.md", overwrite=True)
    assert "mine" not in (tmp_path / "r.md").read_text("utf-8")
