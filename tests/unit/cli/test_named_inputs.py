"""Inputs that options name: a pipe, a device or an static file in their location is an error at once."""

import os
import shutil

import pytest

from sceneloom.batch import jobs
from sceneloom.calibrate.conventions import read_extrinsics
from sceneloom.catalog.database import query
from sceneloom.db34t.transport import read_certificates, read_pair, read_token
from sceneloom.detections.detectors import read_detectors
from sceneloom.errors import DataError
from sceneloom.evaluate.object_files import fused_files
from sceneloom.formats.base import files as base_files
from sceneloom.report.page import read_losses
from sceneloom.service.running import read_configuration_file

READERS = {
    "a list of drives": lambda path: list(jobs._listed(path, {}, frozenset())),
    "extrinsics": read_extrinsics,
    "detectors": read_detectors,
    "a configuration": read_configuration_file,
    "certificates": read_certificates,
    "a key": lambda path: read_pair(path, path),
    "a token": read_token,
    "losses": read_losses,
    "fused detections": fused_files,
}


@pytest.mark.parametrize("what", READERS)
def test_an_input_that_is_a_pipe_is_named_and_not_waited_for(tmp_path, what):
    path = tmp_path / "input.jsonl"
    os.mkfifo(path)
    with pytest.raises(DataError, match=r"input\.jsonl.*is a named pipe; expected a regular file"):
        READERS[what](path)


def test_a_pipe_among_the_sweeps_of_a_recording_is_named_as_what_it_is(recording, call, tmp_path):
    drive = tmp_path / "drive"
    shutil.copytree(recording, drive)
    sweep = drive / "lidar" / "000001.bin"
    sweep.unlink()
    os.mkfifo(sweep)
    outcome = call("convert", drive, tmp_path / "drive.sfs")
    assert outcome.code == 1
    assert "'lidar/000001.bin': is a named pipe; expected a regular file" in outcome.err


def test_the_marker_of_a_catalogue_that_is_a_pipe_is_named(tmp_path):
    os.mkfifo(tmp_path / "catalog.json")
    with pytest.raises(DataError, match=r"catalog\.json: cannot be read: is a named pipe"):
        query(tmp_path, "SELECT 1")


@pytest.mark.parametrize("what", sorted(READERS.keys() - {"losses", "fused detections"}))
def test_settings_that_are_very_long_are_refused(tmp_path, what, monkeypatch):
    monkeypatch.setattr(base_files, "LARGEST_SETTINGS", 1000)
    path = tmp_path / "input.toml"
    path.write_bytes(b"#" * 1001)
    with pytest.raises(DataError, match="1001 bytes; expected 1000 at most"):
        READERS[what](path)
