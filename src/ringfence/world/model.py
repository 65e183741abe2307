"""The World: a value of parameters, the view that they read, and the card; and a file of arrays, with the card as their
metadata."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import msgspec
import numpy as np
from safetensors import safe_open
from safetensors.numpy import load_file

from ringfence.datasets import registry
from ringfence.errors import UserError
from ringfence.problem import features
from ringfence.problem.constraints import CostColumn, Hazard, from_dict
from ringfence.problem.origins import FIELDS as ORIGINS
from ringfence.problem.origins import Origins
from ringfence.types import Array, Spec
from ringfence.utils import schemas
from ringfence.utils.files import place, regular
from ringfence.utils.precision import in_float32
from ringfence.utils.pytrees import as_tree, digest_of, named_arrays, save_named
from ringfence.world import barrier as cbf
from ringfence.world import dynamics, values
from ringfence.world.card import Card
from ringfence.world.settings import Settings
from ringfence.world.verdict import look_of


class World(eqx.Module):
    """A learned model of a team: what actions do, what states are worth, what is dangerous. Features are s̃_i in the
    view of `map`; actions are in [−1, 1]."""

    dynamics: dynamics.Dynamics
    values: values.Values
    barrier: cbf.Barrier | cbf.MinBarrier | None  # None: the logs have no labels of danger
    ood_threshold: Array  # () ensemble disagreement above which a state is out of distribution: a conformal quantile
    map: features.FeatureMap = eqx.field(static=True)
    spec: Spec = eqx.field(static=True)
    alone: bool = eqx.field(static=True)  # of each agent's own view, for decentralized execution
    card: Card = eqx.field(static=True)

    @property
    def hazard(self) -> Hazard:
        """What the logs' card says is dangerous; costs alone where an older World does not say."""
        told = self.card.data.hazard
        return from_dict(told) if told else CostColumn()

    @property
    def limits(self) -> dict[str, float]:
        """Limit per episode of each constraint that the logs name; empty where they name none."""
        return self.card.data.constraints or {}

    @property
    def widths(self) -> tuple[int | None, int | None]:
        """Entries of an observation and of the global state in the logs; None where an older World does not say."""
        return self.card.data.observation_width, self.card.data.state_width

    @property
    def origins(self) -> Origins:
        """What was taken from entries of the logs, and is taken from what is given at run time."""
        data = self.card.data
        return Origins.of({name: getattr(data, name) for name in ORIGINS})

    @property
    def unsafe_steps(self) -> dict[str, float]:
        """Unsafe steps of an episode that each limit allows, which is no question of the costs' units."""
        costs = self.card.data.unsafe_costs or {}
        return {name: limit / costs.get(name, 1.0) for name, limit in self.limits.items()}


# --- as a file ---


def blank_world(
    map: features.FeatureMap, spec: Spec, settings: Settings, constraints: Iterable[str] = (), card: Card | None = None
) -> World:
    """The shapes of a World, with barriers of the named constraints; nothing is computed, since programs for so many
    small arrays take seconds to compile."""

    def shapes() -> World:
        moving = map if card is not None and card.data.partners else replace(map, mirrored=())
        acts = dynamics.blank_dynamics(moving, spec.action_dim, settings.num_ensemble, settings.dynamics_width)
        if card is not None:
            acts = replace(acts, stops=card.data.stops)
        value = values.blank_values(map, spec.action_dim, settings.discount, settings.alone)
        causes = card.causes if card else {}
        names = tuple(constraints)
        barrier = cbf.blank_barrier(map, settings, causes.get("")) if settings.barrier else None
        if barrier is not None and names:
            each = tuple(cbf.blank_barrier(map, settings, causes.get(name)) for name in names)
            barrier = cbf.MinBarrier(each, names)
        return World(acts, value, barrier, jnp.ones(()), map, spec, settings.alone, card or Card())

    return eqx.filter_eval_shape(shapes)


@in_float32
def save(
    world: World, path: str | Path, kept: Callable[[np.ndarray, str], np.ndarray] = lambda array, name: array
) -> Path:
    """Write one file, whole or not at all: arrays, as `kept` makes them, and the card as its metadata."""
    path = place(path)
    about: dict[str, Any] = {
        "map": features.to_dict(world.map),
        "spec": world.spec.to_dict(),
        "card": world.card.to_json(),
    }
    arrays = {name: kept(array, name) for name, array in named_arrays(world).items()}
    about["digest"] = _digest(arrays, about)
    save_named(path, arrays, {"ringfence_world": json.dumps(about)})
    return path


def _digest(arrays: dict[str, np.ndarray], about: Mapping[str, Any]) -> str:
    """Of all that a file holds but the digest itself."""
    words = json.dumps({name: value for name, value in about.items() if name != "digest"}, sort_keys=True)
    return digest_of([*sorted(arrays.items()), ("about", np.frombuffer(words.encode(), np.uint8))])


@in_float32
def load(path: str | Path, map: features.FeatureMap | None = None) -> World:
    """The World in a file that `save` or `ringfence fit --out` wrote, or in a run folder. `map`: its view, if it is
    known; else that of the task's simulator, and of own data the file says all of it."""
    path = place(path)
    try:
        regular(path)
    except ValueError as error:
        raise UserError(f"'{path}' is no World that can be read ({error}); fit one with `ringfence fit`.") from None
    try:
        return _read(path, map)
    except UserError:
        raise
    except Exception as error:  # what is in it may be anything
        raise UserError(
            f"'{path}' is no World that can be read ({type(error).__name__}); fit it again with `ringfence fit`."
        ) from error


def _read(path: Path, map: features.FeatureMap | None) -> World:
    with safe_open(path, "numpy") as file:
        about = schemas.decode((file.metadata() or {})["ringfence_world"], schemas.World)
    raw = load_file(path)
    if about.get("digest", _digest(raw, about)) != _digest(raw, about):  # a stranger may tell none
        raise UserError(f"'{path}' holds another World than was written (its digest differs); fit or copy it again.")
    for name, array in raw.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise UserError(f"'{path}' holds numbers in '{name}' that are not finite; fit it again.")
    card = Card.from_json(about["card"])
    card = card if card.look is not None else msgspec.structs.replace(card, look=look_of(card))
    spec = Spec.of(about["spec"])
    settings = card.settings
    if map is None:
        known = registry.simulated(spec.task, from_dict(card.data.hazard))
        map = features.from_dict(dict(about["map"])) if known is None else known.feature_map(settings.view)
    if settings.alone:
        map = features.alone(map)
    if map.names != spec.feature_names:
        raise UserError(f"'{path}' is a World of another view; fit it again.")
    names = (card.data.constraints or ()) if settings.labels == "costs" else ()
    beyond = map.beyond(card.data.observation_width, card.data.state_width)
    if beyond is not None:
        raise UserError(f"'{path}' reads {beyond} in its logs; fit it again.")
    if not all(stop.fits(map) for stop in card.data.stops):
        raise UserError(
            f"'{path}' has stops of agents or entries that it does not know, or where no log ends; fit it again."
        )
    if map.plus.shape[0] != spec.n_agents:
        raise UserError(f"'{path}' is of {spec.n_agents} agents and sees {map.plus.shape[0]}; fit it again.")
    return as_tree(raw, blank_world(map, spec, settings, names, card), path)
