"""The table of fields: whole, consistent, and reported on the page about the format."""

import re
from pathlib import Path

import numpy as np
import pytest

from sceneloom.formats.sfs.schema import ANNOTATION_RECORDS, RECORDS, Kind

PAGE = Path(__file__).parents[4] / "docs" / "formats" / "sfs.md"
OF_RECORDS = {Kind.RECORD, Kind.RECORDS, Kind.RECORD_OR_RECORDS, Kind.RECORD_LISTS, Kind.RECORD_MAP}
# records that have a table of their own on the page; sensors of ours, which stand under our metadata, have none
SHARED = {"poses": "Poses", "attribute": "Attributes"}
EVERYWHERE = {"sensor": ("Every sensor", "Poses"), "annotation": ("Every annotation", "Poses")}
ELSEWHERE = {"sensor imu", "sensor gnss"}
# one record serves the projections of cuboids and of keypoints
NOT_BOTH = {"annotation cuboid": ("points", "positions"), "annotation points": ("boxes", "cuboids")}


def tables_of_the_page():
    """The fields in the first columns of the page's tables, by the words of their headings."""
    section = PAGE.read_text("utf-8").split("### Field by field")[1].split("\n### ")[0]
    tables = {}
    for part in section.split("\n#### ")[1:]:
        heading, _, text = part.partition("\n")
        cells = re.findall(r"^\| (`.*?) \|", text, flags=re.MULTILINE)
        names = set(re.findall(r"`([^`]+)`", " ".join(cells)))
        for word in re.findall(r"`([^`]+)`", heading) or [heading]:
            tables[word] = names
    return tables


def leaves(record, prefix=""):
    """The paths of all fields of a record that hold no further record."""
    for field in RECORDS[record].values():
        if field.record in SHARED:
            yield f"{prefix}{field.name}", SHARED[field.record]
        elif field.kind in OF_RECORDS:
            many = {Kind.RECORDS: "[]", Kind.RECORD_OR_RECORDS: "[]", Kind.RECORD_LISTS: "[][]"}
            yield from leaves(field.record, f"{prefix}{field.name}{many.get(field.kind, '')}.")
        else:
            yield f"{prefix}{field.name}", None


@pytest.mark.parametrize("record", [r for r in RECORDS if r.split()[0] in EVERYWHERE and r not in ELSEWHERE])
def test_the_page_says_what_becomes_of_every_field(record):
    tables = tables_of_the_page()
    kind, name = record.split()
    own = {"lidar": "Lidar", "radar": "Radar", "points": "Points", "camera": "Camera", "odometry": "Odometry"}
    heading = own[name] if kind == "sensor" else name
    reported = tables[heading].union(*(tables[shared] for shared in EVERYWHERE[kind]))
    not_here = NOT_BOTH.get(record, ())
    for path, shared in leaves(record):
        if path.startswith("projections") and path.rsplit(".", 1)[1] in not_here:
            continue
        assert path in reported or (shared is not None and shared in tables), path
    for shared, heading in {"scene": "Scene", **SHARED}.items():
        assert {field.name for field in RECORDS[shared].values()} <= tables[heading]


def test_every_annotation_of_the_description_is_in_the_table_whose_fields_name_what_their_kind_needs():
    for name, field in ((f"{record}.{name}", field) for record in RECORDS for name, field in RECORDS[record].items()):
        assert (field.kind in OF_RECORDS) == (field.record != ""), name
        assert not field.record or field.record in RECORDS, name
        assert (field.kind is Kind.ARRAY) == (field.dtype != ""), name
        assert not field.dtype or np.dtype(field.dtype).name == field.dtype, name
    # Source: the headings of the description, plus `attributes`, `point`, `point_topdown`, `point_segmentation`
    expected = (
        "cuboid box_2d polyline_2d polygon_2d point_2d polygon polygon_topdown polyline points event labeled_points "
        "localization_adjustment camera_calibration object link group attributes point point_topdown "
        "point_segmentation"
    )
    assert set(ANNOTATION_RECORDS) == set(expected.split())
