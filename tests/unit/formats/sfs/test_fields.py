"""The table of fields: whole, consistent, and told on the page about the format."""

import re
from pathlib import Path

import numpy as np
import pytest

from sceneloom.formats.sfs.fields import ANNOTATION_RECORDS, RECORDS, SENSOR_RECORDS, Kind

PAGE = Path(__file__).parents[4] / "docs" / "formats" / "sfs.md"
OF_RECORDS = {Kind.RECORD, Kind.RECORDS, Kind.RECORD_OR_RECORDS, Kind.RECORD_LISTS, Kind.RECORD_MAP}
FIELDS = [(record, field) for record, fields in RECORDS.items() for field in fields.values()]


@pytest.mark.parametrize(
    ("record", "field"), FIELDS, ids=[f"{record}.{field.name}" for record, field in FIELDS]
)
def test_a_field_names_what_its_kind_needs(record, field):
    assert (field.kind in OF_RECORDS) == (field.record != "")
    assert not field.record or field.record in RECORDS
    assert (field.kind is Kind.ARRAY) == (field.dtype != "")
    assert not field.dtype or np.dtype(field.dtype).name == field.dtype


def test_every_field_and_type_stands_on_the_page_about_the_format():
    text = re.sub(r"^```.*?^```", "", PAGE.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
    words = set(re.findall(r"\w+", " ".join(re.findall(r"`([^`]+)`", text))))
    names = {field.name for _, field in FIELDS} | set(SENSOR_RECORDS) | set(ANNOTATION_RECORDS)
    told_in_words = {"imu", "gnss", "type"}
    assert names - words - told_in_words == set()


def test_every_annotation_of_the_description_is_in_the_table():
    # Source: the headings of the description, plus `attributes`, `point`, `point_topdown`, `point_segmentation`
    expected = (
        "cuboid box_2d polyline_2d polygon_2d point_2d polygon polygon_topdown polyline points event labeled_points "
        "localization_adjustment camera_calibration object link group attributes point point_topdown "
        "point_segmentation"
    )
    assert set(ANNOTATION_RECORDS) == set(expected.split())
