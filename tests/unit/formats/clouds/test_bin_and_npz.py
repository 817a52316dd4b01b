"""Files without a head, and NumPy's own."""

import numpy as np
import pytest

from sceneloom.errors import DataError, OptionError
from sceneloom.formats.points.cloud import parse_layout
from sceneloom.formats.points.files import read_cloud

ROWS = np.array([[1.0, 2.0, 3.0, 0.5], [-4.0, 5.0, 6.0, 0.25]], np.float32)


def test_plain_bin_files_are_read_as_kittis(tmp_path):
    (tmp_path / "0.bin").write_bytes(ROWS.tobytes())
    columns = read_cloud(tmp_path / "0.bin").columns
    assert np.stack([*columns.values()], axis=1).tolist() == ROWS.tolist()
    assert [*columns] == ["x", "y", "z", "intensity"]


def test_bin_files_with_nuscenes_ending_have_rings(tmp_path):
    (tmp_path / "0.pcd.bin").write_bytes(np.arange(10, dtype="<f4").tobytes())
    assert read_cloud(tmp_path / "0.pcd.bin").columns["ring"].tolist() == [4, 9]


def test_a_layout_names_types_and_padding(tmp_path):
    layout = parse_layout(["x", "y", "z", "_:uint8", "ring:uint16", "t:uint64"], default="float64")
    record = np.dtype([("p", "<f8", 3), ("pad", "u1"), ("ring", "<u2"), ("t", "<u8")])
    content = np.array([((1, 2, 3), 255, 40, 2**63 + 1)], record).tobytes()
    (tmp_path / "0.bin").write_bytes(content)
    columns = read_cloud(tmp_path / "0.bin", layout=layout).columns
    assert {name: column.tolist() for name, column in columns.items()} == {
        "x": [1.0],
        "y": [2.0],
        "z": [3.0],
        "ring": [40],
        "t": [2**63 + 1],
    }


@pytest.mark.parametrize("fields", [["x:floot32"], ["x", "x"], ["x y"], []])
def test_a_layout_that_is_none_is_refused(fields):
    with pytest.raises(OptionError):
        parse_layout(fields)


def test_a_bin_file_has_to_be_whole_points(tmp_path):
    (tmp_path / "0.bin").write_bytes(ROWS.tobytes()[:-3])
    with pytest.raises(DataError, match=r"29 bytes are 1 points of 16 bytes .* and 13 bytes more"):
        read_cloud(tmp_path / "0.bin")


@pytest.mark.parametrize("name", ["points", "positions", "xyz"])
def test_rows_of_an_npz_file_are_cut_into_columns(tmp_path, name):
    np.savez_compressed(tmp_path / "0.npz", **{name: ROWS}, ring=np.array([1, 2]), session=np.arange(7))
    cloud = read_cloud(tmp_path / "0.npz")
    assert cloud.columns["intensity"].tolist() == [0.5, 0.25]
    assert cloud.columns["ring"].tolist() == [1, 2]
    assert "session" not in cloud.columns, "an array of another length says nothing of the points"


def test_columns_of_an_npz_file_are_taken_by_name(tmp_path):
    np.savez(tmp_path / "0.npz", x=ROWS[:, 0], y=ROWS[:, 1], z=ROWS[:, 2])
    assert read_cloud(tmp_path / "0.npz").columns["z"].tolist() == [3.0, 6.0]


def test_npy_files_hold_rows_or_named_fields(tmp_path):
    np.save(tmp_path / "0.npy", np.asfortranarray(ROWS.astype(">f8")))
    assert read_cloud(tmp_path / "0.npy").columns["x"].tolist() == [1.0, -4.0]
    named = np.array([(1, 2, 3, 9)], [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("ring", "u1")])
    np.save(tmp_path / "1.npy", named)
    assert read_cloud(tmp_path / "1.npy").columns["ring"].tolist() == [9]


def test_rows_of_unknown_width_ask_for_their_fields(tmp_path):
    np.save(tmp_path / "0.npy", np.zeros((2, 6)))
    with pytest.raises(DataError, match=r"rows of 6 numbers; expected 3 or 4 .*; name them with `fields`"):
        read_cloud(tmp_path / "0.npy")


def test_pickled_objects_are_never_loaded(tmp_path):
    np.savez(tmp_path / "0.npz", points=np.array([{"x": 1}], object))
    with pytest.raises(DataError, match="Python objects, which are never loaded"):
        read_cloud(tmp_path / "0.npz")


def test_other_endings_are_refused_with_the_known_ones(tmp_path):
    (tmp_path / "0.e57").write_bytes(b"ASTM")
    with pytest.raises(DataError, match=r"expected one of \.pcd \.ply \.las \.laz \.bin \.npz \.npy"):
        read_cloud(tmp_path / "0.e57")


def test_a_column_that_is_too_short_is_refused_and_not_left_out(tmp_path):
    np.savez(
        tmp_path / "a.npz", points=np.ones((5, 3), "f4"), intensity=np.ones(4, "f4"), time=np.array([1.0])
    )
    with pytest.raises(DataError, match=r"a\.npz: intensity: 4 numbers for 5 points; expected one per point"):
        read_cloud(tmp_path / "a.npz")


def test_what_an_npz_file_holds_instead_of_points_is_reported_with_its_shape(tmp_path):
    np.savez(tmp_path / "a.npz", range_image=np.ones((4, 5, 3), "f4"))
    with pytest.raises(
        DataError, match=r"holds range_image \(4, 5, 3\); expected arrays of numbers with a row per point"
    ):
        read_cloud(tmp_path / "a.npz")


@pytest.mark.parametrize("other", [{"xyz": 2 * ROWS[:, :3]}, {"intensity": ROWS[:, 0]}])
def test_two_arrays_that_give_one_column_are_refused(tmp_path, other):
    np.savez(tmp_path / "0.npz", points=ROWS, **other)
    with pytest.raises(DataError, match="which another array gives, too; expected each column once"):
        read_cloud(tmp_path / "0.npz")


def test_rows_whose_brightness_is_left_out_go_with_an_array_of_it(tmp_path):
    np.savez(tmp_path / "0.npz", points=ROWS, intensity=ROWS[:, 0])
    cloud = read_cloud(tmp_path / "0.npz", layout=parse_layout(["x", "y", "z", "_"]))
    assert cloud.columns["intensity"].tolist() == [1.0, -4.0]
