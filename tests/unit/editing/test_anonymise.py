"""Drives that report neither where nor when they were."""

from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pymap3d
import pytest

import sceneloom
from sceneloom import scene as sc
from sceneloom.cameras.camera import Camera
from sceneloom.editing.anonymise import anonymised_scene, kind_of
from sceneloom.errors import OptionError
from sceneloom.scene.annotations import BoxPath

EARLY = 1_700_000_000_123_456_789
TIMES = np.array([EARLY, EARLY + 100_000_000, EARLY + 200_000_000])
ROTATION = np.array([0.0, 0.0, np.sin(0.4), np.cos(0.4)])
LOCATIONS = np.array([[690_000.0, 5_330_000.0, 520.0]]) + np.outer(np.arange(3.0), [np.cos(0.8), np.sin(0.8), 0.0])
LLA = np.array([[48.1, 11.5, 520.0], [48.10001, 11.50002, 520.5], [48.10002, 11.50004, 521.0]])
CAMERA = Camera("pinhole", 8, 6, 5.0, 5.0, 3.5, 2.5)


def drive(**fields):
    trajectory = sc.Trajectory("gt", TIMES, LOCATIONS, np.tile(ROTATION, (3, 1)))
    point = LOCATIONS[0] + [np.cos(0.8) * 10 - np.sin(0.8) * 2, np.sin(0.8) * 10 + np.cos(0.8) * 2, 1.0]
    points = sc.LidarPoints(point[None].astype(np.float32), timestamps_ns=TIMES[:1] + 5)
    frame = sc.LidarFrame(int(TIMES[0]), points, extras=MappingProxyType({"gps": [48.1, 11.5], "n": 1}))
    frames, world = sc.LazyFrames.of([frame], TIMES[:1].tolist()), sc.PointsFrame.WORLD
    lidar = sc.LidarSensor("lidar", frames, poses=trajectory.poses, points_frame=world)
    image = sc.CameraImage.of(int(TIMES[1]), CAMERA, np.zeros((6, 8, 3), np.uint8))
    camera = sc.CameraSensor("camera", CAMERA, sc.LazyFrames.of([image], [int(TIMES[1])]), poses=trajectory.poses)
    blank = np.full(3, np.nan)
    gnss = sc.GnssSensor("gnss", TIMES, LLA, blank, blank)
    box = sc.Box2DAnnotation("b", "camera", BoxPath(TIMES[1:2], np.ones((1, 4))))
    sensors = (lidar, camera, gnss, sc.OdometrySensor("ego", trajectory.poses))
    return sc.Scene(sensors, (box,), trajectories={"gt": trajectory}, **fields)


def test_the_ego_begins_at_the_origin_and_fixes_go_or_keep_their_shape_elsewhere():
    # it looks along x
    scene = anonymised_scene(drive())
    assert not [s for s in scene.sensors if isinstance(s, sc.GnssSensor)]
    assert any(n.code == "fixes-left-out" and n.count == 3 for n in scene.warnings)
    trajectory = scene.trajectories["gt"]
    np.testing.assert_allclose(trajectory.positions, [[0, 0, 0], [1, 0, 0], [2, 0, 0]], atol=1e-9)
    np.testing.assert_allclose(trajectory.quaternions_xyzw, [[0, 0, 0, 1]] * 3, atol=1e-12)
    np.testing.assert_allclose(scene.sensor("ego").poses.positions, trajectory.positions, atol=1e-9)
    np.testing.assert_allclose(scene.cameras[0].poses.positions, trajectory.positions, atol=1e-9)
    # the file's float32 holds half a metre at five thousand kilometres
    np.testing.assert_allclose(scene.lidars[0].frames[0].points.positions, [[10, 2, 1]], atol=0.6)
    moved = anonymised_scene(drive(), fixes="shift").sensor("gnss").positions_lla
    expected = pymap3d.geodetic2enu(*LLA.T, *LLA[0])
    np.testing.assert_allclose(pymap3d.geodetic2enu(*moved.T, 0.0, 0.0, 0.0), expected, atol=1e-6)


@pytest.mark.parametrize("row", [0, 1])
def test_fixes_that_are_no_location_do_not_report_how_far_from_there_the_drive_was(row):
    lost, untold = LLA.copy(), LLA.copy()
    lost[row] = 0.0
    untold[:, 2] = np.nan
    whole = drive()
    for lla, count in ((lost, 2), (untold, 3)):
        gnss = replace(whole.sensor("gnss"), positions_lla=lla)
        sensors = tuple(gnss if s.id == "gnss" else s for s in whole.sensors)
        found = anonymised_scene(replace(whole, sensors=sensors), fixes="shift")
        moved = found.sensor("gnss")
        assert (len(moved.timestamps_ns), len(moved.accuracies)) == (count, count)
        assert np.abs(moved.positions_lla[:, :2]).max() < 0.001
        assert np.isnan(moved.positions_lla[:, 2]).all() == np.isnan(lla[:, 2]).all()
        assert sum(n.count for n in found.warnings if n.code == "fixes-left-out") == 3 - count


def test_times_begin_with_the_drive_where_that_is_asked_for_and_stay_where_not():
    kept, shifted = (anonymised_scene(drive(time_offset_ns=5), **how) for how in ({}, {"dates": "shift"}))
    assert kept.lidars[0].frames[0].timestamp_ns == EARLY
    assert shifted.time_offset_ns == 0
    frame = shifted.lidars[0].frames[0]
    assert (frame.timestamp_ns, frame.points.timestamps_ns.tolist()) == (0, [5])
    assert shifted.cameras[0].images[0].timestamp_ns == 100_000_000
    for path in (shifted.trajectories["gt"], shifted.sensor("ego").poses, shifted.cameras[0].poses):
        assert path.timestamps_ns.tolist() == [0, 100_000_000, 200_000_000]
    assert shifted.annotations[0].path.timestamps_ns.tolist() == [100_000_000]


def test_free_fields_that_report_a_location_a_name_or_a_file_go_and_others_stay():
    metadata = {
        "location": "Karlsruhe",
        "weather": "rain",
        "car": {"vin": "WBA123", "wheels": 4},
        "made": "on 2011-09-26 by ann@example.org",
        "notes": ["/media/ann/drive", "wet road"],
        "sceneloom": {"world_from_file": np.eye(4).tolist(), "euler_unit": "degrees"},
        "recording": {"other_lines": ['{"gps":1}'], "calibration": {"cameras": []}},
    }
    attributes = (sc.AttributePath("city", ("Ulm",)), sc.AttributePath("light", ("dusk",)))
    scene = anonymised_scene(drive(metadata=metadata, attributes=attributes))
    reported = {k: v for k, v in scene.metadata.items() if k != "sceneloom"}
    assert reported == {
        "weather": "rain",
        "car": {"wheels": 4},
        "made": "on 2011-09-26 by ann@example.org",
        "notes": ["wet road"],
        "recording": {"calibration": {"cameras": []}},
    }
    assert scene.metadata["sceneloom"] == {"euler_unit": "degrees", "relative": {"fixes": "drop", "dates": "keep"}}
    assert [one.name for one in scene.attributes] == ["light"]
    assert dict(scene.lidars[0].frames[0].extras) == {"n": 1}
    gone = {"metadata.location", "metadata.car.vin", "attributes.city", "sensors[lidar].frames[].extras.gps"}
    assert gone <= {n.location for n in scene.warnings}
    assert ("reports-date", "metadata.made") in {(n.code, n.location) for n in scene.warnings}
    assert "made" not in anonymised_scene(drive(metadata=metadata), dates="shift").metadata
    # what says where on earth the world was
    stated = {"latitude": 48.1, "longitude": 11.5, "altitude": 520.0}
    ours = {"enu_origin": stated, "cropped": {"box": [690_000.0] * 6, "frame": "world"}, "euler_unit": "degrees"}
    found = anonymised_scene(drive(metadata={"sceneloom": ours}))
    assert found.metadata["sceneloom"].keys() == {"euler_unit", "relative"}


def test_fields_are_known_by_the_words_of_their_names_and_by_their_values():
    for name, value, kind in (
        ("gpsLatitude", 48.0, "location"),
        ("camera-serial", "17", "name"),
        ("createdAt", 5, "date"),
        *((name, number, None) for name, number in (("file_seconds", 1.5), ("exposure", 0.01), ("latency", 0.01))),
        ("comment", "see s3://bucket/x", None),
        ("link", "s3://bucket/x", "file"),
        ("comment", "taken 26. or 2011/9/26", "date"),
        ("day", None, None),
    ):
        assert kind_of(name, value) == kind, name


def test_nothing_of_the_location_is_left_in_the_file_that_is_written_and_choices_are_checked(tmp_path):
    labels = {"document": '{"metadata":{"comment":"Karlsruhe"},"frames":{"0":{"timestamp":1700000000.1}}}'}
    scene = anonymised_scene(drive(metadata={"city": "Karlsruhe", "openlabel": labels}), dates="shift")
    sceneloom.write(scene, tmp_path / "o.sfs")
    content = (tmp_path / "o.sfs").read_bytes()
    secrets = (b"Karlsruhe", b"48.1", b"11.5", b"690000", b"5330000", b"1700000000")
    assert [secret for secret in secrets if secret in content] == []
    # a scene without poses
    alone = sc.Scene((sc.GnssSensor("gnss", TIMES, LLA, np.full(3, np.nan), np.full(3, np.nan)),))
    assert "no-poses" in {n.code for n in anonymised_scene(alone).warnings}
    with pytest.raises(OptionError, match="expected one of keep, shift"):
        anonymised_scene(alone, dates="drop")
    with pytest.raises(OptionError, match="expected one of drop, shift"):
        anonymised_scene(alone, fixes="keep")
