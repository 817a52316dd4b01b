"""Faults that the simulator plants into a drive are found, and found in no other sensor; a clean drive has none."""

from sceneloom.cameras.camera import Camera
from sceneloom.checks import validate
from sceneloom.simulate import CameraSpec, Faults, LidarSpec, SensorFaults, TrafficSpec, simulate_street

START = 1_000_000_000
PERIOD = 100_000_000
BLIND = ((START, START + 2 * PERIOD),)
STUCK = ((START + 4 * PERIOD, START + 7 * PERIOD),)
CAMERA_MODEL = Camera("pinhole", 48, 32, 40.0, 40.0, 23.5, 15.5)


def drive(**faults):
    sensors = {name: SensorFaults(**injected) for name, injected in faults.items()}
    return simulate_street(
        2,
        frames=8,
        lidar=LidarSpec(beams=16, steps=300),
        cameras=(CameraSpec(CAMERA_MODEL),),
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


def test_injected_faults_are_found_where_they_are_and_nowhere_else():
    injected = {"blind": BLIND, "stuck": STUCK}
    scene = drive(lidar={**injected, "intensity_scale": 0.005}, camera0=injected)
    locations = {sensor.id: f"sensors[{k}]" for k, sensor in enumerate(scene.sensors)}
    assert found_in(scene) == {
        ("frame-without-points", locations["lidar"]),
        ("frame-repeated", locations["lidar"]),
        ("intensity-scale", locations["lidar"]),
        ("image-plain", locations["camera0"]),
        ("image-repeated", locations["camera0"]),
    }
