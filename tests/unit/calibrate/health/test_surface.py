"""Tops of quadratics."""

import numpy as np

from sceneloom.calibrate.health import Surface, coefficients


def test_the_top_of_a_quadratic_is_found():
    generator = np.random.default_rng(3)
    surface = Surface.of(60, 3, generator)
    top = np.array([0.3, -0.2, 0.4])
    bend = np.diag([1.0, 2.0, 3.0]) + 0.2
    away = surface.locations - top
    values = -np.einsum("ni,ij,nj->n", away, bend, away)
    # 3000 probes in the unit ball lie about 0.1 apart
    assert np.linalg.norm(surface.tops(values[None])[0] - top) < 0.12


def test_a_slope_leads_to_the_rim():
    surface = Surface.of(60, 2, np.random.default_rng(4))
    top = surface.tops((surface.locations @ np.array([1.0, 0.0]))[None])[0]
    assert top[0] > 0.9


def test_a_quadratic_of_three_numbers_has_ten_coefficients():
    assert coefficients(3) == 10
