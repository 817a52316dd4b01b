"""The kit: a sound server passes every check, a broken one fails those of its defect, and reports hold it all."""

import json
import re
from html.parser import HTMLParser
from types import SimpleNamespace

import pytest

from sceneloom.db34t.conformance.catalogue import QUOTES, Basis, CallFailedError
from sceneloom.db34t.conformance.examination import CHECKS, chosen, examine
from sceneloom.db34t.tables import TABLES
from sceneloom.errors import OptionError, OutputError

from .servers import SERVERS, Broken, HereTransport, status_two

EACH_SERVER = pytest.mark.parametrize(("make", "ids"), [row[1:] for row in SERVERS], ids=[row[0] for row in SERVERS])


def test_our_own_interface_passes_all_checks_and_one_that_answers_nothing_none():
    transport = HereTransport()
    sound = examine(transport, address="here")
    assert (sound.failed_ids, sound.passed, transport.sessions) == ((), True, {})  # each is ended after its check
    assert [finding.check for finding in sound.findings] == list(CHECKS)
    assert all(finding.seen for finding in sound.findings)

    def fails(*_):
        raise CallFailedError("UNIMPLEMENTED", "")

    calls = ("call", "send_stream", "subscribe", "health", "services", "files_with")
    assert examine(SimpleNamespace(**dict.fromkeys(calls, fails))).counts == {"passed": 0, "failed": len(CHECKS)}


@EACH_SERVER
def test_a_broken_server_fails_the_checks_of_its_defect_if_only_these_are_made(make, ids):
    assert sorted(examine(make(HereTransport()), only=ids).failed_ids) == sorted(ids)


@pytest.mark.few(5)
@EACH_SERVER
def test_a_broken_server_fails_exactly_the_checks_of_its_defect(make, ids):
    examination = examine(make(HereTransport()))
    assert sorted(examination.failed_ids) == sorted(ids)
    assert not examination.passed


def test_every_row_of_every_table_and_every_interface_of_clause_5_has_its_check_once_and_can_be_chosen():
    ids = [check.id for check in CHECKS]
    assert len(set(ids)) == len(ids)
    expected = {f"T1-{k + 1}" for k in range(9)} | {f"T2-{k + 1}" for k in range(7)}
    expected |= {f"T{n}-{row.number}" for n, table in TABLES.items() for row in table.rows if not row.is_extension}
    assert expected <= set(ids)
    assert {"5.3", "5.4", "5.5", "5.6", "5.7"} <= {check_id.split("-")[0] for check_id in ids}
    assert {check.basis for check in CHECKS} == set(Basis)
    assert [check.id for check in chosen(["5.4-3"])] == ["5.4-3"]
    assert [check.id for check in chosen(["T8", "5.5-1"])] == ["5.5-1", *(f"T8-{k}" for k in range(1, 10))]
    assert chosen([]) == CHECKS
    with pytest.raises(OptionError, match=r"5\.4-99"):
        chosen(["5.4-99"])


def test_quotes_are_what_the_standard_prints(data_dir):
    path = data_dir.parent / "specs" / "db34t_4101_2022.txt"
    if not path.is_file():
        pytest.skip("the text of the standard is not here")
    # the text at hand has blanks, line breaks and two kinds of commas where the print has none
    printed = _plain(path.read_text("utf-8"))
    for clause, (_, chinese) in QUOTES["clauses"].items():
        for part in re.split(r"[;:]", chinese):
            assert _plain(part) in printed, clause
    for table in ("table_1", "table_2"):
        for name, (_, chinese) in QUOTES[table].items():
            assert name in chinese
            assert _plain(chinese.split()[1]) in printed, name
    for number, table in TABLES.items():
        for row in table.rows:
            assert bool(row.quote) is not row.is_extension
            assert row.is_extension or _plain(row.quote.split()[0]) in printed, (number, row.name)


def _plain(text):
    return re.sub(r"[\s,，、。;；:：.\\()（）|/]", "", text)


def test_json_and_markdown_hold_every_check_with_what_it_saw(tmp_path):
    only = ["5.3", "T10-5"]
    examination = examine(Broken(HereTransport(), outgoing=status_two), address="127.0.0.1:1", only=only)
    with pytest.raises(OptionError, match=r"\.json, \.md, \.html"):
        examination.write(tmp_path / "r.pdf")
    (tmp_path / "r.md").write_text("mine")
    with pytest.raises(OutputError, match="exists already"):
        examination.write(tmp_path / "r.md")
    for suffix in (".json", ".md"):
        examination.write(tmp_path / f"r{suffix}", overwrite=True)
    found = json.loads((tmp_path / "r.json").read_text("utf-8"))
    assert (found["address"], found["passed"], found["counts"]) == ("127.0.0.1:1", False, {"passed": 4, "failed": 1})
    failed = next(check for check in found["checks"] if check["verdict"] == "failed")
    assert failed["id"] == "5.3-3"
    assert "1—添加成功" in failed["chinese"]
    assert {"sent": "AddProperty speed", "expected": "1", "found": "2", "agrees": False} in failed["seen"]
    lines = (tmp_path / "r.md").read_text("utf-8").splitlines()
    assert sum(line.startswith(("| 5.3-", "| T10-")) for line in lines) == len(examination.findings)
    (section,) = (line for line in lines if line.startswith("## "))
    assert section == "## 5.3-3: adding returns 1, and 0 where the name is taken"
    assert "| AddProperty speed | 1 | 2 |" in lines


def renamed(_, method, request, reply):
    if method == "GetProperty":
        reply.description = "<script>alert(1)</script> | & \n # x"
    return reply


def test_html_shows_each_check_and_runs_nothing_that_a_server_wrote(tmp_path):
    found = examine(Broken(HereTransport(), outgoing=renamed), address="<b>", only=["5.3-1"])
    assert found.failed_ids == ("5.3-1",)
    for suffix in (".html", ".md"):
        found.write(tmp_path / f"r{suffix}")
    tags = []
    page = HTMLParser()
    page.handle_starttag = lambda tag, attributes: tags.append(tag)
    page.feed((tmp_path / "r.html").read_text("utf-8"))
    assert tags.count("details") == 1
    assert not {"script", "b"} & set(tags)
    table = (tmp_path / "r.md").read_text("utf-8").split("| sent |")[1]
    assert all(line.count(" | ") == 2 for line in table.splitlines()[2:] if line)
