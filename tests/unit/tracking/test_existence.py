"""Existence from moment to moment, against the formulas by hand."""

import numpy as np
import pytest

from sceneloom.detections.projection import Outlines
from sceneloom.tracking import TrackerSettings, tracker


def test_probabilities_and_logarithms_of_odds_are_inverse():
    assert tracker.log_odds(0.9) == pytest.approx(np.log(9.0))
    assert tracker.probabilities(np.array([np.log(9.0)])) == pytest.approx([0.9])
    assert tracker.log_odds(0.0) == -np.inf


def test_time_takes_objects_away():
    odds = np.array([np.log(9.0)])
    assert tracker.probabilities(tracker.aged(odds, 2.0, 10.0)) == pytest.approx([0.9 * np.exp(-0.2)])
    assert tracker.aged(odds, 0.0, 10.0) == pytest.approx(odds)


def test_what_detectors_cannot_find_is_not_missed():
    corners = np.array([[0.0, 0.0, 20.0, 60.0], [0.0, 0.0, 20.0, 10.0], [0.0] * 4])
    lines = Outlines(corners, np.array([1.0, 0.5, 0.0]), np.zeros((3, 3, 3)), np.zeros((3, 8, 3)))
    settings = TrackerSettings(recall_2d=0.8, recall_3d=0.5, least_height_px=25.0, farthest_3d=50.0)
    chances = np.exp(tracker.missed(lines, np.array([100.0, 10.0, 10.0]), settings))
    assert chances == pytest.approx(np.array([[0.2, 1.0], [1.0, 0.75], [1.0, 1.0]]))
