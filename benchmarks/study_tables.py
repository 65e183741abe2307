"""Tables of single studies, from the file of results that each of them wrote (tables.py writes the pages)."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any

import ablations
import certificates
import numpy as np
import pooled
import public_sets
from common import markdown, of_json, read
from families import FAMILIES
from scipy.stats import spearmanr
from stress import FAULTS, KNOWN, RATES, in_words, name_of, trials
from systems import MAPPED, SHAPED, Kind

from ringfence.datasets.registry import TASKS
from ringfence.report.published import PUBLISHED

Rows = list[dict[str, str]]


def percent(x: Any, digits: str = ".3g") -> str:
    return f"{100 * float(x):{digits}}"


def bound(rate: Any, upper: Any, digits: str = ".3g", unit: str = "") -> str:
    """A rate and its upper bound, in percent; without the bound where there is none."""
    return percent(rate, digits) + unit + (f" (≤ {percent(upper, digits)}{unit})" if upper else "")


# Systems of systems.py.


def said(kinds: Sequence[Kind]) -> str:
    return markdown(("system", "what is dangerous"), [(f"`{kind.name}`", kind.says) for kind in kinds])


def shapes(file: str, kinds: Sequence[Kind], whole: str, less: str) -> str:
    """A row per logs and driver: alone, and under shields of two Worlds that differ in one thing. Percentage of
    episodes with a violation, return, and where a World guards its verdict."""
    order = [kind.name for kind in kinds]
    rows = {(r["system"], r["seed"], r["driver"], r["causes"], r["guard"]): r for r in read(file)}
    lines = []
    for name, seed in sorted({key[:2] for key in rows}, key=lambda of: (order.index(of[0]), int(of[1]))):
        for driver in ("naive", "clone"):
            ways = ((whole, "none"), (less, "shield"), (whole, "shield"))
            each = [rows.get((name, seed, driver, *way)) for way in ways]
            if all(each):
                lines.append((f"{name} {seed}", driver, *map(_short, each)))
    return markdown(("logs", "who acts", "no guard", f"shield, {less}", "shield"), lines)


def families() -> str:
    """A row per system: what was found, and the percentage of episodes with a violation, of the naive driver and of the
    clone, alone and under the shield; under that of a World without rules where this was played."""
    rows = {(r["system"], r["causes"], r["driver"], r["guard"]): r for r in read("families.csv")}
    lines = []
    for family in FAMILIES:
        for kind in (*family.open, *family.kept):
            alone, ruled, plain = (
                [rows.get((kind.name, causes, driver, guard)) for driver in ("naive", "clone")]
                for causes, guard in (("rules", "none"), ("rules", "shield"), ("no rules", "shield"))
            )
            if not all((*alone, *ruled)):
                continue
            kept = ", kept" if kind in family.kept else ""
            shares = [f"{percent(a['violated'])}, {percent(b['violated'])}" for a, b in zip(alone, ruled)]
            before = "–"
            if all(plain):
                before = f"*{plain[0]['verdict']}*: {', '.join(percent(r['violated']) for r in plain)}"
            found = re.sub(" of agent .*", " of some", ruled[0]["found"]).replace("|", r"\|")
            lines.append((f"`{kind.name}`{kept}", kind.says, f"*{ruled[0]['verdict']}*", found, *shares, before))
    head = ("system", "what is dangerous", "verdict", "what was found", "naive, shield", "clone, shield", "no rules")
    return markdown(head, lines)


def _short(r: dict[str, str]) -> str:
    found = f"{percent(r['violated'])}, {float(r['return']):.3g}"
    return found if r["guard"] == "none" else f"{found}, *{r['verdict']}*"


def trackers() -> str:
    who, lines = ("clone", "clone, shield", "naive", "naive, shield"), []
    for name, row in of_json("proving/trackers.json").items():
        cells = [f"{percent(row[w]['violation_rate'], '.0f')}, {row[w]['return_mean']:.2f}" for w in who]
        lines.append((name, row["verdict"], *cells))
    return markdown(("dynamics know", "verdict", *who), lines)


# Guards.

# What the page leaves out: neighbours of rows that it has.
UNSHOWN = ("an ensemble of 5", "the true dynamics and formula", "5 rows foreseen", "climbed from 4 starts")
UNSHOWN += ("10 steps of climbing", "4 plans to select from")
WORDS = {"rows foreseen": "predicted steps", "row foreseen": "predicted step"}
WORDS |= {"foreseen by": "predicted by", "row judged": "step judged"}


def of_ablations() -> str:
    """A table for each study, bold where Holm's adjusted p and the interval agree."""

    def more(r: dict, key: str) -> str:
        mean, low, high = (float(r[f"more_{key}{x}"]) for x in ("", "_low", "_high"))
        text = f"{mean:+.3g} [{low:.3g}, {high:.3g}]" if mean or low or high else "0"
        return f"**{text}**" if r[f"holm_{key}"] < 0.05 and not low <= 0 <= high else text

    studies: dict[tuple[str, ...], list[dict]] = defaultdict(list)
    for r in ablations.adjusted(read("ablations.csv")):
        studies[r["task"], r["proposal"], r["guard"]].append(r)
    out = []
    for (task, proposal, guard), found in studies.items():
        guard, lines = guard.replace(ablations.OWN, ", decentralized"), []
        for r in found:
            same = r != found[0] and all(v == found[0].get(k) for k, v in r.items() if k in ablations.PLAYED)
            if same or r["way"] in UNSHOWN:  # a way that is the default here
                continue
            way = r["way"]
            for old, new in WORDS.items():
                way = way.replace(old, new)
            differs = ["", ""] if r["way"] == "default" else [more(r, "return"), more(r, "cost")]
            lines.append((way, f"{float(r['return']):.4g}", f"{float(r['cost']):.3g}", *differs))
        out.append(f"`{task}`, `{proposal}` under `{guard}`, {found[0]['episodes']} episodes:\n")
        table = markdown(("", "return", "cost", "return, more", "cost, more"), lines)
        out.append(table.replace("|  |", "| |", 1) + "\n")
    return "\n".join(out).strip()


def yard() -> str:
    ways = {"": "", "terminal_value=False": ", 3 steps without V", "horizon=7": ", 7 steps"}
    ways |= {"horizon=10": ", 10 steps", "horizon=3 terminal_value=True": ", 3 steps"}
    lines = []
    for r in read("yard.csv"):
        guard = "" if r["guard"] in ("", "none") else f"{r['guard']}, {r['barrier']}{ways[r['options']]}"
        lines.append((r["method"], guard, f"{float(r['return']):.2f}", bound(r["contact"], r["bound"], unit=" %")))
    return markdown(("method", "guard", "return", "episodes with contact (bound)"), lines)


def constraints() -> str:
    words, lines = {"": "", "one": "one, of either", "each": "one each"}, []
    for r in read("constraints.csv"):
        touched = f"{percent(r['contact'], '.1f')} % (≤ {percent(r['contact_bound'], '.1f')})"
        lines.append(
            (r["guard"], words[r["barriers"]], f"{float(r['return']):.2f}", touched, f"{float(r['fast']):.2f}")
        )
    heads = ("guard", "barriers", "return", "episodes with contact (limit 0)", "steps too fast (limit 20)")
    return markdown(heads, lines)


def late_logs() -> str:
    lines = []
    for r in read("late_logs.csv"):
        when = {"": "", "0": "now"}.get(r["delay"], f"{r['delay']} step{'s' * (r['delay'] != '1')} later")
        other = "" if r["otherwise"] == r["verdict"] else f", *{r['otherwise']}* but for that"
        world, error = f"{r['world']}, *{r['verdict']}*{other}", percent(r["error"], ".2g")
        if r["world"] == "none":
            world, error = "no guard", ""
        lines.append((r["late"], world, error, when, f"{float(r['return']):.2f}", bound(r["contact"], r["bound"])))
    heads = ("steps late", "World", "error, % of what changes", "the guard decides for", "return")
    return markdown((*heads, "episodes with contact, %"), lines)


def mpe2() -> str:
    """A line per policy and simulator: alone and under a shield."""
    cells: dict[tuple[str, str], list[str]] = defaultdict(list)
    for r in read("mpe2.csv"):
        text = f"{float(r['return']):.1f} / {float(r['cost']):.2f} / {percent(r['violation_rate'], '.0f')} %"
        cells[r["policy"].replace("learned of", "from"), r["place"]].append(text)
    return markdown(("policy", "played in", "alone", "shield"), [(*key, *both) for key, both in cells.items()])


def irsim() -> str:
    own = ("learned from", "agents", "guard", "return")
    touched = [bound(r["episodes with contact"], r["bound"], unit=" %") for r in read("other_simulator.csv")]
    lines = [(*(r[k] for k in own), cell) for r, cell in zip(read("other_simulator.csv"), touched)]
    return markdown((*own, "episodes with contact"), lines)


# Faults.


def stress() -> str:
    rows = read("stress/crossing.csv")
    plain = {r["episodes"]: float(r["return"]) for r in rows if r["faults"] == "none"}
    order = {name: k for k, name in enumerate(dict.fromkeys(name_of(faults) for faults, _, _ in trials().values()))}
    # Wider margins, and guards that know of half of a delay, are in the file: for certificates and the monitor.
    shown, lines = [r for r in rows if not re.search("margin|others_acceleration", r["guard"])], []
    for r in sorted(shown, key=lambda r: (order[r["faults"]], r["compensated"] == "True", r["guard"])):
        share = percent(float(r["return"]) / plain.get(r["episodes"], next(iter(plain.values()))), ".0f")
        guard = r["guard"].replace("shield", "compensated", 1) if r["compensated"] == "True" else r["guard"]
        cells = [in_words(r["faults"]), guard.replace("_", " "), r["episodes"], f"{float(r['return']):.2f}", share]
        rate, upper, infeasible = (r[name] for name in RATES)
        lines.append((*cells, bound(rate, upper, ".1f"), percent(infeasible, ".0f")))
    heads = ("faults", "guard", "episodes", "return", "of that without faults, %")
    return markdown((*heads, "episodes with contact, % (95 % ≤)", "infeasible steps, %"), lines)


def _kind(guard: str) -> str:
    """Which of the table's columns a guard is in."""
    return "none" if guard == "none" else "compensated" if guard.endswith("compensated") else "guard"


def systems() -> str:
    """Other tasks, side by side: unsafe steps per episode without a guard, under one, and under one that knows; and
    what the robot earns."""
    rows = {(r["task"], r["faults"], _kind(r["guard"])): r for r in read("stress/systems.csv")}
    tasks = list(dict.fromkeys(task for task, _, _ in rows))
    earning = [task for task in tasks if not task.startswith("proving-")]
    lines = []
    for faults in dict.fromkeys(faults for _, faults, _ in rows):
        cells = [in_words(faults)]
        for told, key, digits in ((tasks, "cost", ".3g"), (earning, "return", ".0f")):
            for task in told:
                found = (rows.get((task, faults, name)) for name in ("none", "guard", "compensated"))
                cells.append(" / ".join(f"{float(r[key]):{digits}}" for r in found if r))
        lines.append(cells)
    return markdown(("faults", *(f"`{t}`" for t in tasks), *(f"return of `{t}`" for t in earning)), lines)


def of_filters() -> str:
    """Of the gain that leaves fewer contacts."""
    names = [name_of(faults) for faults in FAULTS if not faults or faults.keys() & set(KNOWN)]
    rows = [r for r in read("stress/filters.csv") if r["gamma"] == "0.3" and r["faults"] in names]
    lines = []
    for r in sorted(rows, key=lambda r: (names.index(r["faults"]), r["compensated"])):
        rate, upper, infeasible = (r[name] for name in RATES)
        cells = [in_words(r["faults"]), "known" if r["compensated"] == "True" else "", f"{float(r['return']):.2f}"]
        lines.append((*cells, bound(rate, upper, ".1f"), percent(infeasible, ".0f")))
    heads = ("faults", "delay", "return", "episodes with contact, % (95 % ≤)", "infeasible steps, %")
    return markdown(heads, lines)


def pedestrians() -> str:
    """Contacts of all drivers together."""
    rows, lines = read("stress/pedestrians.csv"), []
    for name in dict.fromkeys(row["faults"] for row in rows):
        cells = [in_words(name)]
        for guard in ("none", "shield", "shield, compensated"):
            own = [row for row in rows if (row["faults"], row["guard"]) == (name, guard)]
            counted = ("contacts", "caused") if guard != "none" else ("contacts",)
            cells += [str(sum(int(row[c]) for row in own)) if own else "–" for c in counted]
        lines.append(cells)
    heads = ("faults", "of 1000 windows with contact: no guard", "shield", "caused", "compensated", "caused")
    return markdown(heads, lines)


def of_certificates() -> str:
    lines = []
    for setting, rows in certificates.by_setting().items():
        bounds = [float(row["bound"]) for row in rows]
        spread = " to ".join(dict.fromkeys(percent(b, ".1f") for b in (min(bounds), max(bounds))))
        kept, of_pool = (sum(row[k] == "True" for row in rows) for k in ("kept", "kept_of_pool"))
        told = sum(row["vacuous"] == "False" for row in rows)
        pool = int(rows[0]["tested"]) + int(rows[0]["others"]), percent(rows[0]["pool_rate"], ".1f")
        faults = in_words(name_of(certificates.SETTINGS[setting]))
        lines.append((faults, *pool, spread, len(rows), kept, of_pool, told))
    heads = ("faults", "episodes of the setting", "violated, %", "bounds, %", "certificates", "kept, by the rest")
    return markdown((*heads, "by all", "not vacuous"), lines)


def monitor() -> str:
    lines = []
    for r in read("stress/monitor.csv"):
        cells = [
            r["guard knows"],
            percent(r["promised"], ".2f") + " %",
            r["episodes"],
            percent(r["rate"], ".2f") + " %",
        ]
        lines.append((*cells, percent(r["alarms"], ".1f") + " %", r["median"] or "–"))
    heads = ("guard knows", "promised", "episodes", "violating", "streams with an alarm", "median episodes to it")
    return markdown(heads, lines)


# Logs of many drivers.


def _printed(task: str) -> str:
    """What others printed on the public files, which pool five learners, too."""
    values = {p.name.split(" ")[0]: p.values[task] / 100 for p in PUBLISHED if task in p.values}
    return "*as printed, on the public files: " + ", ".join(f"{k} {v:.3f}" for k, v in values.items()) + "*"


def _called(name: str, algorithm: str) -> str:
    told = name.removeprefix(algorithm).replace("told raw", "given the raw return").replace("told", "given")
    return f"`{algorithm}`" + re.sub(r"(\S+) asked", r"target \1", told.replace(", raw,", ", raw return,"))


def of_pools() -> str:
    """Rows of all tasks but robots' in the order of `ROWS`, the data first."""
    lines = []
    for found in pooled.kept(robots=False):
        lines.append(f"| *{found['task']}*: the data | | {found['data']['return_norm']:.3f} | | |")
        if drivers := found["data"].get("of_drivers"):
            lines.append(f"| its best driver of {len(drivers)} | | {max(drivers):.3f} | | |")
        if found["task"].startswith("simple_spread"):
            lines.append(f"| {_printed(found['task'])} | | | | |")
        for name in pooled.ROWS:
            if name in found["rows"] and name not in pooled.UNTOLD:
                r = found["rows"][name]
                interval = r.get("return_norm_interval")  # older rows tell none
                within = f" [{interval[0]:.3f}, {interval[1]:.3f}]" if interval else ""
                cells = [_called(name, r["algorithm"]), str(len(r["seeds"])), f"{r['return_norm']:.3f}{within}"]
                cells += [f"{r['cost_mean']:.2f}", f"{r['cost_safe_start']:.2f}"]
                lines.append(f"| {' | '.join(cells)} |")
    heads = "| | seeds | return, normalised | cost | of safe starts |"
    return "\n".join([heads, "|---|---|---|---|---|", *lines])


def of_robots() -> str:
    """A line for each robot's data under `adapt`: a clone, a flow that is asked for a return, and the best of eight of
    its proposals; and what these earn more, bold beyond chance."""
    lines = []
    for found in pooled.kept(robots=True):
        rows, task = found["rows"], TASKS[found["task"]]
        names = (pooled.CLONE, pooled.ASKED, pooled.BEST)
        cells = [f"{r['return_mean']:.0f} / {r['cost_mean']:.0f}" if (r := rows.get(n)) else "–" for n in names]
        for name in names[1:]:
            mean, (low, high) = pooled.more(rows[name], rows[pooled.CLONE])
            text = f"{mean:+.0f} [{low:.0f}, {high:.0f}]"
            cells.append(f"**{text}**" if low > 0 or high < 0 else text)
        logged = found["data"]["return_norm"] * (task.return_max - task.return_min) + task.return_min
        lines.append((f"`{found['task']}`", f"{logged:.0f}", *cells))
    heads = ("data set", "logs", "BC", "`flow`", "the best of 8", "`flow` − BC", "the best − BC")
    return markdown(heads, lines)


# Policies and logs of others.


def zoo() -> str:
    lines = []
    for r in read("zoo.csv"):
        old = f"{r['return_before']}, {r['cost_before']}" if r["return_before"] else "–"
        lines.append((r["policy"], r["guard"], r["return"], r["cost"], old))
    return markdown(("policy", "guard", "return", "cost", "before it was halved"), lines)


def export() -> str:
    lines = []
    for r in read("export.csv"):
        largest = [f"{float(r[f + '_largest']):.0e}" for f in ("stablehlo", "onnx")]
        ms = ", ".join(f"{float(r[f + '_ms']):.1f}" for f in ("controller", "stablehlo", "onnx"))
        lines.append((r["policy"], *largest, f"{r['stablehlo_apart']}, {r['onnx_apart']}", ms))
    return markdown(("policy", "StableHLO", "ONNX", "above 1e-5, of 1000", "ms: Controller, StableHLO, ONNX"), lines)


# What each number is to tell, and whether more of it is to mean more of that.
TELLS = {
    "played_return": ("true_return", "return, played in the World of the logs"),
    "played_danger": ("true_cost", "dangerous steps, played in the World of the logs"),
    "predicted_violation_rate": ("true_cost", "share of states from which danger is predicted"),
    "margin_violation_rate": ("true_cost", "share of states whose predicted margin is below the calibrated one"),
    "cost": ("true_cost", "fitted Q evaluation of cost"),
    "return": ("true_return", "fitted Q evaluation of return"),
    "ood_rate": ("true_cost", "share of states where the World does not know"),
    "action_rmse": ("true_cost", "distance from the logged actions"),
}


def ranks() -> str:
    """A line per number, a column per task: Spearman's correlation with what the simulator says."""
    rows = read("judging.csv")
    names = list(dict.fromkeys(r["task"] for r in rows))
    lines = []
    for number, (truth, words) in TELLS.items():
        cells = []
        for name in names:
            x, y = (np.array([float(r[k]) for r in rows if r["task"] == name]) for k in (number, truth))
            rank = spearmanr(x, y).statistic
            cells.append("–" if np.isnan(rank) else f"{rank:.2f}")
        lines.append((words, "cost" if truth == "true_cost" else "return", *cells))
    heads = [f"{name} ({sum(r['task'] == name for r in rows)} rows)" for name in names]
    return markdown(("number", "is to rank", *heads), lines)


def of_hostile() -> str:
    """The four ways to fail are one column of the page, since all are to be 0."""
    rows = read("hostile.csv")
    *good, memory = (k for k in rows[0] if k in ("files", "tried", "refused", "read, unchanged", "MiB more"))
    failures = [k for k in rows[0] if k not in (*good, memory)]
    lines = [(*(r[k] for k in good), sum(int(r[k]) for k in failures), r[memory]) for r in rows]
    return markdown((*good, "anything else", memory), lines)


def of_public_sets() -> str:
    lines = []
    for each in read("public_sets.csv"):
        owner, command, place, options = public_sets.SETS[each["set"]]
        name = f"[{each['set']}](https://github.com/{owner}/{place.split('/')[0]})"
        call = f"`{command} {place.split('/')[-1]} {options}`".replace(" `", "`")
        size = f"{each['episodes']}, {each['steps']}"
        lines.append((name, call, size, each["agents"], each["dt"], each["unsafe"]))
    return markdown(("set", "`ringfence data`", "episodes, steps", "agents", "s a step", "steps with cost"), lines)


PROVING, STRESS, GUARDS = "docs/proving-ground.md", "docs/stress-results.md", "docs/guard-results.md"
TABLES: dict[tuple[str, str], Callable[[], str]] = {
    (PROVING, "shaped"): lambda: said(SHAPED),
    (PROVING, "shapes"): lambda: shapes("shapes.csv", SHAPED, "more shapes", "no more shapes"),
    (PROVING, "ruled"): lambda: shapes("shapes.csv", SHAPED, "rules", "more shapes"),
    (PROVING, "families"): families,
    (PROVING, "mapped"): lambda: said(MAPPED),
    (PROVING, "on-map"): lambda: shapes("on_map.csv", MAPPED, "how far away", "places as they are"),
    (PROVING, "trackers"): trackers,
    ("docs/ablations.md", "ablations"): of_ablations,
    (GUARDS, "yard"): yard,
    (GUARDS, "constraints"): constraints,
    (GUARDS, "mpe2"): mpe2,
    ("docs/crossing-results.md", "other"): irsim,
    (STRESS, "late-logs"): late_logs,
    (STRESS, "stress"): stress,
    (STRESS, "systems"): systems,
    (STRESS, "filters"): of_filters,
    (STRESS, "pedestrians"): pedestrians,
    (STRESS, "certificates"): of_certificates,
    (STRESS, "monitor"): monitor,
    ("docs/drivers-results.md", "pooled"): of_pools,
    ("docs/drivers-results.md", "robots"): of_robots,
    ("docs/start.md", "zoo"): zoo,
    ("docs/export.md", "parity"): export,
    ("docs/ope.md", "ranks"): ranks,
    ("docs/security.md", "hostile"): of_hostile,
    ("docs/import-tracks.md", "public sets"): of_public_sets,
}
