r"""Slow random forces: process noise, gusts and roads, told apart by the spectrum that both channels share.

Below `SLOW_HZ` a force on the body shows in the acceleration and in the differenced speed alike, sensors' noise does
not. In band b of the lapped transform the residuals of the two channels are Gaussian with the covariance

    V_b = P_b 1 1' + diag(a_b, c_b),        P_b = int G_b(f) S(f) df,

where S is the one-sided spectrum of the common force, G_b what the transform makes of a tone, and the variances a_b,
c_b of the sensors are free. Spectra compete:

    process noise    2 q^2 |H(f)|^2,  H = (x j w + T) / (1 - x w^2 + T j w)    white jerk, pulled back by the actuator
    gust             4 s^2 tau / (1 + (w tau)^2)                               Ornstein-Uhlenbeck (Dryden, MIL-F-8785C)
    road             flat below v / L, then nothing                            a grade of a longest wavelength L

S_b n_b is Wishart distributed (Anderson 2003, ch. 7). For a given P_b the sensors' variances at the maximum are the
root of a cubic (`wishart_profile`), so a grid over sizes and times costs a few milliseconds. Process noise is always
there: a gust or a road counts by what it gains over it.

With one channel nothing is common: what exceeds the noise of a smooth sensor is the force. An accelerometer fixed to
the car (`accel_kind` "specific-force") does not feel gravity: there a road is in the speed alone, and is what exceeds
the noise of a smooth sensor in it,

    V_b = P_b 1 1' + diag(a_b, R_b + c f_b²),

R_b the road's power, c that of the speed's white noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np
from numba import njit

from avtorch.arrays import FloatArray
from avtorch.gap.engine.coordinates import INDEX
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.likelihood import band_covariance
from avtorch.gap.engine.priors import BAND_RATIO, ONSET_ODDS
from avtorch.gap.engine.pulling_lags import PullingLags

# priors: log-normal, by mean and standard deviation of the logarithm
PROCESS_NOISE = (0.03, 0.8)
"""Size q of white jerk [m/s³/√Hz]: 0.1 m/s³ over a row of 0.1 s, and rough roads (SPEC: 0.1, rough 0.3 m/s³)."""
GUST_SD_MPS2 = (0.2, 0.9)
"""Size of a gust [m/s²]: a wind that varies by 3 m/s around 20 m/s of airspeed, on a car; lorries feel more."""
GUST_TIME_S = (2.3, 0.6)
"""Correlation time of a gust [s]: eddies of 50 m at 20 m/s."""
ROAD_SD_MPS2 = (0.25, 0.9)
"""Size of what a grade does [m/s²]: 2.5 % root mean square, as on hilly roads."""
ROAD_LENGTH_M = (450.0, 0.6)
"""Shortest wavelength of a grade [m]: vertical curves are built to be seen ahead over (AASHTO sight distances)."""

CYCLE_SD_MPS2 = GUST_SD_MPS2
"""Size of a cycle [m/s²]: as that of a gust."""
CYCLE_WIDTH = 0.05
"""Standard deviation of its frequency over its mean [-]: half a band, so that no line falls between two."""

# grids: wide enough for three standard deviations of the priors, ratios of 1.3 to 1.5
PROCESS_NOISE_GRID = np.geomspace(0.004, 0.6, 20)
_GRID_RATIO = float(PROCESS_NOISE_GRID[1] / PROCESS_NOISE_GRID[0])
PROCESS_NOISE_STEPS = (0, 2, 4, 7, 10)
"""Steps of its grid by which process noise may be smaller beside a gust or a road than alone."""
SIZE_GRID_MPS2 = np.geomspace(0.02, 0.8, 16)
GUST_TIME_GRID_S = np.array([0.7, 1.0, 1.5, 2.2, 3.2, 4.7, 7.0])
ROAD_LENGTH_GRID_M = np.array([180.0, 280.0, 420.0, 650.0, 1000.0])
CYCLE_HZ = (0.2, 1.9)
"""Frequencies of cycles [Hz], in half bands: at 20 m/s a road has slower ones, of waves of 100 m and more."""
SENSORS = [INDEX["sensor_lag"], INDEX["speed_lag"], INDEX["sensor_scale"]]
"""Coordinates of readings that show late, or larger, what pushes the car."""
ONSET_SHARES = (0.12, 0.85)
"""Shares of a drive's frames between which a gust may set in: both parts show what they hold."""

ROAD_STEEPNESS = 8
"""Order of the end of a road's spectrum [-]: steep, like that of a curve with continuous curvature."""
SENSOR_ALONE_HZ = 0.5
"""With one channel, frequency above which the least of its spectrum is the sensor's own noise [Hz]."""

_SENSOR_FLOOR = 1e-4  # least variance of a sensor, relative to the residual's: rounding, no sensor is as good
_POWER_FLOOR = 1e-12  # (m/s²)²: keeps covariances regular where there is no force


@dataclass(frozen=True, eq=False)
class SlowForces:
    """Slow forces in a residual, at the maximum over their grids.

    `log_likelihood` [nats] of process noise alone, its prior included, over the lowest `bands` bands; `gust`, `road`
    [nats]: what either gains over it, the difference of priors included. `process_noise` [m/s³/√Hz] alone; `gust_sd`,
    `road_sd` [m/s²]; `gust_time` [s]; `road_length` [m]: the best of each grid.

    `cycle` [nats], its `cycle_sd` [m/s²] and `cycle_hz`: likewise; no nats where it was not asked for.

    `process_power`, `process_power_beside_road` (band,) [(m/s²)²] at the best gust and road; `covariance`
    (band, channel, channel) and `counts` (band,) are what was explained; `sensor` (channel, frame, band): factors by
    which a residual becomes that before a sensor that lags or has another scale.
    """

    log_likelihood: float
    bands: int
    process_noise: float
    process_noise_beside_gust: float
    process_noise_beside_road: float
    gust: float
    gust_sd: float
    gust_time: float
    road: float
    road_sd: float
    road_length: float
    process_power: FloatArray = field(repr=False)
    process_power_beside_road: FloatArray = field(repr=False)
    covariance: FloatArray = field(repr=False)
    counts: FloatArray = field(repr=False)
    sensor: FloatArray = field(repr=False)
    cycle: float = -math.inf
    cycle_sd: float = 0.0
    cycle_hz: float = 0.0
    process_noise_beside_cycle: float = 0.0


# spectra --------------------------------------------------------------------------------------------------------------
def process_spectrum(frequency: FloatArray, lag: float | FloatArray, square_period: float = 0.0) -> FloatArray:
    """One-sided spectrum (..., tone) [(m/s²)²/Hz] of unit white jerk behind an actuator of this `lag` [s] (...,) and
    `square_period` [s²], that of its second pole."""
    w = 2 * np.pi * frequency
    T = np.asarray(lag, float)[..., None]
    H = (1j * w * square_period + T) / (1 - square_period * w * w + 1j * w * T)
    return 2 * np.abs(H) ** 2


def gust_spectrum(frequency: FloatArray, time: float | FloatArray) -> FloatArray:
    """One-sided spectrum (..., tone) [1/Hz] of an Ornstein-Uhlenbeck process of variance 1 and this correlation time
    [s] (...,)."""
    tau = np.asarray(time, float)[..., None]
    return 4 * tau / (1 + (2 * np.pi * frequency * tau) ** 2)


def cycle_spectrum(frequency: FloatArray, line: float | FloatArray) -> FloatArray:
    """One-sided spectrum (..., tone) [1/Hz] of variance 1 about a `line` [Hz] (...,), normal with `CYCLE_WIDTH`."""
    at = np.asarray(line, float)[..., None]
    width = CYCLE_WIDTH * at
    return np.asarray(np.exp(-0.5 * ((frequency - at) / width) ** 2) / (math.sqrt(2 * math.pi) * width), float)


def road_spectrum(frequency: FloatArray, corner: float | FloatArray) -> FloatArray:
    """One-sided spectrum (..., tone) [1/Hz] of variance 1, flat below `corner` [Hz] (...,)."""
    end = np.asarray(corner, float)[..., None]
    width = math.pi / ROAD_STEEPNESS / math.sin(math.pi / ROAD_STEEPNESS)  # over which a flat spectrum has variance 1
    return 1 / (1 + (frequency / end) ** ROAD_STEEPNESS) / (width * end)


# likelihoods of a common power ----------------------------------------------------------------------------------------
def wishart_log_likelihood(
    covariance: FloatArray, counts: FloatArray, power: FloatArray, variances: FloatArray
) -> FloatArray:
    """Nats (..., band) of a common `power` (..., band) beside sensors of these `variances` (..., band, 2).

    `covariance` (..., band, 2, 2) is of `counts` (..., band) coefficients; its own entropy and constants are left out.
    """
    a, c = variances[..., 0], variances[..., 1]
    determinant = a * c + power * (a + c)
    trace = covariance[..., 0, 0] * (c + power) + covariance[..., 1, 1] * (a + power)
    trace = (trace - 2 * covariance[..., 0, 1] * power) / determinant
    return -0.5 * counts * (np.log(determinant) + trace)


def wishart_profile(covariance: FloatArray, counts: FloatArray, power: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Nats (..., band) of a common `power` (..., band) at the best sensors, and their variances (..., band, 2).

    `covariance` S (band, 2, 2) of `counts` (band,) coefficients. At the maximum V = P 1 1' + diag(a, c) has a zero
    diagonal of V^-1 (V - S) V^-1, which holds where a + P = k s_00 and c + P = k s_11 with

        s_00 s_11 (k³ - k²) + (2 P s_01 - P²) k - P² = 0.

    Where that needs a negative variance, one sensor is nearly perfect, and the other's variance has a closed form.
    """
    flat = np.ascontiguousarray(np.reshape(power, (-1, power.shape[-1])), float)
    nats, variances = _profile(np.ascontiguousarray(covariance), np.asarray(counts, float), flat)
    return nats.reshape(power.shape), variances.reshape(*power.shape, 2)


@njit(cache=True, error_model="numpy")
def _profile(covariance: FloatArray, counts: FloatArray, power: FloatArray) -> tuple[FloatArray, FloatArray]:
    nats, variances = np.empty(power.shape), np.empty((*power.shape, 2))
    for b in range(power.shape[1]):
        s00, s11 = max(covariance[b, 0, 0], _POWER_FLOOR), max(covariance[b, 1, 1], _POWER_FLOOR)
        s01, mean = covariance[b, 0, 1], math.sqrt(s00 * s11)
        least0, least1 = _SENSOR_FLOOR * s00, _SENSOR_FLOOR * s11
        for i in range(power.shape[0]):
            P = max(power[i, b], _POWER_FLOOR)
            p, r = P / mean, s01 / mean
            best, a, c = math.inf, least0, least1
            # only channels that are nearly one (r > 0.96) have two maxima: the cubic's largest root and its least
            for start in (1 + max(p - r, 0.0), p):
                k = _root(p, r, start)
                if k * s00 - P >= least0 and k * s11 - P >= least1:
                    cost = _cost(s00, s11, s01, P, k * s00 - P, k * s11 - P)
                    if cost < best:
                        best, a, c = cost, k * s00 - P, k * s11 - P
                if r < 0.96:
                    break
            if best == math.inf or r >= 0.96:  # one sensor perfect: regression on it leaves the variance of the other
                on0, on1 = P / (least0 + P), P / (least1 + P)
                rest1 = max(s11 - 2 * on0 * s01 + on0 * on0 * s00 - on0 * least0, least1)
                rest0 = max(s00 - 2 * on1 * s01 + on1 * on1 * s11 - on1 * least1, least0)
                cost = _cost(s00, s11, s01, P, least0, rest1)
                if cost < best:
                    best, a, c = cost, least0, rest1
                cost = _cost(s00, s11, s01, P, rest0, least1)
                if cost < best:
                    best, a, c = cost, rest0, least1
            nats[i, b] = -0.5 * counts[b] * best
            variances[i, b, 0], variances[i, b, 1] = a, c
    return nats, variances


@njit(cache=True, error_model="numpy")
def _root(p: float, r: float, k: float) -> float:
    """Root of k³ - k² + (2 p r - p²) k - p² by Newton's method from `k`.

    1 + max(p - r, 0), an upper bound, leads down to the largest root, p up to the least. Where a step fails, bisection.
    """
    low, high = 0.0, 1 + max(p - r, 0.0)
    for _ in range(60):
        value = ((k - 1) * k + 2 * p * r - p * p) * k - p * p
        gradient = (3 * k - 2) * k + 2 * p * r - p * p
        # nats are flat at their maximum, so that half of the digits are enough
        if abs(value) <= 1e-8 * k * abs(gradient):
            break
        if value > 0:
            high = k
        else:
            low = k
        k = k - value / gradient if gradient != 0 else low
        if not low < k < high:
            k = 0.5 * (low + high)
    return k


@njit(cache=True, error_model="numpy")
def _cost(s00: float, s11: float, s01: float, P: float, a: float, c: float) -> float:
    """log det V + tr V^-1 S."""
    determinant = a * c + P * (a + c)
    return math.log(determinant) + (s00 * (c + P) + s11 * (a + P) - 2 * s01 * P) / determinant


# the forces -----------------------------------------------------------------------------------------------------------
def sensors_by_frame(h: Hypothesis) -> FloatArray:
    """Lags of the accelerometer and of the speed [s], and what the former's scale is off, (3, frame)."""
    acts = h.data.frame_time >= h.onset_vector()[SENSORS, None]
    return np.where(acts, h.values[SENSORS, None], h.neutral[SENSORS, None])


def slow_forces(
    data: DriveData,
    residual: FloatArray,
    values: FloatArray,
    given: tuple[FloatArray, FloatArray] | None = None,
    lags: PullingLags | None = None,
    *,
    sensors: FloatArray | None = None,
    cycle: bool = False,
) -> SlowForces:
    """Process noise, gust and road in `residual` (channel, frame, bin) of a hypothesis with `values` (parameter,).

    With `cycle`, a cycle too. `sensors` (3, frame), see `sensors_by_frame`: those of `values` where not given.

    `given`: covariance (band, channel, channel) and counts (band,) in place of the residual's; bands beyond `SLOW_HZ`
    are ignored. `lags`, see `pulling_lags`: the likeliest counts; T_L where not given. A gust or a road stands beside
    process noise of that lag, or of the one that the response prefers.
    """
    frequency, energy = data.band_response
    bands = len(energy)
    sensor = _before_the_sensor(data, values[SENSORS, None] if sensors is None else sensors, bands)
    covariance, counts = band_covariance(data, _before(data, residual, sensor))[:bands], data.band_size
    if given is not None:
        less, counts = given[0][:bands] - band_covariance(data, residual)[:bands], given[1]
        covariance = covariance + less * np.einsum("ifb,jfb->bij", sensor, sensor) / data.frame_count
    covariance, counts = np.ascontiguousarray(covariance), np.asarray(counts[:bands], float)

    def nats(force: FloatArray, road: FloatArray | float = 0.0) -> FloatArray:
        """(...,) of powers (..., band) of a force and of a road."""
        if data.channel_count == 1:
            return _one_channel(data, covariance[:, 0, 0], counts, force + road).sum(-1)
        if data.accel_kind == "specific-force":
            return _road_in_the_speed(data, covariance, counts, force, road).sum(-1)
        return wishart_profile(covariance, counts, force + road)[0].sum(-1)

    lag, lost = lags or PullingLags(values[INDEX["T_L"]][None], np.zeros(1))
    spectra = process_spectrum(frequency, lag)
    if values[INDEX["square_period"]] > 0:  # a second pole is passed by what disturbs the actuator, not the body
        spectra = np.concatenate([spectra, process_spectrum(frequency, lag, values[INDEX["square_period"]])])
        lost = np.concatenate([lost, lost])
    unit = spectra @ energy.T
    coarse = nats(PROCESS_NOISE_GRID[:, None] ** 2 * unit[:, None]) + _log_normal(PROCESS_NOISE_GRID, PROCESS_NOISE)
    coarse += lost[:, None]  # (lag, size)

    def alone(i: int) -> tuple[float, float]:
        """Nats of process noise pulled back by one of the lags, and its size."""
        # long drives know the size better than the grid: what is between its points would pass for a gust
        fine = PROCESS_NOISE_GRID[coarse[i].argmax()] * np.geomspace(1 / _GRID_RATIO, _GRID_RATIO, 13)
        total = nats(fine[:, None] ** 2 * unit[i]) + _log_normal(fine, PROCESS_NOISE) + lost[i]
        return float(total.max()), float(fine[total.argmax()])

    likeliest = int(coarse.max(1).argmax())
    base, size = alone(likeliest)
    own = np.flatnonzero(lost == 0)
    chosen = sorted({likeliest, int(own[coarse[own].max(1).argmax()])})
    steps = _GRID_RATIO ** -np.array(PROCESS_NOISE_STEPS, float)
    sizes = np.concatenate([alone(i)[1] * steps for i in chosen])
    of_lag = np.repeat(chosen, len(steps))
    process, prior = sizes[:, None] ** 2 * unit[of_lag], _log_normal(sizes, PROCESS_NOISE) + lost[of_lag]

    def best(
        unit: FloatArray, sizes: tuple[float, float], shape_prior: FloatArray, *, road: bool = False
    ) -> tuple[float, tuple[int, ...]]:
        """Most nats over process noise alone, and where: of process noise, of the size, of the spectrum's shape."""
        slow, fast = SIZE_GRID_MPS2[:, None, None] ** 2 * unit, process[:, None, None]
        total = (nats(fast, slow) if road else nats(fast + slow)) + prior[:, None, None]
        total += _log_normal(SIZE_GRID_MPS2, sizes)[:, None] + shape_prior
        at = np.unravel_index(np.argmax(total), total.shape)
        return float(total[at]) - base, tuple(int(i) for i in at)

    gusts = gust_spectrum(frequency, GUST_TIME_GRID_S) @ energy.T
    gust, (g0, g1, g2) = best(gusts, GUST_SD_MPS2, _log_normal(GUST_TIME_GRID_S, GUST_TIME_S))
    roads = road_spectrum(frequency, _mean_speed(data) / ROAD_LENGTH_GRID_M) @ energy.T
    road, (r0, r1, r2) = best(roads, ROAD_SD_MPS2, _log_normal(ROAD_LENGTH_GRID_M, ROAD_LENGTH_M), road=True)
    found = SlowForces(
        log_likelihood=base,
        bands=bands,
        process_noise=size,
        process_noise_beside_gust=float(sizes[g0]),
        process_noise_beside_road=float(sizes[r0]),
        gust=gust,
        gust_sd=float(SIZE_GRID_MPS2[g1]),
        gust_time=float(GUST_TIME_GRID_S[g2]),
        road=road,
        road_sd=float(SIZE_GRID_MPS2[r1]),
        road_length=float(ROAD_LENGTH_GRID_M[r2]),
        process_power=process[g0],
        process_power_beside_road=process[r0],
        covariance=covariance,
        counts=counts,
        sensor=sensor,
    )
    if not cycle:
        return found
    lines = np.geomspace(*CYCLE_HZ, 1 + round(math.log(CYCLE_HZ[1] / CYCLE_HZ[0]) / (0.5 * math.log(BAND_RATIO))))
    cycles = cycle_spectrum(frequency, lines) @ energy.T
    prior = np.where(of_lag == of_lag[g0], prior, -np.inf)  # of the lag that `process_power` has
    # one of so many bands: two lines a band are not two
    gain, (c0, c1, c2) = best(cycles, CYCLE_SD_MPS2, np.full(len(lines), -math.log(len(lines) / 2)))
    return replace(
        found,
        cycle=gain,
        cycle_sd=float(SIZE_GRID_MPS2[c1]),
        cycle_hz=float(lines[c2]),
        process_noise_beside_cycle=float(sizes[c0]),
    )


def cycle_response(data: DriveData, residual: FloatArray, found: SlowForces) -> FloatArray:
    """What a cycle is expected to have done, given the `residual` (channel, frame, bin) of two channels; its shape."""
    frequency, energy = data.band_response
    power = found.cycle_sd**2 * (cycle_spectrum(frequency, found.cycle_hz) @ energy.T)
    process = found.process_power * (found.process_noise_beside_cycle / found.process_noise_beside_gust) ** 2
    variances = wishart_profile(found.covariance, found.counts, power + process)[1]
    noise = process[:, None, None] + np.eye(2) * variances[:, None]
    before = _before(data, residual, found.sensor)
    return _before(data, expected_force(data, before, power[None], noise), 1 / found.sensor)


def expected_force(data: DriveData, residual: FloatArray, power: FloatArray, noise: FloatArray) -> FloatArray:
    """Mean of a Gaussian force common to two channels, given a `residual` (channel, frame, bin); the same shape.

    `power` (frame or 1, band) in the lowest bands, beside `noise` (band, channel, channel): P 1 1' (P 1 1' + S)^-1 r.
    """
    edges = data.band_edges[: power.shape[1] + 1]
    V = power[..., None, None] + noise
    weight = power[..., None] * np.linalg.solve(V, np.ones((*power.shape, 2, 1)))[..., 0]  # frame, band, channel
    weight = np.broadcast_to(np.repeat(weight, np.diff(edges), axis=1), (residual.shape[1], edges[-1], 2))
    out = np.zeros_like(residual)
    out[:, :, : edges[-1]] = np.einsum("fbc,cfb->fb", weight, residual[:, :, : edges[-1]])
    return out


class SlowOnset(NamedTuple):
    """A gust or a road that sets in at `time` [s]: its `nats` over one that acts throughout, `sd` [m/s²] and `scale`, a
    gust's correlation time [s] or a road's length [m], from then on; no nats and no time (None) where it does not."""

    nats: float
    time: float | None = None
    sd: float = 0.0
    scale: float = 0.0


def slow_onset(
    data: DriveData, residual: FloatArray, found: SlowForces, kind: Literal["gust", "road"] = "gust"
) -> SlowOnset:
    """When a gust or a road sets in, if it does: between `ONSET_SHARES` of the frames, in drives of ten frames or more.

    Not asked of a road that an accelerometer does not feel. Process noise alone explains what was before, the same with
    the force what comes after; `found` of the whole drive tells only the sensors, for over both parts a gust of half
    the time passes for process noise, or this for a gust.
    """
    frames = data.frame_count
    if frames < 10 or (kind == "road" and data.accel_kind == "specific-force"):
        return SlowOnset(0.0)
    frequency, energy = data.band_response
    of_process = _log_normal(PROCESS_NOISE_GRID, PROCESS_NOISE)
    if kind == "gust":
        scales, of_size, of_scale = GUST_TIME_GRID_S, GUST_SD_MPS2, GUST_TIME_S
        spectra, best = gust_spectrum(frequency, scales), (found.gust_sd, found.gust_time)
        beside, power = found.process_noise_beside_gust, found.process_power
    else:
        scales, of_size, of_scale = ROAD_LENGTH_GRID_M, ROAD_SD_MPS2, ROAD_LENGTH_M
        spectra, best = road_spectrum(frequency, _mean_speed(data) / scales), (found.road_sd, found.road_length)
        beside, power = found.process_noise_beside_road, found.process_power_beside_road
    unit = power / beside**2
    process = PROCESS_NOISE_GRID[:, None] ** 2 * unit
    shapes = spectra @ energy.T
    force = (SIZE_GRID_MPS2[:, None, None] ** 2 * shapes).reshape(-1, found.bands)
    of_force = (_log_normal(SIZE_GRID_MPS2, of_size)[:, None] + _log_normal(scales, of_scale)).ravel()
    whole = found.covariance
    throughout = beside**2 * unit + best[0] ** 2 * shapes[int(np.abs(scales - best[1]).argmin())]
    if data.channel_count == 2:
        variances = wishart_profile(whole, found.counts, throughout)[1]
    else:
        variances = np.maximum(whole[:, 0, 0] - throughout, _SENSOR_FLOOR * whole[:, 0, 0])

    def nats(covariance: FloatArray, counts: FloatArray, power: FloatArray) -> FloatArray:
        """(...,) of powers (..., band), the sensors as they are."""
        if data.channel_count == 2:
            return wishart_log_likelihood(covariance, counts, power, variances).sum(-1)
        total = power + variances
        return (-0.5 * counts * (np.log(total) + covariance[..., 0, 0] / total)).sum(-1)

    edges = data.band_edges[: found.bands + 1]
    low = _before(data, residual, found.sensor)[:, :, : edges[-1]]
    products = np.moveaxis(np.add.reduceat(low[:, None] * low, edges[:-1], axis=-1), 2, 0)  # frame, C, C, band
    before = np.moveaxis(np.cumsum(products, axis=0), -1, 1) / np.diff(edges)[:, None, None]
    cuts = np.arange(max(int(ONSET_SHARES[0] * frames), 3), min(int(ONSET_SHARES[1] * frames), frames - 3) + 1)
    n = np.diff(edges) * cuts[:, None].astype(float)
    m = np.diff(edges) * (frames - cuts[:, None].astype(float))
    first = before[cuts - 1] / cuts[:, None, None, None]
    second = (before[-1] - before[cuts - 1]) / (frames - cuts)[:, None, None, None]
    # at each cut the process noise that the first part shows, then both together at the best cut
    calm = nats(first[:, None], n[:, None], process) + of_process
    at = calm.argmax(1)
    gains = calm.max(1) + (nats(second[:, None], m[:, None], process[at][:, None] + force) + of_force).max(1)
    cut = int(gains.argmax())
    both = calm[cut][:, None] + nats(second[cut], m[cut], process[:, None] + force) + of_force
    size, scale = np.unravel_index(int(both.max(0).argmax()), (len(SIZE_GRID_MPS2), len(scales)))
    alike = [np.array([x]) for x in (beside, *best)]
    over = float(nats(whole, found.counts, throughout)) + sum(
        float(_log_normal(x, prior)[0]) for x, prior in zip(alike, (PROCESS_NOISE, of_size, of_scale), strict=True)
    )
    gain = float(both.max()) - over + math.log(ONSET_ODDS / len(cuts))  # one of so many frames
    if gain <= 0:
        return SlowOnset(0.0)
    onset = float(data.frame_time[cuts[cut]] - 0.5 * data.hop_s)
    return SlowOnset(gain, onset, float(SIZE_GRID_MPS2[size]), float(scales[scale]))


# inside ---------------------------------------------------------------------------------------------------------------
def _mean_speed(data: DriveData) -> float:
    """[m/s] at which a road's wavelengths pass."""
    return max(float(data.smooth_speed.mean()), 2.0)


def _before_the_sensor(data: DriveData, sensors: FloatArray, bands: int) -> FloatArray:
    """Factors (channel, frame, band) of a residual: what pushes the car passes the lags and the scale of readings.

    Of a common power P the accelerometer shows P |H|², and P Re H together with the speed; for one pole of scale k,
    P k² / L and P k / L with L = 1 + (w tau)². Scaled by L / k it shows P in common with the speed, and what is out of
    phase beside its own noise. So does a speed that lags; where both do, the slower one is scaled by what it lags
    more. A reading is scaled, so that a covariance stays one.
    """
    first, last = data.band_edges[:bands], data.band_edges[1 : bands + 1] - 1
    out = np.ones((data.channel_count, data.frame_count, bands))
    if data.channel_count == 2:
        w = np.pi * (data.frequency[first] + data.frequency[last])
        lags = np.broadcast_to(sensors[:2, :, None] * w, out.shape)
        quick, slow = np.sort(1 + lags**2, axis=0)
        scales = np.array([np.sqrt(quick), slow * np.sqrt(quick) / (1 + lags.prod(0))])
        out = np.take_along_axis(scales, np.argsort(lags[..., -1:], axis=0), 0)
        out[0] /= 1 + sensors[2, :, None]
    return out


def _before(data: DriveData, residual: FloatArray, sensor: FloatArray) -> FloatArray:
    """A `residual` (channel, frame, bin) by factors (channel, frame, band) of the lowest bands; 0 above."""
    edges, out = data.band_edges[: sensor.shape[-1] + 1], np.zeros_like(residual)
    out[:, :, : edges[-1]] = residual[:, :, : edges[-1]] * np.repeat(sensor, np.diff(edges), axis=-1)
    return out


def _log_normal(x: FloatArray, prior: tuple[float, float]) -> FloatArray:
    """Log density of log x over its greatest one: on a grid the normalisation is the same for all."""
    return -0.5 * (np.log(x / prior[0]) / prior[1]) ** 2


def _one_channel(data: DriveData, variance: FloatArray, counts: FloatArray, power: FloatArray) -> FloatArray:
    """Nats (..., band) of a `power` (..., band) in one channel, beside the most noise that its sensor can have."""
    total = np.maximum(power, _POWER_FLOOR) + _smooth_sensor(data, variance)
    return -0.5 * counts * (np.log(total) + variance / total)


def _road_in_the_speed(
    data: DriveData, covariance: FloatArray, counts: FloatArray, force: FloatArray, road: FloatArray | float
) -> FloatArray:
    """Nats (..., band) of a `force` on both channels and a `road` in the speed alone, at the best variance a of the
    accelerometer: given the speed's coefficient y, the accelerometer's is N(g y, v) with g = P / (P + R + c)."""
    s00, s01, s11 = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    own = _smooth_sensor(data, np.maximum(s11 - s01, _SENSOR_FLOOR * s11))  # what the speed shares with nothing
    force = np.maximum(force, _POWER_FLOOR)
    total = force + road + own
    g = force / total
    left = s00 - 2 * g * s01 + g * g * s11
    v = np.maximum(left, force - g * force + _SENSOR_FLOOR * s00)
    return -0.5 * counts * (np.log(total) + s11 / total + np.log(v) + left / v)


def _smooth_sensor(data: DriveData, variance: FloatArray) -> FloatArray:
    """The most noise (band,) that a sensor of these variances (band,) can have.

    White noise of a speed rises with f² in its difference, that of an acceleration is flat.
    """
    f = data.frequency[data.band_edges[: len(variance)]]
    shape = f**2 if data.speed is not None else np.ones_like(f)
    fast = f > SENSOR_ALONE_HZ
    return (variance[fast] / shape[fast]).min() * shape if fast.any() else 0.0 * shape
