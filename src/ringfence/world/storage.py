"""Worlds as files: arrays, and all that is known of them as metadata."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from safetensors import safe_open
from safetensors.numpy import save_file

from ringfence.errors import UserError
from ringfence.problem import features
from ringfence.types import Spec
from ringfence.utils import schemas
from ringfence.utils.config import build_config
from ringfence.utils.files import whole
from ringfence.utils.pytrees import load_named, named_arrays
from ringfence.world import barrier as cbf
from ringfence.world import dynamics, values
from ringfence.world.card import Card
from ringfence.world.model import World
from ringfence.world.settings import Settings


def _blank(map: features.FeatureMap, spec: Spec, s: Settings, names: Sequence[str] = ()) -> World:
    """The shapes of a World, with barriers of the named constraints; nothing is computed, since programs for so many
    small arrays take seconds to compile."""

    def shapes() -> World:
        acts = dynamics.blank_dynamics(map, spec.action_dim, s.members, s.dynamics_width)
        worth = values.blank_values(map, spec.action_dim, s.discount, s.sight == "own")
        danger = _blank_barrier(map, s) if s.barrier else None
        if danger is not None and names:
            danger = cbf.Worst((danger,) * len(names), tuple(names))
        return World(acts, worth, danger, jnp.ones(()), map, spec, s.sight == "own", Card({}))

    return eqx.filter_eval_shape(shapes)


def _blank_barrier(map: features.FeatureMap, s: Settings) -> cbf.Barrier:
    return cbf.blank_barrier(map, s.barrier_width, s.both_ends, s.distances)


def save(
    world: World, path: str | Path, kept: Callable[[np.ndarray, str], np.ndarray] = lambda array, name: array
) -> Path:
    """Write one file, whole or not at all: arrays, as `kept` makes them, and the card as its metadata."""
    path = Path(path)
    about = {"map": features.to_dict(world.map), "spec": world.spec.told(), "card": world.card.told}
    with whole(path) as temporary:
        arrays = {name: kept(array, name) for name, array in named_arrays(world).items()}
        save_file(arrays, temporary, {"ringfence_world": json.dumps(about)})
    return path


def load(
    path: str | Path, map_of: Callable[[str, str, dict], features.FeatureMap | None] = lambda task, view, hazard: None
) -> World:
    """The World in a file. `map_of` gives the view of a simulated task (tasks.py); of own data the file tells all."""
    path = Path(path)
    try:
        with safe_open(path, "numpy") as f:
            about = schemas.decode((f.metadata() or {})["ringfence_world"], schemas.World)
        told = about["card"]
        settings = build_config(Settings, told["settings"], "the World")
        spec = Spec.of(about["spec"])
        map = map_of(spec.task, settings.view, told["data"]["hazard"]) or features.from_dict(about["map"])
        map = features.alone(map) if settings.sight == "own" else map
        if map.names != spec.feature_names:
            raise UserError(f"'{path}' is a World of another view; fit it again.")
        names = told["data"].get("constraints", ()) if settings.labels == "costs" else ()
        world = load_named(path, _blank(map, spec, settings, names))
    except UserError:
        raise
    except Exception as error:  # what is in it may be anything
        raise UserError(
            f"'{path}' is no World that can be read ({type(error).__name__}); fit it again with `ringfence fit`."
        ) from error
    return dataclasses.replace(world, card=Card(told))
