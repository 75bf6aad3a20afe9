"""Effects in front of recordings: sizes, intervals and counts, of budgets made by hand."""

from __future__ import annotations

from typing import Any

import pytest

from avtorch.gap.quantity import Quantity
from avtorch.gap.result.budget import Budget, ChancePart, Part, Unexplained
from benchmarks.blindtest import IN_FRONT
from benchmarks.blindtest.intervals import counted
from benchmarks.budget_cells import causes
from benchmarks.effects_in_front import HEADER, InFront, Size, closing, compared, in_front
from tests.gap.engine.recorded import recorded_log

HALF = Quantity(0.5, 0.1, 0.4, 0.6)


def made(*parts: Part, chance: tuple[ChancePart, ...] = (), T_L: float = 0.3, K_L: float = 1.0) -> Budget:
    """A budget of these parts."""
    unexplained = Unexplained(Quantity(0.0, 0.0, 0.0, 0.0), material=False)
    repaired = {"T_L": Quantity(T_L, 0.01, T_L - 0.02, T_L + 0.02), "K_L": Quantity(K_L, 0.01, K_L - 0.02, K_L + 0.02)}
    return Budget(2.0, 1.0, {}, parts, unexplained, repaired, chance)


def part(name: str, **sizes: tuple[float, float, float]) -> Part:
    """A part with these parameters, each as mean and ends of its interval."""
    told = {key: Quantity(mean, 0.1, low, high) for key, (mean, low, high) in sizes.items()}
    return Part(name, (name,), 0.9, HALF, 1.0, told)


def test_a_size_is_what_comes_on_top_of_the_untouched_recordings() -> None:
    late = made(part("dead_time", delay_s=(0.4, 0.35, 0.45)))
    raw = compared(late, "dead_time", {"delay_s": 0.3}, None)
    assert raw is not None
    assert (raw.ratio, raw.holds, raw.right) == (pytest.approx(4 / 3), False, False)
    own = compared(late, "dead_time", {"delay_s": 0.3}, 0.12)
    assert own is not None
    assert (own.ratio, own.holds, own.right) == (pytest.approx(0.28 / 0.3), True, True)


@pytest.mark.parametrize(
    ("effect", "key", "found", "put_in", "before", "ratio"),
    [
        ("gain_change", "gain_ratio", (0.63, 0.55, 0.72), 0.7, 0.9, 1.0),  # factors multiply
        ("speed_dependent_gain", "gain_slope", (-0.5, -0.6, -0.4), -0.55, None, 0.5 / 0.55),
        ("road_grade", "grade_rms", (0.05, 0.04, 0.06), 0.04, 0.03, 1.0),  # independent courses add in squares
        ("saturation", "accel_max_mps2", (1.0, 0.9, 1.1), 2.0, 1.0, 1.0),  # the stricter one is seen
    ],
)
def test_factors_squares_signs_and_limits(
    effect: str, key: str, found: tuple[float, float, float], put_in: float, before: float | None, ratio: float
) -> None:
    size = compared(made(part(effect, **{key: found})), effect, {key: put_in}, before)
    assert size is not None
    assert (size.ratio, size.holds) == (pytest.approx(ratio), True)


def test_an_interval_that_reaches_a_factor_of_nothing_holds_nothing() -> None:
    size = compared(made(part("gain_change", gain_ratio=(0.3, -0.1, 0.7))), "gain_change", {"gain_ratio": 0.7}, None)
    assert size is not None
    assert not size.holds


def test_what_is_not_named_has_no_size() -> None:
    assert compared(made(), "dead_time", {"delay_s": 0.3}, None) is None


def row(effect: str, **said: Any) -> InFront:
    given: dict[str, Any] = {"put_in": {"delay_s": 0.24}, "named": False, "alias": False, "size": None, "same": None}
    given |= {"others": (), "nothing": False, "budget": "none", "excited": 30.0}
    return InFront(effect, **(given | said))


def test_the_closing_lines_count_with_intervals() -> None:
    rows = [
        row("dead_time", named=True, size=Size(1.3, False), same=Size(1.0, True)),
        row("dead_band", named=True, size=Size(0.9, True), same=Size(0.8, False), others=("gust",)),
        row("road_grade", alias=True, others=("gust",), excited=float("nan")),
        row("saturation", nothing=True, excited=4.0),
    ]
    assert closing(rows) == [
        "named 2 of 4 (18 to 82 %), of what it excites 2 of 3 (25 to 92 %), with aliases 3 of 4 (36 to 94 %); "
        "with others 2 of 4 (18 to 82 %); "
        "none or unknown 1 of 4 (6 to 64 %)",
        "sizes within 25 % 1 of 2 (12 to 88 %), beside the same effects 2 of 2 (43 to 100 %)",
        "intervals that hold 1 of 2 (12 to 88 %), beside the same effects 1 of 2 (12 to 88 %)",
    ]
    assert counted(0, 0) == "0 of 0"


def test_a_row_has_a_cell_for_each_column() -> None:
    whole = row("dead_time", named=True, size=Size(1.3, False), same=Size(1.0, True), budget="dead_time 100%: 0.3")
    assert str(whole) == ("| dead_time (0.24) | 30 | named | 1.30 | no | 1.00 | yes |  | dead_time 100%: 0.3 |")
    width = HEADER.splitlines()[0].count("|")
    assert str(whole).count("|") == str(row("saturation")).count("|") == width


def test_causes_are_told_with_shares_and_intervals() -> None:
    found = made(part("dead_time", delay_s=(0.3, 0.25, 0.35)), chance=(ChancePart("gust", 0.8),))
    assert causes(found) == "dead_time 50%: 0.3 (0.25 to 0.35); gust, by chance"
    assert causes(made()) == "none"


@pytest.mark.slow
def test_a_log_is_answered_with_an_effect_in_front_of_it(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("benchmarks.effects_in_front.IN_FRONT", {"sensor_bias": IN_FRONT["sensor_bias"]})
    in_front(recorded_log(), 1.0)
    untouched, row, *counts = capsys.readouterr().out.splitlines()[2:]
    assert untouched.startswith("| untouched |")
    assert row.startswith("| sensor_bias (")
    assert float(row.split("|")[2]) > 100.0  # a quarter of the reading's spread, for a minute
    assert row.split("|")[3].strip() == "named"
    assert counts[0].startswith("named 1 of 1")
