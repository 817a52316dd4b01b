"""`--threads`: the number reaches the fusion system of each verb that takes it."""

import pytest

from sceneloom.fusion import system


@pytest.mark.parametrize(
    "words",
    [("fuse", "-o", "out.sfs"), ("depth", "-o", "out", "--method", "sparse"), ("colour", "-o", "map.ply")],
    ids=lambda words: words[0],
)
def test_so_many_threads_share_each_sweep(call, recording, tmp_path, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    asked = set()
    resolve = system.algorithm

    def noting(kind, name):
        def run(points_world, requests, visibility, **named):
            asked.add(visibility.threads)
            return resolve(kind, name)(points_world, requests, visibility, **named)

        return run

    monkeypatch.setattr("sceneloom.fusion.system.algorithm", noting)
    done = call(words[0], recording, *words[1:], "--threads", "2")
    assert done.code == 0, done.err
    assert asked == {2}
