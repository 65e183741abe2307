"""Put tables, figures, animations and provenance on one page that needs nothing but itself."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable
from pathlib import Path

import jinja2
from markupsafe import Markup

from ringfence import __version__, algos
from ringfence.datasets import registry
from ringfence.errors import UserError
from ringfence.evaluation import recordings
from ringfence.evaluation.protocol import of_last_step
from ringfence.guards import GuardOptions, options_of
from ringfence.logs.provenance import regenerated
from ringfence.problem import constraints
from ringfence.proposals.options import PLANNERS, PlanOptions
from ringfence.report import animation, figures
from ringfence.report.pooling import mean_of
from ringfence.report.table import NAMES, Row, Section, sections
from ringfence.training.runs import Run
from ringfence.utils import schemas, stored
from ringfence.utils.escape import shell
from ringfence.utils.files import whole

HERE = Path(__file__).parent
WORDS = {  # hazard -> (what the cost counts, what a violation is)
    "Separation": ("collision steps", "a collision"),
    "SpeedLimit": ("steps above the speed limit", "a step above the speed limit"),
}


def build_report(
    runs: Iterable[Run | str | Path] | Run | str | Path, out: str | Path, title: str | None = None
) -> Path:
    """Write one self-contained HTML page about evaluated runs and return its path.

    `runs` are run folders, or one of them; `out` is the page, or a folder that gets `report.html`. Runs of several
    tasks get a section each. `UserError` where a run has not been evaluated or numbers must not be compared.
    """
    found = sections(runs)
    out = Path(out)
    out = out / "report.html" if out.is_dir() else out
    context = {
        "title": title or "Ringfence report: " + ", ".join(s.task for s in found),
        "js": Markup(_asset("player.js")),
        "sections": [_section(s, k, out) for k, s in enumerate(found)],
    }
    return _write(out, render("template.html.j2", context))


def render(template: str, context: dict) -> str:
    """A page from one of the templates beside this file; a name that the context lacks is an error."""
    engine = jinja2.Environment(
        loader=jinja2.FileSystemLoader(HERE),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    engine.filters |= {"count": _count, "share": share, "number": _number, "duration": _duration}
    engine.filters |= {"signed": _signed, "probability": _probability}
    return engine.get_template(template).render(version=__version__, css=Markup(_asset("style.css")), **context)


def _asset(name: str) -> str:
    return (HERE / name).read_text(encoding="utf-8")


def _write(path: Path, text: str) -> Path:
    with whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path


def _film_shows(section: Section) -> str:
    """What films of a task show, in words; empty where its simulator draws none."""
    task = registry.simulated(section.task, constraints.from_dict(section.hazard)) if section.hazard else None
    return "" if task is None else getattr(task.env, "film_shows", "")


def _section(section: Section, k: int, out: Path) -> dict:
    unit, event = WORDS.get(section.hazard.get("kind"), ("cost", "a violation"))
    test = section.tables.get("test", [])
    recorded = animation.players(section)
    return {
        "id": f"task{k}",
        "task": section.task,
        "unit": unit,
        "headline": headline(section),
        "tables": [
            {
                "split": split,
                "rows": rows,
                "references": section.references if split == "test" else [],
                "constraints": constraint_table(rows),
            }
            for split, rows in section.tables.items()
        ],
        "constants": section.constants,
        "ceiling": section.card.get("return_ceiling"),
        "protocol": section.protocol,
        "several_seeds": any(len(r.seeds) > 1 for r in section.rows),
        "colours": figures.COLOURS,
        "scatter": Markup(figures.scatter(section, test, f"{unit} per episode", f"s{k}")) if test else None,
        "curves": [p | {"svg": Markup(p["svg"])} for p in figures.training_curves(section.rows, f"t{k}")],
        "families": _families(section.rows),
        "fields": _fields(section, k),
        "players": recorded,
        "films": animation.films(section),
        "film_shows": _film_shows(section),
        "players_json": Markup(json.dumps(recorded).replace("<", "\\u003c")),
        "commands": commands(section, out),
        "differences": differences(section),
        "environments": environments(section.runs),
        "card": facts(section.card),
        "regenerated": regenerated(section.card),
    }


def constraint_table(rows: list[Row]) -> list[dict]:
    """What each named constraint cost the rows whose simulator told them apart, mean of their runs."""
    found = []
    for row in rows:
        told = [result["constraints"] for _, result in row.members if "constraints" in result]
        for name in told[0] if len(told) == len(row.members) and told else ():
            each = [t[name] for t in told if name in t]
            line = {k: mean_of(each, k) for k in ("cost_mean", "violation_rate", "limit", "limit_satisfied_rate")}
            found.append({"row": row, "name": name, **line})
    return found


# --- words ---


def headline(section: Section) -> list[str]:
    """The outcome in plain sentences, from the numbers of the test split."""
    rows = section.tables.get("test", [])
    if not rows:
        return ["Only validation results exist: settings can be chosen from them, but no result can be claimed."]
    unit, event = WORDS.get(section.hazard.get("kind"), ("cost", "a violation"))
    most = section.constants["cost_limit"]
    limit = f"the limit of {most:g} {unit.replace('steps', 'step') if most == 1 else unit} per episode"
    safe = [r for r in rows if r.safe]
    said = []
    if not safe:
        least = min(rows, key=lambda r: r.cost)
        said.append(
            f"No method keeps its cost within {limit}. {least.label} comes nearest, with {least.cost:.3f} "
            f"(95 % interval {_range(least.cost_interval, 3)}) at a return of {least.returns:.1f}."
        )
    else:
        best = max(safe, key=lambda r: r.returns)
        lead = (
            f"{best.label} keeps its cost within {limit} and earns a return of"
            if len(rows) == 1
            else f"{best.label} is the only one of {len(rows)} methods that stays within {limit}, at a return of"
            if len(safe) == 1
            else f"{best.label} earns the highest return of the {_of(len(safe), len(rows))} within {limit}:"
        )
        said.append(
            f"{lead} {best.returns:.1f} per episode (95 % interval {_range(best.returns_interval, 1)}), with {event} "
            f"in {share(best.violation_rate)} of {best.episodes:,} episodes "
            f"({len(best.seeds)} seed{'s' * (len(best.seeds) != 1)}), at most {share(best.violation_upper)} "
            "with 95 % confidence."
        )
        ahead = [r for r in section.references if r.safe and r.returns > best.returns]
        if ahead:
            named = _and([f"{r.name} ({r.returns:.1f})" for r in ahead])
            said.append(f"References within the limit that earn more: {named}.")
        near = [r for r in safe if r is not best and r.returns_interval[1] >= best.returns_interval[0]]
        if near:
            verb = "overlaps" if len(near) == 1 else "overlap"
            noun = "interval" if len(near) == 1 else "intervals"
            said.append(f"The {noun} of {_and([r.label for r in near])} {verb} with its own.")
        calm = min(rows, key=lambda r: (r.cost_safe_start, -r.returns))
        if calm is not best:
            said.append(
                f"Fewest avoidable {unit}: {calm.label}, {calm.cost_safe_start:.3f} per episode against "
                f"{best.cost_safe_start:.3f}, at a return of {calm.returns:.1f}."
            )
    data = next((r for r in section.references if r.name == "behaviour data"), None)
    if data:
        said.append(f"The data itself has a return of {data.returns:.1f} and {data.cost:.3f} {unit} per episode.")
    return said


def danger(hazard: dict) -> str:
    """What a cost is charged for, in words; empty where there is no formula."""
    if hazard.get("kind") == "SpeedLimit":
        return f"a speed above {hazard['limit']:g} m/s"
    return f"a distance below {hazard['radius']:g} m" if hazard.get("kind") == "Separation" else ""


def _of(part: int, whole: int) -> str:
    return f"{whole} methods, all" if part == whole else f"{part} of {whole} methods that stay"


def _and(names: list[str]) -> str:
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1]


def _range(interval: tuple[float, float], digits: int) -> str:
    return f"{interval[0]:.{digits}f} to {interval[1]:.{digits}f}"


def share(x: float) -> str:
    """A probability as a percentage that never rounds a danger away."""
    percent = 100 * x
    return f"{percent:.1f} %" if percent >= 1 or percent == 0 else f"{percent:.2f} %"


def _number(x: float, digits: int) -> str:
    return f"{x:,.{digits}f}".replace("-", "−")


def _signed(x: float, digits: int) -> str:
    return f"{x:+,.{digits}f}".replace("-", "−")


def _probability(p: float) -> str:
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


def _count(x: int | None) -> str:
    if x is None:
        return "–"
    for size, letter in ((1e6, " M"), (1e3, " k")):
        if x >= size:
            return f"{x / size:.3g}{letter}"
    return str(x)


def _duration(seconds: float | None) -> str:
    return "–" if seconds is None else f"{seconds:,.0f}"


# --- figures ---


def _families(rows: list[Row]) -> list[dict]:
    """Algorithm and preset with their colour, for the legend of the training curves."""
    seen = {}
    for r in rows:
        preset = "" if r.preset == "default" else r.preset
        name = f"{NAMES.get(r.algorithm, r.algorithm)} {preset}".strip()
        seen.setdefault((r.algorithm, r.preset), {"name": name, "colour": r.style[0] % figures.COLOURS})
    return list(seen.values())


def _fields(section: Section, k: int) -> list[dict]:
    """Pictures of learned barriers, one per algorithm and preset; what cannot be loaded is said, not hidden."""
    found, seen = [], set()
    for row in section.rows:
        run = min((m[0] for m in row.members), key=lambda r: r.config["seed"])
        family = row.algorithm, row.preset
        if family in seen or not run.config["config"].get("barrier"):
            continue
        seen.add(family)
        preset = "" if row.preset == "default" else row.preset
        entry = {"name": f"{row.name} {preset}".strip(), "seed": run.config["seed"]}
        recorded = (recordings.read(run.path, variant) for variant in run.results)
        kept = next((r for r in recorded if r is not None), None)
        n = run.config["spec"]["n_agents"]
        usable = kept is not None and kept["states"].shape[-1] == 6 * n
        try:
            state = figures.lonely_state(kept["states"], n) if usable else None
            drawn = figures.barrier_field(run, state, f"b{k}-{len(found)}")
        except UserError as error:
            found.append(entry | {"missing": str(error)})
            continue
        if drawn:
            found.append(entry | drawn | {"svg": Markup(drawn["svg"]), "real": usable})
    return found


# --- how it was made ---


def commands(section: Section, out: Path) -> list[str]:
    """Shell lines that make this section's numbers again."""
    card, lines = section.card, []
    data = shell(section.task)
    if regenerated(card):
        steps = card.get("size", card.get("transitions"))
        full = registry.TASKS[section.task].transitions if section.task in registry.TASKS else None
        if card.get("seed", 0) == 0 and steps in (None, full):
            lines.append(
                f"ringfence data make {shell(section.task)}" + ("" if steps else "  # its size was not recorded")
            )
        else:
            data = shell(f"{section.task}.h5")
            size = f" --size {steps}" if steps else ""
            lines.append(f"ringfence data make {shell(section.task)}{size} --seed {card.get('seed', 0)} --out {data}")
    else:
        data = "DATA.h5"
    jobs: dict[tuple[str, str, str, str], list[Run]] = {}
    for run in section.runs:
        told = run.config
        changed = json.dumps(_changes(told, preset=True), sort_keys=True)
        root = str(run.path.parent.parent.parent)
        jobs.setdefault((told["algorithm"], told["preset"], changed, root), []).append(run)
    for (algorithm, preset, changed, root), members in jobs.items():
        line = ["ringfence", "train", shell(algorithm), data]
        if preset != _usual_preset(algorithm, section.task):
            line += ["--preset", shell(preset)]
        for first, count in _stretches(sorted(r.config["seed"] for r in members)):
            tail = [f"--seeds {count}"] + ([f"--first-seed {first}"] if first else [])
            if root != "runs":
                tail.append(f"--out {shell(root)}")
            if given := json.loads(changed):
                tail.append("--set " + " ".join(shell(f"{k}={v}") for k, v in given.items()))
            lines.append(" ".join(line + tail))
    evaluations: dict[tuple, list[str]] = {}
    for row in section.rows:
        for run, result in row.members:
            given = _how(result, run)
            split = " --split validation" if row.split == "validation" else ""
            step = "" if of_last_step(result, run.config["config"]) else f" --step {result['step']}"
            how = f"--episodes {result['episodes']}{split}{step} {given}".strip()
            word = f"play --env {shell(result['simulator'])}" if result.get("simulator") else "eval"
            evaluations.setdefault((word, how), []).append(shell(run.path))
    for (word, how), paths in evaluations.items():
        command, *env = word.split(" ", 1)
        lines.append(" ".join(["ringfence", command, *dict.fromkeys(paths), *env, how]))
    roots = dict.fromkeys(shell(r.path.parent.parent) for r in section.runs)
    lines.append(f"ringfence report {' '.join(roots)} --out {shell(out)}")
    return lines


def _usual_preset(algorithm: str, task: str) -> str:
    """The preset that training takes without being told one; no name where that is not known."""
    known = algos.ALGORITHMS.get(algorithm)
    return known.preset_for(registry.TASKS[task].presets if task in registry.TASKS else ()) if known else ""


def _how(result: dict, run: Run) -> str:
    """The options of `ringfence eval` that gave a result."""
    planner, name = result.get("planner", "default"), result.get("guard", "none")
    task = registry.TASKS.get(run.config["task"])
    words = [f"--planner {planner}"] if planner != "default" else []
    team = run.config.get("team") if task is None else task.env.n_agents
    words += [f"--agents {result['agents']}"] if result.get("agents") not in (None, team) else []
    planners = {stored.PLANNERS.get(known, known): options for known, options in PLANNERS.items()}
    usual = stored.planner_options(dataclasses.asdict(PlanOptions()) | planners.get(planner, {}))
    given = {k: v for k, v in (result.get("options") or {}).items() if v != usual.get(k)}
    if result.get("guard_options"):
        words += [f"--guard {name} --barrier {result['barrier']}"]
        words += [f"--execution {result['execution']}"] if result["execution"] != "centralized" else []
        usual = options_of(name, result["barrier"], {} if task is None else task.guard)
        usual = stored.guard_options(dataclasses.asdict(GuardOptions()) | usual)
        given |= {k: v for k, v in result["guard_options"].items() if v != usual.get(k)}
    if given:
        words.append("--set " + " ".join(shell(f"{k}={v}") for k, v in given.items()))
    return " ".join(words)


def _stretches(seeds: list[int]) -> list[tuple[int, int]]:
    """[0, 1, 2, 5] -> [(0, 3), (5, 1)]"""
    found: list[list[int]] = []
    for s in seeds:
        if found and s == found[-1][0] + found[-1][1]:
            found[-1][1] += 1
        elif not found or s >= found[-1][0] + found[-1][1]:
            found.append([s, 1])
    return [(first, count) for first, count in found]


def _changes(told: dict, preset: bool) -> dict:
    """Config fields that differ from the defaults, or from the defaults and the preset together."""
    try:
        algorithm = algos.get(told["algorithm"])
    except UserError:
        return dict(told["config"])
    usual = {f.name: f.default for f in dataclasses.fields(algorithm.Config)}
    if preset:
        usual |= algorithm.presets.get(told["preset"], {})
    usual = json.loads(json.dumps(usual))  # as config.json has it: lists for tuples
    return {k: v for k, v in told["config"].items() if k not in usual or usual[k] != v}


def differences(section: Section) -> list[dict]:
    """Per job: the config fields that differ from the algorithm's defaults."""
    found = {}
    for run in section.runs:
        told = run.config
        changed = _changes(told, preset=False)
        key = (told["algorithm"], told["preset"], json.dumps(changed, sort_keys=True))
        name = f"{told['algorithm']} {told['preset']}"
        entry = found.setdefault(key, {"name": name, "changed": changed, "seeds": []})
        entry["seeds"].append(told["seed"])
    return list(found.values())


def environments(runs: list[Run]) -> list[dict]:
    """Distinct env.json of the runs, flattened, with the runs' names where there are several."""
    found: dict[str, dict] = {}
    for run in runs:
        file = run.path / "env.json"
        damaged = "has a damaged env.json; delete that file"
        told = schemas.read(file, schemas.Environment, damaged) if file.exists() else {}
        if told:
            entry = found.setdefault(json.dumps(told, sort_keys=True), {"facts": facts(told), "runs": []})
            entry["runs"].append(f"{run.path.parent.name}/{run.path.name}")
    return list(found.values())


def facts(told: dict) -> list[tuple[str, str]]:
    """A JSON object as rows of a list; long entries are cut, since the file itself lies in the run folder."""
    rows = []
    for name, value in told.items():
        if value in (None, [], {}, ""):
            continue
        if isinstance(value, dict):
            text = ", ".join(f"{k} {_plain(v)}" for k, v in value.items())
        elif isinstance(value, list):
            text = ", ".join(_plain(v) for v in value)
        else:
            text = _plain(value)
        rows.append((name.replace("_", " "), text if len(text) <= 400 else text[:400] + " …"))
    return rows


def _plain(value) -> str:
    if isinstance(value, float):
        return f"{value:.5g}"
    return value if isinstance(value, str) else json.dumps(value)
