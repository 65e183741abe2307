"""The yard of examples/yard.py, 1000 test episodes: BC, and a naive controller at full speed, alone and under
guard; danger learned of the team's cost column beside the formula that the logs are not told.

    python benchmarks/yard.py            # writes results/yard.csv and docs/guard-results.md's table; an hour

Rows that are there already are not made again.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
from pathlib import Path

from _yard import naive, yard
from readme import put

import ringfence
from ringfence.evaluation.statistics import upper_bound
from ringfence.logs.store import EpisodeStore
from ringfence.problem.constraints import Separation, to_dict
from ringfence.utils import stored
from ringfence.utils.files import whole

ROOT = Path(__file__).resolve().parent.parent
OUT = ROOT / "results" / "yard.csv"
# Who acts, under which guard, of how many episodes one (`full` takes ten times as long).
ROWS = (
    ("BC", "none", "none", {}, 1),
    ("BC", "shield", "learned", {"terminal_value": False}, 1),
    ("BC", "shield", "learned", {}, 1),
    ("BC", "shield", "analytic", {}, 1),
    ("BC", "full", "learned", {}, 5),
    ("BC", "full", "learned", {"horizon": 3, "terminal_value": True}, 5),
    ("BC", "full", "analytic", {}, 5),
    ("naive controller", "none", "none", {}, 1),
    ("naive controller", "shield", "learned", {"terminal_value": False}, 1),
    ("naive controller", "shield", "learned", {}, 1),
    ("naive controller", "shield", "learned", {"horizon": 7}, 1),
    ("naive controller", "shield", "learned", {"horizon": 10}, 1),
    ("naive controller", "shield", "analytic", {}, 1),
)
HEAD = ("method", "guard", "barrier", "options", "episodes", "return", "return_low", "return_high", "contact", "bound")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=1000)
    most = parser.parse_args().episodes
    store = yard.record()
    # The formula is what a guard may be asked for beside; what is learned is learned of the costs.
    hazard = Separation(2 * yard.RADIUS)
    logs_of_both = dataclasses.replace(store, card=store.card.updated(hazard=to_dict(hazard)))
    world = ringfence.fit(logs_of_both, quiet=False)
    run = ringfence.train("bc", logs_of_both, out=ROOT / "runs")[0]
    there = {tuple(r.values())[:4]: list(r.values()) for r in stored.table(OUT)} if OUT.exists() else {}
    rows = [logs(store)]
    for method, guard, barrier, options, part in ROWS:
        words = " ".join(f"{k}={v}" for k, v in options.items())
        if kept := there.get((method, guard, barrier, words)):
            rows.append(kept)
            continue
        episodes = max(100, most // part)
        asked = {} if guard == "none" else {"guard": guard, "barrier": barrier, **options}
        if method == "BC":
            r = ringfence.play(
                run, yard.Yard, episodes=episodes, num_envs=100, **asked, **({"world": world} if asked else {})
            )
        else:
            asked = asked or {"guard": "none"}  # it looks on
            pilot = ringfence.guard(naive, world, hazard=hazard, **asked)
            r = ringfence.play(pilot, yard.Yard, episodes=episodes, num_envs=100)
        measured = [r["return_mean"], *r["return_interval"], r["violation_rate"]]
        bound = upper_bound(round(r["violation_rate"] * episodes), episodes)
        rows.append([method, guard, barrier, words, episodes, *measured, bound])
        print(rows[-1], flush=True)
        write(rows)
    write(rows)
    put("docs/guard-results.md", "yard", table(OUT))


def logs(store: EpisodeStore) -> list:
    touched = int((store.episode_costs > 0).sum())
    rate = touched / store.episodes
    return ["logs", "", "", "", store.episodes, store.returns.mean(), "", "", rate, ""]


def write(rows: list[list]) -> None:
    with whole(OUT) as temporary, temporary.open("w") as f:
        writer = csv.writer(f, lineterminator="\n")
        writer.writerow(HEAD)
        writer.writerows([f"{v:.5g}" if isinstance(v, float) else v for v in row] for row in rows)


def table(file: Path) -> str:
    lines = ["| method | guard | return | episodes with contact (bound) |", "|---|---|---|---|"]
    ways = {"": "", "terminal_value=False": ", 3 steps without V", "horizon=7": ", 7 steps"}
    ways |= {"horizon=10": ", 10 steps"}
    ways |= {"horizon=3 terminal_value=True": ", 3 steps"}
    for r in stored.table(file):
        guard = "" if r["guard"] in ("", "none") else f"{r['guard']}, {r['barrier']}{ways[r['options']]}"
        bound = f" (≤ {100 * float(r['bound']):.3g} %)" if r["bound"] else ""
        touched = f"{100 * float(r['contact']):.3g} %{bound}"
        lines.append(f"| {r['method']} | {guard} | {float(r['return']):.2f} | {touched} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
