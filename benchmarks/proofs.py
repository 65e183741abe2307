"""Proofs in a World: how often an action is proved, and whether bounds of its networks are those of others.

    python benchmarks/proofs.py rates     # results/stress/proof.json, a row for each size of errors
    python benchmarks/proofs.py bounds    # results/stress/bounds.json; `pip install immrax`

`bounds`: boxes lie around states that the logs of Crossing hold. immrax (Harapanahalli, Jafarpour and Coogan 2024)
bounds a function by intervals, operation by operation; ours go backward through the layers. Both are sound, so they
have to meet, and samples of the box lie within both. `speed.py proof` measures what a proof takes.
"""

from __future__ import annotations

import argparse
import tempfile

import jax
import jax.numpy as jnp
import numpy as np
from common import RESULTS, command, keep, of_json

from ringfence.datasets.make import make
from ringfence.datasets.registry import TASKS
from ringfence.deploy import zoo
from ringfence.evaluation.stress import stress
from ringfence.guards.proof import Inputs, output_bounds
from ringfence.nets.layers import MLP
from ringfence.training import worlds

RUN = "crossing-hasty/bc"
KEPT = ("return_mean", "violation_rate", "violation_upper", "infeasible_rate", "proved_rate", "agent_proved_rate")
BOXES, SAMPLES = 200, 1000  # of a box


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("rates", "bounds"))
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--epsilons", type=float, nargs="*", default=[0.005, 0.02, 0.05])
    a = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        run = zoo.pretrained(RUN, folder)
        if a.what == "bounds":
            bounds(run)
            return
        out, rows = RESULTS / "stress" / "proof.json", of_json("stress/proof.json")
        for epsilon in a.epsilons:
            name = f"epsilon {epsilon:g}, without backup"
            if name not in rows:
                found = stress(run, {}, episodes=a.episodes, guard="shield", proof=epsilon)
                rows[name] = {"episodes": a.episodes, **{k: round(found[k], 4) for k in KEPT}}
                print(name, rows[name], flush=True)
                keep(out, rows)


def outputs(net: MLP, x: jax.Array) -> jax.Array:
    """(M,) of inputs (F,), in operations that immrax knows."""
    y = x
    for weight, bias in zip(net.weights[:-1], net.biases[:-1]):
        y = jnp.maximum(y @ weight[0] + bias[0], 0.0)
    y = y @ net.weights[-1][0] + net.biases[-1][0]
    return y if net.linear is None else y + x @ net.linear[0]


def compared(net: MLP, centers: jax.Array, radius: float) -> dict:
    """Of boxes (B, F) of that radius."""
    import immrax

    boxes = Inputs(centers, None, jnp.full_like(centers, radius))
    low, high = output_bounds(net, boxes)
    included = immrax.natif(lambda x: outputs(net, x))
    wide = jax.jit(jax.vmap(lambda x: included(immrax.icentpert(x, radius))))(centers)
    shift = jax.random.uniform(jax.random.key(1), (SAMPLES, *centers.shape), minval=-radius, maxval=radius)
    shown = jax.vmap(net)(centers + shift)
    ours, theirs = high - low, wide.upper - wide.lower
    return {
        "radius": radius,
        "boxes": len(centers),
        "meet": float(((low <= wide.upper) & (high >= wide.lower)).mean()),
        "samples_beyond_ours": int(((shown < low) | (shown > high)).sum()),
        "samples_beyond_theirs": int(((shown < wide.lower) | (shown > wide.upper)).sum()),
        "width_as_share_of_theirs": round(float(np.median(ours / theirs)), 4),
    }


def bounds(run) -> None:
    world = worlds.of_run(run)
    store, _ = make(TASKS["crossing-hasty"])
    steps = np.random.default_rng(0).choice(store.steps, BOXES, replace=False)
    row = steps + store.episode_of_step[steps]
    seen = world.map(jnp.asarray(store.observations[row][:, :1]), None)
    read = world.dynamics.read(seen, jnp.asarray(store.actions[steps][:, :1]))[:, 0]
    net = jax.tree.map(lambda x: x[0], world.dynamics.net)
    found = [compared(net, read, radius) for radius in (0.01, 0.05, 0.2)]
    keep(RESULTS / "stress" / "bounds.json", {"command": command(), "network": "dynamics", "rows": found})
    print(*found, sep="\n")


if __name__ == "__main__":
    main()
