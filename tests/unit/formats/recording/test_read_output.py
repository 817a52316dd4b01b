"""Files of lines that methods put out, as trajectories."""

import json

import numpy as np
import pytest

from sceneloom.checks import validate
from sceneloom.errors import DataError, UnknownFormatError
from sceneloom.formats.base.registry import find_format
from sceneloom.formats.recording.spec import FORMAT

# a line as the vendor's software puts it out, the numbers shortened
OUTPUT = (
    '{"acceleration":{"x":0.0001,"y":-4e-05,"z":2e-05},"angularVelocity":{"x":0.014,"y":-0.02,"z":-0.023},'
    '"orientation":{"w":-0.384162,"x":0.453153,"y":-0.603051,"z":0.532354},'
    '"position":{"x":-0.01,"y":-0.14,"z":0.046},"status":"TRACKING","time":7323.558535104899,'
    '"velocity":{"x":-0.0099,"y":-0.0042,"z":-0.0094},"positionCovariance":[[0.1,0,0],[0,0.2,0],[0,0,0.3]]}'
)


def later(seconds):
    line = json.loads(OUTPUT)
    line["time"] += seconds
    line["position"]["x"] += seconds
    return json.dumps(line)


@pytest.fixture
def output(tmp_path):
    path = tmp_path / "out.jsonl"
    path.write_text(OUTPUT + "\n" + later(0.5) + "\n" + later(1.0) + "\n")
    return path


def test_a_file_of_output_is_a_scene_with_a_trajectory(output):
    assert find_format(output).name == "recording"
    with FORMAT.open(output) as scene:
        assert (scene.source, list(scene.trajectories), scene.sensors) == (str(output), ["output"], ())
        trajectory = scene.trajectories["output"]
        np.testing.assert_allclose(trajectory.positions, [[x, -0.14, 0.046] for x in (-0.01, 0.49, 0.99)])
        np.testing.assert_array_equal(trajectory.quaternions_xyzw[0], [0.453153, -0.603051, 0.532354, -0.384162])
        assert trajectory.timestamps_ns[0] == 7323558535105
        # what a trajectory has no field for is kept word by word
        kept = scene.metadata["recording"]["further_keys"]["trajectories.output"]
        assert json.loads(kept["7323558535105"]) == json.loads(OUTPUT)


POSITION = '"position":{"x":1,"y":2,"z":3}'


@pytest.mark.parametrize(
    ("line", "name"),
    [
        ('"output":{POSITION}', "output"),
        ('"pose":{"name":"basalt",POSITION}', "basalt"),
        ('"groundTruth":{POSITION}', "groundTruth"),
        ('"arkit":{"orientation":{"w":1,"x":0,"y":0,"z":0},POSITION}', "arkit"),
    ],
)
def test_poses_under_the_name_of_a_method_are_read_from_any_file(tmp_path, line, name):
    path = tmp_path / "results.json"
    path.write_text("{" + line.replace("POSITION", '"position":{"x":1,"y":2,"z":3}') + ',"time":0.5}\n')
    assert FORMAT.sniff(path)
    with FORMAT.open(path) as scene:
        assert list(scene.trajectories) == [name]


def test_what_lies_beside_output_is_not_its_own_and_beside_a_log_of_any_name_it_is(output, recording, pinhole):
    recording.lines([{"frames": [{"cameraInd": 0}], "number": 0, "time": 0.0}]).calibration([pinhole])
    recording.video("data.mkv", 1)
    (recording.path / "vio_config.yaml").write_text("useSlam: True\n")
    output.rename(recording.path / "out.jsonl")
    with FORMAT.open(recording.path / "out.jsonl") as scene:
        assert scene.sensors == ()
        assert not {"calibration", "vio_config"} & scene.metadata["recording"].keys()
        assert {warning.code for warning in scene.warnings} == {"further-keys-kept"}
    (recording.path / "data.jsonl").rename(recording.path / "log.jsonl")
    with FORMAT.open(recording.path / "log.jsonl") as scene:
        assert [camera.id for camera in scene.cameras] == ["camera0"]


@pytest.mark.parametrize(
    "text",
    ["", "{}\n", '{"time":1}\n', '{"version":"1.0","sensors":[]}\n', "[1]\n", '"time"\n', "{broken\n", "\x00" * 99],
)
def test_other_files_are_no_logs(tmp_path, text):
    path = tmp_path / "other.jsonl"
    path.write_text(text)
    assert not FORMAT.sniff(path)
    with pytest.raises(UnknownFormatError):
        find_format(path)


@pytest.mark.parametrize(
    ("name", "reported"),
    [
        ("data.jsonl.gz", "there is data.jsonl.gz: unpack it to data.jsonl"),
        ("Data.JSONL", "there is Data.JSONL: is it the recording's data.jsonl?"),
        ("log.jsonl", "there is log.jsonl: is it the recording's data.jsonl?"),
    ],
)
def test_of_a_folder_that_is_nearly_a_recording_it_is_reported_what_is_in_the_way(tmp_path, name, reported):
    (tmp_path / name).write_text(OUTPUT)
    with pytest.raises(UnknownFormatError) as caught:
        find_format(tmp_path)
    assert reported in caught.value.problem


def test_faults_of_output_are_named_with_their_line(output):
    with output.open("a") as file:
        file.write(OUTPUT.replace('"x":-0.01,', "") + "\n")
    with pytest.raises(DataError, match=r"out\.jsonl: line 4: .*position"):
        FORMAT.open(output)
    (error,) = (f for f in validate(output).findings if f.severity == "error")
    assert (error.rule, error.path.partition(": ")[0], "line 4" in error.path) == ("unfit-lines", "out.jsonl", True)
