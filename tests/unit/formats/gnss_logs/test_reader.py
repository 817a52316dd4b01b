"""Logs of NMEA 0183: sentences as receivers send them, and what is wrong with some."""

from functools import reduce
from operator import xor

import numpy as np
import pytest

from sceneloom.errors import DataError
from sceneloom.formats.base.registry import find_format, open_scene

# an example of the standard's tutorials, with its checksum
KNOWN = "$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47"


def sentence(body):
    return f"${body}*{reduce(xor, body.encode(), 0):02X}"


def gga(time, *, minutes="07.038", quality=1, height="545.4", undulation="46.9"):
    return sentence(f"GNGGA,{time},48{minutes},N,01131.000,E,{quality},08,0.9,{height},M,{undulation},M,,")


def rmc(time, date, *, status="A"):
    return sentence(f"GNRMC,{time},{status},4807.038,N,01131.000,E,022.4,084.4,{date},003.1,W")


def write_log(folder, *lines):
    path = folder / "drive.nmea"
    path.write_bytes("\r\n".join(lines or (rmc("235958", "311219"), gga("235958"), gga("000001"))).encode() + b"\r\n")
    return path


def opened(tmp_path, *lines, **options):
    path = write_log(tmp_path, *lines)
    assert find_format(path).name == "nmea"
    scene = open_scene(path, **options)
    return scene.sensors[0], {warning.code: warning for warning in scene.warnings}


def seconds_of(text):
    return int(np.datetime64(text, "ns").astype(np.int64))


def test_degrees_and_minutes_heights_and_accuracies_are_read_and_other_sentences_counted(tmp_path):
    gnss, warnings = opened(
        tmp_path, sentence("GNVTG,84.4,T,,M,22.4,N,41.5,K"), "noise", KNOWN, rmc("123519", "230394"),
        sentence("GNGST,123520.5,1.2,,,,0.6,0.8,1.5"), gga("123520.5"),
    )  # fmt: skip
    # 48° 7.038' and 11° 31', 545.4 m above the geoid, which lies 46.9 m above the ellipsoid
    assert gnss.positions_lla[0] == pytest.approx([48 + 7.038 / 60, 11 + 31 / 60, 592.3])
    times = ["1994-03-23T12:35:19", "1994-03-23T12:35:20.5"]
    assert gnss.timestamps_ns.tolist() == [seconds_of(text) for text in times]
    # an error of ranges of 2 m, in one direction; then as stated, √((0.6² + 0.8²) / 2)
    assert gnss.accuracies == pytest.approx([2.0 * 0.9 / 2**0.5, 0.5**0.5])
    assert gnss.vertical_accuracies == pytest.approx([np.nan, 1.5], nan_ok=True)
    unused = warnings["nmea-sentences-not-used"]
    assert (unused.count, "GNVTG (1)" in unused.message, warnings["nmea-accuracy"].count) == (2, True, 1)


def test_days_go_on_at_midnight_and_without_a_date_begin_in_1970(tmp_path):
    lines = [rmc("235958", "311219"), *map(gga, ("235958", "235959.75", "000001", "120000"))]
    gnss, _ = opened(tmp_path, *lines)
    days = ["2019-12-31T23:59:58", "2019-12-31T23:59:59.75", "2020-01-01T00:00:01", "2020-01-01T12:00"]
    assert gnss.timestamps_ns.tolist() == [seconds_of(text) for text in days]
    # the date is that of its own time, also where it comes after midnight
    gnss, _ = opened(tmp_path, gga("235958"), gga("000001"), rmc("000001", "010120"))
    assert gnss.timestamps_ns.tolist() == [seconds_of(days[0]), seconds_of(days[2])]
    gnss, warnings = opened(tmp_path, *lines[1:])
    assert gnss.timestamps_ns[0] == (24 * 3600 - 2) * 10**9
    assert "1970" in warnings["nmea-date"].message
    wrong = rmc("235958", "311219")[:-2] + "00"
    gnss, warnings = opened(tmp_path, wrong, *lines[1:], lenient=True)
    assert (gnss.timestamps_ns[0], "nmea-sentence" in warnings) == (seconds_of(days[0]), True)


def test_a_log_of_rmc_has_no_heights_and_what_is_no_fix_is_left_out(tmp_path):
    gnss, _ = opened(tmp_path, rmc("000001", "010120"), rmc("000002", "010120", status="V"), rmc("000003", "010120"))
    assert len(gnss.timestamps_ns) == 2
    assert np.isnan(gnss.positions_lla[:, 2]).all()
    none = sentence("GNGGA,000001,,,,,0,00,99.9,,,,,,")
    gnss, warnings = opened(tmp_path, none, gga("000002", undulation=""), gga("000003", quality=6))
    assert (len(gnss.timestamps_ns), warnings["nmea-without-position"].count, warnings["nmea-height"].count) == (
        2,
        1,
        1,
    )
    assert np.isnan(gnss.accuracies[1])  # by dead reckoning
    with pytest.raises(DataError, match="no GGA or RMC sentence has a position"):
        opened(tmp_path, none)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (KNOWN.replace("*47", "*48"), r"line 2.*\$GPGGA,123519.*expected the checksum \*47"),
        (KNOWN.removesuffix("*47"), "expected the checksum"),
        (sentence("GPGGA,123519,4807.038,N"), "expected at least 14 fields"),
        (gga("126019"), "time '126019'; expected hhmmss.ss"),
        (gga("000001", minutes="67.038"), r"'4867\.038', 'N'; expected degrees and minutes"),
        (gga("000001", height="high"), "high"),
        (gga("000001", quality="x"), "line 2: GGA"),
        (rmc("000001", "321320"), "line 2: RMC"),
    ],
)
def test_broken_sentences_are_faults_with_line_and_value_and_counted_where_lenient(line, expected, tmp_path):
    with pytest.raises(DataError, match=expected):
        opened(tmp_path, KNOWN, line)
    gnss, warnings = opened(tmp_path, KNOWN, line, KNOWN, lenient=True)
    assert (len(gnss.timestamps_ns), warnings["nmea-sentence"].count) == (1, 1)
