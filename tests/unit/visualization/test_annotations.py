"""Each annotation is drawn where the simulated street's exact truth says that its object is."""

from dataclasses import replace

import numpy as np
import pytest

from sceneloom import scene as sc
from sceneloom.errors import OptionError, OutputError
from sceneloom.simulate import CameraSpec, LidarSpec, annotate, demo_drive, simulate_street
from sceneloom.visualization import annotations as drawing


@pytest.fixture(scope="module")
def drive():
    return annotate(demo_drive(frames=3))


@pytest.fixture(scope="module")
def scene(drive):
    """Images are rendered when they are asked for, and each test asks again: here they are kept."""
    kept = {}
    for camera in drive.scene.cameras:
        images = [p.loaded() for p in camera.images]
        kept[camera.id] = replace(camera, images=sc.LazyFrames.of(images, camera.images.timestamps_ns))
    sensors = tuple(kept.get(sensor.id, sensor) for sensor in drive.scene.sensors)
    return replace(drive.scene, sensors=sensors)


@pytest.fixture(scope="module")
def sample(scene):
    return replace(scene, corrections=sc.Corrections.IGNORE).samples()[1]  # images are drawn of it as it is


def only(scene, annotation_type):
    chosen = tuple(a for a in scene.annotations if a.type == annotation_type)
    return replace(scene, annotations=chosen, attributes=())


def changed_pixels(scene, sample, camera_id="camera0"):
    """Where the image differs from the one without annotations, (H, W) bool."""
    height = sample.cameras[camera_id].height
    bare = drawing.draw_annotations_in_image(replace(scene, annotations=()), sample, camera_id)
    drawn = drawing.draw_annotations_in_image(scene, sample, camera_id)
    return (np.asarray(drawn)[:height] != np.asarray(bare)[:height]).any(axis=2)


def test_what_is_about_the_car_is_drawn_on_the_car(drive, scene, sample):
    box = next(a for a in scene.annotations if a.type == "box_2d")
    left, top, width, height = box.path.values[1]
    for annotation_type in ("box_2d", "polygon_2d", "labeled_points", "polygon"):
        marked = changed_pixels(only(scene, annotation_type), sample)
        rows, columns = np.nonzero(marked)
        # lines are two pixels wide and names stand a line of text above what they name
        assert left - 12 <= columns.min() < columns.max() <= left + width + 12, annotation_type
        assert top - 40 <= rows.min() < rows.max() <= top + height + 12, annotation_type
        if annotation_type == "labeled_points":
            seen = next(a.id for a in scene.annotations if a.type == "cuboid" and a.projections)
            shown = drive.truth.instances("camera0", 1) == int(seen.split("-")[1])
            assert marked.sum() > 100
            # points that the lidar sees past the car's edges are drawn as discs of three pixels
            assert (marked & shown).sum() > 0.85 * marked.sum()


def test_cuboids_are_drawn_through_their_corners_pixels_from_their_centres_and_links_from_above(scene, sample):
    chosen = replace(scene, annotations=tuple(a for a in scene.annotations if getattr(a, "projections", ())[:1]))
    found = drawing.figures_in_world(chosen, sample.timestamp_ns)
    ((cuboid, figure),) = ((a, f) for a, f in found if a.type == "cuboid")
    assert len(figure.lines) == 13
    assert np.ptp(np.concatenate(figure.lines), axis=0)[2] == pytest.approx(cuboid.path.values[0, 2])
    # pixels of files count from the corner
    found = drawing.figures_in_image(scene, "camera0", sample.times_ns["camera0"])
    ((annotation, figure),) = ((a, f) for a, f in found if a.type == "box_2d")
    np.testing.assert_allclose(figure.lines[0][0], annotation.path.values[1, :2] - 0.5)
    first_ns = scene.annotations[0].path.timestamps_ns[0]
    assert list(drawing.figures_in_image(only(scene, "box_2d"), "camera1", first_ns)) == []

    def drawn(*annotations):
        chosen = replace(scene, annotations=annotations, attributes=())
        return np.asarray(drawing.draw_annotations_above(chosen, sample, reach=30.0))

    link = next(a for a in scene.annotations if a.type == "link")
    ends = tuple(a for a in scene.annotations if a.id in (link.from_id, link.to_id))
    assert (drawn(*ends) != drawn(*ends, link)).any()
    assert np.array_equal(drawn(link), drawn())


def test_an_event_is_a_bar_as_long_as_it_lasts_and_what_does_not_fit_the_timeline_is_counted(scene):
    def timeline(*annotations, attributes=()):
        return drawing.draw_timeline(replace(scene, annotations=annotations, attributes=attributes))

    first = int(scene.annotations[0].path.timestamps_ns[0])
    lengths = []
    for one in (sc.EventAnnotation("e", first, 200_000_000), sc.EventAnnotation("e", first, 100_000_000)):
        dimmed = [round(0.45 * c + 0.55 * d) for c, d in zip(drawing.colour_of(one), (17, 19, 23), strict=True)]
        lengths.append(int((np.asarray(timeline(one)) == dimmed).all(axis=2).any(axis=0).sum()))
    assert lengths[0] == pytest.approx(2 * lengths[1], abs=3)
    many = [sc.EventAnnotation(k, 1_000_000_000 + k) for k in range(500)]
    assert timeline(*many).height == timeline(*many[:200]).height
    stated = sc.AttributePath("weather", ("dry",), np.array([1_100_000_000]))
    assert timeline(attributes=(stated,)).height > timeline().height


def test_corrections_show_what_they_move_and_a_calibration_that_changes_nothing_moves_nothing(scene, sample):
    yellow = (255, 206, 84)

    def drawn(*quaternion):
        poses = sc.Poses(np.array([0]), np.zeros((1, 3)), np.array([quaternion]), static=True)
        image = np.asarray(drawing.draw_calibration(sample, sc.CameraCalibration("c", "camera0", poses)))
        return (image == yellow).all(axis=2).sum()

    assert drawn(0.0, 0.02, 0.0, 0.9998) > 10 * drawn(0.0, 0.0, 0.0, 1.0)
    shift = sc.Poses(np.array([0]), np.array([[0.0, 2.0, 0.0]]), np.array([[0.0, 0.0, 0.0, 1.0]]), static=True)
    image = np.asarray(drawing.draw_adjustment(scene, sc.LocalizationAdjustment("a", shift)))[:600, 100:1100]
    before, after = (np.nonzero((image == colour).all(axis=2))[0] for colour in ((158, 164, 173), yellow))
    assert 0 < after.mean() < before.mean()  # the world's y is up in the image


def test_every_type_gets_a_file_of_its_own_but_in_a_street_without_two_cars(scene, tmp_path):
    every_type = {str(a.type) for a in scene.annotations}
    assert every_type == {
        "cuboid", "box_2d", "points", "event", "labeled_points", "point_segmentation", "localization_adjustment",
        "camera_calibration", "object", "attributes", "link", "group", *map(str, sc.ShapeType),
    }  # fmt: skip
    written = drawing.save_annotation_images(scene, tmp_path / "look", at=0.2)
    assert {p.stem.removeprefix("type_") for p in written if p.stem.startswith("type_")} == every_type
    assert all(path.stat().st_size > 1000 for path in written)
    with pytest.raises(OutputError, match="overwrite"):
        drawing.save_annotation_images(scene, tmp_path / "look")
    names = {path.stem for path in drawing.save_annotation_images(replace(scene, sensors=()), tmp_path / "bare")}
    assert ({"timeline", "type_cuboid"} <= names, "above" in names) == (True, False)
    with pytest.raises(OptionError, match="expected a time within the scene"):
        drawing.save_annotation_images(scene, tmp_path / "other", at=1000.0)
    spec = CameraSpec()
    drive = simulate_street(frames=1, lidar=LidarSpec(beams=4, steps=90), cameras=(spec,), traffic=None)
    empty = replace(drive.truth.street, objects=())
    with pytest.raises(OptionError, match="two"):
        annotate(replace(drive, truth=replace(drive.truth, street=empty)))
