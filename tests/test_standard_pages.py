"""The two pages beside DB34/T 4101-2022 hold every row, property, cause, call and check that there is."""

import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from sceneloom.db34t.setting import PREDEFINED
from sceneloom.db34t.tables import TABLES
from sceneloom.db34t.types import Cause

pytest.importorskip("grpc", reason="the extra `serve` is not installed")

from sceneloom.db34t.conformance.examination import CHECKS
from sceneloom.db34t.transport import SERVICE

DOCS = Path(__file__).parents[1] / "docs"
PAGES = [DOCS / "db34t-4101.md", DOCS / "db34t-4101.zh.md"]

pytestmark = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)


def ids_of(cell):
    """The checks that a cell as `5.7-1 … 5.7-5, 6.2-1` names."""
    for named in cell.split(", "):
        part, first = named.split(" … ")[0].split("-")
        last = named.rsplit("-", 1)[1]
        yield from (f"{part}-{k}" for k in range(int(first), int(last) + 1))


def rows_of(text):
    """The cells of all rows of all tables of a page."""
    return [[cell.strip() for cell in line.strip("| \n").split(" | ")] for line in text.splitlines() if line[:1] == "|"]


def test_rows_properties_causes_and_calls_stand_there_and_the_checks_are_counted(page):
    found = [tuple(row[:3]) for row in rows_of(page.read_text("utf-8"))]
    expected = [(str(row.number), f"`{row.name}`", row.type) for table in TABLES.values() for row in table.rows]
    assert [row for row in found if row in expected] == expected
    found = {row[0].strip("`"): row[1:3] for row in rows_of(page.read_text("utf-8"))}
    for name, entry in PREDEFINED.items():
        kind, default = found[name]
        assert kind == entry.type + (f" [{entry.unit}]" if entry.unit else ""), name
        assert default in (repr(entry.default), "empty", "空"), name
        assert (default in ("empty", "空")) == (entry.default == ""), name
    text = page.read_text("utf-8")
    assert [cause for cause in Cause if cause and f"| `{cause}` |" not in text] == []
    assert [method.name for method in SERVICE.methods if f"`{method.name}`" not in text] == []
    text = page.read_text("utf-8")
    assert re.search(rf"\b{len(CHECKS)}\b", text)
    parts = [row for row in rows_of(text) if len(row) == 3 and row[-1].isdigit()]
    listed = [list(ids_of(cell)) for _, cell, _ in parts]
    assert [str(len(ids)) for ids in listed] == [count for _, _, count in parts]
    assert [check for ids in listed for check in ids] == [check.id for check in CHECKS]


@pytest.mark.parametrize("alone", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_program_on_the_page_runs_and_imports_what_it_needs(page, tmp_path, monkeypatch, capfd, alone):
    program = tmp_path / "program.py"
    program.write_text(re.search(r"```python\n(.*?)```", page.read_text("utf-8"), re.DOTALL)[1], "utf-8")
    monkeypatch.chdir(tmp_path)
    if alone:
        subprocess.run([sys.executable, "-W", "error", program], check=True)
    else:
        runpy.run_path(str(program), run_name="__main__")
    assert capfd.readouterr().out.startswith("10.0 ('x', 'y', 'z'")
