"""A guarded run behind faults, as the guard is and with what it can know of them.

python benchmarks/stress.py                         # writes results/stress/crossing.csv, a row when it is played
python benchmarks/stress.py --jobs 16 --rows delay3 delay3/compensated     # some rows, each in a process of its own
python benchmarks/stress.py --list
python benchmarks/stress.py --table                 # writes the tables of docs/stress-results.md
python benchmarks/stress.py --runs runs/proving-discs/bc/seed-0 ...        # other tasks: results/stress/systems.csv
python benchmarks/stress.py --runs halfcheetah_2x3-good/bc --guard adapt --episodes 10      # a policy that ships

Half a minute for 50 episodes of a row, on one core that has nothing else to do.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import _rows

ROOT = Path(__file__).resolve().parent.parent
OUT = ROOT / "results" / "stress" / "crossing.csv"
ROW = ("faults", "guard", "compensated", "episodes")  # what tells rows apart
RATES = ("violation_rate", "violation_upper", "infeasible_rate")
FIELDS = (*ROW, "return", *RATES)
RUN = "crossing-hasty/bc"
AS_WORLD = {"others_acceleration": 1.0}  # m/s²
WIDER = {"margin": 1.5}
MIDDLE = {"delay": 2, "drop": 0.3, "noise": 0.005, "gain": 0.8, "asynchrony": 0.5}
FAULTS: tuple[dict[str, Any], ...] = (
    {},
    {"delay": 1},
    {"delay": 2},
    {"delay": 3},
    {"jitter": 2},
    {"drop": 0.3},
    {"drop": 0.6},
    {"asynchrony": 0.667},
    {"noise": 0.005},
    {"noise": 0.02},
    {"bias": 0.02},
    {"gain": 0.8},
    {"gain": 0.6},
    {"spread": 0.2},
    {"stop": 0.002},
    MIDDLE,
)
KNOWN = ("delay", "jitter", "drop", "asynchrony")  # faults that `compensate` makes good for

SYSTEMS = OUT.with_name("systems.csv")
SYSTEMS_ROW = ("task", "faults", "guard", "episodes")
SYSTEMS_FIELDS = (*SYSTEMS_ROW, "return", "cost", *RATES)
KINDS = ("none", "guard", "compensated")
# Of other tasks: what guards can know of and what they cannot, at three strengths, and several at once.
STRENGTHS = {
    "delay": (1, 2, 3),
    "drop": (0.3, 0.6, 0.8),
    "asynchrony": (0.5, 0.667, 0.75),
    "noise": (0.005, 0.02, 0.05),
    "gain": (0.8, 0.6, 0.4),
}
ON_SYSTEMS: tuple[dict[str, Any], ...] = ({}, *({k: v} for k, some in STRENGTHS.items() for v in some), MIDDLE)

Trial = tuple[dict[str, Any], bool, dict[str, Any]]  # faults, whether they are compensated, the guard's other options


def trials() -> dict[str, Trial]:
    """All rows by name, e.g. `delay3/compensated`; `all` has several faults at once."""
    found: dict[str, Trial] = {}
    for faults in FAULTS:
        name = "all" if faults is MIDDLE else name_of(faults)
        found[name] = faults, False, {}
        if not faults.keys() & set(KNOWN):
            continue
        found[f"{name}/compensated"] = faults, True, {}
    for faults in ({"delay": 3}, {"drop": 0.6}, {"asynchrony": 0.667}, MIDDLE):
        name = "all" if faults is MIDDLE else name_of(faults)
        found[f"{name}/compensated/wider"] = faults, True, WIDER
    for known in (1, 2):  # and two more steps that it was not told of, which the monitor should find out
        found[f"delay{known + 2}/knows{known}"] = {"delay": known + 2}, False, {"delay": known, **AS_WORLD}
    return found


def name_of(faults: dict[str, Any]) -> str:
    return "+".join(f"{k}{v}" for k, v in faults.items()) or "none"


def in_words(name: str) -> str:
    """`delay2+drop0.3` as delay 2, drop 0.3; all of `MIDDLE` as five at once."""
    if name == name_of(MIDDLE):
        return "five at once"
    return re.sub(r"([a-z])([\d.]+)", r"\1 \2", name).replace("+", ", ")


def guard_of(options: dict[str, Any]) -> str:
    return ", ".join(["shield", *(f"{k} {v}" for k, v in options.items())])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--rows", nargs="*", help="all by default")
    parser.add_argument("--jobs", type=int, default=1, help="rows that are played side by side")
    parser.add_argument("--agents", type=int, help="of another team than that of the logs")
    parser.add_argument("--runs", nargs="*", type=Path, help="of other tasks, without a guard and under one that knows")
    parser.add_argument("--guard", default="shield", help="of these")
    parser.add_argument("--list", action="store_true")
    parser.add_argument("--table", action="store_true")
    a = parser.parse_args()
    every = trials()
    if a.list:
        print(*every, sep="\n")
        return
    if a.table:
        write_table(a.out)
        write_systems_table(SYSTEMS)
        return
    if a.runs:
        for folder in a.runs:
            play_system(folder, a.guard, a.episodes, SYSTEMS if a.out == OUT else a.out)
        return
    unknown = set(a.rows or ()) - set(every)
    if unknown:
        raise SystemExit(f"There is no row {sorted(unknown)[0]}; --list says which there are.")
    wanted = a.rows or list(every)
    if a.jobs > 1:
        side_by_side(wanted, a.jobs, a.episodes, a.out, a.agents)
        return
    with tempfile.TemporaryDirectory() as folder:
        from ringfence.deploy import zoo

        run = zoo.pretrained(RUN, folder)
        for name in wanted:
            play(run, every[name], a.episodes, a.out, a.agents)


def play(run: Any, trial: Trial, episodes: int, out: Path, agents: int | None) -> None:
    """Play a row and add it to the file, unless it is there."""
    from ringfence.errors import UserError
    from ringfence.evaluation.stress import stress

    faults, compensated, options = trial
    row: dict[str, Any] = {
        "faults": name_of(faults),
        "guard": guard_of(options),
        "compensated": compensated,
        "episodes": episodes,
    }
    done = {tuple(r[k] for k in ROW) for r in _rows.read(out)}
    if tuple(str(row[k]) for k in ROW) in done:
        return
    given = {} if agents is None else {"agents": agents}
    try:
        result = stress(run, faults, episodes=episodes, guard="shield", compensate=compensated, **options, **given)
    except UserError as error:  # more late steps than the World's predictions are known for
        print(f"{row}: {error}", flush=True)
        return
    row |= {"return": round(result["return_mean"], 3), **{rate: round(result[rate], 4) for rate in RATES}}
    print(row, flush=True)
    _rows.append(out, row, FIELDS)


def play_system(folder: Path, guard: str, episodes: int, out: Path) -> None:
    """A run behind few faults: without a guard, under one, and under one that knows of them."""
    from ringfence.deploy import zoo
    from ringfence.evaluation.stress import known_to_guards, stress
    from ringfence.faults import Faults
    from ringfence.training.runs import Run

    run = Run.of(folder) if folder.exists() else zoo.pretrained(str(folder), tempfile.mkdtemp())
    guarded = {"guard": guard, "anyway": True}
    guards = {"none": {}, guard: guarded, f"{guard}, compensated": {**guarded, "compensate": True}}
    for faults in ON_SYSTEMS:
        for name, options in guards.items():
            row: dict[str, Any] = {"task": run.config["task"], "faults": name_of(faults)}
            row |= {"guard": name, "episodes": episodes}
            done = {tuple(r[k] for k in SYSTEMS_ROW) for r in _rows.read(out)}
            unknown = "compensate" in options and not known_to_guards(Faults.of(faults))
            if unknown or tuple(str(row[k]) for k in SYSTEMS_ROW) in done:
                continue
            result = stress(run, faults, episodes=episodes, **options)
            row |= {"return": round(result["return_mean"], 3), "cost": round(result["cost_mean"], 3)}
            row |= {rate: round(result[rate], 4) for rate in RATES if rate in result}
            print(row, flush=True)
            _rows.append(out, row, SYSTEMS_FIELDS)


def write_systems_table(out: Path) -> None:
    """Other tasks, side by side: unsafe steps per episode without a guard, under one, and under one that knows; and
    what the robot earns."""
    from readme import put

    rows = {(r["task"], r["faults"], kind(r["guard"])): r for r in _rows.read(out)}
    tasks = list(dict.fromkeys(task for task, _, _ in rows))
    earning = [task for task in tasks if not task.startswith("proving-")]
    heads = [f"`{task}`" for task in tasks] + [f"return of `{task}`" for task in earning]
    lines = [f"| faults | {' | '.join(heads)} |", "|---" * (1 + len(heads)) + "|"]
    for faults in dict.fromkeys(faults for _, faults, _ in rows):
        cells = [in_words(faults)]
        for told, key in ((tasks, "cost"), (earning, "return")):
            digits = ".3g" if key == "cost" else ".0f"
            cells += [
                " / ".join(f"{float(rows[at][key]):{digits}}" for name in KINDS if (at := (task, faults, name)) in rows)
                for task in told
            ]
        lines.append(f"| {' | '.join(cells)} |")
    put("docs/stress-results.md", "systems", "\n".join(lines))


def kind(guard: str) -> str:
    """Which of the table's columns a guard is in."""
    if guard == "none":
        return "none"
    return "compensated" if guard.endswith("compensated") else "guard"


def side_by_side(wanted: Sequence[str], jobs: int, episodes: int, out: Path, agents: int | None) -> None:
    """Every row in a process with one core; each adds its own."""
    out.parent.mkdir(parents=True, exist_ok=True)
    if not out.exists():
        out.write_text(",".join(FIELDS) + "\n")
    one_core = {"XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false", "NPROC": "1", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, __file__, "--episodes", str(episodes), "--out", str(out)]
    command += [] if agents is None else ["--agents", str(agents)]
    waiting = list(wanted)
    running: list[subprocess.Popen] = []
    while waiting or running:
        while waiting and len(running) < jobs:
            running.append(subprocess.Popen([*command, "--rows", waiting.pop(0)], env={**os.environ, **one_core}))
        running.pop(0).wait()


def write_table(out: Path) -> None:
    """The table of docs/stress-results.md between its markers."""
    from readme import put

    rows = _rows.read(out)
    plain = {r["episodes"]: float(r["return"]) for r in rows if r["faults"] == "none"}
    names = list(dict.fromkeys(name_of(faults) for faults, _, _ in trials().values()))
    order = {name: k for k, name in enumerate(names)}
    head = "faults | guard | episodes | return | of that without faults, % | episodes with contact, % (95 % ≤)"
    lines = [f"| {head} | infeasible steps, % |", "|---" * 7 + "|"]
    # Wider margins, and guards that know of half of a delay, are in the file: for certificates and the monitor.
    shown = [r for r in rows if not re.search("margin|others_acceleration", r["guard"])]
    for r in sorted(shown, key=lambda r: (order[r["faults"]], r["compensated"] == "True", r["guard"])):
        base = plain.get(r["episodes"], next(iter(plain.values())))
        share, rate, upper, infeasible = (
            100 * float(x)
            for x in (float(r["return"]) / base, r["violation_rate"], r["violation_upper"], r["infeasible_rate"])
        )
        guard = r["guard"].replace("shield", "compensated", 1) if r["compensated"] == "True" else r["guard"]
        cells = [
            in_words(r["faults"]),
            guard.replace("_", " "),
            r["episodes"],
            f"{float(r['return']):.2f}",
            f"{share:.0f}",
        ]
        lines.append("| " + " | ".join([*cells, f"{rate:.1f} (≤ {upper:.1f})", f"{infeasible:.0f}"]) + " |")
    put("docs/stress-results.md", "stress", "\n".join(lines))


if __name__ == "__main__":
    main()
