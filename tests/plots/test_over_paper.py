"""The pictures of the paper's experiments."""

from __future__ import annotations

import pytest

from avtorch.paper import Leaders, reproduce
from avtorch.plots import paper_pictures


@pytest.mark.slow
def test_every_experiment_has_a_picture() -> None:
    found = reproduce(["regions", "estimation", "monitoring", "gains"], leaders=Leaders.read(), seeds=2).found
    pictures = paper_pictures(found)
    assert list(pictures) == ["regions.png", "estimation.png", "monitoring.png", "gains.png"]
    for draw in pictures.values():
        figure = draw()
        figure.draw_without_rendering()
        assert all(ax.has_data() for ax in figure.axes)
