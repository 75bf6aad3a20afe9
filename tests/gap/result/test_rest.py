"""What the error that is left is said to be."""

from __future__ import annotations

from avtorch.gap.quantity import Quantity
from avtorch.gap.result.budget import Unexplained


def rest(q05: float, q95: float) -> str:
    share = Quantity(0.0, 0.0, 0.0, 0.0)
    return Unexplained(share, material=False, still=Quantity(q05, 0.0, q05, q95)).rest(0.03)


def test_it_is_noise_only_where_no_black_box_could_take_off_what_matters() -> None:
    assert rest(0.0, 0.02) == "noise"
    assert rest(0.12, 0.3) == "noise but for 12 to 30 %, which a black box may still foretell"
    assert rest(0.0, 0.3).startswith("noise but for 0 to 30 %")
    # a log that bounds it from below alone, or not at all
    assert rest(0.03, 1.0) == "noise but for 3 % or more, which a black box may still foretell"
    assert rest(0.0, 1.0).endswith("this log cannot tell")
