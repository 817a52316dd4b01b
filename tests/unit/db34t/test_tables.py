"""The rows of tables 3 to 10 against the standard's text and the `.proto`, pages against the interface."""

import re
from pathlib import Path

import pytest

from sceneloom.db34t import RECORD_KINDS, TABLES
from sceneloom.db34t.interface import FusionInterface
from sceneloom.db34t.setting import PREDEFINED
from sceneloom.db34t.wire import fusion_pb2

from .sending import boxes_2d, boxes_3d, calibration, cloud, image

NAMES = {
    3: "image_size distortion_coeffs intrinsic_matrix reference_frame extrinsic_matrix",
    4: "sensor_id timestamp seq length data",
    5: "sensor_id timestamp seq height width encoding channel data",
    6: "sensor_id timestamp seq number fields fields_number data sensor_type beam ring",
    7: "id class points_seq confidence timestamp X Y Z length width height direction velocity",
    8: "id class image_seq confidence timestamp x1 y1 x2 y2",
    9: "timestamp class image_seq points_seq camera_id lidar_id height width encoding image_channel image_data "
    "image_depth point_num point_fields fields_number point_data",
    10: "id confidence timestamp class X Y Z center_cov length width height size_cov direction velocity x1 y1 x2 y2",
}
"""As the standard's tables have them, in order."""

TYPES = {
    3: "uint32[2] double[5] double[9] bool double[16]",
    4: "uint8 time uint32 uint32 int8[]",
    5: "uint8 time uint32 uint32 uint32 string uint8 uint8[]",
    6: "uint8 time uint32 uint32 string[] uint8 float[] bool uint32 uint32",
    7: "int32 enum uint32 float time float float float float float float float[3] float",
    8: "int32 enum uint32 float time uint32 uint32 uint32 uint32",
    9: "time enum uint32 uint32 uint8 uint8 uint32 uint32 string uint8 uint8[] float[] uint32 string[] uint8 float[]",
    10: "int32 float time enum float float float float[9] float float float float[9] float[3] float" + " uint32" * 4,
}


@pytest.mark.parametrize("number", NAMES)
def test_rows_have_the_names_types_and_sound_examples_of_the_standard_in_its_order(number):
    table = TABLES[number]
    rows = [row for row in table.rows if not row.is_extension]
    types = [row.type.replace("uint32. uint32", "time") for row in rows]
    assert ([row.name for row in rows], types) == (NAMES[number].split(), TYPES[number].split())
    assert [row.number for row in rows] == list(range(1, len(rows) + 1))
    examples = [row for row in rows if row.example is not None]
    assert len(examples) >= 2
    for row in examples:
        row.check(row.example, table.owner)


@pytest.mark.parametrize("kind", RECORD_KINDS.values(), ids=lambda kind: kind.name)
def test_messages_of_all_kinds_have_the_fields_of_their_tables(kind):
    fields = {field.name: field.number for field in getattr(fusion_pb2, kind.message_name).DESCRIPTOR.fields}
    if kind.layout is not None:
        fields.pop(kind.layout.group)
    assert fields == {row.name: row.number for row in kind.table.rows}
    attributes = {row.attribute for row in kind.table.rows}
    assert attributes <= set(kind.record_type.__dataclass_fields__)


def test_kinds_have_the_names_of_what_requests_and_replies_carry():
    sent = fusion_pb2.SendRequest.DESCRIPTOR.oneofs_by_name["data"].fields
    got = fusion_pb2.GetReply.DESCRIPTOR.oneofs_by_name["result"].fields
    carried = {field.name: field.message_type.name for field in (*sent, *got) if field.name != "no_data"}
    assert {name: RECORD_KINDS[name].message_name for name in carried} == carried
    assert {kind.table.number for kind in RECORD_KINDS.values()} >= set(NAMES)


def test_a_row_says_its_range_in_words():
    expected = {(5, "height"): "1 to 4294967295", (5, "sensor_id"): "0 to 255", (7, "confidence"): "0 to 1"}
    expected |= {(7, "length"): "more than 0", (9, "image_depth"): "0 or more", (7, "X"): ""}
    assert {key: TABLES[key[0]].row(key[1]).range for key in expected} == expected
    with pytest.raises(KeyError):
        TABLES[7].row("pitch")


DOCS = Path(__file__).parents[3] / "docs"
PAGES = {name: (DOCS / f"{name}.md").read_text("utf-8") for name in ("db34t-4101", "db34t-4101.zh")}


def rows(page):
    """Cells of all rows of tables, by their first cell without backticks."""
    found = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in page.splitlines() if line[:1] == "|"]
    return {cells[0].replace("`", "").strip(): cells for cells in found}


def test_the_english_page_says_of_properties_what_the_interface_itself_says():
    cells = rows(PAGES["db34t-4101"])
    assert [name for name, row in PREDEFINED.items() if not cells[name][3].startswith(row.description)] == []


@pytest.mark.parametrize("page", PAGES.values(), ids=PAGES)
def test_every_counter_stands_there(page):
    with FusionInterface(inline=True) as fusion:
        fusion.send(cloud(0, 0))
        assert fusion.set_calibration(calibration(), camera_id=1, lidar_id=0)
        for seq in range(3):
            for send in (image, cloud, boxes_2d, boxes_3d):
                fusion.send(send(-20_000 * seq, seq))
        fusion.close()
        names = set(fusion.counters.counts())
    documented = [
        re.compile(re.escape(name).replace("KIND", "[a-z_0-9]+").replace("CAUSE", "[a-z-]+").replace("NAME", r"\S+"))
        for row in rows(page).values()
        for name in re.findall(r"`([^`]+)`", row[0])
    ]
    assert len(names) >= 9
    assert not [name for name in names if not any(pattern.fullmatch(name) for pattern in documented)]
