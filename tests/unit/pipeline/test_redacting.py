"""Lists of boxes in images: CSV and JSON, and what is wrong in them."""

import json

import pytest

from sceneloom.editing.redact import ImageBox
from sceneloom.errors import DataError
from sceneloom.pipeline.redacting import read_image_boxes


def read(tmp_path, text, name="boxes.csv"):
    path = tmp_path / name
    path.write_text(text, "utf-8")
    return read_image_boxes(path)


def test_csv_rows_name_images_by_number_or_by_time(tmp_path):
    text = "camera,frame,time,x1,y1,x2,y2,id,class\nfront,3,,1,2,30.5,40,a,face\n1,,1700000000.000000001,0,0,1,1,,\n"
    assert read(tmp_path, text) == (
        ImageBox((1.0, 2.0, 30.5, 40.0), "front", 3, None, "a", "face"),
        ImageBox((0.0, 0.0, 1.0, 1.0), "1", None, 1_700_000_000_000_000_001),
    )


def test_csv_with_widths_and_json_lists_state_the_same(tmp_path):
    box = ImageBox((1.0, 2.0, 4.0, 6.0), None, None, 12)
    row = {"timestamp_ns": 12, "box": [1, 2, 4, 6]}
    assert read(tmp_path, "timestamp_ns,left,top,width,height\n12,1,2,3,4\n") == (box,)
    assert read(tmp_path, json.dumps([row])) == read(tmp_path, json.dumps({"boxes": [row]})) == (box,)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("a,b\n1,2\n", "line 1: columns a, b; expected camera, number"),
        ("", "line 1: columns none"),
        ("number,x1,y1,x2,y2\n0,1,2,3,x\n", "line 2: y2: 'x'; expected a number"),
        ("number,x1,y1,x2,y2\n0,1,2,3,nan\n", "line 2: y2: 'nan'; expected a finite number"),
        ("number,x1,y1,x2,y2\n0,5,2,3,4\n", "expected x1 <= x2"),
        ("number,x1,y1,x2,y2\n0.5,1,2,3,4\n", "number: '0.5'; expected a whole number"),
        ("number,x1,y1,x2,y2\n,1,2,3,4\n", "does not state which image"),
        ("number,x1,y1,x2,y2\n0,1,2,3\n", "line 2: has more or fewer values"),
        ("[1]", r"boxes\[0\]: 1; expected an object"),
        ("{}", "expected a list of boxes"),
        ("[", "is no JSON"),
        ('[{"number": true, "box": [1, 2, 3, 4]}]', "number: True"),
        ("time,x1,y1,x2,y2\n1e30,1,2,3,4\n", "expected seconds on the scene's clock"),
        ("number,x1,y1,x2,y2\n1e99999999,1,2,3,4\n", "expected a finite number"),
        ("timestamp_ns,x1,y1,x2,y2\n1e30,1,2,3,4\n", "expected one that an image of the scene can have"),
        ('[{"number": 0, "x1": 1, "y1": 2, "x2": [3], "y2": 4}]', r"x2: \[3\]; expected a number"),
        pytest.param("number,x1,y1,x2,y2," + "a" * 200_000, "is no CSV: field larger", id="long"),
    ],
)
def test_what_is_wrong_is_reported_with_its_line(tmp_path, text, problem):
    with pytest.raises(DataError, match=problem):
        read(tmp_path, text)


def test_a_file_that_is_not_there_and_one_that_is_no_text(tmp_path):
    with pytest.raises(DataError, match="no such file"):
        read_image_boxes(tmp_path / "none.csv")
    (tmp_path / "x.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DataError, match="is no UTF-8"):
        read_image_boxes(tmp_path / "x.csv")
