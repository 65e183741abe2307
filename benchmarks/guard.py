"""What a World and a guard cost: fitting, and milliseconds of one joint action.

python benchmarks/guard.py                # writes results/performance/guard.json; some minutes, on a quiet machine
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from pathlib import Path

from _common import Rows, record

from ringfence.datasets import registry
from ringfence.datasets.make import make
from ringfence.evaluation.latency import plan_latency
from ringfence.loading.resolve import load
from ringfence.training import loop, worlds

OUT = Path(__file__).resolve().parent.parent / "results" / "performance" / "guard.json"
GUARDS = ("none", "shield", "full")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--tasks", nargs="+", default=["simple_spread-expert", "halfcheetah_2x3-medium", "ant_4x2-medium"]
    )
    parser.add_argument("--out", type=Path, default=OUT)
    a = parser.parse_args()
    row = Rows()
    for name in a.tasks:
        store, _ = make(registry.get(name))
        begun = time.perf_counter()
        world = worlds.fit(store, cached=False)
        row(f"{name}: fitting a World", time.perf_counter() - begun, "s")
        with tempfile.TemporaryDirectory() as folder:
            (run,) = loop.train("bc", store, out=folder, changes={"num_updates": 200}, quiet=True)
            for guard in GUARDS:
                how = {} if guard == "none" else {"guard": guard, "world": world}
                took = plan_latency(load(run, **how)[1], registry.get(name))
                row(f"{name}: cloning, guard {guard}, one joint action, p50", took["plan_ms_p50"], "ms")
                row(f"{name}: cloning, guard {guard}, one joint action, p99", took["plan_ms_p99"], "ms")
    row("peak memory of this benchmark", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, "GiB")
    record(a.out, row)


if __name__ == "__main__":
    main()
