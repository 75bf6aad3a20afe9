"""SGLD compared with quadrature and NUTS on many windows, and a verdict that includes its own Monte Carlo error."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from avtorch.display import Card, Displayed, Frame
from avtorch.display.progress import called, shows_progress
from avtorch.errors import InputError
from avtorch.inference.arviz_export import shown_unit
from avtorch.inference.map import find_mode
from avtorch.inference.posterior import Posterior
from avtorch.inference.quadrature import Quadrature
from avtorch.inference.sampler import sample
from avtorch.inference.sampler_settings import SamplerSettings
from avtorch.io.log import LogSource, as_log
from avtorch.validation.agreement import Agreement, AgreementVerdict, agreement, agreement_verdict, between
from avtorch.validation.reference import (
    LATENT_NUTS,
    LATENT_NUTS_WINDOWS,
    NUTS_WINDOWS,
    NutsSettings,
    exact_draws,
    reference,
    select,
    walk_nuts,
)
from avtorch.validation.stein import Stein, stein_discrepancy
from avtorch.validation.windows import Windows, windows_of_log

if TYPE_CHECKING:
    from arviz import InferenceData

Progress = Callable[[float, float], None]

#: Weight of a window of NUTS in the progress; one of SGLD and quadrature has weight one.
NUTS_SHARE = 20


@dataclass(frozen=True, repr=False)
class Validation(Displayed):
    """The result of `validate`; W windows and P parameters, named by ``windows.names``.

    Attributes:
        windows: the windows validated.
        settings: of SGLD.
        seed: of everything random.
        reference: "quadrature", or "nuts" where quadrature cannot be (more than three parameters).
        sgld: draws ``(chain, draw, W, P)`` in the parameters' own units.
        quadrature: of all windows (marginals `nodes`, `mass` ``(W, P, node)``, over log parameters), or None.
        nuts: draws ``(chain, draw, M, P)`` of the M windows named by ``nuts_index`` ``(M,)``.
        nuts_index: see there.
        compared: which windows ``agreement`` is over, indices ``(C,)``: all, or ``nuts_index`` where NUTS is the
            reference.
        agreement: SGLD against the reference, ``(C, P)`` each.
        nuts_agreement: NUTS against quadrature, ``(M, P)`` each, or None.
        sgld_nuts: SGLD against NUTS, ``(M, P)`` each.
        stein: kernel Stein discrepancy of SGLD, its null and p-value, ``(W,)`` each.
        seconds: per window, by method: "sgld", "nuts", "quadrature" (0 where it was not run).
        verdict: see `AgreementVerdict`.

    Example:
        >>> from avtorch.inference import SamplerSettings
        >>> from avtorch.validation import NutsSettings, synthetic_windows, validate
        >>> quick = dict(settings=SamplerSettings(chains=64), nuts=NutsSettings(1, 20, 10), nuts_windows=1)
        >>> found = validate(synthetic_windows(1, seed=1), **quick)
        >>> found.reference, tuple(found.agreement.sd_ratio.shape), sorted(found.seconds)
        ('quadrature', (1, 3), ['nuts', 'quadrature', 'sgld'])
    """

    windows: Windows
    settings: SamplerSettings
    seed: int
    reference: str
    sgld: Posterior
    quadrature: Quadrature | None
    nuts: Posterior
    nuts_index: Tensor
    compared: Tensor
    agreement: Agreement
    nuts_agreement: Agreement | None
    sgld_nuts: Agreement
    stein: Stein
    seconds: dict[str, float]
    verdict: AgreementVerdict

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.windows.names

    def overview(self) -> Card:
        """The verdict, and how far SGLD lies from the reference."""
        word = "agrees" if self.verdict.agree else "disagrees"
        count = f"{len(self.windows)} window{'' if len(self.windows) == 1 else 's'}"
        title = f"Validation of SGLD on {count} of {self.windows.name}: it {word}"
        return Card(title, (f"{self.verdict.why} Against {self.reference}:",), self.summary())

    def summary(self) -> Frame:
        """A row a parameter: over the windows compared, the 95 % quantile of the distance of the means [SD of the
        reference], the range of the ratio of SDs that holds 95 %, the largest R-hat and the median ESS."""
        found = self.agreement
        return Frame(
            {
                "parameter": list(self.names),
                "unit": [shown_unit(name) for name in self.names],
                "mean_difference_sd_p95": found.mean_difference.abs().nanquantile(0.95, 0).tolist(),
                "sd_ratio_p025": found.sd_ratio.nanquantile(0.025, 0).tolist(),
                "sd_ratio_p975": found.sd_ratio.nanquantile(0.975, 0).tolist(),
                "rhat_max": found.rhat.nan_to_num(nan=-math.inf).amax(0).tolist(),
                "ess_bulk_median": found.ess_bulk.nanquantile(0.5, 0).tolist(),
            }
        )

    def coverage(self, level: float = 0.9) -> dict[str, Tensor]:
        """Coverage of the central interval of SGLD, ``(P,)`` each.

        Where the truth is known: shares of windows whose interval covers it, for "sgld" and, on the same windows,
        "quadrature" (synthetic vehicles are not drawn from the prior, so neither need be ``level``). Otherwise "sgld"
        is the mean mass of the reference inside SGLD's interval.
        """
        tail = (1 - level) / 2
        low, high = self.sgld.quantile(tail), self.sgld.quantile(1 - tail)
        truth = self.windows.truth
        if truth is not None:
            found = {"sgld": ((low <= truth) & (truth <= high)).double().mean(0)}
            if self.quadrature is not None:
                exact = self.quadrature.quantile(tail), self.quadrature.quantile(1 - tail)
                found["quadrature"] = ((exact[0] <= truth) & (truth <= exact[1])).double().mean(0)
            return found
        if self.quadrature is not None:
            return {"sgld": (self.quadrature.cdf(high) - self.quadrature.cdf(low)).nan_to_num(nan=0.0).mean(0)}
        flat = self.nuts.flat
        inside = (low[self.nuts_index] <= flat) & (flat <= high[self.nuts_index])
        return {"sgld": inside.double().mean((0, 1))}

    def quadrature_draws(self, index: Tensor | None = None, *, chains: int = 4, draws: int = 500) -> Posterior | None:
        """Independent draws of the joint posterior (see `exact_draws`), of all windows or those named by ``index``;
        None where quadrature was not run."""
        if self.quadrature is None:
            return None
        density = self.windows.density if index is None else self.windows.select(index).density
        return exact_draws(density, chains=chains, draws=draws, generator=torch.Generator().manual_seed(self.seed))

    def to_arviz(self) -> dict[str, InferenceData]:
        """The draws of "sgld", "nuts" and, where it was run, "quadrature" (as independent draws) for ArviZ."""
        found = {"sgld": self.sgld.to_arviz(), "nuts": self.nuts.to_arviz()}
        named = {"window": self.nuts_index.numpy()}
        found["nuts"].assign_coords(named, inplace=True)  # pyright: ignore[reportCallIssue]
        exact = self.quadrature_draws()
        if exact is not None:
            found["quadrature"] = exact.to_arviz()
        return found


def check_installed() -> None:
    """Raises `InputError` where ArviZ or Pyro is missing."""
    missing = [name for name, module in (("arviz", "arviz"), ("pyro-ppl", "pyro")) if find_spec(module) is None]
    if missing:
        verb = "are" if len(missing) > 1 else "is"
        raise InputError(f"{', '.join(missing)}: {verb} not installed; needs pip install 'avtorch[validate]'")


@shows_progress
def validate(
    log: LogSource | Windows,
    *,
    window: float = 2.0,
    windows: int | None = None,
    settings: SamplerSettings | None = None,
    nuts_windows: int | None = None,
    nuts: NutsSettings | None = None,
    seed: int = 0,
    progress: Progress | bool | None = None,
) -> Validation:
    """SGLD, quadrature and NUTS over the same windows, each under the first prior and on its own.

    Args:
        log: a log (a `Log`, a path or a data frame), or windows made by `synthetic_windows` and its like.
        window: length of a log's windows [s].
        windows: at most so many windows of a log, evenly spread; all by default.
        settings: of SGLD; by default those that every command uses for the form.
        nuts_windows: on how many windows, evenly spread, NUTS is run: three, or one in the latent form, where it costs
            minutes.
        nuts: its chains and draws; by default those of `NutsSettings`, and fewer in the latent form.
        progress: called with (done, of); or True for a bar, False for none, None for a bar in a notebook only.

    Raises `InputError` if ArviZ or Pyro is missing, for ``nuts_windows`` below 1, or for a log that cannot be used.

    Example:
        >>> from avtorch.inference import SamplerSettings
        >>> from avtorch.validation import NutsSettings, synthetic_windows, validate
        >>> quick = dict(settings=SamplerSettings(chains=64), nuts=NutsSettings(1, 20, 10), nuts_windows=1)
        >>> found = validate(synthetic_windows(1, seed=1), **quick)  # too few draws for a verdict; the defaults suffice
        >>> found.names, bool((found.agreement.mean_difference.abs() < 0.5).all())
        (('T_L', 'K_L', 'sigma'), True)
    """
    check_installed()
    if nuts_windows is not None and nuts_windows < 1:
        raise InputError(f"nuts_windows: found {nuts_windows}, needs 1 or more")
    source = log if isinstance(log, Windows) else windows_of_log(as_log(log), window=window, count=windows)
    settings = source.sampler if settings is None else settings
    if settings.chains == 1 and settings.draws < 8:
        raise InputError(f"draws: found {settings.draws} of a single chain, needs 8 or more")
    latent = source.form == "latent"
    nuts = (LATENT_NUTS if latent else NutsSettings()) if nuts is None else nuts
    if nuts_windows is None:
        nuts_windows = LATENT_NUTS_WINDOWS if latent else NUTS_WINDOWS
    chosen = torch.linspace(0, len(source) - 1, min(nuts_windows, len(source))).round().long()
    count = _ProgressCount(called(progress), len(source) + NUTS_SHARE * len(chosen))
    generator = torch.Generator().manual_seed(seed)
    begun = clock.perf_counter()
    sgld = sample(source.density, settings, generator=generator)  # search for the mode included
    sgld_s = clock.perf_counter() - begun
    count.add(0.3 * len(source))
    begun = clock.perf_counter()
    quadrature = reference(source, done=lambda: count.add(0.5)) if len(source.names) <= 3 else None
    quadrature_s = 0.0 if quadrature is None else clock.perf_counter() - begun
    mode = find_mode(source.density)
    stein = stein_discrepancy(source.density, sgld.draws.log(), mode=mode, generator=generator)
    count.add((0.2 if quadrature is not None else 0.7) * len(source))
    begun = clock.perf_counter()
    walked = walk_nuts(source, chosen, nuts, seed=seed, done=lambda: count.add(NUTS_SHARE))
    seconds = {
        "sgld": sgld_s / len(source),
        "nuts": (clock.perf_counter() - begun) / len(chosen),
        "quadrature": quadrature_s / len(source),
    }
    sgld_nuts = between(_of_windows(sgld, chosen), walked)
    if quadrature is None:
        compared, found, against = chosen, sgld_nuts, None
        converged = sgld.converged[chosen] & walked.converged
    else:
        compared, found = torch.arange(len(source)), agreement(sgld, quadrature)
        against = agreement(walked, select(quadrature, chosen))
        converged = sgld.converged & quadrature.converged
    held_to = "nuts" if quadrature is None else "quadrature"
    verdict = agreement_verdict(found, converged, reference=held_to, numbers=compared.tolist(), nuts=against)
    return Validation(
        windows=source,
        settings=settings,
        seed=seed,
        reference=held_to,
        sgld=sgld,
        quadrature=quadrature,
        nuts=walked,
        nuts_index=chosen,
        compared=compared,
        agreement=found,
        nuts_agreement=against,
        sgld_nuts=sgld_nuts,
        stein=stein,
        seconds=seconds,
        verdict=verdict,
    )


@dataclass
class _ProgressCount:
    """Progress so far."""

    progress: Progress | None
    total: float
    done: float = 0.0

    def add(self, amount: float) -> None:
        self.done += amount
        if self.progress is not None:
            self.progress(self.done, self.total)


def _of_windows(posterior: Posterior, index: Tensor) -> Posterior:
    why = tuple(posterior.why[i] for i in index.tolist()) if posterior.why else ()
    return Posterior(posterior.names, posterior.draws[:, :, index], posterior.converged[index], why)
