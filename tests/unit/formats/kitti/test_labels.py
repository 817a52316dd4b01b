"""KITTI's text of labels and results."""

import numpy as np
import pytest

from sceneloom.errors import DataError, OutputError
from sceneloom.formats.kitti.benchmark_writer import write_labels, write_object_labels
from sceneloom.formats.kitti.labels import read_labels

CAR = "Car 0 1 -1.50 10.0 20.0 30.0 40.0 1.5 1.6 4.0 2.0 1.5 10.0 0.25"
NOWHERE = "DontCare -1 -1 -10 5 6 7 8 -1 -1 -1 -1000 -1000 -1000 -10"
TRACKING = f"0 3 {CAR}\n0 -1 {NOWHERE}\n4 3 {CAR}\n"


def written(tmp_path, text, name="0001.txt"):
    path = tmp_path / name
    path.write_text(text)
    return path


def test_labels_of_tracking_are_read_as_they_stand_and_written_again(tmp_path):
    labels = read_labels(written(tmp_path, TRACKING))
    assert (labels.frames.tolist(), labels.track_ids.tolist()) == ([0, 0, 4], [3, -1, 3])
    assert (labels.types, labels.have_position.tolist()) == (("Car", "DontCare", "Car"), [True, False, True])
    # -1.50 is alpha; corners are as in the file, not shifted; height, width, length; the bottom's middle; about y
    assert labels.values[0].tolist() == [0, 1, -1.5, 10, 20, 30, 40, 1.5, 1.6, 4.0, 2.0, 1.5, 10.0, 0.25]
    assert labels.scores is None
    scored = read_labels(written(tmp_path, TRACKING.replace("\n", " 0.125\n")))
    write_labels(scored.select(scored.have_position), tmp_path / "out.txt")
    back = read_labels(tmp_path / "out.txt")
    np.testing.assert_array_equal(back.bottoms, labels.bottoms[[0, 2]])
    assert back.scores.tolist() == [0.125, 0.125]
    assert len((tmp_path / "out.txt").read_text().splitlines()[0].split()) == 18
    with pytest.raises(OutputError, match="exists already"):
        write_labels(labels, tmp_path / "0001.txt")


def test_labels_of_objects_have_a_file_for_each_frame_whose_name_is_its_number(tmp_path):
    labels = read_labels(written(tmp_path, f"{CAR} 0.5\n{CAR} -2.5\n", "000114.txt"))
    assert (labels.frames.tolist(), labels.track_ids.tolist()) == ([114, 114], [-1, -1])
    assert labels.scores.tolist() == [0.5, -2.5]
    assert len(read_labels(written(tmp_path, "\n"))) == 0
    labels = read_labels(written(tmp_path, TRACKING))
    write_object_labels(labels, tmp_path / "out", frames=range(5))
    assert sorted(file.name for file in (tmp_path / "out").iterdir()) == [f"{k:06d}.txt" for k in range(5)]
    assert (tmp_path / "out" / "000001.txt").read_text() == ""
    back = read_labels(tmp_path / "out" / "000004.txt")
    assert (back.frames.tolist(), back.types, back.track_ids.tolist()) == ([4], ("Car",), [-1])
    np.testing.assert_array_equal(back.bottoms, labels.bottoms[[2]])


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        (f"0 3 {CAR} 0.5 9\n", "line 1: 19 values; expected 17 or 18"),
        (f"0 3 {CAR}\n1 3 {CAR[:-5]}\n", "line 2: 16 values; expected 17 or 18"),
        (f"0 3 {CAR}\n1 3 {CAR} 0.5\n", "line 2: 18 values where others have 17"),
        (f"0 3 {CAR}\n\n1 3 {CAR}\n", "line 2: 0 values"),
        (f"0 3 {CAR}\n1 x {CAR}\n", "line 2: track 'x'"),
        (f"0 3 {CAR.replace('4.0 2.0', '-4.0 2.0')}\n", "line 1: l -4; expected a size above 0"),
        (f"0 3 {CAR.replace('10.0 20.0', 'nan 20.0')}\n", "line 1: x1 'nan'"),
        (f"{CAR.replace('Car', '7')}\n", "line 1: class '1'; expected a word"),
    ],
)
def test_a_faulty_line_is_reported_with_its_location(tmp_path, text, reported):
    with pytest.raises(DataError, match=reported):
        read_labels(written(tmp_path, text))
