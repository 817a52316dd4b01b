"""Algorithms of other packages, and sets of detector settings."""

import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from tests.unit.db34t.sending import box_2d, box_3d, boxes_2d, boxes_3d, calibration, cloud, image

from sceneloom.db34t.interface import FusionInterface
from sceneloom.db34t.types import Cause
from sceneloom.detections.detectors import detector_names
from sceneloom.errors import OptionError
from sceneloom.fusion.algorithms import FusionType, algorithm, names

EXAMPLE = Path(__file__).parents[3] / "examples" / "algorithm_package"


def install(site, monkeypatch, entry_points):
    """What an installation leaves where Python looks for packages."""
    metadata = site / "somebody_s-1.0.dist-info"
    metadata.mkdir(parents=True)
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: somebody-s\nVersion: 1.0\n", "utf-8")
    lines = (f"[{group}]\n{name} = {target}" for group, own in entry_points.items() for name, target in own.items())
    (metadata / "entry_points.txt").write_text("\n".join(lines), "utf-8")
    monkeypatch.syspath_prepend(str(site))


@pytest.fixture
def example_package(tmp_path, monkeypatch):
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text("utf-8"))["project"]
    install(tmp_path, monkeypatch, project["entry-points"])
    monkeypatch.syspath_prepend(str(EXAMPLE))
    yield
    sys.modules.pop("near_fusion", None)


@pytest.fixture
def fusion():
    with FusionInterface(inline=True) as interface:
        assert interface.set_calibration(calibration(), camera_id=1, lidar_id=0)
        yield interface


@pytest.mark.usefixtures("example_package")
def test_the_sensor_data_fusion_of_the_example_package_colours_near_points_alone(fusion):
    assert names(FusionType.SENSOR_DATA) == ("projection", "blending", "near")
    assert fusion.set_property("fusion_algorithm", "near")
    assert fusion.send(image(0, 1))
    assert fusion.send(cloud(0, 1, [(10.0, 0, 0), (30.0, 3.0, 0)]))
    fusion.flush()
    result = fusion.get(0)
    np.testing.assert_array_equal(result.record.points, [[10, 0, 0, 7, 7, 7], [30, 3, 0, 128, 128, 128]])
    assert result.configuration["fusion_algorithm"] == "near"


@pytest.mark.usefixtures("example_package")
def test_the_detection_fusion_of_the_example_package_keeps_what_both_saw(fusion):
    assert names(FusionType.DETECTIONS) == ("projection", "agreed")
    both = (boxes_3d(0, 1), boxes_2d(0, 1))
    alone = (box_3d(100, 2), box_3d(100, 2, Y=5.0, id=9), box_2d(100, 2), box_2d(100, 2, x1=1, x2=6, id=8))
    assert fusion.set_property("fusion_type", 1)
    assert fusion.set_property("fusion_algorithm", "agreed")
    for record in (*both, *alone):
        assert fusion.send(record)
    fusion.flush()
    found = [(result.record.box_3d_ids, result.record.box_2d_ids) for result in fusion.results()]
    assert found == [((4,), (6,)), ((4,), (6,))]


def test_a_package_can_bring_what_is_known_by_name_alone(fusion, tmp_path, monkeypatch):
    target = "sceneloom.detections.projection:fuse_by_projection"
    install(tmp_path, monkeypatch, {"sceneloom.detection_fusion": {"MV3d": target}})
    assert not fusion.set_property("fusion_algorithm", "MV3d")  # of sensor data
    assert fusion.set_property("fusion_type", 1)
    assert fusion.set_property("fusion_algorithm", "MV3d")


def test_one_that_is_built_in_is_never_replaced(tmp_path, monkeypatch):
    install(tmp_path, monkeypatch, {"sceneloom.sensor_data_fusion": {"projection": "os:abort"}})
    from sceneloom.colouring.algorithms import fuse_by_projection

    assert algorithm(FusionType.SENSOR_DATA, "projection") is fuse_by_projection
    assert names(FusionType.SENSOR_DATA) == ("projection", "blending")


@pytest.mark.parametrize("target", ["no_such_module:fuse", "math:no_such_name", "broken_algorithm:fuse"])
def test_a_package_that_cannot_be_loaded_is_a_0_that_names_it(fusion, tmp_path, monkeypatch, target):
    (tmp_path / "broken_algorithm.py").write_text("raise RuntimeError('at import')\n", "utf-8")
    install(tmp_path, monkeypatch, {"sceneloom.sensor_data_fusion": {"theirs": target}})
    outcome = fusion.set_property("fusion_algorithm", "theirs")
    assert (outcome.status, outcome.cause) == (0, Cause.UNKNOWN_ALGORITHM)
    assert target in outcome.reason


def test_one_that_is_known_by_name_alone_says_what_it_needs_and_an_unknown_one_what_there_is(fusion):
    for kind in FusionType:
        assert fusion.set_property("fusion_type", int(kind))
        outcome = fusion.set_property("fusion_algorithm", "MV3d")
        assert (outcome.status, outcome.cause) == (0, Cause.UNKNOWN_ALGORITHM)
        assert "trained network" in outcome.reason
        assert fusion.get_property("fusion_algorithm") == "projection"
    with pytest.raises(OptionError, match="'magic'; there are projection"):
        algorithm(FusionType.DETECTIONS, "magic")


def test_confidence_is_that_of_the_detectors_that_are_named_if_they_come_with_the_package(fusion):
    found = set()
    for detectors in detector_names():
        with FusionInterface(inline=True) as one:
            assert one.set_calibration(calibration(), camera_id=1)
            assert one.set_property("detectors", detectors)
            assert one.send(boxes_2d(0, 0))
            assert one.send(boxes_3d(0, 0))
            one.flush()
            found.add(float(one.get(1).record.confidence[0]))
    assert len(found) == len(detector_names()) >= 3
    assert all(0.5 < confidence <= 1.0 for confidence in found)
    for name in ["nobody", "", "/etc/passwd", "other.toml"]:
        outcome = fusion.set_property("detectors", name)
        assert outcome.cause is Cause.OUT_OF_RANGE
        assert "simulated" in outcome.reason
        assert fusion.get_property("detectors") == "simulated"
