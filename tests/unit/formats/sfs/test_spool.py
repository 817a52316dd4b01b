"""The spool: arrays before their header, in memory or on disk, and a header that proves longer than expected."""

import io

import numpy as np
import pytest

from sceneloom.formats.sfs import writer as module
from sceneloom.formats.sfs.writer import ALIGNMENT, Spool

SMALL = np.arange(7, dtype=np.uint8)
LARGE = np.arange(100_000, dtype=np.float32).reshape(-1, 2)


def spooled(path, arrays, header, *, reserve=640):
    """Write arrays and a header, and give the file's bytes and the arrays' locations."""
    with Spool(path, reserve=lambda: reserve) as spool:
        blobs = [spool.add(array) for array in arrays]
        spool.finish(header)
    return path.read_bytes(), blobs


def check(content, header, arrays, blobs):
    """The header, blanks, NULs, and every array at its location, aligned, followed by NULs."""
    stop = content.index(b"\0")
    assert content[:stop].rstrip(b" ") == header
    assert content[stop : stop + 4] == bytes(4)
    assert stop % ALIGNMENT == 0
    end = stop
    for array, blob in zip(arrays, blobs, strict=True):
        start = stop + blob.offset
        assert start % ALIGNMENT == 0
        assert start >= end + 4
        assert not any(content[end:start])
        assert content[start : start + blob.length] == array.tobytes()
        end = start + blob.length
    assert len(content) - end in range(4, ALIGNMENT + 4)
    assert not any(content[end:])


@pytest.fixture(params=["in memory", "on disk"])
def kept(request, monkeypatch):
    """Arrays stay in memory, or go to disk after the first kilobyte."""
    if request.param == "on disk":
        monkeypatch.setattr(module, "_IN_MEMORY", 1000)
        monkeypatch.setattr(module, "_GATHERED", 500)
    return request.param


@pytest.mark.parametrize("length", [0, 1, 639, 640, 641, 5000, 300_000])
def test_headers_of_any_length_stand_before_the_arrays(tmp_path, kept, length):
    header = b"x" * length
    arrays = [SMALL, LARGE, SMALL[:0], *[SMALL] * 100, LARGE.T, np.float64(2.5)]
    content, blobs = spooled(tmp_path / "file", arrays, header)
    check(content, header, arrays, blobs)
    assert blobs[3].shape == (7,)
    assert blobs[-1].shape == ()


def test_a_file_system_that_cannot_make_room_gives_the_same_bytes(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_IN_MEMORY", 1000)
    header = b"x" * 10_000
    quick, _ = spooled(tmp_path / "quick", [SMALL, LARGE], header)
    monkeypatch.setattr(module, "_fallocate", lambda *arguments: False)
    monkeypatch.delattr(module.os, "copy_file_range", raising=False)
    slow, blobs = spooled(tmp_path / "slow", [SMALL, LARGE], header)
    assert slow == quick
    check(slow, header, [SMALL, LARGE], blobs)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["quick", "slow"]


def test_arrays_are_written_as_they_were_added_in_little_endian_order(tmp_path, kept):
    array, big_endian = SMALL.copy(), np.array([1, 258], ">u4")
    with Spool(tmp_path / "file", reserve=lambda: 640) as spool:
        blobs = [spool.add(LARGE), spool.add(array), spool.add(big_endian)]
        array[:] = 0
        spool.finish(b"{}")
    assert blobs[2].dtype == "uint32"
    check((tmp_path / "file").read_bytes(), b"{}", [LARGE, SMALL, big_endian.astype("<u4")], blobs)


def test_an_array_can_be_changed_while_others_are_written(tmp_path, kept):
    with Spool(tmp_path / "file", reserve=lambda: 640) as spool:
        blobs = [spool.add(SMALL), spool.add(LARGE), spool.add(SMALL)]
        spool.change(blobs[0], lambda array: array + 1)
        spool.change(blobs[2], lambda array: array + 2)
        blobs.append(spool.add(LARGE))
        spool.finish(b"{}")
    check((tmp_path / "file").read_bytes(), b"{}", [SMALL + 1, LARGE, SMALL + 2, LARGE], blobs)


@pytest.mark.parametrize("size", [0, 100, 200_000])
def test_a_file_is_written_as_bytes(tmp_path, kept, size):
    bytes_of_file = np.random.default_rng(3).integers(0, 256, size, np.uint8)
    (tmp_path / "video").write_bytes(bytes_of_file.tobytes())
    with Spool(tmp_path / "file", reserve=lambda: 640) as spool:
        blobs = [spool.add(SMALL), spool.add_file(tmp_path / "video"), spool.add(SMALL)]
        spool.finish(b"{}")
    check((tmp_path / "file").read_bytes(), b"{}", [SMALL, bytes_of_file, SMALL], blobs)


def test_a_write_that_takes_only_a_part_is_continued(tmp_path, monkeypatch):
    class Reluctant(io.FileIO):
        """Takes at most a thousand bytes at once, as a full pipe or a signal makes a file do."""

        def write(self, content):
            return super().write(bytes(memoryview(content)[:1000]))

    monkeypatch.setattr(module, "_IN_MEMORY", 1000)
    path = tmp_path / "file"
    with Spool(path, reserve=lambda: 640) as spool:
        spool._file_for(0).close()
        spool._file = Reluctant(path, "r+b")
        spool._file.seek(640 + ALIGNMENT)
        blobs = [spool.add(LARGE), spool.add(SMALL)]
        spool.finish(b"{}")
    check(path.read_bytes(), b"{}", [LARGE, SMALL], blobs)
