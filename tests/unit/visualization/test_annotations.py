"""Each annotation is drawn where the simulated street's exact truth says that its object is."""

from dataclasses import replace

import numpy as np
import pytest

from sceneloom.errors import OptionError, OutputError
from sceneloom.scene import (
    AttributePath,
    CameraCalibration,
    Corrections,
    EventAnnotation,
    LazyFrames,
    LocalizationAdjustment,
    Poses,
    ShapeType,
)
from sceneloom.simulate import CameraSpec, LidarSpec, annotate, demo_drive, simulate_street
from sceneloom.visualization.annotations import (
    colour_of,
    draw_adjustment,
    draw_annotations_above,
    draw_annotations_in_image,
    draw_calibration,
    draw_timeline,
    figures_in_image,
    figures_in_world,
    save_annotation_images,
)

EVERY_TYPE = {
    "cuboid", "box_2d", "points", "event", "labeled_points", "point_segmentation", "localization_adjustment",
    "camera_calibration", "object", "attributes", "link", "group", *map(str, ShapeType),
}  # fmt: skip


@pytest.fixture(scope="module")
def drive():
    return annotate(demo_drive(frames=3))


@pytest.fixture(scope="module")
def scene(drive):
    """Images are rendered when they are asked for, and each test asks again: here they are kept."""
    kept = {}
    for camera in drive.scene.cameras:
        images = [p.loaded() for p in camera.images]
        kept[camera.id] = replace(camera, images=LazyFrames.of(images, camera.images.timestamps_ns))
    sensors = tuple(kept.get(sensor.id, sensor) for sensor in drive.scene.sensors)
    return replace(drive.scene, sensors=sensors)


@pytest.fixture(scope="module")
def sample(scene):
    return replace(scene, corrections=Corrections.IGNORE).samples()[1]  # images are drawn of it as it is


def only(scene, annotation_type):
    chosen = tuple(a for a in scene.annotations if a.type == annotation_type)
    return replace(scene, annotations=chosen, attributes=()), chosen[0]


def changed_pixels(scene, sample, camera_id="camera0"):
    """Where the image differs from the one without annotations, (H, W) bool."""
    height = sample.cameras[camera_id].height
    bare = draw_annotations_in_image(replace(scene, annotations=()), sample, camera_id)
    drawn = draw_annotations_in_image(scene, sample, camera_id)
    return (np.asarray(drawn)[:height] != np.asarray(bare)[:height]).any(axis=2)


def test_the_annotated_drive_has_every_type_of_the_format(scene):
    assert {str(a.type) for a in scene.annotations} == EVERY_TYPE


@pytest.mark.parametrize("annotation_type", ["box_2d", "polygon_2d", "labeled_points", "polygon"])
def test_what_is_about_the_car_is_drawn_on_the_car(drive, scene, sample, annotation_type):
    box = next(a for a in scene.annotations if a.type == "box_2d")
    left, top, width, height = box.path.values[1]
    chosen, _ = only(scene, annotation_type)
    rows, columns = np.nonzero(changed_pixels(chosen, sample))
    # lines are two pixels wide and names stand a line of text above what they name
    assert left - 12 <= columns.min()
    assert columns.max() <= left + width + 12
    assert top - 40 <= rows.min()
    assert rows.max() <= top + height + 12


def test_labelled_points_fall_on_the_pixels_that_show_the_car(drive, scene, sample):
    chosen, _annotation = only(scene, "labeled_points")
    marked = changed_pixels(chosen, sample)
    instance = int(next(a.id for a in scene.annotations if a.type == "cuboid" and a.projections).split("-")[1])
    shown = drive.truth.instances("camera0", 1) == instance
    assert marked.sum() > 100
    # points that the lidar sees past the car's edges are drawn as discs of three pixels
    assert (marked & shown).sum() > 0.85 * marked.sum()


def test_a_cuboid_is_drawn_through_its_projected_corners(scene, sample):
    _, _cuboid = only(scene, "cuboid")
    chosen = replace(scene, annotations=tuple(a for a in scene.annotations if getattr(a, "projections", ())[:1]))
    figures = dict(figures_in_world(chosen, sample.timestamp_ns))
    (figure,) = (f for a, f in figures.items() if a.type == "cuboid")
    assert len(figure.lines) == 13
    sizes = np.ptp(np.concatenate(figure.lines), axis=0)
    assert sizes[2] == pytest.approx(next(a for a in figures if a.type == "cuboid").path.values[0, 2])


def test_pixels_of_files_count_from_the_corner_and_are_drawn_from_the_centre(scene, sample):
    found = figures_in_image(scene, "camera0", sample.times_ns["camera0"])
    ((annotation, figure),) = ((a, f) for a, f in found if a.type == "box_2d")
    np.testing.assert_allclose(figure.lines[0][0], annotation.path.values[1, :2] - 0.5)
    chosen, _ = only(scene, "box_2d")
    assert list(figures_in_image(chosen, "camera1", scene.annotations[0].path.timestamps_ns[0])) == []


def test_from_above_a_link_joins_what_it_links(scene, sample):
    chosen, link = only(scene, "link")
    ends = tuple(a for a in scene.annotations if a.id in (link.from_id, link.to_id))

    def drawn(*annotations):
        return np.asarray(draw_annotations_above(replace(chosen, annotations=annotations), sample, reach=30.0))

    assert (drawn(*ends) != drawn(*ends, link)).any()
    assert np.array_equal(drawn(link), drawn())


def test_an_event_is_a_bar_as_long_as_it_lasts(scene):
    first = scene.annotations[0].path.timestamps_ns[0]
    event = EventAnnotation("e", int(first), 200_000_000)
    half = EventAnnotation("e", int(first), 100_000_000)
    lengths = []
    for one in (event, half):
        image = np.asarray(draw_timeline(replace(scene, annotations=(one,), attributes=())))
        dimmed = [round(0.45 * c + 0.55 * d) for c, d in zip(colour_of(one), (17, 19, 23), strict=True)]
        lengths.append(int((image == dimmed).all(axis=2).any(axis=0).sum()))
    assert lengths[0] == pytest.approx(2 * lengths[1], abs=3)


def test_what_does_not_fit_the_timeline_is_counted_and_attributes_of_the_scene_have_a_line(scene):
    def height(*annotations, attributes=()):
        return draw_timeline(replace(scene, annotations=annotations, attributes=attributes)).height

    many = [EventAnnotation(k, 1_000_000_000 + k) for k in range(500)]
    assert height(*many) == height(*many[:200])
    stated = AttributePath("weather", ("dry",), np.array([1_100_000_000]))
    assert height(attributes=(stated,)) > height()


def test_a_calibration_that_changes_nothing_moves_nothing(sample):
    def drawn(*quaternion):
        poses = Poses(np.array([0]), np.zeros((1, 3)), np.array([quaternion]), static=True)
        return np.asarray(draw_calibration(sample, CameraCalibration("c", "camera0", poses)))

    nothing, moved = drawn(0.0, 0.0, 0.0, 1.0), drawn(0.0, 0.02, 0.0, 0.9998)
    yellow = (255, 206, 84)
    assert (moved == yellow).all(axis=2).sum() > 10 * (nothing == yellow).all(axis=2).sum()


def test_an_adjustment_shows_the_trajectory_before_and_after(scene):
    shift = Poses(np.array([0]), np.array([[0.0, 2.0, 0.0]]), np.array([[0.0, 0.0, 0.0, 1.0]]), static=True)
    image = np.asarray(draw_adjustment(scene, LocalizationAdjustment("a", shift)))
    rows_before = np.nonzero((image == (158, 164, 173)).all(axis=2)[:600, 100:1100])[0]
    rows_after = np.nonzero((image == (255, 206, 84)).all(axis=2)[:600, 100:1100])[0]
    assert len(rows_before)
    assert len(rows_after)
    assert rows_after.mean() < rows_before.mean()  # the world's y is up in the image


def test_every_type_gets_a_file_of_its_own(scene, tmp_path):
    written = save_annotation_images(scene, tmp_path / "look", at=0.2)
    assert {p.stem.removeprefix("type_") for p in written if p.stem.startswith("type_")} == EVERY_TYPE
    assert all(path.stat().st_size > 1000 for path in written)
    with pytest.raises(OutputError, match="overwrite"):
        save_annotation_images(scene, tmp_path / "look")


def test_a_scene_without_sweeps_and_images_has_its_timeline_and_times_outside_are_refused(scene, tmp_path):
    names = {path.stem for path in save_annotation_images(replace(scene, sensors=()), tmp_path / "look")}
    assert {"timeline", "type_cuboid"} <= names
    assert "above" not in names
    with pytest.raises(OptionError, match="expected a time within the scene"):
        save_annotation_images(scene, tmp_path / "other", at=1000.0)


def test_a_street_without_two_cars_in_view_is_refused():
    spec = CameraSpec()
    drive = simulate_street(frames=1, lidar=LidarSpec(beams=4, steps=90), cameras=(spec,), traffic=None)
    empty = replace(drive.truth.street, objects=())
    with pytest.raises(OptionError, match="two"):
        annotate(replace(drive, truth=replace(drive.truth, street=empty)))
