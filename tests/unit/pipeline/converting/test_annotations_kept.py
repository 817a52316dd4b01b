"""Every annotation of a drive is in the target when it is read back, or among the listed losses with its count."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

import sceneloom
from sceneloom.formats.base.losses import Support
from sceneloom.formats.base.registry import written_formats
from sceneloom.scene import (
    AttributePath,
    Box2DAnnotation,
    BoxPath,
    CameraCalibration,
    CuboidAnnotation,
    EventAnnotation,
    GroupAnnotation,
    LabeledPoints,
    LabeledPointsAnnotation,
    LinkAnnotation,
    LocalizationAdjustment,
    ObjectAnnotation,
    PointPath,
    PointsAnnotation,
    Poses,
    ShapeAnnotation,
    ShapeType,
    VertexPath,
)
from sceneloom.simulate import LidarSpec

SMALL = LidarSpec(beams=8, steps=90)


def shape(identifier, kind, times, vertices):
    where = {"sensor_id": "camera0"} if kind.endswith("_2d") else {}
    return ShapeAnnotation(
        identifier, ShapeType(kind), VertexPath(times, (np.array(vertices, float),) * len(times)), **where
    )


def annotated(with_camera):
    """Three sweeps with an annotation of every type; those in images only where there is a camera."""
    drive = sceneloom.simulate_street(
        3, frames=3, lidar=SMALL, **({} if with_camera else {"cameras": ()})
    ).scene
    times = drive.lidars[0].frames.timestamps_ns
    here = next(iter(drive.trajectories.values())).positions[20]
    cuboids = [a for a in drive.annotations if isinstance(a, CuboidAnnotation)][:6]
    still = Poses(times[:1], np.zeros((1, 3)), np.array([[0, 0, 0, 1.0]]))
    state = AttributePath("review_state", ("approved",), times[:1])
    ahead = [here + np.array([x, y, 1]) for x, y in ((10, 0), (10, 3), (15, 3))]
    found = [
        replace(cuboids[0], attributes=(*cuboids[0].attributes, state), parent_id="thing"),
        *cuboids[1:],
        shape("line", "polyline", times, ahead),
        shape("area", "polygon", times, ahead),
        PointsAnnotation("points", (PointPath(times, np.repeat([ahead[0]], 3, axis=0)),), labels=("a",)),
        EventAnnotation("event", int(times[0]), 10**8, label="start"),
        LabeledPointsAnnotation(
            "labelled", (LabeledPoints("lidar", np.arange(5, dtype=np.uint32), 0),), "road"
        ),
        ObjectAnnotation("thing", "car"),
        LinkAnnotation("link", cuboids[0].id, cuboids[1].id, "follows", is_bidirectional=False),
        GroupAnnotation("group", "convoy"),
        LocalizationAdjustment("adjustment", still),
    ]
    if with_camera:
        seen = drive.cameras[0].images.timestamps_ns
        found += [
            Box2DAnnotation("box", "camera0", BoxPath(seen, np.tile([50.0, 60, 70, 80], (3, 1))), "car"),
            shape("line in images", "polyline_2d", seen, [[1, 2], [30, 40]]),
            shape("area in images", "polygon_2d", seen, [[1, 2], [30, 40], [5, 60]]),
            CameraCalibration("calibration", "camera0", still),
        ]
    return replace(drive, annotations=tuple(found))


@pytest.fixture(scope="module", params=[True, False], ids=["with a camera", "without a camera"])
def source(request, tmp_path_factory):
    path = tmp_path_factory.mktemp("annotated") / "drive.sfs"
    scene = annotated(request.param)
    sceneloom.write(scene, path)
    return scene, path


IS_READ = {"colmap": False, "nerfstudio": False}


@pytest.mark.few(18)
@pytest.mark.parametrize("target", written_formats())
def test_each_annotation_is_read_back_or_listed_with_its_count(source, target, tmp_path):
    scene, path = source
    only_written = target in ("colmap", "nerfstudio")
    if only_written and not scene.cameras:
        pytest.skip("writes images, of which there are none")
    written = tmp_path / {
        "sfs": "out.sfs",
        "mcap": "out.mcap",
        "ros1": "out.bag",
        "openlabel": "out.json",
    }.get(target, "out")
    report = sceneloom.convert(path, written, to=target)
    found = ()
    if not only_written:
        with sceneloom.open(written, format=target) as again:
            found = again.annotations
    listed = Counter()
    for loss in report.losses.losses:
        if loss.support is Support.DROPPED and loss.field in _WHOLE:
            listed[loss.field.removeprefix("annotations.")] += loss.count
    applied = [n for n in report.warnings if n.code == "correction-applied"]
    kept = Counter(n.message.split(" ")[0] for n in applied)
    missing = kinds_of(scene.annotations) - kinds_of(found) - kept
    unlisted = missing - listed
    assert unlisted.total() <= listed["annotations"], (
        f"{dict(unlisted)} of {dict(missing)}; {dict(listed)} listed"
    )


def kinds_of(annotations):
    return Counter("shape" if isinstance(a, ShapeAnnotation) else str(a.type) for a in annotations)


_WHOLE = {"annotations", *(f"annotations.{kind}" for kind in kinds_of(annotated(True).annotations))}


@pytest.mark.parametrize("target", ["kitti-object", "kitti-tracking", "kitti-raw"])
def test_boxes_of_a_drive_without_a_camera_are_in_their_locations_in_each_frame(tmp_path, target):
    scene = annotated(with_camera=False)
    sceneloom.convert(_saved(scene, tmp_path), tmp_path / "out", to=target)
    with sceneloom.open(tmp_path / "out") as again:
        assert not again.cameras
        for mine, theirs in zip(scene.samples(), again.samples(), strict=True):
            assert len(theirs.boxes) == len(mine.boxes) == 6
            np.testing.assert_allclose(in_lidar(theirs), in_lidar(mine), atol=1e-3)  # numbers of fixed digits


def in_lidar(sample):
    return sample.world_from_lidar.inverse().apply(sample.boxes.centers_world)


def _saved(scene, folder):
    path = folder / "drive.sfs"
    sceneloom.write(scene, path)
    return path
