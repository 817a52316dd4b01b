"""`sceneloom fuse --algorithm`: the algorithm reaches the fusion system."""

import json

from sceneloom.colouring.algorithms import fuse_by_projection


def test_the_algorithm_that_is_named_fuses(call, recording, tmp_path, monkeypatch):
    called = []

    def algorithm(*arguments, **named):
        called.append(len(arguments[0]))
        return fuse_by_projection(*arguments, **named)

    monkeypatch.setattr("sceneloom.fusion.system.algorithm", lambda kind, name: {"theirs": algorithm}[name])
    done = call("fuse", recording, "-o", tmp_path / "out.sfs", "--algorithm", "theirs", "--json", "--quiet")
    assert (done.code, done.err) == (0, "")
    assert len(called) == json.loads(done.out)["fused"] == 3


def test_one_that_is_not_installed_is_bad_usage(call, recording, tmp_path):
    done = call("fuse", recording, "-o", tmp_path / "out.sfs", "--algorithm", "MV3d")
    assert done.code == 2
    assert "there are projection" in done.err
    assert "trained network" in done.err
    assert not (tmp_path / "out.sfs").exists()
