"""Tables of guards: docs/guard-results.md, docs/crossing-results.md, docs/proving-ground.md, and docs/attribution.md,
where proposals are crossed with guards and every question stands beside its paired baseline (tables.py writes them).
"""

from __future__ import annotations

import functools
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import evidence
import numpy as np
from common import markdown, read
from evidence import Difference, Row, difference, family, of, proven, tasks_of, variant

from ringfence.evaluation.statistics import upper_bound

Column = tuple[str, Row]  # a suite, and a row of it
SHIELD, FULL, ADAPT = "+shield-learned", "+full-learned", "+adapt-learned"
OF_SEEDS = "\n\n[n]: of n seeds, but where a cell says another number."


def _columns(more: dict[str, tuple[str, str]]) -> dict[str, Column]:
    """Heads, and where their rows are: a suite and what a clone is guarded by."""
    return {head: (suite, ("bc", f"default{guard}")) for head, (suite, guard) in more.items()}


SPREAD: dict[str, Column] = _columns(
    {
        "BC": ("guards", ""),
        "shield, analytic": ("guards", "+shield-analytic"),
        "**shield**": ("guards", SHIELD),
        "**full**": ("guards", FULL),
    }
)
SPREAD["MPC from a zero proposal, full"] = ("guards", ("mpc", f"default{FULL}"))
SPREAD |= _columns(
    {
        "shield, decentralized": ("own-sight", f"{SHIELD}-decentralized"),
        "full, decentralized": ("own-sight", f"{FULL}-decentralized"),
    }
)
ROBOTS: dict[str, Column] = _columns(
    {
        "BC": ("guards-mujoco", ""),
        "adapt, analytic": ("guards-mujoco", "+adapt-analytic"),
        "**adapt**": ("guards-mujoco", ADAPT),
        "full, analytic": ("guards-mujoco", "+full-analytic"),
        "**full**": ("guards-mujoco", FULL),
        "adapt, decentralized": ("own-sight-mujoco", f"{ADAPT}-decentralized"),
    }
)
# Crossing's rows: algorithm and variant, and their words.
WAYS = {
    "certificates reference": "certificates (true state and brakes)",
    "bc default": "BC",
    **{
        f"bc default{SHIELD}+horizon{k}+terminal_valueFalse": f"shield, ℓ, {k} step{'s' * (k > 1)}"
        for k in (1, 3, 7, 15)
    },
    f"bc default{SHIELD}+horizon1": "shield, ℓ and V, 1 step",
    f"bc default{SHIELD}": "**shield, ℓ and V, 3 steps**",
    "bc default+shield-analytic+horizon15+terminal_valueFalse": "shield, analytic, 15 steps",
    f"bc default{FULL}": "**full**",
}
PROPOSALS = {
    "bc": "BC",
    "bc-best": "10 % BC",
    "bc-return": "return-conditioned BC",
    "bc-safe": "BC on episodes without contact",
    "ma-td3bc": "MA-TD3+BC",
    "ma-td3bc-lag": "MA-TD3+BC, Lagrange",
    "omar": "OMAR",
}
TEAMS = {f"bc default{SHIELD}": "8 agents, as in the logs"}
TEAMS |= {f"bc default{SHIELD}+agents{n}": f"{n} agents" for n in (4, 16, 64, 256)}
SIZES = {"BC": "", "shield": SHIELD, "full": FULL}


def table(columns: dict[str, Column], cell: Callable[[list[dict]], str]) -> str:
    """A row per task, a column per guard; – where nothing was made, and how many seeds each cell is of."""
    tasks = tasks_of(next(iter(columns.values()))[0])
    found = {
        (task, words): list(of(suite, task, variant(task, row)).values())
        for task in tasks
        for words, (suite, row) in columns.items()
    }
    # Seeds stand in the head where all cells of a column have as many, else in the task's name or in the cell.
    seeds = {w: {len(rows) for (_, words), rows in found.items() if words == w and rows} for w in columns}
    heads = ["", *(w + (f" [{max(seeds[w])}]" if len(seeds[w]) == 1 else "") for w in columns)]
    lines = []
    for task in tasks:
        mixed = {w: len(found[task, w]) for w in columns if len(seeds[w]) > 1 and found[task, w]}
        usual = max(set(mixed.values()), key=list(mixed.values()).count) if len(mixed) > 1 else 0
        cells = []
        for words in columns:
            rows = found[task, words]
            some = f" [{mixed[words]}]" if mixed.get(words, usual) != usual else ""
            cells.append(cell(rows) + some if rows else "–")
        if any(c != "–" for c in cells[1:]):
            lines.append((f"`{task}`{f' [{usual}]' * bool(usual)}", *cells))
    return bare(heads, lines) + "\n\n[n]: of n seeds."


def bare(heads: Sequence[str], lines: Sequence) -> str:
    """A table whose first head is empty."""
    return markdown(heads, lines).replace("|  |", "| |", 1)


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
    rows = read(f"{suite}/table.csv")
    return [r for r in rows if r["task"] == task and f"{r['algorithm']} {r['variant']}" == key]


def touching(found: list[dict]) -> str:
    """The share of episodes with contact, and its bound. Seeds share their resets, so the bound is of one: the seed
    that touches most."""
    episodes = int(found[0]["episodes"])
    most = max(float(r["violation_rate"]) for r in found)
    bound = upper_bound(round(most * episodes), episodes)
    return f"{100 * mean(found, 'violation_rate'):.3g} % (≤ {100 * bound:.3g} %)"


def earned_touching(found: list[dict]) -> str:
    return f"{mean(found, 'return_mean'):.2f} / {touching(found)}"


def unmet(found: list[dict]) -> str:
    return f"{100 * mean(found, 'infeasible_rate'):.2g} %" if found[0]["infeasible_rate"] else ""


def tiers() -> str:
    """A row per task of Crossing: the logs, a clone, and the clone under its shield."""
    lines = []
    for task in dict.fromkeys(r["task"] for r in read("crossing/table.csv")):
        keys = ("behaviour data reference", "bc default", f"bc default{SHIELD}")
        logs, clone, guarded = (of_crossing("crossing", task, key) for key in keys)
        seeds = f", {len(guarded)} seeds" if len(guarded) > 1 else ""
        logged = f"{mean(logs, 'return_mean'):.2f} / {100 * mean(logs, 'violation_rate'):.3g} %"
        played = [earned_touching(found) for found in (clone, guarded)]
        lines.append((f"`{task}`", logged, *played, unmet(guarded), f"{guarded[0]['episodes']}{seeds}"))
    return markdown(("tier", "logs", "BC", "**BC, shield**", "infeasible_rate", "n_episodes"), lines)


def crossing(suite: str, named: dict[str, str]) -> str:
    """A row per variant of one task."""
    lines = []
    for key, words in named.items():
        if found := of_crossing(suite, "crossing-hasty", key):
            lines.append((words, f"{mean(found, 'return_mean'):.2f}", touching(found), unmet(found)))
    return markdown(("method", "return", "episodes with contact (bound)", "infeasible_rate"), lines)


def proposals() -> str:
    """A row per proposal on Crossing: alone and under a shield."""
    lines = []
    for name, words in PROPOSALS.items():
        keys = (f"{name} default", f"{name} default{SHIELD}")
        both = [of_crossing("crossing-guards", "crossing-hasty", key) for key in keys]
        lines.append((words, *(earned_touching(found) for found in both)))
    return markdown(("proposal", "alone", "under a shield"), lines)


def sizes() -> str:
    """A row per task and number of agents, a column per guard."""
    rows, seeds, lines = read("spread-teams/table.csv"), set(), []
    for task in dict.fromkeys(r["task"] for r in rows):
        for n in (2, 3, 4, 6):
            cells = []
            for guard in SIZES.values():
                name = f"default{guard}" + f"+agents{n}" * (n != 3)
                found = [r for r in rows if (r["task"], r["algorithm"], r["variant"]) == (task, "bc", name)]
                seeds.add(len(found))
                cells.append(f"{mean(found, 'return_mean'):.0f} / {mean(found, 'cost_safe_start'):.3f}")
            lines.append((f"`{task}`", f"{n}{', as in the logs' * (n == 3)}", *cells))
    assert len(seeds) == 1, f"the page names one number of seeds, the rows have {seeds}"
    return markdown(("learned from", "agents", *SIZES), lines)


def proving(folder: str, files: str, filtered: bool = True) -> str:
    """Systems of the proving ground's kind, by their results; `filtered` also by a filter that knows the formula."""
    kinds = {"none": "", "shield learned": "shield", "cbf-qp": "CBF-QP", "shield oracle": "oracle"}
    kinds = {row: head for row, head in kinds.items() if filtered or row != "cbf-qp"}
    drivers = {"bc": "clone", "naive": "naive"}
    heads = ["system", "verdict", "causes found"]
    heads += [head or driver for driver in drivers.values() for head in kinds.values()]
    lines = []
    for found in proven(folder, files):
        causes = dict.fromkeys(_in_short(cause) for cause in found["causes"])
        name = found["task"].removeprefix("proving-").removeprefix("other-").removeprefix("drawn-")
        cells = [f"`{name}`{_in_words(found.get('system'))}", _verdicts(found), "; ".join(causes) or "none"]
        lines.append(cells + [_share_and_return(found["rows"].get(f"{d} {row}")) for d in drivers for row in kinds])
    return markdown(heads, lines)


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


# Proposals that the page shows: their words, and their row without a guard. `ringfence bench results
# results/guards` prints all others, too.
CROSSED: dict[str, Row] = {
    "logs": ("behaviour data", "reference"),
    "do nothing": ("do-nothing", "reference"),
    "BC": ("bc", "default"),
    "10 % BC": ("bc-best", "default"),
    "return-conditioned BC": ("bc-return", "default"),
    "MA-TD3+BC": ("ma-td3bc", "default"),
    "MA-TD3+BC, Lagrange": ("ma-td3bc-lag", "default"),
    "OMAR": ("omar", "default"),
    # the same under other guards
    "BC, `full`": ("bc", f"default{FULL}"),
    "MPC from a zero proposal (`mpc`), `full`": ("mpc", f"default{FULL}"),
}
# Robots' proposals under `adapt`, danger learned, and the one that only climbs. Cloning under `full` stands in
# docs/guard-results.md.
ON_ROBOTS: dict[str, Row] = {
    "BC": ("bc", f"default{ADAPT}"),
    "return-conditioned BC": ("bc-return", f"default{ADAPT}"),
    "MPC, `full`": ("mpc", f"default{FULL}"),
    "MPC, `full`, anywhere": ("mpc", f"default{FULL}+trust_radius2.0"),
}


@dataclass(frozen=True)
class Question:
    """Does what `row` has and `paired` lacks change a number?"""

    words: str
    row: Row
    paired: Row
    shown: bool = True  # on the page


_CLONE, _SHIELDED, _ADAPTED, _FULL = (("bc", f"default{guard}") for guard in ("", SHIELD, ADAPT, FULL))
QUESTIONS = (
    Question("a shield, under BC", _SHIELDED, _CLONE),
    Question("danger learned, not the formula, in that shield", _SHIELDED, ("bc", "default+shield-analytic")),
    Question("`full`, not the shield alone", _FULL, _SHIELDED),
    Question("BC under `full`, not MPC from a zero proposal", _FULL, ("mpc", f"default{FULL}")),
)
_FROM_NOTHING = "BC under `full`, not MPC from a zero proposal"
OF_ROBOTS = (
    Question("a guard (`adapt`), under BC", _ADAPTED, _CLONE),
    Question("danger learned, not the formula", _ADAPTED, ("bc", "default+adapt-analytic")),
    Question("`full`, not `adapt`", _FULL, _ADAPTED),
    *(
        Question(f"{name}, not bc", (name, f"default{ADAPT}"), _ADAPTED, shown=False)
        for name in ("bc-return", "bc-best", "ma-td3bc", "omar")
    ),
    Question(f"{_FROM_NOTHING} (near rest)", _FULL, ("mpc", f"default{FULL}")),
    Question(f"{_FROM_NOTHING} (climbed anywhere)", _FULL, ("mpc", f"default{FULL}+trust_radius2.0")),
)
# By suite: what is asked, and of which cost; no robot starts above the limit.
ASKED = {"guards": (QUESTIONS, "cost_safe_start"), "guards-mujoco": (OF_ROBOTS, "cost")}


def of_seeds(suite: str, task: str, row: Row, keys: tuple[str, str], digits: tuple[int, int]) -> tuple[str, int]:
    """Two means of a row on a task, as words, and of how many seeds."""
    here = variant(task, row)
    means = [(evidence.mean(suite, task, here, key), n) for key, n in zip(keys, digits)]
    words = "–" if means[0][0] is None else " / ".join(f"{value:z.{n}f}" for value, n in means)
    return words, len(of(suite, task, here))


def usual(counts: Iterable[int]) -> int:
    """The most common number of seeds."""
    return Counter(n for n in counts if n).most_common(1)[0][0]


def crossed(suite: str) -> str:
    """A line per proposal, a column per task: normalised return / cost of resets that start safely → return under a
    shield, whose cost the page gives."""
    columns = []
    for task in tasks_of(suite):
        cells = []
        for row in CROSSED.values():
            text, seeds = of_seeds(suite, task, row, ("return_norm", "cost_safe_start"), (2, 2))
            guarded = evidence.mean(suite, task, variant(task, (row[0], row[1] + SHIELD)), "return_norm")
            text += f" → {guarded:z.2f}" if guarded is not None else ""
            cells.append((text, seeds if row[1] != "reference" else 0))
        most = usual(n for _, n in cells)
        marked = [text + (f" [{n}]" if n not in (0, most) else "") for text, n in cells]
        columns.append((f"{task.partition('-')[2]} [{most}]", *marked))
    heads, *lines = zip(("proposal", *CROSSED), *columns)
    return markdown(heads, lines) + OF_SEEDS


def robots(suite: str) -> str:
    """A line per proposal, a column per data set under the limit that proposals were played with: return / steps above
    it."""
    names = [t for t in tasks_of(suite) if of(suite, t, variant(t, ON_ROBOTS["return-conditioned BC"]))]
    lines = []
    for words, row in ON_ROBOTS.items():
        made = [of_seeds(suite, task, row, ("return_mean", "cost_mean"), (0, 1)) for task in names]
        most = usual(seeds for _, seeds in made)
        cells = [text + (f" [{seeds}]" if seeds not in (0, most) else "") for text, seeds in made]
        lines.append((f"{words} [{most}]", *cells))
    return bare(["", *names], lines) + OF_SEEDS


@functools.cache
def answers(suite: str) -> list[tuple[Question, str, list[Difference]]]:
    """(question, key, difference on every task that has both rows); p-values adjusted over all of them together."""
    asked, cost = ASKED[suite]
    found = []
    for q in asked:
        for key in ("return", cost):
            each = (difference(suite, t, variant(t, q.row), variant(t, q.paired), key) for t in tasks_of(suite))
            found.append((q, key, [d for d in each if d]))
    adjusted = iter(family([d for *_, ds in found for d in ds]))
    return [(q, key, [next(adjusted) for _ in ds]) for q, key, ds in found]


def questions(suite: str) -> str:
    """A line per question and number: the difference on every task, bold where it is significant. Costs that differ
    nowhere are left out."""
    names, lines = tasks_of(suite), []
    for q, key, ds in answers(suite):
        if not q.shown or not ds or (key != "return" and not any(d.holds for d in ds)):
            continue
        by_task = {d.task: shown(d, key) for d in ds}
        lines.append((q.words, "return" if key == "return" else "cost", *(by_task.get(n, "–") for n in names)))
    return markdown(("what differs", "of", *(n.partition("-")[2] for n in names)), lines)


def counted(suite: str) -> str:
    """A line per question of robots: on how many tasks the row has more and less, beyond chance, and which they are.
    What differs nowhere is left out."""
    lines = []
    for q, key, ds in answers(suite):
        if not q.shown or not any(d.holds for d in ds):
            continue
        sides = [[f"`{d.task}` {d.mean:+.3g}" for d in ds if d.holds and d.mean * sign > 0] for sign in (1, -1)]
        listed = [f": {', '.join(side)}" if len(side) <= 3 else "" for side in sides]
        counts = [f"**{len(side)}**{names}" if side else "0" for side, names in zip(sides, listed)]
        seeds = sorted({len(d.seeds) for d in ds})
        some = "–".join(map(str, dict.fromkeys((seeds[0], seeds[-1]))))
        lines.append((q.words, key, len(ds), some, *counts))
    return markdown(("what differs", "of", "tasks", "seeds", "more on", "less on"), lines)


def shown(d: Difference, key: str) -> str:
    digits = 0 if key == "return" else 2
    text = f"{d.mean:+.{digits}f} [{d.low:.{digits}f}, {d.high:.{digits}f}]"
    return f"**{text}**" if d.holds else text


def _proving(folder: str, files: str, filtered: bool = True) -> Callable[[], str]:
    return lambda: proving(folder, files, filtered)


TABLES: dict[tuple[str, str], Callable[[], str]] = {
    ("docs/guard-results.md", "spread"): lambda: table(SPREAD, short),
    ("docs/guard-results.md", "robots"): lambda: table(ROBOTS, long),
    ("docs/proving-ground.md", "proving"): _proving("proving", "proving-*.json"),
    ("docs/proving-ground.md", "others"): _proving("proving/others", "*.json", False),
    ("docs/proving-ground.md", "drawn"): _proving("proving/drawn", "*.json", False),
    ("docs/crossing-results.md", "tiers"): tiers,
    ("docs/crossing-results.md", "guards"): lambda: crossing("crossing-guards", WAYS),
    ("docs/crossing-results.md", "proposals"): proposals,
    ("docs/crossing-results.md", "teams"): lambda: crossing("crossing-teams", TEAMS),
    ("docs/crossing-results.md", "sizes"): sizes,
    ("docs/attribution.md", "crossed"): lambda: crossed("guards"),
    ("docs/attribution.md", "questions"): lambda: questions("guards"),
    ("docs/attribution.md", "robots"): lambda: robots("guards-mujoco"),
    ("docs/attribution.md", "robot-questions"): lambda: counted("guards-mujoco"),
}
