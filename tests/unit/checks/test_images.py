"""Rules about images."""

from dataclasses import replace

import numpy as np

from sceneloom.scene import CameraImage, CameraSensor, LazyFrames

RULES = ("image-size", "image-repeated", "image-plain")
RNG = np.random.default_rng(1)


def camera_of(sound, *images, camera_model=None, **fields):
    usual = sound.camera().camera
    times = sound.times(len(images))
    made = [
        CameraImage.of(int(t), usual.resized(rgb.shape[1], rgb.shape[0]), rgb)
        for t, rgb in zip(times, images, strict=True)
    ]
    return CameraSensor(
        "front", camera_model or usual, LazyFrames.of(made, times), poses=sound.path(), **fields
    )


def noise(width=32, height=24):
    return RNG.integers(0, 255, (height, width, 3), np.uint8)


def test_a_sound_scene_keeps_all_of_them(sound, found):
    scene = sound.scene(camera_of(sound, noise(), noise(), noise()))
    assert [found(scene, rule) for rule in RULES] == [[]] * len(RULES)


def test_images_of_another_size_are_reported_once_for_the_camera(sound, found):
    scene = sound.scene(camera_of(sound, noise(), noise(64, 48), noise(64, 48)))
    [(path, message)] = found(scene, "image-size")
    assert path == "sensors[0].images[1]"
    assert message.startswith("64 x 48 px")


def test_images_with_camera_models_of_their_own_may_have_their_own_sizes(sound, found):
    scene = sound.scene(camera_of(sound, noise(64, 48)))
    camera = scene.sensors[0]
    own = replace(camera.camera.resized(64, 48), fx=70.0)
    image = replace(camera.images[0], camera=own)
    camera = replace(camera, images=LazyFrames.of([image], [0]))
    assert found(sound.scene(camera), "image-size") == []


def test_images_equal_to_the_one_before_are_counted(sound, found):
    one, other = noise(), noise()
    scene = sound.scene(camera_of(sound, one, other, one, one, one.copy()))
    assert found(scene, "image-repeated") == [
        ("sensors[0].images[3]", "2 of 5 images are equal to the one before")
    ]


def test_black_images_and_those_of_one_colour_are_reported(sound, found):
    dark = RNG.integers(0, 9, (24, 32, 3), np.uint8)
    blue = np.full((24, 32, 3), (10, 20, 200), np.uint8)
    assert found(sound.scene(camera_of(sound, noise(), dark, blue)), "image-plain") == [
        ("sensors[0].images[1]", "black, as are 1 more")
    ]
    assert found(sound.scene(camera_of(sound, blue)), "image-plain") == [
        ("sensors[0].images[0]", "of one colour, [10, 20, 200]")
    ]
