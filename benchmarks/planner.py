"""The diffusion planner: what each choice is worth, Algorithm 1 as printed, and rows by plans followed as they are.

    python benchmarks/planner.py GROUP [--tasks ...] [--rows ...] [--seeds 0 1 2] [--runs runs/planner]
    python benchmarks/planner.py tables

A file of results for each group and task: a row is one run of one seed, played in several ways on the same test resets.
Rows that a file holds already are not made again; runs are kept, so a new way of playing needs no training. Seconds are
of one core (`taskset -c 0`, XLA_FLAGS=--xla_cpu_multi_thread_eigen=false). `tables` writes pages anew.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from common import command, machine
from pooled import milliseconds
from safetensors.numpy import load_file

import ringfence
from ringfence import algos
from ringfence.algos import drivers
from ringfence.datasets.make import make
from ringfence.datasets.registry import TASKS
from ringfence.datasets.task import Task
from ringfence.envs import SafeMuJoCo
from ringfence.evaluation.evaluate import evaluate
from ringfence.logs.store import EpisodeStore
from ringfence.training import worlds
from ringfence.training.runs import Run

RESULTS = Path(__file__).resolve().parent.parent / "results" / "planner"
SPREAD = tuple(f"simple_spread-{tier}" for tier in ("expert", "medium-replay", "medium", "random"))
POOLED = tuple(f"{name}-pooled" for name in SPREAD)
ROBOTS = tuple(
    f"{robot}-{tier}" for robot in ("ant_2x4", "ant_4x2", "halfcheetah_2x3") for tier in ("good", "medium", "poor")
)
LEARNED = ("simple_spread-expert", "simple_spread-expert-pooled")  # one learner, five

AS_IT_IS: dict[str, Any] = {}
ALONE = {"barrier_guidance": 0.0, "value_guidance": 0.0}  # which is MADIFF, of the same training
GUARDED = {guard: {"guard": guard, "anyway": True} for guard in ("shield", "full", "adapt")}
COOL = {"planner": "low_temperature"}
PLAYS: dict[str, dict[str, Any]] = {
    "as it is": AS_IT_IS,
    "alone": ALONE,
    "danger alone": {"value_guidance": 0.0},
    **{f"under {guard}": how for guard, how in GUARDED.items()},
    "under shield, alone": GUARDED["shield"] | ALONE,
    "cool": COOL,
    "cool, alone": COOL | ALONE,
    "cool, under adapt": COOL | GUARDED["adapt"],
    "cool, values guide": COOL | {"value_guidance": 1.0},  # as it is where V knows how to stay safe
    **{f"{n} steps": {"sampling_steps": n} for n in (1, 2, 3, 10, 20)},
    **{f"temperature {t:g}": {"temperature": t} for t in (0.0, 0.3)},
}

# (algorithm, preset, changes): what is trained
OLD = ("madiff", "attention", {})
MADIFF = ("madiff", "", {})
_BEFORE = {"net": "attention", "width": 128}
ABLATIONS: dict[str, tuple[str, str, dict[str, Any]]] = {
    "as it is": MADIFF,
    "noise around the origin": ("madiff", "", {"around": "nothing"}),
    # as many seconds on a pool as the mean plan and its denoiser take together
    "noise around the origin, 5500 updates": ("madiff", "", {"around": "nothing", "num_updates": 5500}),
    # as many parameters
    "noise around the origin, 600 units": ("madiff", "", {"around": "nothing", "width": 600}),
    "noise around the origin, noisy entries as they are": ("madiff", "", {"around": "nothing", "noisy_input": "unit"}),
    "noisy entries as they are": ("madiff", "", {"noisy_input": "unit"}),
    "EDM's preconditioning (v), around the origin": (
        "madiff",
        "",
        {"around": "nothing", "noisy_input": "unit", "prediction": "v"},
    ),
    "the network outputs ε": ("madiff", "", {"noisy_input": "unit", "prediction": "epsilon"}),
    "the network outputs v, the error is of ε": (
        "madiff",
        "",
        {"noisy_input": "unit", "prediction": "v", "error": "noise"},
    ),
    "level weights 0.5 to 5": ("madiff", "", {"snr_floor": 0.5, "snr_ceiling": 5.0}),
    "attention of 128": ("madiff", "", _BEFORE),
    "attention of 128, agents told apart": ("madiff", "", _BEFORE | {"distinguish_agents": True}),
    "attention of 384, agents told apart": ("madiff", "", {"net": "attention", "distinguish_agents": True}),
    "half the units": ("madiff", "", {"width": 192}),
    "4 rows": ("madiff", "", {"horizon": 4}),
    "16 rows": ("madiff", "", {"horizon": 16}),
    "the window's advantage, not the return": ("icbf", "", {"condition": "advantage"}),
    "nobody is searched for": ("madiff", "", {"drivers": 0}),
    "nobody is searched for, 10,000 updates": ("madiff", "", {"num_updates": 10_000, "drivers": 0}),
    "before (attention of 128, weights 0.5 to 5, around the origin, nobody is searched for)": OLD,
}
SHAPED = {f"λ = {w:g}": ("icbf", "", {"barrier_weight": w}) for w in (0.1, 0.3, 1.0, 3.0)}
GROUPS: dict[str, dict[str, Any]] = {
    "rows": {
        "tasks": SPREAD + POOLED + ("proving-hall", "proving-discs"),
        "rows": {"icbf": ("icbf", "", {})},
        "plays": ("as it is", "danger alone", "alone", "under shield", "under shield, alone"),
    },
    "ablations": {"tasks": LEARNED, "rows": ABLATIONS, "plays": ("alone",)},
    "frontier": {"tasks": LEARNED, "rows": SHAPED, "plays": ("as it is", "alone")},
    "sampling": {
        "tasks": LEARNED,
        "rows": {"icbf": ("icbf", "", {})},
        "plays": ("1 steps", "2 steps", "3 steps", "10 steps", "20 steps", "temperature 0", "temperature 0.3"),
    },
    "algorithm1": {
        "tasks": SPREAD + POOLED + ROBOTS,
        "rows": {f"λ = {w:g}": ("icbf", "algorithm1", {"barrier_weight": w}) for w in (0.0, 0.1, 1.0, 10.0)},
        "plays": ("as it is",),  # and of robots --plays "as it is" cool
    },
    "guards": {
        "tasks": SPREAD,
        "rows": {"icbf": ("icbf", "", {}), "bc": ("bc", "", {})},
        "plays": ("under full",),
    },
    "robots": {
        "tasks": ROBOTS,
        "rows": {"icbf": ("icbf", "", {}), "bc": ("bc", "", {})},
        "plays": ("cool", "cool, values guide", "cool, alone", "cool, under adapt"),
    },
    "crossing": {
        "tasks": ("crossing-hasty",),
        "rows": {"icbf": ("icbf", "", {}), "bc": ("bc", "", {})},
        "plays": ("as it is", "danger alone", "alone", "under shield", "under shield, alone"),
    },
}


def episodes_of(task: Task) -> int:
    return 20 if isinstance(task.env, SafeMuJoCo) else 200


def row(
    task: Task, store: EpisodeStore, what: tuple[str, str, dict], seed: int, runs: Path, timed: bool
) -> tuple[dict[str, Any], Any]:
    """(what is said of a run, the run)."""
    algorithm, preset, changes = what
    known = algos.get(algorithm)
    wanted = [f"{preset}-{of_task}" if preset else of_task for of_task in task.presets]
    chosen = next((name for name in wanted if name in known.presets), preset or next(iter(known.presets)))
    named = "-".join([chosen, *(f"{k}-{v}" for k, v in changes.items())])
    folder = runs / task.name / algorithm / named / f"seed-{seed}"
    run = ringfence.train(
        algorithm,
        store,
        preset=chosen,
        changes=changes,
        seeds=(seed,),
        folder=lambda _: folder,
        quiet=True,
    )[0]
    config = run.config["config"]
    windows = config["num_updates"] * config["batch"]
    told = {
        "algorithm": algorithm,
        "preset": chosen,
        "changes": changes,
        "seed": seed,
        "revision": run.config["revision"],
        "updates": config["num_updates"],
        "windows": windows,
        "passes": round(windows / store.steps, 3),
        "parameters": parameters(run),
        "seconds": round(sum(m["seconds"] for m in run.metrics), 1),
        "found": drivers.found(run.metrics[-1]) if "drivers/worth" in run.metrics[-1] else 0,
        "worth": round(run.metrics[-1].get("drivers/worth", 0.0), 3),
        "plays": {},
        "machine": machine(),
        "command": command(),
    }
    if timed:
        told["milliseconds"] = milliseconds(run, store, {})
    return told, run


def parameters(run: Run) -> int:
    """Numbers of the networks that act: of all that are averaged but the clones, which find whose windows are."""
    arrays = load_file(run.checkpoints()[-1][1])
    return sum(x.size for k, x in arrays.items() if k.startswith("ema/") and not k.startswith("ema/clones/"))


def played(run: Any, task: Task, options: dict[str, Any]) -> dict[str, Any]:
    begun = time.monotonic()
    r = worlds.with_world(evaluate, run, episodes=episodes_of(task), **options)
    of = r["per_episode"]
    return {
        "options": options,
        "return_norm": round(r["return_norm"], 4),
        "return_mean": round(r["return_mean"], 3),
        "cost": round(r["cost_mean"], 4),
        "cost_safe_start": round(r["cost_safe_start"], 4),
        "violation_rate": round(r["violation_rate"], 4),
        "wall_seconds": round(time.monotonic() - begun, 1),
        "per_episode": {
            "return": np.round(of["return"], 2).tolist(),
            "cost": np.round(of["cost"], 2).tolist(),
            "unsafe_start": [int(x) for x in of["unsafe_start"]],
        },
    }


def write(file: Path, found: dict) -> None:
    """A line for every run."""
    file.parent.mkdir(parents=True, exist_ok=True)
    lines = [json.dumps(r, ensure_ascii=False) for r in found["rows"]]
    head = json.dumps({k: v for k, v in found.items() if k != "rows"}, ensure_ascii=False)
    file.write_text(head[:-1] + ', "rows": [\n' + ",\n".join(lines) + "\n]}\n")


def main() -> None:
    reader = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    reader.add_argument("group", choices=[*GROUPS, "tables"])
    reader.add_argument("--tasks", nargs="*")
    reader.add_argument("--rows", nargs="*")
    reader.add_argument("--plays", nargs="*")
    reader.add_argument("--seeds", nargs="*", type=int, default=[0])
    reader.add_argument("--runs", type=Path, default=Path("runs/planner"))
    given = reader.parse_args()
    if given.group == "tables":
        from planner_tables import write_tables

        write_tables()
        return
    group = GROUPS[given.group]
    for seed in given.seeds:
        for name in given.tasks or group["tasks"]:
            task = TASKS[name]
            store, _ = make(task)
            file = RESULTS / f"{given.group}-{name}.json"
            found = json.loads(file.read_text()) if file.exists() else {"group": given.group, "task": name, "rows": []}
            found["logs"] = round(float(task.normalised_return(store.returns).mean()), 4)
            for which in given.rows or group["rows"]:
                old = next((r for r in found["rows"] if (r["name"], r["seed"]) == (which, seed)), None)
                ways = given.plays or group["plays"]
                if old is not None and all(w in old["plays"] for w in ways):
                    continue
                told, run = row(task, store, group["rows"][which], seed, given.runs, given.group == "rows")
                if old is None:
                    found["rows"].append(old := {"name": which, **told})
                for way in ways:
                    if way not in old["plays"]:
                        old["plays"][way] = played(run, task, PLAYS[way])
                        p = old["plays"][way]
                        print(
                            name, which, seed, way, p["return_norm"], p["cost_safe_start"], old["seconds"], flush=True
                        )
                write(file, found)


if __name__ == "__main__":
    main()
