"""The boxes of one moment in the world, each once."""

from dataclasses import replace

import numpy as np
import pytest

from sceneloom.geometry.rigid import RigidTransform
from sceneloom.tracking.tracker import UNKNOWN_VARIANCE, visibility

ROTATION = RigidTransform(
    np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([5.0, 6.0, 7.0])
)


def stationary(street, actor, **options):
    return street([actor(lambda t: (10.0, 2.0, 0.2), **options)], sigma=0.0).observe([0.0])[0]


def test_locations_headings_and_covariances_are_those_of_the_world(street, actor):
    seen = stationary(street, actor)
    fused = replace(seen.fused["front"], center_covariances=np.diag([0.01, 0.04, 0.09])[None])
    there = visibility(replace(seen, fused={"front": fused}, world_from_lidar=ROTATION))
    assert there.measures[0, :2] == pytest.approx([5.0 - 2.0, 6.0 + 10.0])
    assert there.measures[0, 6] == pytest.approx(0.2 + np.pi / 2)
    assert np.diag(there.covariances[0])[:3] == pytest.approx([0.04, 0.01, 0.09])


def test_a_box_of_the_image_alone_reports_no_heading_and_little_of_its_distance(street, actor):
    there = visibility(stationary(street, actor, only_in_image=(0.0, 1.0)))
    assert not there.measured[0]
    assert there.covariances[0, 6, 6] == UNKNOWN_VARIANCE
    ray = there.measures[0, :3] / np.linalg.norm(there.measures[0, :3])
    along = ray @ there.covariances[0, :3, :3] @ ray
    across = np.linalg.eigvalsh(there.covariances[0, :3, :3])[0]
    assert along == pytest.approx(9.0 * across)


def test_of_two_cameras_the_one_with_a_partner_counts_else_the_doubtful_one(street, actor):
    fused = stationary(street, actor).fused["front"]
    alone = replace(fused, rows_2d=np.array([-1]))
    sure, doubtful = (replace(alone, scores=np.array([score])) for score in (0.8, 0.3))
    seen = stationary(street, actor)
    for by_camera, odds in (
        ({"a": doubtful, "b": replace(fused, scores=np.array([0.6]))}, 0.6),
        ({"a": sure, "b": doubtful}, 0.3),
    ):
        there = visibility(replace(seen, fused=by_camera))
        assert len(there) == 1
        assert there.log_odds[0] == pytest.approx(np.log(odds / (1.0 - odds)))


def test_yaw_variances_of_the_fusion_count_where_they_are_some(street, actor):
    seen = stationary(street, actor)
    for stated, expected in ((np.array([0.04]), 0.04), (np.array([np.nan]), 0.01), (None, 0.01)):
        fused = replace(seen.fused["front"], yaw_variances=stated)
        assert visibility(replace(seen, fused={"front": fused})).covariances[0, 6, 6] == pytest.approx(
            expected
        )
