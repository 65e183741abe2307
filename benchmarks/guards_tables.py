"""Writes the tables of guards between their markers in docs/, from results/ alone.

python benchmarks/guards_tables.py
"""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

import numpy as np
from _proven import proven
from evidence import Row, of, tasks_of, variant
from readme import put

from ringfence.evaluation.statistics import upper_bound
from ringfence.utils import stored

RESULTS = Path(__file__).resolve().parent.parent / "results"
Column = tuple[str, Row]  # a suite, and a row of it
# Columns: their heads, and where their rows are.
SPREAD: dict[str, Column] = {
    "BC": ("guards", ("bc", "default")),
    "shield, analytic": ("guards", ("bc", "default+shield-analytic")),
    "**shield**": ("guards", ("bc", "default+shield-learned")),
    "**full**": ("guards", ("bc", "default+full-learned")),
    "MPC from a zero proposal, full": ("guards", ("mpc", "default+full-learned")),
    "shield, decentralized": ("own-sight", ("bc", "default+shield-learned-decentralized")),
    "full, decentralized": ("own-sight", ("bc", "default+full-learned-decentralized")),
}
ROBOTS: dict[str, Column] = {
    "BC": ("guards-mujoco", ("bc", "default")),
    "adapt, analytic": ("guards-mujoco", ("bc", "default+adapt-analytic")),
    "**adapt**": ("guards-mujoco", ("bc", "default+adapt-learned")),
    "full, analytic": ("guards-mujoco", ("bc", "default+full-analytic")),
    "**full**": ("guards-mujoco", ("bc", "default+full-learned")),
    "adapt, decentralized": ("own-sight-mujoco", ("bc", "default+adapt-learned-decentralized")),
}
# Crossing's rows: algorithm and variant, and their words.
SHIELDED = "+shield-learned"
WAYS = {
    "certificates reference": "certificates (true state and brakes)",
    "bc default": "BC",
    **{
        f"bc default{SHIELDED}+horizon{k}+terminal_valueFalse": f"shield, ℓ, {k} step{'s' * (k > 1)}"
        for k in (1, 3, 7, 15)
    },
    f"bc default{SHIELDED}+horizon1": "shield, ℓ and V, 1 step",
    f"bc default{SHIELDED}": "**shield, ℓ and V, 3 steps**",
    "bc default+shield-analytic+horizon15+terminal_valueFalse": "shield, analytic, 15 steps",
    "bc default+full-learned": "**full**",
}
PROPOSALS = {
    "bc default": "BC",
    "bc-best default": "10 % BC",
    "bc-return default": "return-conditioned BC",
    "bc-safe default": "BC on episodes without contact",
    "ma-td3bc default": "MA-TD3+BC",
    "ma-td3bc-lag default": "MA-TD3+BC, Lagrange",
    "omar default": "OMAR",
}
TEAMS = {"bc default+shield-learned": "8 agents, as in the logs"}
TEAMS |= {f"bc default+shield-learned+agents{n}": f"{n} agents" for n in (4, 16, 64, 256)}
SIZES = {"BC": "", "shield": "+shield-learned", "full": "+full-learned"}


def main() -> None:
    put("docs/guard-results.md", "spread", table(SPREAD, short))
    put("docs/guard-results.md", "robots", table(ROBOTS, long))
    put("docs/proving-ground.md", "proving", proving(RESULTS / "proving", "proving-*.json"))
    put("docs/proving-ground.md", "others", proving(RESULTS / "proving" / "others", "*.json", filtered=False))
    put("docs/proving-ground.md", "drawn", proving(RESULTS / "proving" / "drawn", "*.json", filtered=False))
    put("docs/crossing-results.md", "tiers", tiers())
    put("docs/crossing-results.md", "guards", crossing("crossing-guards", WAYS))
    put("docs/crossing-results.md", "proposals", proposals())
    put("docs/crossing-results.md", "teams", crossing("crossing-teams", TEAMS))
    put("docs/crossing-results.md", "sizes", sizes())
    put("docs/crossing-results.md", "other", other_simulator())


def table(columns: dict[str, Column], cell) -> str:
    """A row per task, a column per guard; – where nothing was made, and how many seeds each cell is of."""
    tasks = tasks_of(next(iter(columns.values()))[0])
    found = {
        (task, words): list(of(suite, task, variant(task, row)).values())
        for task in tasks
        for words, (suite, row) in columns.items()
    }
    # Seeds stand in the head where all cells of a column have as many, else in the task's name or in the cell.
    seeds = {w: {len(rows) for (_, words), rows in found.items() if words == w and rows} for w in columns}
    heads = [w + (f" [{max(seeds[w])}]" if len(seeds[w]) == 1 else "") for w in columns]
    out = ["| | " + " | ".join(heads) + " |", "|---" * (1 + len(columns)) + "|"]
    for task in tasks:
        mixed = {w: len(found[task, w]) for w in columns if len(seeds[w]) > 1 and found[task, w]}
        usual = max(set(mixed.values()), key=list(mixed.values()).count) if len(mixed) > 1 else 0
        cells = []
        for words in columns:
            rows = found[task, words]
            some = f" [{mixed[words]}]" if mixed.get(words, usual) != usual else ""
            cells.append(cell(rows) + some if rows else "–")
        if any(c != "–" for c in cells[1:]):
            out.append(f"| `{task}`{f' [{usual}]' * bool(usual)} | " + " | ".join(cells) + " |")
    return "\n".join([*out, "", "[n]: of n seeds."])


def mean(rows: list[dict], key: str) -> float:
    return float(np.mean([float(r[key]) for r in rows]))


def short(rows: list[dict]) -> str:
    return f"{mean(rows, 'return_norm'):.2f} / {mean(rows, 'cost_safe_start'):.3f}"


def long(rows: list[dict]) -> str:
    fell = mean(rows, "termination_rate")
    text = f"{mean(rows, 'return_mean'):.0f} / {mean(rows, 'cost_mean'):.1f}"
    return text + (f" ({100 * fell:.0f} %)" if fell else "")


def of_crossing(suite: str, task: str, key: str) -> list[dict]:
    """A row's lines of table.csv, one for each seed."""
    rows = stored.table(RESULTS / suite / "table.csv")
    return [r for r in rows if r["task"] == task and f"{r['algorithm']} {r['variant']}" == key]


def touching(found: list[dict]) -> str:
    """The share of episodes with contact, and its bound. Seeds share their resets, so the bound is of one: the seed
    that touches most."""
    episodes = int(found[0]["episodes"])
    most = max(float(r["violation_rate"]) for r in found)
    bound = upper_bound(round(most * episodes), episodes)
    return f"{100 * mean(found, 'violation_rate'):.3g} % (≤ {100 * bound:.3g} %)"


def unmet(found: list[dict]) -> str:
    return f"{100 * mean(found, 'infeasible_rate'):.2g} %" if found[0]["infeasible_rate"] else ""


def tiers() -> str:
    """A row per task of Crossing: the logs, a clone, and the clone under its shield."""
    out = ["| tier | logs | BC | **BC, shield** | infeasible_rate | n_episodes |", "|---" * 6 + "|"]
    for task in dict.fromkeys(r["task"] for r in stored.table(RESULTS / "crossing" / "table.csv")):
        logs, clone, guarded = (
            of_crossing("crossing", task, key)
            for key in ("behaviour data reference", "bc default", f"bc default{SHIELDED}")
        )
        cells = [f"{mean(logs, 'return_mean'):.2f} / {100 * mean(logs, 'violation_rate'):.3g} %"]
        cells += [f"{mean(found, 'return_mean'):.2f} / {touching(found)}" for found in (clone, guarded)]
        seeds = f", {len(guarded)} seeds" if len(guarded) > 1 else ""
        cells += [unmet(guarded), f"{guarded[0]['episodes']}{seeds}"]
        out.append(f"| `{task}` | " + " | ".join(cells) + " |")
    return "\n".join(out)


def crossing(suite: str, named: dict[str, str]) -> str:
    """A row per variant of one task."""
    head = ("method", "return", "episodes with contact (bound)", "infeasible_rate")
    out = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for key, words in named.items():
        if found := of_crossing(suite, "crossing-hasty", key):
            part = [words, f"{mean(found, 'return_mean'):.2f}"]
            out.append("| " + " | ".join([*part, touching(found), unmet(found)]) + " |")
    return "\n".join(out)


def proposals() -> str:
    """A row per proposal on Crossing: alone and under a shield."""
    out = ["| proposal | alone | under a shield |", "|---" * 3 + "|"]
    for key, words in PROPOSALS.items():
        both = [of_crossing("crossing-guards", "crossing-hasty", name) for name in (key, key + SHIELDED)]
        cells = [f"{mean(found, 'return_mean'):.2f} / {touching(found)}" for found in both]
        out.append(f"| {words} | " + " | ".join(cells) + " |")
    return "\n".join(out)


def sizes() -> str:
    """A row per task and number of agents, a column per guard."""
    rows = stored.table(RESULTS / "spread-teams" / "table.csv")
    seeds = set()
    out = ["| learned from | agents | " + " | ".join(SIZES) + " |", "|---" * (2 + len(SIZES)) + "|"]
    for task in dict.fromkeys(r["task"] for r in rows):
        for n in (2, 3, 4, 6):
            cells = []
            for guard in SIZES.values():
                name = f"default{guard}" + f"+agents{n}" * (n != 3)
                found = [r for r in rows if (r["task"], r["algorithm"], r["variant"]) == (task, "bc", name)]
                seeds.add(len(found))
                cells.append(f"{mean(found, 'return_mean'):.0f} / {mean(found, 'cost_safe_start'):.3f}")
            out.append(f"| `{task}` | {n}{', as in the logs' * (n == 3)} | " + " | ".join(cells) + " |")
    assert len(seeds) == 1, f"the page names one number of seeds, the rows have {seeds}"
    return "\n".join(out)


def other_simulator() -> str:
    """Rows of benchmarks/other_simulator.py."""
    rows = stored.table(RESULTS / "other_simulator.csv")
    head = ("learned from", "agents", "guard", "return", "episodes with contact")
    out = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for r in rows:
        part = [r[k] for k in ("learned from", "agents", "guard", "return")]
        part.append(f"{100 * float(r['episodes with contact']):.3g} %")
        part[-1] += f" (≤ {100 * float(r['bound']):.3g} %)" if r["bound"] else ""
        out.append("| " + " | ".join(part) + " |")
    return "\n".join(out)


def proving(folder: Path, files: str, filtered: bool = True) -> str:
    """Systems of the proving ground's kind, by their results; `filtered` also by a filter that knows the formula."""
    kinds = {"none": "", "shield learned": "shield", "cbf-qp": "CBF-QP", "shield oracle": "oracle"}
    kinds = {row: head for row, head in kinds.items() if filtered or row != "cbf-qp"}
    drivers = {"bc": "clone", "naive": "naive"}
    rows = [f"{driver} {row}" for driver in drivers for row in kinds]
    heads = ["system", "verdict", "causes found"]
    heads += [head or driver for driver in drivers.values() for head in kinds.values()]
    lines = [f"| {' | '.join(heads)} |", "|" + "---|" * len(heads)]
    for found in proven(folder, files):
        causes = dict.fromkeys(_in_short(cause) for cause in found["causes"])
        name = found["task"].removeprefix("proving-").removeprefix("other-").removeprefix("drawn-")
        cells = [f"`{name}`{_in_words(found.get('system'))}", _verdicts(found), "; ".join(causes) or "none"]
        cells += [_share_and_return(found["rows"].get(row)) for row in rows]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _verdicts(found: dict) -> str:
    """What the Worlds of all seeds say of themselves."""
    words = Counter(found["verdicts"])
    return next(iter(words)) if len(words) == 1 else ", ".join(f"{word} by {n}" for word, n in words.items())


def _in_words(system: dict | None) -> str:
    """What was drawn."""
    if system is None:
        return ""
    unnamed = ", no names" if system["names"] == "none" else ""
    return f": {system['n_agents']} {system['body']}, {' and '.join(system['danger'])}{unnamed}"


def _in_short(cause: str) -> str:
    """A cause without the agents that it is of, and a distance by its name."""
    return re.sub(r"^length of (\w+)\.d\w, (?:\w+\.)?d\w", r"distance to \1", re.sub(" of agent.*", " of some", cause))


def _share_and_return(row: dict | None) -> str:
    if row is None or "refused" in row:
        return "–"
    share = 100 * row["violation_rate"]
    return f"{share:.{int(0 < share < 10)}f}, {row['return_mean']:.2f}"


if __name__ == "__main__":
    main()
