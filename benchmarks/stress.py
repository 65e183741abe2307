"""A guarded run behind faults, as the guard is and with what it can know of them.

python benchmarks/stress.py                         # writes results/stress/crossing.csv, a row when it is played
python benchmarks/stress.py --jobs 16 --rows delay3 delay3/compensated     # some rows, each in a process of its own
python benchmarks/stress.py --list
python benchmarks/stress.py --runs runs/proving-discs/bc/seed-0 ...        # other tasks: results/stress/systems.csv
python benchmarks/stress.py --runs halfcheetah_2x3-good/bc --guard adapt --episodes 10      # a policy that ships

Half a minute for 50 episodes of a row, on one core that has nothing else to do.
"""

from __future__ import annotations

import argparse
import re
import tempfile
from pathlib import Path
from typing import Any

from common import RESULTS, append, read, side_by_side

OUT = RESULTS / "stress" / "crossing.csv"
SYSTEMS = OUT.with_name("systems.csv")
ROW = ("faults", "guard", "compensated", "episodes")  # what tells rows apart
SYSTEMS_ROW = ("task", "faults", "guard", "episodes")
RATES = ("violation_rate", "violation_upper", "infeasible_rate")
RUN = "crossing-hasty/bc"
AS_WORLD = {"others_acceleration": 1.0}  # m/s²
WIDER = {"margin": 1.5}
Faults = dict[str, Any]
MIDDLE: Faults = {"delay": 2, "drop": 0.3, "noise": 0.005, "gain": 0.8, "asynchrony": 0.5}
_ALONE = {"delay": (1, 2, 3), "jitter": (2,), "drop": (0.3, 0.6), "asynchrony": (0.667,), "noise": (0.005, 0.02)}
_ALONE |= {"bias": (0.02,), "gain": (0.8, 0.6), "spread": (0.2,), "stop": (0.002,)}
# Of other tasks: what guards can know of and what they cannot, at three strengths, and several at once.
_STRENGTHS = {"delay": (1, 2, 3), "drop": (0.3, 0.6, 0.8), "asynchrony": (0.5, 0.667, 0.75)}
_STRENGTHS |= {"noise": (0.005, 0.02, 0.05), "gain": (0.8, 0.6, 0.4)}


def each_alone(strengths: dict[str, tuple[float, ...]], together: Faults) -> tuple[Faults, ...]:
    """No fault, each at every strength, and several at once."""
    return ({}, *({k: v} for k, some in strengths.items() for v in some), together)


FAULTS, ON_SYSTEMS = each_alone(_ALONE, MIDDLE), each_alone(_STRENGTHS, MIDDLE)
KNOWN = ("delay", "jitter", "drop", "asynchrony")  # faults that `compensate` makes good for
Trial = tuple[Faults, bool, dict[str, Any]]  # faults, whether they are compensated, the guard's other options


def trials() -> dict[str, Trial]:
    """All rows by name, e.g. `delay3/compensated`; `all` has several faults at once."""
    named = {"all" if faults is MIDDLE else name_of(faults): faults for faults in FAULTS}
    found: dict[str, Trial] = {}
    for name, faults in named.items():
        found[name] = faults, False, {}
        if faults.keys() & set(KNOWN):
            found[f"{name}/compensated"] = faults, True, {}
    for name in ("delay3", "drop0.6", "asynchrony0.667", "all"):
        found[f"{name}/compensated/wider"] = named[name], True, WIDER
    for known in (1, 2):  # and two more steps that it was not told of, which the monitor should find out
        found[f"delay{known + 2}/knows{known}"] = {"delay": known + 2}, False, {"delay": known, **AS_WORLD}
    return found


def name_of(faults: Faults) -> str:
    return "+".join(f"{k}{v}" for k, v in faults.items()) or "none"


def in_words(name: str) -> str:
    """`delay2+drop0.3` as delay 2, drop 0.3; all of `MIDDLE` as five at once."""
    if name == name_of(MIDDLE):
        return "five at once"
    return re.sub(r"([a-z])([\d.]+)", r"\1 \2", name).replace("+", ", ")


def missing(out: Path, row: dict[str, Any]) -> bool:
    """Whether a table lacks a row with these entries."""
    wanted = {k: str(v) for k, v in row.items()}
    return not any(wanted.items() <= r.items() for r in read(out))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--rows", nargs="*", default=list(trials()), choices=list(trials()))
    parser.add_argument("--jobs", type=int, default=1, help="rows that are played side by side")
    parser.add_argument("--agents", type=int, help="of another team than that of the logs")
    parser.add_argument("--runs", nargs="*", type=Path, help="of other tasks, without a guard and under one that knows")
    parser.add_argument("--guard", default="shield", help="of these")
    parser.add_argument("--list", action="store_true")
    a = parser.parse_args()
    if a.list:
        print(*trials(), sep="\n")
    elif a.runs:
        for folder in a.runs:
            play_system(folder, a.guard, a.episodes, SYSTEMS if a.out == OUT else a.out)
    elif a.jobs > 1:
        same = ["stress.py", "--episodes", str(a.episodes), "--out", str(a.out)]
        same += [] if a.agents is None else ["--agents", str(a.agents)]
        if not a.out.exists():  # once, not by each process
            a.out.write_text(",".join((*ROW, "return", *RATES)) + "\n")
        side_by_side(([*same, "--rows", row] for row in a.rows), a.jobs)
    else:
        for name in a.rows:
            play(trials()[name], a.episodes, a.out, a.agents)


def play(trial: Trial, episodes: int, out: Path, agents: int | None) -> None:
    """Play a row and add it to the file, unless it is there."""
    from ringfence.deploy import zoo
    from ringfence.errors import UserError
    from ringfence.evaluation.stress import stress

    faults, compensated, options = trial
    guard = ", ".join(["shield", *(f"{k} {v}" for k, v in options.items())])
    row = dict(zip(ROW, (name_of(faults), guard, compensated, episodes)))
    if not missing(out, row):
        return
    how = options if agents is None else {**options, "agents": agents}
    with tempfile.TemporaryDirectory() as folder:
        run = zoo.pretrained(RUN, folder)
        try:
            result = stress(run, faults, episodes=episodes, guard="shield", compensate=compensated, **how)
        except UserError as error:  # more late steps than the World's predictions are known for
            print(f"{row}: {error}", flush=True)
            return
    append(out, row | {"return": round(result["return_mean"], 3), **{k: round(result[k], 4) for k in RATES}})


def play_system(folder: Path, guard: str, episodes: int, out: Path) -> None:
    """A run behind few faults: without a guard, under one, and under one that knows of them."""
    from ringfence.deploy import zoo
    from ringfence.evaluation.compensation import known_to_guards
    from ringfence.evaluation.stress import stress
    from ringfence.faults import Faults
    from ringfence.training.runs import Run
    from ringfence.training.worlds import with_world

    run = Run.of(folder) if folder.exists() else zoo.pretrained(str(folder), tempfile.mkdtemp())
    guarded = {"guard": guard, "anyway": True}
    guards = {"none": {}, guard: guarded, f"{guard}, compensated": {**guarded, "compensate": True}}
    for faults in ON_SYSTEMS:
        for name, options in guards.items():
            row = dict(zip(SYSTEMS_ROW, (run.config["task"], name_of(faults), name, episodes)))
            unknown = "compensate" in options and not known_to_guards(Faults.of(faults))
            if unknown or not missing(out, row):
                continue
            result = with_world(stress, run, faults, episodes=episodes, **options)
            row |= {"return": round(result["return_mean"], 3), "cost": round(result["cost_mean"], 3)}
            append(out, row | {k: round(result[k], 4) if k in result else "" for k in RATES})


if __name__ == "__main__":
    main()
