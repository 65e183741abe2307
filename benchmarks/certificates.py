"""Does a certificate keep what it promises? Calibrate and test many times, and count how often other episodes violate
no more than it allows.

python benchmarks/certificates.py play --batches 2     # plays each setting, a file for each batch, resumable
python benchmarks/certificates.py judge                # writes results/stress/certificates.csv and .json from these
python benchmarks/certificates.py monitor              # writes results/stress/monitor.csv

Margins are those of a grid: a calibration takes the least of them that is no less than its quantile. A larger one is
played where a batch's quantile asks for it. The episodes of a setting are one pool. A repetition draws its
calibration and its test episodes from it, none twice, and compares its bound with the rest of the pool (`kept`), whose
rate is as uncertain as the bound, and with all of it (`kept_of_pool`), which holds the tested ones, too. Repetitions
share their episodes; `disjoint` ones, of consecutive episodes, share none.

Two minutes for a batch of 600 episodes, on one core that has nothing else to do.

`monitor` asks how seldom the monitor of a certificate raises a false alarm, and how soon a true one. Episodes violate
or not, independently and with a given probability; no simulator is asked. Promises and rates are those of
results/stress/crossing.csv (stress.py): a guard's upper bound as it was tested, and the rate that was counted with two
more late steps than it knows of.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from common import RESULTS, keep, read, side_by_side, write
from stress import MIDDLE

FOLDER = RESULTS / "stress" / "certificates"
OUT = RESULTS / "stress" / "certificates.csv"
RUN = "crossing-hasty/bc"
MARGINS = (1.0, 1.5, 2.0, 3.0)
SETTINGS: dict[str, dict[str, Any]] = {
    "none": {},
    "delay2": {"delay": 2},
    "asynchrony0.667": {"asynchrony": 0.667},
    "all": MIDDLE,
    "delay3": {"delay": 3},
    "drop0.6": {"drop": 0.6},
}
CALIBRATION, TESTED, QUANTILE, CONFIDENCE = 100, 300, 0.95, 0.95  # of a repetition
BATCH = 600  # episodes
FIRST = 10  # batch of resets; `certify` and `eval` play those before

Pool = dict[str, np.ndarray]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("play", "judge", "monitor"))
    parser.add_argument("--settings", nargs="*", choices=list(SETTINGS), default=list(SETTINGS))
    parser.add_argument("--batches", type=int, default=2)
    parser.add_argument("--episodes", type=int, default=BATCH, help="of a batch")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--repetitions", type=int, default=20)
    parser.add_argument("--folder", type=Path, default=FOLDER)
    parser.add_argument("--out", type=Path, default=OUT)
    a = parser.parse_args()
    if a.what == "judge":
        judge(a.folder, a.out, a.repetitions)
    elif a.what == "monitor":
        monitor(RESULTS / "stress" / "monitor.csv" if a.out == OUT else a.out)
    elif a.jobs > 1:
        same = ["certificates.py", "play", "--batches", str(a.batches), "--episodes", str(a.episodes)]
        same += ["--folder", str(a.folder), "--settings"]
        side_by_side(([*same, setting] for setting in a.settings), a.jobs)
    else:
        for batch in range(a.batches):
            for setting in a.settings:
                play_batch(setting, batch, a.episodes, a.folder)


def file_of(folder: Path, setting: str, margin: float, batch: int) -> Path:
    return folder / f"{setting}-margin{margin:g}-{batch}.json"


def play_batch(setting: str, batch: int, episodes: int, folder: Path) -> None:
    """A batch under every margin up to the first that its own quantile does not exceed."""
    from ringfence.evaluation.certify import conformal

    for margin in MARGINS:
        file = file_of(folder, setting, margin, batch)
        if not file.exists():
            folder.mkdir(parents=True, exist_ok=True)
            file.write_text(json.dumps(played(setting, margin, batch, episodes)) + "\n")
        found = json.loads(file.read_text())
        quantile = conformal(np.array(found["shortfall"]), QUANTILE)
        print(file.name, found["return"], np.mean(found["violated"]), round(quantile, 3), flush=True)
        if quantile <= margin:
            return


def played(setting: str, margin: float, batch: int, episodes: int) -> dict[str, Any]:
    """The shortfall of foresight of each episode behind the setting's faults, and whether it violated."""
    from ringfence.deploy import zoo
    from ringfence.evaluation.certify import shortfalls
    from ringfence.evaluation.compensation import compensated
    from ringfence.evaluation.protocol import rollout
    from ringfence.faults import Faults
    from ringfence.faults.policy import under_faults
    from ringfence.loading.resolve import resolve
    from ringfence.loading.spec import PolicySpec
    from ringfence.utils.compilation import keep_programs

    keep_programs()
    faults = Faults.of(SETTINGS[setting])
    with tempfile.TemporaryDirectory() as runs:
        run = zoo.pretrained(RUN, runs)
        options = compensated(run, faults, {"guard": "shield", "margin": margin})
        resolved = resolve(PolicySpec.of(run, **options))
        task = resolved.job.task
        policy = under_faults(resolved.team, faults, task)
        found = rollout(policy, task.simulator, episodes, "test", 0, 0, setting, True, FIRST + batch, foreseen=True)
        return {
            "setting": setting,
            "margin": margin,
            "shortfall": [round(float(x), 4) for x in shortfalls(resolved, found)],
            "violated": [int(x) for x in found["costs"].sum(1) > 0],
            "return": round(float(found["rewards"].sum(1).mean()), 3),
        }


def pools_of(folder: Path, setting: str) -> dict[float, Pool]:
    """What was played of a setting, all batches of a margin as one."""
    found: dict[float, Pool] = {}
    for margin in MARGINS:
        files = sorted(folder.glob(f"{setting}-margin{margin:g}-*.json"))
        if files:
            stored = [json.loads(file.read_text()) for file in files]
            found[margin] = {
                "shortfall": np.concatenate([one["shortfall"] for one in stored]),
                "violated": np.concatenate([one["violated"] for one in stored]).astype(bool),
            }
    return found


def judge(folder: Path, out: Path, repetitions: int) -> None:
    """A row for each repetition of each setting, and how many of them were kept."""
    rows: list[dict[str, Any]] = []
    for setting in SETTINGS:
        pools = pools_of(folder, setting)
        if not pools:
            continue
        whole = len(next(iter(pools.values()))["violated"])
        for k in range(repetitions):
            orders = {m: np.random.default_rng(k).permutation(len(pool["violated"])) for m, pool in pools.items()}
            rows.append({"setting": setting, "disjoint": False, **repetition(pools, orders)})
        for k in range(whole // (CALIBRATION + TESTED)):
            first = k * (CALIBRATION + TESTED)
            orders = {m: np.roll(np.arange(len(pool["violated"])), -first) for m, pool in pools.items()}
            rows.append({"setting": setting, "disjoint": True, **repetition(pools, orders)})
    if not rows:
        raise SystemExit(f"{folder} holds nothing that was played; run this with `play` first.")
    write(out, rows)
    summary = {"confidence": CONFIDENCE, "drawn": shares(rows, False), "disjoint": shares(rows, True)}
    keep(out.with_suffix(".json"), summary)
    print(json.dumps(summary, indent=1))


def shares(rows: list[dict[str, Any]], disjoint: bool) -> dict[str, Any]:
    """How many repetitions there are, and the shares of them that are kept, and not vacuous."""
    kind = [row for row in rows if row["disjoint"] == disjoint]
    if not kind:
        return {"repetitions": 0}
    return {
        "repetitions": len(kind),
        "kept": round(float(np.mean([row["kept"] for row in kind])), 4),
        "kept_of_pool": round(float(np.mean([row["kept_of_pool"] for row in kind])), 4),
        "not_vacuous": round(float(np.mean([not row["vacuous"] for row in kind])), 4),
        "settings": len({row["setting"] for row in kind}),
    }


def repetition(pools: dict[float, Pool], orders: dict[float, np.ndarray]) -> dict[str, Any]:
    """Calibrated on the first episodes of an order, tested on the next, and compared with the rest."""
    from ringfence.evaluation.certify import conformal
    from ringfence.evaluation.statistics import upper_bound

    margins = sorted(pools)
    margin, agreed, batches, used = margins[0], False, 0, dict.fromkeys(margins, 0)
    while not agreed and batches < 4 and used[margin] + CALIBRATION + TESTED <= len(orders[margin]):
        batch = orders[margin][used[margin] : used[margin] + CALIBRATION]
        used[margin] += CALIBRATION
        batches += 1
        quantile = conformal(pools[margin]["shortfall"][batch], QUANTILE)
        agreed = quantile <= margin
        larger = [m for m in margins if m >= quantile and m > margin]
        if agreed or not (larger or margin < margins[-1]):
            break
        margin = larger[0] if larger else margins[-1]
    order = orders[margin]
    tested = order[used[margin] : used[margin] + TESTED]
    violated = pools[margin]["violated"]
    others = violated[np.setdiff1d(order, tested)]
    bound = upper_bound(int(violated[tested].sum()), len(tested), CONFIDENCE)
    rate = float(others.mean())
    return {
        "margin": margin,
        "calibrated": batches * CALIBRATION,
        "agreed": agreed,
        "bound": round(bound, 4),
        "tested": len(tested),
        "others": len(others),
        "others_rate": round(rate, 4),
        "pool_rate": round(float(violated.mean()), 4),
        "kept": rate <= bound,
        "kept_of_pool": float(violated.mean()) <= bound,
        "vacuous": bound > 3 * float(violated.mean()) + 0.01,
    }


def by_setting(out: Path = OUT) -> dict[str, list[dict[str, str]]]:
    """Rows of the repetitions that were drawn."""
    found: dict[str, list[dict[str, str]]] = defaultdict(list)
    for row in read(out):
        if row["disjoint"] == "False":
            found[row["setting"]].append(row)
    return found


STREAMS, EPISODES = 2000, 500
# What the guard knows, as rows of crossing.csv, and what befalls it: two more late steps.
KNOWS: dict[str, tuple[tuple[str, str, str], tuple[str, str, str]]] = {
    "none": (("none", "shield", "False"), ("delay2", "shield", "False")),
    **{
        f"delay {k}": (
            (f"delay{k}", "shield", "True"),
            (f"delay{k + 2}", f"shield, delay {k}, others_acceleration 1.0", "False"),
        )
        for k in (1, 2)
    },
}


def monitor(out: Path) -> None:
    played = {(r["faults"], r["guard"], r["compensated"]): r for r in read("stress/crossing.csv")}
    rows: list[dict[str, Any]] = []
    for name, (before, after) in KNOWS.items():
        promised = float(played[before]["violation_upper"])
        cases = {"as promised, at most": promised, "as it was played": float(played[before]["violation_rate"])}
        if after in played:
            cases["two more late steps"] = float(played[after]["violation_rate"])
        rows += [{"guard knows": name, "promised": promised, **case(what, promised, r)} for what, r in cases.items()]
    write(out, rows)


def case(what: str, promised: float, rate: float) -> dict[str, Any]:
    """Streams of episodes that violate at this rate, watched against what was promised."""
    rng = np.random.default_rng(0)
    first = np.array([first_alarm(promised, rng.random(EPISODES) < rate) for _ in range(STREAMS)])
    raised = first <= EPISODES
    row = {"episodes": what, "rate": rate, "streams": STREAMS, "length": EPISODES}
    row |= {"alarms": round(float(raised.mean()), 4), "median": "", "nine tenths": ""}
    if raised.mean() >= 0.9:
        row |= {"median": int(np.median(first)), "nine tenths": int(np.quantile(first, 0.9))}
    print(row, flush=True)
    return row


def first_alarm(promised: float, violated: np.ndarray) -> float:
    """The episode after which the alarm is raised; infinite where it never is."""
    from ringfence.evaluation.certificate import Monitor

    monitor = Monitor(promised)
    for k, one in enumerate(violated):
        if monitor.observe(bool(one)):
            return k + 1
    return np.inf


if __name__ == "__main__":
    main()
