"""What stands in the tables."""

from dataclasses import replace

import numpy as np
import pytest

import sceneloom
from sceneloom.catalog import TABLES, Selection, build, query
from sceneloom.catalog.rows import Ego, box_rows, distances, track_rows
from sceneloom.scene import Poses

from .conftest import box, street, times_ns


def rows_of(catalogue, sql):
    return query(catalogue, sql).rows


def test_a_box_stands_at_every_moment_between_its_timestamps(catalogue, drives):
    rows = rows_of(
        catalogue,
        "SELECT seconds, x, y, speed, a.annotation FROM annotations a JOIN scenes USING (scene) "
        f"WHERE path = '{drives[0]}' AND label LIKE 'ped%' ORDER BY seconds",
    )
    assert [row[0] for row in rows] == pytest.approx(np.arange(2.0, 3.05, 0.1))
    assert [row[2] for row in rows] == pytest.approx(5 + 2 * np.arange(0, 1.05, 0.1))
    assert [row[3] for row in rows] == pytest.approx([2.0] * 11)
    assert {row[4] for row in rows} == {"7"}


def test_distances_are_those_from_the_ego_at_that_moment(catalogue, drives):
    rows = rows_of(
        catalogue,
        "SELECT seconds, distance, ego_speed FROM annotations a JOIN scenes USING (scene) "
        f"WHERE path = '{drives[0]}' AND label = 'Car' ORDER BY seconds",
    )
    t = np.array([row[0] for row in rows])
    east = np.where(t < 5, 5 * t, 25 + 15 * (t - 5))
    assert len(t) == 100
    assert [row[1] for row in rows] == pytest.approx(np.hypot(50 - east, 10))
    steady = np.abs(t - 5) > 0.3  # a speed is that over half a second
    assert np.array([row[2] for row in rows])[steady] == pytest.approx(np.where(t < 5, 5, 15)[steady])


def test_a_track_reports_its_span_trajectory_and_least_distance(catalogue):
    sql = "SELECT start, stop, metres, nearest, boxes FROM tracks WHERE annotation = '7' LIMIT 1"
    ((start, stop, metres, nearest, boxes),) = rows_of(catalogue, sql)
    assert (start, stop, metres, boxes) == pytest.approx((2.0, 3.0, 2.0, 11))
    t = np.arange(2.0, 3.05, 0.1)
    assert nearest == pytest.approx(np.hypot(20 - 5 * t, 5 + 2 * (t - 2)).min())


def test_the_least_distance_is_that_of_the_moments_at_which_the_ego_is_known():
    scene = street()
    ego = scene.sensor("ego")
    rows = slice(0, 30)
    path = Poses(ego.poses.timestamps_ns[rows], ego.poses.positions[rows], ego.poses.quaternions_xyzw[rows])
    part = replace(scene, sensors=(replace(ego, poses=path),))
    boxes = box_rows(part, times_ns(100))
    nearest = track_rows(part, boxes, distances(part, Ego.of(part), boxes), 0)["nearest"]
    assert nearest == pytest.approx([np.hypot(50 - 5 * 2.9, 10), np.hypot(20 - 5 * 2.9, 7 - 0.2)], abs=0.5)


def test_frames_report_where_on_earth_the_ego_was(catalogue, drives):
    sql = (
        "SELECT f.latitude, f.longitude FROM frames f JOIN scenes s USING (scene) WHERE reference AND "
        f"path = '{drives[0]}' ORDER BY frame"
    )
    found = np.array(rows_of(catalogue, sql))
    assert found == pytest.approx(street().sensors[0].positions_lla[:, :2], abs=1e-9)


def test_fixes_without_reception_or_height_are_reported_as_far_as_they_are_locations():
    whole = street()
    lla = whole.sensor("gnss").positions_lla.copy()
    lla[:, 2] = np.nan
    lla[50] = 0.0
    ego = Ego.of(replace(whole, sensors=(replace(whole.sensor("gnss"), positions_lla=lla),)))
    found = ego.positions_lla(times_ns(100))
    assert found[:, :2] == pytest.approx(whole.sensor("gnss").positions_lla[:, :2], abs=1e-5)
    assert ego.speeds(times_ns(100)).max() < 20.0


@pytest.mark.parametrize(
    ("ours", "known"),
    [
        ({}, True),
        ({"world_from_file": np.eye(4).tolist()}, False),
        ({"enu_origin": {"latitude": 10**400, "longitude": 11.0, "altitude": 0.0}}, False),
    ],
)
def test_a_location_of_the_world_counts_where_it_is_one_and_the_world_was_not_moved(ours, known):
    origin = dict(zip(("latitude", "longitude", "altitude"), (48.0, 11.0, 500.0), strict=True))
    scene = replace(street(), sensors=street().sensors[1:], metadata={"sceneloom": {"enu_origin": origin, **ours}})
    assert np.isfinite(Ego.of(scene).positions_lla(times_ns(3))).all() == known


def test_every_table_has_its_columns_and_the_scene(catalogue):
    for table, columns in TABLES.items():
        result = query(catalogue, f"SELECT * FROM {table} LIMIT 0")
        assert result.columns == ("scene", *(column.name for column in columns))


def test_the_scene_row_counts_what_is_there(catalogue, drives):
    sql = f"SELECT duration, period, metres, tracks, boxes, frames FROM scenes WHERE path = '{drives[0]}'"
    assert rows_of(catalogue, sql)[0] == pytest.approx((9.9, 0.1, 25 + 15 * 4.9, 2, 111, 200))


def test_the_page_about_catalogues_names_every_column(request):
    page = (request.config.rootpath / "docs" / "catalogue.md").read_text("utf-8")
    for table, columns in TABLES.items():
        reported = "; ".join(f"`{column.name}` {column.words}" for column in columns)
        assert f"| `{table}` | {reported} |" in page


@pytest.mark.parametrize("reader", ["pyarrow", "polars"])
def test_other_readers_find_the_same_rows_and_scenes(catalogue, reader):
    folder = str(catalogue / "annotations")
    if reader == "pyarrow":
        from pyarrow import dataset

        table = dataset.dataset(folder, partitioning="hive").to_table()
        found = (table.num_rows, len(set(table["scene"].to_pylist())))
    else:
        polars = pytest.importorskip("polars")
        frame = polars.scan_parquet(folder, hive_partitioning=True, glob=False).collect()
        found = (frame.height, frame["scene"].n_unique())
    assert found == rows_of(catalogue, "SELECT count(*), count(DISTINCT scene) FROM annotations")[0]


def test_the_moments_of_a_drive_without_frames_are_the_timestamps_of_its_boxes(tmp_path):
    stands = replace(box("stands", "car", [0.0], [[1, 2, 0]]), stationary=True)
    boxes = (stands, box("goes", "car", [1.0, 2.0, 4.0], [[0, 0, 0], [2, 0, 0], [6, 0, 0]]))
    sceneloom.write(replace(street(annotations=boxes), sensors=()), tmp_path / "boxes.sfs")
    build([tmp_path / "boxes.sfs"], tmp_path / "catalogue")
    rows = rows_of(tmp_path / "catalogue", "SELECT annotation, x FROM annotations ORDER BY timestamp_ns, track")
    assert rows[:1] == [("stands", 1.0)]
    assert rows[1:] == [(name, x) for goes in (0.0, 2.0, 6.0) for name, x in (("stands", 1.0), ("goes", goes))]
    assert query(tmp_path / "catalogue", Selection(labels=("car",), count=2), gap=5.0).rows[0][3:] == (3, 2)
