"""Drives that several tests look at."""

import pytest

from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street


@pytest.fixture(scope="session")
def drive():
    return simulate_street(3, frames=8, lidar=LidarSpec(beams=32, steps=600))


@pytest.fixture(scope="session")
def exact_drive():
    exact = LidarSpec(beams=32, steps=600, range_sigma=0.0, drop_rate=0.0)
    return simulate_street(3, frames=8, lidar=exact, cameras=(CameraSpec(),))
