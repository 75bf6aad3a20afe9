"""The compiled loops' own random numbers and exponential."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from tests.bars import BAR
from tests.inference.compiled_cases import walk_noise

kernels = pytest.importorskip("avtorch.inference.kernels", exc_type=ImportError)


def test_philox_gives_the_words_of_its_authors():
    """The known answers of Random123 for Philox 4x32-10."""
    full = 0xFFFFFFFF
    known = [
        ((0, 0, 0, 0, 0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
        ((full,) * 6, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
        (
            (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344, 0xA4093822, 0x299F31D0),
            (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
        ),
    ]
    for given, expected in known:
        assert kernels.philox(*(np.uint64(x) for x in given)) == expected


def test_the_exponential_is_exact_to_two_units():
    @kernels.njit
    def each(x, out):
        for i in range(len(x)):
            out[i] = kernels.exp(x[i])

    x = np.concatenate([np.linspace(-700, 700, 20_001), np.linspace(-1, 1, 20_001), [np.nan]])
    out = np.empty_like(x)
    each(x, out)
    exact = np.exp(x[:-1])
    assert np.all(np.abs(out[:-1] - exact) <= 2 * np.spacing(exact))
    assert np.isnan(out[-1])


@pytest.mark.statistical
def test_the_noise_is_normal_and_independent(rotating_seed, draws_factor):
    """Moments, distribution, and correlations between parameters, windows, chains and steps, also of squares."""
    out = np.empty((40, 3, 5, 320 * draws_factor))
    walk_noise(kernels, out, np.uint64(rotating_seed % 2**32), np.uint64(1))
    n = out.size
    for power, (mean, variance) in {1: (0, 1), 2: (1, 2), 3: (0, 15), 4: (3, 96)}.items():
        assert abs((out**power).mean() - mean) < BAR * (variance / n) ** 0.5
    assert stats.kstest(out.ravel(), "norm").pvalue > 2 * stats.norm.sf(BAR)
    for axis in range(4):
        first, second = (np.take(out, range(start, out.shape[axis] - 1 + start), axis) for start in (0, 1))
        assert abs((first * second).mean()) < BAR / first.size**0.5
        assert abs(((first**2 - 1) * (second**2 - 1)).mean()) < BAR * 2 / first.size**0.5
