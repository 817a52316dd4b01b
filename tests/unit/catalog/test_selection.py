"""Ready filters against what is known of the drives."""

import json

import numpy as np
import pytest
from pymap3d import enu2geodetic
from pymap3d.vincenty import vdist

from sceneloom.batch.jobs import find_inputs
from sceneloom.catalog import Selection, format_csv, iter_list, query, records
from sceneloom.errors import OptionError


def spans(catalogue, drive, **wanted):
    result = query(catalogue, Selection(**wanted))
    return [(row[1], row[2]) for row in result.rows if row[0] == str(drive)]


@pytest.mark.parametrize(
    ("wanted", "expected"),
    [
        ({"labels": ("PEDESTRIAN*",)}, [(2.0, 3.1)]),
        ({"labels": ("car",), "start": 8.0}, [(8.0, 10.0)]),
        ({"labels": ("car",), "stop": "1970-01-01T00:00:01"}, [(0.0, 1.0)]),
        ({"count": 2}, [(2.0, 3.1)]),
        ({"count": 3}, []),
        ({"labels": ("nothing",)}, []),
        ({"types": ("box_2d",)}, []),
        ({"speed": (0.0, 6.0)}, [(0.0, 4.9)]),  # of half a second, no more than 0.05 s at 15 m/s
        ({"attributes": (("Weather", "rain"),)}, [(4.0, 10.0)]),
        ({"attributes": (("weather", "dry"),), "labels": ("car",)}, [(0.0, 4.0)]),
        ({"attributes": (("colour", "red"),), "count": 1}, [(0.0, 10.0)]),
        ({"attributes": (("colour", "red"),), "labels": ("ped*",)}, []),
        ({"findings": ("no-such-rule",)}, []),
        ({"distance": (0.0, 15.0), "labels": ("car",)}, [(6.0, 7.5)]),  # 11.2 m east or west of it
        ({}, [(0.0, 10.0)]),
    ],
    ids=str,
)
def test_spans_are_those_in_which_all_holds(catalogue, drives, wanted, expected):
    found = spans(catalogue, drives[0], **wanted)
    assert np.array(found).reshape(-1) == pytest.approx(np.array(expected).reshape(-1))


def test_locations_are_found_by_metres_on_the_ellipsoid_also_across_the_date_line(catalogue, drives):
    for drive, origin in ((drives[0], (48.0, 11.0)), (drives[1], (-33.9, 179.9999))):
        found = spans(catalogue, drive, near=(*origin, 40.0))
        t = np.arange(100) / 10
        east = np.where(t < 5, 5 * t, 25 + 15 * (t - 5))
        latitude, longitude, _ = enu2geodetic(east, 0 * t, 0 * t, *origin, 0)
        away = np.array([vdist(*origin, *p)[0] for p in zip(latitude, longitude, strict=True)])
        assert found == [(0.0, pytest.approx(t[away <= 40.0][-1] + 0.1))]


def test_findings_choose_drives(catalogue, drives):
    rules = query(catalogue, "SELECT DISTINCT rule, path FROM findings JOIN scenes USING (scene)").rows
    assert rules, "the drives state less than the rules want"
    rule = rules[0][0]
    chosen = query(catalogue, Selection(findings=(rule,)), show="drives")
    assert [row[0] for row in chosen.rows] == sorted(path for name, path in rules if name == rule)


def test_rows_are_the_boxes_themselves(catalogue, drives):
    result = query(catalogue, Selection(labels=("ped*",)), show="rows")
    mine = [row for row in records(result) if row["path"] == str(drives[0])]
    assert len(mine) == 11
    assert mine[0]["left_px"] is None
    assert format_csv(result).count("\n") == len(result.rows) + 1


def test_a_gap_joins_spans_and_a_margin_widens_them(catalogue, drives):
    wanted = Selection(labels=("car",), distance=(10.2, 15.0))
    both = [row[1:3] for row in query(catalogue, wanted, gap=0.2).rows if row[0] == str(drives[0])]
    assert len(both) == 2
    one = [row[1:3] for row in query(catalogue, wanted, gap=2.0, margin=0.5).rows if row[0] == str(drives[0])]
    assert one == [pytest.approx((both[0][0] - 0.5, both[1][1] + 0.5))]


def test_lists_are_what_a_batch_takes(catalogue, drives, tmp_path):
    lines = list(iter_list(query(catalogue, Selection(labels=("ped*",)))))
    (tmp_path / "found.jsonl").write_text("\n".join(lines))
    inputs = find_inputs((), (tmp_path / "found.jsonl",))
    assert [drive.location for drive in inputs] == list(map(str, drives[:2]))
    assert inputs[0].options == {"start": 2.0, "stop": json.loads(lines[0])["stop"]}
    with pytest.raises(OptionError, match="needs the column `path`"):
        list(iter_list(query(catalogue, "SELECT 1 AS start")))


@pytest.mark.parametrize(
    "wanted",
    [
        lambda: Selection(speed=(5.0, 1.0)),
        lambda: Selection(near=(91.0, 0.0, 1.0)),
        lambda: Selection(distance=(float("nan"), 1.0)),
    ],
)
def test_bounds_that_cannot_be_are_refused(wanted):
    with pytest.raises(OptionError):
        wanted()


def test_times_that_are_none_are_refused(catalogue):
    with pytest.raises(OptionError, match="'noon'"):
        query(catalogue, Selection(start="noon"))
    with pytest.raises(OptionError, match="rows"):
        query(catalogue, Selection(), show="all")
