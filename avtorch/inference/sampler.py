"""Algorithm 1 of the paper: walk with SGLD, drop the burn-in, collect the rest; chains and windows in one tensor."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.optim import Optimizer

from avtorch.arrays import Bool, Float
from avtorch.errors import InputError
from avtorch.inference.compiled import compiled_form, compiled_walk
from avtorch.inference.coordinates import Coordinates, stiffness
from avtorch.inference.density import Density, SubsampledDensity, constrained, has_selection, score_of, selected
from avtorch.inference.device import check_generator
from avtorch.inference.exactness import CACHED, Exactness, Moments, compare_with_exact
from avtorch.inference.map import Mode, find_mode
from avtorch.inference.posterior import Posterior
from avtorch.inference.sampler_settings import SamplerSettings
from avtorch.inference.sgld import SGLD

#: Chains times windows sampled at once: enough to make the cost of a call negligible, few enough for the processor's
#: cache.
BLOCK = 2**15
#: The same on a graphics card, which a thousand windows keep half as long as with the processor's two numbers.
CARD_BLOCK = 2**20
#: Chains times windows below which the calls alone determine the cost of a step, here and on a card.
FEW, CARD_FEW = 2**11, 2**16

#: A window stiffer than this is whitened afresh by a pilot walk.
UNEVEN = 16.0
#: How many times as many steps the pilot gets.
PILOT = 8.0
#: A window stiffer than this has not mixed: even the longest burn-in is shorter than its relaxation time.
STUCK = 256.0
#: Largest slope that a burn-in step follows, in whitened coordinates; within the posterior slopes are a few units.
TAMED = 10.0


def sample(
    density: Density,
    settings: SamplerSettings | None = None,
    *,
    generator: torch.Generator | None = None,
    mode: Mode | None = None,
    rhat_max: float = 1.1,
) -> Posterior:
    """Draws from the posterior of every window (Algorithm 1).

    A window whose chains leave the finite numbers or the posterior, end with a nested R-hat above ``rhat_max``, or do
    not follow the exact density in mean, SD and tails (:mod:`avtorch.inference.exactness`), is sampled again, with half
    the step and, up to ``longest``, twice the steps; one that never settles, or for which the comparison is
    inconclusive, is returned with ``converged`` false and the reason in ``why``.

    `density`: the target. `mode`: its mode and curvature, if known.

    Example:
        >>> import torch
        >>> from avtorch.inference import integrate, sample
        >>> from avtorch.validation import synthetic_windows
        >>> density = synthetic_windows(2, seed=1).density
        >>> posterior = sample(density, generator=torch.Generator().manual_seed(0))
        >>> exact = integrate(density, nodes=25)
        >>> posterior.converged.tolist(), bool(((posterior.mean - exact.mean).abs() < 0.1 * exact.sd).all())
        ([True, True], True)
    """
    settings = SamplerSettings() if settings is None else settings
    mode = find_mode(density) if mode is None else mode
    check_generator(generator, mode.z.device)
    mode, slowdown = _adapted(density, mode, settings, generator)
    # all draws of a parameter of a window behind one another, as its summaries read them
    draws = mode.z.new_empty(*mode.z.shape, settings.chains, settings.draws).permute(2, 3, 0, 1)
    diverged, unmixed, stuck = (torch.zeros_like(mode.converged) for _ in range(3))
    found = Exactness.unknown(mode.z)
    # chains that agree still differ by chance: eight groups cut into halves of this many draws each
    members = max(1, settings.chains // 8) * (settings.draws // 2)
    limit = (rhat_max**2 + 4 / members) ** 0.5
    open_ = torch.arange(density.windows, device=mode.z.device)
    for attempt in range(settings.attempts):
        for index in _batches(density, open_, slowdown, settings.chains):
            part, where = selected(density, index), mode.select(index)
            times = float(_longer(slowdown[index]).amax())
            coordinates, w = _walk(part, where, settings.slower(times), slowdown[index], generator)
            fresh = torch.isin(index, open_)
            new = index[fresh]
            z = coordinates.z(w).transpose(0, 1)
            moments = Moments.of(z)
            diverged[new] = _diverged(part, where, coordinates.z(_furthest(w)))[fresh]
            unmixed[new] = ~(moments.rhat.amax(-1) <= limit)[fresh]  # NaN counts as not converged
            stuck[new] = (slowdown[new] > STUCK) | _too_wide(where, settings, slowdown[index], times)[fresh]
            values = constrained(density, z)
            draws[:, :, new] = values if len(new) == len(index) else values[:, :, fresh]
            if settings.compare:
                total = settings.chains * settings.draws
                found = found.put(index, compare_with_exact(part, moments, total), fresh)
        slowdown = 2 * slowdown
        again = diverged | unmixed
        if settings.compare:
            # a second run may reach what the first did not; where it changed nothing, half the step will not either
            again |= ~found.holds if attempt == 0 else ~(found.holds | found.hopeless)
        open_ = again.nonzero().squeeze(-1)
        if not len(open_):
            break
    off = found.why(density.names) if settings.compare else [""] * density.windows
    flags = zip(mode.converged.tolist(), diverged.tolist(), unmixed.tolist(), stuck.tolist(), off, strict=True)
    why = tuple(_why(*flag) for flag in flags)
    converged = torch.tensor([not reason for reason in why], device=mode.z.device)
    return Posterior(density.names, draws, converged, why, found if settings.compare else None)


def _adapted(
    density: Density, mode: Mode, settings: SamplerSettings, generator: torch.Generator | None
) -> tuple[Mode, Tensor]:
    """Whitening and stiffness of every window.

    Where the Laplace covariance at the mode fits badly (one window in three hundred), a pilot walk's mean and
    covariance take its place if they are less stiff.
    """
    coordinates = Coordinates.of(mode, settings.whitening)
    slowdown = stiffness(density, coordinates)
    uneven = (slowdown > UNEVEN).nonzero().squeeze(-1)
    if settings.whitening != "full" or not len(uneven):
        return mode, slowdown
    fitted, fitted_slowdown = mode, slowdown.clone()
    for index in _batches(density, uneven, slowdown, settings.chains):
        part, where = selected(density, index), mode.select(index)
        # a rough covariance will do
        coordinates, w = _walk(part, where, settings.slower(PILOT), slowdown[index], generator)
        better = where.refitted(coordinates.z(w).flatten(0, 1))
        quicker = stiffness(part, Coordinates.of(better))
        fitted = fitted.replaced(index, better, quicker < slowdown[index])
        fitted_slowdown[index] = torch.minimum(quicker, slowdown[index])
    return fitted, fitted_slowdown


def _why(mode_found: bool, diverged: bool, unmixed: bool, stuck: bool, off: str) -> str:
    if not mode_found:
        return "the search for the posterior's mode did not end at a maximum"
    if stuck:
        return "the posterior is so uneven that the longest chain would not cross it"
    if diverged:
        return "chains left the posterior, also with the shortest step tried"
    return "chains disagree, also with the shortest step tried" if unmixed else off


def _too_wide(
    mode: Mode, settings: SamplerSettings, slowdown: Float[Tensor, " window"], times: float
) -> Bool[Tensor, " window"]:
    """Where the burn-in is too short for the widest direction of a space left unwhitened, ``(window,)`` bool.

    Along a direction of SD ``s`` a step forgets ``h/(2 s^2)`` of what was; chains that begin at the mode reach 99 % of
    an SD after two such times. They agree with each other all the while, so R-hat does not detect it.
    """
    if settings.whitening == "full":
        return torch.zeros_like(slowdown, dtype=torch.bool)
    widest = Coordinates.of(mode, settings.whitening).widest(mode)
    return settings.slower(times).burn_in < 2 * (2 / settings.step) * slowdown * widest.square()


def _longer(slowdown: Float[Tensor, "*window"]) -> Float[Tensor, "*window"]:
    """Factor of steps for a window of this slowdown: the nearest of 1, sqrt 2, 2, ... 64."""
    return 2.0 ** (0.5 * (2 * slowdown.log2()).round().clamp(0, 12))


def _batches(density: Density, index: Tensor, slowdown: Tensor, chains: int) -> list[Tensor]:
    """Windows to sample together: with equal numbers of steps, and not too many windows at once."""
    if not has_selection(density):
        return [torch.arange(density.windows, device=index.device)]
    block, enough = (CARD_BLOCK, CARD_FEW) if index.is_cuda else (BLOCK, FEW)
    size = max(1, block // chains)
    times = _longer(slowdown[index])
    batches, few = [], index[:0]
    for each in times.unique():
        few = torch.cat([few, index[times == each]])
        # a handful of windows costs less in the next batch, with its shorter steps, than in one of their own
        if len(few) * chains >= enough or each == times.max():
            # in their own order: a batch of all windows needs no indexing
            batches += few.sort().values.split(size)
            few = index[:0]
    return batches


def _furthest(w: Float[Tensor, "draw chain window d"]) -> Float[Tensor, "window d"]:
    """The draw of each window that is furthest from ``w = 0``, one that is no number if there is any."""
    planes = w.permute(2, 3, 0, 1).flatten(2)
    size = len(planes) if w.is_cuda else max(1, CACHED // planes[0].numel())
    # a NaN is the largest
    at = torch.cat([part.square().sum(1).argmax(-1) for part in planes.split(size)])
    return planes[torch.arange(len(planes), device=w.device), :, at]


def _diverged(
    density: Density, mode: Mode, far: Float[Tensor, "window d"], depth: float = 50.0
) -> Bool[Tensor, " window"]:
    """Where the furthest draw ``far`` lies ``depth`` nats and one a parameter off the mode, ``(window,)`` bool.

    R-hat alone does not detect a few diverging chains: they increase the variance within as much as that between. A
    draw of a normal lies ``chi^2/2`` nats deep: among ten thousand in three dimensions none beyond 20.
    """
    with torch.no_grad():
        return ~((mode.log_prob - density.log_prob(far)).abs() <= depth + far.shape[-1])


def walk(
    density: Density,
    mode: Mode,
    settings: SamplerSettings,
    *,
    slowdown: Float[Tensor, " window"] | None = None,
    generator: torch.Generator | None = None,
) -> Float[Tensor, "chain draw window d"]:
    """One run of Algorithm 1 in the whitened coordinates, with step ``settings.step / slowdown``.

    ``slowdown``, ``(window,)``, is the :func:`stiffness` by default. Returns draws of ``z``,
    ``(chain, draw, window, d)``.
    """
    slowdown = stiffness(density, Coordinates.of(mode, settings.whitening)) if slowdown is None else slowdown
    coordinates, w = _walk(density, mode, settings, slowdown, generator)
    return coordinates.z(w).transpose(0, 1)


def _walk(
    density: Density, mode: Mode, settings: SamplerSettings, slowdown: Tensor, generator: torch.Generator | None
) -> tuple[Coordinates, Tensor]:
    """Draws ``(draw, chain, window, d)`` in the coordinates returned with them.

    In memory they are parameter by parameter and window by window, as arithmetic is quickest.
    """
    # each window's own step is folded into its scale
    coordinates = Coordinates.of(mode, settings.whitening).slowed(slowdown)
    windows, d = mode.z.shape
    start = mode.z.new_zeros(d, windows, settings.chains)
    w = start.permute(2, 1, 0)
    if settings.spread > 0:
        normal = torch.randn(w.shape, dtype=w.dtype, device=w.device, generator=generator)
        w += settings.spread * slowdown.sqrt()[:, None] * normal
    form = compiled_form(density, settings)
    if form is not None:
        kept = compiled_walk(form, coordinates, start, settings, TAMED, generator)
        return coordinates, kept.permute(2, 3, 1, 0)
    w.requires_grad_()
    if settings.optimizer is None:
        options = {"noise": settings.noise, "noise_dtype": torch.float32}
        optimizer: Optimizer = SGLD([w], settings.step, generator=generator, **options)
    else:
        optimizer = settings.optimizer([w], settings.step, generator)
    scheduler = None if settings.schedule is None else settings.schedule(optimizer)
    state = w.detach()
    graph = any(group.get("preconditioner") for group in optimizer.param_groups)
    kept = start.new_empty(d, windows, settings.draws, settings.chains).permute(2, 3, 1, 0)

    def closure() -> Tensor | None:
        if graph:  # differentiates the potential itself, and again
            return -_log_prob(density, coordinates.z(w), settings.batch, generator).sum()
        score = _score(density, coordinates.z(state), settings.batch, generator)
        w.grad = coordinates.pull_back(score).neg_()
        if k < settings.burn_in:
            # far out the slope may be arbitrary, and a step along it would move the chain even further
            w.grad.nan_to_num_(nan=0.0).clamp_(-TAMED, TAMED)
        return None

    for k in range(settings.burn_in + settings.draws * settings.thinning):
        optimizer.step(closure)  # pyright: ignore[reportCallIssue, reportArgumentType]  (a gradient is left, no loss)
        if scheduler is not None:
            scheduler.step()
        collected = k + 1 - settings.burn_in
        if collected > 0 and collected % settings.thinning == 0:
            kept[collected // settings.thinning - 1] = w.detach()
    return coordinates, kept


def _log_prob(density: Density, z: Tensor, batch: int | None, generator: torch.Generator | None) -> Tensor:
    """The log density, or its estimate from a minibatch that all chains share."""
    if batch is None:
        return density.log_prob(z)
    if not isinstance(density, SubsampledDensity):
        raise InputError(f"batch: {type(density).__name__} has no minibatch estimate; leave batch at None")
    return density.log_prob_minibatch(z, torch.randint(density.points, (batch,), generator=generator, device=z.device))


def _score(density: Density, z: Tensor, batch: int | None, generator: torch.Generator | None) -> Tensor:
    """Gradient of the log density, or of its estimate from a minibatch."""
    if batch is None:
        return score_of(density, z)
    z = z.requires_grad_()
    with torch.enable_grad():
        (score,) = torch.autograd.grad(_log_prob(density, z, batch, generator).sum(), z)
    return score
