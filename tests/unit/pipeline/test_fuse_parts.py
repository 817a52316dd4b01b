"""Drives fused in parts: the scene is the one that a single run writes."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from sceneloom.batch.pieces import cut_times
from sceneloom.errors import DataError, OptionError
from sceneloom.geometry.rotations import matrix_from_quaternion
from sceneloom.motion.odometry import OdometryRun, lidar_odometry
from sceneloom.pipeline import FusionOutputs, fuse
from sceneloom.pipeline.fusing.parts import fuse_part, join_fused, reference_times
from sceneloom.pipeline.parts.odometry import follow_part, goes_by_sweeps, join_ways, read_way
from sceneloom.pipeline.parts.records import read_records, writing_records
from sceneloom.scene import GnssSensor, LazyFrames, LidarSensor, PosePath, Scene
from sceneloom.simulate import LidarSpec, simulate_street

SECONDS = 0.2


def fused_in_parts(scene: Scene, folder: Path, *, way: OdometryRun | None = None, **how: Any) -> Any:
    files = []
    for k, span_ns in enumerate(cut_times(reference_times(scene), seconds=SECONDS)):
        files.append(folder / f"part{k}")
        fuse_part(scene, files[-1], span_ns=span_ns, odometry=way, **how)
    assert len(files) > 1
    return join_fused(scene, files, outputs=FusionOutputs(scene=folder / "joined.sfs"), odometry=way, **how)


def without_way(scene: Scene) -> Scene:
    kept = tuple(sensor for sensor in scene.sensors if not isinstance(sensor, GnssSensor))
    return replace(scene, trajectories={}, sensors=kept)


def told(report: Any) -> Any:
    return msgspec.structs.replace(report, output=None, seconds=0.0, stages={})


@pytest.mark.parametrize("how", [{}, {"start": 0.1}, {"trajectory": "identity"}])
def test_a_known_way_gives_the_very_file(drive: Scene, tmp_path: Path, how: dict[str, Any]) -> None:
    whole = fuse(drive, tmp_path / "whole.sfs", **how)
    joined = fused_in_parts(drive, tmp_path, **{"start": None, "stop": None, **how})
    assert told(joined) == told(whole)
    assert (tmp_path / "joined.sfs").read_bytes() == (tmp_path / "whole.sfs").read_bytes()


def test_a_way_found_before_gives_the_very_file(drive: Scene, tmp_path: Path) -> None:
    blind = without_way(drive)
    assert goes_by_sweeps(blind, None)
    fuse(blind, tmp_path / "whole.sfs")
    fused_in_parts(blind, tmp_path, way=lidar_odometry(blind))
    assert (tmp_path / "joined.sfs").read_bytes() == (tmp_path / "whole.sfs").read_bytes()


def test_sweeps_that_cannot_be_read_are_told_once(drive: Scene, tmp_path: Path) -> None:
    (lidar,) = drive.lidars

    def read(index: int) -> Any:
        if index == 2:
            raise DataError("drive", f"frames[{index}]", "torn")
        return lidar.frames[index]

    torn = LazyFrames(lidar.frames.timestamps_ns, read)
    sensors = tuple(replace(s, frames=torn) if isinstance(s, LidarSensor) else s for s in drive.sensors)
    scene = replace(drive, sensors=sensors)
    whole = fuse(scene, tmp_path / "whole.sfs", lenient=True)
    joined = fused_in_parts(scene, tmp_path, lenient=True)
    assert (joined.skipped, len(joined.skipped)) == (whole.skipped, 1)
    assert (tmp_path / "joined.sfs").read_bytes() == (tmp_path / "whole.sfs").read_bytes()


def test_a_part_that_ends_too_early_is_refused(drive: Scene, tmp_path: Path) -> None:
    (span_ns,) = cut_times(reference_times(drive))
    fuse_part(drive, tmp_path / "part", span_ns=span_ns)
    records = list(read_records(tmp_path / "part"))
    with writing_records(tmp_path / "short") as writer:
        for record in records[:-1]:
            writer.add(*record)
    whole = (tmp_path / "part").read_bytes()
    (tmp_path / "torn").write_bytes(whole[: len(whole) // 2])
    outputs = FusionOutputs(scene=tmp_path / "joined.sfs")
    (tmp_path / "empty").touch()
    faults = {
        "short": "ends too early",
        "torn": "expected a record",
        "empty": "is empty",
        "gone": "cannot be read",
    }
    for name, why in faults.items():
        with pytest.raises(DataError, match=why):
            join_fused(drive, [tmp_path / name], outputs=outputs)
    assert not outputs.scene.exists()  # type: ignore[union-attr]


def test_what_is_made_of_whole_pictures_is_refused(drive: Scene, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="--depth"):
        join_fused(drive, [], outputs=FusionOutputs(scene=tmp_path / "a.sfs", depth=tmp_path / "depth"))


def test_records_keep_arrays_and_values_as_they_are(tmp_path: Path) -> None:
    arrays = {"a": np.arange(6, dtype=np.int16).reshape(2, 3)[:, ::-1], "none": np.zeros((0, 3), np.float32)}
    with writing_records(tmp_path / "file") as writer:
        writer.add({"deep": {"x": np.array([1.5]), "y": np.float32(2.5), "z": [1, None, "µ"]}}, arrays)
        with pytest.raises(TypeError, match="a object cannot be kept"):
            writer.add({"odd": object()}, {})
    ((values, found),) = read_records(tmp_path / "file")
    assert (values["deep"]["x"].tolist(), values["deep"]["y"].dtype) == ([1.5], np.float32)
    assert values["deep"]["z"] == [1, None, "µ"]
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == array.dtype


def ways(scene: Scene, folder: Path, spans: Sequence[tuple[int, int]]) -> OdometryRun:
    files = []
    for k, span_ns in enumerate(spans):
        files.append(folder / f"way{k}")
        follow_part(scene, files[-1], span_ns=span_ns)
    join_ways(files, folder / "way", scene.source)
    return read_way(folder / "way")


@pytest.mark.slow
def test_the_way_found_in_parts_is_that_of_a_single_run(tmp_path: Path) -> None:
    drive = simulate_street(5, frames=150, lidar=LidarSpec(beams=24, steps=360), cameras=())
    scene = without_way(drive.scene)
    single = lidar_odometry(scene).trajectory
    spans = cut_times(reference_times(scene), seconds=4.0)
    joined = ways(scene, tmp_path, spans).trajectory
    np.testing.assert_array_equal(joined.timestamps_ns, single.timestamps_ns)
    apart = np.linalg.norm(joined.positions - single.positions, axis=1)
    length = np.linalg.norm(np.diff(single.positions, axis=0), axis=1).sum()
    # each of three joints errs by a few millimetres and tenths of a milliradian
    assert apart.max() < 0.02 + 1e-3 * length
    assert apart[joined.timestamps_ns < spans[0][1] - 10**8].max() == 0.0
    truth = drive.truth.world_from_ego(single.timestamps_ns)
    ends = [end_from_first(way) for way in (truth, single.poses, joined.poses)]
    errors = [float(np.linalg.norm(end - ends[0])) for end in ends[1:]]
    assert errors[1] < errors[0] + 2e-4 * length


def end_from_first(path: PosePath) -> np.ndarray:
    """The last position as seen from the first pose."""
    turn = matrix_from_quaternion(path.quaternions_xyzw)[0]
    return np.asarray((path.positions[-1] - path.positions[0]) @ turn)


def test_the_way_of_one_part_is_that_of_the_whole(drive: Scene, tmp_path: Path) -> None:
    scene = without_way(drive)
    single, joined = lidar_odometry(scene), ways(scene, tmp_path, cut_times(reference_times(scene)))
    for name in ("timestamps_ns", "positions", "quaternions_xyzw", "covariances"):
        np.testing.assert_array_equal(getattr(joined.trajectory, name), getattr(single.trajectory, name))
    assert joined.notices == single.notices


def test_parts_of_single_sweeps_know_how_the_way_begins(drive: Scene, tmp_path: Path) -> None:
    scene = without_way(drive)
    single = lidar_odometry(scene).trajectory
    spans = cut_times(reference_times(scene), seconds=0.01)
    assert len(spans) == len(reference_times(scene))
    # each part is led into by all sweeps before it, so that nothing is known less
    np.testing.assert_allclose(ways(scene, tmp_path, spans).trajectory.positions, single.positions, atol=1e-9)
