"""Logs of NMEA 0183: sentences as receivers send them, and what is wrong with some."""

from functools import reduce
from operator import xor

import numpy as np
import pytest

from sceneloom.errors import DataError
from sceneloom.formats.base.registry import find_format, open_scene
from sceneloom.geometry.rigid import rotate_vectors

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
    unused, other = warnings["messages-not-used"], warnings["bytes-of-no-message"]
    assert (unused.count, "GNVTG (1)" in unused.message, other.count) == (1, True, len("noise"))
    assert warnings["nmea-accuracy"].count == 1


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
    gnss, warnings = opened(tmp_path, wrong, *lines[1:])
    assert (gnss.timestamps_ns[0], warnings["messages-broken"].count) == (seconds_of(days[0]), 1)


def test_a_log_of_rmc_has_no_heights_and_what_is_no_fix_is_left_out(tmp_path):
    gnss, _ = opened(tmp_path, rmc("000001", "010120"), rmc("000002", "010120", status="V"), rmc("000003", "010120"))
    assert len(gnss.timestamps_ns) == 2
    assert np.isnan(gnss.positions_lla[:, 2]).all()
    none = sentence("GNGGA,000001,,,,,0,00,99.9,,,,,,")
    gnss, warnings = opened(tmp_path, none, gga("000002", undulation=""), gga("000003", quality=6))
    assert (len(gnss.timestamps_ns), warnings["no-reception"].count, warnings["nmea-height"].count) == (2, 1, 1)
    assert np.isnan(gnss.accuracies[1])  # by dead reckoning
    with pytest.raises(DataError, match=r"no GGA, GNS, .* has a position \(1 without\)"):
        opened(tmp_path, none)


def test_sentences_that_are_cut_or_have_wrong_checksums_are_counted_and_never_used(tmp_path):
    gnss, warnings = opened(
        tmp_path, KNOWN, KNOWN.replace("545.4", "545.5"), gga("123521")[:-9] + KNOWN, gga("123522")[:-3]
    )
    assert gnss.positions_lla[:, 2].tolist() == pytest.approx([592.3])
    assert "messages-broken" in warnings
    broken = [w for w in open_scene(tmp_path / "drive.nmea").warnings if w.code == "messages-broken"]
    assert [(w.message, w.count) for w in broken] == [
        ("sentences with wrong checksums", 1),
        ("sentences cut, or without a checksum", 2),
    ]
    assert "line 2" in broken[0].location
    # a log in which no sentence has a checksum is another thing
    gnss, warnings = opened(tmp_path, *(gga(time).split("*")[0] for time in ("000001", "000002")))
    assert (len(gnss.timestamps_ns), warnings["nmea-unsigned"].count) == (2, 2)


def test_gns_pubx_and_gll_are_positions_and_gsa_has_the_vertical_dilution(tmp_path):
    position = "4807.038,N,01131.000,E"
    gsa = sentence("GNGSA,A,3,01,02,,,,,,,,,,,1.5,0.9,1.2,1")
    gnss, _ = opened(tmp_path, sentence(f"GNGNS,000001,{position},RNA,12,0.9,545.4,46.9,,,V"), gsa)
    # ambiguities are fixed: 0.05 m by HDOP over the root of 2, and by VDOP
    assert gnss.accuracies == pytest.approx([0.05 * 0.9 / 2**0.5])
    assert gnss.vertical_accuracies == pytest.approx([0.05 * 1.2])
    pubx = f"PUBX,00,000001.00,{position},592.3,G3,2.1,2.0,0.007,77.52,0.007,,0.92,1.19,0.77,9,0,0"
    gnss, _ = opened(tmp_path, sentence(pubx), sentence("PUBX,04,000001.00,010120,259218,2086,18,0,0,0"))
    assert gnss.positions_lla[0] == pytest.approx([48 + 7.038 / 60, 11 + 31 / 60, 592.3])
    assert (gnss.accuracies[0], gnss.vertical_accuracies[0]) == pytest.approx((2.1 / 2**0.5, 2.0))
    assert gnss.timestamps_ns[0] == seconds_of("2020-01-01T00:00:01")
    zda = sentence("GPZDA,000001.00,01,01,2020,00,00")
    gnss, warnings = opened(tmp_path, sentence(f"GPGLL,{position},000001.00,A,A"), zda)
    assert (gnss.timestamps_ns[0], "nmea-date" in warnings) == (seconds_of("2020-01-01T00:00:01"), False)


def test_days_without_fixes_between_are_days_of_the_dates(tmp_path):
    gnss, _ = opened(tmp_path, rmc("120000", "010120"), gga("120000"), rmc("120000", "040120"), gga("120000"))
    assert np.diff(gnss.timestamps_ns).tolist() == [3 * 86_400 * 10**9]


def test_attitudes_become_poses_of_the_fixes_and_headings_alone_level_ones(tmp_path):
    def pashr(time):
        return sentence(f"PASHR,{time},090.00,T,+00.00,+30.00,+00.00,0.01,0.01,0.02,1,1")

    lines = [line for k in range(3) for line in (rmc(f"00000{k}", "010120"), gga(f"00000{k}"), pashr(f"00000{k}"))]
    with open_scene(write_log(tmp_path, *lines)) as scene:
        poses = scene.trajectories["receiver"].poses
        forward, left = rotate_vectors(poses.quaternions_xyzw[0], np.eye(3)[:2])
        # to the east and 30° up; the left is north
        np.testing.assert_allclose(forward, [np.cos(np.pi / 6), 0, 0.5], atol=1e-12)
        np.testing.assert_allclose(left, [0, 1, 0], atol=1e-12)
    hdt = sentence("GPHDT,180.0,T")
    lines = [line for k in range(2) for line in (rmc(f"00000{k}", "010120"), gga(f"00000{k}"), hdt)]
    with open_scene(write_log(tmp_path, *lines)) as scene:
        quaternions = scene.trajectories["receiver"].quaternions_xyzw
        np.testing.assert_allclose(rotate_vectors(quaternions[0], np.eye(3)[0]), [0, -1, 0], atol=1e-12)
        assert "attitude-level" in {warning.code for warning in scene.warnings}


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (sentence("GPGGA,123519,4807.038,N"), r"line 2.*GPGGA,123519.*expected at least 14 fields"),
        (sentence("GPHDT,999.0,T"), "HDT: '999.0'; expected a heading within 360 degrees"),
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
