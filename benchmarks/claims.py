"""What the documents claim, each sentence with the rows and the test behind it; fails when one does not hold, or when
its words are no longer there.

    python benchmarks/claims.py          # prints docs/claims.md's table into it
"""

from __future__ import annotations

import json
import re
import sys
import textwrap
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import planner_tables
import pooled
from ablations import adjusted
from common import put, read
from evidence import LEVEL, difference, evaluations, mean, of, proven, tasks_of, variant
from guards_tables import FULL, QUESTIONS, SHIELD, Question, answers
from scipy.stats import fisher_exact, spearmanr

from ringfence.datasets.registry import TASKS
from ringfence.evaluation.statistics import mean_of_runs
from ringfence.report import board, standings

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "results"
SPREAD = "results/guards/table.csv"
POOL = "results/pooled/simple_spread-expert-pooled.json"
MEDIUM_POOL = "results/pooled/simple_spread-medium-pooled.json"
RANDOM_POOL = "results/pooled/simple_spread-random-pooled.json"
FULL_POOL = ", under full"  # ends the names of their rows
PROVING = "results/proving"
DRAWN = "results/proving/drawn"
CROWD = "results/replay/students03.json"
PEDESTRIANS = "results/stress/pedestrians.csv"
SYSTEMS = "results/stress/systems.csv"
ROBOTS = "guards-mujoco"
ROBOT_ROWS = f"results/{ROBOTS}/table.csv"
TRACKERS = "results/proving/trackers.json"
STRESS = "results/stress/crossing.csv"
PLANNER = "results/planner"
LEARNER, FIVE = "simple_spread-expert", "simple_spread-expert-pooled"  # one learner's logs, five learners'
SHOWN = 80  # letters of a sentence in the table


@dataclass(frozen=True)
class Claim:
    """A piece of a sentence, where it stands, the file it rests on, and a check that tells what it found."""

    page: str
    words: str
    file: str
    check: Callable[[], tuple[bool, str]]


def asked(row, paired) -> Question:
    return next(q for q in QUESTIONS if (q.row, q.paired) == (row, paired))


def tested(row, paired, key: str, verdict: Callable[[list], bool]) -> Callable[[], tuple[bool, str]]:
    """A question of attribution.py: `verdict` of its differences on all tiers, adjusted with all others."""

    def check():
        found = next(ds for q, k, ds in answers("guards") if q == asked(row, paired) and k == key)
        differences = ", ".join(f"{d.mean:+.3g}{'' if d.holds else ' (chance)'}" for d in found)
        return len(found) == 4 and verdict(found), f"{key} {differences}"

    return check


def on_robots(row, paired, more: int, less: int) -> Callable[[], tuple[bool, str]]:
    """On how many of the nine data sets the row earns more and less than its paired baseline, adjusted with all other
    questions of robots."""

    def check():
        answered = answers(ROBOTS)
        found = next(ds for q, key, ds in answered if (q.row, q.paired) == (row, paired) and key == "return")
        sides = [[f"{d.task} {d.mean:+.0f}" for d in found if d.holds and d.mean * sign > 0] for sign in (1, -1)]
        seeds = {len(d.seeds) for d in found}
        text = f"{told(sides)}; {min(seeds)} to {max(seeds)} seeds"
        return (len(found), *map(len, sides)) == (9, more, less), text

    return check


def told(sides: list[list[str]]) -> str:
    """On what a row has more, and on what less; of many, how many."""
    named = [", ".join(side) if 0 < len(side) < 4 else len(side) or "none" for side in sides]
    return f"more on {named[0]}, less on {named[1]}"


def of_a_pool(row: str, verdict: Callable[[dict, dict], bool]) -> Callable[[], tuple[bool, str]]:
    """`verdict` of a row of `POOL` and of the data."""

    def check():
        found = json.loads((ROOT / POOL).read_text())
        r = found["rows"][row]
        low, high = r["return_norm_interval"]
        text = f"{r['return_norm']:.3f} [{low:.3f}, {high:.3f}], data {found['data']['return_norm']:.3f}"
        text += f", its best driver {max(found['data']['of_drivers']):.3f}"
        return verdict(r, found["data"]), text

    return check


def of_systems() -> tuple[bool, str]:
    """Episodes on the proving ground: the clone's by the seed that violates most, the naive driver's in the mean."""
    found = proven()
    rows = {one["task"].removeprefix("proving-"): one["rows"] for one in found}
    clone = {name: r["bc shield learned"]["most"] for name, r in rows.items()}
    naive = {name: r["naive shield learned"]["violation_rate"] for name, r in rows.items()}
    kept = {n: r["bc shield learned"]["return_mean"] / r["bc shield oracle"]["return_mean"] for n, r in rows.items()}
    fine = [name for name in rows if clone[name] <= 0.01 and kept[name] >= 0.9]
    refused = [one["task"].removeprefix("proving-") for one in found if "unfit" in one["verdicts"]]
    most = max(rate for name, rate in clone.items() if name in fine)
    more = [name for name in fine if naive[name] > 0.01]
    holds = len(rows) == 16 and most <= 0.01 and len(fine) == 14 and len(more) == 4 and refused == ["arms", "train"]
    return holds, f"{most:.3f} at most on {len(fine)}, at nine tenths of the return; naive more on {', '.join(more)}"


def of_bad_driving() -> tuple[bool, str]:
    """Systems on which the guard leaves the naive driver at most 2 %, as it is and by three rows."""
    rows = [one["rows"] for one in proven()]
    kept = [r["naive shield learned"]["return_mean"] / r["naive shield oracle"]["return_mean"] for r in rows]
    far = [r["naive shield learned"]["violation_rate"] <= 0.02 and share >= 0.9 for r, share in zip(rows, kept)]
    near = [r["naive shield learned, 3 rows"]["violation_rate"] <= 0.02 for r in rows]
    return (sum(far), sum(near)) == (12, 8), f"{sum(far)} of {len(rows)}, by three rows {sum(near)}"


def of_shapes() -> tuple[bool, str]:
    """Episodes with a violation of guarded clones by causes of more shapes, and without (Fisher's exact test)."""
    each = [r for r in rows_of("shapes.csv", guard="shield", driver="clone") if r["system"] != "rays"]
    rows = {(r["system"], r["seed"], r["causes"]): r for r in each}
    logs = [key[:2] for key in rows if key[2] == "more shapes"]
    left = {key: [_violated(rows[*key, causes]) for causes in ("more shapes", "no more shapes")] for key in logs}
    fewer = {key[0] for key, (more, plain) in left.items() if fisher_exact(np.c_[more, plain], "less").pvalue < LEVEL}
    words = [f"{' '.join(key)} {plain[0]} → {more[0]}" for key, (more, plain) in left.items()]
    unfit = [key for key in logs if rows[*key, "more shapes"]["verdict"] == "unfit"]
    most = [max(each[k][0] for each in left.values()) for k in (0, 1)]
    holds = not unfit and most == [6, 99] and len(logs) == 16 and len(fewer) == 11
    return holds, f"of 100: {', '.join(words)}"


def of_rays() -> tuple[bool, str]:
    """Return and episodes with a violation of guarded drivers, by rays that are one cause, and by eight causes."""
    rows = {(r["causes"], r["driver"]): r for r in rows_of("shapes.csv", guard="shield", system="rays")}
    both = {
        which: [rows[which, driver] for driver in ("naive", "clone")] for which in ("more shapes", "no more shapes")
    }
    violated = {which: [_violated(r)[0] for r in each] for which, each in both.items()}
    earned = {which: [float(r["return"]) for r in each] for which, each in both.items()}
    fit = {r["verdict"] for r in both["more shapes"]} == {"fit"}
    holds = fit and min(violated["more shapes"]) > 20 and max(violated["no more shapes"]) <= 10
    holds &= max(earned["no more shapes"]) < 0 < min(earned["more shapes"])
    return holds, f"violated {violated}, return {earned}"


def of_maps() -> tuple[bool, str]:
    """Episodes with a violation of guarded drivers by logs of places, read as distances and as they are."""
    rows = {(r["system"], r["driver"], r["guard"], r["causes"]): r for r in rows_of("on_map.csv")}
    systems = dict.fromkeys(key[0] for key in rows)
    near, far, alone = (
        {name: rows[name, "clone", guard, which] for name in systems}
        for guard, which in (("shield", "how far away"), ("shield", "places as they are"), ("none", "how far away"))
    )
    holds = {r["verdict"] for r in near.values()} == {"fit"} and {r["verdict"] for r in far.values()} == {"unfit"}
    left = {name: _violated(r)[0] for name, r in near.items()}
    holds &= left.pop("listed") == 14 and max(left.values()) == 4 and len(left) == 6
    # no fewer beyond chance
    tests = [fisher_exact(np.c_[_violated(far[name]), _violated(alone[name])], "less").pvalue for name in systems]
    return holds and min(tests) > LEVEL, f"{left} of 100, as they are {[_violated(r)[0] for r in far.values()]}"


def _violated(row: dict[str, str]) -> list[int]:
    """Episodes with a violation, and without."""
    count = round(float(row["violated"]) * int(row["episodes"]))
    return [count, int(row["episodes"]) - count]


def of_late_actions() -> tuple[bool, str]:
    """Episodes with contact of a guard that knows of late actions, and of one that does not."""
    rows = {(r["faults"], r["guard"], r["compensated"]): r for r in read(ROOT / STRESS)}
    known = [float(rows[f"delay{k}", "shield", "True"]["violation_rate"]) for k in (1, 2, 3)]
    unknown = [float(rows[f"delay{k}", "shield", "False"]["violation_rate"]) for k in (1, 2, 3)]
    holds = all(a < 0.1 * b for a, b in zip(known, unknown)) and max(known) <= 0.02 and 0.93 <= max(unknown) < 0.95
    return holds, f"{known} of {unknown}"


def of_trackers() -> tuple[bool, str]:
    """Violations of a naive driver under guard, by what dynamics know of lists."""
    rows = json.loads((ROOT / TRACKERS).read_text())
    naive = {name: row["naive, shield"]["violation_rate"] for name, row in rows.items()}
    clones = max(row["clone, shield"]["violation_rate"] for row in rows.values())
    falls = naive["as it is"] < 0.3 * naive["not who is seen"] < 0.3 * naive["nor what is an angle"]
    return falls and clones == 0, f"{naive}, clones {clones} at most"


def of_late_systems() -> tuple[bool, str]:
    """Unsafe steps behind late actions, of a guard that knows of them."""
    rows = read(ROOT / SYSTEMS)
    known = {
        (r["task"], r["faults"]): float(r["cost"])
        for r in rows
        if re.fullmatch(r"delay\d", r["faults"]) and r["guard"] == "shield, compensated"
    }
    return len(known) == 9 and max(known.values()) == 0, f"{max(known.values()):.2f} at most, of {len(known)}"


def of_a_robot_behind_faults() -> tuple[bool, str]:
    """Unsafe steps of a guarded robot behind faults."""
    costs = [float(r["cost"]) for r in read(ROOT / SYSTEMS) if r["guard"].startswith("adapt")]
    return len(costs) > 20 and max(costs) <= 25, f"{max(costs):.1f} at most, of {len(costs)}"


def of_pedestrians() -> tuple[bool, str]:
    """Contacts of pedestrians that a guard leaves which knows of late or lost steps, of those of one that does not."""
    rows = read(ROOT / PEDESTRIANS)

    def left(faults: str, guard: str) -> int:
        return sum(int(r["contacts"]) for r in rows if (r["faults"], r["guard"]) == (faults, guard))

    names = sorted({r["faults"] for r in rows if re.fullmatch(r"(delay|drop)[\d.]+", r["faults"])})
    shares = {name: left(name, "shield, compensated") / left(name, "shield") for name in names}
    return len(shares) == 6 and max(shares.values()) <= 0.5, f"{max(shares.values()):.2f} at most, of {len(shares)}"


def of_shielded_pool() -> tuple[bool, str]:
    """Generators of the pool of experts under a shield, and the same without."""
    rows = json.loads((ROOT / POOL).read_text())["rows"]
    pairs = {name: (rows[name], rows[f"{name}, under shield"]) for name in rows if f"{name}, under shield" in rows}
    cost = max(shield["cost_safe_start"] for _, shield in pairs.values())
    more = {name: shield["return_norm"] - alone["return_norm"] for name, (alone, shield) in pairs.items()}
    low, high = min(more.values()), max(more.values())
    return cost < 0.005 and low > -0.01, f"cost {cost:.3f} at most; return {low:+.3f} to {high:+.3f}, of {len(more)}"


def of_medium_pool() -> tuple[bool, str]:
    """What learns the pool of medium drivers beside the best of these."""
    found = json.loads((ROOT / MEDIUM_POOL).read_text())
    best = max(found["data"]["of_drivers"])
    rows = {name: found["rows"][name] for name in ("bc-best", "ma-td3bc")}
    text = ", ".join(f"{name} {r['return_norm']:.3f} {r['return_norm_interval']}" for name, r in rows.items())
    within = all(r["return_norm_interval"][0] <= best <= r["return_norm_interval"][1] for r in rows.values())
    return within, f"the best driver {best:.3f}; {text}"


def under_full(file: str) -> dict[str, dict]:
    """Rows of a pool under `full`."""
    rows = json.loads((ROOT / file).read_text())["rows"]
    return {name.removesuffix(FULL_POOL): r for name, r in rows.items() if name.endswith(FULL_POOL)}


def of_full_pool() -> tuple[bool, str]:
    """Clones of the pool of experts under `full`."""
    data = json.loads((ROOT / POOL).read_text())["data"]["return_norm"]
    rows = {name: r for name, r in under_full(POOL).items() if name.startswith("bc")}
    least = min(r["return_norm_interval"][0] for r in rows.values())
    seeds = {len(rows[name]["seeds"]) for name in ("bc, 20,000 updates", "bc-best")}
    return least > data and seeds == {5}, ", ".join(f"{name} {r['return_norm']:.2f}" for name, r in rows.items())


def of_full_pools() -> tuple[bool, str]:
    """Whoever proposes under `full` on the pools without experts, beside what generators earn alone."""
    least, most = np.inf, -np.inf
    for file in (MEDIUM_POOL, RANDOM_POOL):
        rows = json.loads((ROOT / file).read_text())["rows"]
        least = min(least, *(r["return_norm"] for r in under_full(file).values()))
        most = max(most, *(r["return_norm"] for r in rows.values() if "guard" not in r["played"]))
    return least > 1.2 and most < 0.34, f"full {least:.2f} at least, alone {most:.2f} at most"


def of_robot_pools() -> tuple[bool, str]:
    """What `flow` earns more than a clone on HalfCheetah's tiers, on the same resets."""
    more = {}
    for tier in ("good", "medium", "poor"):
        rows = json.loads((ROOT / f"results/pooled/halfcheetah_2x3-{tier}.json").read_text())["rows"]
        earned = [np.array(rows[name]["per_episode"]["return"]) for name in ("flow", "bc, 20,000 updates")]
        more[tier] = mean_of_runs(earned[0] - earned[1])
    text = ", ".join(f"{tier} [{low:.0f}, {high:.0f}]" for tier, (low, high) in more.items())
    signs = sorted((low > 0) - (high < 0) for low, high in more.values())
    return signs == [-1, 0, 1], text


def of_robots_asked(who: str, wins: int, losses: int = 0) -> Callable[[], tuple[bool, str]]:
    """What `flow` under `adapt` earns more than a clone under it, on the same resets of every robot's data."""

    def found() -> tuple[bool, str]:
        rows = {r["task"]: r["rows"] for r in pooled.kept(robots=True)}
        apart = {task: pooled.more(r[who], r[pooled.CLONE])[1] for task, r in rows.items()}
        cost = max(r[who]["cost_mean"] for r in rows.values())
        intervals = {task: f"{task} [{low:.0f}, {high:.0f}]" for task, (low, high) in apart.items()}
        sides = [
            [intervals[task] for task, (low, _) in apart.items() if low > 0],
            [intervals[task] for task, (_, high) in apart.items() if high < 0],
        ]
        holds = (*map(len, sides),) == (wins, losses) and cost <= 25
        return holds, f"{told(sides)} of {len(apart)}; {cost:.0f} steps above the limit at most"

    return found


def of_climbing_robots() -> tuple[bool, str]:
    """Clones under `full` beside the best of eight proposals, on robots."""
    more = {}
    for found in pooled.kept(robots=True):
        best = found["rows"][pooled.BEST]["return_mean"]
        more[found["task"]] = earned_by_clone(found["task"], "full") - best
    most = sum(x > 0 for x in more.values()) > len(more) / 2
    sides = [[f"{name} {x:+.0f}" for name, x in more.items() if x * sign > 0] for sign in (1, -1)]
    return most, f"{told(sides)} of {len(more)}"


def of_selection() -> tuple[bool, str]:
    """The best of several proposals, by values, beside the proposals."""
    told = {}
    for file in (MEDIUM_POOL, RANDOM_POOL):
        rows = json.loads((ROOT / file).read_text())["rows"]
        told[file] = [rows[name]["return_norm"] for name in ("flow", "flow, the best of 8", "flow, the best of 64")]
    text = "; ".join(" / ".join(f"{x:.2f}" for x in row) for row in told.values())
    return all(one + 0.1 < eight < many for one, eight, many in told.values()), f"1 / 8 / 64: {text}"


def of_rebounds() -> tuple[bool, str]:
    """Guards of a system whose bodies bounce off what they touch, and the same by states as they were logged."""
    now, before = (
        json.loads((ROOT / PROVING / name).read_text())["rows"]
        for name in ("others/x9.json", "tried/x9-as-logged.json")
    )
    leaning = json.loads((ROOT / PROVING / "others/x10.json").read_text())["rows"]
    kinds = (now, before, leaning)
    rates = [[rows[f"{who} shield learned"]["violation_rate"] for who in ("bc", "naive")] for rows in kinds]
    text = f"clone and naive {rates[0]}, as logged {rates[1]}; `x10` {rates[2]}"
    return rates[0] == rates[2] == [0, 0] and min(rates[1]) > 0.9, text


def of_drawn_systems() -> tuple[bool, str]:
    """Guards by the Worlds of systems drawn at random that call themselves fit."""
    found = [json.loads(file.read_text()) for file in sorted((ROOT / DRAWN).glob("*.json"))]
    rows = [one["rows"] for one in found if one["verdict"] == "fit"]
    clone, naive = (max(r[f"{who} shield learned"]["violation_rate"] for r in rows) for who in ("bc", "naive"))
    return clone == 0 and naive <= 0.07, f"{100 * clone:.0f} and {100 * naive:.1f} % at most, of {len(rows)}"


def of_a_crowd() -> tuple[bool, str]:
    """Of the contacts that five drivers make among filmed pedestrians: within the logs, and beyond."""
    found = json.loads((ROOT / CROWD).read_text())
    shares = []
    for rows in (found["rows"], found["beyond the logs"]):
        shield = [row for row in rows if row["filter"] == "shield"]
        shares.append(sum(row["prevented"] for row in shield) / sum(row["alone"] for row in shield))
    within, beyond = shares
    return 0.72 < within < 0.78 and beyond < 0.5, f"{100 * within:.0f} and {100 * beyond:.0f} %"


def of_filters() -> tuple[bool, str]:
    """Naive drivers under the shield that learned, and under the classical filter, where there is one."""
    rows = {one["task"].removeprefix("proving-"): one["rows"] for one in proven() if "naive cbf-qp" in one["rows"]}
    both = {n: [r[f"naive {how}"]["violation_rate"] for how in ("shield learned", "cbf-qp")] for n, r in rows.items()}
    fewer = [name for name, (mine, theirs) in both.items() if mine < theirs]
    more = [name for name, (mine, theirs) in both.items() if mine > theirs]
    return (len(fewer), sorted(more)) == (8, ["arms", "bench", "train"]), f"fewer on {len(fewer)}, more on {more}"


PRIOR = on_robots(("bc", f"default{FULL}"), ("mpc", f"default{FULL}"), 6, 1)
ANYWHERE = on_robots(("bc", f"default{FULL}"), ("mpc", f"default{FULL}+trust_radius2.0"), 8, 0)


def chance(found: list) -> bool:
    return not any(d.holds for d in found)


def lower(found: list) -> bool:
    return all(d.holds and d.mean < 0 for d in found)


def higher(found: list) -> bool:
    return all(d.holds and d.mean > 0 for d in found)


def shielded_all() -> tuple[bool, str]:
    """No proposal under the learned shield has any cost left on any tier, nor less return by more than 2 % of the
    range."""
    left, lost = [], []
    for (task, algorithm, named), runs in evaluations("guards").items():
        alone = of("guards", task, (algorithm, named.removesuffix(SHIELD)))
        if named.endswith(SHIELD) and alone:
            left.append(mean("guards", task, (algorithm, named), "cost_safe_start"))
            both = set(runs) & set(alone)
            lost.append(np.mean([alone[s]["return_norm"] - runs[s]["return_norm"] for s in both]))
    text = f"{len(left)} proposals and tiers: at most {max(left):.3f} cost left, {max(lost):.3f} normalised return lost"
    return max(left) == 0 and max(lost) <= 0.02, text


def same_safety() -> tuple[bool, str]:
    """Learned danger beside the formula, under cloning: Simple Spread's shield and the robots' adapting one."""
    share, left = [], []
    for task in tasks_of("guards"):
        learned, formula = (mean("guards", task, ("bc", f"default+shield-{d}"), "return_mean") for d in BARRIERS)
        share.append(learned / formula)
        left.append(mean("guards", task, ("bc", "default+shield-learned"), "cost_safe_start"))
    kept = [limits(ROBOTS, "bc", f"default+adapt-{d}") for d in BARRIERS]
    ok = min(share) > 0.98 and max(left) < 0.05 and kept[0] >= kept[1]
    return ok, (
        f"at least {100 * min(share):.1f} % of the return on every tier, at most {max(left):.3f} cost left; robots' "
        f"limits kept {kept[0]} and {kept[1]} of 18"
    )


BARRIERS = ("learned", "analytic")
NAIVE = "naive controller"


def limits(suite: str, algorithm: str, variant: str) -> int:
    """Tasks on which the upper end of the cost's interval is within the limit."""
    shown = standings.standings(board.read(RESULTS / suite))
    found = [
        r for rows in shown.values() for r in rows if (r.method.algorithm, r.method.variant) == (algorithm, variant)
    ]
    return sum(r.safe for r in found)


def robots_kept(algorithm: str, variant: str, wanted: int, suite: str = ROBOTS) -> Callable[[], tuple[bool, str]]:
    def check():
        kept = limits(suite, algorithm, variant)
        return kept == wanted, f"{kept} of {len(tasks_of(suite))}"

    return check


def contact(suite: str, row, low: float, high: float, task: str = "crossing-hasty") -> Callable[[], tuple[bool, str]]:
    """The share of episodes with contact lies in a range."""

    def check():
        share = mean(suite, task, row, "violation_rate")
        return low <= share <= high, f"{100 * share:.3g} % of episodes"

    return check


def careful_logs_suffice() -> tuple[bool, str]:
    """Logs with contact in one episode of twenty teach a World that leaves hardly any; of naive drivers, none."""
    words = "logs of IR-SIM"
    few, many = (
        [float(r["episodes with contact"]) for r in of_irsim(w)] for w in (words, f"{words}, two of eight naive")
    )
    text = " / ".join(f"{100 * x:.3g} %" for x in (*few, *many))
    return few[0] == 0 and max(few) < 0.05 and max(many) == 0, f"8 and 16 robots, both logs: {text} of episodes"


def crossing_rare() -> tuple[bool, str]:
    """Contact under the shield, on all tiers of Crossing."""
    row = ("bc", "default+shield-learned")
    tiers = [f"crossing{body}-{tier}" for body in ("", "_unicycle") for tier in ("hasty", "mixed", "careful", "random")]
    runs = [r for tier in tiers for r in of("crossing", tier, row).values()]
    touched = sum(round(r["violation_rate"] * r["episodes"]) for r in runs)
    episodes = sum(r["episodes"] for r in runs)
    return (touched, episodes) == (1, 10_000), f"{touched} of {episodes} episodes, one seed; three of hasty unicycles"


def rows_of(file: str, **where: str) -> list[dict[str, str]]:
    """Rows of a table in results/ with these entries."""
    rows = read(file)
    return [r for r in rows if all(r[k] == v for k, v in where.items())]


def one_keeps_both() -> tuple[bool, str]:
    """No contact and no step too fast by one barrier for both or by one each, whose return lies below the first's."""
    none, one, each = (rows_of("constraints.csv", guard=g, barriers=b)[0] for g, b in TWO)
    contact = [float(r["contact"]) for r in (none, one, each)]
    kept = contact[0] > 0 and all(float(r[key]) == 0 for r in (one, each) for key in ("contact", "fast"))
    lost = float(one["return"]) - float(each["return"])
    shares = " / ".join(f"{100 * c:.1f} %" for c in contact)
    text = f"{shares} without a guard, with one, with each; {lost:.2f} of return"
    return kept and float(each["return_high"]) < float(one["return_low"]), text


TWO = (("none", ""), ("shield", "one"), ("shield", "each"))


def brakes_in_time() -> tuple[bool, str]:
    """Of the clone three rows leave next to nothing; of the naive controller they leave most, and V nothing."""
    ask = dict(guard="shield", barrier="learned")
    clone, naive, seen = (
        float(rows_of("yard.csv", method=who, options=how, **ask)[0]["contact"])
        for who, how in (("BC", "terminal_value=False"), (NAIVE, "terminal_value=False"), (NAIVE, ""))
    )
    text = (
        f"3 rows: {100 * clone:.2g} % of the clone's episodes, {100 * naive:.3g} % of the naive; V: {100 * seen:.2g} %"
    )
    return clone <= 0.005 and naive > 0.5 and seen <= 0.01, text


def learned_sees_more() -> tuple[bool, str]:
    """Under the same three rows the formula's interval lies above V's bound."""
    learned, formula = (rows_of("yard.csv", method=NAIVE, guard="shield", barrier=b, options="")[0] for b in BARRIERS)
    shares = [float(r["contact"]) for r in (learned, formula)]
    return shares[1] > 0.6 and float(learned["bound"]) < 0.02, f"{100 * shares[0]:.2g} % and {100 * shares[1]:.3g} %"


def own_shield_leaves(most: float) -> Callable[[], tuple[bool, str]]:
    def check():
        row = ("bc", "default+shield-learned-decentralized")
        left = max(mean("own-sight", task, row, "cost_safe_start") for task in tasks_of("own-sight"))
        return left <= most, f"at most {left:.3f} on four tiers"

    return check


def as_safe_by_v() -> tuple[bool, str]:
    """ℓ alone touches along one row, and neither V with it, nor with three, nor ℓ along seven does."""
    name = "default+shield-learned"
    shares = [
        mean("crossing-guards", "crossing-hasty", ("bc", name + more), "violation_rate")
        for more in (*(f"+horizon{k}+terminal_valueFalse" for k in (1, 3, 7)), "+horizon1", "")
    ]
    text = ", ".join(f"{100 * s:.3g} %" for s in shares)
    held = shares[0] > 0.1 and 0 < shares[1] < 0.03 and max(shares[2:]) == 0
    return held, f"ℓ with 1, 3, 7 rows, V with 1, 3: {text} of episodes"


def told_clones_earn() -> tuple[bool, str]:
    """More than plain cloning and than the certificates on the same resets, and without contact."""
    suite, task, key = "crossing-guards", "crossing-hasty", "default+shield-learned"
    better = [difference(suite, task, ("bc-return", key), paired, "return") for paired in (("bc", key), CERTIFICATES)]
    touched = mean(suite, task, ("bc-return", key), "violation_rate")
    text = ", ".join(f"{d.mean:+.2f} ({d.low:+.2f} to {d.high:+.2f})" for d in better)
    return touched == 0 and all(d.low > 0 for d in better), f"{text} than cloning and than certificates; contact in 0 %"


CERTIFICATES = ("certificates", "reference")


def full_is_safe() -> tuple[bool, str]:
    """No contact, and by how much more than the shield alone."""
    suite, task, key = "crossing-guards", "crossing-hasty", "default+full-learned"
    more = difference(suite, task, ("bc", key), ("bc", "default+shield-learned"), "return")
    share = more.mean / mean(suite, task, ("bc", "default+shield-learned"), "return_mean")
    touched = mean(suite, task, ("bc", key), "violation_rate")
    text = f"contact in {100 * touched:g} %, {100 * share:.0f} % more"
    return touched == 0 and 0.23 < share < 0.27 and more.low > 0, text


def limits_learned() -> tuple[bool, str]:
    """How many of five limits the Lagrangian learner keeps on each task."""
    kept = Counter()
    for r in rows_of("frontiers.csv", method="MA-TD3+BC, Lagrange"):
        kept[r["task"]] += float(r["cost"]) <= float(r["value"])
    spread = sum(n for task, n in kept.items() if task.startswith("simple_spread"))
    del kept["crossing-hasty"]  # where a limit is of each agent's cost, and the row is of the team's
    return (spread, kept["halfcheetah_2x3-good"]) == (9, 0), ", ".join(f"{task} {n} of 5" for task, n in kept.items())


def guards_price() -> tuple[bool, str]:
    """Return of guarded cloning at the calibrated margin over that at the loosest, where there is no time to adapt."""
    shares = {}
    for task in ("simple_spread-expert", "simple_spread-medium-replay", "crossing-hasty"):
        of = {r["value"]: r for r in rows_of("frontiers.csv", task=task, method="BC, guarded")}
        shares[task] = float(of["1.0"]["return"]) / float(of["-1.0"]["return"]), float(of["1.0"]["cost"])
    text = ", ".join(f"{task} {100 * share:.1f} % at {cost:g}" for task, (share, cost) in shares.items())
    return all(share > 0.99 and cost <= 0.005 for share, cost in shares.values()), text


def undelayed_logs_leave_little() -> tuple[bool, str]:
    """Episodes with contact and return under shields by Worlds of late logs, as they are and undelayed."""
    rows = {(int(r["late"]), r["world"][:12], r["delay"]): r for r in rows_of("late_logs.csv")}
    text, holds = [], True
    for late in (1, 2, 3):
        mended, raw = rows[late, "of undelayed", str(late)], rows[late, "of the logs ", "0"]
        twice = rows[late, "of the logs ", str(late)]
        left = [float(r["contact"]) for r in (mended, raw, twice)]
        holds &= left[0] <= 1 / 300 + 1e-4 and left[0] <= left[1] <= left[2]
        holds &= float(mended["return"]) > float(raw["return"])
        text.append(f"{late} late: {', '.join(f'{100 * share:.2g} %' for share in left)}")
    return holds, "; ".join(text)


def no_size_touches() -> tuple[bool, str]:
    """Under a shield and `full`, in teams of two, three, four and six, by every seed."""
    rows = rows_of("spread-teams/table.csv", barrier="learned")
    left = max(float(r["cost_safe_start"]) for r in rows)
    return left == 0 and len(rows) >= 24, f"{len(rows)} rows, at most {left:g} steps"


def no_size_loses() -> tuple[bool, str]:
    """The shield's mean return beside the clone's, of the same teams."""
    rows = defaultdict(list)
    for r in rows_of("spread-teams/table.csv", algorithm="bc"):
        rows[r["task"], r["agents"], r["guard"]].append(float(r["return_mean"]))
    teams = [(task, n) for task, n, guard in rows if guard == "shield"]
    more = {team: np.mean(rows[*team, "shield"]) / np.mean(rows[*team, "none"]) - 1 for team in teams}
    least, most = 100 * min(more.values()), 100 * max(more.values())
    return len(more) == 8 and least > -1, f"{least:+.1f} to {most:+.1f} %, of {len(more)} teams"


def of_other_integrators() -> tuple[bool, str]:
    """Clones' steps with contact where things move by other rules than the World's logs, and of logs recorded there."""
    rows = {(r["policy"], r["place"], r["guard"]): r for r in rows_of("mpe2.csv") if "icbf" not in r["policy"]}
    left = {}
    for who, place in {(who, place) for who, place, _ in rows if place != "ours, the data's rules"}:
        alone, guarded = (rows[who, place, g] for g in ("none", "shield"))
        left[who, place] = float(guarded["cost"]) / float(alone["cost"])
    own = next(key for key in left if "recorded" in key[0])
    kept = float(rows[*own, "shield"]["return"]) >= float(rows[*own, "none"]["return"])
    least, most = min(left.values()), max(left.values())
    return most < 0.5 and left[own] == least and kept, f"{100 * least:.0f} to {100 * most:.0f} % of the contact is left"


def full_earns_more() -> tuple[bool, str]:
    """Returns of robots under `full` beside `adapt`, by learned danger."""
    tasks = tasks_of(ROBOTS)
    earned = [[earned_by_clone(task, guard) for guard in ("full", "adapt")] for task in tasks]
    more = sum(full > adapt for full, adapt in earned)
    return more > len(tasks) / 2, f"{more} of {len(tasks)}"


def earned_by_clone(task: str, guard: str) -> float:
    """A clone's return on a robot under a guard of learned danger, over all seeds."""
    return mean(ROBOTS, task, variant(task, ("bc", f"default+{guard}-learned")), "return_mean")


def error_costs_nothing() -> tuple[bool, str]:
    """The simulator itself as the World's dynamics: intervals of return and cost reach 0 under shield and `full`."""
    rows = rows_of("ablations.csv", way="the true dynamics")
    text = "; ".join(
        f"{r['guard']} {r['more_return']} ({r['more_return_low']} to {r['more_return_high']})" for r in rows
    )
    reach = [float(r[f"more_{k}_low"]) <= 0 <= float(r[f"more_{k}_high"]) for r in rows for k in ("return", "cost")]
    return len(rows) == 2 and all(reach), f"return {text}"


def by_value_alone() -> tuple[bool, str]:
    """V in the place of ℓ: as safe on Crossing and Simple Spread, less return there and on the robot, at more cost."""
    rows = {r["task"]: r for r in adjusted(rows_of("ablations.csv")) if r["way"] == "by V alone"}
    crossing, spread, robot = (
        rows[name] for name in ("crossing-hasty", "simple_spread-expert", "halfcheetah_2x3-medium")
    )
    text = "; ".join(f"{name}: return {r['more_return']}, cost {r['more_cost']}" for name, r in rows.items())
    safe = float(crossing["cost"]) == 0 and float(spread["more_cost"]) == 0
    worse = all(r["holm_return"] < LEVEL and float(r["more_return_high"]) < 0 for r in (spread, robot))
    return safe and worse and robot["holm_cost"] < LEVEL and float(robot["more_cost_low"]) > 0, text


def guess_is_worth() -> tuple[bool, str]:
    """Own sight without its guess earns as much and costs as much, beyond chance."""
    rows = [r for r in adjusted(rows_of("ablations.csv")) if r["way"] == "foreseen by the own action alone"]
    text = ", ".join(f"{r['more_return']} (Holm p {r['holm_return']:.2g})" for r in rows)
    reach = [float(r[f"more_{k}_low"]) <= 0 <= float(r[f"more_{k}_high"]) for r in rows for k in ("return", "cost")]
    return len(rows) == 3 and all(reach), text


def of_irsim(words: str) -> list[dict[str, str]]:
    return rows_of("other_simulator.csv", guard="shield", **{"learned from": words})


def exported_in_time() -> tuple[bool, str]:
    slower = [float(r["stablehlo_ms"]) / float(r["controller_ms"]) for r in rows_of("export.csv")]
    return max(slower) <= 1.0, f"{min(slower):.2f} to {max(slower):.2f} of the controller's time"


def ranks_like(number: str, truth: str, least: float) -> Callable[[], tuple[bool, str]]:
    """Spearman's correlation on every task whose policies were evaluated by logs."""

    def check():
        tasks = {r["task"]: [] for r in rows_of("judging.csv")}
        for task in tasks:
            rows = rows_of("judging.csv", task=task)
            tasks[task] = float(spearmanr(*([float(r[k]) for r in rows] for k in (truth, number))).statistic)
        return min(tasks.values()) >= least, ", ".join(f"{k} {v:.2f}" for k, v in tasks.items())

    return check


def planned(group: str, task: str, name: str, way: str) -> tuple[np.ndarray, np.ndarray]:
    """Normalised return (seeds, E) of a planner's row, and cost of its safe starts (seeds,)."""
    found = planner_tables.played(planner_tables.rows_of(group, task), name, way)
    earned = TASKS[task].normalised_return(planner_tables.episodes(found, "return"))
    return earned, np.array([r["cost_safe_start"] for r in found])


def planner_reaches(task: str, least: float, most: float, seeds: int = 5) -> Callable[[], tuple[bool, str]]:
    """What plans earn that are followed as they are, in the mean of so many seeds, and what they cost."""

    def check() -> tuple[bool, str]:
        earned, cost = planned("rows", task, "icbf", "as it is")
        holds = len(cost) == seeds and earned.mean() >= least and cost.mean() <= most
        return bool(holds), f"{earned.mean():.3f} / {cost.mean():.3f}, {len(cost)} seeds"

    return check


def guidance_takes_cost() -> tuple[bool, str]:
    """On both logs, return gained and cost left by guidance, on the same runs and resets."""
    words, holds = [], True
    for task in (LEARNER, FIVE):
        guided, left = planned("rows", task, "icbf", "as it is")
        alone, cost = planned("rows", task, "icbf", "alone")
        low, high = mean_of_runs(guided - alone)
        holds = holds and low > 0 and left.mean() < 0.03 * cost.mean()
        words.append(f"{task} [{low:+.3f}, {high:+.3f}], {cost.mean():.2f} to {left.mean():.2f}")
    return bool(holds), "; ".join(words)


def mean_plan_pays() -> tuple[bool, str]:
    """What the mean plan earns more, on the pool and on one learner."""
    words, lows = [], []
    for task in (FIVE, LEARNER):
        apart = (
            planned("ablations", task, "as it is", "alone")[0]
            - planned("ablations", task, "noise around the origin", "alone")[0]
        )
        low, high = mean_of_runs(apart)
        lows.append(apart.mean())
        words.append(f"{task} {apart.mean():+.3f} [{low:+.3f}, {high:+.3f}]")
    return bool(lows[0] > 0.1 and lows[0] > 5 * lows[1]), ", ".join(words)


def shaping_costs_return() -> tuple[bool, str]:
    """Return of guided plans falls as λ rises."""
    earned = [planned("rows", LEARNER, "icbf", "as it is")[0][0].mean()]
    earned += [planned("frontier", LEARNER, f"λ = {w:g}", "as it is")[0].mean() for w in (0.3, 1.0, 3.0)]
    return bool(np.all(np.diff(earned) < 0)), ", ".join(f"{x:.3f}" for x in earned)


def printed_earns() -> tuple[bool, str]:
    """Algorithm 1 as printed on the pool at the best of its λ, and its cost at 1 beside 0 and at 10."""
    found = {w: planned("algorithm1", FIVE, f"λ = {w:g}", "as it is") for w in (0.0, 1.0, 10.0)}
    earned = {w: float(e.mean()) for w, (e, _) in found.items()}
    cost = {w: float(c.mean()) for w, (_, c) in found.items()}
    holds = earned[1.0] >= 0.95 and cost[1.0] > 0.95 * cost[0.0] and cost[10.0] < 0.6 * cost[0.0]
    holds = holds and earned[10.0] < 0.6 * earned[0.0]
    return holds, ", ".join(f"λ = {w:g}: {earned[w]:.2f} / {cost[w]:.2f}" for w in found)


CLAIMS = (
    Claim(
        "README.md",
        "earns more than the logs of one learner, and of five",
        PLANNER,
        planner_reaches(LEARNER, 1.05, 0.1),
    ),
    Claim("docs/planner-results.md", "which is what the paper prints", PLANNER, planner_reaches(FIVE, 1.1, 0.005)),
    Claim("docs/planner-results.md", "Guidance takes the cost and adds return", PLANNER, guidance_takes_cost),
    Claim("docs/planner-results.md", "The mean plan is what makes it learn a pool", PLANNER, mean_plan_pays),
    Claim("docs/planner-results.md", "The barrier in training costs return", PLANNER, shaping_costs_return),
    Claim("docs/planner-results.md", "Algorithm 1 as printed earns what print has", PLANNER, printed_earns),
    Claim("README.md", "The safety comes from the guard", SPREAD, shielded_all),
    Claim("docs/tables.md", "learned danger does what the formula does", f"guards, {ROBOTS}", same_safety),
    Claim(
        "docs/tables.md",
        "two robot limits of 18 are not kept",
        ROBOT_ROWS,
        robots_kept("bc", "default+full-learned", 16),
    ),
    Claim(
        "docs/crossing-results.md",
        "the shield leaves contact in 1 of 10,000 episodes",
        "results/crossing/table.csv",
        crossing_rare,
    ),
    Claim(
        "docs/crossing-results.md",
        "predicted step or three is as safe as ℓ along seven",
        "results/crossing-guards/table.csv",
        as_safe_by_v,
    ),
    Claim(
        "docs/stress-results.md",
        "Undelayed logs leave contact in at most 1 of 300 episodes, and earn more",
        "results/late_logs.csv",
        undelayed_logs_leave_little,
    ),
    Claim(
        "docs/crossing-results.md",
        "a return-conditioned clone earns 4.96 under the same shield",
        "results/crossing-guards/table.csv",
        told_clones_earn,
    ),
    Claim(
        "docs/crossing-results.md",
        "`full` earns a quarter more than the shield, without contact",
        "results/crossing-guards/table.csv",
        full_is_safe,
    ),
    Claim(
        "docs/crossing-results.md",
        "Whoever does not start in contact touches nobody in any size",
        "results/spread-teams/table.csv",
        no_size_touches,
    ),
    Claim(
        "docs/crossing-results.md",
        "yet a World of their logs leaves eight robots no contact",
        "results/other_simulator.csv",
        careful_logs_suffice,
    ),
    Claim("docs/ablations.md", "The World's error costs nothing", "results/ablations.csv", error_costs_nothing),
    Claim("docs/ablations.md", "V alone, without ℓ", "results/ablations.csv", by_value_alone),
    Claim("docs/ablations.md", "a guess of what others do is worth nothing", "results/ablations.csv", guess_is_worth),
    Claim("docs/frontiers.md", "safety costs next to nothing", "results/frontiers.csv", guards_price),
    Claim("docs/frontiers.md", "keeps 9 of 10 limits on Simple Spread", "results/frontiers.csv", limits_learned),
    Claim(
        "docs/crossing-results.md",
        "the shield takes hardly any return",
        "results/spread-teams/table.csv",
        no_size_loses,
    ),
    Claim("docs/guard-results.md", "takes more than half of the contact", "results/mpe2.csv", of_other_integrators),
    Claim("docs/guard-results.md", "and earns more on most", ROBOT_ROWS, full_earns_more),
    Claim("docs/guard-results.md", "One barrier for both keeps both limits", "results/constraints.csv", one_keeps_both),
    Claim("docs/guard-results.md", "and not for who never brakes", "results/yard.csv", brakes_in_time),
    Claim(
        "docs/guard-results.md", "it knows what is dangerous, not what will be", "results/yard.csv", learned_sees_more
    ),
    Claim(
        "docs/guard-results.md",
        "A shield of each agent's own leaves hardly a collision step",
        "results/own-sight/table.csv",
        own_shield_leaves(0.0035),
    ),
    Claim(
        "docs/guard-results.md",
        "keep all 18 limits under `adapt`",
        "results/own-sight-mujoco/table.csv",
        robots_kept("bc", "default+adapt-learned-decentralized", 18, "own-sight-mujoco"),
    ),
    Claim("docs/export.md", "which is no slower", "results/export.csv", exported_in_time),
    Claim("docs/ope.md", "Danger is ranked well", "results/judging.csv", ranks_like("played_danger", "true_cost", 0.8)),
    Claim(
        "docs/tables.md", "climbing from nothing earns less on six of nine data sets and more on one", ROBOT_ROWS, PRIOR
    ),
    Claim("docs/attribution.md", "On Simple Spread a shield takes the cost from every proposal", SPREAD, shielded_all),
    Claim(
        "docs/attribution.md",
        "earns less than from cloned actions on six of nine data sets and more on one",
        ROBOT_ROWS,
        PRIOR,
    ),
    Claim("docs/attribution.md", "When it may climb anywhere it earns less on eight", ROBOT_ROWS, ANYWHERE),
    Claim(
        "docs/attribution.md",
        "The return comes from climbing learned values",
        SPREAD,
        tested(("bc", f"default{FULL}"), ("bc", f"default{SHIELD}"), "return", higher),
    ),
    Claim(
        "docs/attribution.md",
        "A zero proposal (`mpc`) earns less on three",
        SPREAD,
        tested(
            ("bc", f"default{FULL}"),
            ("mpc", f"default{FULL}"),
            "return",
            lambda ds: sum(d.holds and d.mean > 0 for d in ds) == 3 and not any(d.holds and d.mean < 0 for d in ds),
        ),
    ),
    Claim(
        "docs/drivers-results.md",
        "Over five seeds `flow` earns more than the best driver did",
        POOL,
        of_a_pool(
            "flow",
            lambda row, data: len(row["seeds"]) == 5 and row["return_norm_interval"][0] > max(data["of_drivers"]),
        ),
    ),
    Claim(
        "docs/drivers-results.md",
        "a clone of the best tenth and MA-TD3+BC earn what the best driver does",
        MEDIUM_POOL,
        of_medium_pool,
    ),
    Claim(
        "docs/drivers-results.md",
        "Under `full` clones earn more than the data does",
        POOL,
        of_full_pool,
    ),
    Claim(
        "docs/drivers-results.md",
        "none of them corrected (`select`), earns more than `flow` alone on both",
        "pooled/simple_spread-{medium,random}-pooled.json",
        of_selection,
    ),
    Claim(
        "docs/drivers-results.md",
        "earns more than a clone under the same guard on eight of nine data sets and less on none",
        "results/pooled",
        of_robots_asked(pooled.BEST, 8),
    ),
    Claim(
        "docs/drivers-results.md",
        "**The first proposal alone** earns more on four of nine and less on two",
        "results/pooled",
        of_robots_asked(pooled.ASKED, 4, 2),
    ),
    Claim(
        "docs/drivers-results.md",
        "`full` from cloned actions earns more than that on most",
        f"pooled, {ROBOTS}",
        of_climbing_robots,
    ),
    Claim(
        "docs/drivers-results.md",
        "On medium and random alone none earns more than 0.33; under `full` all earn 1.2 or more",
        "pooled/simple_spread-{medium,random}-pooled.json",
        of_full_pools,
    ),
    Claim(
        "docs/drivers-results.md",
        "`flow` earns less on one of three and more on another of HalfCheetah's tiers than a clone",
        "results/pooled",
        of_robot_pools,
    ),
    Claim(
        "docs/drivers-results.md",
        "Guided by danger `flow` costs nothing from safe starts and earns no less",
        POOL,
        of_a_pool(
            "flow, 8 steps, guided by danger",
            lambda row, data: row["cost_safe_start"] == 0.0 and row["paired"]["return_norm_interval"][0] >= 0.0,
        ),
    ),
    Claim(
        "docs/drivers-results.md",
        "Under a shield none costs anything from safe starts**, and none loses 0.01 of its return",
        POOL,
        of_shielded_pool,
    ),
    Claim(
        "README.md",
        "On fourteen of sixteen systems a guarded clone violates in at most 1 % of its "
        "episodes; on four of these a naive driver does so more often",
        PROVING,
        of_systems,
    ),
    Claim(
        "docs/proving-ground.md",
        "the guard leaves contact in none of the episodes of `x9`, and in none of `x10`",
        "results/proving/others/x9.json",
        of_rebounds,
    ),
    Claim(
        "docs/proving-ground.md",
        "With more shapes no World is *unfit*, and guarded clones violate in at most 6 %, without in up to 99 %",
        "results/shapes.csv",
        of_shapes,
    ),
    Claim("docs/proving-ground.md", "Only `rays` stays bad", "results/shapes.csv", of_rays),
    Claim(
        "docs/proving-ground.md", "Read as they are, such logs make every World *unfit*", "results/on_map.csv", of_maps
    ),
    Claim(
        "docs/proving-ground.md",
        "Fourteen of sixteen guarded clones violate in at most 1 % of their episodes",
        PROVING,
        of_systems,
    ),
    Claim(
        "docs/proving-ground.md",
        "Clones guarded by *fit* Worlds never violate, naive drivers in at most 7 %",
        DRAWN,
        of_drawn_systems,
    ),
    Claim(
        "docs/proving-ground.md",
        "On twelve systems the guard leaves it at most 2 %, at nine tenths of the oracle's return; a guard that looks "
        "three steps ahead on eight",
        PROVING,
        of_bad_driving,
    ),
    Claim(
        "docs/replay-results.md",
        "The shield prevents three quarters there, beyond the logs less than half",
        CROWD,
        of_a_crowd,
    ),
    Claim(
        "docs/stress-results.md",
        "A guard that knows of late or lost steps leaves half of the contacts, or fewer",
        PEDESTRIANS,
        of_pedestrians,
    ),
    Claim(
        "docs/stress-results.md",
        "A guard that knows of up to three late steps leaves no unsafe step on the three systems",
        SYSTEMS,
        of_late_systems,
    ),
    Claim(
        "docs/guard-results.md",
        "intervals included, by learned danger and by the formula",
        ROBOT_ROWS,
        robots_kept("bc", "default+adapt-learned", 17),
    ),
    Claim(
        "docs/proving-ground.md",
        "Who is seen matters to bold drivers",
        TRACKERS,
        of_trackers,
    ),
    Claim(
        "docs/stress-results.md",
        "is kept behind every fault",
        SYSTEMS,
        of_a_robot_behind_faults,
    ),
    Claim(
        "docs/proving-ground.md",
        "With naive drivers it leaves more violations than the shield on eight of thirteen systems, fewer on three",
        PROVING,
        of_filters,
    ),
    Claim(
        "docs/stress-results.md",
        "leaves contact in 1.2 % of the episodes at most (bound 2.4 %). One that does not know leaves it in up to 94 %",
        STRESS,
        of_late_actions,
    ),
)


def main() -> None:
    lines, wrong, page = ["| claim | rests on | found |", "|---|---|---|"], 0, ""
    for claim in sorted(CLAIMS, key=lambda claim: claim.page):
        text = re.sub(r"\s+", " ", (ROOT / claim.page).read_text())
        holds, found = claim.check()
        if claim.words not in text:
            holds, found = False, "the sentence is not there"
        wrong += not holds
        print(f"{'ok   ' if holds else 'WRONG'} {claim.page}: {claim.words}: {found}")
        if claim.page != page:
            page = claim.page
            lines.append(f"| **{page}** | | |")
        file = claim.file.removeprefix("results/").removesuffix("/table.csv")
        words = textwrap.shorten(claim.words, SHOWN, placeholder=" …")
        lines.append(f"| {words} | {file} | {'' if holds else '**wrong**: '}{found} |")
    put("docs/claims.md", "claims", "\n".join(lines))
    sys.exit(f"{wrong} claims do not hold" if wrong else 0)


if __name__ == "__main__":
    main()
