"""Who the others are that entries number: the team in order, a fixed order of another kind, or whoever is nearest."""

from __future__ import annotations

import copy

import jax.numpy as jnp
import numpy as np
import pytest

from ringfence.errors import UserError
from ringfence.evaluation.replay_scene import motion_of, names_of, windows_of
from ringfence.logs.store import EpisodeStore
from ringfence.problem.features import FeatureMap, from_data, from_dict, to_dict
from ringfence.problem.partners import others
from ringfence.training import worlds
from tests.quick import QUICK_WORLD

N, DT = 4, 0.1
RING = np.array([[(i + step) % N for step in (1, 2, 3)] for i in range(N)])  # next, opposite, previous
MIXED = np.random.default_rng(1).permuted(others(N), axis=1)
NAMES = ("own.x", "own.y", "own.vx", "own.vy")


def walk(order: np.ndarray, listed: bool = False) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Points (E, L+1, N, 4) that are pushed about, and what each sees of others in this order (E, L+1, N, O)."""
    g = np.random.default_rng(0)
    speed = g.normal(size=(20, 31, N, 2)).cumsum(1) * 0.2
    place = g.normal(size=(20, 1, N, 2)) * 3 + DT * speed.cumsum(1)
    own = np.concatenate([place, speed], -1)
    seen = own[:, :, order] - own[:, :, :, None]
    if listed:
        nearest = np.argsort(np.linalg.norm(seen[..., :2], axis=-1), -1)
        seen = np.take_along_axis(seen, nearest[..., None], -2)
    names = [*NAMES, *(f"other{k}.{field}" for k in range(order.shape[1]) for field in ("dx", "dy", "dvx", "dvy"))]
    return own, np.concatenate([own, seen.reshape(*seen.shape[:3], -1)], -1), tuple(names)


def map_of(order: np.ndarray, **how) -> tuple[FeatureMap, np.ndarray]:
    _, x, names = walk(order, **how)
    rows = x.reshape(-1, N, x.shape[-1]).astype(np.float32)
    return from_data("decentralized", rows, None, names, (), np.arange(20) * 31), x


@pytest.mark.parametrize("order", [others(N), RING, RING[:, [0, 2]], MIXED], ids=["team", "ring", "beside", "mixed"])
def test_what_agents_see_of_others_in_an_order_that_stays_follows_from_these(order):
    map, x = map_of(order)
    assert map.follows == tuple(range(4, x.shape[-1])) and not map.mirrored
    assert map.order is None if (order == others(N)[:, : order.shape[1]]).all() else (map.order == order).all()
    steps = np.stack([x[:, 3], x[:, 9]], 1).astype(np.float32)  # (E, 2, N, O)
    planned = steps.copy()
    planned[:, 1, :, 4:] = 7.0  # what nobody planned
    assert np.allclose(np.asarray(map.reconcile(jnp.asarray(planned))), steps, atol=1e-5)
    again = from_dict(to_dict(map))
    assert again == map and hash(again) == hash(map)
    assert np.allclose(np.asarray(again.reconcile(jnp.asarray(planned))), steps, atol=1e-5)


def test_lists_of_the_nearest_have_no_order():
    map, _ = map_of(RING, listed=True)
    assert map.order is None and map.mirrored and not set(map.follows) & set(range(4, 16))


@pytest.mark.parametrize(
    "spoil", [[[0, 1, 2]] * N, [[1, 2, 9]] * N, [[1, 1, 2]] * N, [[1, 2]], [[1], [0, 2], [0], [0]]]
)
def test_an_order_of_nobody_is_refused(spoil):
    damaged = copy.deepcopy(to_dict(map_of(RING)[0])) | {"order": spoil}
    with pytest.raises(UserError, match="its others are none of its agents"):
        from_dict(damaged)


def store_of(order: np.ndarray, **how) -> EpisodeStore:
    own, x, names = walk(order, **how)
    pushes = np.diff(own[..., 2:], axis=1)
    card = {"task": "ring", "observation_names": list(names), "dt": DT, "action_low": -2, "action_high": 2}
    costs = (np.linalg.norm(x[:, 1:, :, 4:6], axis=-1) < 1.0) * 1.0
    return EpisodeStore.from_episodes(x, pushes, np.zeros(pushes.shape[:2]), costs, card=card)


def test_a_world_predicts_a_ring_as_well_as_a_team_in_order():
    settings = QUICK_WORLD | {"dynamics_updates": 600, "barrier": False}
    errors = {}
    for name, order in {"team": others(N), "ring": RING}.items():
        world = worlds.fit(store_of(order), **settings)
        errors[name] = world.card.prediction_error.error_of_change[0]
    assert errors["ring"] < 1.3 * errors["team"]


@pytest.mark.parametrize("how", [{}, {"listed": True}])
@pytest.mark.parametrize("order", [others(N), RING], ids=["team", "ring"])
def test_a_driven_agent_is_seen_by_others_where_it_is(order, how):
    store = store_of(order, **how)
    names = names_of(store)
    windows, _ = windows_of(store, names, motion_of(store, names), np.arange(3), 10, 12, 0.01, DT)
    moved = np.array([0.3, -0.2])
    seen, _ = windows.observed(4, windows.place[:, 4] + moved, windows.velocity[:, 4], np.zeros(windows.count))
    logged = windows.observations[:, 4]
    for w, driven in enumerate(windows.driven):
        own = logged[w, :, :2]
        for j in set(range(N)) - {driven}:
            places = own[j] + seen[w, j, 4:].reshape(-1, 4)[:, :2]
            wanted = np.delete(own, j, 0) + (np.delete(np.arange(N), j) == driven)[:, None] * moved
            assert np.allclose(sorted(places.tolist()), sorted(wanted.tolist()), atol=1e-5)
