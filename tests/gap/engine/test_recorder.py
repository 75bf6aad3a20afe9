"""What a recorder does to a signal, by its own law."""

from __future__ import annotations

import numpy as np
import pytest

from tests.gap.engine.recorded import fitted_hypothesis, recorded_log


@pytest.mark.parametrize("time_constant", [0.02, 0.064, 0.3])
def test_a_ramp_passes_a_pole_exactly_at_any_rate(time_constant: float) -> None:
    data = fitted_hypothesis(recorded_log(rate_hz=20)).data
    t = data.time - data.time[0]
    expected = t - time_constant * (1 - np.exp(-t / time_constant))
    np.testing.assert_allclose(data.low_pass(t, time_constant), expected, atol=1e-9)


def test_what_explains_has_to_gain_below_half_of_what_rows_resolve() -> None:
    for rate_hz, claim_hz in ((10.0, 2.5), (20.0, 5.0), (100.0, 10.0)):
        assert fitted_hypothesis(recorded_log(rate_hz=rate_hz, seconds=30.0)).data.claim_hz == pytest.approx(claim_hz)
