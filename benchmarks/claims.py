"""What the documents claim: sentences by page, each with the check behind it, which names the file it rests on and says
what it found. Fails when one does not hold, or when its words are no longer there.

    python benchmarks/claims.py
"""

from __future__ import annotations

import re
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import planner_tables
import pooled
from ablations import adjusted
from common import RESULTS, ROOT, of_json, read
from evidence import LEVEL, difference, evaluations, mean, of, proven, tasks_of, variant
from guards_tables import ADAPT, ANYWHERE, FROM_NOTHING, FULL, SHIELD, answers
from scipy.stats import fisher_exact, spearmanr

from ringfence.datasets.registry import TASKS
from ringfence.evaluation.statistics import mean_of_runs
from ringfence.report import board

Check = Callable[[], tuple[bool, str]]  # whether it holds, and what was found
LEARNER, FIVE = "simple_spread-expert", "simple_spread-expert-pooled"  # one learner's logs, five learners'
POOL, MEDIUM, RANDOM = (f"pooled/simple_spread-{tier}-pooled.json" for tier in ("expert", "medium", "random"))
BOTH_POOLS = "pooled/simple_spread-{medium,random}-pooled.json"
ROBOTS = "guards-mujoco"
BARRIERS = ("learned", "analytic")


def on(file: str) -> Callable[[Check], Check]:
    """The file of `results/` that a check rests on."""

    def mark(check: Check) -> Check:
        check.__dict__["file"] = file
        return check

    return mark


def rows_of(file: str, **where: str) -> list[dict[str, str]]:
    """Rows of a table with these entries."""
    return [r for r in read(file) if all(r[k] == v for k, v in where.items())]


def told(sides: Iterable[list[str]]) -> str:
    """On what a row has more, and on what less; of many, how many."""
    named = [", ".join(side) if 0 < len(side) < 4 else len(side) or "none" for side in sides]
    return f"more on {named[0]}, less on {named[1]}"


def violated(row: dict[str, str]) -> list[int]:
    """Episodes with a violation, and without."""
    count = round(float(row["violated"]) * int(row["episodes"]))
    return [count, int(row["episodes"]) - count]


def fewer(some: dict[str, str], others: dict[str, str]) -> float:
    """Fisher's exact p that some violate in no fewer episodes than others."""
    return fisher_exact(np.c_[violated(some), violated(others)], "less").pvalue


# Suites of results, by evidence.py and guards_tables.py.


def asked(suite: str, row, paired, key: str = "return") -> list:
    """A row less its paired baseline on every task, adjusted with all other questions of the suite."""
    return next(ds for q, k, ds in answers(suite) if (q.row, q.paired, k) == (row, paired, key))


def climbs(paired, verdict: Callable[[list], bool]) -> Check:
    """`verdict` of the return that cloning under `full` has more than another row on all tiers."""

    @on("guards")
    def check():
        found = asked("guards", ("bc", f"default{FULL}"), paired)
        differences = ", ".join(f"{d.mean:+.3g}{'' if d.holds else ' (chance)'}" for d in found)
        return len(found) == 4 and verdict(found), f"return {differences}"

    return check


def on_robots(row: str, paired, more: int, less: int, tasks: int = 18, key: str = "return") -> Check:
    """On how many data sets a guarded clone has more and less than another row, beyond chance."""

    @on(ROBOTS)
    def check():
        found = asked(ROBOTS, ("bc", f"default{row}"), paired, key)
        sides = [[f"{d.task} {d.mean:+.3g}" for d in found if d.holds and d.mean * sign > 0] for sign in (1, -1)]
        seeds = {len(d.seeds) for d in found}
        return (len(found), *map(len, sides)) == (tasks, more, less), f"{told(sides)}; {min(seeds)} seeds at least"

    return check


FORMULA = ("bc", "default+adapt-analytic")
CLIMBS_FROM_NOTHING = on_robots(FULL, FROM_NOTHING, 6, 1, 9)
CLIMBS_ANYWHERE = on_robots(FULL, ANYWHERE, 8, 0, 9)
FULL_EARNS = on_robots(FULL, ("bc", f"default{ADAPT}"), 9, 0)


@on(ROBOTS)
def learned_costs() -> tuple[bool, str]:
    """Danger learned and by the formula, under `adapt`: return lost on two, cost raised on two."""
    each = [on_robots(ADAPT, FORMULA, 0, 2)(), on_robots(ADAPT, FORMULA, 2, 4, key="cost")()]
    return all(holds for holds, _ in each), "; ".join(words for _, words in each)


def higher(found: list) -> bool:
    return all(d.holds and d.mean > 0 for d in found)


def higher_on_three(found: list) -> bool:
    return sum(d.holds and d.mean > 0 for d in found) == 3 and not any(d.holds and d.mean < 0 for d in found)


CLIMBING_EARNS = climbs(("bc", f"default{SHIELD}"), higher)
CLONING_EARNS = climbs(FROM_NOTHING, higher_on_three)


@on("guards")
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


def limits(suite: str, algorithm: str, variant: str) -> int:
    """Tasks on which the upper end of the cost's interval is within the limit."""
    shown = board.read(RESULTS / suite).lines.values()
    wanted = (algorithm, variant)
    return sum(r.safe for rows in shown for r in rows if (r.method.algorithm, r.method.variant) == wanted)


def robots_kept(variant: str, wanted: int, suite: str = ROBOTS) -> Check:
    @on(suite)
    def check():
        kept = limits(suite, "bc", variant)
        return kept == wanted, f"{kept} of {len(tasks_of(suite))}"

    return check


def clone_earns(task: str, guard: str) -> float:
    """A clone's return on a robot under a guard of learned danger, over all seeds."""
    return mean(ROBOTS, task, variant(task, ("bc", f"default+{guard}-learned")), "return_mean")


@on("mujoco")
def fisor_keeps() -> tuple[bool, str]:
    """Limits that FISOR keeps without a guard, and its share of what `adapt` leaves a clone, over all tasks."""
    tasks = tasks_of(ROBOTS)
    earned = np.mean([mean("mujoco", t, variant(t, ("fisor", "default")), "return_norm") for t in tasks])
    guarded = np.mean([mean(ROBOTS, t, variant(t, ("bc", "default+adapt-learned")), "return_norm") for t in tasks])
    kept = limits("mujoco", "fisor", "default")
    return kept == 16 and earned < 0.5 * guarded, f"{kept} of {len(tasks)}; {earned:.2f} for {guarded:.2f}"


@on(ROBOTS)
def safety_costs() -> tuple[bool, str]:
    """Normalised return of a clone of the fast HalfCheetah, alone and under `adapt`."""
    task = "halfcheetah_2x3-good"
    ways = ("default", "default+adapt-learned")
    alone, guarded = (mean(ROBOTS, task, variant(task, ("bc", way)), "return_norm") for way in ways)
    return (round(alone, 2), round(guarded, 2)) == (0.87, 0.29), f"{alone:.3f} and {guarded:.3f}"


@on("mujoco")
def standing_earns() -> tuple[bool, str]:
    """Doing nothing beside every method without a guard, on the poor Ant."""
    task = "ant_2x4-poor"
    rows = {
        key[1:]: mean("mujoco", *key[:1], key[1:], "return_mean") for key in evaluations("mujoco") if key[0] == task
    }
    still = rows.pop(("do-nothing", "reference"))
    return still > max(rows.values()), f"{still:.0f}, others at most {max(rows.values()):.0f}"


@on("own-sight")
def own_shield_leaves_little() -> tuple[bool, str]:
    row = ("bc", "default+shield-learned-decentralized")
    left = max(mean("own-sight", task, row, "cost_safe_start") for task in tasks_of("own-sight"))
    return left <= 0.0035, f"at most {left:.3f} on four tiers"


# Crossing, and teams of other sizes.
IN_CROSSING = ("crossing-guards", "crossing-hasty")
SHIELDED = f"default{SHIELD}"


@on("crossing")
def crossing_rare() -> tuple[bool, str]:
    """Contact under the shield, on all tiers of Crossing."""
    tiers = [f"crossing{body}-{tier}" for body in ("", "_unicycle") for tier in ("hasty", "mixed", "careful", "random")]
    runs = [r for tier in tiers for r in of("crossing", tier, ("bc", SHIELDED)).values()]
    touched = sum(round(r["violation_rate"] * r["episodes"]) for r in runs)
    episodes = sum(r["episodes"] for r in runs)
    return (touched, episodes) == (1, 10_000), f"{touched} of {episodes} episodes, one seed; three of hasty unicycles"


@on("crossing-guards")
def as_safe_by_v() -> tuple[bool, str]:
    """ℓ alone touches along one row, and neither V with it, nor with three, nor ℓ along seven does."""
    ways = (*(f"+horizon{k}+terminal_valueFalse" for k in (1, 3, 7)), "+horizon1", "")
    shares = [mean(*IN_CROSSING, ("bc", SHIELDED + more), "violation_rate") for more in ways]
    text = ", ".join(f"{100 * s:.3g} %" for s in shares)
    held = shares[0] > 0.1 and 0 < shares[1] < 0.03 and max(shares[2:]) == 0
    return held, f"ℓ with 1, 3, 7 rows, V with 1, 3: {text} of episodes"


@on("crossing-guards")
def told_clones_earn() -> tuple[bool, str]:
    """More than plain cloning and than the certificates on the same resets, and without contact."""
    rows = (("bc", SHIELDED), ("certificates", "reference"))
    better = [difference(*IN_CROSSING, ("bc-return", SHIELDED), paired, "return") for paired in rows]
    touched = mean(*IN_CROSSING, ("bc-return", SHIELDED), "violation_rate")
    text = ", ".join(f"{d.mean:+.2f} ({d.low:+.2f} to {d.high:+.2f})" for d in better)
    return touched == 0 and all(d.low > 0 for d in better), f"{text} than cloning and than certificates; contact in 0 %"


@on("crossing-guards")
def full_is_safe() -> tuple[bool, str]:
    """No contact, and by how much more than the shield alone."""
    row, shield = ("bc", f"default{FULL}"), ("bc", SHIELDED)
    more = difference(*IN_CROSSING, row, shield, "return")
    share = more.mean / mean(*IN_CROSSING, shield, "return_mean")
    touched = mean(*IN_CROSSING, row, "violation_rate")
    text = f"contact in {100 * touched:g} %, {100 * share:.0f} % more"
    return touched == 0 and 0.23 < share < 0.27 and more.low > 0, text


@on("spread-teams")
def no_size_touches() -> tuple[bool, str]:
    """Under a shield and `full`, in teams of two, three, four and six, by every seed."""
    left = [float(r["cost_safe_start"]) for r in rows_of("spread-teams/table.csv", barrier="learned")]
    return max(left) == 0 and len(left) >= 24, f"{len(left)} rows, at most {max(left):g} steps"


@on("spread-teams")
def no_size_loses() -> tuple[bool, str]:
    """The shield's mean return beside the clone's, of the same teams."""
    rows = defaultdict(list)
    for r in rows_of("spread-teams/table.csv", algorithm="bc"):
        rows[r["task"], r["agents"], r["guard"]].append(float(r["return_mean"]))
    teams = [(task, n) for task, n, guard in rows if guard == "shield"]
    more = [100 * (np.mean(rows[*team, "shield"]) / np.mean(rows[*team, "none"]) - 1) for team in teams]
    return len(more) == 8 and min(more) > -1, f"{min(more):+.1f} to {max(more):+.1f} %, of {len(more)} teams"


@on("other_simulator.csv")
def careful_logs_suffice() -> tuple[bool, str]:
    """Logs with contact in one episode of twenty teach a World that leaves hardly any; of naive drivers, none."""
    words = ("logs of IR-SIM", "logs of IR-SIM, two of eight naive")
    each = (rows_of("other_simulator.csv", guard="shield", **{"learned from": w}) for w in words)
    few, many = ([float(r["episodes with contact"]) for r in rows] for rows in each)
    text = " / ".join(f"{100 * x:.3g} %" for x in (*few, *many))
    return few[0] == 0 and max(few) < 0.05 and max(many) == 0, f"8 and 16 robots, both logs: {text} of episodes"


@on("mpe2.csv")
def of_other_integrators() -> tuple[bool, str]:
    """Clones' steps with contact where things move by other rules than the World's logs, and of logs recorded there."""
    rows = {(r["policy"], r["place"], r["guard"]): r for r in read("mpe2.csv") if "icbf" not in r["policy"]}
    places = {key[:2] for key in rows if key[1] != "ours, the data's rules"}
    left = {key: float(rows[*key, "shield"]["cost"]) / float(rows[*key, "none"]["cost"]) for key in places}
    own = next(key for key in left if "recorded" in key[0])
    kept = float(rows[*own, "shield"]["return"]) >= float(rows[*own, "none"]["return"])
    least, most = min(left.values()), max(left.values())
    return most < 0.5 and left[own] == least and kept, f"{100 * least:.0f} to {100 * most:.0f} % of the contact is left"


# Systems of the proving ground, and small ones.


def of_proving() -> dict[str, dict[str, Any]]:
    return {one["task"].removeprefix("proving-"): one for one in proven()}


@on("results/proving")
def of_systems() -> tuple[bool, str]:
    """Episodes on the proving ground: the clone's by the seed that violates most, the naive driver's in the mean."""
    found = of_proving()
    rows = {name: one["rows"] for name, one in found.items()}
    clone = {name: r["bc shield learned"]["most"] for name, r in rows.items()}
    kept = {n: r["bc shield learned"]["return_mean"] / r["bc shield oracle"]["return_mean"] for n, r in rows.items()}
    fine = [name for name in rows if clone[name] <= 0.01 and kept[name] >= 0.9]
    refused = [name for name, one in found.items() if "unfit" in one["verdicts"]]
    most = max(clone[name] for name in fine)
    more = [name for name in fine if rows[name]["naive shield learned"]["violation_rate"] > 0.01]
    holds = len(rows) == 16 and most <= 0.01 and len(fine) == 14 and len(more) == 4 and refused == ["arms", "train"]
    return holds, f"{most:.3f} at most on {len(fine)}, at nine tenths of the return; naive more on {', '.join(more)}"


@on("results/proving/again")
def of_again() -> tuple[bool, str]:
    """Systems that were played by Worlds of today, of three seeds: whom they leave in more than one episode of 60."""
    found = {one["task"].removeprefix("proving-"): one for one in proven("proving/again")}
    rates = {
        who: {name: one["rows"][f"{who} shield learned"]["most"] for name, one in found.items()}
        for who in ("bc", "naive")
    }
    fit, refused = ([n for n, one in found.items() if one["verdicts"] == [word] * 3] for word in ("fit", "unfit"))
    left = {name: rates["naive"][name] for name in fit if rates["naive"][name] > 1.5 / 60}
    text = f"{len(fit)} of {len(found)} fit; clones {max(rates['bc'][n] for n in fit):.3f} at most; naive {left}"
    holds = (len(found), len(fit), refused) == (16, 14, ["arms", "train"]) and sorted(left) == ["bench", "gears"]
    return holds and not any(rates["bc"][name] for name in fit), text


@on("results/proving")
def of_bad_driving() -> tuple[bool, str]:
    """Systems on which the guard leaves the naive driver at most 2 %, as it is and by three rows."""
    rows = [one["rows"] for one in proven()]
    kept = [r["naive shield learned"]["return_mean"] / r["naive shield oracle"]["return_mean"] for r in rows]
    far = [r["naive shield learned"]["violation_rate"] <= 0.02 and share >= 0.9 for r, share in zip(rows, kept)]
    near = [r["naive shield learned, 3 rows"]["violation_rate"] <= 0.02 for r in rows]
    return (sum(far), sum(near)) == (12, 8), f"{sum(far)} of {len(rows)}, by three rows {sum(near)}"


@on("results/proving")
def of_fit_worlds() -> tuple[bool, str]:
    """Naive drivers under guards of Worlds that call themselves fit by every seed: where more than 1 % violate."""
    rows = {
        name: one["rows"]["naive shield learned"] for name, one in of_proving().items() if {*one["verdicts"]} == {"fit"}
    }
    more = {name: row["most"] for name, row in rows.items() if row["violation_rate"] > 0.01}
    text = ", ".join(f"{name} {most:.2f}" for name, most in more.items())
    return sorted(more) == ["bench", "convoy", "flock", "gears"] and round(max(more.values()), 2) == 0.35, text


@on("results/proving/others")
def of_ten_more() -> tuple[bool, str]:
    """Clones under the shield that never violate."""
    left = {
        one["task"]: one["rows"]["bc shield learned"]["violation_rate"] for one in proven("proving/others", "*.json")
    }
    return (len(left), sum(x == 0 for x in left.values())) == (10, 9), f"{max(left.values()):.2f} at most"


@on("results/proving")
def of_filters() -> tuple[bool, str]:
    """Naive drivers under the shield that learned, and under the classical filter, where there is one."""
    rows = {name: one["rows"] for name, one in of_proving().items() if "naive cbf-qp" in one["rows"]}
    both = {n: [r[f"naive {how}"]["violation_rate"] for how in ("shield learned", "cbf-qp")] for n, r in rows.items()}
    less, more = (sorted(n for n, (mine, theirs) in both.items() if sign * (mine - theirs) > 0) for sign in (-1, 1))
    return (len(less), more) == (8, ["arms", "bench", "train"]), f"fewer on {len(less)}, more on {more}"


@on("results/proving/drawn")
def of_drawn_systems() -> tuple[bool, str]:
    """Guards by the Worlds of systems drawn at random that call themselves fit."""
    found = [of_json(file) for file in sorted((RESULTS / "proving" / "drawn").glob("*.json"))]
    rows = [one["rows"] for one in found if one["verdict"] == "fit"]
    clone, naive = (max(r[f"{who} shield learned"]["violation_rate"] for r in rows) for who in ("bc", "naive"))
    return clone == 0 and naive <= 0.07, f"{100 * clone:.0f} and {100 * naive:.1f} % at most, of {len(rows)}"


@on("proving/others/x9.json")
def of_rebounds() -> tuple[bool, str]:
    """Guards of a system whose bodies bounce off what they touch, and the same by states as they were logged."""
    kinds = (of_json(f"proving/{name}.json")["rows"] for name in ("others/x9", "tried/x9-as-logged", "others/x10"))
    now, before, leaning = ([r[f"{who} shield learned"]["violation_rate"] for who in ("bc", "naive")] for r in kinds)
    text = f"clone and naive {now}, as logged {before}; `x10` {leaning}"
    return now == leaning == [0, 0] and min(before) > 0.9, text


MORE, LESS = "more shapes", "no more shapes"
FAMILIES = "21 of 27 fit; {'clone': 20, 'naive': 20}, at most 4 and 9 of 60"


@on("shapes.csv")
def of_shapes() -> tuple[bool, str]:
    """Episodes with a violation of guarded clones by causes of more shapes, and without (Fisher's exact test)."""
    each = [r for r in rows_of("shapes.csv", guard="shield", driver="clone") if r["system"] != "rays"]
    rows = {(r["system"], r["seed"], r["causes"]): r for r in each}
    logs = {key[:2]: (rows[key], rows[*key[:2], LESS]) for key in rows if key[2] == MORE}
    clearly = {name for (name, _), both in logs.items() if fewer(*both) < LEVEL}
    words = [f"{' '.join(key)} {violated(plain)[0]} → {violated(more)[0]}" for key, (more, plain) in logs.items()]
    most = [max(violated(both[k])[0] for both in logs.values()) for k in (0, 1)]
    unfit = any(more["verdict"] == "unfit" for more, _ in logs.values())
    return not unfit and most == [6, 99] and len(logs) == 16 and len(clearly) == 11, f"of 100: {', '.join(words)}"


@on("shapes.csv")
def of_rays() -> tuple[bool, str]:
    """Return and episodes with a violation of guarded drivers, by rays that are one cause, and by eight causes."""
    rows = {(r["causes"], r["driver"]): r for r in rows_of("shapes.csv", guard="shield", system="rays")}
    both = {which: [rows[which, driver] for driver in ("naive", "clone")] for which in (MORE, LESS)}
    bad = {which: [violated(r)[0] for r in each] for which, each in both.items()}
    earned = {which: [float(r["return"]) for r in each] for which, each in both.items()}
    holds = {r["verdict"] for r in both[MORE]} == {"fit"} and min(bad[MORE]) > 20 and max(bad[LESS]) <= 10
    return holds and max(earned[LESS]) < 0 < min(earned[MORE]), f"violated {bad}, return {earned}"


@on("families.csv")
def of_families() -> tuple[bool, str]:
    """Verdicts, and episodes of 60 with a violation under the shield, of what was played of nine families."""
    rows = {(r["system"], r["driver"]): r for r in rows_of("families.csv", guard="shield", causes="rules")}
    names = sorted({name for name, _ in rows})
    fit = [name for name in names if rows[name, "clone"]["verdict"] == "fit"]
    left = {driver: [violated(rows[name, driver])[0] for name in fit] for driver in ("clone", "naive")}
    few = {driver: sum(bad <= 2 for bad in each) for driver, each in left.items()}
    told = f"{len(fit)} of {len(names)} fit; {few}, at most {max(left['clone'])} and {max(left['naive'])} of 60"
    return told == FAMILIES, told


@on("on_map.csv")
def of_maps() -> tuple[bool, str]:
    """Episodes with a violation of guarded drivers by logs of places, read as distances and as they are."""
    rows = {(r["system"], r["guard"], r["causes"]): r for r in rows_of("on_map.csv", driver="clone")}
    ways = (("shield", "how far away"), ("shield", "places as they are"), ("none", "how far away"))
    near, far, alone = ({key[0]: r for key, r in rows.items() if key[1:] == way} for way in ways)
    holds = {r["verdict"] for r in near.values()} == {"fit"} and {r["verdict"] for r in far.values()} == {"unfit"}
    left = {name: violated(r)[0] for name, r in near.items()}
    holds &= max(left.values()) == 4 and len(left) == 7
    chance = min(fewer(far[name], alone[name]) for name in near) > LEVEL  # no fewer beyond it
    return holds and chance, f"{left} of 100, as they are {[violated(r)[0] for r in far.values()]}"


@on("proving/trackers.json")
def of_trackers() -> tuple[bool, str]:
    """Violations of a naive driver under guard, by what dynamics know of lists."""
    rows = of_json("proving/trackers.json")
    naive = {name: row["naive, shield"]["violation_rate"] for name, row in rows.items()}
    clones = max(row["clone, shield"]["violation_rate"] for row in rows.values())
    falls = naive["as it is"] < 0.3 * naive["not who is seen"] < 0.3 * naive["nor what is an angle"]
    return falls and clones == 0, f"{naive}, clones {clones} at most"


# Faults.


@on("stress/crossing.csv")
def of_late_actions() -> tuple[bool, str]:
    """Episodes with contact of a guard that knows of late actions, and of one that does not."""
    rows = {(r["faults"], r["compensated"]): r for r in rows_of("stress/crossing.csv", guard="shield")}
    known, unknown = ([float(rows[f"delay{k}", c]["violation_rate"]) for k in (1, 2, 3)] for c in ("True", "False"))
    holds = all(a < 0.1 * b for a, b in zip(known, unknown)) and max(known) <= 0.02 and 0.93 <= max(unknown) < 0.95
    return holds, f"{known} of {unknown}"


@on("stress/systems.csv")
def of_late_systems() -> tuple[bool, str]:
    """Unsafe steps behind late actions, of a guard that knows of them."""
    rows = rows_of("stress/systems.csv", guard="shield, compensated")
    known = [float(r["cost"]) for r in rows if re.fullmatch(r"delay\d", r["faults"])]
    return len(known) == 9 and max(known) == 0, f"{max(known):.2f} at most, of {len(known)}"


@on("stress/systems.csv")
def of_a_robot_behind_faults() -> tuple[bool, str]:
    """Unsafe steps of a guarded robot behind faults."""
    costs = [float(r["cost"]) for r in read("stress/systems.csv") if r["guard"].startswith("adapt")]
    return len(costs) > 20 and max(costs) <= 25, f"{max(costs):.1f} at most, of {len(costs)}"


@on("stress/pedestrians.csv")
def of_pedestrians() -> tuple[bool, str]:
    """Contacts of pedestrians that a guard leaves which knows of late or lost steps, of those of one that does not."""
    left: Counter = Counter()
    for r in read("stress/pedestrians.csv"):
        left[r["faults"], r["guard"]] += int(r["contacts"])
    names = {faults for faults, _ in left if re.fullmatch(r"(delay|drop)[\d.]+", faults)}
    shares = [left[name, "shield, compensated"] / left[name, "shield"] for name in names]
    return len(shares) == 6 and max(shares) <= 0.5, f"{max(shares):.2f} at most, of {len(shares)}"


@on("late_logs.csv")
def undelayed_logs_leave_little() -> tuple[bool, str]:
    """Episodes with contact and return under shields by Worlds of late logs, as they are and undelayed."""
    rows = {(int(r["late"]), r["world"][:12], r["delay"]): r for r in read("late_logs.csv")}
    text, holds = [], True
    for late in (1, 2, 3):
        ways = (("of undelayed", str(late)), ("of the logs ", "0"), ("of the logs ", str(late)))
        left = [float(rows[late, *way]["contact"]) for way in ways]
        mended, raw = (float(rows[late, *way]["return"]) for way in ways[:2])
        holds &= left[0] <= 1 / 300 + 1e-4 and left[0] <= left[1] <= left[2] and mended > raw
        text.append(f"{late} late: {', '.join(f'{100 * share:.2g} %' for share in left)}")
    return holds, "; ".join(text)


@on("replay/students03.json")
def of_a_crowd() -> tuple[bool, str]:
    """Of the contacts that five drivers make among filmed pedestrians: within the logs, and beyond."""
    found, shares = of_json("replay/students03.json"), []
    for where in ("rows", "beyond the logs"):
        shield = [row for row in found[where] if row["filter"] == "shield"]
        shares.append(sum(row["prevented"] for row in shield) / sum(row["alone"] for row in shield))
    return 0.72 < shares[0] < 0.78 and shares[1] < 0.5, f"{100 * shares[0]:.0f} and {100 * shares[1]:.0f} %"


# Logs of many drivers.


def of_a_pool(row: str, verdict: Callable[[dict, dict], bool]) -> Check:
    """`verdict` of a row of the pool of experts and of the data."""

    @on(POOL)
    def check():
        found = of_json(POOL)
        r, data = found["rows"][row], found["data"]
        low, high = r["return_norm_interval"]
        text = f"{r['return_norm']:.3f} [{low:.3f}, {high:.3f}], data {data['return_norm']:.3f}"
        return verdict(r, data), text + f", its best driver {max(data['of_drivers']):.3f}"

    return check


def beats_the_logs(row: dict, data: dict) -> bool:
    return len(row["seeds"]) == 5 and row["return_norm_interval"][0] > data["return_norm"]


def safe_and_no_less(row: dict, data: dict) -> bool:
    return row["cost_safe_start"] == 0.0 and row["paired"]["return_norm_interval"][0] >= 0.0


FLOW_POOL = of_a_pool("flow", beats_the_logs)
GUIDED_POOL = of_a_pool("flow, 8 steps, guided by danger", safe_and_no_less)


@on(POOL)
def of_shielded_pool() -> tuple[bool, str]:
    """Generators of the pool of experts under a shield, and the same without."""
    rows = of_json(POOL)["rows"]
    pairs = [(rows[n], rows[f"{n}, under shield"]) for n in rows if f"{n}, under shield" in rows]
    cost = max(shield["cost_safe_start"] for _, shield in pairs)
    more = [shield["return_norm"] - alone["return_norm"] for alone, shield in pairs]
    text = f"cost {cost:.3f} at most; return {min(more):+.3f} to {max(more):+.3f}, of {len(more)}"
    return cost < 0.005 and min(more) > -0.01, text


@on(MEDIUM)
def of_medium_pool() -> tuple[bool, str]:
    """What learns the pool of medium drivers beside the best of these."""
    found = of_json(MEDIUM)
    best, rows = max(found["data"]["of_drivers"]), {name: found["rows"][name] for name in ("bc-best", "ma-td3bc")}
    text = ", ".join(f"{name} {r['return_norm']:.3f} {r['return_norm_interval']}" for name, r in rows.items())
    within = all(r["return_norm_interval"][0] <= best <= r["return_norm_interval"][1] for r in rows.values())
    return within, f"the best driver {best:.3f}; {text}"


def under_full(file: str) -> dict[str, dict]:
    """Rows of a pool under `full`."""
    ending = ", under full"
    return {n.removesuffix(ending): r for n, r in of_json(file)["rows"].items() if n.endswith(ending)}


@on(POOL)
def of_full_pool() -> tuple[bool, str]:
    """Clones of the pool of experts under `full`."""
    rows = {name: r for name, r in under_full(POOL).items() if name.startswith("bc")}
    least = min(r["return_norm_interval"][0] for r in rows.values())
    seeds = {len(rows[name]["seeds"]) for name in ("bc, 20,000 updates", "bc-best")}
    holds = least > of_json(POOL)["data"]["return_norm"] and seeds == {5}
    return holds, ", ".join(f"{name} {r['return_norm']:.2f}" for name, r in rows.items())


@on(BOTH_POOLS)
def of_full_pools() -> tuple[bool, str]:
    """Whoever proposes under `full` on the pools without experts, beside what generators earn alone."""
    least = min(r["return_norm"] for file in (MEDIUM, RANDOM) for r in under_full(file).values())
    rows = [r for file in (MEDIUM, RANDOM) for r in of_json(file)["rows"].values()]
    most = max(r["return_norm"] for r in rows if "guard" not in r["played"])
    return least > 1.2 and most < 0.34, f"full {least:.2f} at least, alone {most:.2f} at most"


@on("results/pooled")
def of_robot_pools() -> tuple[bool, str]:
    """What `flow` earns more than a clone on HalfCheetah's tiers, on the same resets."""
    more = {}
    for tier in ("good", "medium", "poor"):
        rows = of_json(f"pooled/halfcheetah_2x3-{tier}.json")["rows"]
        more[tier] = pooled.more(rows["flow"], rows["bc, 20,000 updates"])[1]
    text = ", ".join(f"{tier} [{low:.0f}, {high:.0f}]" for tier, (low, high) in more.items())
    return sorted((low > 0) - (high < 0) for low, high in more.values()) == [-1, 0, 1], text


def of_robots_asked(who: str, wins: int, losses: int = 0) -> Check:
    """What `flow` under `adapt` earns more than a clone under it, on the same resets of every robot's data."""

    @on("results/pooled")
    def check():
        rows = {r["task"]: r["rows"] for r in pooled.kept(robots=True)}
        apart = {task: pooled.more(r[who], r[pooled.CLONE])[1] for task, r in rows.items()}
        cost = max(r[who]["cost_mean"] for r in rows.values())
        said = {task: f"{task} [{low:.0f}, {high:.0f}]" for task, (low, high) in apart.items()}
        sides = [said[t] for t, (low, _) in apart.items() if low > 0], [said[t] for t, (_, x) in apart.items() if x < 0]
        holds = (*map(len, sides),) == (wins, losses) and cost <= 25
        return holds, f"{told(sides)} of {len(apart)}; {cost:.0f} steps above the limit at most"

    return check


BEST_OF_EIGHT = of_robots_asked(pooled.BEST, 8)
FIRST_ALONE = of_robots_asked(pooled.ASKED, 4, 2)


@on(f"pooled, {ROBOTS}")
def of_climbing_robots() -> tuple[bool, str]:
    """Clones under `full` beside the best of eight proposals, on robots."""
    rows = {found["task"]: found["rows"][pooled.BEST]["return_mean"] for found in pooled.kept(robots=True)}
    more = {task: clone_earns(task, "full") - best for task, best in rows.items()}
    sides = [[f"{name} {x:+.0f}" for name, x in more.items() if x * sign > 0] for sign in (1, -1)]
    return sum(x > 0 for x in more.values()) > len(more) / 2, f"{told(sides)} of {len(more)}"


# Choices of a guard.


@on("constraints.csv")
def one_keeps_both() -> tuple[bool, str]:
    """No contact and no step too fast by one barrier for both or by one each, whose return lies below the first's."""
    ways = (("none", ""), ("shield", "one"), ("shield", "each"))
    none, one, each = (rows_of("constraints.csv", guard=g, barriers=b)[0] for g, b in ways)
    contact = [float(r["contact"]) for r in (none, one, each)]
    kept = contact[0] > 0 and all(float(r[key]) == 0 for r in (one, each) for key in ("contact", "fast"))
    lost = float(one["return"]) - float(each["return"])
    shares = " / ".join(f"{100 * c:.1f} %" for c in contact)
    text = f"{shares} without a guard, with one, with each; {lost:.2f} of return"
    return kept and float(each["return_high"]) < float(one["return_low"]), text


def in_the_yard(who: str, barrier: str, how: str = "") -> dict[str, str]:
    return rows_of("yard.csv", method=who, guard="shield", barrier=barrier, options=how)[0]


@on("yard.csv")
def brakes_in_time() -> tuple[bool, str]:
    """Of the clone three rows leave next to nothing; of the naive controller they leave most, and V nothing."""
    ways = (("BC", "terminal_value=False"), ("naive controller", "terminal_value=False"), ("naive controller", ""))
    clone, naive, seen = (float(in_the_yard(who, "learned", how)["contact"]) for who, how in ways)
    text = (
        f"3 rows: {100 * clone:.2g} % of the clone's episodes, {100 * naive:.3g} % of the naive; V: {100 * seen:.2g} %"
    )
    return clone <= 0.005 and naive > 0.5 and seen <= 0.01, text


@on("yard.csv")
def learned_sees_more() -> tuple[bool, str]:
    """Under the same three rows the formula's interval lies above V's bound."""
    learned, formula = (in_the_yard("naive controller", barrier) for barrier in BARRIERS)
    shares = [float(r["contact"]) for r in (learned, formula)]
    return shares[1] > 0.6 and float(learned["bound"]) < 0.02, f"{100 * shares[0]:.2g} % and {100 * shares[1]:.3g} %"


@on("frontiers.csv")
def limits_learned() -> tuple[bool, str]:
    """How many of five limits the Lagrangian learner keeps on each task."""
    kept = Counter()
    for r in rows_of("frontiers.csv", method="MA-TD3+BC, Lagrange"):
        kept[r["task"]] += float(r["cost"]) <= float(r["value"])
    spread = sum(n for task, n in kept.items() if task.startswith("simple_spread"))
    del kept["crossing-hasty"]  # where a limit is of each agent's cost, and the row is of the team's
    return (spread, kept["halfcheetah_2x3-good"]) == (9, 0), ", ".join(f"{task} {n} of 5" for task, n in kept.items())


@on("frontiers.csv")
def guards_price() -> tuple[bool, str]:
    """Return of guarded cloning at the calibrated margin over that at the loosest, where there is no time to adapt."""
    shares = {}
    for task in ("simple_spread-expert", "simple_spread-medium-replay", "crossing-hasty"):
        of = {r["value"]: r for r in rows_of("frontiers.csv", task=task, method="BC, guarded")}
        shares[task] = float(of["1.0"]["return"]) / float(of["-1.0"]["return"]), float(of["1.0"]["cost"])
    text = ", ".join(f"{task} {100 * share:.1f} % at {cost:g}" for task, (share, cost) in shares.items())
    return all(share > 0.99 and cost <= 0.005 for share, cost in shares.values()), text


def reaches_nothing(rows: list[dict[str, str]]) -> bool:
    """Whether all intervals of return and of cost hold 0."""
    return all(float(r[f"more_{k}_low"]) <= 0 <= float(r[f"more_{k}_high"]) for r in rows for k in ("return", "cost"))


@on("ablations.csv")
def error_costs_nothing() -> tuple[bool, str]:
    """The simulator itself as the World's dynamics: intervals of return and cost reach 0 under shield and `full`."""
    rows = rows_of("ablations.csv", way="the true dynamics")
    said = (f"{r['guard']} {r['more_return']} ({r['more_return_low']} to {r['more_return_high']})" for r in rows)
    return len(rows) == 2 and reaches_nothing(rows), f"return {'; '.join(said)}"


@on("ablations.csv")
def by_value_alone() -> tuple[bool, str]:
    """V in the place of ℓ: as safe on Crossing and Simple Spread, less return there and on the robot, at more cost."""
    rows = {r["task"]: r for r in adjusted(read("ablations.csv")) if r["way"] == "by V alone"}
    crossing, spread, robot = (rows[n] for n in ("crossing-hasty", "simple_spread-expert", "halfcheetah_2x3-medium"))
    text = "; ".join(f"{name}: return {r['more_return']}, cost {r['more_cost']}" for name, r in rows.items())
    safe = float(crossing["cost"]) == 0 and float(spread["more_cost"]) == 0
    worse = all(r["holm_return"] < LEVEL and float(r["more_return_high"]) < 0 for r in (spread, robot))
    return safe and worse and robot["holm_cost"] < LEVEL and float(robot["more_cost_low"]) > 0, text


@on("ablations.csv")
def guess_is_worth() -> tuple[bool, str]:
    """Own sight without its guess earns as much and costs as much, beyond chance."""
    rows = [r for r in adjusted(read("ablations.csv")) if r["way"] == "foreseen by the own action alone"]
    text = ", ".join(f"{r['more_return']} (Holm p {r['holm_return']:.2g})" for r in rows)
    return len(rows) == 3 and reaches_nothing(rows), text


@on("export.csv")
def exported_in_time() -> tuple[bool, str]:
    slower = [float(r["stablehlo_ms"]) / float(r["controller_ms"]) for r in read("export.csv")]
    return max(slower) <= 1.0, f"{min(slower):.2f} to {max(slower):.2f} of the controller's time"


@on("judging.csv")
def danger_is_ranked() -> tuple[bool, str]:
    """Spearman's correlation on every task whose policies were evaluated by logs."""
    tasks = dict.fromkeys(r["task"] for r in read("judging.csv"))
    for task in tasks:
        rows = rows_of("judging.csv", task=task)
        tasks[task] = spearmanr(*([float(r[k]) for r in rows] for k in ("true_cost", "played_danger"))).statistic
    return min(tasks.values()) >= 0.8, ", ".join(f"{k} {v:.2f}" for k, v in tasks.items())


# The planner.


def planned(group: str, task: str, name: str, way: str) -> tuple[np.ndarray, np.ndarray]:
    """Normalised return (seeds, E) of a planner's row, and cost of its safe starts (seeds,)."""
    found = planner_tables.played(planner_tables.rows_of(group, task), name, way)
    earned = TASKS[task].normalised_return(planner_tables.episodes(found, "return"))
    return earned, np.array([r["cost_safe_start"] for r in found])


def planner_reaches(task: str, least: float, most: float, seeds: int = 5) -> Check:
    """What plans earn that are followed as they are, in the mean of so many seeds, and what they cost."""

    @on("results/planner")
    def check():
        earned, cost = planned("rows", task, "icbf", "as it is")
        holds = len(cost) == seeds and earned.mean() >= least and cost.mean() <= most
        return bool(holds), f"{earned.mean():.3f} / {cost.mean():.3f}, {len(cost)} seeds"

    return check


TIERS = tuple(f"simple_spread-{tier}" for tier in planner_tables.SPREAD)


def on_each(tasks: Iterable[str], judge: Callable[[str], tuple[bool, str]]) -> tuple[bool, str]:
    """Whether it holds on all tasks, and what was found on each."""
    found = {task: judge(task) for task in tasks}
    return all(bool(holds) for holds, _ in found.values()), "; ".join(f"{k} {words}" for k, (_, words) in found.items())


@on("results/planner")
def guidance_takes_cost() -> tuple[bool, str]:
    """On both logs, return gained and cost left where danger alone guides, on the same runs and resets."""

    def judge(task: str) -> tuple[bool, str]:
        (guided, left), (alone, cost) = (planned("rows", task, "icbf", way) for way in ("danger alone", "alone"))
        low, high = mean_of_runs(guided - alone)
        holds = low > -0.01 and left.mean() < 0.03 * cost.mean()
        return holds, f"[{low:+.3f}, {high:+.3f}], {cost.mean():.2f} to {left.mean():.2f}"

    return on_each((LEARNER, FIVE), judge)


@on("results/planner")
def values_guide() -> tuple[bool, str]:
    """Plans that values guide, too, beside those that danger alone guides, of the same runs on the same resets."""

    def judge(task: str) -> tuple[bool, str]:
        (steered, cost), (plain, _) = (planned("rows", task, "icbf", way) for way in ("as it is", "danger alone"))
        low, high = mean_of_runs(steered - plain)
        printed = planner_tables.paper.PRINTED[task][1][2][0]
        holds = low > 0 and cost.mean() <= 0.05 and steered.mean() > printed and len(steered) >= 3
        apart = f"{steered.mean():.2f} [{low:+.3f}, {high:+.3f}]"
        return holds, f"{apart} at {cost.mean():.3f}, {len(steered)} seeds"

    return on_each(TIERS, judge)


@on("results/planner")
def guided_under_shield() -> tuple[bool, str]:
    """Guided plans under a shield beside plans of the same runs that nothing guides under it, on Spread's tiers: what
    they earn more, beside what the shield takes of guided plans, and what they cost."""

    def judge(task: str) -> tuple[bool, str]:
        rows = planner_tables.rows_of("rows", task)
        guided, plain, free = (
            planner_tables.played(rows, "icbf", way) for way in ("under shield", "under shield, alone", "as it is")
        )
        more, taken = (
            np.subtract(*(TASKS[task].normalised_return(x) for x in planner_tables.paired(*both)))
            for both in ((guided, plain), (free, guided))
        )
        low, _ = mean_of_runs(more)
        cost = max(r["cost_safe_start"] for r in guided)
        holds = low > 0 and taken.mean() < 0.02 and cost == 0 and len(more) >= 3
        return holds, f"{more.mean():+.2f}, of free plans {-taken.mean():+.3f}, cost {cost}, {len(more)} seeds"

    return on_each(TIERS, judge)


@on("results/planner")
def guided_elsewhere() -> tuple[bool, str]:
    """Steps in contact on systems beside the paper's."""

    def judge(task: str) -> tuple[bool, str]:
        (_, left), (_, cost) = (planned("rows", task, "icbf", way) for way in ("as it is", "alone"))
        return left.max() <= 0.03 and cost.min() >= 26, f"{cost.mean():.1f} to {left.mean():.3f}, {len(left)} seeds"

    return on_each(planner_tables.PROVING, judge)


@on("results/planner")
def same_from_plans() -> tuple[bool, str]:
    """What `full` earns from plans less what it earns from clones, by the same seeds on the same resets."""

    def judge(task: str) -> tuple[bool, str]:
        rows = planner_tables.rows_of("guards", task)
        both = [planner_tables.played(rows, name, "under full") for name in ("icbf", "bc")]
        apart = np.subtract(*(TASKS[task].normalised_return(x) for x in planner_tables.paired(*both)))
        low, high = mean_of_runs(apart)
        return low < 0 < high and len(apart) >= 3, f"[{low:+.3f}, {high:+.3f}], {len(apart)} seeds"

    return on_each(TIERS, judge)


@on("results/planner")
def plans_cross() -> tuple[bool, str]:
    """On Crossing under a shield: what plans earn more than clones, and steps in contact of either."""
    rows = planner_tables.rows_of("crossing", "crossing-hasty")
    both = [planner_tables.played(rows, name, "under shield") for name in ("icbf", "bc")]
    plans, clones = planner_tables.paired(*both)
    low, high = mean_of_runs(plans - clones)
    cost = max(r["cost"] for some in both for r in some)
    words = f"{plans.mean():.2f} for {clones.mean():.2f} [{low:+.2f}, {high:+.2f}], {len(plans)} seeds, cost {cost}"
    return bool(low > 0 and cost == 0 and len(plans) >= 3), words


@on("results/planner")
def plans_run() -> tuple[bool, str]:
    """On robots under `adapt`: what plans earn more than clones, of the same seeds on the same resets, and whether both
    keep the limit."""
    apart, runs, seeds, kept = {}, [], [], True
    for task in [t for t in planner_tables.paper.PRINTED if not t.startswith("simple")]:
        rows = planner_tables.rows_of("robots", task)
        ways = (("icbf", "cool, under adapt"), ("bc", "under adapt"))
        both = [planner_tables.played(rows, *way) for way in ways]
        more = np.subtract(*planner_tables.paired(*both))
        apart[task] = more.mean()
        runs += [mean_of_runs(each[None]) for each in more]
        seeds.append(mean_of_runs(more))
        cost = max(np.mean([r["cost"] for r in some]) for some in both)
        kept = kept and cost <= TASKS[task].cost_limit
    more, less = sum(low > 0 for low, _ in runs), sum(high < 0 for _, high in runs)
    words = ", ".join(f"{task} {mean:+.0f}" for task, mean in apart.items())
    holds = (
        sum(mean > 0 for mean in apart.values()) == 8 and (len(apart), len(runs), more, less) == (9, 27, 15, 2) and kept
    )
    holds = holds and sum(low > 0 for low, _ in seeds) == 2 and not any(high < 0 for _, high in seeds)
    return bool(holds), f"{words}; of {len(runs)} runs {more} more, {less} less"


@on("results/planner")
def mean_plan_pays() -> tuple[bool, str]:
    """What the mean plan earns more, on the pool and on one learner."""
    words, apart = [], []
    for task in (FIVE, LEARNER):
        each = [planned("ablations", task, name, "alone")[0] for name in ("as it is", "noise around the origin")]
        low, high = mean_of_runs(each[0] - each[1])
        apart.append((each[0] - each[1]).mean())
        words.append(f"{task} {apart[-1]:+.3f} [{low:+.3f}, {high:+.3f}]")
    return bool(apart[0] > 0.1 and apart[0] > 5 * apart[1]), ", ".join(words)


@on("results/planner")
def shaping_costs_return() -> tuple[bool, str]:
    """Return of plans that nothing guides falls as λ rises."""
    earned = [planned("rows", LEARNER, "icbf", "alone")[0][0].mean()]
    earned += [planned("frontier", LEARNER, f"λ = {w:g}", "alone")[0].mean() for w in (0.3, 1.0, 3.0)]
    return bool(np.all(np.diff(earned) < 0)), ", ".join(f"{x:.3f}" for x in earned)


@on("results/planner")
def printed_earns() -> tuple[bool, str]:
    """Algorithm 1 as printed on the pool at the best of its λ, and its cost at 1 beside 0 and at 10."""
    found = {w: planned("algorithm1", FIVE, f"λ = {w:g}", "as it is") for w in (0.0, 1.0, 10.0)}
    earned, cost = ({w: float(both[k].mean()) for w, both in found.items()} for k in (0, 1))
    holds = earned[1.0] >= 0.95 and cost[1.0] > 0.95 * cost[0.0] and cost[10.0] < 0.6 * cost[0.0]
    holds = holds and earned[10.0] < 0.6 * earned[0.0]
    return holds, ", ".join(f"λ = {w:g}: {earned[w]:.2f} / {cost[w]:.2f}" for w in found)


@on("results/planner")
def printed_runs() -> tuple[bool, str]:
    """Algorithm 1 as printed on good robots, at λ = 1: return beside the logs', and cost in limits."""
    found = {}
    for robot in ("ant_2x4", "ant_4x2", "halfcheetah_2x3"):
        task = f"{robot}-good"
        (row,) = planner_tables.played(planner_tables.rows_of("algorithm1", task), "λ = 1", "cool")
        logs = of_json(f"planner/algorithm1-{task}.json")["logs"]
        found[robot] = row["return_norm"] - logs, TASKS[task].normalised_cost(row["cost"])
    earned, cost = zip(*found.values())
    holds = min(earned) > 0 and (round(min(cost)), round(max(cost))) == (28, 38)
    return holds, ", ".join(f"{robot} {more:+.2f}, {cost:.0f} limits" for robot, (more, cost) in found.items())


def beside_print() -> dict[str, tuple[tuple[float, float], tuple[float, float]]]:
    """By task, return and cost of the paper's method and of ours as it is, both normalised."""
    found = {}
    for task, (_, values) in planner_tables.paper.PRINTED.items():
        spread = task.startswith("simple")
        group, way = ("rows", "as it is") if spread else ("robots", "cool")
        rows = planner_tables.played(planner_tables.rows_of(group, task), "icbf", way)
        cost = TASKS[task].normalised_cost(np.mean([r["cost"] for r in rows]))
        found[task] = (values[2][0], values[2][2]), (np.mean([r["return_norm"] for r in rows]), cost)
    return found


@on("results/planner")
def print_earns_more() -> tuple[bool, str]:
    """Of the paper's tasks, on other data: where its printed return is not higher than ours."""
    less = {task for task, (printed, ours) in beside_print().items() if printed[0] <= ours[0]}
    spread = {f"simple_spread-{tier}" for tier in planner_tables.SPREAD}
    return less == {"ant_4x2-medium", "ant_4x2-poor"} | spread, f"not on {', '.join(sorted(less))}"


@on("results/planner")
def some_exceed() -> tuple[bool, str]:
    """Robots' limits that plans exceed which are followed as they are, and those that print exceeds."""
    robots = {task: both for task, both in beside_print().items() if not task.startswith("simple")}
    ours, theirs = ([task for task, both in robots.items() if both[k][1] > 1] for k in (1, 0))
    return ours == ["halfcheetah_2x3-good"] and not theirs, f"ours {ours}, print {theirs}"


CLAIMS: dict[str, dict[str, Check]] = {
    "README.md": {
        "It earns more than its logs": planner_reaches(LEARNER, 1.15, 0.1, seeds=4),
        "The safety comes from the guard": shielded_all,
        "On fourteen of sixteen systems a guarded clone never violates": of_again,
        "Print earns more than ours as it is on seven of nine robot tasks": print_earns_more,
        "Ours earns more on Simple Spread's four tiers at hardly any cost": values_guide,
        "exceeds no limit; ours exceeds one": some_exceed,
    },
    "docs/export.md": {"which is no slower": exported_in_time},
    "docs/ope.md": {"Danger is ranked well": danger_is_ranked},
    "docs/results.md": {
        # the paper
        "Print earns more than ours as it is on seven of nine robot tasks": print_earns_more,
        "Our ICBF as it is exceeds the limit": some_exceed,
        # Simple Spread
        "On Simple Spread a shield takes the cost from every proposal": shielded_all,
        "The return comes from climbing learned values": CLIMBING_EARNS,
        "A zero proposal (`mpc`) earns less on three": CLONING_EARNS,
        "A shield of each agent's own leaves hardly a collision step": own_shield_leaves_little,
        # robots
        "intervals included, by learned danger and by the formula": robots_kept("default+adapt-learned", 17),
        "By learned danger `full` keeps 16": robots_kept("default+full-learned", 16),
        "earns more on most: on nine beyond chance, on none less": FULL_EARNS,
        "costs return beyond chance on two of 18 tasks, and raises the cost on two": learned_costs,
        "FISOR keeps 16 of 18 without a guard": fisor_keeps,
        "keep all 18 limits under `adapt`": robots_kept("default+adapt-learned-decentralized", 18, "own-sight-mujoco"),
        "Safety may cost most of the return": safety_costs,
        "An Ant that stands still earns more than every unguarded method": standing_earns,
        "earns less than from cloned actions on six of nine data sets and more on one": CLIMBS_FROM_NOTHING,
        "When it may climb anywhere it earns less on eight": CLIMBS_ANYWHERE,
        # Crossing, and teams
        "predicted step or three is as safe as ℓ along seven": as_safe_by_v,
        "`full` earns a quarter more than the shield, without contact": full_is_safe,
        "a return-conditioned clone earns 4.96 under the same shield": told_clones_earn,
        "On eight tiers the shield leaves contact in 1 of 10,000 episodes": crossing_rare,
        "Whoever does not start in contact touches nobody in any size": no_size_touches,
        "the shield takes hardly any return": no_size_loses,
        # other simulators and constraints
        "and not for who never brakes": brakes_in_time,
        "it knows what is dangerous, not what will be": learned_sees_more,
        "One barrier for both keeps both limits": one_keeps_both,
        "yet a World of their logs leaves eight robots no contact": careful_logs_suffice,
        "takes more than half of the contact": of_other_integrators,
        # the planner
        "plans earn** 1.24 of the scale at no cost": planner_reaches(FIVE, 1.235, 0.005, seeds=3),
        "Danger that guides takes the cost, and no return": guidance_takes_cost,
        "Values that guide plans earn more on every tier": values_guide,
        "Under a `shield` guided plans keep their return, and touch nobody": guided_under_shield,
        "On two systems of the proving ground": guided_elsewhere,
        "Where values are climbed no difference was shown": same_from_plans,
        "plans earn more than clones in the mean of eight of nine robot data sets": plans_run,
        "On Crossing plans earn more than clones under the same shield": plans_cross,
        "The mean plan is what makes it learn a pool": mean_plan_pays,
        "The barrier in training costs return": shaping_costs_return,
        "Algorithm 1 as printed earns nearly what print has": printed_earns,
        "On good robots it earns what the logs do or more, at 28 to 38 times the limit": printed_runs,
        # logs of many drivers
        "`flow` earns more than the pool's logs": FLOW_POOL,
        "Guided by danger `flow` costs nothing from safe starts and earns no less": GUIDED_POOL,
        "Under a shield none costs anything from safe starts**, and none loses 0.01 of its return": of_shielded_pool,
        "Under `full` clones earn more than the data does": of_full_pool,
        "On medium and random alone none earns more than 0.33; under `full` all earn 1.2 or more": of_full_pools,
        "a clone of the best tenth and MA-TD3+BC earn about what the best driver's episodes do": of_medium_pool,
        "earns more than a clone under the same guard on eight of nine data sets and less on none": BEST_OF_EIGHT,
        "**The first proposal alone** earns more on four of nine and less on two": FIRST_ALONE,
        "`full` from cloned actions earns more than that on most": of_climbing_robots,
        "`flow` earns less on one of three and more on another of HalfCheetah's tiers than a clone": of_robot_pools,
        # choices of a guard
        "The World's error costs nothing": error_costs_nothing,
        "V alone, without ℓ": by_value_alone,
        "a guess of what others do is worth nothing": guess_is_worth,
        "safety costs next to nothing": guards_price,
        "keeps 9 of 10 limits on Simple Spread": limits_learned,
    },
    "docs/proving-ground.md": {
        "clones guarded by *fit* Worlds never violate, naive drivers in at most one episode of 60, but on `bench` two "
        "and on `gears` four": of_again,
        "Fourteen of sixteen guarded clones violate in at most 1 % of their episodes": of_systems,
        "On twelve systems the guard leaves it at most 2 %, at nine tenths of the oracle's return; a guard "
        "that looks three steps ahead on eight": of_bad_driving,
        "Naive drivers under guards of *fit* Worlds violate on `bench`, `convoy`, `flock` and `gears`**, by one seed "
        "in up to 35 %": of_fit_worlds,
        "With naive drivers it leaves more violations than the shield on eight of thirteen systems, fewer on "
        "three": of_filters,
        "Nine of ten guarded clones never violate": of_ten_more,
        "the guard leaves contact in none of the episodes of `x9`, and in none of `x10`": of_rebounds,
        "Clones guarded by *fit* Worlds never violate, naive drivers in at most 7 %": of_drawn_systems,
        "With more shapes no World is *unfit*, and guarded clones violate in at most 6 %, without in up to "
        "99 %": of_shapes,
        "Only `rays` stays bad": of_rays,
        "Of 27 Worlds twenty-one are *fit*": of_families,
        "Read as they are, such logs make every World *unfit*": of_maps,
        "Who is seen matters to bold drivers": of_trackers,
    },
    "docs/robustness.md": {
        "The shield prevents three quarters there, beyond the logs less than half": of_a_crowd,
        "leaves contact in 1.2 % of the episodes at most (bound 2.4 %). One that does not know leaves it in "
        "up to 94 %": of_late_actions,
        "A guard that knows of up to three late steps leaves no unsafe step on the three systems": of_late_systems,
        "is kept behind every fault": of_a_robot_behind_faults,
        "A guard that knows of late or lost steps leaves half of the contacts, or fewer": of_pedestrians,
        "Undelayed logs leave contact in at most 1 of 300 episodes, and earn more": undelayed_logs_leave_little,
    },
}


def main() -> None:
    wrong = 0
    for page, claims in CLAIMS.items():
        text = re.sub(r"\s+", " ", (ROOT / page).read_text())
        for words, check in claims.items():
            holds, found = check()
            if words not in text:
                holds, found = False, "the sentence is not there"
            wrong += not holds
            file = check.__dict__["file"].removeprefix("results/")
            print(f"{'ok   ' if holds else 'WRONG'} {page}: {words} ({file}): {found}")
    sys.exit(f"{wrong} claims do not hold" if wrong else 0)


if __name__ == "__main__":
    main()
