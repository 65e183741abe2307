"""Put tables, figures, animations and provenance on one page that needs nothing but itself.

Its player of episodes (player.js) shows places and plans as whole numbers of a unit, millimetres or coarser. Pictures
of every frame, as matplotlib writes them, would be tens of times as large, and of one ink.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from ringfence.datasets import registry
from ringfence.errors import UserError
from ringfence.evaluation import recordings, reference, statistics
from ringfence.evaluation.recordings import LONGEST
from ringfence.evaluation.statistics import Interval
from ringfence.evaluation.table import Row
from ringfence.logs.schema import regenerated
from ringfence.problem import constraints
from ringfence.report import figures, html, provenance
from ringfence.report.html import share
from ringfence.report.table import Line, Method, Section, mean_of, sections
from ringfence.training.runs import Run
from ringfence.utils.files import regular, within

TEMPLATE = "page.html.j2"
WORDS = {  # constraint -> (what the cost counts, what a violation is)
    "Separation": ("collision steps", "a collision"),
    "SpeedLimit": ("steps above the speed limit", "a step above the speed limit"),
}
EPISODES = 4  # per variant
VARIANTS = 2  # per task
LARGEST = 2**26  # bytes of a film
MILLIMETRE = 1e-3
NUMBERS = 20_000  # of an episode's plans; more plans than fit are left out, never the chosen one


def build_report(
    runs: Iterable[Run | str | Path] | Run | str | Path, out: str | Path, title: str | None = None
) -> Path:
    """Write one self-contained HTML page about evaluated runs and return its path.

    `runs` are run folders, or one of them; `out` is the page, or a folder that gets `report.html`. Runs of several
    tasks get a section each. `UserError` where a run has not been evaluated or numbers must not be compared.
    """
    found = sections(runs)
    out = html.page_file(out)
    context = {
        "title": title or "Ringfence report: " + ", ".join(s.task for s in found),
        "board": None,
        "js": Markup(html.asset("player.js")),
        "sections": [of_section(s, k) | _of_runs(s, k, out) for k, s in enumerate(found)],
        "environments": provenance.environments([run for s in found for run in s.runs]),
    }
    return html.write(out, html.render(TEMPLATE, context))


@dataclass(frozen=True)
class SplitTable:
    """The lines of one split, and what stands below them."""

    split: str
    lines: list[Line]
    references: list[Line]  # of the first split alone
    constraints: list[ConstraintLine]
    guards: list[GuardLine]


@dataclass(frozen=True)
class GuardLine:
    """What the guard of a line says of itself."""

    line: Line
    verdict: str | None  # of its World; None of results of before
    infeasible: float  # share of the steps in which no action kept the margin
    ood: float | None  # share of the steps that the logs do not cover


@dataclass(frozen=True)
class ConstraintLine:
    """What a named constraint cost a line, mean of its runs; None where the runs do not say."""

    line: Line
    name: str
    cost_mean: float | None
    violation_rate: float | None
    limit: float | None
    limit_satisfied_rate: float | None


def of_section(section: Section, k: int) -> dict[str, Any]:
    """What every page shows of a task."""
    unit, _ = words_of(section.hazard)
    first = next(iter(section.tables), "")
    shown = [*section.lines, *section.references]
    tables = []
    for split, lines in section.tables.items():
        beside = [line for line in section.references if split == first and line.rows[0].split in (split, "data")]
        tables.append(SplitTable(split, lines, beside, constraint_table(lines), guard_table(lines)))
    return {
        "id": f"task{k}",
        "task": section.task,
        "short": section.task,
        "unit": unit,
        "headline": headline(section),
        "tables": tables,
        # What a page of runs or of a board has beside it, or neither.
        **dict.fromkeys(("absent", "contests", "files"), ()),
        **dict.fromkeys(("curves", "fields", "players", "films", "simulated", "commands"), ()),
        "ends": any(line.ended for line in shown),
        "danger": danger(section.hazard),
        "constants": section.constants,
        "limits": {name: limit for line in section.lines for name, limit in line.limits.items()},
        "ceiling": section.card.get("return_ceiling"),
        "protocol": section.protocol,
        "scatter": figures.scatter(section, tables[0].lines, f"{unit} per episode", f"s{k}") if tables else None,
        "card": provenance.facts(section.card),
        "regenerated": regenerated(section.card),
    }


def _of_runs(section: Section, k: int, out: Path) -> dict[str, Any]:
    """What the page of runs shows beside that."""
    recorded = players(section)
    simulated = registry.simulated(section.task, constraints.from_dict(section.hazard)) if section.hazard else None
    families = {_family_name(m): line.style[0] for line in section.lines if (m := line.method)}
    return {
        "curves": figures.training_curves(section.lines, f"t{k}"),
        "families": families,
        "fields": _fields(section, k),
        "players": recorded,
        "players_json": Markup(json.dumps(recorded, separators=(",", ":")).replace("<", "\\u003c")),
        "films": films(section),
        "film_shows": getattr(simulated.env, "film_shows", "") if simulated else "",
        "simulated": simulated is not None,
        "commands": provenance.commands(section, out),
        "differences": provenance.differences(section.runs),
    }


def guard_table(lines: list[Line]) -> list[GuardLine]:
    """What guards say, of each line that was played under one."""
    found = []
    for line in lines:
        results = [row.result for row in line.rows]
        infeasible = mean_of(results, "infeasible_rate")
        if infeasible is None:
            continue
        verdicts = {result.get("verdict") for result in results}
        verdict = verdicts.pop() if len(verdicts) == 1 else None
        found.append(GuardLine(line, verdict, infeasible, mean_of(results, "ood_rate")))
    return found


def constraint_table(lines: list[Line]) -> list[ConstraintLine]:
    """Each named constraint of the lines whose simulator names them."""
    found = []
    for line in lines:
        costs = [row.result["constraints"] for row in line.rows if "constraints" in row.result]
        if not costs or len(costs) < len(line.rows):
            continue
        for name in costs[0]:
            runs = [by_name[name] for by_name in costs if name in by_name]
            keys = ("cost_mean", "violation_rate", "limit", "limit_satisfied_rate")
            found.append(ConstraintLine(line, name, *(mean_of(runs, key) for key in keys)))
    return found


def _family_name(method: Method) -> str:
    return method.name if method.preset == "default" else f"{method.name} {method.preset}"


def _fields(section: Section, k: int) -> list[dict[str, Any]]:
    """Pictures of learned barriers, one per algorithm and preset; what cannot be loaded is said, not hidden."""
    first: dict[str, Row] = {}
    for line in section.lines:
        if line.method is not None and line.rows[0].config["config"].get("barrier"):
            first.setdefault(_family_name(line.method), line.rows[0])
    found: list[dict[str, Any]] = []
    for name, row in first.items():
        assert row.run is not None, "a method's row"
        state = _lonely_state(row.run, row.config["spec"]["n_agents"])
        entry: dict[str, Any] = {"name": name, "seed": row.seed}
        try:
            drawn = figures.field(row.run, state, f"b{k}-{len(found)}")
        except UserError as error:
            found.append(entry | {"missing": str(error)})
            continue
        if drawn is not None:
            found.append(entry | {"field": drawn})
    return found


def _lonely_state(run: Run, n: int) -> np.ndarray | None:
    """A recorded state in which agent 0 is farthest from the agents 2, 3, ...: they must not decide its barrier. None
    where none was kept."""
    for variant in run.results:
        recorded = recordings.read(run.path, variant)
        if recorded is not None and "states" in recorded:
            flat = recorded["states"].reshape(-1, recorded["states"].shape[-1])
            if flat.shape[-1] != 6 * n:
                return None
            position = flat[:, : 2 * n].reshape(-1, n, 2)
            far = np.linalg.norm(position[:, 2:] - position[:, :1], axis=-1)
            return flat[far.min(1).argmax()] if n > 2 else flat[0]
    return None


def words_of(hazard: dict[str, Any]) -> tuple[str, str]:
    """(what the cost counts, what a violation is)."""
    return WORDS.get(hazard.get("kind", ""), ("cost", "a violation"))


def danger(hazard: dict[str, Any]) -> str:
    """What a cost is charged for, in words; empty where there is no formula."""
    if hazard.get("kind") == "SpeedLimit":
        return f"a speed above {hazard['limit']:g} m/s"
    return f"a distance below {hazard['radius']:g} m" if hazard.get("kind") == "Separation" else ""


def headline(section: Section) -> list[str]:
    """The outcome in plain sentences, from the numbers of test resets."""
    rows = section.tables.get("test", [])
    if not rows:
        return ["Only validation results exist: settings can be chosen from them, but no result can be claimed."]
    unit, event = words_of(section.hazard)
    cost_limit = section.constants["cost_limit"]
    counted = unit.replace("steps", "step") if cost_limit == 1 else unit
    limit = f"the limit of {cost_limit:g} {counted} per episode"
    limits = {name: limit for row in rows for name, limit in row.limits.items()}
    if limits:
        each = ", ".join(f"{name} {own:g}" for name, own in limits.items())
        limit = f"the limit of each constraint ({each} per episode)"
    safe = [row for row in rows if row.safe]
    sentences = _best(rows, safe, section.references, limit, unit, event) if safe else _nearest(rows, limit)
    for row in section.references:
        if row.name == reference.LOGS:
            sentences.append(
                f"The data itself has a return of {row.returns:.1f} and {row.cost:.3f} {unit} per episode, and {event} "
                f"in {share(row.violation_rate)} of all."
            )
            most = max(rows, key=lambda row: row.violation_rate)
            low, _ = statistics.clopper_pearson(most.violations, most.episodes)
            if low > 1.5 * row.violation_rate and low - row.violation_rate >= 0.05:  # clearly more than its logs
                unsafe = share(most.violation_rate)
                sentences.append(f"{most.label} has {event} in {unsafe} of its episodes, more than the data has.")
    return sentences


def _nearest(rows: Sequence[Line], limit: str) -> list[str]:
    """Where nobody keeps the limit."""
    if any(row.limits for row in rows):
        least = min(rows, key=lambda row: row.cost_norm)
        return [
            f"No method keeps its costs within {limit}. {least.label} comes nearest, with {least.cost_norm:.3g} times "
            f"the limit of its worst constraint, at a return of {least.returns:.1f}."
        ]
    least = min(rows, key=lambda row: row.cost)
    return [
        f"No method keeps its cost within {limit}. {least.label} comes nearest, with {least.cost:.3f} "
        f"(95 % interval {_range(least.cost_interval, 3)}) at a return of {least.returns:.1f}."
    ]


def _best(
    rows: Sequence[Line], safe: Sequence[Line], references: Sequence[Line], limit: str, unit: str, event: str
) -> list[str]:
    """Of the method that earns most within the limit, and of those near it."""
    best = max(safe, key=lambda row: row.returns)
    seeds = f"{len(best.seeds)} {'seed' if len(best.seeds) == 1 else 'seeds'}"
    sentences = [
        f"{_lead(best, len(rows), len(safe), limit)} {best.returns:.1f} per episode (95 % interval "
        f"{_range(best.returns_interval, 1)}), with {event} in {share(best.violation_rate)} of {best.episodes:,} "
        f"episodes ({seeds}), at most {share(best.violation_upper)} with 95 % confidence."
    ]
    ahead = [row for row in references if row.safe and row.returns > best.returns]
    if ahead:
        named = _and([f"{row.name} ({row.returns:.1f})" for row in ahead])
        sentences.append(f"References within the limit that earn more: {named}.")
    near = [row for row in safe if row is not best and row.returns_interval[1] >= best.returns_interval[0]]
    if near:
        overlap = "interval of {} overlaps" if len(near) == 1 else "intervals of {} overlap"
        sentences.append(f"The {overlap.format(_and([row.label for row in near]))} with its own.")
    least = min(rows, key=lambda row: (row.cost_safe_start, -row.returns))
    if least is not best:
        sentences.append(
            f"Fewest {unit} in episodes that start safe: {least.label}, {least.cost_safe_start:.3f} against "
            f"{best.cost_safe_start:.3f}, at a return of {least.returns:.1f}."
        )
    return sentences


def _lead(best: Line, methods: int, safe: int, limit: str) -> str:
    """How a sentence on the best of `safe` among `methods` begins; its return follows."""
    if methods == 1:
        return f"{best.label} keeps its cost within {limit} and earns a return of"
    if safe == 1:
        return f"{best.label} is the only one of {methods} methods that stays within {limit}, at a return of"
    some = f"{methods} methods, all" if safe == methods else f"{safe} of {methods} methods that stay"
    return f"{best.label} earns the highest return of the {some} within {limit}:"


def _and(names: list[str]) -> str:
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1]


def _range(interval: Interval, digits: int) -> str:
    return f"{interval[0]:.{digits}f} to {interval[1]:.{digits}f}"


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
        return self.plans, (self.row.result.get("options") or {}).get("value_guidance") or 0.0


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
                # A GIF that lies in the run's folder: a page that is passed on must hold no other file of its maker's.
                try:
                    size = regular(within(row.file.parent, file)).stat().st_size
                    if size > LARGEST:
                        raise ValueError(f"it is larger than {LARGEST / 2**20:.0f} MiB")
                    content = file.read_bytes()
                    if not content.startswith((b"GIF87a", b"GIF89a")):
                        raise ValueError("it is no GIF")
                except (OSError, ValueError) as error:
                    raise UserError(f"'{file}' is no film of this run ({error}); delete that file.") from None
                gif = base64.b64encode(content).decode()
                found.append({"label": line.label, "seed": row.seed, "gif": gif})
                break
    return found[-VARIANTS:]


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
    # Places (L+1, N, 2) where who is not shown any more stays where he was; the first row is known.
    places = moved.places[e]
    known = np.isfinite(places).all(-1)
    last = np.maximum.accumulate(np.where(known, np.arange(len(places))[:, None], 0), 0)
    positions = np.take_along_axis(places, last[..., None], 0) - moved.middle[e]
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
