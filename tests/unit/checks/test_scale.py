"""The rules of the profile `scale`, on files that our own writer makes; the library itself judges in tests/interop."""

from dataclasses import replace

import numpy as np

from sceneloom import scene as sc
from sceneloom.checks import all_rules, validate
from sceneloom.formats.sfs.writer import write_scene

SECOND = 1_000_000_000
RULES = [rule.id for rule in all_rules() if rule.id.startswith("scale-")]
ONE = np.ones((1, 3), np.float32)


def everything(sound):
    """A scene with what Scale's library refuses in it, at today's date."""
    late = 1_700_000_000 * SECOND

    def moved(sensor):
        times = sensor.frames.timestamps_ns + late
        frames = [sound.sweep(int(t)) for t in times]
        return replace(sensor, frames=sc.LazyFrames.of(frames, times), poses=sound.path(times))

    radar = sc.RadarFrame(late, sc.RadarPoints(ONE, ONE, np.ones(1, np.float32)))
    path = sound.path(sound.times() + late)
    attributes = (
        sc.AttributePath("speed", (1.5,), np.array([late])),
        sc.AttributePath("make", ("vw", "vw"), np.array([late, late + 1000]), static=True),
    )
    row = np.array([[4.0, 2, 1.5, 1, 2, 0, 0, 0, 30]])
    cuboid = sc.CuboidAnnotation("car", sc.CuboidPath(np.array([late]), row), label="car", attributes=attributes)
    return sound.scene(
        moved(sound.lidar()),
        sc.RadarSensor("radar", sc.LazyFrames.of([radar], [late]), path),
        replace(sound.odometry(), poses=path),
        sc.PointsSensor("map", ONE),
        cuboid,
        sc.GroupAnnotation("all"),
    )


def found_in(path):
    findings = validate(path, profile="scale", rules=RULES).findings
    return sorted({finding.rule for finding in findings})


def test_what_the_text_alone_allows_is_found_where_the_profile_asks_for_it(sound, tmp_path, encode_sfs):
    scene, ours, text = everything(sound), tmp_path / "scale.sfs", tmp_path / "text.sfs"
    write_scene(scene, ours, profile="scale")
    write_scene(scene, text, time_unit="nanoseconds")
    kinds = ("annotation-type", "field", "points", "radar-lengths", "scene", "sensor-type", "static-attribute")
    assert found_in(text) == [f"scale-{kind}" for kind in kinds]
    assert not set(validate(text).rules) & set(RULES)
    # nor is a scene that is no file of the format refused anything
    assert found_in(ours) == found_in(scene) == []
    # what the library drops in silence is reported
    poses = {"timestamps": [0], "values": [[0.0, 0, 0, 0, 0, 0, 1]]}
    frames = [{"timestamp": 0, "points": {"positions": ONE}}]
    lidar = {"id": "top", "type": "lidar", "poses": poses, "frames": frames, "coordinates": "ego", "parent_id": "rack"}
    text.write_bytes(encode_sfs({"version": "1.0", "sensors": [lidar]}))
    findings = validate(text, profile="scale", rules=RULES).findings
    dropped = {("scale-dropped", f"sensors[0].{field}") for field in ("coordinates", "parent_id")}
    assert {(finding.rule, finding.path) for finding in findings} == dropped
