"""The yard of examples/yard.py: who acts there, alone and under guard.

    python benchmarks/yard.py guards         # results/yard.csv; an hour
    python benchmarks/yard.py constraints    # results/constraints.csv; twenty minutes
    python benchmarks/yard.py late           # results/late_logs.csv; an hour

`guards`: BC, and a naive controller at full speed; danger learned of the team's cost column beside the formula that the
logs are not told. `constraints`: two of them, each with its limit, contact (0 of 80 steps) and speed above 0.8 m/s (20
of 80); what a guard makes of them when the logs name them, beside a baseline whose logs tell their maximum alone.
`late`: its robots one to three steps late, and the naive controller under a shield by Worlds of these logs as they are,
and undelayed. Rows of `guards` and `late` that are there are not made again. tables.py writes the pages.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import warnings
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from common import RESULTS, ROOT, append, brief, read, write

import ringfence
from ringfence.evaluation.statistics import upper_bound
from ringfence.logs.late import lateness
from ringfence.logs.store import EpisodeStore
from ringfence.problem.constraints import Separation, to_dict
from ringfence.world.card import Card, Verdict
from ringfence.world.verdict import judge

sys.path.insert(0, str(ROOT / "examples"))
import yard  # noqa: E402

AT = {name: k for k, name in enumerate(yard.NAMES)}
# Who acts, under which guard, of how many episodes one (`full` takes ten times as long).
V, NO_V = {"terminal_value": True}, {"terminal_value": False}
GUARDS: tuple[tuple[str, str, str, dict[str, Any], int], ...] = (
    ("BC", "none", "none", {}, 1),
    ("BC", "shield", "learned", NO_V, 1),
    ("BC", "shield", "learned", {}, 1),
    ("BC", "shield", "analytic", {}, 1),
    ("BC", "full", "learned", {}, 5),
    ("BC", "full", "learned", {"horizon": 3, **V}, 5),
    ("BC", "full", "analytic", {}, 5),
    ("naive controller", "none", "none", {}, 1),
    ("naive controller", "shield", "learned", NO_V, 1),
    ("naive controller", "shield", "learned", {}, 1),
    ("naive controller", "shield", "learned", {"horizon": 7}, 1),
    ("naive controller", "shield", "learned", {"horizon": 10}, 1),
    ("naive controller", "shield", "analytic", {}, 1),
)
HEAD = ("method", "guard", "barrier", "options", "episodes", "return", "return_low", "return_high", "contact", "bound")
LIMITS, FAST = {"contact": 0.0, "fast": 20.0}, 0.8  # m/s
BARRIERS = (("none", "each"), ("shield", "one"), ("shield", "each"), ("adapt", "one"), ("adapt", "each"))
ALONE, AS_THEY_ARE, UNDELAYED = "none", "of the logs as they are", "of undelayed logs"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("guards", "constraints", "late"))
    parser.add_argument("--episodes", type=int, help="1000, 500 and 300 by default")
    a = parser.parse_args()
    {"guards": guards, "constraints": constraints, "late": late}[a.what](*filter(None, [a.episodes]))


def naive(observations: np.ndarray, state: None) -> np.ndarray:
    """Full speed to the goal, past nobody."""
    gap, speed = (observations[:, [AT[f"{n}x"], AT[f"{n}y"]]] for n in ("goal.d", "own.v"))
    far = np.maximum(np.linalg.norm(gap, axis=-1, keepdims=True), 0.3)
    return np.clip(2 * (gap / far - speed), -1, 1)


def guards(most: int = 1000) -> None:
    out, store = RESULTS / "yard.csv", yard.record()
    # The formula is what a guard may be asked for beside; what is learned is learned of the costs.
    hazard = Separation(2 * yard.RADIUS)
    logs_of_both = dataclasses.replace(store, card=store.card.updated(hazard=to_dict(hazard)))
    world = ringfence.fit(logs_of_both, quiet=False)
    run = ringfence.train("bc", logs_of_both, out=ROOT / "runs")[0]
    there = {tuple(r.values())[:4]: r for r in read(out)}
    touched = float((store.episode_costs > 0).mean())
    logs = ("logs", "", "", "", store.episodes, float(store.returns.mean()), "", "", touched, "")
    rows: list[dict[str, Any]] = [brief(dict(zip(HEAD, logs)))]
    for method, guard, barrier, options, part in GUARDS:
        words = " ".join(f"{k}={v}" for k, v in options.items())
        if (method, guard, barrier, words) in there:
            rows.append(there[method, guard, barrier, words])
            continue
        episodes = max(100, most // part)
        asked = {} if guard == "none" else {"guard": guard, "barrier": barrier, **options}
        player, how = run, {**asked, "world": world} if asked else {}
        if method != "BC":
            player, how = (
                ringfence.guard(naive, world, hazard=hazard, **(asked or {"guard": "none"})),
                {},
            )  # it looks on
        r = ringfence.play(player, yard.Yard, episodes=episodes, num_envs=100, **how)
        measured = [r["return_mean"], *r["return_interval"], r["violation_rate"]]
        bound = upper_bound(round(r["violation_rate"] * episodes), episodes)
        rows.append(brief(dict(zip(HEAD, [method, guard, barrier, words, episodes, *measured, bound]))))
        print(rows[-1], flush=True)
        write(out, rows)
    write(out, rows)


def fast(seen: np.ndarray) -> np.ndarray:
    """(...,) 1 where any robot of (..., N, 18) is too fast."""
    return (np.linalg.norm(seen[..., :2], axis=-1) > FAST).any(-1).astype(float)


class Strict(yard.Yard):
    """The yard, which names what its costs are of."""

    def step(self, actions):
        seen, *rest, infos = super().step(actions)
        too_fast = float(fast(np.stack(list(seen.values()))))
        return seen, *rest, {a: {"cost": {"contact": i["cost"], "fast": too_fast}} for a, i in infos.items()}


def of_two_constraints() -> tuple[EpisodeStore, EpisodeStore]:
    """The same logs with their maximum as the only cost, and with both by name."""
    store = yard.record()
    e, rows = store.episodes, store.observations.reshape(store.episodes, yard.STEPS + 1, yard.N, -1)
    actions, rewards, touched = (
        x.reshape(e, yard.STEPS, *x.shape[1:]) for x in (store.actions, store.rewards, store.costs)
    )
    costs = {"contact": touched, "fast": fast(rows[:, 1:])}
    named = EpisodeStore.from_episodes(rows, actions, rewards, costs, card=store.card.updated(constraints=LIMITS))
    one = store.card.updated(cost_limit=LIMITS["fast"])
    return dataclasses.replace(named, constraints=None, card=one), named


def constraints(episodes: int = 500) -> None:
    one, named = of_two_constraints()
    worlds = {"one": ringfence.fit(one, quiet=False), "each": ringfence.fit(named, quiet=False)}
    print(worlds["each"].card)
    runs = {k: ringfence.train("bc", store, out=ROOT / "runs" / k)[0] for k, store in (("one", one), ("each", named))}
    rate = 0.5 * LIMITS["fast"] / yard.STEPS  # one margin for both has that of the constraint with a budget
    rows = []
    for guard, barriers in BARRIERS:
        how = {} if guard == "none" else {"guard": guard, "world": worlds[barriers], "rate": rate}
        r = ringfence.play(runs[barriers], Strict, episodes=episodes, num_envs=100, **how)
        touched, hurried = (r["constraints"][name] for name in LIMITS)
        row = {"guard": guard, "barriers": "" if guard == "none" else barriers, "episodes": episodes}
        row |= dict(zip(("return", "return_low", "return_high"), (r["return_mean"], *r["return_interval"])))
        row |= {"contact": touched["violation_rate"], "contact_bound": touched["violation_upper"]}
        row |= dict(zip(("fast", "fast_low", "fast_high"), (hurried["cost_mean"], *hurried["cost_interval"])))
        rows.append(brief(row | {"infeasible_rate": r.get("infeasible_rate", "")}))
        print(rows[-1], flush=True)
        write(RESULTS / "constraints.csv", rows)


def late_logs(late: int, episodes: int = 1500) -> EpisodeStore:
    """The careless controller's logs where what it sends takes effect so many steps later."""
    rng = np.random.default_rng(0)
    now = yard.begin(rng, episodes)
    act = yard.Careless(rng, episodes)
    sent = [np.zeros((episodes, yard.N, 2))] * late
    rows, kept = [yard.seen(*now)], []
    for _ in range(yard.STEPS):
        action = act(*now)
        sent.append(action)
        p, v, reward, cost = yard.move(*now, sent.pop(0))
        now = (p, v, now[2])
        rows.append(yard.seen(*now))
        kept.append((action, reward, cost))
    actions, rewards, costs = (np.stack(x, 1) for x in zip(*kept))
    card = {"task": f"yard-{late}-late", "observation_names": yard.NAMES, "provenance": "benchmarks/yard.py"}
    return EpisodeStore.from_episodes(np.stack(rows, 1), actions, rewards, costs, card=card)


class LateYard(yard.Yard):
    """The yard, its robots so many steps late."""

    late = 0

    def reset(self, seed=None, options=None):
        self.sent = [{a: np.zeros(2) for a in self.possible_agents}] * self.late
        return super().reset(seed, options)

    def step(self, actions):
        self.sent.append(actions)
        return super().step(self.sent.pop(0))


def late(episodes: int = 300) -> None:
    out: Path = RESULTS / "late_logs.csv"
    done = {(int(r["late"]), r["world"], r["delay"]) for r in read(out)}
    ways = [(ALONE, ""), *((of, late) for of in (AS_THEY_ARE, UNDELAYED) for late in (False, True))]
    for steps in (1, 2, 3):
        env, store = type("LateYard", (LateYard,), {"late": steps}), late_logs(steps)
        told = lateness(store).of_all
        for world_of, known in ways:
            delay = known if known == "" else known * steps
            if (steps, world_of, str(delay)) in done:
                continue
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that these logs are late is what is asked here
                world = ringfence.fit(store if world_of == AS_THEY_ARE else ringfence.undelay(store, steps))
            how = {"guard": "none"} if delay == "" else {"guard": "shield", "delay": delay, "anyway": True}
            r = ringfence.play(ringfence.guard(naive, world, **how), env, episodes=episodes, num_envs=100)
            row = {"late": steps, "told": told, "world": world_of}
            row |= {"verdict": world.card.verdict.word, "otherwise": otherwise(world.card).word}
            row |= {"error": world.card.prediction_error.error_of_change[0], "delay": delay, "episodes": episodes}
            row |= {"return": r["return_mean"], "contact": r["violation_rate"]}
            row |= {"bound": upper_bound(round(r["violation_rate"] * episodes), episodes)}
            append(out, brief(row | {"infeasible_rate": r["infeasible_rate"]}))


def otherwise(card: Card) -> Verdict:
    """The verdict of a card that does not say how late commands are."""
    return judge(msgspec.structs.replace(card, data=msgspec.structs.replace(card.data, late=())))


if __name__ == "__main__":
    main()
