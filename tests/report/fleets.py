"""Answers of fleets as `fleet.json` has them, without logs."""

from __future__ import annotations

from typing import Any

from tests.report.conftest import HOSTILE


def answer_of(count: int, *, causes: bool = True) -> dict[str, Any]:
    """Of `count` cars, the second of which has a hostile name, the third a report, and the fourth a log that failed."""
    cars = [_car(rank, count) for rank in range(1, count + 1)]
    cars[1]["car"] = HOSTILE
    cars[2]["logs"][0]["report"] = "reports/a b/drive-0/report.html"
    cars[3]["logs"][0]["errors"] = {"check": HOSTILE}
    interval = {"median": 0.35, "q05": 0.3, "q95": 0.4}
    common = {"cars": count, "drives": count, "sampled_cars": count, "sampler": "grid"}
    quantity = {"typical": interval, "between": interval, "within": None, "converged": True, "why": ""}
    share = {"mean": 0.9, "q05": 0.8, "q95": 0.97}
    one = {"name": "late", "cars": count, "may": count, "diagnosed": count, "share": share, "verdict": "the model's"}
    other = {**one, "name": "steep", "cars": 1, "verdict": "single cars'", "of": [HOSTILE], "parameters": {}}
    delay = quantity | {"unit": "s", "cars": count, "drives": 2 * count, "next_car": {"q05": 0.25, "q95": 0.45}}
    one |= {"of": None, "parameters": {"delay_s": delay}}
    reasons = {name: sum(car["reason"] == name for car in cars) for name in ("below target", "sound")}
    return {
        "schema": "avtorch.fleet/1",
        "target": 0.9,
        "steps": ["check", "estimate", "diagnose"],
        "logs": count,
        "failed_logs": 1,
        "reasons": reasons,
        "population": common | {"T_L": quantity, "K_L": quantity},
        "causes": [one, other] if causes else [],
        "cars": cars,
        "notes": [HOSTILE],
    }


def _car(rank: int, count: int) -> dict[str, Any]:
    stable = (rank - 0.5) / count
    quantity = {"T_L": 0.3 + 0.1 * stable, "K_L": 1.0 - 0.1 * stable}
    car: dict[str, Any] = {"rank": rank, "car": f"car {rank}", "reason": "below target" if stable < 0.9 else "sound"}
    car["p_string_stable"] = {"now": stable, "lowest": stable}
    car |= {name: {"mean": x, "sd": 0.02, "q05": x - 0.03, "q95": x + 0.03} for name, x in quantity.items()}
    car["change"] = {"T_L": {"past": 0.3, "now": 0.4, "difference": 0.1, "in_sd": 1.5}}
    beside = {"pooled": {"median": 0.3, "q05": 0.2, "q95": 0.4}, "ratio": 1.8, "tail": 1e-5 if rank == 1 else 0.5}
    car["siblings"] = {"q_value": 1e-4 if rank == 1 else 1.0, "T_L": beside, "K_L": beside | {"tail": 0.9}}
    car["gap"] = {"verdict": ["late"]}
    return car | {"logs": [{"log": f"{rank}.csv", "errors": {}, "report": None}]}
