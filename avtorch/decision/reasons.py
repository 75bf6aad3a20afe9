"""Why a setting was chosen, in one plain sentence."""

from __future__ import annotations

from torch import Tensor

from avtorch.decision.replay import Prediction
from avtorch.decision.settings import Setting


def sentences(
    chosen: Setting,
    *,
    current: Setting,
    default: Setting,
    strategies: list[set[int]],
    sufficient: Tensor,
    p_string_stable: Tensor,
    p_deaf: Tensor,
    predicted: Prediction,
    asked: Tensor,
    seconds: float,
    required: float,
    most_clipped: float,
) -> list[str]:
    """One sentence per scenario on the choice of a `Decision`; tensors are (scenario,).

    `p_deaf`: P(string stable) if the leader's acceleration is no longer received. `asked`: the driver is asked to set
    the gap. `seconds` [s] of the past over which `predicted` was replayed. `required` P(string stable) and the share
    `most_clipped` of commands are what a setting has to keep.
    """
    out = []
    for i, used in enumerate(strategies):
        now, was = chosen.as_dict(i), current.as_dict(i)
        steps = []
        if 1 in used:
            steps.append(
                f"lower level models T {now['T_hat']:.2f} s, K {now['K_hat']:.2f} and targets {now['T_d']:.2f} s"
            )
        if 2 in used:
            verb = "driver asked for a time gap of" if bool(asked[i]) else "time gap"
            steps.append(f"{verb} {now['time_gap_s']:g} s instead of {float(default.time_gap[i]):g} s")
        if 3 in used:
            steps.append("gains " + ", ".join(f"{k:g}" for k in now["gains"]))
        if 4 in used:
            lost = f"P(string stable) {float(p_deaf[i]):.2f} if the link is lost"
            steps.append(f"leader's acceleration fed forward with k_f {now['feedforward']:g} ({lost})")
        what = "; ".join(steps) if steps else "default setting"
        if now == was:
            what = f"setting in force stays ({what})"
        clipped = 100.0 * float(predicted.clipped_share[i])
        past = f"{clipped:.1f} % of commands clipped in a replay of the past {seconds:.0f} s"
        result = f"P(string stable) {float(p_string_stable[i]):.2f}, {past}"
        if bool(sufficient[i]):
            out.append(f"least intrusive sufficient setting: {what} ({result})")
        else:
            missed = f"keeps P(string stable) at {required:g} with {100 * most_clipped:g} % of commands clipped or less"
            out.append(f"no setting of the grid {missed}; the best one: {what} ({result})")
    return out
