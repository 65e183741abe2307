"""Bounds of the networks of a World, beside those of a library for interval analysis: `pip install immrax`.

    python benchmarks/bounds.py                 # writes results/stress/bounds.json

Boxes lie around states that the logs of Crossing hold. immrax (Harapanahalli, Jafarpour and Coogan 2024) bounds a
function by intervals, operation by operation; ours go backward through the layers. Both are sound, so they have to
meet, and samples of the box lie within both.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import immrax
import jax
import jax.numpy as jnp
import numpy as np
from _common import command

from ringfence.datasets.make import make
from ringfence.datasets.registry import TASKS
from ringfence.deploy import zoo
from ringfence.loading import run_worlds
from ringfence.nets.bounds import Inputs, output_bounds
from ringfence.nets.mlp import MLP

OUT = Path(__file__).resolve().parent.parent / "results" / "stress" / "bounds.json"
BOXES = 200
SAMPLES = 1000  # of a box


def outputs(net: MLP, x: jax.Array) -> jax.Array:
    """(M,) of inputs (F,), in operations that immrax knows."""
    y = x
    for weight, bias in zip(net.weights[:-1], net.biases[:-1]):
        y = jnp.maximum(y @ weight[0] + bias[0], 0.0)
    y = y @ net.weights[-1][0] + net.biases[-1][0]
    return y if net.linear is None else y + x @ net.linear[0]


def compared(net: MLP, centers: jax.Array, radius: float) -> dict:
    """Of boxes (B, F) of that radius."""
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=OUT)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        world = run_worlds.of_run(zoo.pretrained("crossing-hasty/bc", folder))
    store, _ = make(TASKS["crossing-hasty"])
    random = np.random.default_rng(0)
    steps = random.choice(store.steps, BOXES, replace=False)
    row = steps + store.episode_of_step[steps]
    seen = world.map(jnp.asarray(store.observations[row][:, :1]), None)
    read = world.dynamics.read(seen, jnp.asarray(store.actions[steps][:, :1]))[:, 0]
    net = jax.tree.map(lambda x: x[0], world.dynamics.net)
    found = [compared(net, read, radius) for radius in (0.01, 0.05, 0.2)]
    given.out.write_text(json.dumps({"command": command(), "network": "dynamics", "rows": found}, indent=1) + "\n")
    print(*found, sep="\n")


if __name__ == "__main__":
    main()
