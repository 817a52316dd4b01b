"""The fusion interface against a small model of clause 5, and every record accounted for."""

import dataclasses
from collections import Counter, deque
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from sceneloom.db34t import Boxes2d, Boxes3d, CalibrationData, ImageData, PointCloudData, Timestamp
from sceneloom.db34t.interface import FusionInterface
from sceneloom.db34t.setting import PREDEFINED
from sceneloom.errors import OptionError
from sceneloom.fusion.algorithms import algorithm
from sceneloom.scene.poses import Poses

MS = 1_000_000
PERIOD_NS = 100 * MS
RESTART_NS = 2_000 * MS
CLOCK_JUMP_NS = 10_000 * MS
FORWARD = (0, 0, 1, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 0, 1)
CALIBRATION = CalibrationData(
    image_size=(2, 1), intrinsic_matrix=(2.0, 0, 0.5, 0, 2.0, 0, 0, 0, 1), reference_frame=0, extrinsic_matrix=FORWARD
)
TYPES = {"bool": (0, 1, 2), "uint32": (7, 2**32, -1), "string": ("a", 3), "(int8, int8)": ((1, -2), (1,), (1, 300))}
"""Types, and values of which the first ones fit."""
FITTING = {"bool": 2, "uint32": 1, "string": 1, "(int8, int8)": 1}
KINDS = ("image", "points", "boxes_2d", "boxes_3d")
ENDS = ("fused", "unpaired", "failed", "dropped.queue-full", "dropped.waiting")
PARTNERS = {"points": ("image", 0), "boxes_3d": ("boxes_2d", 1)}


def record(kind, time_ns, seq):
    head = {"sensor_id": int(kind in {"image", "boxes_2d"}), "timestamp": Timestamp.of(time_ns), "seq": seq}
    if kind == "image":
        return ImageData(**head, height=1, width=2, encoding="rgb8", channel=3, data=np.zeros(6, np.uint8))
    if kind == "points":
        points = np.array([5.0, 0, 0], np.float32)
        return PointCloudData(**head, number=1, fields=("x", "y", "z"), fields_number=3, data=points)
    return (Boxes2d if kind == "boxes_2d" else Boxes3d).empty(head["sensor_id"], seq, head["timestamp"])


class Pairs:
    """Sweeps and images of one fusion type, all of them kept, searched one by one."""

    def __init__(self):
        self.images = []  # (time, seq)
        self.waiting = deque()  # (time, seq, tolerance)
        self.latest_ns = 0
        self.results = deque()

    def fuse(self, lateness_ns, *, final=False):
        while self.waiting:
            time_ns, seq, tolerance_ns = self.waiting[0]
            distances = [abs(time - time_ns) for time, _ in self.images]
            known = any(time >= time_ns for time, _ in self.images) and min(distances) <= PERIOD_NS // 2
            if not (final or known or self.latest_ns > time_ns + tolerance_ns + lateness_ns):
                return
            self.waiting.popleft()
            near = [(abs(time - time_ns), time, number) for time, number in self.images]
            near = [found for found in near if found[0] <= tolerance_ns]
            if near:
                self.results.append((seq, min(near)[2]))


class Clause5(RuleBasedStateMachine):
    """What a caller does, done to the interface and to the model."""

    @initialize()
    def begin(self):
        self.fusion = FusionInterface(inline=True)
        self.added = {}
        self.tolerance_ms, self.timeout_ms, self.fusion_type = 0.0, 100, 0
        self.lateness_ns = self.stated_ns = None
        self.calibrated = self.closed = False
        self.now_ns = 1_000_000 * MS
        self.streams = {kind: {} for kind in KINDS}
        self.pairs = {0: Pairs(), 1: Pairs()}
        self.numbers = Counter()

    def teardown(self):
        if hasattr(self, "fusion"):
            self.fusion.close()

    @rule(name=st.sampled_from(["frequency", "mood", "chirality"]), type=st.sampled_from([*TYPES, "float16", "int8["]))
    def add(self, name, type):
        expected = name not in {*self.added, "chirality"} and type in TYPES
        assert self.fusion.add_property(name, "", type).status == int(expected)
        if expected:
            self.added[name] = [type, None]

    @rule(name=st.sampled_from(["frequency", "mood"]), data=st.data())
    def set(self, name, data):
        type = self.added.get(name, ["bool"])[0]
        value = data.draw(st.sampled_from(TYPES[type]))
        expected = name in self.added and TYPES[type].index(value) < FITTING[type]
        assert self.fusion.set_property(name, value).status == int(expected)
        if expected:
            self.added[name][1] = value

    @rule(name=st.sampled_from(["frequency", "mood", "camera_frequency"]))
    def read(self, name):
        if name == "camera_frequency":
            assert self.fusion.get_property(name) == 10
        elif name in self.added:
            assert self.fusion.get_property(name) == self.added[name][1]
        else:
            with pytest.raises(OptionError, match=name):
                self.fusion.get_property(name)

    @rule(tolerance=st.sampled_from([0.0, 30.0]), timeout=st.sampled_from([0, 100, 400]), type=st.sampled_from([0, 1]))
    def configure(self, tolerance, timeout, type):
        assert self.fusion.set_property("pairing_tolerance_ms", tolerance)
        assert self.fusion.set_property("pairing_timeout_ms", timeout)
        assert self.fusion.set_property("fusion_type", type)
        self.tolerance_ms, self.timeout_ms, self.fusion_type = tolerance, timeout, type

    @precondition(lambda self: not self.calibrated)
    @rule()
    def calibrate(self):
        assert self.fusion.set_calibration(CALIBRATION, camera_id=1, lidar_id=0)
        self.calibrated = True

    @precondition(lambda self: self.calibrated)
    @rule(row_major=st.booleans())
    def replace(self, row_major):
        numbers = tuple(np.reshape(FORWARD, (4, 4)).T.ravel().tolist()) if row_major else FORWARD
        calibration = dataclasses.replace(CALIBRATION, extrinsic_matrix=numbers)
        assert self.fusion.set_calibration(calibration, camera_id=1, lidar_id=0)

    @rule(back=st.sampled_from([0, 30, 20_000]), count=st.integers(1, 3))
    def move(self, back, count):
        times_ns = self.now_ns - back * MS + np.arange(count, dtype=np.int64) * 10 * MS
        quaternions = np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))
        outcome = self.fusion.send_motion(Poses(times_ns, np.zeros((count, 3)), quaternions))
        newer = self.stated_ns is None or times_ns[0] > self.stated_ns
        cause = "" if newer or times_ns[0] < self.stated_ns - CLOCK_JUMP_NS else "bad-motion"
        cause = "closed" if self.closed else cause
        assert (outcome.status, outcome.cause) == (int(not cause), cause)
        if not cause:
            self.stated_ns = int(times_ns[-1])

    @rule()
    def list_all(self):
        found = {entry.name: entry for entry in self.fusion.list_properties()}
        assert list(found) == [*PREDEFINED, *self.added]
        for name, (type, value) in self.added.items():
            assert (str(found[name].type), found[name].value) == (type, value)

    @rule(
        kind=st.sampled_from(KINDS), step=st.integers(0, 150), late=st.sampled_from([0, 40, 130]), again=st.booleans()
    )
    def send(self, kind, step, late, again):
        self.now_ns += step * MS
        time_ns = self.now_ns - late * MS
        seq = max(self.numbers[kind] - again, 0)
        outcome = self.fusion.send(record(kind, time_ns, seq))
        cause = self.judged(kind, time_ns, seq)
        assert (outcome.status, outcome.cause) == (int(not cause), cause)
        if cause:
            return
        self.numbers[kind] = seq + 1
        stream = self.streams[kind]
        if stream and time_ns > max(stream.values()) + RESTART_NS:
            stream.clear()
        stream[seq] = time_ns
        self.lateness_ns = self.timeout_ms * MS
        pairs = self.pairs[int(kind.startswith("boxes"))]
        pairs.latest_ns = max(pairs.latest_ns, time_ns)
        if kind in PARTNERS:
            tolerance_ns = int(self.tolerance_ms * MS) or PERIOD_NS
            pairs.waiting.append((time_ns, seq, tolerance_ns))
        else:
            pairs.images.append((time_ns, seq))
        for either in self.pairs.values():
            either.fuse(self.lateness_ns)

    def judged(self, kind, time_ns, seq):
        if self.closed:
            return "closed"
        if not self.calibrated:
            return "no-calibration"
        stream = self.streams[kind]
        if not stream:
            return ""
        newest_ns = max(stream.values())
        if seq in stream and time_ns - newest_ns <= RESTART_NS:
            return "duplicate"
        return "time-backwards" if newest_ns - time_ns > max(self.timeout_ms * MS, PERIOD_NS) else ""

    @rule(type=st.sampled_from([0, 1, None, 2]))
    def get(self, type):
        if type == 2:
            with pytest.raises(OptionError, match="fusion type 2"):
                self.fusion.get(type)
            return
        expected = self.pairs[self.fusion_type if type is None else type].results
        result = self.fusion.get(type)
        found = None if result is None else (result.record.points_seq, result.record.image_seq)
        assert found == (expected.popleft() if expected else None)

    @rule()
    def flush(self):
        self.fusion.flush()
        if not self.closed:
            for pairs in self.pairs.values():
                pairs.fuse(0, final=True)

    @precondition(lambda self: self.calibrated)
    @rule(sure=st.integers(0, 9))
    def close(self, sure):
        if sure == 0:
            self.flush()
            self.fusion.close()
            self.closed = True

    @invariant()
    def nothing_is_given_that_was_not_fused(self):
        if hasattr(self, "fusion"):
            assert self.fusion.waiting_results == sum(len(pairs.results) for pairs in self.pairs.values())


Clause5.TestCase.settings = settings(
    max_examples=40, stateful_step_count=40, suppress_health_check=[HealthCheck.too_slow]
)
TestClause5 = Clause5.TestCase
SENDS = st.tuples(
    st.sampled_from(KINDS), st.integers(-120, 250), st.integers(0, 12), st.sampled_from([0, 0, 0, 0, 10**8, -(10**8)])
)


class FailsNowAndThen:
    """Algorithms of which every second call raises."""

    def __init__(self, fusion_type, name):
        self.fuse, self.calls = algorithm(fusion_type, name), 0

    def __call__(self, *arguments, **named):
        self.calls += 1
        if self.calls % 2:
            raise ZeroDivisionError
        return self.fuse(*arguments, **named)


@pytest.mark.parametrize("inline", [True, False])
@pytest.mark.parametrize("policy", ["drop-oldest", "refuse"])
@settings(max_examples=15)
@given(sends=st.lists(SENDS, max_size=60), most=st.integers(1, 4), failing=st.booleans(), flushes=st.integers(5, 40))
def test_every_record_is_accounted_for(inline, policy, sends, most, failing, flushes):
    taken, refused = Counter(), Counter()
    fusion = FusionInterface(inline=inline)
    assert fusion.set_property("queue_policy", policy)
    assert fusion.set_property("queue_length", most)
    assert fusion.set_property("result_queue_length", 2)
    for lidar_id in (0, 2):  # so that images go to two
        assert fusion.set_calibration(CALIBRATION, camera_id=1, lidar_id=lidar_id)
    time_ns = 10**9 * MS
    with patch("sceneloom.fusion.system.algorithm", FailsNowAndThen if failing else algorithm):
        for k, (kind, step, seq, jump) in enumerate(sends):
            time_ns += (step + jump) * MS
            outcome = fusion.send(record(kind, time_ns, seq))
            if outcome:
                taken[kind] += 1
            else:
                refused[str(outcome.cause)] += 1
            if k % flushes == 0:
                fusion.flush()
        assert 0 <= fusion.waiting_records <= sum(taken.values())
        fusion.close()
    counts = Counter(fusion.counters.counts())
    assert fusion.waiting_records == 0
    for kind in KINDS:
        ends = [counts[f"{end}.{kind}"] for end in ENDS]
        assert counts[f"received.{kind}"] == taken[kind] == sum(ends)
    assert {name[8:]: count for name, count in counts.items() if name.startswith("refused.")} == dict(refused)
    results = counts["results.sensor_data"] + counts["results.detections"]
    assert results == counts["dropped.results"] + fusion.waiting_results
    assert fusion.waiting_results <= 4
