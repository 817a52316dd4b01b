"""Folders of public driving data, as their authors publish them, against the numbers that come with them."""

import numpy as np
import pytest

import sceneloom
from sceneloom.visibility import count_points

ARGOVERSE = "real/argoverse2"


def test_points_in_the_cuboids_of_an_argoverse_log_are_as_many_as_it_says(data_dir):
    pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    scene = sceneloom.open(data_dir / ARGOVERSE)
    found = count_points(scene).lidars
    assert [lidar.id for lidar in scene.lidars] == ["up_lidar", "down_lidar"]
    away = []
    for column, cuboid in enumerate(scene.annotations):
        for k, stamp in enumerate(scene.lidars[0].frames.timestamps_ns):
            row = np.flatnonzero(cuboid.path.timestamps_ns == stamp)
            if len(row):
                counted = sum(int(lidar.counts[k, column]) for lidar in found)
                away.append(abs(counted - cuboid.attributes[0].values[int(row[0])]))
    assert len(away) > 100
    assert max(away) <= 2  # points on a face, which float32 coordinates put on one side or the other


def test_the_lasers_of_an_argoverse_lidar_keep_their_elevation_seen_from_it(data_dir):
    pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    scene = sceneloom.open(data_dir / ARGOVERSE)
    up, down = scene.lidars

    def spread(lidar, mount):
        points = lidar.frames[0].points
        seen = mount.inverse().apply(points.positions)
        distances = np.linalg.norm(seen, axis=1)
        elevations = np.degrees(np.arcsin(seen[:, 2] / distances))
        rows = [(points.rings == ring) & (distances > 15) for ring in np.unique(points.rings)]
        return np.median([np.ptp(np.percentile(elevations[row], [10, 90])) for row in rows if row.sum() > 30])

    assert spread(up, up.mount) < 0.6 * spread(up, down.mount)
    assert spread(down, down.mount) < 0.6 * spread(down, up.mount)
