"""Probabilities given a dead time: relative to bare GLVD, a delay is the verdict for nearly every car."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from avtorch.gap.answer.verdict import Candidate, Verdict
from avtorch.gap.simulator.effect import delay_effect
from avtorch.gap.simulator.plant import GapPlant


def given_dead_time(
    candidates: Sequence[Candidate], verdict: Verdict, baseline: GapPlant | None = None
) -> tuple[Candidate, ...] | None:
    """Hypotheses for the other causes, given that the delay is one of the causes; the most probable first.

    `none` is the delay alone, an effect's name its pair with the delay. Probabilities are proportional to those of the
    `candidates` with the delay, including the penalty of a second cause; `unknown` keeps its own. They sum to 1.
    `log_evidence` is relative to the delay alone, `parameters` are the second effect's, `moved` is with both effects.

    None where the baseline is more than bare GLVD, the verdict does not contain the delay, or no pair was tried.
    """
    delay = delay_effect().name
    late = [c for c in candidates if delay in c.effects]
    alone = next((c for c in late if c.name == delay), None)
    if delay not in verdict.names or alone is None or len(late) < 2 or (baseline is not None and baseline.effects):
        return None
    total = sum(c.probability for c in late)
    unknown = next((c.probability for c in candidates if c.name == "unknown"), 0.0)
    out = [Candidate("unknown", unknown)]
    for c in late:
        second = "+".join(name for name in c.effects if name != delay)
        own = {k.removeprefix(f"{second}."): q for k, q in c.parameters.items() if k.startswith(f"{second}.")}
        out.append(
            replace(
                c,
                name=second or "none",
                probability=(1 - unknown) * c.probability / total,
                log_evidence=(c.log_evidence or 0.0) - (alone.log_evidence or 0.0),
                parameters=own if second else {},
            )
        )
    return tuple(sorted(out, key=lambda c: -c.probability))
