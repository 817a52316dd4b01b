"""Axes of declared frames: the triples of table 2 and plain words."""

import numpy as np
import pytest

from sceneloom.db34t.calibration import DeclaredAxes, SensorKind
from sceneloom.errors import CalibrationError


@pytest.mark.parametrize(
    ("triple", "left_handed", "words"),
    [
        ((2, 0, -1), False, "+z,+x,-y"),  # table 2's example of a camera
        ((0, -1, 2), False, "+x,-y,+z"),  # and of a lidar
        ((2, 0, -1), True, "+z,-x,-y"),
        ((0, -1, 2), True, "-x,-y,+z"),
        ((1, 0, 2), False, "+y,+x,+z"),  # y forward, x right, z up, as of nuScenes' lidar
        ((0, 1, 2), False, "-x,+y,+z"),
    ],
)
def test_a_triple_says_what_its_words_state(triple, left_handed, words):
    by_triple = DeclaredAxes.of_triple(triple, left_handed=left_handed)
    assert by_triple.words == words
    assert by_triple.left_handed is left_handed
    np.testing.assert_array_equal(DeclaredAxes.of_words(words).forward_right_up, by_triple.forward_right_up)


def test_the_frames_of_the_examples_are_those_used_inside():
    camera = DeclaredAxes.of_triple((2, 0, -1), left_handed=False)
    lidar = DeclaredAxes.of_triple((0, -1, 2), left_handed=False)
    np.testing.assert_array_equal(camera.standard_from_declared(SensorKind.CAMERA), np.eye(3))
    np.testing.assert_array_equal(lidar.standard_from_declared(SensorKind.LIDAR), np.eye(3))


def test_a_left_handed_frame_is_mirrored_on_the_way_in():
    axes = DeclaredAxes.of_words("+x,+y,+z")
    matrix = axes.standard_from_declared(SensorKind.LIDAR)
    np.testing.assert_array_equal(matrix @ (1.0, 2.0, 3.0), (1.0, -2.0, 3.0))
    assert np.linalg.det(matrix) == -1.0


@pytest.mark.parametrize("triple", [(0, 1), (0, 1, 1), (0, -1, 3), (0, 1, 2, 0)])
def test_triples_that_are_no_axes_are_refused(triple):
    with pytest.raises(CalibrationError, match="axes"):
        DeclaredAxes.of_triple(triple, left_handed=False)


@pytest.mark.parametrize("words", ["", "+x", "+x,+y", "+x,+x,+z", "a,b,c", "+x,-y,+z,+x"])
def test_words_that_are_no_axes_are_refused(words):
    with pytest.raises(CalibrationError, match="axes"):
        DeclaredAxes.of_words(words)
