"""The ledger that keeps every fault with its location."""

import pytest

from sceneloom.errors import CalibrationError, DataError
from sceneloom.formats.base.diagnostics import MOST_LOCATIONS, FaultLedger, Ledger


def line(number):
    return DataError("/drive/data.jsonl", f"line {number}", f"{number} is odd")


def test_of_very_many_faults_those_beyond_are_counted_with_the_position_of_the_last():
    ledger = FaultLedger("/drive")
    for number in range(MOST_LOCATIONS + 500):
        ledger.fault("broken", line(number))
    ledger.fault("other", line(7))
    assert len(ledger.faults) == MOST_LOCATIONS + 2
    assert sum(fault.count for fault in ledger.faults if fault.code == "broken") == MOST_LOCATIONS + 500
    last = ledger.faults[-1]
    assert (last.path, last.count) == (f"data.jsonl: line {MOST_LOCATIONS + 499}", 500)


def test_what_decides_the_meaning_of_the_rest_is_refused_even_by_a_lenient_reading():
    with pytest.raises(DataError):
        Ledger(lenient=True).refuse("unreadable", line(1))
    ledger = FaultLedger("/drive")
    ledger.refuse("unreadable", line(1))
    assert [fault.vital for fault in ledger.faults] == [True]


def test_locations_are_distinguished_from_the_folder_on_and_taken_out_of_messages():
    ledger = FaultLedger("/drive")
    ledger.fault("camera_model", CalibrationError("/drive/data.jsonl: line 3: frames[].imuToCamera: is skewed: 0.5"))
    ledger.fault("camera_model", CalibrationError("no camera model at all"))
    ledger.fault("camera_model", CalibrationError("/drive/a file: is odd"))
    ledger.fault("broken", line(3))
    assert (ledger.faults[-1].code, ledger.faults[-1].vital) == ("broken", False)
    assert [(fault.path, fault.problem) for fault in ledger.faults] == [
        ("data.jsonl: line 3: frames[].imuToCamera", "is skewed: 0.5"),
        ("", "no camera model at all"),
        ("", "a file: is odd"),
        ("data.jsonl: line 3", "3 is odd"),
    ]
