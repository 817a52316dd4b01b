"""`sceneloom view`."""

import json

import pytest

import sceneloom
from sceneloom.scene.scene import time_span

pytest.importorskip("rerun", reason="rerun-sdk is not installed: pip install 'sceneloom[view]'")


def test_a_view_is_saved_and_summed_up(refuses, succeeds, reported, recording, tmp_path):
    target = tmp_path / "drive.rrd"
    outcome = succeeds("view", recording, "--save", target, "--no-findings", "--every", "2")
    assert [text for text in ("2 images", "2 sweeps", f"rerun {target}") if text not in outcome.out] == []
    assert target.read_bytes()[:3] == b"RRF"  # what files of Rerun begin with
    refuses(1, "--overwrite", "view", recording, "--save", target)
    words = ("--save", tmp_path / "d.rrd", "--colour-by", "height", "--sensors", "lidar", "--no-findings")
    report = reported("view", recording, *words)
    (drive,) = report["drives"]
    assert (drive["colours"], drive["logged"]["sweeps"]) == ({"lidar": "height"}, 3)
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


def test_a_list_names_drives_and_parts_of_them_as_many_as_can_be_looked_at(refuses, reported, recording, tmp_path):
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
    parts.write_text("\n".join(json.dumps({"path": str(recording), "start": 0.01 * k}) for k in range(33)))
    assert "33 drives" in refuses(2, "--limit 32", "view --list", parts, "--save", tmp_path / "e.rrd").err
    refuses(2, "", "view --save", tmp_path / "e.rrd")
    assert not (tmp_path / "e.rrd").exists()
