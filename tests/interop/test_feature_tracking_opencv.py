"""Corners and their following against OpenCV."""

import cv2
import numpy as np
import pytest

from sceneloom.motion.camera_rotation import Pyramid, corner_strengths, find_corners, followed


@pytest.fixture(scope="module")
def images():
    """An image of smooth noise, and the same moved, rotated a little and darker."""
    draw = np.random.default_rng(0)
    noise = cv2.GaussianBlur(draw.uniform(0, 255, (300, 400)).astype(np.float32), (0, 0), 2.5)
    first = np.clip(128 + 6 * (noise - noise.mean()), 20, 235)
    move = cv2.getRotationMatrix2D((200, 150), 1.5, 1.0)
    move[:, 2] += (6.3, -3.7)
    second = 0.9 * cv2.warpAffine(first, move, (400, 300), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return [np.repeat(x.astype(np.uint8)[:, :, None], 3, axis=2) for x in (first, second)], move


def test_corners_are_as_strong_as_opencvs_and_followed_as_well(images):
    grey = images[0][0][:, :, 0].astype(np.float32)
    ours = np.empty_like(grey)
    corner_strengths(grey, 2, ours)
    theirs = cv2.cornerMinEigenVal(grey, blockSize=5, ksize=-1)
    # OpenCV takes Scharr's gradients, which look at three rows; ours look at one
    inside = (slice(10, -10), slice(10, -10))
    assert np.corrcoef(ours[inside].ravel(), theirs[inside].ravel())[0, 1] > 0.97
    (first, second), move = images
    pyramids = Pyramid.of(first), Pyramid.of(second)
    corners = find_corners(pyramids[0])
    ours, found = followed(*pyramids, corners)
    window = {"winSize": (15, 15), "maxLevel": 2, "minEigThreshold": 1e-6}
    theirs, status, _ = cv2.calcOpticalFlowPyrLK(
        first[:, :, 0], second[:, :, 0], corners[:, None].copy(), None, **window
    )
    truth = corners @ move[:, :2].T + move[:, 2]
    both = found & (status[:, 0] == 1)
    errors = np.linalg.norm(ours - truth, axis=1)[both]
    their_errors = np.linalg.norm(theirs[:, 0] - truth, axis=1)[both]
    assert len(corners) > 200
    assert both.mean() > 0.8
    # whole grey levels and a rotating window leave some hundredths of a pixel
    assert np.median(errors) < max(1.2 * np.median(their_errors), 0.03)
    assert np.quantile(errors, 0.95) < 0.2
