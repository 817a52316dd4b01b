"""The page about the checks lists every rule as it is."""

import re
from pathlib import Path

from sceneloom.checks.validation import catalogue

PAGE = Path(__file__).parents[3] / "docs" / "checks.md"


def row(rule):
    """The line of the page that a rule has."""
    marks = ", ".join([rule.severity, *(["fix"] if rule.fixable else [])])
    return f"| `{rule.id}` | {marks} | {rule.summary} | {rule.remedy} |"


def test_the_page_lists_every_rule_and_no_other():
    listed = [line for line in PAGE.read_text("utf-8").splitlines() if line.startswith("| `") and "|" in line]
    rows = [line for line in listed if line.count("|") == 5]
    both = [row(rule) for rule in catalogue() if not rule.only_in]
    scale = [row(rule) for rule in catalogue() if rule.only_in]
    assert rows == both + scale


def test_rules_that_the_page_names_for_a_check_of_scales_are_there():
    text = PAGE.read_text("utf-8").split("## What Scale's validator checks")[1].split("\n## ")[0]
    known = {rule.id for rule in catalogue()}
    lines = [line for line in text.splitlines() if line.startswith("| ")][1:]
    cells = [cell for line in lines for cell in line.split("|")[2:4]]
    named = {name.strip("` ") for cell in cells for name in cell.split(",") if "`" in name}
    assert named
    assert named <= known


def test_rules_that_the_page_names_for_recordings_are_there():
    text = PAGE.read_text("utf-8").split("\n## Recordings")[1].split("\n## ")[0]
    known = {rule.id for rule in catalogue()}
    lines = [line for line in text.splitlines() if line.startswith("| ") and "`" in line]
    named = {name for line in lines for name in re.findall(r"`([a-z0-9-]+)`", line.split("|")[3])}
    assert named > {"lines-in-order", "fixes-jump"}
    assert named <= known
