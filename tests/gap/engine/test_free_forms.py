"""Free forms: laws of their responses and of their evidence, and known causes found by the right family."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

from avtorch import Log
from avtorch.arrays import FloatArray
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.free_forms import (
    COEFFICIENT_SD,
    FreeForm,
    _bent,
    _delayed,
    _first_order_backwards,
    _moved,
    band_products,
    demand_response,
    explained,
    explained_or_late,
    first_order,
    linear_forms,
    mirror_columns,
    sensor_form,
    wandering,
)
from avtorch.gap.engine.gauss_newton import fit, prior_terms, slopes_of, whitened_jacobian
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.inference import infer
from avtorch.gap.engine.likelihood import log_likelihood, whiten
from avtorch.gap.engine.roughness import SIGNS, roughness

DT, SECONDS, LAG, GAIN = 0.02, 150.0, 0.4, 0.9
ACCEL_SD, SPEED_SD = 0.1, 0.03

Force = Callable[[FloatArray, FloatArray], FloatArray]


def _lagged(x: FloatArray) -> FloatArray:
    keep = math.exp(-DT / LAG)
    return lfilter([0.0, 1.0 - keep], [1.0, -keep], x, zi=[x[0]])[0]


def _lags(time: FloatArray, u: FloatArray) -> FloatArray:
    return _lagged(GAIN * u)


def _cubic(time: FloatArray, u: FloatArray) -> FloatArray:
    return _lagged(GAIN * (u + 0.15 * u * np.abs(u)))


def _weaker_drive(time: FloatArray, u: FloatArray) -> FloatArray:
    return _lagged(GAIN * np.where(u > 0, 0.8 * u, u))


def _slower_drive(time: FloatArray, u: FloatArray) -> FloatArray:
    up = lfilter([DT / 1.0], [1.0, DT / 1.0 - 1.0], GAIN * np.maximum(u, 0.0))
    return np.asarray(up + _lagged(GAIN * np.minimum(u, 0.0)))


def _two_lags(time: FloatArray, u: FloatArray) -> FloatArray:
    slow = lfilter([DT / 3.0], [1.0, DT / 3.0 - 1.0], u)
    return _lagged(GAIN * (0.7 * u + 0.3 * slow))


def _wandering_gain(time: FloatArray, u: FloatArray) -> FloatArray:
    return _lagged(GAIN * u * (1.0 + 0.25 * np.sin(2 * np.pi * time / 60.0)))


def _wandering_brakes(time: FloatArray, u: FloatArray) -> FloatArray:
    force = np.where(u < 0, 1.0 + 0.25 * np.sin(2 * np.pi * time / 60.0), 1.0)
    return _lagged(GAIN * force * u)


def _pulsing_brakes(time: FloatArray, u: FloatArray) -> FloatArray:
    off = (u < -0.5) & (np.sin(2 * np.pi * 1.7 * time) > 0)
    return _lagged(GAIN * np.where(off, 0.6, 1.0) * u)


def _uneven_brakes(time: FloatArray, u: FloatArray) -> FloatArray:
    pulse = 1.0 + 0.2 * np.sign(np.sin(2 * np.pi * (1.0 + 0.005 * time) * time))  # no cycle: 1 to 2.5 Hz
    return _lagged(GAIN * np.where(u < -0.5, pulse, 1.0) * u)


def _wandering_delay(time: FloatArray, u: FloatArray) -> FloatArray:
    late = 0.1 + 0.1 * np.sin(2 * np.pi * time / 60.0)
    return np.interp(time - late, time, _lagged(GAIN * u))


def _foreseeing(time: FloatArray, u: FloatArray) -> FloatArray:
    return 0.8 * _lagged(GAIN * u) + 0.2 * _lagged(GAIN * u[::-1])[::-1]


def _foreseeing_drive(time: FloatArray, u: FloatArray) -> FloatArray:
    up = np.maximum(u, 0.0)
    return _lagged(GAIN * np.minimum(u, 0.0)) + 0.8 * _lagged(GAIN * up) + 0.2 * _lagged(GAIN * up[::-1])[::-1]


def _drive(response: Force, channels: tuple[str, ...] = ("accel", "speed"), seed: int = 0, bias: float = 0.0) -> Log:
    """A car with this response to an open-loop command, and a bias of its accelerometer [m/s²]."""
    random = np.random.default_rng(seed)
    time = np.arange(0.0, SECONDS, DT)
    command = gaussian_filter1d(np.repeat(random.normal(0.0, 1.3, len(time)), 150)[: len(time)], 20)
    command -= command.mean()
    accel = response(time, command)
    speed = 40.0 + np.cumsum(np.append(0.0, 0.5 * (accel[1:] + accel[:-1]))) * DT
    speed += 20.0 - speed.min()  # never near standstill
    readings = {
        "accel": bias + accel + random.normal(0.0, ACCEL_SD, len(time)),
        "speed": speed + random.normal(0.0, SPEED_SD, len(time)),
    }
    return Log.from_arrays(time=time, accel_cmd=command, **{c: readings[c] for c in channels})


@cache
def _car(response: Force, channels: tuple[str, ...] = ("accel", "speed"), seed: int = 0) -> Hypothesis:
    """The hypothesis without effects, fitted to such a car."""
    return _fitted(DriveData.of(_drive(response, channels, seed)))


def _fitted(data: DriveData) -> Hypothesis:
    h = fit(Hypothesis(data), 12)
    whitened = whitened_jacobian(h, slopes_of(h))
    h.information = whitened @ whitened.T + np.diag(prior_terms(h, h.free)[0])
    return h


# responses ---------------------------------------------------------------------------------------------------------
def test_lag_follows_a_step_as_its_equation_says() -> None:
    time = np.arange(0.0, 5.0, DT)
    step = (time >= 1.0 - 1e-9).astype(float)
    accel, speed = first_order(time, time == 0.0, step, LAG)
    since = np.maximum(time - 1.0, 0.0)
    np.testing.assert_allclose(accel, 1.0 - np.exp(-since / LAG), atol=1e-12)
    np.testing.assert_allclose(speed, since - LAG * (1.0 - np.exp(-since / LAG)), atol=1e-12)


def test_each_stretch_begins_anew(fresh_seed: int) -> None:
    demand = np.random.default_rng(fresh_seed).normal(size=100)
    time = np.arange(100) * DT
    starts = np.zeros(100, bool)
    starts[[0, 40]] = True
    accel, speed = first_order(time, starts, demand, LAG)
    alone = first_order(time[40:], starts[40:], demand[40:], LAG)
    np.testing.assert_allclose(accel[40:], alone[0])
    np.testing.assert_allclose(speed[40:], alone[1])
    assert accel[40] == demand[40]
    assert speed[40] == 0.0


def test_backwards_is_forwards_in_the_mirror(fresh_seed: int) -> None:
    """A held demand turned around is one held from the other end."""
    random = np.random.default_rng(fresh_seed)
    held, time = random.normal(size=99), np.arange(100) * DT
    starts = np.arange(100) == 0
    forwards, gained = first_order(time, starts, np.append(held[::-1], held[0]), LAG)
    accel, speed = _first_order_backwards(time, starts, np.append(held, 0.0), LAG)
    np.testing.assert_allclose(accel[::-1], forwards, atol=1e-12)
    # its integral: as much speed is gained from any row to the end
    np.testing.assert_allclose(speed[-1] - speed[::-1], gained, atol=1e-12)


@pytest.mark.parametrize("channels", [("accel", "speed"), ("speed",), ("accel",)], ids="+".join)
def test_demand_of_the_command_is_the_cars_own_response(channels: tuple[str, ...]) -> None:
    """Without effects the car is a lag behind K u, seen by the same recorder: what is left is the start's transient,
    of which exp(-4 s / T) is left after warming up."""
    h = _car(_lags, channels)
    own = demand_response(h, h["K_L"] * h.command()[None], np.array([h["T_L"]]))[0]
    assert np.linalg.norm(own - h.predicted) < 10 * math.exp(-4.0 / h["T_L"]) * np.linalg.norm(own)


def test_a_dead_time_delays_every_demand() -> None:
    h = _car(_lags).copy()
    h["dead_time"] = 0.2
    late = demand_response(h, h["K_L"] * h.command()[None], np.array([h["T_L"]]))[0]
    assert np.linalg.norm(late - h.response()) < 1e-3 * np.linalg.norm(late)


# evidence ----------------------------------------------------------------------------------------------------------
def test_band_products_give_every_whitened_product(fresh_seed: int) -> None:
    h = _car(_lags)
    x = np.random.default_rng(fresh_seed).normal(size=(3, *h.residual.shape))
    weighted = np.tensordot(np.linalg.inv(h.covariance), band_products(h.data, x), 3)
    flat = np.array([whiten(h.data, h.covariance, y) for y in x])
    np.testing.assert_allclose(weighted, flat @ flat.T, rtol=1e-9, atol=1e-6)


def test_evidence_does_not_depend_on_the_basis(fresh_seed: int) -> None:
    """A rotation of a form's coefficients leaves their prior as it is, and so their evidence."""
    h = _car(_cubic)
    form = linear_forms(h)["sided"]
    rotation = np.linalg.qr(np.random.default_rng(fresh_seed).normal(size=(len(form.columns),) * 2))[0]
    turned = FreeForm("sided", np.tensordot(rotation, form.columns, 1))
    one, other = explained(h, form), explained(h, turned)
    assert other.nats == pytest.approx(one.nats, abs=1e-6)
    np.testing.assert_allclose(other.coefficients, rotation @ one.coefficients, atol=1e-6)


def test_what_the_parameters_already_do_gains_nothing() -> None:
    """A form in the span of the Jacobian: its coefficient and the gain's own share what little is left. The gain's sd
    is 0.5; with another 0.35 beside it, the prior is wider, and the posterior as narrow."""
    h = _car(_lags)
    again = FreeForm("gain", slopes_of(h)[h.free.index("K_L")][None])
    found = explained(h, again)
    wider = 0.5 * math.log(1.0 + (0.35 / 0.5) ** 2)
    assert found.nats == pytest.approx(-wider, abs=0.2)  # what the prior's mean is away from the fit


def test_residual_is_what_the_coefficients_leave() -> None:
    h = _car(_cubic)
    form = linear_forms(h)["map"]
    found = explained(h, form)
    assert found.residual is not None
    rest = h.residual - found.residual - np.tensordot(found.coefficients, form.columns, 1)
    flat = rest.ravel()
    basis = slopes_of(h).reshape(len(h.free), -1)
    left = flat - basis.T @ np.linalg.lstsq(basis.T, flat, rcond=None)[0]
    assert np.linalg.norm(left) < 1e-6 * np.linalg.norm(flat)


def test_what_dynamics_leave_is_left_by_a_car_within_its_limits() -> None:
    """Far from a fit the response is no straight line in its parameters: the moved car's own response counts."""
    h = _car(_lags)
    moves = np.array([-3.0 if name == "T_L" else 0.01 for name in h.free])
    there = _moved(h, moves)
    assert there["T_L"] == h.limits("T_L")[0]
    np.testing.assert_allclose([there[n] - h[n] for n in h.free if n != "T_L"], 0.01)
    np.testing.assert_allclose(there.residual, h.data.measured - there.response())
    form = linear_forms(h)["linear"]
    found = explained(h, form)
    assert found.residual is not None
    left = log_likelihood(h.data, found.residual)[0] - h.log_likelihood
    assert found.nats <= left - 0.5 * float(found.coefficients @ found.coefficients) / COEFFICIENT_SD**2 + 1e-6


@pytest.mark.parametrize("lag", [-3.0, -0.2, 0.6])
def test_what_only_a_straight_line_promises_is_no_gain(lag: float) -> None:
    """A course is found with parameters that move along straight lines, and counts where they put the car."""
    h = _car(_lags)
    moves = np.array([lag if name == "T_L" else 0.0 for name in h.free])
    linear = h.residual - np.tensordot(moves, slopes_of(h), 1)
    left, over = _bent(h, moves, np.zeros_like(h.residual), linear)
    car = _moved(h, moves)
    np.testing.assert_allclose(left, h.data.measured - car.response())
    assert over == pytest.approx(max(log_likelihood(h.data, linear)[0] - car.log_likelihood, 0.0))


def test_a_frame_that_is_late_is_simulated_so() -> None:
    """Delays of whole steps of the grid, of which each frame has its own: the response, not its slope times them."""
    h = _car(_lags)
    late = np.where(np.arange(h.data.frame_count) % 2 == 0, 0.3, -0.2)
    change = _delayed(h, late)
    for first, delay in enumerate((0.3, -0.2)):
        there = h.copy()
        for channel in h.data.channels:
            there[f"{channel}_delay"] += delay
        np.testing.assert_allclose(change[:, first::2], (there.response() - h.predicted)[:, first::2], atol=1e-12)


@pytest.mark.parametrize("channels", [("accel", "speed"), ("speed",), ("accel",)], ids="+".join)
def test_nothing_is_found_where_nothing_is_missing(channels: tuple[str, ...]) -> None:
    """Every coefficient that could be seen and is not there costs its logarithm of how well it was seen."""
    h = _car(_lags, channels)
    forms = linear_forms(h)
    assert set(forms) == ({"linear", "sided", "map"} if "speed" in channels else {"linear", "sided"})
    fits = [explained(h, f) for f in [*forms.values(), mirror_columns(h)]]
    fits += wandering(h).values()
    if len(channels) == 2:
        fits += [explained_or_late(h, sensor_form(h)), *(roughness(h, form) for form in SIGNS)]
    assert max(f.nats for f in fits) < 0.0


@pytest.mark.parametrize(
    ("response", "family"),
    [(_cubic, "map"), (_weaker_drive, "map"), (_slower_drive, "sided"), (_two_lags, "linear")],
    ids=["cubic", "weaker drive", "slower drive", "two lags"],
)
def test_the_family_of_the_cause_gains_most(response: Force, family: str) -> None:
    """The gain of one side is a map, its lag is not. Gains are hundreds of nats."""
    h = _car(response)
    nats = {name: explained(h, form).nats for name, form in linear_forms(h).items()}
    nats |= {name: found.nats for name, found in wandering(h).items()}
    assert max(nats, key=lambda name: nats[name]) == family
    assert nats[family] > 20.0


def test_brakes_that_pulse_are_a_force_while_braking() -> None:
    """Two fifths of the force go and come back 1.7 times a second, a random force of a tenth of it about that line."""
    h = _car(_pulsing_brakes)
    found = {form: roughness(h, form) for form in SIGNS}
    assert found["rough_braking"].nats > 20.0
    assert found["rough_driving"].nats < 0.0
    at = int(np.searchsorted(h.data.frequency[h.data.band_edges[1:-1]], 1.7))
    assert found["rough_braking"].coefficients[at - 1 : at + 2].max() >= 0.12
    # what it is expected to have done is in the frames that brake
    done = np.sum((h.residual - found["rough_braking"].residual) ** 2, axis=(0, 2))
    braked = demand_response(h, np.minimum(h.command(), 0.0)[None], np.array([LAG]))[0, 0]
    assert np.corrcoef(done, np.sum(braked**2, axis=-1))[0, 1] > 0.5


def test_no_name_describes_what_chance_does() -> None:
    """A biased accelerometer and brakes that pulse about their mean were one unknown cause."""
    log = _drive(_uneven_brakes, bias=0.3)
    found = infer(DriveData.of(log), effects=("sensor_bias", "dead_time")).average
    assert found.label == "sensor_bias"
    assert found.parts["rough_braking"] > 0.5


def test_dynamics_of_one_reading_are_the_sensors() -> None:
    """A recorder's filter is below 50 ms; both channels of the car share its own lag."""
    data = _car(_lags).data
    h = _fitted(data.with_accel(_lagged(data.accel)))
    assert explained(h, sensor_form(h)).nats > explained(h, linear_forms(h)["linear"]).nats + 20.0


@pytest.mark.parametrize("form", ["linear", "sided"])
def test_an_answer_before_the_command_is_the_mirrors(form: str) -> None:
    h = _car(_foreseeing if form == "linear" else _foreseeing_drive)
    assert explained(h, mirror_columns(h, form)).nats > explained(h, linear_forms(h)[form]).nats + 20.0


@pytest.mark.parametrize(
    ("response", "kind", "size"),
    [(_wandering_gain, "gain", 0.25), (_wandering_brakes, "braking", 0.25), (_wandering_delay, "delay", 0.1)],
    ids=["gain", "brakes", "delay"],
)
def test_a_course_that_wanders_is_found_again(response: Force, kind: str, size: float) -> None:
    """Its course is a sine of 60 s in frames of 5 s. The frames' overlap smooths a few per cent away; the prior pulls
    frames in which the command hardly moves to 0, up to a quarter of the whole in some drives."""
    h = _car(response)
    found = wandering(h)
    assert found[kind].nats > 20.0
    assert max(found, key=lambda k: found[k].nats) == kind
    course = found[kind].coefficients
    assert course.sum() == pytest.approx(0.0, abs=1e-9)
    truth = size * np.sin(2 * np.pi * h.data.frame_time / 60.0)
    truth -= truth.mean()
    assert np.corrcoef(course, truth)[0, 1] > 0.95
    assert np.std(course) == pytest.approx(np.std(truth), rel=0.3)
