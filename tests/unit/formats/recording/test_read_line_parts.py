"""Large files are read by several processes: what they find is what one finds."""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sceneloom.errors import DataError, OptionError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.recording import line_parts
from sceneloom.formats.recording.column_arrays import line_seconds, lines_of
from sceneloom.formats.recording.columns import RecordingColumns
from sceneloom.formats.recording.columns_joining import ColumnsJoiner
from sceneloom.formats.recording.line_parts import LineParts, reading_processes
from sceneloom.formats.recording.line_worker import command, read_part
from sceneloom.formats.recording.lines import read_lines

TURN = {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}
POSE = {"position": {"x": 1.5, "y": 2.0, "z": 3.0}, "orientation": TURN}
FIX = {"latitude": 60.1, "longitude": 24.9, "altitude": 14.2}
LENSES = [{"focalLengthX": 9.0 + k} for k in range(3)]
KINDS: list[Callable[[int], dict[str, Any] | str]] = [
    lambda k: {"sensor": {"type": "gyroscope", "values": [k, 0.5, -0.25]}, "time": k},
    lambda k: {"sensor": {"type": "gyroscope", "values": [k, 0.5, 1], "temperature": 40 + k}, "time": k},
    lambda k: {"sensor": {"type": f"odd{k % 5}", "values": [k] * (1 + k % 5)}, "time": k},
    lambda k: {"groundTruth": POSE, "time": k},
    lambda k: {"arcore": POSE, "status": str(k), "time": k},
    lambda k: {"gps": FIX, "groundTruth": POSE, "time": k},
    lambda k: {"rtkgps": FIX, "time": k - 0.5},
    lambda k: {"frames": [{"cameraInd": 0, "cameraParameters": LENSES[k % 3]}], "number": k, "time": k},
    lambda k: {"frames": [{"cameraInd": k % 2}], "number": k, "time": k, "gps": FIX},
    lambda k: {"lidar": {"model": "RoboSense M1 XYZIRT", "dataFile": f"{k}.bin"}, "time": k},
    lambda k: {"barometer": {"pressureHectopascals": 1013 + k}, "time": k},
    lambda k: {"trigger": k, "time": k},
    lambda k: {"sdkVersion": str(k)},
    lambda k: f'{{"torn": {k}',
]
ODD = ["", '{"sensor": {"type": "odd1", "values": [1, 2, 3]}, "time": 1}', '{"time": NaN}']
"""Lines that are empty, no JSON, or whose samples are as wide as those of no other line."""

LINES = [KINDS[k * 5 % len(KINDS)](k) for k in range(60)]


def write(path: Path, lines: list[dict[str, Any] | str]) -> None:
    texts = [line if isinstance(line, str) else json.dumps(line) for line in lines]
    path.write_text("".join(text + "\n" for text in texts))


def content(value: Any) -> Any:
    """Columns as plain values, the codes of streams, which are any numbers, as what they stand for."""
    if is_dataclass(value):
        return {
            field.name: content(getattr(value, field.name))
            for field in fields(value)
            if field.name not in {"code", "codes", "last_code", "shared"}
        }
    if isinstance(value, dict):
        return {key: content(part) for key, part in value.items()}
    return list(map(str, value)) if hasattr(value, "typecode") else value


def told(columns: RecordingColumns) -> tuple[Any, ...]:
    lines = {key: lines_of(columns.log, stream.code).tolist() for key, stream in columns.streams().items()}
    shared = {line: (found.text, len(found.rows)) for line, found in columns.log.shared.items()}
    return content(columns), lines, shared, list(map(str, line_seconds(columns)))


@pytest.fixture
def small_parts(monkeypatch):
    """Parts of a few lines, of files of any size."""
    monkeypatch.setattr(line_parts, "PART", 300)
    monkeypatch.setattr(line_parts, "SMALL_FILE", 0)


def read(path: Path, processes: int, monkeypatch, *, lenient: bool = True) -> tuple[RecordingColumns, Ledger]:
    monkeypatch.setenv("SCENELOOM_PROCESSES", str(processes))
    ledger = Ledger(lenient=lenient)
    return read_lines(path, ledger), ledger


def test_two_processes_find_what_one_finds(tmp_path, monkeypatch, small_parts):
    path = tmp_path / "data.jsonl"
    write(path, LINES)
    alone, ledger = read(path, 1, monkeypatch)
    together, other = read(path, 2, monkeypatch)
    assert told(together) == told(alone)
    assert other.notices == ledger.notices


def test_the_first_fault_of_the_file_is_the_one_that_is_raised(tmp_path, monkeypatch, small_parts):
    path = tmp_path / "data.jsonl"
    write(path, [KINDS[0](k) for k in range(20)] + ["{"] + [KINDS[0](k) for k in range(20)] + ["{{"])
    with pytest.raises(DataError, match="line 21: "):
        read(path, 2, monkeypatch, lenient=False)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.integers(0, len(KINDS) - 1), max_size=30), st.integers(40, 400))
def test_parts_of_any_lengths_join_to_the_whole(tmp_path, monkeypatch, kinds, length):
    path = tmp_path / "data.jsonl"
    write(path, [KINDS[kind](k) for k, kind in enumerate(kinds)])
    size = path.stat().st_size
    whole, joined = read_part(path, 0, size), RecordingColumns()
    assert whole is not None
    joiner = ColumnsJoiner(joined)
    for start in range(0, size, length):
        part = read_part(path, start, min(start + length, size))
        assert part is not None
        if not joiner.can_join(part.columns):
            return
        joiner.join(part.columns)
    joiner.finish()
    assert told(joined) == told(whole.columns)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    kinds=st.lists(st.integers(0, len(KINDS) + 2), max_size=30),
    length=st.integers(40, 400),
    feed=st.sampled_from(["\n", "\r\n"]),
    ends=st.booleans(),
)
def test_parts_find_the_faults_and_notices_of_the_whole(
    tmp_path, monkeypatch, small_parts, kinds, length, feed, ends
):
    lines = [ODD[kind - len(KINDS)] if kind >= len(KINDS) else KINDS[kind](k) for k, kind in enumerate(kinds)]
    texts = [line if isinstance(line, str) else json.dumps(line) for line in lines]
    path = tmp_path / "data.jsonl"
    path.write_text('{"time": 0}' + feed + feed.join(texts) + (feed if ends else ""), newline="")
    monkeypatch.setattr(line_parts, "PART", length)
    monkeypatch.setattr(line_parts, "_start", lambda path: None)
    alone, ledger = read(path, 1, monkeypatch)
    together, other = read(path, 2, monkeypatch)
    assert told(together) == told(alone)
    assert other.notices == ledger.notices


def test_samples_whose_width_an_earlier_part_decides_are_read_once_more(tmp_path, monkeypatch, small_parts):
    path = tmp_path / "data.jsonl"
    write(path, [{"sensor": {"type": "odd", "values": [1] * (1 + k // 10)}, "time": k} for k in range(20)])
    alone, together = read(path, 1, monkeypatch)[0], read(path, 2, monkeypatch)[0]
    assert told(together) == told(alone)
    assert len(together.sensors["odd"]) == len(together.other_lines) == 10


def test_a_process_that_dies_leaves_its_parts_to_the_others(tmp_path, monkeypatch, small_parts):
    path = tmp_path / "data.jsonl"
    write(path, LINES)
    monkeypatch.setattr(line_parts, "command", lambda path: [sys.executable, "-c", "raise SystemExit(1)"])
    assert told(read(path, 2, monkeypatch)[0]) == told(read(path, 1, monkeypatch)[0])


SAYS_WRONG = [
    "print(0); input(); print(17); input()",
    "print(0); print(open(__import__('json').loads(input())[2], 'wb').write(b'torn')); input()",
    "print(0); input(); print(0); input()",
    "print('what?'); input()",
]


@pytest.mark.parametrize("script", SAYS_WRONG)
def test_parts_that_another_process_does_not_give_are_read_here(tmp_path, monkeypatch, small_parts, script):
    path = tmp_path / "data.jsonl"
    write(path, LINES)
    monkeypatch.setattr(line_parts, "command", lambda path: [sys.executable, "-u", "-c", script])
    assert told(read(path, 2, monkeypatch)[0]) == told(read(path, 1, monkeypatch)[0])


def test_without_a_place_for_parts_this_process_reads_alone(tmp_path, monkeypatch, small_parts):
    path = tmp_path / "data.jsonl"
    write(path, LINES)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "missing"))
    assert told(read(path, 2, monkeypatch)[0]) == told(read(path, 1, monkeypatch)[0])


def test_nothing_is_left_among_temporary_files(tmp_path, monkeypatch, small_parts):
    path, folder = tmp_path / "data.jsonl", tmp_path / "temporary"
    write(path, LINES)
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    read(path, 2, monkeypatch)
    assert not list(folder.iterdir())


def test_another_process_loads_only_what_reading_lines_needs(tmp_path):
    python, *rest = command(tmp_path / "data.jsonl")
    found = subprocess.run([python, "-X", "importtime", *rest], input=b"", capture_output=True, check=True)
    assert found.stdout == b"0\n"
    loaded = {line.rpartition(b"|")[2].strip().decode() for line in found.stderr.splitlines()}
    assert "sceneloom.formats.recording.line_reading" in loaded
    assert not loaded & {"numpy", "sceneloom.scene", "sceneloom.formats.recording.column_arrays"}


def test_no_process_is_left_when_reading_is_broken_off(tmp_path, small_parts):
    path = tmp_path / "data.jsonl"
    write(path, LINES)
    parts = LineParts(path, path.stat().st_size, 2)
    next(iter(parts))
    parts.close()
    (worker,) = parts._workers
    assert worker is not None
    assert worker.poll() is not None


def test_small_files_are_read_by_one_process(monkeypatch):
    monkeypatch.setenv("SCENELOOM_PROCESSES", "4")
    assert reading_processes(line_parts.SMALL_FILE - 1) == 1
    assert reading_processes(line_parts.SMALL_FILE) == 4


@pytest.mark.parametrize("text", ["0", "-1", "two", ""])
def test_a_number_of_processes_that_is_none_is_a_wrong_option(monkeypatch, text):
    monkeypatch.setenv("SCENELOOM_PROCESSES", text)
    with pytest.raises(OptionError, match="SCENELOOM_PROCESSES"):
        reading_processes(1)


def test_programs_that_are_no_python_read_alone(monkeypatch):
    monkeypatch.setenv("SCENELOOM_PROCESSES", "4")
    monkeypatch.setattr(sys, "executable", "/usr/bin/blender")
    assert reading_processes(1 << 40) == 1


def test_a_process_that_another_started_reads_alone_unless_told_otherwise(tmp_path, monkeypatch):
    path = tmp_path / "data.jsonl"
    write(path, LINES)
    monkeypatch.delenv("SCENELOOM_PROCESSES", raising=False)
    script = tmp_path / "script.py"
    script.write_text(
        "import multiprocessing\n"
        "from pathlib import Path\n"
        "from sceneloom.formats.ledger import Ledger\n"
        "from sceneloom.formats.recording.line_parts import reading_processes\n"
        "from sceneloom.formats.recording.lines import read_lines\n"
        "def count():\n"
        f"    columns = read_lines(Path({str(path)!r}), Ledger(lenient=True))\n"
        "    print(reading_processes(1 << 40), len(columns.log.codes), flush=True)\n"
        "if __name__ == '__main__':\n"
        "    child = multiprocessing.get_context('spawn').Process(target=count, daemon=True)\n"
        "    child.start()\n"
        "    child.join()\n"
    )
    found = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=True)
    assert found.stdout == f"1 {len(LINES)}\n"


def test_a_script_without_a_guard_reads_with_several_processes(tmp_path):
    path = tmp_path / "data.jsonl"
    write(path, LINES)
    script = tmp_path / "script.py"
    script.write_text(
        "from pathlib import Path\n"
        "from sceneloom.formats.ledger import Ledger\n"
        "from sceneloom.formats.recording import line_parts, lines\n"
        "line_parts.PART, line_parts.SMALL_FILE = 300, 0\n"
        f"columns = lines.read_lines(Path({str(path)!r}), Ledger(lenient=True))\n"
        "print(len(columns.log.codes))\n"
    )
    found = subprocess.run(
        [sys.executable, str(script)],
        env={**os.environ, "SCENELOOM_PROCESSES": "2"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert found.stdout == f"{len(LINES)}\n"
