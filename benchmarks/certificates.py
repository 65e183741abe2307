"""Does a certificate keep what it promises? Calibrate and test many times, and count how often fresh episodes violate
no more than it allows.

python benchmarks/certificates.py play --jobs 16       # plays each setting under a few margins, a file each, resumable
python benchmarks/certificates.py judge                # writes results/stress/certificates.csv and .json from these

Episodes of a margin are played once, so margins are those of a grid: a calibration takes the least of them that is no
less than its quantile. A repetition draws its calibration and its test
episodes from what was played, none twice; its bound is compared with all episodes of its margin that it was not tested
on.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import _rows
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / "results" / "stress" / "certificates"
OUT = ROOT / "results" / "stress" / "certificates.csv"
RUN = "crossing-hasty/bc"
MARGINS = (1.0, 1.5, 2.0, 3.0)
SETTINGS: dict[str, dict[str, Any]] = {
    "none": {},
    "delay1": {"delay": 1},
    "delay2": {"delay": 2},
    "drop0.3": {"drop": 0.3},
    "asynchrony0.5": {"asynchrony": 0.5},
    "gain0.8+noise0.005": {"gain": 0.8, "noise": 0.005},
}
CALIBRATION, TESTED, QUANTILE, CONFIDENCE = 100, 300, 0.95, 0.95  # of a repetition; the rest of the episodes are fresh


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("play", "judge"))
    parser.add_argument("--settings", nargs="*", choices=list(SETTINGS), default=list(SETTINGS))
    parser.add_argument("--margins", nargs="*", type=float, default=list(MARGINS))
    parser.add_argument("--episodes", type=int, default=700)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--repetitions", type=int, default=20)
    parser.add_argument("--folder", type=Path, default=FOLDER)
    parser.add_argument("--out", type=Path, default=OUT)
    a = parser.parse_args()
    if a.what == "judge":
        judge(a.folder, a.out, a.repetitions)
        return
    waiting = [(s, m) for m in a.margins for s in a.settings if not file_of(a.folder, s, m).exists()]
    if a.jobs == 1:
        for setting, margin in waiting:
            play(setting, margin, a.episodes, a.folder)
        return
    one_core = {"XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false", "NPROC": "1", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, __file__, "play", "--episodes", str(a.episodes), "--folder", str(a.folder)]
    running: list[subprocess.Popen] = []
    while waiting or running:
        while waiting and len(running) < a.jobs:
            setting, margin = waiting.pop(0)
            one = [*command, "--settings", setting, "--margins", str(margin)]
            running.append(subprocess.Popen(one, env={**os.environ, **one_core}))
        running.pop(0).wait()


def file_of(folder: Path, setting: str, margin: float) -> Path:
    return folder / f"{setting}-margin{margin:g}.json"


def play(setting: str, margin: float, episodes: int, folder: Path) -> None:
    """The shortfall of foresight and the cost of each episode, behind the setting's faults."""
    from ringfence.deploy import zoo
    from ringfence.evaluation.certify import shortfalls
    from ringfence.evaluation.rollout import rollout
    from ringfence.evaluation.stress import compensated
    from ringfence.faults import Faults, under_faults
    from ringfence.loading.resolve import resolve
    from ringfence.loading.spec import PolicySpec

    faults = Faults.of(SETTINGS[setting])
    with tempfile.TemporaryDirectory() as runs:
        run = zoo.pretrained(RUN, runs)
        options = compensated(run, faults, {"guard": "shield", "margin": margin})
        resolved = resolve(PolicySpec.of(run, **options))
        task = resolved.job.task
        policy = under_faults(resolved.team, faults, task)
        played = rollout(policy, task.simulator, episodes, "test", 0, 0, setting, True, 3, foreseen=True)
        found = {
            "setting": setting,
            "margin": margin,
            "shortfall": [round(float(x), 4) for x in shortfalls(resolved, played)],
            "violated": [bool(x) for x in played["costs"].sum(1) > 0],
            "return": round(float(played["rewards"].sum(1).mean()), 3),
        }
    folder.mkdir(parents=True, exist_ok=True)
    file_of(folder, setting, margin).write_text(json.dumps(found) + "\n")
    print(setting, margin, found["return"], np.mean(found["violated"]), flush=True)


def judge(folder: Path, out: Path, repetitions: int) -> None:
    """A row for each repetition of each setting, and how many of them were kept."""
    rows: list[dict[str, Any]] = []
    for setting in SETTINGS:
        played = {m: file_of(folder, setting, m) for m in MARGINS}
        pools = {m: json.loads(file.read_text()) for m, file in played.items() if file.exists()}
        if min(MARGINS) in pools:
            rows += [repetition(setting, pools, np.random.default_rng(k)) for k in range(repetitions)]
    if not rows:
        raise SystemExit(f"{folder} holds nothing that was played; run this with `play` first.")
    _rows.write(out, rows)
    kept = float(np.mean([row["kept"] for row in rows]))
    told = float(np.mean([not row["vacuous"] for row in rows]))
    summary = {"repetitions": len(rows), "kept": kept, "not_vacuous": told, "confidence": CONFIDENCE}
    out.with_suffix(".json").write_text(json.dumps(summary, indent=1) + "\n")
    print(summary)


def repetition(setting: str, pools: dict[float, dict[str, Any]], rng: np.random.Generator) -> dict[str, Any]:
    """Calibrated on some episodes, tested on others, and compared with the rest."""
    from ringfence.evaluation.certify import conformal
    from ringfence.evaluation.statistics import upper_bound

    margins = sorted(pools)
    margin, agreed, batches, used = margins[0], False, 0, {m: 0 for m in margins}
    orders = {m: rng.permutation(len(pools[m]["violated"])) for m in margins}
    while not agreed and batches < 4:
        batch = orders[margin][used[margin] : used[margin] + CALIBRATION]
        used[margin] += CALIBRATION
        batches += 1
        quantile = conformal(np.array(pools[margin]["shortfall"])[batch], QUANTILE)
        agreed = quantile <= margin
        larger = [m for m in margins if m >= quantile and m > margin]
        if agreed or not (larger or margin < margins[-1]):
            break
        margin = larger[0] if larger else margins[-1]
    left = orders[margin][used[margin] :]
    violated = np.array(pools[margin]["violated"])
    tested = violated[left[:TESTED]]
    fresh = violated[np.setdiff1d(np.arange(len(violated)), left[:TESTED])]
    bound = upper_bound(int(tested.sum()), len(tested), CONFIDENCE)
    rate = float(fresh.mean())
    return {
        "setting": setting,
        "margin": margin,
        "calibrated": batches * CALIBRATION,
        "agreed": agreed,
        "bound": round(bound, 4),
        "tested": len(tested),
        "fresh": len(fresh),
        "fresh_rate": round(rate, 4),
        "kept": rate <= bound,
        "vacuous": bound > 3 * rate + 0.01,
    }


if __name__ == "__main__":
    main()
