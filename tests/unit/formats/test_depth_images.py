import cv2
import numpy as np
import pytest

from sceneloom.errors import ArrayError, OutputError
from sceneloom.formats.base.images import write_confidence_png, write_depth_npz, write_depth_png


def _depths():
    depths = np.random.default_rng(4).uniform(0.5, 120.0, (37, 51)).astype(np.float32)
    depths[::3] = 0.0
    return depths


def test_opencv_reads_the_png_as_metres_times_256(tmp_path):
    depths = _depths()
    assert write_depth_png(depths, tmp_path / "d.png") == 0
    read = cv2.imread(str(tmp_path / "d.png"), cv2.IMREAD_UNCHANGED)
    assert read.dtype == np.uint16
    assert read.shape == depths.shape
    # Half a step of 1/256 m: the values are rounded.
    assert np.abs(read / 256.0 - depths).max() <= 0.5 / 256
    assert np.array_equal(read == 0, depths == 0)


def test_depths_beyond_16_bits_become_nothing_and_are_counted(tmp_path):
    depths = np.array([[255.99, 255.9961, 256.0, 1000.0, np.inf, 0.0]], np.float32)
    assert write_depth_png(depths, tmp_path / "d.png") == 3
    read = cv2.imread(str(tmp_path / "d.png"), cv2.IMREAD_UNCHANGED)
    assert read.tolist() == [[65533, 65535, 0, 0, 0, 0]]


def test_a_depth_below_the_first_step_does_not_become_nothing(tmp_path):
    write_depth_png(np.array([[0.001, 0.0]], np.float32), tmp_path / "d.png")
    assert cv2.imread(str(tmp_path / "d.png"), cv2.IMREAD_UNCHANGED).tolist() == [[1, 0]]


def test_npz_holds_the_depths_bit_by_bit(tmp_path):
    depths = _depths()
    depths[1, 1] = np.inf
    write_depth_npz(depths, tmp_path / "d.npz")
    with np.load(tmp_path / "d.npz") as file:
        assert file.files == ["depth"]
        assert file["depth"].dtype == np.float32
        assert file["depth"].tobytes() == depths.tobytes()


@pytest.mark.parametrize("write", [write_depth_png, write_depth_npz])
@pytest.mark.parametrize(
    ("depths", "message"),
    [
        (np.array([[1.0, np.nan]], np.float32), r"depth_image\[0, 1\]: nan"),
        (np.array([[1.0], [-2.0]], np.float32), r"depth_image\[1, 0\]: -2.0"),
        (np.zeros((0, 5), np.float32), "at least one pixel"),
        (np.zeros((4, 5)), "float32"),
    ],
)
def test_what_is_no_depth_image_is_refused(tmp_path, write, depths, message):
    with pytest.raises(ArrayError, match=message):
        write(depths, tmp_path / "file")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("write", [write_depth_png, write_depth_npz])
def test_existing_files_are_replaced_only_on_request(tmp_path, write):
    target = tmp_path / "file"
    target.write_bytes(b"kept")
    with pytest.raises(OutputError, match="exists already"):
        write(_depths(), target)
    assert target.read_bytes() == b"kept"
    write(_depths(), target, overwrite=True)
    assert target.read_bytes() != b"kept"


@pytest.mark.parametrize("write", [write_depth_png, write_depth_npz])
def test_a_missing_folder_is_an_output_error(tmp_path, write):
    with pytest.raises(OutputError, match="missing"):
        write(_depths(), tmp_path / "missing" / "d")


def test_opencv_reads_confidences_as_255_for_one(tmp_path):
    confidence = np.array([[0.0, 0.5, 1.0], [0.25, 0.999, 0.001]], np.float32)
    write_confidence_png(confidence, tmp_path / "c.png")
    read = cv2.imread(str(tmp_path / "c.png"), cv2.IMREAD_UNCHANGED)
    assert read.dtype == np.uint8
    np.testing.assert_array_equal(read, [[0, 128, 255], [64, 255, 0]])


@pytest.mark.parametrize("value", [np.nan, -0.1, 1.1])
def test_what_is_no_confidence_is_refused(tmp_path, value):
    with pytest.raises(ArrayError, match="from 0 to 1"):
        write_confidence_png(np.full((2, 2), value, np.float32), tmp_path / "c.png")
    assert not list(tmp_path.iterdir())


def test_npz_files_hold_the_confidence_of_the_same_size_only(tmp_path):
    depths = _depths()
    confidence = (depths > 0).astype(np.float32)
    write_depth_npz(depths, tmp_path / "d.npz", confidence=confidence)
    with np.load(tmp_path / "d.npz") as arrays:
        np.testing.assert_array_equal(arrays["confidence"], confidence)
    with pytest.raises(ArrayError, match="confidence"):
        write_depth_npz(depths, tmp_path / "e.npz", confidence=confidence[1:])
