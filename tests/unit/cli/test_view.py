"""`sceneloom view`."""

import json

import pytest

import sceneloom
from sceneloom.scene.scene import time_span

pytest.importorskip("rerun", reason="rerun-sdk is not installed: pip install 'sceneloom[view]'")


def test_a_view_is_saved_and_summed_up(refuses, succeeds, recording, tmp_path):
    target = tmp_path / "drive.rrd"
    outcome = succeeds("view", recording, "--save", target, "--no-findings", "--every", "2")
    assert "2 images" in outcome.out
    assert "2 sweeps" in outcome.out
    assert f"rerun {target}" in outcome.out
    assert target.read_bytes()[:3] == b"RRF"  # what files of Rerun begin with
    refuses(1, "--overwrite", "view", recording, "--save", target)


def test_the_summary_is_json_for_machines(reported, recording, tmp_path):
    words = ("--save", tmp_path / "d.rrd", "--colour-by", "height", "--sensors", "lidar", "--no-findings")
    report = reported("view", recording, *words)
    assert report["drives"][0]["colours"] == {"lidar": "height"}
    assert report["drives"][0]["logged"]["sweeps"] == 3
    assert report["size_bytes"] == (tmp_path / "d.rrd").stat().st_size


@pytest.mark.parametrize(
    ("words", "reported"),
    [
        (("--save", "OUT.rrd", "--web"), "one of them"),
        (("--save", "OUT.txt"), ".rrd"),
        (("--save", "OUT.rrd", "--sensors", "nobody"), "nobody"),
        (("--save", "OUT.rrd", "--trajectory", "nowhere"), "nowhere"),
        (("--save", "OUT.rrd", "--start", "99"), "no frame"),
    ],
)
def test_what_cannot_be_followed_is_reported(call, recording, tmp_path, words, reported):
    outcome = call("view", recording, *(word.replace("OUT", str(tmp_path / "out")) for word in words))
    assert outcome.code in (1, 2)
    assert reported in outcome.err
    assert list(tmp_path.iterdir()) == []


def test_a_list_names_drives_and_parts_of_them(reported, recording, tmp_path):
    parts = tmp_path / "parts.jsonl"
    with sceneloom.open(recording) as scene:
        sweeps_ns, first_ns = scene.lidars[0].frames.timestamps_ns, time_span(scene)[0]
    between = round(float(sweeps_ns[:2].mean() - first_ns) / 1e9, 3)
    lines = [{"path": str(recording), "stop": between}, {"path": str(recording), "start": between}]
    parts.write_text("\n".join(map(json.dumps, lines)))
    words = ("--save", tmp_path / "d.rrd", "--no-findings", "--start", "99")
    first, second = reported("view --list", parts, *words)["drives"]
    assert first["source"] == second["source"]
    assert (first["logged"]["sweeps"], second["logged"]["sweeps"]) == (1, len(sweeps_ns) - 1)
    roots = [shown["root"].replace("\\", "") for shown in (first, second)]
    assert roots == [f"/{recording.name} 0-{between:g} s", f"/{recording.name} {between:g}-"]


def test_more_than_can_be_looked_at_is_refused(call, recording, tmp_path):
    parts = tmp_path / "parts.jsonl"
    parts.write_text("\n".join(json.dumps({"path": str(recording), "start": 0.01 * k}) for k in range(33)))
    outcome = call("view --list", parts, "--save", tmp_path / "d.rrd")
    assert (outcome.code, "33 drives" in outcome.err, "--limit 32" in outcome.err) == (2, True, True)
    assert not (tmp_path / "d.rrd").exists()
    assert call("view --save", tmp_path / "d.rrd").code == 2
