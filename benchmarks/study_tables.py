"""Tables of single studies, from the file of results that each of them wrote (tables.py writes the pages)."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from typing import Any

import ablations
import certificates
import numpy as np
import pooled
from common import markdown, of_json, read
from evidence import proven
from families import FAMILIES
from scipy.stats import spearmanr
from stress import FAULTS, KNOWN, in_words, name_of

from ringfence.report.board_page import PUBLISHED

Rows = list[dict[str, str]]


def percent(x: Any, digits: str = ".3g") -> str:
    return f"{100 * float(x):{digits}}"


def share(x: Any) -> str:
    """In percent, with a digit more where it is small."""
    return percent(x, f".{int(0 < 100 * float(x) < 9.95)}f")


def bound(rate: Any, upper: Any, digits: str = ".3g", unit: str = "") -> str:
    """A rate and its upper bound, in percent; without the bound where there is none."""
    return percent(rate, digits) + unit + (f" (≤ {percent(upper, digits)}{unit})" if upper else "")


# Systems of the proving ground's kind.
MORE, RULES = "more shapes", "rules"
Shares = dict[str, list[float]]  # of each log, episodes with a violation


def collections() -> str:
    """A line per collection of systems: verdicts, and the percentage of episodes with a violation, of clones and of
    naive drivers, alone and under the shield: the mean, and the most of one."""
    lines = []
    for name, (verdicts, shares) in _collected().items():
        words = Counter(verdicts)
        said = ", ".join(f"{words[word]} *{word}*" for word in ("fit", "weak", "unfit") if words[word])
        cells = []
        for driver in ("clone", "naive"):
            alone, left = (shares[f"{driver}, {guard}"] for guard in ("none", "shield"))
            cells.append(f"{share(np.mean(alone))} → {share(np.mean(left))} ({share(max(left))})")
        lines.append((name, len(verdicts), said, *cells))
    return markdown(("systems", "logs", "Worlds", "clones", "naive drivers"), lines)


def _collected() -> dict[str, tuple[list[str], Shares]]:
    found: dict[str, tuple[list[str], Shares]] = {}
    for name, folder, files in (
        ("the sixteen", "proving", "proving-*.json"),
        ("ten more", "proving/others", "*.json"),
        ("twelve drawn at random", "proving/drawn", "*.json"),
    ):
        all_of, shares = proven(folder, files), defaultdict(list)
        for one in all_of:
            for row, words in (("bc none", "clone, none"), ("bc shield learned", "clone, shield")):
                shares[words].append(one["rows"][row]["violation_rate"])
                shares[words.replace("clone", "naive")].append(
                    one["rows"][row.replace("bc", "naive")]["violation_rate"]
                )
        found[name] = [one["verdicts"][0] for one in all_of], shares
    found["danger of other shapes"] = _table("shapes.csv", (MORE, RULES))
    found["nine families"] = _table("families.csv", (RULES,))
    found["places on a map"] = _table("on_map.csv", ("how far away",))
    lists = of_json("proving/trackers.json")["today"]
    rows = {"clone": "clone", "clone, shield": "clone, shield", "naive": "naive", "naive, shield": "naive, shield"}
    shares = {k if "," in k else f"{k}, none": [lists[v]["violation_rate"]] for k, v in rows.items()}
    found["a list of the two nearest"] = [lists["verdict"]], shares
    return found


def _table(file: str, ways: Sequence[str]) -> tuple[list[str], Shares]:
    """Of each log the last of the ways by which its World was fitted."""
    rows = {}
    for way in ways:
        for r in read(file):
            if r["causes"] == way:
                rows[r["system"], r["seed"], r["driver"], r["guard"]] = r
    shares, verdicts = defaultdict(list), {}
    for (name, seed, driver, guard), r in rows.items():
        shares[f"{driver}, {guard}"].append(float(r["violated"]))
        if guard == "shield":
            verdicts[name, seed] = r["verdict"]
    return list(verdicts.values()), shares


def families() -> str:
    """A row per system: its verdict, and the percentage of episodes with a violation, alone and under the shield."""
    rows = {(r["system"], r["driver"], r["guard"]): r for r in read("families.csv") if r["causes"] == RULES}
    lines = []
    for family in FAMILIES:
        for kind in (*family.open, *family.kept):
            each = {
                driver: [rows.get((kind.name, driver, guard)) for guard in ("none", "shield")]
                for driver in ("clone", "naive")
            }
            if not all(r for both in each.values() for r in both):
                continue
            ruled = each["clone"][1]
            shares = [" → ".join(share(r["violated"]) for r in both) for both in each.values()]
            kept = ", kept" if kind in family.kept else ""
            lines.append((f"`{kind.name}`{kept}", ruled["verdict"], *shares))
    return markdown(("system", "verdict", "clone", "naive"), lines)


# Guards.

WORDS = {"rows foreseen": "predicted steps", "row foreseen": "predicted step"}
WORDS |= {"foreseen by": "predicted by", "row judged": "step judged"}


def of_ablations() -> str:
    """What differs from the default beyond chance, by Holm's adjusted p and the interval."""

    def more(r: dict, key: str) -> str:
        mean, low, high = (float(r[f"more_{key}{x}"]) for x in ("", "_low", "_high"))
        text = f"{mean:+.3g} [{low:.3g}, {high:.3g}]" if mean or low or high else "0"
        return f"**{text}**" if holds(r, key) else text

    def holds(r: dict, key: str) -> bool:
        return r[f"holm_{key}"] < 0.05 and not float(r[f"more_{key}_low"]) <= 0 <= float(r[f"more_{key}_high"])

    lines = []
    for r in ablations.adjusted(read("ablations.csv")):
        if r["way"] != "default" and (holds(r, "return") or holds(r, "cost")):
            way = r["way"]
            for old, new in WORDS.items():
                way = way.replace(old, new)
            where = f"`{r['task']}`, {r['guard'].replace(ablations.OWN, ', decentralized')}"
            lines.append((where, way, more(r, "return"), more(r, "cost")))
    return markdown(("where", "what differs", "return, more", "cost, more"), lines)


# Recordings and faults.

PEDESTRIANS = ("zara02", "seq_hotel", "zara01", "seq_eth", "students03", "citr")
MACHINES = ("a-den", "b-den", "town")
FILTERS = {"shield": "shield, learned danger", "formula": "formula, 2 s", "brake": "constant-velocity brake"}


def replayed() -> str:
    """Contacts of five drivers together, by recording: how many are prevented, and caused."""
    lines = []
    for name in (*PEDESTRIANS, *MACHINES):
        found = of_json(f"replay/{name}.json")
        alone, cells = sum(r["contacts"] for r in found["rows"] if r["filter"] == "none"), []
        for each in FILTERS:
            rows = [r for r in found["rows"] if r["filter"] == each]
            prevented, caused = (sum(r[what] for r in rows) for what in ("prevented", "caused"))
            cells.append(f"{100 * prevented / alone:.0f} %, {caused}")
        lines.append((f"`{name}`", found["verdict"], found["windows"], alone, *cells))
    return markdown(("recording", "verdict", "windows", "contacts", *FILTERS.values()), lines)


def stress() -> str:
    """Crossing behind faults that a guard can know of: percentage of episodes with contact, and its bound, of a guard
    that does not know of them, of one that does, and of a filter that knows the formula."""
    learned = {(r["faults"], r["compensated"]): r for r in read("stress/crossing.csv") if r["guard"] == "shield"}
    classical = {(r["faults"], r["compensated"]): r for r in read("stress/filters.csv") if r["gamma"] == "0.3"}
    lines = []
    for name in (name_of(faults) for faults in FAULTS if not faults or faults.keys() & set(KNOWN)):
        cells = []
        for rows in (learned, classical):
            for known in ("False", "True"):
                r = rows.get((name, known))
                cells.append(bound(r["violation_rate"], r["violation_upper"], ".1f") if r else "–")
        words = in_words(name)
        lines.append(("five at once" if words.count(",") == 4 else words, *cells))
    heads = ("faults", "shield", "shield that knows", "filter by the formula", "the same, knowing")
    return markdown(heads, lines)


def of_certificates() -> str:
    lines = []
    for setting, rows in certificates.by_setting().items():
        bounds = [float(row["bound"]) for row in rows]
        spread = " to ".join(dict.fromkeys(percent(b, ".1f") for b in (min(bounds), max(bounds))))
        kept = sum(row["kept"] == "True" for row in rows)
        told = sum(row["vacuous"] == "False" for row in rows)
        faults = in_words(name_of(certificates.SETTINGS[setting]))
        lines.append((faults, percent(rows[0]["pool_rate"], ".1f"), spread, f"{kept} of {len(rows)}", told))
    return markdown(("faults", "violated, %", "bounds, %", "kept, by the rest", "not vacuous"), lines)


# Logs of many drivers: words, and the names of rows, of which a file's first is shown.
POOLED: dict[str, tuple[str, ...]] = {
    "BC": ("bc, 20,000 updates", "bc"),
    "10 % BC": ("bc-best",),
    "MA-TD3+BC": ("ma-td3bc",),
    "OMAR": ("omar",),
    "`flow`": ("flow",),
    "`flow`, guided by danger": ("flow, 8 steps, guided by danger",),
    "`flow`, the best of 64": ("flow, the best of 64",),
    "BC under `shield`": ("bc, 20,000 updates, under shield",),
    "`flow` under `shield`": ("flow, under shield",),
    "BC under `full`": ("bc, 20,000 updates, under full",),
    "`flow` under `full`": ("flow, under full",),
}


def of_pools() -> str:
    """Normalised return / cost of safe starts, a column for each pool of five drivers; what others print in italics."""
    found = {r["task"]: r for r in pooled.kept(robots=False) if r["task"].startswith("simple_spread")}
    names = [f"simple_spread-{tier}-pooled" for tier in ("expert", "medium", "random")]
    logs = [f"{found[name]['data']['return_norm']:.2f}" for name in names]
    lines: list[tuple[str, ...]] = [("the logs", *logs)]
    for words, rows in POOLED.items():
        cells = []
        for name in names:
            r = next((found[name]["rows"][row] for row in rows if row in found[name]["rows"]), None)
            cells.append(f"{r['return_norm']:.2f} / {r['cost_safe_start']:.2f} [{len(r['seeds'])}]" if r else "–")
        lines.append((words, *cells))
    for each in PUBLISHED:
        if names[0] in each.values:
            printed = (f"*{each.values[name] / 100:.2f}*" for name in names)
            lines.append((f"*{each.name.split(' ')[0]}, public files*", *printed))
    return markdown(("logs of five drivers", *(name.split("-")[1] for name in names)), lines)


# Policies and logs of others.


def zoo() -> str:
    """A line per policy: return / cost, alone and under its guard."""
    rows: dict[str, list[dict[str, str]]] = defaultdict(list)
    for r in read("zoo.csv"):
        rows[r["policy"]].append(r)
    lines = []
    for policy, found in rows.items():
        guard = next(r["guard"] for r in found if r["guard"] != "none")
        found.sort(key=lambda r: r["guard"] != "none")
        cells = [f"{float(r['return']):.4g} / {float(r['cost']):.3g}" for r in found]
        lines.append((policy, *cells, f"`{guard}`"))
    return markdown(("policy", "alone", "guarded", "guard"), lines)


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
        lines.append((words, *cells))
    heads = [f"{name} ({sum(r['task'] == name for r in rows)} rows)" for name in names]
    return markdown(("number", *heads), lines)


def of_hostile() -> str:
    """All kinds of files together; what may go wrong is one column, since all of it is to be 0."""
    rows = read("hostile.csv")
    good = ("files", "tried", "refused", "read, unchanged")
    failures = [k for k in rows[0] if k not in (*good, "MiB more")]
    counts = [sum(int(r[k]) for r in rows) for k in good[1:]] + [sum(int(r[k]) for r in rows for k in failures)]
    return markdown(("kinds", *good[1:], "anything else"), [(len(rows), *counts)])


PROVING, RESULTS_PAGE, ROBUST = "docs/proving-ground.md", "docs/results.md", "docs/robustness.md"
TABLES: dict[tuple[str, str], Callable[[], str]] = {
    (PROVING, "collections"): collections,
    (PROVING, "families"): families,
    (RESULTS_PAGE, "ablations"): of_ablations,
    (RESULTS_PAGE, "pooled"): of_pools,
    (ROBUST, "recordings"): replayed,
    (ROBUST, "stress"): stress,
    (ROBUST, "certificates"): of_certificates,
    ("docs/start.md", "zoo"): zoo,
    ("docs/export.md", "parity"): export,
    ("docs/ope.md", "ranks"): ranks,
    ("docs/security.md", "hostile"): of_hostile,
}
