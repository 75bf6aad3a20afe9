"""Signatures: drawn for every effect, and each shows a gap."""

from __future__ import annotations

import matplotlib as mpl
import pytest

mpl.use("Agg")
import matplotlib.pyplot as plt

from avtorch.gap import EFFECTS, Effect
from avtorch.plots.signatures import effect_signature, signature_figure, standard_response


@pytest.mark.parametrize(
    "cls", [c for c in EFFECTS.values() if c.__module__.startswith("avtorch")], ids=lambda c: c.name
)
def test_every_effect_has_a_signature(cls: type[Effect]) -> None:
    effect = cls(change_s=9.0) if cls.name == "gain_change" else cls()
    shown = "speed_measured" if cls.reading == "speed" else "accel_measured"
    with_it, neutral, without = (getattr(standard_response(e), shown) for e in (effect, cls.neutral(), None))
    assert float((with_it - without).abs().max()) > 0.005
    assert float((neutral - without).abs().max()) < 1e-12


def test_drawing_takes_an_axes() -> None:
    figure, ax = plt.subplots()
    assert effect_signature(ax, EFFECTS["dead_time"]()) is ax
    assert "gap × 1" in [t.get_text() for t in ax.texts]
    plt.close(figure)


@pytest.mark.slow
def test_overview_shows_all() -> None:
    figure = signature_figure()
    titles = {ax.get_title("left") or ax.get_title() for ax in figure.axes}
    assert {name.replace("_", " ") for name in EFFECTS} <= titles
    plt.close(figure)
