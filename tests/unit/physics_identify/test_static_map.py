"""The static map between and beyond its knots."""

import numpy as np

from pmac_comp.physics.identify import StaticMap


def test_a_linear_lead_error_goes_on_beyond_the_captures() -> None:
    knots = np.linspace(-0.2, 0.2, 9)
    wave = np.array([1.0])
    lead = StaticMap(knots, 35e-6 * knots, wave, 2e-6 * wave, 0.0 * wave, 0.01)
    x = np.linspace(-0.3, 0.3, 1001)
    wobble = 2e-6 * np.cos(2.0 * np.pi * x / 0.01)
    np.testing.assert_allclose(lead.error_m(x), 35e-6 * x + wobble, atol=1e-12)
