"""`sceneloom catalog`: drives into tables, and out again as lists."""

import json


def test_a_catalogue_is_built_updated_and_asked(call, recording, tmp_path):
    folder = tmp_path / "catalogue"
    outcome = call("catalog", "build", recording, tmp_path / "missing", "-o", folder)
    assert (outcome.code, "1 scene: 1 new, 1 failed" in outcome.out) == (1, True)
    assert f"failed: {tmp_path / 'missing'}: no such file or folder" in outcome.err
    assert "1 unchanged" in call("catalog", "update", folder).out
    told = call("catalog", "query", folder, "--speed", 0, "inf", "--as", "list")
    assert [json.loads(line)["path"] for line in told.out.splitlines()] == [str(recording)]
    rows = json.loads(call("catalog", "query", folder, "--sql", "SELECT sensor FROM sensors", "--json").out)
    assert {"sensor": "lidar"} in rows
    table = call("catalog", "query", folder, "--show", "drives").out.splitlines()
    assert table[0].split() == ["path", "seconds", "spans", "moments", "most"]
    lines = call("catalog", "query", folder, "--sql", "SELECT 1 AS one, NULL AS two", "--as", "csv").out
    assert lines == "one,two\n1,\n"


def test_filters_beside_sql_and_what_is_no_catalogue_are_refused(call, tmp_path):
    both = call("catalog", "query", tmp_path, "--sql", "SELECT 1", "--label", "car")
    assert (both.code, "--sql" in both.err) == (2, True)
    none = call("catalog", "query", tmp_path, "--label", "car")
    assert (none.code, "holds no catalogue" in none.err) == (1, True)
    bad = call("catalog", "query", tmp_path, "--attribute", "rain")
    assert (bad.code, "NAME=VALUE" in bad.err) == (2, True)
