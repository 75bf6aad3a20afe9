r"""What a small change of the demanded acceleration would gain, row by row: the matched filter for pulses of the drive.

Lost messages and gear shifts change the demand by w (row,) [m/s²] for a moment. The channels answer linearly,
y_c = d_c h * w: h is the actuator (held rows, lag, second pole, dead time), d_c what channel c makes of an acceleration
(difference of speeds, its recorder's delay and filter). With the noise S of a hypothesis given, log L changes by

    log L(w) - log L(0) = s' w - 1/2 w' A w,    s = h' sum_c d_c' (S^-1 R)_c,    A_ij = rho(|i - j|),

s (row,) being the score, the gradient of log L in the demand of every row, and A the information, which is Toeplitz as
the noise is stationary: rho is the inverse cosine transform of |h(f)|² d(f)* S(f)^-1 d(f) (Turin 1960; Kay, Detection
Theory, 1998, ch. 4). Where frames begin and end it is D A D, D (row,) being what they
see. A pulse of L rows costs L products for s' w and L² / 2 for w' A w, and no simulation. Frequencies above `claim_hz`
have no weight.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.fft import irfft, rfft, rfftfreq
from scipy.ndimage import maximum_filter1d

from avtorch.arrays import FloatArray, IntArray
from avtorch.gap.engine.coordinates import INDEX
from avtorch.gap.engine.drive_data import DriveData, one_pole
from avtorch.gap.engine.hypothesis import Hypothesis

ComplexArray = np.typing.NDArray[np.complex128]


def coordinate_from_start(h: Hypothesis, name: str) -> float:
    """The value of a coordinate that acts in the whole drive; 0 for one that sets in later."""
    i = INDEX[name]
    return float(h.values[i]) if h.onset_vector()[i] <= h.data.time[0] else 0.0


def actuator_transfer(h: Hypothesis, frequency: FloatArray, *, dead_time: bool = True) -> ComplexArray:
    """Acceleration [m/s²] per demand [m/s²] held over each row, (frequency,).

    `dead_time`: whether the hypothesis's dead time delays it (not so for what interrupts the drive itself).
    """
    omega = 2 * np.pi * frequency
    delay = 0.5 * h.data.dt + (coordinate_from_start(h, "dead_time") if dead_time else 0.0)
    lag = float(h.values[INDEX["T_L"]])
    poles = 1 + 1j * omega * lag - omega**2 * coordinate_from_start(h, "square_period")
    return np.sinc(frequency * h.data.dt) * np.exp(-1j * omega * delay) / poles


def channel_transfer(h: Hypothesis, frequency: FloatArray) -> ComplexArray:
    """What each channel shows of an acceleration [m/s² per m/s²], (channel, frequency)."""
    data, values = h.data, h.values
    omega = 2 * np.pi * frequency
    shown = []
    for channel in data.channels:
        delay, pole = (float(values[INDEX[f"{channel}_{part}"]]) for part in ("delay", "filter"))
        if channel == "accel":
            delay += data.align_s
            gain = (1 + coordinate_from_start(h, "sensor_scale")) / (
                1 + 1j * omega * coordinate_from_start(h, "sensor_lag")
            )
        else:  # the central difference of a speed that the recorder may hold for some rows
            delay += 0.5 * (data.hold - 1) * data.dt
            gain = np.sinc(2 * frequency * data.dt) / (1 + 1j * omega * coordinate_from_start(h, "speed_lag"))
        keep, new, old = one_pole(max(pole, 1e-4), np.array(data.dt))
        row = np.exp(-1j * omega * data.dt)
        shown.append(gain * np.exp(-1j * omega * delay) * (new + old * row) / (1 - keep * row))
    return np.array(shown)


def precision(data: DriveData, covariance: FloatArray) -> FloatArray:
    """Inverse (bin, channel, channel) of the noise's `covariance` (band, channel, channel), 0 above `claim_hz`."""
    inverse = np.linalg.inv(covariance)
    inverse[data.frequency[data.band_edges[:-1]] > data.claim_hz] = 0.0
    return np.asarray(inverse[data.band_of_bin], np.float64)


def demand_score(h: Hypothesis, covariance: FloatArray, x: FloatArray, *, dead_time: bool = True) -> FloatArray:
    """Inner products (..., row) of coefficients `x` (..., channel, frame, bin) with the response to one row's demand.

    For a residual it is the gradient of log L [nats per m/s²]. `covariance` (band, channel, channel): the noise.
    """
    data = h.data
    weights = precision(data, covariance)
    columns = x.reshape(-1, *x.shape[-3:])
    out = np.empty((len(columns), len(data.time)))
    rows = [[data.adjoint(w) for w in weighted(weights, column)] for column in columns]
    for i, j in zip(data.bounds[:-1], data.bounds[1:], strict=True):
        n = 1 << int(j - i + data.warm_rows).bit_length()  # room for what the filters pull across an end
        frequency: FloatArray = rfftfreq(n, data.dt).astype(np.float64)
        back = np.conj(actuator_transfer(h, frequency, dead_time=dead_time) * channel_transfer(h, frequency))
        for k, channels in enumerate(rows):
            spectrum = np.sum([b * rfft(r[i:j], n) for b, r in zip(back, channels, strict=True)], axis=0)
            out[k, i:j] = irfft(spectrum, n)[: j - i]
    return out.reshape(*x.shape[:-3], -1)


def weighted(weights: FloatArray, x: FloatArray) -> FloatArray:
    """S^-1 x, (channel, frame, bin)."""
    return np.array([sum(weights[:, i, j] * x[j] for j in range(len(x))) for i in range(len(x))])


def demand_information(h: Hypothesis, covariance: FloatArray, lags: int, *, dead_time: bool = True) -> FloatArray:
    """rho (lag,): information of two rows' demands at a distance of 0 to `lags` - 1 rows [nats per (m/s²)²].

    It is periodic beyond a frame, so `lags` is at most the frame's rows.
    """
    data = h.data
    frequency = data.frequency
    shown = actuator_transfer(h, frequency, dead_time=dead_time) * channel_transfer(h, frequency)
    power = np.einsum("if,fij,jf->f", shown.conj(), precision(data, covariance), shown).real
    count = min(lags, data.frame_rows)
    used = power > 0.0
    phase = 2 * np.pi * data.dt * np.outer(np.arange(count), frequency[used])
    return np.cos(phase) @ power[used] / data.frame_rows


def information_of_coefficients(
    data: DriveData, covariance: FloatArray, columns: FloatArray, residual: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Information (column, column) of coefficients of `columns` (column, channel, frame, bin), and their score
    (column,) for a `residual` (channel, frame, bin), in the bands that count here."""
    weights = precision(data, covariance)
    used = int(np.count_nonzero(weights[:, 0, 0]))
    in_noise = np.array([weighted(weights[:used], c[..., :used]).ravel() for c in columns])
    flat = columns[..., :used].reshape(len(columns), -1)
    return flat @ in_noise.T, in_noise @ residual[..., :used].ravel()


def frame_cover(h: Hypothesis) -> FloatArray:
    """How much of a row's response the frames see, (row,) from 0 to 1: D in D A D, the information at their ends.

    The response to a row's demand lasts three lags; where frames see it best counts, so that no gain is overstated.
    """
    data = h.data
    window, M = data.window**2, data.frame_rows
    seen, k = np.zeros(len(data.time)), 0
    for first, count in data.frames:
        for i in range(first, first + count * M, M):
            if data.used[k]:
                seen[i : i + 2 * M] += window
            k += 1
    lasts = response_rows(h)
    ahead = np.append(seen, np.zeros(lasts))
    best = maximum_filter1d(ahead, lasts + 1, origin=-((lasts + 1) // 2))[: len(seen)]
    return np.sqrt(np.minimum(best, 1.0))


def response_rows(h: Hypothesis) -> int:
    """Rows for which the response to one row's demand lasts: the dead time and three lags."""
    return round((3 * h["T_L"] + coordinate_from_start(h, "dead_time")) / h.data.dt)


@njit(cache=True, fastmath=True, error_model="numpy")
def take_out(
    score: FloatArray, information: FloatArray, cover: FloatArray, rows: IntArray, pulse: FloatArray, sign: float
) -> None:
    """`score` -= sign D A D w for a change w that is a `pulse` (element,) in `rows` (element,): the score beside it, in
    place. `information` (lag,), `cover` (row,)."""
    n, reach = len(score), len(information)
    for k in range(len(rows)):
        at = rows[k]
        if pulse[k] == 0.0:
            continue
        w = sign * pulse[k] * cover[at]
        for i in range(max(0, at - reach + 1), at):
            score[i] -= w * cover[i] * information[at - i]
        for i in range(at, min(n, at + reach)):
            score[i] -= w * cover[i] * information[i - at]


@njit(cache=True, fastmath=True, error_model="numpy")
def pulse_energy(information: FloatArray, cover: FloatArray, rows: IntArray, pulse: FloatArray) -> float:
    """w' D A D w of such a change, whose `rows` (element,) are in order of time, but for pulses that overlap."""
    total, reach = 0.0, len(information)
    for k in range(len(rows)):
        w = pulse[k] * cover[rows[k]]
        total += w * w * information[0]
        for j in range(k + 1, len(rows)):
            lag = rows[j] - rows[k]
            if lag >= reach:
                break
            total += 2.0 * w * pulse[j] * cover[rows[j]] * information[abs(lag)]
    return total
