"""Pickles of pandas frames are read without pandas, and nothing that they name is ever called."""

import gzip
import pickle
import pickletools
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from sceneloom.errors import DataError
from sceneloom.formats.pandaset import pickles
from sceneloom.formats.pandaset.pickles import read_pickled_frame

FRAMES = Path(__file__).parent / "frames"
VERSIONS = ["pandas_1", "pandas_2", "pandas_3"]


@pytest.mark.parametrize("version", VERSIONS)
def test_frames_of_every_pandas_give_the_columns_that_were_written(tmp_path, version):
    lidar = read_pickled_frame(FRAMES / version / "lidar_1.pkl.gz")
    row = np.arange(13)
    assert list(lidar.columns) == list("xyzitd")
    assert lidar.columns["x"].tolist() == (101.0 + row * 1.25).tolist()
    assert lidar.columns["d"].tolist() == [0] * 8 + [1] * 5
    assert not lidar.columns["x"].flags.writeable
    cuboids = read_pickled_frame(FRAMES / version / "cuboids_0.pkl.gz")
    assert cuboids.columns["label"].tolist() == ["Car", "Car", "Pedestrian"]
    assert cuboids.columns["stationary"].tolist() == [False, False, True]
    assert cuboids.columns["dimensions.y"].tolist() == [4.6, 4.6, 0.7]
    plain = gzip.decompress((FRAMES / version / "lidar_0.pkl.gz").read_bytes())  # a file that is not packed
    assert read_pickled_frame(written(tmp_path / "00.pkl", plain)).count == 12


class Calls:
    """Unpickled in the usual way, it would call."""

    def __init__(self, function, *arguments):
        self.what = function, arguments

    def __reduce__(self):
        return self.what


def written(path, thing, **options):
    path.write_bytes(thing if isinstance(thing, bytes) else pickle.dumps(thing, **options))
    return path


def named(name):
    """A pickle that asks for what a module calls so."""
    return b"\x80\x04" + b"".join(b"\x8c" + bytes([len(word)]) + word for word in name.encode().split()) + b"\x93."


FOREIGN = ("builtins eval", "os system", "numpy load", "pandas eval", "pandas.io.common os.system")


@pytest.mark.parametrize("protocol", [2, 4, 5])
def test_what_a_pickle_asks_to_be_called_is_not_called(tmp_path, protocol):
    mark = tmp_path / "called"
    path = written(tmp_path / "a.pkl", [Calls(Path.touch, mark)], protocol=protocol)
    with pytest.raises(DataError, match=r"asks for .*, which no frame of numbers and texts needs; it was not"):
        read_pickled_frame(path)
    assert not mark.exists()


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        *((named(name), f"asks for {name.replace(' ', '.')}") for name in FOREIGN),
        # the objects that stand for names cannot be changed by a file
        (b"\x80\x04" + b"cbuiltins\nslice\n" + b"}\x8c\x05_makeK\x01sb.", "changes what it must not"),
        (b"\x80\x02Psecret\n.", "operation PERSID"),
        (b"\x80\x02Nr\xff\xff\xff\x7f.", "things to remember"),
        *((pickle.dumps(thing), "a pandas frame|operation") for thing in ([1, 2], {"a": 1}, "text", None, b"bytes", 5)),
    ],
)
def test_names_operations_and_things_that_no_frame_needs_are_refused(tmp_path, content, problem):
    with pytest.raises(DataError, match=problem):
        read_pickled_frame(written(tmp_path / "a.pkl", content))
    assert pickles._NAMED["slice"](1, 2) == slice(1, 2)


def test_too_much_content_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(pickles, "LARGEST", 1000)
    with pytest.raises(DataError, match="more than 1000 bytes"):
        read_pickled_frame(written(tmp_path / "a.pkl.gz", gzip.compress(bytes(5000))))


@pytest.mark.parametrize("version", VERSIONS)
def test_a_frame_that_is_cut_off_or_has_a_flipped_byte_is_a_data_error_or_read(tmp_path, version):
    whole, rng = gzip.decompress((FRAMES / version / "cuboids_1.pkl.gz").read_bytes()), np.random.default_rng(3)
    for stop in range(0, len(whole) - 1, 83):
        with pytest.raises(DataError):
            read_pickled_frame(written(tmp_path / "a.pkl", whole[:stop]))
    for location in rng.integers(0, len(whole), 50).tolist():
        changed = bytearray(whole)
        changed[location] ^= 1 << int(rng.integers(8))
        with suppress(DataError):
            read_pickled_frame(written(tmp_path / "a.pkl", bytes(changed)))


def test_the_golden_frames_hold_only_what_the_reader_allows():
    for path in sorted(FRAMES.glob("*/*.pkl.gz")):
        found = {operation.name for operation, _, _ in pickletools.genops(gzip.decompress(path.read_bytes()))}
        assert found <= pickles._OPERATIONS
