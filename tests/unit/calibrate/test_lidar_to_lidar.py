"""Two lidars against each other on a simulated drive."""

from dataclasses import replace

import numpy as np
import pytest

from sceneloom.calibrate.extrinsics import ground_plane, step_between
from sceneloom.calibrate.lidar_to_lidar import lidar_to_lidar
from sceneloom.errors import OptionError, PoseError
from sceneloom.simulate import Faults, LidarSpec, SensorFaults, SimulatedDrive, inject, sensor_mount, simulate_street

ROOF = LidarSpec(beams=32, steps=900)
CORNER = LidarSpec(
    beams=16,
    steps=900,
    elevations_deg=(-30.0, 10.0),
    mount=sensor_mount(position=(1.5, 0.6, 0.9), yaw_deg=70.0, pitch_deg=3.0, roll_deg=-4.0),
)


@pytest.fixture(scope="module")
def drive() -> SimulatedDrive:
    """Six sweeps of two lidars, the second of which is stated 3.7 degrees and 24 cm off."""
    wrong = SensorFaults(rotation_deg=(1.0, -2.0, 3.0), shift=(0.2, -0.1, 0.1))
    return inject(simulate_street(3, frames=6, lidars=(ROOF, CORNER)), Faults({"lidar1": wrong}))


@pytest.mark.parametrize(("use_stated", "started"), [(True, "stated"), (False, "ground")])
@pytest.mark.few(1)
def test_the_second_lidar_is_found_from_a_wrong_mounting_and_from_none(
    drive: SimulatedDrive, use_stated: bool, started: str
) -> None:
    found = lidar_to_lidar(drive.scene, use_stated=use_stated, most=4)
    step = step_between(found.mounting.a_from_b, ROOF.mount.inverse() @ CORNER.mount)
    # range noise of 2 cm over thousands of points, thinned to one in 40 cm
    assert np.degrees(np.linalg.norm(step[:3])) < 0.1
    assert np.linalg.norm(step[3:]) < 0.02
    assert found.started == started
    assert found.agreeing >= 3
    assert found.overlap > 0.4
    assert (np.abs(step) < 4.0 * found.mounting.sigmas).all()


def test_lidars_that_are_not_there_are_refused(drive: SimulatedDrive) -> None:
    with pytest.raises(OptionError, match="expected two"):
        lidar_to_lidar(drive.scene, "lidar0", "lidar7")
    one = replace(drive.scene, sensors=drive.scene.lidars[:1])
    with pytest.raises(OptionError, match=r"expected two$"):
        lidar_to_lidar(one)
    with pytest.raises(OptionError, match="named twice"):
        lidar_to_lidar(drive.scene, "lidar0", "lidar0")


@pytest.mark.slow
def test_a_start_far_off_is_refused_and_not_refined_into_something(drive: SimulatedDrive) -> None:
    far = inject(
        simulate_street(3, frames=4, lidars=(ROOF, CORNER)),
        Faults({"lidar1": SensorFaults(rotation_deg=(0.0, 90.0, 0.0), shift=(0.0, 0.0, 30.0))}),
    )
    with pytest.raises(PoseError, match="expected"):
        lidar_to_lidar(far.scene, most=3)


def test_the_ground_is_found_below_the_sensor() -> None:
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(-15, 15, (3000, 2)), rng.normal(-1.7, 0.02, 3000)])
    wall = np.column_stack([np.full(2000, 8.0), rng.uniform(-10, 10, 2000), rng.uniform(-1.7, 4.0, 2000)])
    found = ground_plane(np.concatenate([ground, wall]))
    assert found is not None
    np.testing.assert_allclose(found[0], [0.0, 0.0, 1.0], atol=0.005)
    assert found[1] == pytest.approx(1.7, abs=0.01)
    assert ground_plane(wall) is None
    assert ground_plane(wall[:10]) is None
