"""Files that state what detectors are like."""

from dataclasses import asdict

import pytest

from sceneloom.detections.detectors import (
    detector_names,
    find_detectors,
    format_detectors,
    independent_detectors,
    read_detectors,
)
from sceneloom.errors import DataError, OptionError

TEXT = format_detectors(independent_detectors())


@pytest.mark.parametrize("name", detector_names())
def test_what_is_written_is_read_again(tmp_path, name):
    detectors = find_detectors(name)
    path = tmp_path / "mine.toml"
    path.write_text(format_detectors(detectors), "utf-8")
    again = find_detectors(str(path))
    assert (again.name, again.otherwise, again.provenance) == (
        detectors.name,
        detectors.otherwise,
        detectors.provenance,
    )
    assert again.degrees_of_freedom == detectors.degrees_of_freedom
    for label, own in detectors.classes.items():
        # five digits are written
        assert flat(asdict(again.classes[label])) == pytest.approx(flat(asdict(own)), rel=1e-4)


def flat(value):
    if isinstance(value, dict):
        return [x for inner in value.values() for x in flat(inner)]
    if isinstance(value, tuple):
        return [x for inner in value for x in flat(inner)]
    return [value]


@pytest.mark.parametrize("name", detector_names())
def test_surer_scores_never_make_an_object_of_the_package_s_detectors_less_likely(name):
    for own in find_detectors(name).classes.values():
        assert own.sweep.slope >= 0.0
        assert own.image.slope >= 0.0
        assert min(own.both.sweep, own.both.image, own.both.overlap) >= 0.0
        assert own.visibility.weak_recall_2d <= own.visibility.recall_2d


@pytest.mark.parametrize(
    ("old", "new", "location"),
    [
        ('otherwise = "car"', 'otherwise = "cart"', "otherwise: 'cart'"),
        ("prior = 0.1", "prior = 0.0", "classes.car.visibility.prior: 0.0"),
        ("slope = 1.0", "slope = nan", "classes.car.sweep.slope: nan"),
        ("slope = 1.0", "slop = 1.0", "slope"),
        ("degrees_of_freedom = inf", "degrees_of_freedom = 2.0", "degrees_of_freedom: 2.0"),
        ("[provenance]", "[provenance", "expected the TOML of detectors"),
        ("classes.van.", "classes.unicorn.", "classes.unicorn: no known class"),
    ],
)
def test_a_wrong_file_is_reported_with_its_location(tmp_path, old, new, location):
    assert old in TEXT
    path = tmp_path / "wrong.toml"
    path.write_text(TEXT.replace(old, new), "utf-8")
    with pytest.raises(DataError, match=str(path)) as caught:
        read_detectors(path)
    assert location in str(caught.value)


def test_unknown_detectors_are_reported_with_the_known_ones():
    with pytest.raises(OptionError, match=r"detectors 'kiti'; expected one of .*independent"):
        find_detectors("kiti")


def test_a_file_that_is_not_there_is_reported(tmp_path):
    with pytest.raises(DataError, match=r"none\.toml"):
        find_detectors(str(tmp_path / "none.toml"))
