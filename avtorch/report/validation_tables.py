"""The numbers behind the pictures of a validation, as tables of its page."""

from __future__ import annotations

import numpy as np

from avtorch.inference.units import shown_unit
from avtorch.plots.chosen_windows import ChosenWindows
from avtorch.plots.ranks import rank_band
from avtorch.plots.validation_ranks import ecdfs_of, ranks_of
from avtorch.report.table import Table
from avtorch.validation.agreement import MEAN_TOLERANCE, SD_TOLERANCE
from avtorch.validation.validate import Validation

_MOST = 40  # rows of the table behind a picture of all windows


def tables_behind(found: Validation) -> dict[str, Table]:
    """By picture; the one of exact probabilities only where there is quadrature."""
    chosen = ChosenWindows(found)
    tables = {
        "agreement": _windows(found),
        "marginals": _marginals(chosen),
        "joint": _correlations(chosen),
        "ranks": _ranks(chosen),
    }
    if found.quadrature is not None:
        tables["ecdf"] = _ecdfs(found)
    return tables


def _windows(found: Validation) -> Table:
    """The windows farthest from the reference first, `_MOST` of them at most."""
    columns = ("window", *(f"{what}, {n}" for what in ("mean error [SD]", "SD ratio") for n in found.names))
    errors, ratios = (x.numpy() for x in (found.agreement.mean_difference, found.agreement.sd_ratio))
    far = np.nan_to_num(np.maximum(abs(errors) / MEAN_TOLERANCE, abs(ratios - 1) / SD_TOLERANCE), nan=np.inf).max(1)
    rows = tuple(
        (str(int(found.compared[i])), *(f"{x:+.3f}" for x in errors[i]), *(f"{x:.3f}" for x in ratios[i]))
        for i in np.argsort(-far, kind="stable")[:_MOST]
    )
    some = f"{len(rows)} of {len(errors)} windows" if len(rows) < len(errors) else "Windows"
    return Table(f"{some}, the farthest from the reference first", columns, rows, numeric=columns[1:])


def _marginals(chosen: ChosenWindows) -> Table:
    found = chosen.validation
    rows = []
    for window in chosen.windows:
        for i, name in enumerate(found.names):
            exact, truth = found.quadrature, chosen.truth(window, name)
            sides = (
                None if exact is None else (exact.mean[window.number, i], exact.sd[window.number, i]),
                (found.sgld.mean[window.number, i], found.sgld.sd[window.number, i]),
                None if window.nuts is None else (found.nuts.mean[window.nuts, i], found.nuts.sd[window.nuts, i]),
            )
            told = ("" if side is None else f"{float(side[0]):.4g} ± {float(side[1]):.2g}" for side in sides)
            rows.append(
                (f"{window.number}: {name} [{shown_unit(name)}]", *told, "" if truth is None else f"{truth:.4g}")
            )
    columns = ("window and parameter", "exact", "SGLD", "NUTS", "truth")
    return Table("Mean and SD", columns, tuple(rows))


def _correlations(chosen: ChosenWindows) -> Table:
    """Of T_L and K_L, by the draws."""
    found = chosen.validation
    pair = [found.names.index(name) for name in ("T_L", "K_L")]
    rows = []
    for i, window in enumerate(chosen.windows):
        drawn = [None if chosen.exact is None else chosen.exact.flat[:, i], found.sgld.flat[:, window.number]]
        drawn.append(None if window.nuts is None else found.nuts.flat[:, window.nuts])
        told = ("" if x is None else f"{np.corrcoef(x[:, pair].numpy().T)[0, 1]:+.2f}" for x in drawn)
        rows.append((str(window.number), *told))
    columns = ("window", "exact", "SGLD", "NUTS")
    return Table("Correlation of lag and gain", columns, tuple(rows), numeric=columns[1:])


def _ranks(chosen: ChosenWindows) -> Table:
    """A row a window and parameter: the bar of each group that is farthest from the count expected, and its band."""
    rows, groups = [], ()
    for row, window in enumerate(chosen.windows):
        for name, ranks in zip(chosen.validation.names, ranks_of(chosen, row), strict=True):
            groups, outside, cells = tuple(ranks.counts), 0, []
            for group, (low, high) in rank_band(ranks.counts, effective=ranks.effective).items():
                count = ranks.counts[group]
                off = count * len(count) / count.sum() - 1
                outside += int(((off < low) | (off > high)).sum())
                cells.append(f"{100 * off[abs(off).argmax()]:+.0f} (±{50 * (high - low):.0f})")
            rows.append((f"{window.number}: {name}", *cells, str(outside)))
    columns = ("window and parameter", *groups, "bars outside")
    return Table("Farthest bar and half width of its band [%]", columns, tuple(rows), numeric=columns[1:])


def _ecdfs(found: Validation) -> Table:
    rows = []
    for arm in ecdfs_of(found):
        far = abs(arm.less_uniform).max(-1)
        for name, inside, reach in zip(found.names, arm.inside, far, strict=True):
            where = (f"{reach.max():.3f}", str(int(arm.windows[reach.argmax()]))) if len(reach) else ("", "")
            rows.append((f"{arm.method}: {name}", str(len(inside)), str(inside.sum()), *where))
    columns = ("method and parameter", "windows", "inside their band", "farthest from uniform", "in window")
    return Table("Windows within their 95 % bands", columns, tuple(rows), numeric=columns[1:])
