"""MCAP files behind URLs: the index and what is asked for are fetched, not the file."""

import pickle

import numpy as np
import pytest

import sceneloom
from sceneloom.errors import DataError
from sceneloom.formats.sfs.writer import SceneWriter
from sceneloom.scene import LidarFrame, LidarPoints, LidarSensor


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """40 sweeps of 8,000 points, in chunks that are not compressed, as bytes of an MCAP file."""
    folder = tmp_path_factory.mktemp("mcap")
    rng = np.random.default_rng(5)
    with SceneWriter(folder / "drive.sfs") as writer:
        writer.add_sensor(LidarSensor("top", ()))
        for k in range(40):
            points = LidarPoints(rng.normal(size=(8_000, 3)).astype(np.float32))
            writer.add_frame("top", LidarFrame(k * 100_000_000, points))
    with sceneloom.open(folder / "drive.sfs") as scene:
        sceneloom.write(scene, folder / "drive.mcap", compression="none")
    return folder / "drive.mcap"


def test_a_sweep_costs_its_message_and_not_the_file(served, drive):
    served.files["drive.mcap"] = drive.read_bytes()
    with sceneloom.open(served.url("drive.mcap")) as scene, sceneloom.open(drive) as local:
        assert served.bytes_sent < len(served.files["drive.mcap"]) / 4
        opened = served.bytes_sent
        found, expected = scene.lidars[0].frames[17], local.lidars[0].frames[17]
        assert found.timestamp_ns == expected.timestamp_ns
        np.testing.assert_array_equal(found.points.positions, expected.points.positions)
        assert served.bytes_sent - opened < 2 * 8_000 * 16 + 200_000


def test_faults_that_pass_do_not_show(served, drive, waits):
    served.files["drive.mcap"] = drive.read_bytes()
    with sceneloom.open(served.url("drive.mcap")) as scene:
        served.faults[:] = ["503", "cut", "503"]
        assert len(scene.lidars[0].frames[3].points.positions) == 8_000
    assert waits


def test_a_drive_goes_to_other_processes_and_is_distinguished_from_another_one(served, drive):
    served.files["drive.mcap"] = drive.read_bytes()
    with sceneloom.open(served.url("drive.mcap") + "?sig=hidden") as scene:
        again = pickle.loads(pickle.dumps(scene))
        assert len(again.lidars[0].frames[3].points.positions) == 8_000
        late = pickle.loads(pickle.dumps(scene))
    served.files["drive.mcap"] += b"\0"
    with pytest.raises(DataError, match="was changed after it was opened") as reported:
        _ = late.lidars[0].frames[5].points.positions
    assert "hidden" not in str(reported.value)
