"""Logs of many drivers: what learns the pooled tiers, played as it is.

    python benchmarks/pooled.py results/pooled [--tasks simple_spread-expert-pooled ...] [--rows flow bc ...]

One file for each task. Rows that a file holds already, of as many seeds (`--seeds`), are not made again; `runs/pooled`
keeps the runs, so a row whose runs are there is only played. Budgets are small: a laptop makes a row in minutes, and
each row says its own. tables.py writes the page.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from common import command, machine

import ringfence
from ringfence.datasets.make import make
from ringfence.datasets.recipes.spread import TURNS
from ringfence.datasets.registry import TASKS
from ringfence.datasets.task import Task
from ringfence.envs import SafeMuJoCo
from ringfence.evaluation.evaluate import evaluate
from ringfence.evaluation.statistics import mean_of_runs
from ringfence.logs.store import EpisodeStore
from ringfence.training import worlds
from ringfence.training.runs import Run

RESULTS = Path(__file__).resolve().parent.parent / "results" / "pooled"
EPISODES = 200  # test resets
OF_ROBOTS = 20  # theirs are forty times as long
COLUMNS = ("return_mean", "return_norm", "cost_mean", "cost_safe_start", "train_seconds", "parameters")
FLOW = {"num_updates": 4000}
RAW = {"condition": "raw", "discount": 0.99}
# (algorithm, preset, changes, how it is played)
ROWS = {
    "bc": ("bc", "default", {}, {}),
    "bc, joint view": ("bc", "joint", {}, {}),
    "flow": ("flow", "default", FLOW, {}),
    "flow, the drivers' means": ("flow", "default", FLOW, {"sampling_steps": 1, "temperature": 0.0}),
    "flow, 4 steps": ("flow", "default", FLOW, {"sampling_steps": 4}),
    "flow, guided by danger": ("flow", "default", FLOW, {"barrier_guidance": 1.0}),
    **{f"flow, λ = {w:g}": ("flow", "default", FLOW | {"barrier_weight": w}, {}) for w in (0.1, 0.3, 1.0)},
    "flow, 2 steps": ("flow", "default", FLOW, {"sampling_steps": 2}),
    "flow, 2 steps, guided by danger": ("flow", "default", FLOW, {"sampling_steps": 2, "barrier_guidance": 1.0}),
    "flow, 8 steps": ("flow", "default", FLOW, {"sampling_steps": 8}),
    "flow, 8 steps, guided by danger": ("flow", "default", FLOW, {"sampling_steps": 8, "barrier_guidance": 1.0}),
    "flow, one driver": ("flow", "default", FLOW | {"drivers": 1}, {}),
    "flow, one driver, its mean": ("flow", "default", FLOW | {"drivers": 1}, {"sampling_steps": 1, "temperature": 0.0}),
    "flow, told the return": ("flow", "return", FLOW, {}),
    "flow, told the return, 2.5 asked": ("flow", "return", FLOW, {"target_return": 2.5}),
    "flow, told the return, 2.5 asked, guidance 2": ("flow", "return", FLOW, {"target_return": 2.5, "cfg_scale": 2.0}),
    "bc, 20,000 updates": ("bc", "default", {"num_updates": 20_000}, {}),
    "bc, joint view, 20,000 updates": ("bc", "joint", {"num_updates": 20_000}, {}),
    "bc-best": ("bc-best", "default", {}, {}),
    "bc-return": ("bc-return", "default", {}, {}),
    "omar": ("omar", "expert", {}, {}),
    "ma-td3bc": ("ma-td3bc", "default", {}, {}),
    "ma-td3bc-lag": ("ma-td3bc-lag", "default", {}, {}),
    **{f"flow, told raw, {t} asked": ("flow", "return", FLOW | RAW, {"target_return": t}) for t in (0.5, 0.9, 1.5)},
    "bc-return, raw, 0.9 asked": ("bc-return", "default", RAW | {"target_return": 0.9}, {}),
}
# The same runs under guards, by one World of the pool, seed 0.
_GUARDED = (
    "bc, 20,000 updates",
    "bc, joint view, 20,000 updates",
    "bc-best",
    "bc-return",
    "omar",
    "ma-td3bc",
    "ma-td3bc-lag",
    "flow",
    "flow, told the return",
)
ROWS |= {
    f"{name}, under {guard}": (*ROWS[name][:-1], ROWS[name][-1] | {"guard": guard})
    for name in _GUARDED
    for guard in ("shield", "adapt", "full")
}
ROWS["mpc, under full"] = ("mpc", "default", {}, {"guard": "full"})  # from a zero proposal
# Chosen among by learned values, and not corrected.
ROWS |= {
    f"flow, the best of {n}": ("flow", "default", FLOW, {"guard": "select", "num_samples": n}) for n in (8, 64, 256)
}
# What is compared on robots' data.
CLONE, ASKED = "bc, 20,000 updates, under adapt", "flow, told the return, under adapt"
BEST = "flow, told the return, the best of 8, under adapt"
ROWS[BEST] = ("flow", "return", FLOW, {"guard": "adapt", "num_samples": 8, "select": True})
# Rows that are compared with another of the same runs, on the same resets.
PAIRED = {"flow, guided by danger": "flow"} | {f"flow, {n} steps, guided by danger": f"flow, {n} steps" for n in (2, 8)}


def milliseconds(run: Run, store: EpisodeStore, options: dict) -> float:
    """Of one joint action, the median of 200."""
    pilot = ringfence.Controller(run, **options)
    seconds = []
    # Homogeneous agents see for themselves and are given no state.
    blind = store.state is None or TASKS[run.config["task"]].homogeneous
    for k in range(210):
        begun = time.perf_counter()
        pilot.act(store.observations[k], None if blind else store.state[k])
        seconds.append(time.perf_counter() - begun)
    return round(1000 * float(np.median(seconds[10:])), 2)


def of_robot(task: Task) -> bool:
    return isinstance(task.env, SafeMuJoCo)


def episodes_of(task: Task) -> int:
    return OF_ROBOTS if of_robot(task) else EPISODES


def per_episode(results: list[dict], what: str) -> np.ndarray:
    """(seeds, episodes)."""
    return np.array([r["per_episode"][what] for r in results], float)


def of_data(store: EpisodeStore, task: Task) -> dict:
    """What the logs earned, and each of their drivers where the card says whose an episode is."""
    returns = task.normalised_return(store.returns)
    found: dict[str, Any] = {"return_norm": round(float(returns.mean()), 4)}
    if store.card.extra.get("driver_of_episode") == TURNS:
        drivers = len(store.card.extra["drivers"])
        found["of_drivers"] = [round(float(returns[k::drivers].mean()), 4) for k in range(drivers)]
    return found


def few(results: list[dict]) -> dict:
    """What every episode earned and cost, of robots', which are few: rows of other runs are compared by them."""
    if results[0]["episodes"] > OF_ROBOTS:
        return {}
    return {"per_episode": {k: per_episode(results, k).round(2).tolist() for k in ("return", "cost")}}


def differences(results: list[dict], others: list[dict], task: Task) -> dict:
    """What results have more than others of the same runs and resets: return, and cost of episodes that start safe."""
    earned = task.normalised_return(per_episode(results, "return")) - task.normalised_return(
        per_episode(others, "return")
    )
    spent = per_episode(results, "cost") - per_episode(others, "cost")
    safe = 1.0 - per_episode(results, "unsafe_start")
    return {
        "return_norm": round(float(earned.mean()), 4),
        "return_norm_interval": [round(x, 4) for x in mean_of_runs(earned)],
        "cost_safe_start": round(float((spent * safe).sum() / safe.sum()), 4),
        "cost_safe_start_interval": [round(x, 4) for x in mean_of_runs(spent, safe)],
    }


def row(name: str, store: EpisodeStore, task: Task, runs: Path, seeds: int) -> dict:
    """All seeds of a row: means over them, and 95 % intervals of what was earned and of what an episode cost."""
    algorithm, preset, changes, options = ROWS[name]
    changed = "-".join(f"{k}-{v}" for k, v in changes.items()) or "default"
    trained = ringfence.train(
        algorithm,
        store,
        preset=preset,
        changes=changes,
        seeds=tuple(range(seeds)),
        out=str(runs / preset / changed),
        quiet=True,
    )
    given = options
    if "barrier_guidance" in options or "guard" in options:
        given = options | {"world": worlds.fit(store)}  # the same for all seeds
        given |= {"anyway": True} if "guard" in options else {}
    episodes = episodes_of(task)
    results = [evaluate(run, episodes=episodes, **given) for run in trained]
    returns = task.normalised_return(per_episode(results, "return"))
    paired = {}
    if name in PAIRED:
        others = [evaluate(run, episodes=episodes, **ROWS[PAIRED[name]][3]) for run in trained]
        paired = {"paired": {"with": PAIRED[name]} | differences(results, others, task)}
    return {
        "algorithm": algorithm,
        "preset": preset,
        "changes": changes,
        "played": options,
        "seeds": list(range(seeds)),
        "updates": trained[0].config["config"]["num_updates"],
        **{k: round(float(np.mean([r[k] for r in results])), 4) for k in COLUMNS},
        "return_norm_interval": [round(x, 4) for x in mean_of_runs(returns)],
        "return_norm_of_seeds": [round(float(r["return_norm"]), 4) for r in results],
        "cost_interval": [round(x, 4) for x in mean_of_runs(per_episode(results, "cost"), least=0.0)],
        **few(results),
        **paired,
        "milliseconds": milliseconds(trained[0], store, given),
        "command": command(),
        "machine": machine(),
    }


def kept(robots: bool) -> list[dict]:
    """What the files hold, of robots' data or of the others'."""
    files = sorted(RESULTS.glob("*.json"))
    return [json.loads(file.read_text()) for file in files if of_robot(TASKS[file.stem]) == robots]


def more(row: dict, other: dict) -> tuple[float, tuple[float, float]]:
    """Return that a robot's row has more than another on the same resets, and its interval."""
    apart = np.array(row["per_episode"]["return"]) - np.array(other["per_episode"]["return"])
    return float(apart.mean()), mean_of_runs(apart)


def main() -> None:
    reader = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    reader.add_argument("out", type=Path)
    reader.add_argument("--tasks", nargs="*", default=["simple_spread-expert-pooled", "simple_spread-medium-pooled"])
    reader.add_argument("--rows", nargs="*", default=list(ROWS), choices=list(ROWS))
    reader.add_argument("--seeds", type=int, default=1)
    reader.add_argument("--runs", type=Path, default=Path("runs/pooled"))
    given = reader.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    for name in given.tasks:
        task = TASKS[name]
        store, _ = make(task)
        file = given.out / f"{name}.json"
        found = json.loads(file.read_text()) if file.exists() else {"task": name, "episodes": episodes_of(task)}
        found["data"] = of_data(store, task)
        file.write_text(json.dumps(found, indent=1) + "\n")
        rows = found.setdefault("rows", {})
        for which in given.rows:
            if which in rows and len(rows[which]["seeds"]) >= given.seeds:
                continue
            rows[which] = row(which, store, task, given.runs, given.seeds)
            print(name, which, rows[which], flush=True)
            file.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
