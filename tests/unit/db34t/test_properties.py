"""Clauses 5.2 to 5.5: properties are there, added, set and read."""

import threading

import numpy as np
import pytest

from sceneloom.db34t.interface import PropertyStore
from sceneloom.db34t.setting import MOST_PROPERTIES, PREDEFINED
from sceneloom.db34t.types import Cause

TABLE_2 = {
    "fusion_type": 0,
    "chirality": 0,
    "camera_coordinate": (2, 0, -1),
    "lidar_coordinate": (0, -1, 2),
    "camera_frequency": 10,
    "lidar_frequency": 10,
}
"""Names and examples of table 2, less the algorithm, whose example is not built in."""


def test_the_properties_of_table_2_stand_first_with_its_examples_and_every_default_can_be_set():
    store = PropertyStore()
    before = store.snapshot()
    assert list(before.properties)[:7] == [*TABLE_2, "fusion_algorithm"]
    assert {name: before[name] for name in TABLE_2} == TABLE_2
    assert all(found.predefined for found in before.properties.values())
    for row in PREDEFINED.values():
        assert store.set(row.name, row.default).status == 1, row.name
    assert store.set("lidar_frequency", 20)
    assert (before["lidar_frequency"], store.snapshot()["lidar_frequency"]) == (10, 20)  # a snapshot stays as it was
    assert store.snapshot().revision > before.revision


REFUSED = {
    Cause.ILL_TYPED: [
        *(("camera_frequency", value) for value in (-1, 2**32, 2**32 + 20, 20.0, "20", True)),  # it does not wrap to 0
        *(("camera_coordinate", value) for value in ((2, 0), (2, 0, 200))),
        *(("fusion_type", 2), ("pairing_tolerance_ms", float("nan"))),
    ],
    Cause.OUT_OF_RANGE: [
        *(("camera_frequency", 0), ("camera_coordinate", (2, 0, 0)), ("pairing_tolerance_ms", -1.0)),
        *(("depth_kind", "y"), ("sensors", "[]"), ("calibration", '[{"camera_id": 300}]'), ("lidar_axes", "up")),
    ],
    Cause.UNKNOWN_NAME: [("no_such", 1)],
}


@pytest.mark.parametrize(("name", "value", "cause"), [(*row, cause) for cause, rows in REFUSED.items() for row in rows])
def test_what_is_refused_leaves_the_property_as_it_was(name, value, cause):
    store = PropertyStore()
    before = store.snapshot()
    outcome = store.set(name, value)
    assert (outcome.status, outcome.cause) == (0, cause)
    assert outcome.reason
    assert store.snapshot() is before


def test_each_fusion_type_keeps_its_own_algorithm():
    asked = []
    store = PropertyStore(check_algorithm=lambda fusion_type, name: asked.append((fusion_type, name)))
    assert store.set("fusion_algorithm", "of_points")
    assert store.set("fusion_type", 1)
    assert store.get("fusion_algorithm").value == "projection"
    assert store.set("fusion_algorithm", "of_boxes")
    assert store.snapshot().algorithms == ("of_points", "of_boxes")
    assert store.set("fusion_type", 0)
    assert store.get("fusion_algorithm").value == "of_points"
    assert asked == [(0, "of_points"), (1, "of_boxes")]


def test_an_enum_takes_the_names_and_numbers_of_its_description_and_truth_values_of_two():
    store = PropertyStore()
    for value in (0, 1, False, True, np.uint8(1)):
        assert store.set("chirality", value)
        found = store.get("chirality").value
        assert (type(found), found) == (int, int(value))
    assert store.add("weather", "what it is like: dry=0, rain=1, snow=-1", "enum")
    assert store.set("weather", "snow")
    assert store.get("weather").value == -1
    assert [store.set("weather", value).status for value in (1, 2, "fog")] == [1, 0, 0]
    assert store.get("weather").value == 1
    assert not store.add("mood", "without values", "enum")


def test_what_is_wrong_with_a_property_that_is_added_is_named_and_who_adds_for_ever_is_stopped():
    store = PropertyStore()
    for name in ("", " ", "a b", "\n", "x" * 257):
        assert store.add(name, "", "bool").cause is Cause.ILL_TYPED
    for name, description, wrong, sound in (
        ("frequency", "x" * 100_001, "description", "name"),
        ("a name", "", "name", "description"),
    ):
        outcome = store.add(name, description, "uint32")
        assert (outcome.status, wrong in outcome.reason, sound in outcome.reason) == (0, True, False)
    outcomes = [store.add(f"p{k}", "", "bool") for k in range(MOST_PROPERTIES)]
    assert (outcomes[0].status, outcomes[-1].cause) == (1, Cause.TOO_MANY)
    assert store.add("p0", "", "bool").cause is Cause.KNOWN_NAME
    assert len(store.snapshot().properties) == MOST_PROPERTIES


def test_callers_at_once_lose_no_change():
    store = PropertyStore()
    start = threading.Barrier(4)

    def add(caller):
        start.wait()
        for k in range(100):
            assert store.add(f"p{caller}_{k}", "", "uint32")
            assert store.set(f"p{caller}_{k}", k)

    threads = [threading.Thread(target=add, args=(caller,)) for caller in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    found = store.snapshot()
    assert found.revision == 800
    assert all(found[f"p{caller}_{k}"] == k for caller in range(4) for k in range(100))
