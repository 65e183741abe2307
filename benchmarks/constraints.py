"""Two constraints of the yard of examples/yard.py, each with its limit: contact (0 of 80 steps) and speed above 0.8 m/s
(20 of 80). What a guard makes of them when the logs name them, beside a baseline whose logs tell their maximum alone.

    python benchmarks/constraints.py     # writes results/constraints.csv and its table; twenty minutes
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path

import numpy as np
from _rows import write
from readme import put

import ringfence
from ringfence.logs.store import EpisodeStore

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "examples"))
import yard  # noqa: E402

OUT = ROOT / "results" / "constraints.csv"
LIMITS, FAST = {"contact": 0.0, "fast": 20.0}, 0.8  # m/s
ROWS = (("none", "each"), ("shield", "one"), ("shield", "each"), ("adapt", "one"), ("adapt", "each"))


def fast(seen: np.ndarray) -> np.ndarray:
    """(...,) 1 where any robot of (..., N, 18) is too fast."""
    return (np.linalg.norm(seen[..., :2], axis=-1) > FAST).any(-1).astype(float)


class Strict(yard.Yard):
    """The yard, which names what its costs are of."""

    def step(self, actions):
        seen, *rest, infos = super().step(actions)
        too_fast = float(fast(np.stack(list(seen.values()))))
        return seen, *rest, {a: {"cost": {"contact": i["cost"], "fast": too_fast}} for a, i in infos.items()}


def stores() -> tuple[EpisodeStore, EpisodeStore]:
    """The same logs with their maximum as the only cost, and with both by name."""
    store = yard.record()
    e, rows = store.episodes, store.observations.reshape(store.episodes, yard.STEPS + 1, yard.N, -1)
    by_step = lambda x: x.reshape(e, yard.STEPS, *x.shape[1:])  # noqa: E731
    made = [rows, *(by_step(x) for x in (store.actions, store.rewards))]
    costs = {"contact": by_step(store.costs), "fast": fast(rows[:, 1:])}
    card = store.card.updated(constraints=LIMITS)
    named = EpisodeStore.from_episodes(*made, costs, card=card)
    one = store.card.updated(cost_limit=LIMITS["fast"])
    return dataclasses.replace(named, constraints=None, card=one), named


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=500)
    episodes = parser.parse_args().episodes
    one, named = stores()
    worlds = {"one": ringfence.fit(one, quiet=False), "each": ringfence.fit(named, quiet=False)}
    print(worlds["each"].card)
    runs = {k: ringfence.train("bc", store, out=ROOT / "runs" / k)[0] for k, store in (("one", one), ("each", named))}
    rate = 0.5 * LIMITS["fast"] / yard.STEPS  # one margin for both has that of the constraint with a budget
    rows = []
    for guard, barriers in ROWS:
        how = {} if guard == "none" else {"guard": guard, "world": worlds[barriers], "rate": rate}
        r = ringfence.play(runs[barriers], Strict, episodes=episodes, num_envs=100, **how)
        touched, hurried = (r["constraints"][name] for name in LIMITS)
        row = {
            "guard": guard,
            "barriers": "" if guard == "none" else barriers,
            "episodes": episodes,
            "return": r["return_mean"],
            "return_low": r["return_interval"][0],
            "return_high": r["return_interval"][1],
            "contact": touched["violation_rate"],
            "contact_bound": touched["violation_upper"],
            "fast": hurried["cost_mean"],
            "fast_low": hurried["cost_interval"][0],
            "fast_high": hurried["cost_interval"][1],
            "infeasible_rate": r.get("infeasible_rate", ""),
        }
        rows.append({k: f"{v:.5g}" if isinstance(v, float) else v for k, v in row.items()})
        print(rows[-1], flush=True)
        write(OUT, rows)
    put("docs/guard-results.md", "constraints", table(rows))


def table(rows: list[dict]) -> str:
    lines = [
        "| guard | barriers | return | episodes with contact (limit 0) | steps too fast (limit 20) |",
        "|---|---|---|---|---|",
    ]
    words = {"": "", "one": "one, of either", "each": "one each"}
    for r in rows:
        touched = f"{100 * float(r['contact']):.1f} % (≤ {100 * float(r['contact_bound']):.1f})"
        lines.append(
            f"| {r['guard']} | {words[r['barriers']]} | {float(r['return']):.2f} | {touched} | {float(r['fast']):.2f} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
