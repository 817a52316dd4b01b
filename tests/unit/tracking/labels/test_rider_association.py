"""Tests of who rides what."""

import numpy as np
import pytest

from sceneloom.tracking.labels import riders


@pytest.fixture
def beside(a_track):
    return lambda number, label, left: a_track(
        number, label, centers=a_track().centers + np.array([0.1, left, 0.0])
    )


def pairs(*tracks):
    return [(person.id, bike.id) for person, bike in riders(tracks)]


def test_a_person_is_linked_with_the_nearest_thing_that_it_stays_with(beside):
    assert pairs(beside(1, "Pedestrian", 0.0), beside(2, "bicycle", 0.5), beside(3, "bicycle", 0.1)) == [
        (1, 3)
    ]


def test_each_rides_one_thing_and_is_ridden_by_one(beside):
    people = beside(1, "rider", 0.0), beside(2, "person", 0.3)
    assert pairs(*people, beside(3, "motorcycle", 0.1)) == [(1, 3)]


def test_who_walks_past_or_is_somewhere_else_does_not_ride(a_track, beside):
    passing = a_track(1, "pedestrian", centers=np.zeros((21, 3)))
    assert pairs(passing, beside(2, "bicycle", 0.0)) == []
    later = a_track(1, "pedestrian", timestamps_ns=a_track().timestamps_ns + 7)
    assert pairs(later, beside(2, "bicycle", 0.0)) == []


def test_cars_are_not_ridden(beside):
    assert pairs(beside(1, "pedestrian", 0.0), beside(2, "car", 0.0)) == []
