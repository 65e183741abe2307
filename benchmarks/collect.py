"""Wall time and peak memory of collecting 1 M transitions of Simple Spread's medium tier.

    python benchmarks/collect.py

Prints the measurements and writes them to results/performance/collect.json: a list of objects with name, value, unit,
command and machine. Times include compilation, since a user waits for that too.
"""

from __future__ import annotations

import json
import os
import platform
import resource
import sys
import time
from pathlib import Path

TRANSITIONS = 1_000_000
OUT = Path(__file__).parents[1] / "results" / "performance" / "collect.json"


def machine() -> str:
    """Processor, the cores that this process may use, and Python's and JAX's versions."""
    import jax

    info = Path("/proc/cpuinfo")
    names = [line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")]
    cpu = names[0] if names else platform.processor() or platform.machine()
    cores = len(os.sched_getaffinity(0))
    return f"{cpu}, {cores} cores, Python {platform.python_version()}, JAX {jax.__version__} on {jax.default_backend()}"


def peak_mebibytes() -> float:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)  # kB on Linux, bytes on macOS


def main() -> None:
    start = time.perf_counter()
    import jax

    from ringfence.datasets.behaviour import collect, shipped_policy, statistics
    from ringfence.envs.simple_spread import SimpleSpread

    imported = time.perf_counter()
    env = SimpleSpread()
    data = collect(env, shipped_policy("medium"), TRANSITIONS // env.episode_length, jax.random.key(0))
    collected = time.perf_counter()
    peak = peak_mebibytes()
    rows = [
        ("collect medium, 1 M transitions: wall time", collected - imported, "s"),
        ("collect medium, 1 M transitions: imports", imported - start, "s"),
        ("collect medium, 1 M transitions: peak resident memory", peak, "MiB"),
        ("collect medium, 1 M transitions: size of the arrays", sum(x.nbytes for x in data.values()) / 2**20, "MiB"),
        ("collect medium, 1 M transitions: mean return", statistics(data)["return_mean"], "return per episode"),
    ]
    where = machine()
    report = [
        {
            "name": name,
            "value": round(value, 2),
            "unit": unit,
            "command": "python benchmarks/collect.py",
            "machine": where,
        }
        for name, value, unit in rows
    ]
    OUT.parent.mkdir(parents=True, exist_ok=True)
    temporary = OUT.with_suffix(".json.tmp")
    temporary.write_text(json.dumps(report, indent=1) + "\n")
    os.replace(temporary, OUT)
    for row in report:
        print(f"{row['name']}: {row['value']} {row['unit']}")


if __name__ == "__main__":
    main()
