"""Words of detectors that mean the same."""

import pytest

from sceneloom.detections.classes import KINDS, codes, kind_name, says_nothing, typical_sizes


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
    three, two = codes(["dragon", "Dragon", "car"], ["DRAGON", "griffin", "van"])
    assert three[0].tolist() == three[1].tolist() == two[0].tolist()
    assert three[0, 0] != two[1, 0]
    assert three[0, 1] == two[1, 1] == -1
    assert three[2, 1] == two[2, 1] >= 0


def test_a_word_that_names_no_class_says_nothing():
    assert says_nothing("Unknown")
    assert says_nothing("")
    assert not says_nothing("dragon")


def test_typical_sizes_are_those_of_the_class():
    sizes, sigmas = typical_sizes(["Pedestrian", "dragon"])
    assert sizes[0, 2] == pytest.approx(1.7, abs=0.1)
    assert (sigmas[1] > sigmas[0]).all()
