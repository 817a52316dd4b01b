"""A log that was written wrongly as a whole is reported so in a few findings, not line by line."""

import gzip
import json

import pytest

from sceneloom.checks import validate
from sceneloom.formats.base.diagnostics import MOST_LOCATIONS

COUNT = 40
LINES = [
    {"groundTruth": {"position": {"x": 0.1 * k, "y": 0.0, "z": 0.0}}, "time": 0.1 * k} for k in range(COUNT)
]
TEXTS = [json.dumps(line) for line in LINES]
LOG = "".join(text + "\n" for text in TEXTS).encode()


def reported(folder, content):
    """Rule, location, message and count of each error, also of what would be counted at the end of a list."""
    (folder / "data.jsonl").write_bytes(content)
    report = validate(folder, locations=None)
    assert not report.passed
    return [(f.rule, f.path, f.message, f.count) for f in report.findings if f.severity == "error"]


@pytest.mark.parametrize(
    ("encode", "kind"),
    [
        (lambda log: gzip.compress(log, mtime=0), "compressed by gzip"),
        (lambda log: log.decode().encode("utf-16"), "text in UTF-16"),
        (lambda log: log.decode().encode("utf-16-be"), "text in UTF-16"),
        (lambda log: log[:0], "empty"),
    ],
    ids=["gzip", "utf-16 with mark", "utf-16 without", "empty"],
)
def test_a_file_that_is_no_log_is_one_finding(tmp_path, encode, kind):
    [(rule, location, message, count)] = reported(tmp_path, encode(LOG))
    assert (rule, location, count) == ("recording-readable", "data.jsonl", 1)
    assert kind in message


def test_what_to_do_about_an_empty_log_is_not_to_salvage_it(tmp_path):
    (tmp_path / "data.jsonl").touch()
    [finding] = validate(tmp_path).findings
    assert "salvage" not in finding.remedy
    assert "record" in finding.remedy


def in_unit(factor):
    lines = [line | {"time": int((1.7e9 + line["time"]) * factor)} for line in LINES]
    return "".join(json.dumps(line) + "\n" for line in lines).encode()


@pytest.mark.parametrize(
    ("factor", "unit"), [(1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")]
)
def test_times_in_another_unit_are_one_finding_that_names_it(tmp_path, factor, unit):
    [(rule, location, message, count)] = reported(tmp_path, in_unit(factor))
    assert (rule, count) == ("unfit-lines", COUNT)
    assert location == f"data.jsonl: lines 1, 2, 3, … {COUNT}"
    assert f"looks like {unit}" in message
    assert f"{COUNT} of {COUNT} lines" in message


def test_a_list_of_objects_is_one_finding_and_its_end(tmp_path):
    found = reported(tmp_path, ("[\n" + ",\n".join(TEXTS) + "\n]\n").encode())
    assert [(rule, count) for rule, _, _, count in found] == [("broken-lines", COUNT), ("broken-lines", 1)]
    assert "a log is no list" in found[0][2]


def test_objects_over_several_lines_are_reported_by_kinds(tmp_path):
    content = "\n".join(json.dumps(line, indent=1) for line in LINES).encode()
    found = reported(tmp_path, content)
    assert len(found) <= 5
    assert sum(count for *_, count in found) == content.count(b"\n") + 1


def test_a_log_with_more_lines_than_locations_are_kept_is_one_finding(tmp_path):
    [(_, location, _, count)] = reported(tmp_path, b"time,x,y\n" * (3 * MOST_LOCATIONS))
    assert count == 3 * MOST_LOCATIONS
    assert location.endswith(f" {3 * MOST_LOCATIONS}")


def test_lines_that_are_torn_here_and_there_are_listed_singly(tmp_path):
    texts = [text[:-1] if k % 9 == 4 else text for k, text in enumerate(TEXTS)]
    found = reported(tmp_path, ("\n".join(texts) + "\n").encode())
    assert [location for _, location, _, _ in found] == [
        f"data.jsonl: line {k + 1}" for k in range(4, COUNT, 9)
    ]
