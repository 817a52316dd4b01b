"""Types of table 1, timestamps, rows of tables 3 to 10 against the standard and the `.proto`, and pages."""

import math
import re
from pathlib import Path

import numpy as np
import pytest

from sceneloom.db34t import RECORD_KINDS, TABLES, Timestamp
from sceneloom.db34t.interface import FusionInterface
from sceneloom.db34t.setting import PREDEFINED
from sceneloom.db34t.types import BasicType, ValueForm, ValueType
from sceneloom.db34t.wire import fusion_pb2
from sceneloom.errors import DataError

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
    expected = {(5, "height"): "1 to 4294967295", (5, "sensor_id"): "0 to 255", (7, "confidence"): "0 to 1"}
    expected |= {(7, "length"): "more than 0", (9, "image_depth"): "0 or more", (7, "X"): ""}
    assert {key: TABLES[key[0]].row(key[1]).range for key in expected} == expected
    with pytest.raises(KeyError):
        table.row("pitch")


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


@pytest.mark.parametrize(
    ("text", "form", "elements", "length"),
    [
        ("uint32", ValueForm.SCALAR, ["uint32"], None),
        ("(int8, int8, int8)", ValueForm.TUPLE, ["int8"] * 3, None),
        (" ( float ,string ) ", ValueForm.TUPLE, ["float", "string"], None),
        ("(bool,)", ValueForm.TUPLE, ["bool"], None),
        ("uint32[2]", ValueForm.ARRAY, ["uint32"], 2),
        ("string[]", ValueForm.ARRAY, ["string"], None),
        ("double[ 9 ]", ValueForm.ARRAY, ["double"], 9),
    ],
)
def test_a_type_is_read_as_the_standard_writes_it(text, form, elements, length):
    value_type = ValueType.parse(text)
    assert (value_type.form, value_type.length) == (form, length)
    assert [str(kind) for kind in value_type.elements] == elements
    assert ValueType.parse(str(value_type)) == value_type
    for wrong in ("", "int16", "uint32[0]", "uint32[-1]", "()", "(int8", "int8,int8", "(int8[2])", 3):
        with pytest.raises(DataError, match="expected one of bool, int8"):
            ValueType.parse(wrong)
    assert [str(kind) for kind in BasicType] == [
        "bool",
        "int8",
        "uint8",
        "int32",
        "uint32",
        "float",
        "double",
        "string",
        "enum",
    ]


@pytest.mark.parametrize(
    ("kind", "low", "high"),
    [("int8", -128, 127), ("uint8", 0, 255), ("int32", -(2**31), 2**31 - 1), ("uint32", 0, 2**32 - 1), ("bool", 0, 1)],
)
def test_whole_numbers_do_not_wrap(kind, low, high):
    value_type = ValueType.parse(kind)
    assert [value_type.check(low), value_type.check(high)] == [low, high]
    for beyond in (low - 1, high + 1, 2**64, -(2**200)):
        with pytest.raises(DataError, match=f"{low} to {high}"):
            value_type.check(beyond)


WRONG = {
    "uint32": [20.0, "20", True, None, [20]],
    "bool": ["true", 0.0],
    "float": [math.nan, math.inf, 3.5e38, "1.0", True],
    "double": [-math.inf, 10**400],
    "string": [b"MV3d", "\ud800"],
    "(int8, int8)": [(1,), 5, (1, 200)],
    "uint32[2]": [(1, 2, 3), "12", np.zeros((1, 2), np.uint32)],
    "string[]": ["xyz"],
}


@pytest.mark.parametrize(("kind", "value"), [(kind, value) for kind, values in WRONG.items() for value in values])
def test_a_value_of_another_type_or_size_is_refused(kind, value):
    with pytest.raises(DataError) as fault:
        ValueType.parse(kind).check(value, owner="properties", location="p")
    assert (fault.value.file, fault.value.location[:1]) == ("properties", "p")
    assert "expected" in fault.value.problem


@pytest.mark.parametrize(
    ("kind", "value", "kept"),
    [
        ("bool", True, 1),
        ("bool", np.False_, 0),
        ("uint8", np.uint8(200), 200),
        ("float", 1, 1.0),
        ("float", 0.1, float(np.float32(0.1))),
        ("float", 3.4028235e38, float(np.finfo(np.float32).max)),
        ("double", 0.1, 0.1),
        ("enum", "Car", "Car"),
        ("enum", 3, 3),
        ("(int8, int8, int8)", [2, 0, -1], (2, 0, -1)),
        ("uint32[2]", np.array([640, 480]), (640, 480)),
        ("string[]", [], ()),
    ],
)
def test_a_value_is_kept_as_plain_python(kind, value, kept):
    found = ValueType.parse(kind).check(value)
    assert found == kept
    assert type(found) is type(kept)


def test_timestamps_keep_every_nanosecond_and_are_ordered():
    example = Timestamp(1595682678, 715705367)
    assert (example.nanoseconds, str(example)) == (1595682678715705367, "1595682678.715705367")
    assert str(Timestamp(7, 5)) == "7.000000005"
    assert Timestamp.of(2**32 * 10**9 - 1) == Timestamp(2**32 - 1, 10**9 - 1)
    assert Timestamp(1, 999999999) < Timestamp(2, 0) < Timestamp(2, 1)


@pytest.mark.parametrize(
    ("make", "value", "expected"),
    [
        *((Timestamp.of, value, "expected 0 to") for value in (-1, 2**32 * 10**9, 1.5)),
        (Timestamp.parse, "4294967296.000000000", "expected a uint32"),
        *((Timestamp.parse, text, "expected") for text in ("1.5", "1595682678", "1.0000000001", " 1.000000000")),
        *((Timestamp.parse, text, "expected") for text in ("-1.000000000", "٣.000000000", 1595682678.7, None)),
        *(
            (lambda pair: Timestamp(*pair), pair, "expected")
            for pair in ((0, 10**9), (-1, 0), (2**32, 0), (0, -1), (1.5, 0), (0, "5"), (True, 0))
        ),
    ],
)
def test_what_no_timestamp_can_state_or_what_could_be_read_two_ways_is_refused(make, value, expected):
    with pytest.raises(DataError, match=expected):
        make(value)
