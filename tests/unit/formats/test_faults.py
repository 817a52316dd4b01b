"""The ledger that keeps every fault of a recording with its location."""

import pytest

from sceneloom.errors import CalibrationError, DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.recording.reader import _MOST_LOCATIONS, _FaultLedger


def line(number):
    return DataError("/drive/data.jsonl", f"line {number}", f"{number} is odd")


def test_of_very_many_faults_those_beyond_are_counted_with_the_position_of_the_last():
    ledger = _FaultLedger("/drive")
    for number in range(_MOST_LOCATIONS + 500):
        ledger.fault("broken", line(number))
    ledger.fault("other", line(7))
    assert len(ledger.faults) == _MOST_LOCATIONS + 2
    assert sum(fault.count for fault in ledger.faults if fault.code == "broken") == _MOST_LOCATIONS + 500
    last = ledger.faults[-1]
    assert (last.path, last.count) == (f"data.jsonl: line {_MOST_LOCATIONS + 499}", 500)


def test_locations_are_distinguished_from_the_folder_on_and_vital_faults_refused_even_by_a_lenient_reading():
    with pytest.raises(DataError):
        Ledger(lenient=True).refuse("unreadable", line(1))
    ledger = _FaultLedger("/drive")
    ledger.refuse("unreadable", line(1))
    ledger.fault("camera_model", CalibrationError("/drive/data.jsonl: line 3: frames[].imuToCamera: is skewed: 0.5"))
    ledger.fault("camera_model", CalibrationError("no camera model at all"))
    ledger.fault("camera_model", CalibrationError("/drive/a file: is odd"))
    ledger.fault("broken", line(3))
    assert [(fault.path, fault.problem, fault.code, fault.vital) for fault in ledger.faults] == [
        ("data.jsonl: line 1", "1 is odd", "unreadable", True),
        ("data.jsonl: line 3: frames[].imuToCamera", "is skewed: 0.5", "camera_model", False),
        ("", "no camera model at all", "camera_model", False),
        ("", "a file: is odd", "camera_model", False),
        ("data.jsonl: line 3", "3 is odd", "broken", False),
    ]
