"""Faults that the simulator plants into a drive are found, and found in no other sensor; a clean drive has none."""

from sceneloom.cameras.camera import Camera
from sceneloom.checks import validate
from sceneloom.simulate import CameraSpec, Faults, LidarSpec, SensorFaults, TrafficSpec, simulate_street

START = 1_000_000_000
PERIOD = 100_000_000
BLIND = ((START, START + 2 * PERIOD),)
STUCK = ((START + 4 * PERIOD, START + 7 * PERIOD),)
LENS = Camera("pinhole", 48, 32, 40.0, 40.0, 23.5, 15.5)


def drive(**faults):
    sensors = {name: SensorFaults(**planted) for name, planted in faults.items()}
    return simulate_street(
        2,
        frames=8,
        lidar=LidarSpec(beams=16, steps=300),
        cameras=(CameraSpec(LENS),),
        traffic=TrafficSpec(),
        faults=Faults(sensors=sensors) if sensors else None,
    ).scene


def found_in(scene):
    """Rules that found something, with the sensor or part of the scene that they found it in."""
    findings = validate(scene).findings
    usual = {"annotation-beyond-scene"}
    return {(f.rule, f.path.split(".")[0]) for f in findings if f.rule not in usual}


def test_a_clean_drive_has_no_fault():
    assert found_in(drive()) == set()


def test_planted_faults_are_found_where_they_are_and_nowhere_else():
    planted = {"blind": BLIND, "stuck": STUCK}
    scene = drive(lidar={**planted, "intensity_scale": 0.005}, camera0=planted)
    places = {sensor.id: f"sensors[{k}]" for k, sensor in enumerate(scene.sensors)}
    assert found_in(scene) == {
        ("frame-without-points", places["lidar"]),
        ("frame-repeated", places["lidar"]),
        ("intensity-scale", places["lidar"]),
        ("picture-plain", places["camera0"]),
        ("picture-repeated", places["camera0"]),
    }
