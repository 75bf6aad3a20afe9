"""A winner outside what is physically possible is marked everywhere that it is named."""

from __future__ import annotations

import json
from dataclasses import dataclass

import pytest
import torch

import avtorch
from avtorch.errors import InputError
from avtorch.gap import EFFECTS, Effect, Parameter, plant
from avtorch.gap.effects.gust import Gust
from avtorch.gap.effects.sensor_lag import SensorLag
from avtorch.gap.quantity import Quantity
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.gap.result.hypotheses import implausible
from avtorch.gap.simulator.plant import BASELINE
from avtorch.report.diagnosis import report_html
from tests.gap.records import Noise, log_of


def about(mean: float, share: float = 0.05) -> Quantity:
    """Known to a share of itself."""
    half = 1.645 * share * abs(mean)
    return Quantity(mean, share * abs(mean), mean - half, mean + half)


def said_everywhere(found: Diagnosis, reason: str) -> None:
    """In Python, the terminal, the page and JSON."""
    told = found.to_dict()
    assert told["verdict"]["plausible"] is False
    assert reason in told["verdict"]["plausibility"]
    own = next(e for e in told["effects"] if e["name"] == found.verdict.name)
    assert own["plausible"] is False
    assert own["plausibility"] == told["verdict"]["plausibility"]
    json.dumps(told, allow_nan=False)
    assert reason in str(found)
    assert reason in "\n".join(found.winner.implausible), "as the terminal has it"
    assert reason in report_html(found)


@pytest.fixture(scope="module")
def shaken() -> Diagnosis:
    """A car that something pushes far harder than wind and road do."""
    log = log_of(plant(T_L=0.4, K_L=0.9), noise=Noise(force_sd=1.9, force_time=1.5), speed0=40.0)
    return avtorch.diagnose(log, effects=["gust"], pairs=False)


@pytest.mark.slow
def test_a_gust_that_no_wind_makes_is_remarked_with_its_name(shaken: Diagnosis) -> None:
    assert shaken.verdict.names == ("gust",)
    assert shaken.winner.parameters["sd_mps2"].mean > 0.6  # what wind does; the engine's sizes end at 0.8
    said_everywhere(shaken, "possible are 0 to 0.6; the effect stands in for something else")
    first = str(shaken).splitlines()[0]
    assert "physically implausible" in first
    assert Gust.meaning not in first


@pytest.mark.slow
def test_a_gain_of_a_sixteenth_is_remarked() -> None:
    found = avtorch.diagnose(log_of(plant(T_L=0.3, K_L=0.06)), effects=[], pairs=False)
    said_everywhere(found, "possible are 0.3 to 3.5")


@pytest.mark.slow
def test_a_usual_gust_is_not() -> None:
    log = log_of(plant(T_L=0.4, K_L=0.9), noise=Noise(force_sd=0.3, force_time=1.5))
    found = avtorch.diagnose(log, effects=["gust"], pairs=False)
    assert found.verdict.names == ("gust",)
    assert found.to_dict()["verdict"] | {"plausible": True, "plausibility": None} == found.to_dict()["verdict"]
    assert "implausible" not in report_html(found) + str(found)
    assert "wind and road push the car at random" in str(found)


@pytest.mark.parametrize("kind", [EFFECTS[name] for name in sorted(EFFECTS)], ids=lambda kind: kind.name)
def test_what_an_effect_reports_has_a_range_that_holds_its_typical_values(kind: type[Effect]) -> None:
    ranges = {p.name: p for p in (*kind.parameters, *kind.derived) if p.reported}
    assert set(kind().report(torch.tensor(0.4))) == set(ranges)
    for p in ranges.values():
        low, high = p.physical
        # a moment is on the log's own time, and may be any
        assert low <= p.low < p.high <= high
        for typical in (p.low, p.high):
            assert implausible({p.name: about(typical)}, {}, [kind]) == ()


def test_one_interval_that_reaches_in_is_no_accusation() -> None:
    (late,) = implausible({"lag_s": Quantity(2.4, 0.1, 2.2, 2.6)}, {}, [SensorLag])
    assert late.startswith("sensor_lag.lag_s is 2.4 s, typical 0.05 to 0.5: possible are 0 to 1")
    assert implausible({"lag_s": Quantity(2.4, 1.0, 0.9, 4.2)}, {}, [SensorLag]) == ()
    # of a pair each by its own name
    pair = {"sensor_lag.lag_s": about(0.2), "gust.sd_mps2": about(1.9), "gust.time_constant_s": about(2.0)}
    (only,) = implausible(pair, {p.name: about(float(p.typical())) for p in BASELINE}, [SensorLag, Gust])
    assert only.startswith("gust.sd_mps2 is 1.9 m/s²")


@dataclass(frozen=True)
class Trailer(Effect):
    """A user's effect that does not declare what is possible."""

    mass_ratio: float = 0.4

    name, place = "trailer_of_mine", "actuator"
    meaning, equation = "a trailer", "K_L / (1 + m)"
    parameters = (Parameter("mass_ratio", "-", neutral=0.0, low=0.1, high=0.8),)


def test_an_own_effect_falls_back_to_three_times_its_typical_range() -> None:
    # on the log scale: 0.1 to 0.8 is the middle times and over the root of 8
    low, high = Trailer.parameters[0].physical
    middle, reach = 0.08**0.5, 8**0.5
    assert (low, high) == pytest.approx((middle / reach**3, middle * reach**3))
    assert implausible({"mass_ratio": about(0.9)}, {}, [Trailer]) == ()
    (told,) = implausible({"mass_ratio": about(12.0)}, {}, [Trailer])
    assert "possible are 0.013 to 6.4" in told


def test_a_range_that_is_empty_is_refused() -> None:
    with pytest.raises(InputError, match="possible"):
        Parameter("x", "-", 0.0, 1.0, 2.0, possible=(3.0, 1.0))
