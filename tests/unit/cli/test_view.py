"""`sceneloom view`."""

import json

import pytest

pytest.importorskip("rerun", reason="rerun-sdk is not installed: pip install 'sceneloom[view]'")


def test_a_view_is_saved_and_summed_up(call, recording, tmp_path):
    target = tmp_path / "drive.rrd"
    outcome = call("view", recording, "--save", target, "--no-findings", "--every", "2")
    assert outcome.code == 0, outcome.err
    assert "2 pictures" in outcome.out
    assert "2 sweeps" in outcome.out
    assert f"rerun {target}" in outcome.out
    assert target.read_bytes()[:3] == b"RRF"  # what files of Rerun begin with
    again = call("view", recording, "--save", target)
    assert (again.code, "--overwrite" in again.err) == (1, True)


def test_the_summary_is_json_for_machines(call, recording, tmp_path):
    words = (
        "--save",
        tmp_path / "d.rrd",
        "--json",
        "--colour-by",
        "height",
        "--sensors",
        "lidar",
        "--no-findings",
    )
    report = json.loads(call("view", recording, *words).out)
    assert report["drives"][0]["colours"] == {"lidar": "height"}
    assert report["drives"][0]["logged"]["sweeps"] == 3
    assert report["size_bytes"] == (tmp_path / "d.rrd").stat().st_size


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--save", "OUT.rrd", "--web"), "one of them"),
        (("--save", "OUT.txt"), ".rrd"),
        (("--save", "OUT.rrd", "--sensors", "nobody"), "nobody"),
        (("--save", "OUT.rrd", "--trajectory", "nowhere"), "nowhere"),
        (("--save", "OUT.rrd", "--start", "99"), "no frame"),
    ],
)
def test_what_cannot_be_followed_is_told(call, recording, tmp_path, words, told):
    outcome = call("view", recording, *(word.replace("OUT", str(tmp_path / "out")) for word in words))
    assert outcome.code in (1, 2)
    assert told in outcome.err
    assert list(tmp_path.iterdir()) == []
