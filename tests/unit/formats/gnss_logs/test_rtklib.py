"""Positions of RTKLIB: published lines, and the same in its other coordinates, as pymap3d computes them."""

import numpy as np
import pytest

from sceneloom.errors import DataError
from sceneloom.formats.base.registry import find_format, open_scene

# a published result of RTKPOST 2.4.2 (station BUTE, Budapest)
HEAD = "% program   : RTKPOST ver.2.4.2\n%\n% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,5:single,6:ppp)\n"
NAMES = "latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)  sdeu(m)  sdun(m)"
DMS = NAMES.replace("(deg)", "(d'\")")
DEVIATIONS = "4.9465   2.9464   8.0844   2.3532   3.9166   4.0832   0.00    0.0"
LINE = f"47.480948244   19.056512467   177.0515   5   5   {DEVIATIONS}"
LLA = f"{HEAD}%  GPST   {NAMES}\n2016/01/06 00:00:00.000   {LINE}\n2016/01/06 00:00:30.000   {LINE}\n"

OTHERS = {
    "week and seconds": f"%  GPST   {NAMES}\n1878 259200.000   {LINE}\n",
    "degrees, minutes, seconds": f"%  GPST   {DMS}\n2016/01/06 00:00:00.000 "
    f"47 28 51.4136784   19 03 23.4448812   177.0515   5   5   {DEVIATIONS}\n",
    # east, north, up from the base turned by pymap3d 3.2.0, variances with its rotation
    "UTC, earth-centred, commas": "%  UTC,x-ecef(m),y-ecef(m),z-ecef(m),Q,ns,sdx(m),sdy(m),sdz(m),sdxy(m)\n"
    "2016/01/05,23:59:43.000,4081880.0521,1410008.9601,4678196.9597,5,5,4.5554,3.8032,7.9556,3.2334,4.5170,3.6022,0,0\n",
    "JST, baseline": "% ref pos   :  47.000000000   19.000000000   100.0000\n"
    "%  JST  e-baseline(m)  n-baseline(m)  u-baseline(m)   Q  ns   sde(m)   sdn(m)   sdu(m)\n"
    "2016/01/06 08:59:43.000 4259.5083 53472.0707 -148.8049 5 5 2.9464 4.9465 8.0844 2.3532 4.0832 3.9166 0.00 0.0\n",
    "without names": f"2016/01/06 00:00:00.000   {LINE}\n",
}


def write_log(folder, text=LLA):
    path = folder / "drive.pos"
    path.write_text(text)
    return path


def opened(folder, text=LLA, **options):
    path = write_log(folder, text)
    assert find_format(path).name == "rtklib"
    scene = open_scene(path, **options)
    return scene, {warning.code: warning for warning in scene.warnings}


@pytest.mark.parametrize("text", [LLA, *OTHERS.values()], ids=["degrees", *OTHERS])
def test_all_coordinates_and_times_of_a_position_are_the_same_position(text, tmp_path):
    scene, warnings = opened(tmp_path, text)
    gnss = scene.sensors[0]
    # 17 leap seconds in January 2016
    assert gnss.timestamps_ns[0] == np.datetime64("2016-01-05T23:59:43", "ns").astype(np.int64)
    np.testing.assert_allclose(gnss.positions_lla[0, :2], [47.480948244, 19.056512467], atol=2e-9)
    assert gnss.positions_lla[0, 2] == pytest.approx(177.0515, abs=1e-4)
    # of what is written with four digits
    assert gnss.accuracies[0] == pytest.approx(((4.9465**2 + 2.9464**2) / 2) ** 0.5, abs=1e-4)
    assert gnss.vertical_accuracies[0] == pytest.approx(8.0844, abs=1e-4)
    assert "single" in warnings["pos-not-used"].message


def test_signs_of_covariances_count(tmp_path):
    text = OTHERS["UTC, earth-centred, commas"].replace("3.2334,4.5170,3.6022", "-3.2334,-4.5170,-3.6022")
    scene, _ = opened(tmp_path, text)
    across, up = scene.sensors[0].accuracies[0], scene.sensors[0].vertical_accuracies[0]
    # the trace stays: twice the horizontal variance and the vertical one
    assert 2 * across**2 + up**2 == pytest.approx(4.5554**2 + 3.8032**2 + 7.9556**2)
    place = np.array([4081880.0521, 1410008.9601, 4678196.9597 / (1 - 1 / 298.257223563) ** 2])  # along the normal
    x, y, z = place / np.linalg.norm(place)
    variance = 4.5554**2 * x * x + 3.8032**2 * y * y + 7.9556**2 * z * z
    variance -= 2 * (3.2334**2 * x * y + 4.5170**2 * y * z + 3.6022**2 * z * x)
    assert up == pytest.approx(variance**0.5, abs=1e-3)


def test_a_baseline_without_its_base_is_a_trajectory_and_heights_above_the_geoid_are_warned_of(tmp_path):
    scene, warnings = opened(tmp_path, OTHERS["JST, baseline"].split("\n", 1)[1])
    assert (scene.sensors, "pos-without-base" in warnings) == ((), True)
    assert scene.trajectories["baseline"].positions[0].tolist() == [4259.5083, 53472.0707, -148.8049]
    _, warnings = opened(tmp_path, LLA.replace("ellipsoidal", "geodetic").replace("WGS84", "Tokyo"))
    assert {"pos-height", "pos-datum"} <= set(warnings)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("2016/01/06 00:00:40.000 95.0 19.0 177.0 5 5", r"line 7.*coordinates \[95.0, 19.0, 177.0\]"),
        ("2016/13/06 00:00:40.000 47.0 19.0 177.0 5 5", "line 7: '2016/13/06"),
        ("9016/01/06 00:00:40.000 47.0 19.0 177.0 5 5", "time '9016/01/06 00:00:40.000'"),
        ("2016/01/06 25:00:40.000 47.0 19.0 177.0 5 5", "time '2016/01/06 25:00:40.000'"),
        ("2016/01/06 00:00:40.000 47.0 nan 177.0 5 5", "coordinates"),
        ("2016/01/06 00:00:40.000 47.0", "expected a time, three coordinates"),
    ],
)
def test_wrong_lines_are_faults_with_their_number_and_left_out_where_lenient(line, expected, tmp_path):
    with pytest.raises(DataError, match=expected):
        opened(tmp_path, f"{LLA}{line}\n")
    scene, warnings = opened(tmp_path, f"{LLA}{line}\n", lenient=True)
    assert (len(scene.sensors[0].timestamps_ns), warnings["pos-line"].count) == (2, 1)
    with pytest.raises(DataError, match="no line of a position"):
        opened(tmp_path, LLA[: LLA.index("2016")])
