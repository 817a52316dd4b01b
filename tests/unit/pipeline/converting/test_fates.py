"""What a report says of each field: the format's own word, and what the writing told of this scene."""

import pytest

from sceneloom.formats.holdings import holding_of, unknown_names
from sceneloom.formats.loss import KEPT, Fate, Loss, approximated, converted, dropped
from sceneloom.pipeline.converting.fates import field_fates, lost
from sceneloom.pipeline.converting.field_names import fields_meant
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
    ("field", "fate"),
    [
        ("sensors.lidar.frames.points.colors", Fate.APPROXIMATED),
        ("sensors.lidar.frames.points.rings", Fate.CONVERTED),
        ("sensors.lidar.id", Fate.KEPT),
        ("sensors.lidarish.id", Fate.DROPPED),
        ("metadata", Fate.KEPT),
    ],
)
def test_the_longest_beginning_that_ends_at_a_dot_counts(field, fate):
    assert holding_of(HOLDS, field).fate == fate


def test_a_table_that_says_nothing_of_a_field_gives_none():
    assert holding_of({"sensors": KEPT}, "metadata") is None


def test_slips_of_the_pen_are_found():
    assert unknown_names({**HOLDS, "sensors.lidar.frame": KEPT, "meta": KEPT}) == [
        "sensors.lidar.frame",
        "meta",
    ]


@pytest.mark.parametrize(
    ("place", "fields"),
    [
        ("sensors[top].frames[].points.intensities", ["sensors.lidar.frames.points.intensities"]),
        ("sensors[top].frames[].points.timestamps", ["sensors.lidar.frames.points.timestamps_ns"]),
        ("sensors[top].frames[3].points.reflectivity", ["sensors.lidar.frames.points.extras"]),
        ("sensors[top].serial", ["sensors.lidar.extras"]),
        ("sensors[a.b].intrinsics.distortion", ["sensors.camera.camera"]),
        ("sensors[a.b].images[].content", ["sensors.camera.pictures.rgb"]),
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
def test_a_line_is_about_the_field_that_it_names(place, fields):
    assert list(fields_meant(place, KINDS)) == fields


def test_a_line_about_a_sensor_is_about_all_of_its_fields():
    assert set(fields_meant("sensors[top]", KINDS)) == {
        f for f in MODEL_FIELDS if f.startswith("sensors.lidar.")
    }
    everywhere = fields_meant("sensors[].poses", KINDS)
    assert set(everywhere) == {f for f in MODEL_FIELDS if f.startswith("sensors.") and f.endswith(".poses")}


def test_the_worst_that_happened_counts_and_the_largest_error():
    contents = {"sensors.lidar.frames.points.timestamps_ns": 9, "sensors.lidar.id": 1, "metadata": 1}
    told = [
        Loss(
            field="sensors[top].frames[].points.timestamps", what="µs", fate=Fate.CONVERTED, largest_error=0.4
        ),
        Loss(
            field="sensors[top].frames[].points.timestamps",
            what="ms",
            fate=Fate.APPROXIMATED,
            largest_error=0.2,
        ),
        Loss(field="sensors[top].id", what="read back as 'lidar'", kept="the header"),
        Loss(field="replay", what="a remark", count=3, fate=Fate.KEPT),
    ]
    found = {fate.field: fate for fate in field_fates(contents, HOLDS, told, KINDS)}
    times = found["sensors.lidar.frames.points.timestamps_ns"]
    assert (times.fate, times.count, times.largest_error) == (Fate.APPROXIMATED, 9, 0.4)
    assert times.how[-1] == "as 32 bits"
    assert found["sensors.lidar.id"].fate == Fate.KEPT
    assert "it is in the header" in found["sensors.lidar.id"].how[0]
    assert (found["metadata"].fate, found["metadata"].how) == (Fate.KEPT, ())
    assert (found["replay"].count, found["replay"].how) == (3, ("a remark (3 times)",))
    assert [fate.field for fate in lost(found.values())] == ["sensors.lidar.frames.points.timestamps_ns"]


def test_what_is_told_of_fields_that_the_scene_does_not_hold_stands_by_itself():
    told = [Loss(field="sensors[top].mount", what="taken to be where the IMU is")]
    found = field_fates({"metadata": 1}, {"": KEPT}, told, KINDS)
    assert [(fate.field, fate.fate) for fate in found] == [
        ("metadata", Fate.KEPT),
        ("sensors[top].mount", Fate.DROPPED),
    ]
