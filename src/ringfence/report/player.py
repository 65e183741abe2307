"""What the player of episodes shows (player.js): places and plans as whole numbers of a unit, millimetres or coarser.

Pictures of every frame, as matplotlib writes them, would be tens of times as large, and of one ink."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ringfence.datasets import registry
from ringfence.errors import UserError
from ringfence.evaluation import recordings
from ringfence.evaluation.places import LONGEST
from ringfence.evaluation.table import Row
from ringfence.report.table import Line, Section
from ringfence.utils.files import regular, within

EPISODES = 4  # per variant
VARIANTS = 2  # per task
LARGEST = 2**26  # bytes of a film
MILLIMETRE = 1e-3
NUMBERS = 20_000  # of an episode's plans; more plans than fit are left out, never the chosen one


@dataclass(frozen=True)
class Recorded:
    """A line with the first recording of it."""

    line: Line
    row: Row
    arrays: recordings.Recording

    @property
    def plans(self) -> int:
        """How many plans every step drew."""
        return self.arrays["plans"].shape[2] if "plans" in self.arrays else 0

    @property
    def size(self) -> tuple[float, float]:
        """What it is chosen by: plans drawn, guidance by value."""
        return self.plans, (self.row.result.get("options") or {}).get("value_guidance", 0.0)


def of_line(line: Line) -> Recorded | None:
    """The first seed of a line that has a recording."""
    for row in line.rows:
        arrays = recordings.read(row.file.parent, row.name)
        if arrays is not None:
            return Recorded(line, row, arrays)
    return None


def players(section: Section) -> list[dict[str, Any]]:
    """At most two variants of a task: the planner with the most plans and one that draws a single plan."""
    found = [recorded for line in section.tables.get("test", []) if (recorded := of_line(line))]
    made = [p for chosen in _two(found) if (p := player(section, chosen))]
    for pair in zip(*(p["episodes"] for p in made)):  # the same resets at the same scale
        reach = max(episode["reach"] for episode in pair)
        for episode in pair:
            episode["reach"] = reach
    return made


def _two(found: list[Recorded]) -> list[Recorded]:
    """The one with the most plans; and the last one beside it, of a single plan and of its algorithm where there is
    one. Of equals the last, since the flagship is last in the table."""
    if not found:
        return []
    size = max(recorded.size for recorded in found)
    most = [recorded for recorded in found if recorded.size == size][-1]
    rest = [recorded for recorded in found if recorded is not most]
    single = [recorded for recorded in rest if recorded.plans <= 1] or rest
    same = [recorded for recorded in single if _family(recorded) == _family(most)]
    return [most, *(same or single)[-1:]][:VARIANTS]


def _family(recorded: Recorded) -> tuple[str, str]:
    return recorded.row.algorithm, recorded.row.preset


def films(section: Section) -> list[dict[str, Any]]:
    """GIFs of robots that lie beside recordings, at most two: {label, seed, gif (base64)}."""
    found = []
    for line in section.tables.get("test", []):
        for row in line.rows:
            file = recordings.kept(row.file.parent, row.name, "gif")
            if file is not None:
                gif = base64.b64encode(_film(row.file.parent, file)).decode()
                found.append({"label": line.label, "seed": row.seed, "gif": gif})
                break
    return found[-VARIANTS:]


def _film(folder: Path, file: Path) -> bytes:
    """A GIF that lies in the run's folder: a page that is passed on must hold no other file of its maker's."""
    try:
        size = regular(within(folder, file)).stat().st_size
        if size > LARGEST:
            raise ValueError(f"it is larger than {LARGEST / 2**20:.0f} MiB")
        content = file.read_bytes()
        if not content.startswith((b"GIF87a", b"GIF89a")):
            raise ValueError("it is no GIF")
    except (OSError, ValueError) as error:
        raise UserError(f"'{file}' is no film of this run ({error}); delete that file.") from None
    return content


@dataclass(frozen=True, eq=False)
class Moved:
    """What a film shows of R episodes."""

    places: np.ndarray  # (R, L+1, N, 2), nan after an episode's end
    landmarks: np.ndarray  # (R, K, 2)
    steps: list[int]  # of each episode
    middle: np.ndarray  # (R, 1, 2) of what is shown
    arena: float | None  # half of its width, where it has walls
    radius: float | None  # of bodies, where it is known
    plans: np.ndarray | None  # (R, L, P, H, N, 2)
    speeds: dict[str, float]  # steps per second, by name
    shows: str  # in words


def player(section: Section, recorded: Recorded) -> dict[str, Any] | None:
    """One variant's episodes, or None where nobody can be shown on a plane."""
    moved = (_of_places if "places" in recorded.arrays else _of_states)(section, recorded)
    if moved is None:
        return None
    contact = None if moved.radius is None else 2 * moved.radius
    return {
        "label": recorded.line.label,
        "seed": recorded.row.seed,
        "agents": moved.places.shape[2],
        "arena": moved.arena,
        "radius": moved.radius,
        "contact": contact,
        "total": int(moved.plans.shape[2]) if moved.plans is not None else 0,
        "speeds": moved.speeds,
        "shows": moved.shows,
        "episodes": [_episode(recorded.arrays, moved, e) for e in range(len(moved.places))],
    }


def _of_states(section: Section, recorded: Recorded) -> Moved | None:
    """States of agents on a plane with landmarks."""
    config = recorded.row.config
    n = config["spec"]["n_agents"]
    states = recorded.arrays["states"][:EPISODES].astype(np.float64)
    if states.shape[-1] != 6 * n or "radius" not in section.hazard:
        return None
    env = registry.TASKS[section.task].env if section.task in registry.TASKS else None
    episodes, rows = states.shape[:2]
    return Moved(
        places=states[..., : 2 * n].reshape(episodes, rows, n, 2),
        landmarks=states[:, 0, 4 * n :].reshape(episodes, n, 2),
        steps=[rows - 1] * episodes,
        middle=np.zeros((episodes, 1, 2)),
        arena=getattr(env, "half_width", 1.0),
        radius=section.hazard["radius"] / 2,
        plans=tracks(recorded.arrays, config["spec"]["feature_names"], n, config["config"].get("history", 0)),
        speeds={"slow": 1, "normal": 3, "real time": 10},
        shows="Circles are agents at their true radius, crosses are landmarks, red is contact. Thick coloured "
        "lines are the plan that is followed, faint ones the plans that were drawn and rejected.",
    )


def _of_places(section: Section, recorded: Recorded) -> Moved:
    """Where agents were in a simulator of somebody's own."""
    arrays = recorded.arrays
    places = arrays["places"][:EPISODES].astype(np.float64)
    landmarks = arrays["resting"][:EPISODES].astype(np.float64)
    begun = np.concatenate([places[:, 0], landmarks], 1)
    dt = section.card.get("dt")
    per_second = 10.0 if dt is None else 1 / dt
    radius = section.hazard["radius"] / 2 if "radius" in section.hazard else None
    red = "agents that are charged a cost" if "agent_costs" in arrays else ""
    red = red if radius is None else "agents nearer than is allowed"  # as the player marks them
    steps = [int(n) for n in np.isfinite(arrays["rewards"][:EPISODES]).sum(1)]
    return Moved(
        places=places,
        landmarks=landmarks,
        steps=steps,
        middle=(begun.min(1, keepdims=True) + begun.max(1, keepdims=True)) / 2,
        arena=None,
        radius=radius,
        plans=None,
        speeds={"slow": per_second / 4, "normal" if dt is None else "real time": per_second, "fast": 4 * per_second},
        shows="Agents where their observations put them, from above; crosses are goals and what else rests."
        + (f" Red are {red}." if red else "")
        + (f" An episode's first {LONGEST} steps are kept." if max(steps) >= LONGEST else ""),
    )


def _episode(arrays: recordings.Recording, moved: Moved, e: int) -> dict[str, Any]:
    """The e-th episode."""
    steps = moved.steps[e]
    positions = _kept_on(moved.places[e]) - moved.middle[e]
    landmarks = moved.landmarks[e] - moved.middle[e]
    reach = float(np.abs(np.concatenate([positions.reshape(-1, 2), landmarks])).max())
    shown = reach * 1.1 + 1e-3 if moved.arena is None else max(moved.arena, reach) + 0.2
    unit = max(MILLIMETRE, float(f"{shown / 30_000:.1e}"))
    episode: dict[str, Any] = {
        "reach": float(f"{shown:.3g}") if moved.arena is None else round(shown, 2),  # half the width of what is shown
        "unit": unit,
        "steps": steps,
        "positions": in_units(positions, unit),
        "landmarks": in_units(landmarks, unit),
        "rewards": [round(float(x), 2) for x in np.nan_to_num(arrays["rewards"][e, :steps])],
        "costs": [round(float(x), 2) for x in np.nan_to_num(arrays["costs"][e, :steps])],
    }
    if moved.radius is None and "agent_costs" in arrays:
        charged = arrays["agent_costs"][e, :steps] > 0
        episode["charged"] = [[], *([int(i) for i in np.flatnonzero(one)] for one in charged)]
    if moved.plans is not None:
        episode["plans"] = few(moved.plans[e], np.asarray(arrays["chosen"][e]) if "chosen" in arrays else None)
    return episode


def _kept_on(places: np.ndarray) -> np.ndarray:
    """Places (L+1, N, 2) where who is not shown any more stays where he was; the first row is known."""
    known = np.isfinite(places).all(-1)
    last = np.maximum.accumulate(np.where(known, np.arange(len(places))[:, None], 0), 0)
    return np.take_along_axis(places, last[..., None], 0)


def tracks(arrays: recordings.Recording, names: list[str], n: int, history: int) -> np.ndarray | None:
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


def few(plans: np.ndarray, chosen: np.ndarray | None) -> list[Any]:
    """An episode's plans (L, P, H, N, 2) within the budget, the chosen one first."""
    steps, drawn, horizon, n, _ = plans.shape
    keep = int(np.clip(NUMBERS // (steps * horizon * n * 2), 1, drawn))
    chosen = np.zeros(steps, int) if chosen is None else chosen
    chosen = np.broadcast_to(chosen.reshape(steps, -1), (steps, n))  # agents that execute apart choose apart
    rejected = np.arange(drawn)[None, :, None] != chosen[:, None]
    order = np.argsort(rejected, axis=1, kind="stable")[:, :keep]
    return in_units(np.take_along_axis(plans, order[:, :, None, :, None], 1), MILLIMETRE)


def in_units(metres: np.ndarray, unit: float) -> list[Any]:
    """Nested lists of whole numbers of a unit, 0 where nothing is known."""
    return np.nan_to_num(np.round(metres / unit)).astype(int).tolist()
