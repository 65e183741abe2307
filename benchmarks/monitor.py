"""How seldom the monitor of a certificate raises a false alarm, and how soon a true one.

python benchmarks/monitor.py          # writes results/stress/monitor.csv and the table of docs/stress-results.md

Episodes violate or not, independently and with a given probability; no simulator is asked. Promises and rates are
those of results/stress/crossing.csv (benchmarks/stress.py): a guard's upper bound as it was tested, and the rate that
was counted with two more late steps than it knows of.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import _rows
import numpy as np
from readme import put

from ringfence.faults.monitor import Monitor

ROOT = Path(__file__).resolve().parent.parent
PLAYED = ROOT / "results" / "stress" / "crossing.csv"
OUT = ROOT / "results" / "stress" / "monitor.csv"
STREAMS, EPISODES = 2000, 500
# What the guard knows, as rows of crossing.csv, and what befalls it: two more late steps.
BEFORE: dict[str, tuple[str, str, str]] = {
    "none": ("none", "shield", "False"),
    "delay 1": ("delay1", "shield", "True"),
    "delay 2": ("delay2", "shield", "True"),
}
AFTER: dict[str, tuple[str, str, str]] = {
    "none": ("delay2", "shield", "False"),
    "delay 1": ("delay3", "shield, delay 1, others_acceleration 1.0", "False"),
    "delay 2": ("delay4", "shield, delay 2, others_acceleration 1.0", "False"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=OUT)
    a = parser.parse_args()
    played = {(r["faults"], r["guard"], r["compensated"]): r for r in _rows.read(PLAYED)}
    rows: list[dict[str, Any]] = []
    for name, before in BEFORE.items():
        promised = float(played[before]["violation_upper"])
        kept = float(played[before]["violation_rate"])
        cases = {"as promised, at most": promised, "as it was played": kept}
        if AFTER[name] in played:
            cases["two more late steps"] = float(played[AFTER[name]]["violation_rate"])
        rows += [{"guard knows": name, "promised": promised, **case(what, promised, r)} for what, r in cases.items()]
    _rows.write(a.out, rows)
    put("docs/stress-results.md", "monitor", table(rows))


def case(what: str, promised: float, rate: float) -> dict[str, Any]:
    """Streams of episodes that violate at this rate, watched against what was promised."""
    rng = np.random.default_rng(0)
    first = np.array([first_alarm(Monitor(promised), rng.random(EPISODES) < rate) for _ in range(STREAMS)])
    raised = first <= EPISODES
    row = {"episodes": what, "rate": rate, "streams": STREAMS, "length": EPISODES}
    row |= {"alarms": round(float(raised.mean()), 4), "median": "", "nine tenths": ""}
    if raised.mean() >= 0.9:
        row |= {"median": int(np.median(first)), "nine tenths": int(np.quantile(first, 0.9))}
    print(row, flush=True)
    return row


def first_alarm(monitor: Monitor, violated: np.ndarray) -> float:
    """The episode after which the alarm is raised; infinite where it never is."""
    for k, one in enumerate(violated):
        if monitor.observe(bool(one)):
            return k + 1
    return np.inf


def table(rows: list[dict[str, Any]]) -> str:
    lines = ["| guard knows | promised | episodes | violating | streams with an alarm | median episodes to it |"]
    lines.append("|---" * 6 + "|")
    for r in rows:
        cells = [r["guard knows"], f"{100 * r['promised']:.2f} %", r["episodes"], f"{100 * r['rate']:.2f} %"]
        lines.append(f"| {' | '.join(cells)} | {100 * r['alarms']:.1f} % | {r['median'] or '–'} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
