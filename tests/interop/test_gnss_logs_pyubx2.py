"""Logs of UBX that pyubx2 writes, with any values in any mixture, where it is installed."""

import numpy as np
import pytest

from sceneloom.formats import open_scene

pyubx2 = pytest.importorskip("pyubx2")
GPS_START = np.datetime64("1980-01-06", "ms")


@pytest.mark.parametrize("seed", range(5))
def test_positions_and_deviations_are_those_that_pyubx2_was_given(seed, tmp_path):
    chance = np.random.default_rng(seed)
    start = np.datetime64("2012-06-30T23:59:40", "ms") + int(chance.integers(0, 10**12))
    content, expected = b"", []
    for k in range(40):
        # UTC of whole milliseconds, and the same as a receiver counts it, by the leap seconds of the day
        utc = start + 100 * k
        leap = 15 + sum(utc >= np.datetime64(day) for day in ("2012-07-01", "2015-07-01", "2017-01-01"))
        tow = int((utc - GPS_START).astype(int) + 1000 * leap) % 604_800_000
        latitude, longitude = chance.uniform(-90, 90), chance.uniform(-180, 180)
        height, across, up = (int(value) for value in chance.integers(-400_000, 9_000_000, 3) * [1, 0, 0] + [0, 25, 40])
        position = {"lat": latitude, "lon": longitude, "height": height, "hAcc": across, "vAcc": up}
        kind = ("NAV-PVT", "NAV-POSLLH")[k % 2]
        date = utc.astype("datetime64[s]").item()
        fields = {"iTOW": tow, **position}
        if kind == "NAV-PVT":
            nano = int((utc - utc.astype("datetime64[s]")).astype(int)) * 10**6
            fields |= {"year": date.year, "month": date.month, "day": date.day, "hour": date.hour, "min": date.minute}
            fields |= {"second": date.second, "nano": nano, "validDate": 1, "validTime": 1, "fixType": 3}
            fields["gnssFixOk"] = 1
        content += pyubx2.UBXMessage("NAV", kind, pyubx2.GET, **fields).serialize()
        content += chance.bytes(int(chance.integers(0, 9)))
        expected.append((int(utc.astype("datetime64[ns]").astype(int)), latitude, longitude, height * 1e-3))
    path = tmp_path / "a.ubx"
    path.write_bytes(content)
    gnss = open_scene(path, format="ubx").sensors[0]
    assert gnss.timestamps_ns.tolist() == [row[0] for row in expected]
    np.testing.assert_allclose(gnss.positions_lla, [row[1:] for row in expected], atol=1.01e-7)
    np.testing.assert_allclose(gnss.accuracies, 0.025 / 2**0.5)
    np.testing.assert_allclose(gnss.vertical_accuracies, 0.04)
