"""The yard of examples/yard.py, 1000 test episodes: cloning alone and under guard, danger learned of the team's cost
column beside the formula that the logs are not told.

    python benchmarks/yard.py            # writes results/yard.csv; an hour, most of it `full`
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import sys
from pathlib import Path

import ringfence
from ringfence.data.store import EpisodeStore
from ringfence.files import whole
from ringfence.hazards import Separation, to_dict
from ringfence.stats import upper_bound

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "examples"))
import yard  # noqa: E402

OUT = ROOT / "results" / "yard.csv"
GUARDS = (
    ("none", "none", {}),
    ("shield", "learned", {}),
    ("shield", "formula", {}),
    ("full", "learned", {}),
)
HEAD = ("guard", "danger", "episodes", "return", "return_low", "return_high", "contact", "bound", "infeasible")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=1000)
    episodes = parser.parse_args().episodes
    store = yard.record()
    # The formula is what a guard may be asked for beside; what is learned is learned of the costs.
    hazard = to_dict(Separation(2 * yard.RADIUS))
    told = dataclasses.replace(store, card={**store.card, "hazard": hazard})
    world = ringfence.fit(told, quiet=False)
    run = ringfence.train("bc", told, out=ROOT / "runs")[0]
    rows = [logs(store)]
    for guard, danger, options in GUARDS:
        how = {} if guard == "none" else {"guard": guard, "danger": danger, "world": world, **options}
        r = ringfence.play(run, yard.Yard, episodes=episodes, at_once=100, **how)
        touched = round(r["violation_rate"] * episodes)
        rows.append(
            [guard, danger, episodes, r["return_mean"], *r["return_interval"], r["violation_rate"]]
            + [upper_bound(touched, episodes), r.get("infeasible", "")]
        )
        print(rows[-1], flush=True)
        write(rows)


def logs(store: EpisodeStore) -> list:
    touched = int((store.episode_costs > 0).sum())
    rate = touched / store.episodes
    return ["logs", "", store.episodes, store.returns.mean(), "", "", rate, "", ""]


def write(rows: list[list]) -> None:
    with whole(OUT) as temporary, temporary.open("w") as f:
        writer = csv.writer(f, lineterminator="\n")
        writer.writerow(HEAD)
        writer.writerows([f"{v:.5g}" if isinstance(v, float) else v for v in row] for row in rows)


if __name__ == "__main__":
    main()
