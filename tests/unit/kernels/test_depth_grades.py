import numpy as np

from sceneloom.kernels.completion import grade_depths


def test_each_pixel_gets_the_cell_of_its_doubt_and_its_gap():
    random = np.random.default_rng(3)
    depths, trusts, spreads, gaps = (random.random((9, 11)).astype(np.float32) for _ in range(4))
    depths *= 40
    depths[2] = 0
    spreads *= 5
    doubt_steps, gap_steps = np.array([0.5, 1.0], np.float32), np.array([0.1, 0.2, 0.25], np.float32)
    table = random.random((3, 4)).astype(np.float32)
    confidence = np.empty_like(depths)
    grade_depths(
        depths, trusts, spreads, gaps, 3.0, 0.5, 0.05, 0.1, doubt_steps, gap_steps, table, confidence
    )
    for location in np.ndindex(depths.shape):
        doubt = (1 - 0.9 * trusts[location]) * spreads[location] / max(0.5, 0.05 * depths[location])
        cell = (doubt >= doubt_steps).sum(), (gaps[location] / 3 >= gap_steps).sum()
        assert confidence[location] == (table[cell] if depths[location] > 0 else 0)
