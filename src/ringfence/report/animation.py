"""What the rollout player needs, packed: positions and plans in millimetres, as base64 of little-endian int16."""

from __future__ import annotations

import base64

import numpy as np

from ringfence.datasets import registry
from ringfence.evaluation import recordings
from ringfence.report.table import Row, Section
from ringfence.training.runs import Run

EPISODES = 4  # per variant
VARIANTS = 2  # per task
NUMBERS = 20_000  # of an episode's plans; more plans than fit are left out, never the chosen one


def variant_key(row: Row, run: Run) -> str:
    """The variant's name in results.json, which the recording carries too."""
    return next(result["variant"] for member, result in row.members if member == run)


def of_row(row: Row) -> tuple[Run, recordings.Recording] | None:
    """The first seed of a row that has a recording."""
    for run, _ in sorted(row.members, key=lambda m: m[0].config["seed"]):
        arrays = recordings.read(run.path, variant_key(row, run))
        if arrays is not None:
            return run, arrays
    return None


def players(section: Section) -> list[dict]:
    """At most two variants of a task: the planner with the most plans and one that draws a single plan."""
    found = []
    for row in section.rows:
        if row.split == "test" and (kept := of_row(row)):
            options = row.members[0][1].get("options") or {}
            found.append(((options.get("plans", 0), options.get("value_guidance", 0.0)), row, *kept))
    if not found:
        return []
    most = max(found, key=lambda f: f[0])  # of equals the first; the flagship is last in the table, so look backwards
    most = [f for f in found if f[0] == most[0]][-1]
    rest = [f for f in found if f[1] is not most[1]]
    single = [f for f in rest if f[0][0] <= 1] or rest
    same = [f for f in single if (f[1].algorithm, f[1].preset) == (most[1].algorithm, most[1].preset)]
    chosen = [most, *(same or single)[-1:]][:VARIANTS]
    made = [p for _, row, run, arrays in chosen if (p := player(section, row, run, arrays))]
    for pair in zip(*(p["episodes"] for p in made)):  # the same resets at the same scale
        reach = max(e["reach"] for e in pair)
        for e in pair:
            e["reach"] = reach
    return made


def films(section: Section) -> list[dict]:
    """GIFs of robots that lie beside recordings, at most two: {label, seed, gif (base64)}."""
    found = []
    for row in section.rows:
        for run, result in sorted(row.members, key=lambda m: m[0].config["seed"]):
            file = run.path / f"rollout-{result['variant']}.gif"
            if row.split == "test" and file.exists():
                gif = base64.b64encode(file.read_bytes()).decode()
                found.append({"label": row.label, "seed": run.config["seed"], "gif": gif})
                break
    return found[-VARIANTS:]


def player(section: Section, row: Row, run: Run, arrays: dict[str, np.ndarray]) -> dict | None:
    """One variant's episodes, or None where the states are not those of agents on a plane with landmarks."""
    spec, n = run.config["spec"], run.config["spec"]["n_agents"]
    states = arrays["states"][:EPISODES].astype(np.float64)
    if states.shape[-1] != 6 * n or "radius" not in section.hazard:
        return None
    plans = tracks(arrays, spec["feature_names"], n, run.config["config"].get("history", 0))
    arena = getattr(registry.TASKS[section.task].env, "half_width", 1.0) if section.task in registry.TASKS else 1.0
    episodes = []
    for e in range(len(states)):
        places = np.abs(np.concatenate([states[e, :, : 2 * n].ravel(), states[e, 0, 4 * n :]]))
        told = {
            "reach": round(max(arena, float(places.max())) + 0.2, 2),  # half the width of what is shown
            "positions": pack(states[e, :, : 2 * n]),
            "landmarks": pack(states[e, 0, 4 * n :]),
            "rewards": [round(float(x), 2) for x in arrays["rewards"][e]],
            "costs": [round(float(x), 2) for x in arrays["costs"][e]],
        }
        if plans is not None:
            told |= few(plans[e], np.asarray(arrays["chosen"][e]) if "chosen" in arrays else None)
        episodes.append(told)
    return {
        "label": row.label,
        "seed": run.config["seed"],
        "agents": n,
        "steps": states.shape[1] - 1,
        "arena": arena,
        "radius": section.hazard["radius"] / 2,
        "contact": section.hazard["radius"],
        "total": int(plans.shape[2]) if plans is not None else 0,
        "episodes": episodes,
    }


def tracks(arrays: dict[str, np.ndarray], names: list[str], n: int, history: int) -> np.ndarray | None:
    """Plans (R, L, P, H, N, 2): positions from the present on; steps without a new plan repeat the last one."""
    if "plans" not in arrays:
        return None
    plans = arrays["plans"][:EPISODES, :, :, history:].astype(np.float64)
    if "own.x" in names:
        xy = plans[..., [names.index("own.x"), names.index("own.y")]]
    elif "agent0.x" in names:  # every agent plans the whole state: each is shown its own part
        pairs = [[names.index(f"agent{i}.x"), names.index(f"agent{i}.y")] for i in range(n)]
        xy = np.stack([plans[..., i, pairs[i]] for i in range(n)], -2)
    else:
        return None
    for t in range(1, xy.shape[1]):
        stale = ~plans[:, t].any(axis=(1, 2, 3, 4))
        xy[stale, t] = xy[stale, t - 1]
    return xy


def few(plans: np.ndarray, chosen: np.ndarray | None) -> dict:
    """An episode's plans (L, P, H, N, 2) within the budget, the chosen one first."""
    steps, p, h, n, _ = plans.shape
    keep = int(np.clip(NUMBERS // (steps * h * n * 2), 1, p))
    chosen = np.zeros(steps, int) if chosen is None else chosen
    chosen = np.broadcast_to(chosen.reshape(steps, -1), (steps, n))  # agents that execute apart choose apart
    order = np.argsort(np.arange(p)[None, :, None] != chosen[:, None], axis=1, kind="stable")[:, :keep]
    kept = np.take_along_axis(plans, order[:, :, None, :, None], 1)
    return {"plans": pack(kept), "shape": [steps, keep, h, n]}


def pack(metres: np.ndarray) -> str:
    """Rounded to millimetres."""
    whole = np.clip(np.nan_to_num(np.round(metres * 1000)), -32768, 32767).astype("<i2")
    return base64.b64encode(whole.tobytes()).decode()


def unpack(text: str) -> np.ndarray:
    """Inverse of `pack`, flat."""
    return np.frombuffer(base64.b64decode(text), "<i2") / 1000
