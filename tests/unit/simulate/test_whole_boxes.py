import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.simulate import (
    CameraSpec,
    Detector2dSpec,
    LidarSpec,
    MissSpec,
    PathSpec,
    TrafficSpec,
    camera_mount,
    detect_2d,
    simulate_street,
)
from sceneloom.simulate.camera import LineViews, projected_boxes

CAMERA_MODEL = Camera("pinhole", 320, 200, 190.0, 190.0, 159.5, 95.5)
AHEAD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
READOUT_NS = 60_000_000
WHOLE = Detector2dSpec(amodal=True, misses=MissSpec(recall=1.0, hiding=0.0))


@pytest.fixture(scope="module")
def drives():
    """A busy street in a bend, before a camera whose shutter rolls over the rows and before one of columns."""
    return [
        simulate_street(
            4,
            frames=8,
            lidar=LidarSpec(beams=1, steps=1),
            cameras=(
                CameraSpec(
                    CAMERA_MODEL,
                    camera_mount(yaw_deg=20.0),
                    readout_ns=READOUT_NS,
                    left_to_right=left_to_right,
                ),
            ),
            traffic=TrafficSpec(cars=5.0, cyclists=4.0, pedestrians=8.0),
            path=PathSpec(yaw_rate=0.6),
        )
        for left_to_right in (False, True)
    ]


def test_the_box_of_an_object_beside_the_camera_reaches_the_border_and_stays_finite():
    views = LineViews(
        CAMERA_MODEL,
        False,
        AHEAD[None],
        np.zeros((1, 3)),
        np.array([[[1.0, 3.0, -1.0]]]),
        np.zeros((1, 1)),
        np.array([[8.0, 2.0, 2.0]]),
    )
    (box,) = projected_boxes(views, np.array([[1.0, 2.0, 3.0, 4.0]]))
    # Its far end is 5 m ahead and begins 2 m to the left; its top is on the camera's height.
    assert box == pytest.approx([0.0, 96.0, 159.5 - 190 * 2 / 5 + 0.5, 200.0])


@pytest.mark.slow
def test_what_a_rolling_shutter_shows_of_an_object_lies_in_its_whole_box(drives):
    for drive in drives:
        for k, report in enumerate(detect_2d(drive, "camera0", WHOLE)):
            shown = drive.truth.instances("camera0", k)
            for instance, box in zip(report.truth_instances, report.truth.corners_xyxy, strict=True):
                rows, columns = np.nonzero(shown == instance)
                # The centre of a pixel that shows it lies in the box, but for what moves within one line's time
                # and what the shutter's last lines round.
                assert box[0] - 0.1 <= columns.min() + 0.5 <= columns.max() + 0.5 <= box[2] + 0.1
                assert box[1] - 0.1 <= rows.min() + 0.5 <= rows.max() + 0.5 <= box[3] + 0.1


@pytest.mark.parametrize("axis", [1, 0])
@pytest.mark.few(1)
def test_whole_boxes_of_a_rolling_shutter_are_what_all_its_lines_see_of_the_boxes_in_space(drives, axis):
    drive = drives[axis == 0]
    camera, (report,) = drive.truth.cameras["camera0"], detect_2d(drive, "camera0", WHOLE, frames=[3])
    rotations, origins = camera.line_poses(3)
    boxes = drive.truth.boxes(camera.line_times_ns(3))
    still_px, compared = [], 0
    for instance, found in zip(report.truth_instances, report.truth.corners_xyxy, strict=True):
        own = boxes.instances.tolist().index(instance)
        seen = []
        for line, (rotation, origin) in enumerate(zip(rotations, origins, strict=True)):
            points = edge_points(
                boxes.centers_world[line, own], boxes.yaws[line, own], boxes.sizes_lwh[own], count=200
            )
            x, y, z = ((points - origin) @ rotation).T
            if z.min() < 0.5:
                break
            pixels = np.column_stack([190.0 * x / z + 159.5, 190.0 * y / z + 95.5])
            seen.append(pixels[np.abs(pixels[:, axis] - line) <= 0.5])
        else:
            pixels = np.concatenate(seen) + 0.5
            if not len(pixels) or pixels.min() < 2 or (pixels > [318, 198]).any() or len(pixels) < 50:
                continue
            expected = [*pixels.min(axis=0), *pixels.max(axis=0)]
            # A corner can fall between two lines: half a pixel.
            np.testing.assert_allclose(found, expected, atol=0.6)
            frozen = projected_boxes(at_once(LineViews.of(camera, 3, np.array([instance]))), found[None])[0]
            still_px.append(np.abs(frozen - expected).max())
            compared += 1
    assert compared >= 3
    assert max(still_px) > 1.0  # all lines at once would give other boxes


def at_once(views):
    """The views of a shutter that takes all lines with the middle one."""
    middle = slice(len(views.origins) // 2, len(views.origins) // 2 + 1)
    return LineViews(
        views.camera_model,
        views.left_to_right,
        views.rotations[middle],
        views.origins[middle],
        views.centers_world[middle],
        views.yaws[middle],
        views.sizes_lwh,
    )


def edge_points(center, yaw, size_lwh, *, count):
    """Points on the twelve edges of an upright box, world frame."""
    along = np.linspace(-1.0, 1.0, count)
    points = np.concatenate(
        [
            np.insert(np.tile([a, b], (count, 1)), axis, along, axis=1)
            for axis in range(3)
            for a in (-1.0, 1.0)
            for b in (-1.0, 1.0)
        ]
    )
    x, y, z = (points * np.array(size_lwh) / 2).T
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return np.column_stack([cosine * x - sine * y, sine * x + cosine * y, z]) + center
