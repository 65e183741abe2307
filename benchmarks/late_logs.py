"""Logs of machines whose commands take effect late: the yard of examples/yard.py, its robots one to three steps late,
and a naive controller at full speed under a shield by Worlds of these logs as they are, and undelayed.

    python benchmarks/late_logs.py       # writes results/late_logs.csv and docs/stress-results.md's table; an hour

Rows that are there already are not made again.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import msgspec
import numpy as np
from _rows import append, read
from _yard import naive, yard
from readme import put

import ringfence
from ringfence.evaluation.statistics import upper_bound
from ringfence.logs.late import lateness
from ringfence.logs.store import EpisodeStore
from ringfence.world.card import Card, Verdict
from ringfence.world.verdict import judge

ROOT = Path(__file__).resolve().parent.parent
OUT = ROOT / "results" / "late_logs.csv"
LATE = (1, 2, 3)
LOGGED, EPISODES = 1500, 300
HEAD = (
    "late",
    "told",
    "world",
    "verdict",
    "otherwise",
    "error",
    "delay",
    "episodes",
    "return",
    "contact",
    "bound",
    "infeasible_rate",
)
ALONE, AS_THEY_ARE, UNDELAYED = "none", "of the logs as they are", "of undelayed logs"


def record(late: int, seed: int = 0) -> EpisodeStore:
    """The careless controller's logs where what it sends takes effect so many steps later."""
    rng = np.random.default_rng(seed)
    now = yard.begin(rng, LOGGED)
    act = yard.Careless(rng, LOGGED)
    sent = [np.zeros((LOGGED, yard.N, 2))] * late
    rows, kept = [yard.seen(*now)], []
    for _ in range(yard.STEPS):
        action = act(*now)
        sent.append(action)
        p, v, reward, cost = yard.move(*now, sent.pop(0))
        now = (p, v, now[2])
        rows.append(yard.seen(*now))
        kept.append((action, reward, cost))
    actions, rewards, costs = (np.stack(x, 1) for x in zip(*kept))
    card = {"task": f"yard-{late}-late", "observation_names": yard.NAMES, "provenance": "benchmarks/late_logs.py"}
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


def main() -> None:
    done = {(int(r["late"]), r["world"], r["delay"]) for r in read(OUT)}
    for late in LATE:
        env = type("LateYard", (LateYard,), {"late": late})
        store = record(late)
        told = lateness(store)
        ways = ((ALONE, None), (AS_THEY_ARE, 0), (AS_THEY_ARE, late), (UNDELAYED, 0), (UNDELAYED, late))
        for world_of, delay in ways:
            if (late, world_of, "" if delay is None else str(delay)) in done:
                continue
            logs = store if world_of == AS_THEY_ARE else ringfence.undelay(store, late)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that these logs are late is what is asked here
                world = ringfence.fit(logs)
            how = {"guard": "none"} if delay is None else {"guard": "shield", "delay": delay, "anyway": True}
            r = ringfence.play(ringfence.guard(naive, world, **how), env, episodes=EPISODES, num_envs=100)
            bound = upper_bound(round(r["violation_rate"] * EPISODES), EPISODES)
            error = world.card.prediction_error.error_of_change[0]
            verdicts = [world.card.verdict.word, otherwise(world.card).word]
            about = [late, told.of_all, world_of, *verdicts, error, "" if delay is None else delay]
            measured = [r["return_mean"], r["violation_rate"], bound, r["infeasible_rate"]]
            row = [f"{v:.5g}" if isinstance(v, float) else v for v in (*about, EPISODES, *measured)]
            append(OUT, dict(zip(HEAD, row)), HEAD)
            print(row, flush=True)
    put("docs/stress-results.md", "late-logs", table())


def otherwise(card: Card) -> Verdict:
    """The verdict of a card that does not say how late commands are."""
    return judge(msgspec.structs.replace(card, data=msgspec.structs.replace(card.data, late=())))


def table() -> str:
    lines = [
        "| steps late | World | error, % of what changes | the guard decides for | return | episodes with contact, % |",
        "|---|---|---|---|---|---|",
    ]
    for r in read(OUT):
        alone = r["world"] == ALONE
        error = "" if alone else f"{100 * float(r['error']):.2g}"
        when = {"": "", "0": "now"}.get(r["delay"], f"{r['delay']} step{'s' * (r['delay'] != '1')} later")
        touched = f"{100 * float(r['contact']):.3g} (≤ {100 * float(r['bound']):.3g})"
        other = "" if r["otherwise"] == r["verdict"] else f", *{r['otherwise']}* but for that"
        world = "no guard" if alone else f"{r['world']}, *{r['verdict']}*{other}"
        lines.append(f"| {r['late']} | {world} | {error} | {when} | {float(r['return']):.2f} | {touched} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
