"""The file that a fusion system starts from: what it sets, and what is stated for faults in it."""

import numpy as np
import pytest

from sceneloom.db34t import ImageData, PointCloudData, Timestamp
from sceneloom.db34t.interface import FusionInterface, read_configuration_file
from sceneloom.errors import DataError

WHOLE = """
[properties]
lidar_frequency = 20
lidar_coordinate = [0, -1, 2]

[[added]]
name = "site"
description = "where the rig is"
type = "string[2]"
value = ["yard", "road"]

[sensors.0]
kind = "lidar"
[sensors.1]
kind = "camera"
raw = "jpeg"

[[calibrations]]
camera_id = 1
image_size = [4, 2]
intrinsic_matrix = [5.0, 0, 1.5, 0, 5.0, 0.5, 0, 0, 1]
reference_frame = 0
extrinsic_matrix = [0, 0, 1, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 0, 1]

[service]
most_sessions = 3
"""

CALIBRATION = WHOLE[WHOLE.index("[[calibrations]]") : WHOLE.index("[service]")]


@pytest.fixture
def read(tmp_path):
    def read_text(text, **options):
        path = tmp_path / "rig.toml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return read_configuration_file(path, **options)

    return read_text


def test_a_system_starts_as_the_file_says(read):
    found = read(WHOLE, further=("service",))
    assert found.further == {"service": {"most_sessions": 3}}
    with FusionInterface(inline=True) as fusion:
        found.apply(fusion)
        assert fusion.get_property("lidar_frequency") == 20
        assert fusion.get_property("lidar_coordinate") == (0, -1, 2)
        assert fusion.get_property("site") == ("yard", "road")
        common = {"timestamp": Timestamp(5, 0), "seq": 1}
        pixels = {"height": 2, "width": 4, "encoding": "mono8", "channel": 1, "data": np.zeros(8, np.uint8)}
        assert fusion.send(ImageData(sensor_id=1, **common, **pixels))
        points = np.ones((1, 3), np.float32)
        cloud = PointCloudData(
            sensor_id=0, **common, number=1, fields=("x", "y", "z"), fields_number=3, data=points
        )
        assert fusion.send(cloud)
        assert fusion.send(PointCloudData(**{**as_fields(cloud), "sensor_id": 1})).cause == "unknown-sensor"


def as_fields(record):
    return {name: getattr(record, name) for name in type(record).__slots__}


def test_an_empty_file_changes_nothing(read):
    found = read("")
    with FusionInterface(inline=True) as fusion:
        before = fusion.list_properties()
        found.apply(fusion)
        assert fusion.list_properties() == before


@pytest.mark.parametrize(
    ("text", "location", "words"),
    [
        ("propertes = 1", "propertes", "expected one of properties"),
        ("properties = 1", "properties", r"expected a table \[properties\]"),
        ("[added]\nname = 'x'", "added", r"expected a table \[\[added\]\]"),
        ("[service]\nx = 1", "service", "expected one of properties"),
        ("[properties]\nlidar_frequency = 0", "properties.lidar_frequency", "0; expected 1 or more"),
        ("[properties]\nlidar_frequency = 10.5", "properties.lidar_frequency", "10.5; expected a uint32"),
        ("[properties]\nlidar_frequenzy = 1", "properties.lidar_frequenzy", "'lidar_frequenzy' is not there"),
        ("[properties]\nsensors = '{}'", "properties.sensors", "expected \\[sensors.ID\\]"),
        ("[properties]\ncalibration = '[]'", "properties.calibration", "expected \\[\\[calibrations\\]\\]"),
        ("[properties]\nfusion_algorithm = 'MV3d'", "properties.fusion_algorithm", "MV3d"),
        ("[[added]]\nname = 'x'", r"added\[0\].type", "missing"),
        ("[[added]]\nname = 'x'\ntype = 'int64'", r"added\[0\]", "'int64'"),
        ("[[added]]\nname = 'x'\ntype = 7", r"added\[0\].type", "7; expected a string"),
        ("[[added]]\nname = 'x'\ntype = 'bool'\nunit = 'm'", r"added\[0\].unit", "expected one of name"),
        ("[[added]]\nname = 'x'\ntype = 'uint8'\nvalue = 256", r"added\[0\].value", "256; expected a uint8"),
        ("added = [1]", r"added\[0\]", "expected a table"),
        ("[sensors.0]\nkind = 'radar'", "sensors.0.kind", "'radar'"),
        ("[sensors]\n0 = 1979-05-27", "sensors.0", "expected an object"),
        (CALIBRATION + CALIBRATION, r"calibrations\[1\]", "camera 1 and lidar 0 again"),
        (CALIBRATION.replace("[4, 2]", "[4]"), r"calibrations\[0\].image_size", "expected"),
        (CALIBRATION.replace("image_size", "size"), r"calibrations\[0\].size", "not a field of table 3"),
        (CALIBRATION.replace("[5.0,", "[-5.0,"), r"calibrations\[0\]", "-5"),
        ("[properties", "", "no TOML"),
        (b"\xff\xfe", "", "no TOML"),
        ("a = " + "[" * 5000, "", "no TOML"),
    ],
)
def test_a_fault_is_reported_with_its_location(read, text, location, words):
    with pytest.raises(DataError, match=rf"rig\.toml: {location}.*{words}"):
        read(text)
