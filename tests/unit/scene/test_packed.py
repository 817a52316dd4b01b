"""Points made of packed records: nobody can report them from other ones."""

import copy
import pickle
from dataclasses import FrozenInstanceError, dataclass, field, fields, replace
from threading import Barrier, Thread

import numpy as np
import pytest

from sceneloom.arrays import AnyArray
from sceneloom.errors import DataError
from sceneloom.scene import LidarFrame, LidarPoints

TIMES = np.array([30, 10, 20], np.int64)


def plain() -> LidarPoints:
    return LidarPoints(
        positions=np.arange(9, dtype=np.float32).reshape(3, 3),
        intensities=np.array([1, 2, 3], np.uint8),
        timestamps_ns=TIMES,
        extras={"further": np.ones(3)},
    )


@dataclass
class Records:
    """Counts how often its three records are taken apart."""

    asked: list[str] = field(default_factory=list)

    def __len__(self) -> int:
        return 3

    def unpacked(self) -> LidarPoints:
        self.asked.append("unpacked")
        return plain()


def assert_same(found: LidarPoints, expected: LidarPoints) -> None:
    for each in fields(LidarPoints):
        if each.name != "extras":
            np.testing.assert_array_equal(getattr(found, each.name), getattr(expected, each.name))
    assert found.extras.keys() == expected.extras.keys()


@pytest.mark.parametrize("name", [each.name for each in fields(LidarPoints)])
def test_whichever_field_is_asked_for_first_all_are_unpacked_once(name):
    records = Records()
    points = LidarPoints.of_packed(records)
    assert len(points) == points.packed_count() == 3
    assert records.asked == []
    first = getattr(points, name)
    assert first is getattr(points, name)
    assert_same(points, plain())
    assert records.asked == ["unpacked"]
    assert points.packed_count() is None
    assert len(points) == 3


@pytest.mark.parametrize("trajectory", [lambda points: pickle.loads(pickle.dumps(points)), copy.copy, copy.deepcopy])
def test_copies_are_unpacked(trajectory):
    again = trajectory(LidarPoints.of_packed(Records()))
    assert type(again) is LidarPoints
    assert again.packed_count() is None
    assert len(again) == 3
    assert_same(again, plain())


def test_a_field_can_be_replaced_and_the_others_stay():
    positions: AnyArray = np.zeros((3, 3), np.float32)
    changed = replace(LidarPoints.of_packed(Records()), positions=positions)
    assert changed.positions is positions
    assert_same(replace(changed, positions=plain().positions), plain())


def test_they_are_frozen_equal_to_themselves_only_and_paired_by_the_median_of_their_times():
    records = Records()
    points, other = LidarPoints.of_packed(records), LidarPoints.of_packed(records)
    assert points == points
    assert points != other
    assert len({points, other}) == 2
    assert records.asked == []
    with pytest.raises(FrozenInstanceError):
        points.positions = np.zeros((3, 3), np.float32)  # type: ignore[misc]
    with pytest.raises(AttributeError, match="'LidarPoints' object has no attribute 'position'"):
        _ = points.position  # type: ignore[attr-defined]
    assert not hasattr(plain(), "position")
    assert LidarFrame(0, other).reference_ns == 20


def test_what_is_wrong_with_records_is_reported_at_each_use():
    class Torn(Records):
        def unpacked(self) -> LidarPoints:
            raise DataError("0.bin", "byte 0", "torn")

    points = LidarPoints.of_packed(Torn())
    for _ in range(2):
        with pytest.raises(DataError, match="torn"):
            _ = points.positions


def test_threads_that_ask_at_once_all_get_the_fields():
    together = Barrier(4)

    class Slow(Records):
        def unpacked(self) -> LidarPoints:
            together.wait(timeout=10)
            return super().unpacked()

    points = LidarPoints.of_packed(Slow())
    found: list[int] = []
    threads = [Thread(target=lambda: found.append(int(points.positions[2, 2]))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [8, 8, 8, 8]
