"""Rules about pictures."""

from dataclasses import replace

import numpy as np

from sceneloom.scene import CameraSensor, LazyFrames, Picture

RULES = ("picture-size", "picture-repeated", "picture-plain")
RNG = np.random.default_rng(1)


def camera_of(sound, *pictures, lens=None, **fields):
    usual = sound.camera().camera
    times = sound.times(len(pictures))
    made = [
        Picture.of(int(t), usual.resized(rgb.shape[1], rgb.shape[0]), rgb)
        for t, rgb in zip(times, pictures, strict=True)
    ]
    return CameraSensor("front", lens or usual, LazyFrames.of(made, times), poses=sound.path(), **fields)


def noise(width=32, height=24):
    return RNG.integers(0, 255, (height, width, 3), np.uint8)


def test_a_sound_scene_keeps_all_of_them(sound, found):
    scene = sound.scene(camera_of(sound, noise(), noise(), noise()))
    assert [found(scene, rule) for rule in RULES] == [[]] * len(RULES)


def test_pictures_of_another_size_are_told_once_for_the_camera(sound, found):
    scene = sound.scene(camera_of(sound, noise(), noise(64, 48), noise(64, 48)))
    [(path, message)] = found(scene, "picture-size")
    assert path == "sensors[0].pictures[1]"
    assert message.startswith("64 x 48 px")


def test_pictures_with_lenses_of_their_own_may_have_their_own_sizes(sound, found):
    scene = sound.scene(camera_of(sound, noise(64, 48)))
    camera = scene.sensors[0]
    own = replace(camera.camera.resized(64, 48), fx=70.0)
    picture = replace(camera.pictures[0], camera=own)
    camera = replace(camera, pictures=LazyFrames.of([picture], [0]))
    assert found(sound.scene(camera), "picture-size") == []


def test_pictures_equal_to_the_one_before_are_counted(sound, found):
    one, other = noise(), noise()
    scene = sound.scene(camera_of(sound, one, other, one, one, one.copy()))
    assert found(scene, "picture-repeated") == [
        ("sensors[0].pictures[3]", "2 of 5 pictures are equal to the one before")
    ]


def test_black_pictures_and_those_of_one_colour_are_told(sound, found):
    dark = RNG.integers(0, 9, (24, 32, 3), np.uint8)
    blue = np.full((24, 32, 3), (10, 20, 200), np.uint8)
    assert found(sound.scene(camera_of(sound, noise(), dark, blue)), "picture-plain") == [
        ("sensors[0].pictures[1]", "black, as are 1 more")
    ]
    assert found(sound.scene(camera_of(sound, blue)), "picture-plain") == [
        ("sensors[0].pictures[0]", "of one colour, [10, 20, 200]")
    ]
