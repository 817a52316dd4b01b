"""The types of table 1, tuples and arrays of them, what their values may be; timestamps of seconds and nanoseconds."""

import math

import numpy as np
import pytest

from sceneloom.db34t import BasicType, Timestamp, ValueForm, ValueType
from sceneloom.errors import DataError


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


@pytest.mark.parametrize("text", ["", "int16", "uint32[0]", "uint32[-1]", "()", "(int8", "int8,int8", "(int8[2])", 3])
def test_what_is_no_type_is_refused(text):
    with pytest.raises(DataError, match="expected one of bool, int8"):
        ValueType.parse(text)


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
