"""What can be repaired in annotations without a choice is repaired in the file, all at once."""

import numpy as np

from sceneloom.checks import validate
from sceneloom.formats import open_scene
from sceneloom.formats.sfs.writer import write_scene
from sceneloom.scene import (
    AttributePath,
    CuboidAnnotation,
    CuboidPath,
    LabeledPoints,
    LabeledPointsAnnotation,
)

PERIOD = 100_000_000
REPAIRED = {
    "annotation-times-increasing",
    "cuboid-negative-size",
    "labelled-point-twice",
    "attribute-static-repeats",
}


def test_a_file_with_everything_that_can_be_repaired_is_repaired(sound, tmp_path):
    rows = np.tile([-4.0, 2, 1.5, 1, 2, 0, 0, 0, 30], (3, 1))
    repeated = AttributePath("make", ("vw", "vw"), np.array([0, PERIOD]), static=True)
    annotations = (
        CuboidAnnotation(
            "car", CuboidPath(np.array([PERIOD, 0, PERIOD]), rows), label="car", attributes=(repeated,)
        ),
        LabeledPointsAnnotation(
            "road", (LabeledPoints("top", np.array([7, 7, 3], np.uint32), 0),), label="road"
        ),
    )
    write_scene(sound.scene(annotations=annotations), tmp_path / "drive.sfs")
    before = validate(tmp_path / "drive.sfs")
    assert {f.rule for f in before.findings if f.fixable} == REPAIRED
    report = validate(tmp_path / "drive.sfs", fix=tmp_path / "repaired.sfs")
    assert {finding.rule for finding in report.fixed} == REPAIRED
    assert not {finding.rule for finding in report.findings} & REPAIRED
    with open_scene(tmp_path / "repaired.sfs") as scene:
        car, road = scene.annotations
        assert car.path.timestamps_ns.tolist() == [0, PERIOD]
        assert car.path.values[:, 0].tolist() == [4.0, 4.0]
        assert car.attributes[0].values == ("vw",)
        assert road.labeled_points[0].point_ids.tolist() == [7, 3]
