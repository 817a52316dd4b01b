"""The order of streams in lines of one time, so that few times have an order of their own."""

import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sceneloom.formats.ledger import Ledger
from sceneloom.formats.recording.column_arrays import line_seconds
from sceneloom.formats.recording.line_order import line_order
from sceneloom.formats.recording.lines import read_lines

STREAMS = "abcde"


def order_of(groups: list[list[int]]) -> dict[str, Any]:
    """The order that is found where each group is of one time; it names streams by letters."""
    lines = [
        {"sensor": {"type": STREAMS[stream], "values": [1]}, "time": time_s}
        for time_s, group in enumerate(groups)
        for stream in group
    ]
    with TemporaryDirectory() as folder:
        path = Path(folder, "data.jsonl")
        path.write_text("".join(json.dumps(line) + "\n" for line in lines))
        columns = read_lines(path, Ledger(lenient=False))
    names = {stream.code: name for name, stream in columns.sensors.items()}
    return line_order(columns, names, np.zeros(0, np.int64), line_seconds(columns))


@given(st.permutations(range(5)), st.lists(st.sets(st.integers(0, 4), min_size=1), min_size=1, max_size=12))
def test_streams_that_always_stand_in_one_order_need_no_exceptions(order, members):
    groups = [sorted(group, key=order.index) for group in members]
    assert "exceptions" not in order_of(groups)


def test_a_stream_that_is_at_few_times_stands_behind_one_that_is_at_all():
    found = order_of([[0, 1], [0, 1, 2]] * 10 + [[0, 1, 2, 3]])
    assert found == {"streams": list("abcd")}


def test_the_order_that_is_against_most_is_an_exception():
    found = order_of([[0, 1]] * 5 + [[1, 2]] * 4 + [[2, 0]] * 2 + [[0, 1]])
    assert found["streams"] == list("abc")
    assert set(found["exceptions"]) == {str(time_s * 10**9) for time_s in (9, 10)}
