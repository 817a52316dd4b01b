"""Drives tracked in parts: objects keep one number through all of them."""

import numpy as np
import pytest

from sceneloom.batch.pieces import cut_times
from sceneloom.errors import DataError
from sceneloom.fusion.messages.json_form import format_json
from sceneloom.fusion.messages.scene_form import boxes_3d_record
from sceneloom.pipeline.detections.detected_scene import DetectionFiles, scene_drive
from sceneloom.pipeline.tracking import parts
from sceneloom.pipeline.tracking.job import track
from sceneloom.pipeline.tracking.parts import LEAD_SECONDS, Joining, same_objects
from sceneloom.scene import TrackedObjects
from sceneloom.simulate import LidarSpec, detect_3d, simulate_street

PERIOD_NS = 100_000_000
START, STOP = np.iinfo(np.int64).min, np.iinfo(np.int64).max


def told(time, places):
    """Objects by their numbers, each at its place along x [m]."""
    count = len(places)
    return TrackedObjects(
        time * PERIOD_NS,
        np.array(list(places), np.int64),
        ("car",) * count,
        np.array([[x, 0.0, 0.0] for x in places.values()]).reshape(-1, 3),
        *(np.ones((count, 3)), np.zeros(count), np.zeros((count, 3)), np.zeros(count)),
        *(np.tile(np.eye(10), (count, 1, 1)), np.ones(count), np.zeros(count, np.uint8)),
    )


def test_objects_in_the_same_places_are_one_whatever_their_numbers():
    earlier = {k * PERIOD_NS: told(k, {4: 0.0, 7: 10.0}) for k in range(5)}
    later = [told(k, {1: 10.2, 2: 0.1, 3: 30.0}) for k in range(3, 9)]
    assert same_objects(earlier, later) == {1: 7, 2: 4}


def test_the_nearest_pairs_of_all_together_are_taken():
    earlier = {0: told(0, {1: 0.0, 2: 1.0})}
    # the second lies nearest to 1 alone, but then the first would be left without a partner
    assert same_objects(earlier, [told(0, {8: -0.6, 9: 0.4})]) == {8: 1, 9: 2}


def test_objects_that_meet_once_are_two():
    earlier = {k * PERIOD_NS: told(k, {1: 5.0 * k}) for k in range(5)}
    later = [told(k, {1: 20.0 - 5.0 * k}) for k in range(5)]
    assert same_objects(earlier, later) == {}


def test_nothing_has_a_number_twice_and_what_goes_on_keeps_its_own():
    joining = Joining()
    first = joining.add([told(k, {1: 0.0, 2: 50.0}) for k in range(10)], (START, 8 * PERIOD_NS))
    second = joining.add([told(k, {1: 50.0, 2: 100.0}) for k in range(5, 20)], (8 * PERIOD_NS, STOP))
    assert [m.timestamp_ns // PERIOD_NS for m in (*first, *second)] == list(range(20))
    (a, b), (same, new) = first[0].ids.tolist(), second[0].ids.tolist()
    assert (same, len({a, b, new})) == (b, 3)


def test_an_object_gone_for_longer_than_what_leads_in_gets_a_new_number():
    gap = round(LEAD_SECONDS * 1e9) // PERIOD_NS + 5
    joining = Joining()
    (first, *_) = joining.add([told(0, {1: 0.0})], (START, gap * PERIOD_NS))
    (second, *_) = joining.add([told(gap, {1: 0.0})], (gap * PERIOD_NS, STOP))
    assert first.ids.tolist() != second.ids.tolist()


@pytest.fixture(scope="module")
def listed(tmp_path_factory):
    """Three seconds of a street, and what a detector of sweeps found in them."""
    folder = tmp_path_factory.mktemp("drive")
    drive = simulate_street(1, frames=30, lidar=LidarSpec(beams=16, steps=240), cameras=())
    records = [boxes_3d_record(one.boxes, sensor_id=0, seq=k) for k, one in enumerate(detect_3d(drive))]
    (folder / "boxes.jsonl").write_text("\n".join(map(format_json, records)))
    return drive.scene, DetectionFiles(boxes_3d=(folder / "boxes.jsonl",))


def test_joined_parts_tell_what_a_single_run_tells(listed, tmp_path, monkeypatch):
    monkeypatch.setattr(parts, "LEAD_SECONDS", 0.8)
    monkeypatch.setattr(parts, "TRAIL_SECONDS", 0.3)
    drive = scene_drive(*listed)
    whole = track(drive)
    spans = cut_times(drive.timestamps_ns, seconds=1.0)
    files = [tmp_path / str(k) for k in range(len(spans))]
    counts = [parts.track_part(drive, file, span_ns=s) for file, s in zip(files, spans, strict=True)]
    assert len(spans) == 3
    assert max(counts) < len(whole.moments)
    joined = parts.join_tracked(drive, files)
    assert [m.timestamp_ns for m in joined.moments] == [m.timestamp_ns for m in whole.moments]
    # what lives through a joint has one number on both sides of it, and no other object has it
    names = same_objects({m.timestamp_ns: m for m in whole.moments}, joined.moments)
    assert len(set(names.values())) == len(names) >= 5
    pairs = {(number, names.get(number)) for m in joined.moments for number in m.ids.tolist()}
    assert len({number for number, _ in pairs}) <= len(whole.tracks) + 2  # born shortly before a part begins
    last = {number: t.timestamps_ns[-1] - t.timestamps_ns[0] for number, t in by_id(whole).items()}
    for number, of_whole in names.items():
        if last[of_whole] > 2_000_000_000:
            mine = by_id(joined)[number]
            assert mine.timestamps_ns[-1] - mine.timestamps_ns[0] == last[of_whole]


def by_id(tracked):
    return {one.id: one for one in tracked.tracks}


def test_a_part_that_is_damaged_is_named(listed, tmp_path):
    drive = scene_drive(*listed)
    (span,) = cut_times(drive.timestamps_ns)
    parts.track_part(drive, tmp_path / "part", span_ns=span)
    (tmp_path / "part").write_bytes((tmp_path / "part").read_bytes()[:-7])
    with pytest.raises(DataError, match="part"):
        parts.join_tracked(drive, [tmp_path / "part"])
