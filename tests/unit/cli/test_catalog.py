"""`sceneloom catalog`: drives into tables, and out again as lists."""

import json
import shutil


def test_a_catalogue_is_built_updated_and_asked(call, recording, tmp_path):
    folder = tmp_path / "catalogue"
    outcome = call("catalog build", recording, tmp_path / "missing", "-o", folder)
    assert (outcome.code, "1 scene: 1 new, 1 failed" in outcome.out) == (1, True)
    assert f"failed: {tmp_path / 'missing'}: no such file or folder" in outcome.err
    assert "1 unchanged" in call("catalog update", folder).out
    reported = call("catalog query", folder, "--speed", 0, "inf", "--as", "list")
    assert [json.loads(line)["path"] for line in reported.out.splitlines()] == [str(recording)]
    rows = json.loads(call("catalog query", folder, "--sql", "SELECT sensor FROM sensors", "--json").out)
    assert {"sensor": "lidar"} in rows
    table = call("catalog query", folder, "--show", "drives").out.splitlines()
    assert table[0].split() == ["path", "seconds", "spans", "moments", "most"]
    lines = call("catalog query", folder, "--sql", "SELECT 1 AS one, NULL AS two", "--as", "csv").out
    assert lines == "one,two\n1,\n"


def test_filters_beside_sql_what_is_no_catalogue_and_outputs_in_lists_are_refused(refuses, recording, tmp_path):
    refuses(2, "--sql", "catalog query", tmp_path, "--sql", "SELECT 1", "--label", "car")
    refuses(1, "holds no catalogue", "catalog query", tmp_path, "--label", "car")
    refuses(2, "NAME=VALUE", "catalog query", tmp_path, "--attribute", "rain")
    line = {"path": str(recording), "reading": {"output": str(tmp_path / "elsewhere.sfs")}}
    (tmp_path / "list.jsonl").write_text(json.dumps(line))
    refuses(1, "'output'", "batch convert --list", tmp_path / "list.jsonl", "-o", tmp_path / "out", "--workers", 1)
    assert not (tmp_path / "elsewhere.sfs").exists()


def test_a_list_says_how_its_drives_are_opened(call, succeeds, recording, tmp_path):
    both, fleet = tmp_path / "kitti", tmp_path / "fleet"
    for name in ("0001", "0002"):
        how = ("--to", "kitti-tracking", "--output-option", f"sequence={name}")
        succeeds("convert", recording, tmp_path / name, *how)
        shutil.copytree(tmp_path / name, both, dirs_exist_ok=True)
    succeeds("catalog build", both, "-o", fleet, "--input-option", "sequence=0001")
    succeeds("catalog update", fleet, both, "--input-option", "sequence=0002")
    assert "2 scenes: 2 unchanged" in call("catalog update", fleet, both).out
    reported = call("catalog query", fleet, "--speed", 0, "inf", "--show", "drives", "--as", "list").out
    readings = [json.loads(line)["reading"] for line in reported.splitlines()]
    assert readings == [{"sequence": "0001"}, {"sequence": "0002"}]
    (tmp_path / "list.jsonl").write_text(reported)
    succeeds("batch convert --list", tmp_path / "list.jsonl", "-o", tmp_path / "out", "--workers", 1)
    names = sorted(file.name for file in (tmp_path / "out").glob("*.sfs"))
    assert names == ["kitti_0001.sfs", "kitti_0002.sfs"]
    again = call("batch convert", both, "-o", tmp_path / "out", "--workers", 1, "--resume")
    assert (again.code, "2 of them before and unchanged" in again.out) == (0, True), again.err
    assert f"{both}: 2 drives; --sequence chooses one\n" in again.err
    assert "2 unchanged" in call("catalog update", fleet, "--list", tmp_path / "list.jsonl").out
    saved = call("view --list", tmp_path / "list.jsonl", "--save", tmp_path / "both.rrd", "--json")
    roots = [drive["root"] for drive in json.loads(saved.out)["drives"]]
    assert (saved.code, roots) == (0, [r"/kitti\ 0001", r"/kitti\ 0002"])
