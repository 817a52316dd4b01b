"""Pages of a scene file that were read do not stay this process's memory."""

import mmap

import numpy as np
import pytest

from sceneloom.formats.sfs import container
from sceneloom.formats.sfs.container import LocalFile


@pytest.mark.skipif(not hasattr(mmap, "MADV_DONTNEED"), reason="this system cannot let go of single pages")
def test_pages_are_let_go_now_and_then_and_still_state_the_same(tmp_path, monkeypatch):
    monkeypatch.setattr(container, "_MAPPED_AT_MOST", 1 << 20)
    path = tmp_path / "drive.sfs"
    path.write_bytes(np.arange(1 << 20, dtype=np.uint32).tobytes())
    file = LocalFile.of(path)
    whole = np.frombuffer(file.content, np.uint32)
    let_go = []
    monkeypatch.setattr(container.MappedFile, "madvise", lambda *what: let_go.append(what[1:]), raising=False)
    for k in range(4):
        piece = file.fetch({"points": {"positions": whole[k << 18 : (k + 1) << 18]}, "timestamp": 5})
        assert piece["points"]["positions"][1] == (k << 18) + 1
    assert let_go == [(mmap.MADV_DONTNEED,)] * 2
    monkeypatch.undo()
    file.content.madvise(mmap.MADV_DONTNEED)
    np.testing.assert_array_equal(whole[::4096], np.arange(1 << 20, dtype=np.uint32)[::4096])
