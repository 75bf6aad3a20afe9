"""Pictures: drawings that take an axes and return it, and the figures that the commands write."""

from avtorch.plots.figures import (
    belief_figure,
    motion_figure,
    overview_figure,
    probability_figure,
    region_figure,
    stability_figure,
)
from avtorch.plots.over_plane import gain_curve, region, setting_region, verdict_legend, verdict_map
from avtorch.plots.over_time import belief_band, data_quality, events, motion, string_probability
from avtorch.plots.style import STYLE, save

__all__ = [
    "STYLE",
    "belief_band",
    "belief_figure",
    "data_quality",
    "events",
    "gain_curve",
    "motion",
    "motion_figure",
    "overview_figure",
    "probability_figure",
    "region",
    "region_figure",
    "save",
    "setting_region",
    "stability_figure",
    "string_probability",
    "verdict_legend",
    "verdict_map",
]
