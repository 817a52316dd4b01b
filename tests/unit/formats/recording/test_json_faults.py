"""What the decoder complains about, in words for people who do not program."""

import codecs
import gzip
from typing import Annotated

import msgspec
import pytest

from sceneloom.formats.recording.json_faults import DECODER_FAULTS, json_fault


class Entry(msgspec.Struct):
    """A value of each type that lines and calibrations have."""

    number: float | None = None
    seconds: Annotated[float, msgspec.Meta(le=9.2e9)] | None = None
    index: int | None = None
    model: str | None = None
    left: bool | None = None
    mount: dict[str, float] | None = None
    rows: list[float] | None = None


def told(text, kind=Entry):
    with pytest.raises(DECODER_FAULTS) as caught:
        msgspec.json.decode(text, type=kind)
    return json_fault(caught.value, text)


@pytest.mark.parametrize(
    ("text", "path", "problem"),
    [
        (b'{"number":"7"}', "number", '"7": expected a number, not a text'),
        (b'{"seconds":17e17}', "seconds", "1.7e18: expected a number of at most 9200000000.0"),
        (b'{"index":"0"}', "index", '"0": expected a whole number, not a text'),
        (b'{"model":3}', "model", "3: expected a text, not a whole number"),
        (b'{"left":"yes"}', "left", '"yes": expected true or false, not a text'),
        (b'{"mount":[1.0]}', "mount", "[1.0]: expected an object, not a list"),
        (b'{"rows":{}}', "rows", "{}: expected a list, not an object"),
    ],
)
def test_types_have_everyday_names(text, path, problem):
    assert told(text) == (path, problem)


def test_what_is_no_matter_of_types_is_told_as_it_is():
    assert told(b"{}", kind=msgspec.defstruct("Fix", [("altitude", float)])) == (
        "",
        "{}: Object missing required field `altitude`",
    )


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (b"", "empty; "),
        (codecs.BOM_UTF8 + b"{}", "begins with a byte order mark; "),
        ("{}".encode("utf-16"), "is text in UTF-16; "),
        (gzip.compress(b"{}", mtime=0), "is compressed by gzip; "),
    ],
)
def test_text_of_other_kinds_is_told_by_its_kind(text, problem):
    assert told(text)[1].startswith(problem)
