"""The table of formats in the documentation against the formats."""

import re
from pathlib import Path

import pytest
from tests.test_documentation import SHARED_PAGES

from sceneloom.errors import OptionError
from sceneloom.formats.base.losses import Support
from sceneloom.formats.base.registry import FORMATS, format_named, open_scene
from sceneloom.formats.listing import FormatListing, list_formats, list_supported_fields
from sceneloom.scene.contents import MODEL_FIELDS

PAGE = Path(__file__).parents[3] / "docs" / "converting.md"


def row(form: FormatListing) -> str:
    """The row that the page has to have."""
    page = f"formats/{SHARED_PAGES.get(form.name, form.name)}.md"
    name = f"`{form.name}`" if form.trajectory else f"[{form.name}]({page})"
    suffixes = " ".join(f"`{suffix}`" for suffix in form.suffixes if suffix) or (
        f"`--to {form.name}`" if form.name != "recording" else "none"
    )
    both = " | ".join("yes" if can else "no" for can in (form.reads, form.writes))
    return f"| {name} | {both} | {suffixes if form.writes else ''} | {form.looks_like} |".replace("  ", " ")


@pytest.mark.parametrize("form", list_formats(), ids=lambda form: form.name)
def test_the_page_says_of_each_format_what_the_code_says(form):
    assert row(form) in PAGE.read_text().splitlines(), f"docs/converting.md lacks: {row(form)}"


def test_help_of_open_names_each_format_that_is_read():
    named = open_scene.__doc__.split("Formats: ")[1].split("`sceneloom formats`")[0]
    words = set(re.split(r"[,;.\s]+", named))
    assert {form.name for form in list_formats() if form.reads and not form.trajectory} <= words


def test_the_page_lists_no_format_that_is_not_there():
    rows = [line for line in PAGE.read_text().splitlines() if line.startswith(("| [", "| `"))]
    assert sorted(rows) == sorted(map(row, list_formats()))


@pytest.mark.parametrize("name", [name for name in FORMATS if format_named(name).writes])
def test_a_format_that_is_written_says_something_of_every_field(name):
    assert list(list_supported_fields(name)) == list(MODEL_FIELDS)


def test_a_format_that_is_only_read_holds_nothing_and_an_unknown_one_is_refused():
    assert list_supported_fields("rig") == {}
    assert list_supported_fields("tum")["sensors.lidar.id"].support == Support.DROPPED
    with pytest.raises(OptionError, match="no format or form 'nope'"):
        list_supported_fields("nope")
