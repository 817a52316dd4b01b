"""Words of detectors that mean the same."""

import numpy as np
import pytest

from sceneloom.detections.detectors import FAMILIES, KINDS, SIZES, UNLISTED, kind_name, numbers_of, table_rows
from sceneloom.detections.projection import says_nothing


@pytest.mark.parametrize(
    ("word", "name"),
    [("Car", "car"), ("Person_sitting", "pedestrian"), ("BICYCLIST", "cyclist"), ("Pick-up Truck", "van")],
)
def test_words_are_found_whatever_their_case_and_dashes(word, name):
    assert kind_name(word) == name


def test_no_word_stands_for_two_classes():
    words = [word for name, kind in KINDS.items() for word in (name, *kind.words)]
    assert len(words) == len(set(words))


def test_words_in_no_table_are_equal_to_themselves_and_of_no_family():
    three, two = numbers_of(["dragon", "Dragon", "car"], ["DRAGON", "griffin", "van", "Sedan"])
    assert three[0] == three[1] == two[0]
    assert three[0] != two[1]
    assert three[2] == two[3] != two[2]
    rows = table_rows(np.concatenate([three, two]))
    assert rows.tolist() == [UNLISTED, UNLISTED, 0, UNLISTED, UNLISTED, list(KINDS).index("van"), 0]
    assert FAMILIES[UNLISTED] == -1
    assert FAMILIES[0] == FAMILIES[list(KINDS).index("van")] >= 0


def test_a_word_that_names_no_class_says_nothing():
    assert says_nothing("Unknown")
    assert says_nothing("")
    assert not says_nothing("dragon")


def test_typical_sizes_are_those_of_the_class():
    people, dragons = SIZES[table_rows(numbers_of(["Pedestrian", "dragon"], [])[0])]
    assert people[2] == pytest.approx(1.7, abs=0.1)
    assert (dragons[3:] > people[3:]).all()
