"""What the decoder complains about, in words for people who do not program."""

import bz2
import codecs
import gzip
import lzma
from typing import Annotated, Any

import msgspec
import pytest

from sceneloom.formats.recording.json_faults import DECODER_FAULTS, json_fault, other_file


class Entry(msgspec.Struct):
    """A value of each type that lines and calibrations have."""

    number: float | None = None
    seconds: Annotated[float, msgspec.Meta(le=9.2e9)] | None = None
    index: int | None = None
    model: str | None = None
    left: bool | None = None
    mount: dict[str, float] | None = None
    rows: list[float] | None = None


def reported(text, kind=Entry):
    with pytest.raises(DECODER_FAULTS) as caught:
        msgspec.json.decode(text, type=kind)
    return json_fault(caught.value, text)


@pytest.mark.parametrize(
    ("text", "path", "problem"),
    [
        (b'{"number":"7"}', "number", '"7": expected a number, not a text'),
        (b'{"seconds":17e17}', "seconds", "1.7e18: expected seconds, within ±9.2e+09; this looks like nanoseconds"),
        (
            b'{"seconds":17e11}',
            "seconds",
            "1700000000000.0: expected seconds, within ±9.2e+09; this looks like milliseconds",
        ),
        (
            b'{"seconds":17e14}',
            "seconds",
            "1700000000000000.0: expected seconds, within ±9.2e+09; this looks like microseconds",
        ),
        (b'{"seconds":1e10}', "seconds", "10000000000.0: expected seconds, within ±9.2e+09"),
        (b'{"index":"0"}', "index", '"0": expected a whole number, not a text'),
        (b'{"model":3}', "model", "3: expected a text, not a whole number"),
        (b'{"left":"yes"}', "left", '"yes": expected true or false, not a text'),
        (b'{"mount":[1.0]}', "mount", "[1.0]: expected an object, not a list"),
        (b'{"rows":{}}', "rows", "{}: expected a list, not an object"),
    ],
)
def test_types_have_everyday_names(text, path, problem):
    assert reported(text) == (path, problem)


def test_what_is_no_matter_of_types_is_reported_as_it_is_and_other_files_by_their_first_bytes():
    fix = msgspec.defstruct("Fix", [("altitude", float)])
    assert reported(b"{}", kind=fix) == ("", "{}: Object missing required field `altitude`")
    assert reported(b"")[1].startswith("empty; ")
    assert reported(codecs.BOM_UTF8 + b"{}")[1].startswith("begins with a byte order mark; ")
    texts = {bz2.compress(b"{}"): "is compressed by bzip2", lzma.compress(b"{}"): "is compressed by xz"}
    texts |= {gzip.compress(b"{}", mtime=0): "is compressed by gzip"}
    texts |= {'{"time":1}'.encode("utf-16"): "is text in UTF-16"}
    for text, kind in texts.items():
        assert reported(text)[1].startswith(f"{kind}; ")
        assert other_file(text[:16]) == kind
    for encoding in ("utf-16-le", "utf-16-be"):
        assert other_file('{"time":1}'.encode(encoding)[:16]) == "is text in UTF-16"
    for text in (b'{"time":1}', codecs.BOM_UTF8 + b"{}", bytes(range(16)), b""):
        assert other_file(text[:16]) is None


@pytest.mark.parametrize(
    ("text", "hint"), [(b'{"number":1},', "no list"), (b"[", "no list"), (b"{", "each object in one line")]
)
def test_a_list_and_an_object_over_several_lines_are_reported_to_be_none_of_a_log(text, hint):
    assert hint in reported(text, kind=Any)[1]
