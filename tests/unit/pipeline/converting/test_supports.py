"""What a report says of each field: the format's own word, and what the writing reported this scene."""

import pytest

from sceneloom.formats.base.losses import (
    KEPT,
    Loss,
    Support,
    approximated,
    converted,
    dropped,
    holding_of,
    unknown_names,
)
from sceneloom.pipeline.converting import field_supports, fields_meant, lost
from sceneloom.scene.contents import MODEL_FIELDS

HOLDS = {
    "": KEPT,
    "sensors": dropped("no sensors"),
    "sensors.lidar": KEPT,
    "sensors.lidar.frames.points": converted("as 32 bits"),
    "sensors.lidar.frames.points.colors": approximated("three bits each"),
}
KINDS = {
    "sensors[top]": "sensors.lidar",
    "sensors[a.b]": "sensors.camera",
    "annotations[7]": "annotations.cuboid",
}


@pytest.mark.parametrize(
    ("field", "support"),
    [
        ("sensors.lidar.frames.points.colors", Support.APPROXIMATED),
        ("sensors.lidar.frames.points.rings", Support.CONVERTED),
        ("sensors.lidar.id", Support.KEPT),
        ("sensors.lidarish.id", Support.DROPPED),
        ("metadata", Support.KEPT),
    ],
)
def test_the_longest_beginning_that_ends_at_a_dot_counts(field, support):
    assert holding_of(HOLDS, field).support == support


def test_a_table_that_says_nothing_of_a_field_gives_none():
    assert holding_of({"sensors": KEPT}, "metadata") is None


def test_slips_of_the_pen_are_found():
    assert unknown_names({**HOLDS, "sensors.lidar.frame": KEPT, "meta": KEPT}) == [
        "sensors.lidar.frame",
        "meta",
    ]


@pytest.mark.parametrize(
    ("location", "fields"),
    [
        ("sensors[top].frames[].points.intensities", ["sensors.lidar.frames.points.intensities"]),
        ("sensors[top].frames[].points.timestamps", ["sensors.lidar.frames.points.timestamps_ns"]),
        ("sensors[top].frames[3].points.reflectivity", ["sensors.lidar.frames.points.extras"]),
        ("sensors[top].serial", ["sensors.lidar.extras"]),
        ("sensors[a.b].intrinsics.distortion", ["sensors.camera.camera"]),
        ("sensors[a.b].images[].content", ["sensors.camera.images.rgb"]),
        ("annotations[7].attributes[].extras", ["annotations.cuboid.attributes"]),
        ("trajectories[vio].covariances", ["trajectories.covariances"]),
        ("trajectories.vio.covariances", ["trajectories.covariances"]),
        ("trajectories.covariances", ["trajectories.covariances"]),
        ("sensors.imu.streams.barometer.values", ["sensors.imu.streams.other.values"]),
        ("metadata.weather", ["metadata"]),
        ("sensors", ["sensors.order"]),
        ("replay", []),
    ],
)
def test_a_line_is_about_the_field_that_it_names(location, fields):
    assert list(fields_meant(location, KINDS)) == fields


def test_a_line_about_a_sensor_is_about_all_of_its_fields():
    assert set(fields_meant("sensors[top]", KINDS)) == {
        f for f in MODEL_FIELDS if f.startswith("sensors.lidar.")
    }
    everywhere = fields_meant("sensors[].poses", KINDS)
    assert set(everywhere) == {f for f in MODEL_FIELDS if f.startswith("sensors.") and f.endswith(".poses")}


def test_the_worst_that_happened_counts_and_the_largest_error():
    contents = {"sensors.lidar.frames.points.timestamps_ns": 9, "sensors.lidar.id": 1, "metadata": 1}
    reported = [
        Loss(
            field="sensors[top].frames[].points.timestamps",
            what="µs",
            support=Support.CONVERTED,
            largest_error=0.4,
        ),
        Loss(
            field="sensors[top].frames[].points.timestamps",
            what="ms",
            support=Support.APPROXIMATED,
            largest_error=0.2,
        ),
        Loss(field="sensors[top].id", what="read back as 'lidar'", kept="the header"),
        Loss(field="replay", what="a note", count=3, support=Support.KEPT),
    ]
    found = {support.field: support for support in field_supports(contents, HOLDS, reported, KINDS)}
    times = found["sensors.lidar.frames.points.timestamps_ns"]
    assert (times.support, times.count, times.largest_error) == (Support.APPROXIMATED, 9, 0.4)
    assert times.how[-1] == "as 32 bits"
    assert found["sensors.lidar.id"].support == Support.KEPT
    assert "it is in the header" in found["sensors.lidar.id"].how[0]
    assert (found["metadata"].support, found["metadata"].how) == (Support.KEPT, ())
    assert (found["replay"].count, found["replay"].how) == (3, ("a note (3 times)",))
    assert [support.field for support in lost(found.values())] == [
        "sensors.lidar.frames.points.timestamps_ns"
    ]


def test_what_is_reported_fields_that_the_scene_does_not_hold_stands_by_itself():
    reported = [Loss(field="sensors[top].mount", what="taken to be where the IMU is")]
    found = field_supports({"metadata": 1}, {"": KEPT}, reported, KINDS)
    assert [(support.field, support.support) for support in found] == [
        ("metadata", Support.KEPT),
        ("sensors[top].mount", Support.DROPPED),
    ]
