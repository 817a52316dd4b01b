"""Any id gives a name that stays in its folder, and no two ids share one."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sceneloom.formats.base.output import file_stem, file_stems

IDS = st.one_of(st.integers(), st.text(st.characters(exclude_categories=["Cs"]), max_size=300))


@given(IDS)
def test_a_stem_is_one_part_of_a_path_and_short(identifier: str | int) -> None:
    stem = file_stem(identifier)
    assert stem
    assert not set(stem) & set('/\\:*?"<>|\0')
    assert not stem.startswith(".")
    assert stem.isascii()
    assert len(stem) <= 129


@given(st.lists(IDS, max_size=8))
def test_stems_of_several_ids_differ_even_where_case_does_not_count(identifiers: list[str | int]) -> None:
    stems = file_stems(identifiers)
    assert len({stem.casefold() for stem in stems}) == len(stems) == len(identifiers)


@pytest.mark.parametrize(
    ("identifiers", "stems"),
    [
        ((1, "1"), ["1", "1~2"]),
        (("Front", "front"), ["Front", "front~2"]),
        (("", "%"), ["%", "%25"]),
        (("a/../b", "..", "camera 0"), ["a%2F..%2Fb", "%2E.", "camera 0"]),
    ],
)
def test_ids_keep_what_a_file_name_can_hold(identifiers: tuple[str | int, ...], stems: list[str]) -> None:
    assert file_stems(identifiers) == stems
