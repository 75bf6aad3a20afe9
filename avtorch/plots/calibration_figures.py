"""The picture of a calibration: do posteriors cover the truths as often as stated?"""

from __future__ import annotations

from matplotlib.figure import Figure

from avtorch.plots.ranks import ecdf_difference, ecdf_of, rank_plot
from avtorch.plots.style import BLACK, short, styled
from avtorch.validation.calibration import RankCalibration
from avtorch.validation.uniformity import ecdf_band

#: Points at which the coverage is compared with the level.
POINTS = 100


@styled
def calibration_figure(calibration: RankCalibration, *, title: str = "") -> Figure:
    """Simulation-based calibration, a row a quantity: histogram of ranks, ECDF difference, coverage of intervals.

    Example:
        >>> import torch
        >>> from avtorch.plots import calibration_figure
        >>> from avtorch.validation.calibration import RankCalibration
        >>> g, names = torch.Generator().manual_seed(0), ("T_L", "K_L")
        >>> ranks, below = torch.randint(0, 100, (200, 2), generator=g), torch.rand(200, 2, generator=g)
        >>> figure = calibration_figure(RankCalibration(names, ranks, 99, below.double(), dropped=0))
        >>> len(figure.axes)  # a row each of histogram, ECDF difference and coverage
        6
    """
    names = calibration.names
    counts, ecdf, band = calibration.counts(20), calibration.ecdf, calibration.ecdf_band()
    # a central interval of level c holds the truth where this is at most c
    central, central_band = (2 * calibration.below - 1).abs(), ecdf_band(calibration.replications, POINTS - 1)
    p_values = calibration.p_values
    figure = Figure(figsize=(10.8, 1.75 * len(names) + 1.1), layout="constrained")
    axes = figure.subplots(len(names), 3, squeeze=False, sharex=True)
    for i, (name, (left, centre, right)) in enumerate(zip(names, axes, strict=True)):
        rank_plot(left, {"": counts[i].numpy()})
        left.set_title(short(name))
        ecdf_difference(centre, {"": ecdf[i].numpy()}, band)
        subtitle = f"ECDF: p = {float(p_values['ecdf'][i]):.2g}, spread: p = {float(p_values['dispersion'][i]):.2g}"
        centre.set_title(subtitle, fontsize=9, fontweight="normal")
        ecdf_difference(right, {"": ecdf_of(central[:, i].numpy(), POINTS)}, central_band)
        held = [(level, 100 * float(share[i])) for level, share in calibration.coverage.items()]
        right.set_title(
            ", ".join(f"{100 * level:.0f} %: {share:.1f}" for level, share in held),
            fontsize=9,
            fontweight="normal",
        )
        for level, share in held:
            right.plot(level, share / 100 - level, "o", color=BLACK, markersize=4, zorder=3)
        centre.set_ylabel("ECDF diff. [-]")
        right.set_ylabel("coverage diff. [-]")
    for ax, label in zip(
        axes[-1], ("rank of the truth / draws [-]",) * 2 + ("level of the interval [-]",), strict=True
    ):
        ax.set_xlabel(label)
    dropped = f", {calibration.dropped} dropped" if calibration.dropped else ""
    figure.suptitle(
        f"{title + ': ' if title else ''}{calibration.replications} replications{dropped}; grey: 95 % bands of uniform"
        " ranks, each for its whole panel",
        fontsize=10,
        color=BLACK,
    )
    return figure
