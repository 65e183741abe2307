"""The World: what is learned of the logs before and without a policy."""

import dataclasses
import shutil
import types

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors import SafetensorError

from ringfence import guards, world
from ringfence.cli import app
from ringfence.datasets import registry
from ringfence.envs import SimpleSpread
from ringfence.errors import UserError
from ringfence.guards.wrap import Nothing
from ringfence.problem import constraints, features
from ringfence.problem.features import FeatureMap
from ringfence.training import worlds
from ringfence.world import Settings, judging, margins
from ringfence.world import barrier as cbf
from tests.quick import IN_FULL, LITTLE, QUICK_WORLD


def with_costs(store, costs, task="mine"):
    card = store.card.updated(task=task, hazard={"kind": "CostColumn"})
    return dataclasses.replace(store, costs=np.asarray(costs, np.float32), card=card)


def test_a_world_is_fitted_once_and_survives_its_file(small_store, small_world, tmp_path, monkeypatch):
    """From the cache the second time, to the last bit; and from a file of its own."""
    monkeypatch.setattr("ringfence.world.dynamics.regress", lambda *_, **__: pytest.fail("it was fitted again"))
    again = worlds.fit(small_store, **QUICK_WORLD)
    loaded = world.load(world.save(small_world, tmp_path / "w.safetensors"))
    for other in (again, loaded):
        for a, b in zip(jax.tree.leaves(small_world), jax.tree.leaves(other), strict=True):
            np.testing.assert_array_equal(a, b)
    assert loaded.card.seed == 0 and str(loaded.card) == str(small_world.card)
    (tmp_path / "w.safetensors").write_bytes(b"none")
    with pytest.raises(UserError, match="is no World that can be read"):
        world.load(tmp_path / "w.safetensors")


def test_a_world_of_other_data_in_the_cache_is_not_taken(small_store, tmp_path, monkeypatch):
    """Nor a part of one, which somebody has put under its name."""
    monkeypatch.setenv("RINGFENCE_HOME", str(tmp_path))
    other = dataclasses.replace(small_store, costs=np.roll(small_store.costs, 3, 0))
    theirs = worlds.fit(other, **QUICK_WORLD)
    names = {file.name for file in (tmp_path / "worlds").iterdir()}
    mine = worlds.fit(small_store, **QUICK_WORLD)
    added = {file.name for file in (tmp_path / "worlds").iterdir()} - names
    for kind in ("world", "future"):
        (here,) = (name for name in added if name.startswith(kind))
        (there,) = (name for name in names if name.startswith(kind))
        shutil.copy(tmp_path / "worlds" / there, tmp_path / "worlds" / here)
    again = worlds.fit(small_store, **QUICK_WORLD)
    assert again.card.data.content == small_store.content != theirs.card.data.content
    for a, b in zip(jax.tree.leaves(mine), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_world_of_other_data_in_a_run_is_refused(small_store, small_world, tmp_path):
    """Though its task is called the same, and its agents act alike."""
    world.save(small_world, tmp_path / "guard.safetensors")
    card = worlds.card_of(small_store)
    config = {"task": card["task"], "seed": 0, "spec": {"action_dim": 2}, "hazard": card["hazard"]}
    mine, others = (
        types.SimpleNamespace(path=tmp_path, config=config | {"data": card | {"content": content}})
        for content in (small_store.content, "another")
    )
    assert worlds.for_guard(mine, "centralized").card == small_world.card
    with pytest.raises(UserError, match="is a World of '.*', the run '.*' of other data"):
        worlds.for_guard(others, "centralized")


@pytest.mark.parametrize("change", [{"miscoverage": 2}, {"miscoverage": -1}, {"miscoverage": "nan"}, {"discount": 1.5}])
def test_settings_are_refused_before_any_data_is_made(change, capsys, monkeypatch):
    monkeypatch.setattr("ringfence.datasets.make.make", lambda *_, **__: pytest.fail("data were made"))
    (name,) = change
    with pytest.raises(SystemExit):
        app.main(["fit", "simple_spread-expert", "--set", f"{name}={change[name]}"])
    assert f"{name}=" in capsys.readouterr().err


def test_a_cache_that_takes_no_world_is_said(small_store, monkeypatch, tmp_path):
    """Before anything is fitted, or, where the disk fills meanwhile, in a sentence; either names what to set."""
    full = SafetensorError("Error while serializing: No space left on device (os error 28)")
    with monkeypatch.context() as patch:
        patch.setenv("RINGFENCE_HOME", "/proc/nothing")
        patch.setattr("ringfence.world.fit.Logged.of", lambda *_: pytest.fail("it was begun"))
        with pytest.raises(UserError, match="could not be written.*; set RINGFENCE_HOME to another folder"):
            worlds.fit(small_store, **QUICK_WORLD)
    monkeypatch.setenv("RINGFENCE_HOME", str(tmp_path))
    monkeypatch.setattr("ringfence.utils.pytrees.save_file", lambda *_, **__: (_ for _ in ()).throw(full))
    with pytest.raises(UserError, match="No space left.*free some space or set RINGFENCE_HOME"):
        worlds.fit(small_store, **QUICK_WORLD)
    assert not list(tmp_path.rglob("*.safetensors")) and not list(tmp_path.rglob("*.part"))


def test_what_judges_a_world_is_set_and_kept_apart(small_store, small_world, monkeypatch):
    """Of the same parts: a card says what was asked."""
    monkeypatch.setattr(judging, "JUDGING", dataclasses.replace(LITTLE, ahead=2))
    again = worlds.fit(small_store, **QUICK_WORLD)
    assert again.card.prediction_error.steps_ahead == (1, 2)
    assert small_world.card.prediction_error.steps_ahead == tuple(range(1, LITTLE.ahead + 1))
    assert eqx.tree_equal(again.dynamics.net, small_world.dynamics.net)
    assert again.card.barrier.avoidable is None and np.isnan(again.card.barrier.searched), "none is asked about"


def test_two_loads_of_a_world_are_one_to_the_compiler(small_world, tmp_path):
    """A guard of either is the same program: static fields are compared by content."""
    file = world.save(small_world, tmp_path / "w.safetensors")
    traced = []

    @jax.jit
    def start(guarded):
        traced.append(guarded)
        return guarded.initial_state(1)

    for _ in range(2):
        loaded = world.load(file)
        start(guards.policy.build(Nothing(), loaded, constraints.Separation(), "shield", "both"))
    assert len(traced) == 1
    others = [dataclasses.replace(loaded.map, view="other"), dataclasses.replace(loaded.map, plus=loaded.map.plus + 1)]
    assert all(loaded.map != other for other in others) and loaded.map == dataclasses.replace(loaded.map)


class Head(eqx.Module):
    """Two cars in a lane, features (gap, closing speed), that brake by at most 1 m/s²: dynamics and barrier in one."""

    shape: object = eqx.field(static=True, default=None)

    def step(self, x, action):
        speed = x[..., 1] - 0.1 * action.mean((-1, -2))[..., None]
        return jnp.stack([x[..., 0] - 0.1 * speed, speed], -1), jnp.zeros(x.shape[:-1])

    def of_steps(self, before, after):
        return after[..., 0]


def test_the_card_says_how_far_ahead_danger_is_decided():
    """Cars that close in at 1 m/s stop in half a metre: from five steps before it is too late, from seven it is not."""
    gap = 1.93 - 0.1 * np.arange(21)
    x = np.stack([gap, np.ones(21)], -1)[:, None].repeat(2, 1)
    arrays = {"features": jnp.asarray(x, jnp.float32), "actions": jnp.zeros((20, 2, 1))}
    arrays |= {"row": np.arange(20), "first_row": np.zeros(20, int), "last_row": np.full(20, 20)}
    entered = np.array([19])  # the step that ends with a gap below 0
    found = judging._avoidable(Head(), Head(), arrays, entered, IN_FULL)
    assert found.before == IN_FULL.before[:-1] and found.rows == 7  # the log is 20 steps long
    assert found.avoided == (0, 0, 0, 0, 1, 1, 1, 1)


def test_held_out_episodes_are_whole_and_differ_between_seeds(small_store):
    from ringfence.world.logged import held_out

    a, b = held_out(small_store, 0), held_out(small_store, 1)
    assert a.sum() == b.sum() == 4 and (a != b).any()
    few = small_store.select(np.arange(small_store.episodes) < 4)
    with pytest.raises(UserError, match="has 4 episodes, too few to hold some out"):
        worlds.fit(few, **QUICK_WORLD)


@pytest.mark.parametrize(("value", "said"), [(0.0, "No step of 'mine' is unsafe"), (1.0, "No step of 'mine' is safe")])
def test_costs_that_tell_nothing_are_refused(small_store, value, said):
    with pytest.raises(UserError, match=said):
        worlds.fit(with_costs(small_store, np.full(small_store.steps, value)), **QUICK_WORLD, barrier=True)
    assert worlds.fit(with_costs(small_store, np.full(small_store.steps, value)), **QUICK_WORLD).barrier is None


def test_a_formula_that_is_not_there_is_refused(small_store):
    with pytest.raises(UserError, match="labels='formula' needs a formula of danger"):
        worlds.fit(with_costs(small_store, small_store.costs), **QUICK_WORLD, labels="formula")
    with pytest.raises(UserError, match="did you mean 'num_ensemble'"):
        worlds.fit(small_store, num_ensembles=3)


def test_names_tell_who_is_who():
    """Pairs of own movement and each other; the own net reads what is about nobody else; bodies are read whole."""
    spread = SimpleSpread().feature_map("pruned")
    shape = cbf.shape_of(spread)
    (kind, pairs), *more = shape.pairs
    assert kind == "other" and not more and len(pairs) == 2 and shape.groups == 1 and shape.blame == "worst"
    read = [spread.names[d] for d in pairs[1]]
    assert read == ["own.vx", "own.vy", "other1.dvx", "other1.dvy", "other1.dx", "other1.dy"] or sorted(read) == sorted(
        ["own.vx", "own.vy", "other1.dvx", "other1.dvy", "other1.dx", "other1.dy"]
    )
    assert "own.x" in [spread.names[d] for d in shape.own]
    body = cbf.shape_of(registry.get("ant_4x2-poor").feature_map("pruned"))
    assert body.joint and body.blame == "all" and body.use_transition and not body.pairs
    table = np.zeros((2, 3), int)
    unnamed = FeatureMap("pruned", ("a", "b", "c"), "observations", table, table - 1)
    assert cbf.shape_of(unnamed).groups == 2 and not cbf.shape_of(unnamed).pairs


def test_the_worst_agent_explains_the_teams_cost():
    """Three points on a line, one cost for all when any two are within 0.1: who was near is found out, and an offset
    turned
    by any angle scores the same in distance."""
    rng = np.random.default_rng(0)
    p = rng.uniform(-1, 1, (4000, 3, 2))
    gap = np.stack([p[:, [j for j in range(3) if j != i]] - p[:, i : i + 1] for i in range(3)], 1)  # (M, N, 2, 2)
    x = np.concatenate([p, gap.reshape(len(p), 3, 4)], -1).astype(np.float32)
    names = ("own.x", "own.y", "other0.dx", "other0.dy", "other1.dx", "other1.dy")
    table = np.tile(np.arange(6), (3, 1))
    map = FeatureMap("pruned", names, "observations", table, table * 0 - 1)
    near = np.linalg.norm(gap, axis=-1).min(-1) < 0.3  # (M, N)
    unsafe = near.any(-1)[1:]
    settings = Settings(barrier_updates=800, barrier_width=32)
    blank = cbf.blank_barrier(map, settings)
    data = jnp.asarray(x), jnp.asarray(x[1:]), jnp.arange(len(x) - 1), jnp.asarray(unsafe)
    steps = np.arange(len(x) - 1)
    fitted = cbf.fit_label(blank, data, steps[unsafe], steps[~unsafe], jax.random.key(0), settings)
    h = np.asarray(fitted.of_steps(jnp.asarray(x), jnp.asarray(x)))
    assert ((h < 0) == near).mean() > 0.95  # each agent's own danger, though no label named it
    assert np.abs(h).max() <= cbf.FARTHEST


def test_danger_is_seen_ahead():
    """A point that runs into a wall and cannot turn: V tells it long before ℓ does."""
    rng = np.random.default_rng(0)
    episodes, steps = 300, 12
    v = rng.uniform(-1, 1, (episodes, 1))
    x = rng.uniform(-0.5, 0.5, (episodes, 1)) + 0.1 * v * np.arange(steps + 1)
    rows = np.stack([x, np.repeat(v, steps + 1, 1)], -1).reshape(-1, 1, 2).astype(np.float32)
    row = (np.arange(episodes)[:, None] * (steps + 1) + np.arange(steps)).ravel()
    unsafe = rows[row + 1, 0, 0] > 0.8
    table = np.zeros((1, 2), int)
    settings = Settings(barrier_updates=500, barrier_width=32, future_discount=0.9, expectile=0.9, future_updates=1)
    blank = cbf.blank_barrier(FeatureMap("pruned", ("x", "v"), "observations", table, table - 1), settings)
    data = jnp.asarray(rows), jnp.asarray(rows[row + 1]), jnp.asarray(row), jnp.asarray(unsafe)
    every = np.arange(len(row))
    fitted = cbf.fit_label(blank, data, every[unsafe], every[~unsafe], jax.random.key(0), settings)
    arrays = {"features": data[0], "row": data[2], "terminated": jnp.zeros(len(row), bool)}
    start = cbf.fit_future(fitted, arrays, every, every[:0], jax.random.key(1), settings)
    np.testing.assert_allclose(start.ahead(data[0]), fitted.of_steps(data[0], data[0]), atol=1.0)  # it begins as ℓ
    settings = dataclasses.replace(settings, future_updates=1000)
    ahead = cbf.fit_future(fitted, arrays, every, every[unsafe], jax.random.key(1), settings)
    doomed, fine = jnp.asarray([[[0.4, 0.9]]]), jnp.asarray([[[0.4, -0.9]]])
    assert fitted.of_steps(doomed, doomed) > 0 and fitted.of_steps(fine, fine) > 0
    assert ahead.ahead(doomed) < 0 < ahead.ahead(fine)


def test_conformal_quantiles_cover_what_they_say():
    rng = np.random.default_rng(0)
    covered = [rng.normal() <= margins.conformal(rng.normal(size=99), 0.9) for _ in range(4000)]
    assert np.mean(covered) == pytest.approx(0.9, abs=0.02)
    assert margins.conformal(np.arange(5.0), 0.99) == 4.0  # too few to say more


def test_own_entries_tell_the_rest_where_the_logs_agree(played):
    """Offsets and relative velocities of anybody's data follow from everybody's own movement; one that does not is
    predicted. A state that repeats what is observed adds nothing."""
    view = SimpleSpread().feature_map("pruned")
    x = view(None, played["state"]).reshape(-1, 3, 18)
    state = played["state"].reshape(len(x), -1)
    odd = x.copy()
    odd[..., view.names.index("other0.dx")] = np.random.default_rng(0).normal(size=x.shape[:2])
    firsts = np.arange(0, len(x), 26)
    names = tuple(f"s{k}" for k in range(state.shape[1]))
    found = features.from_data("pruned", x, state, view.names, names, firsts)
    assert found.names == view.names and set(found.own) == set(view.own)
    again = features.from_dict(features.to_dict(found))
    plan = jnp.asarray(x[:8].reshape(1, 8, 3, 18) + 0.1)
    np.testing.assert_allclose(again.reconcile(plan), view.reconcile(plan), atol=1e-5)
    broken = features.from_data("pruned", odd, None, view.names, (), firsts)
    assert view.names.index("other0.dx") in broken.own


def test_a_hazard_keeps_what_it_reads(small_store):
    card = small_store.card.updated(task="mine", observation_names=None, hazard=constraints.Separation(0.3))
    own = dataclasses.replace(small_store, card=card)
    task = registry.from_store(own)
    assert {"agent0.x", "agent2.y"} <= set(task.feature_map("pruned", own).names)


def test_costs_per_agent_label_agents(small_store):
    """(T, N) costs: the team's is the largest, and every agent learns from its own."""
    view = SimpleSpread().feature_map("pruned")
    bound = constraints.bind(constraints.Separation(), view.names, 3)
    row = np.arange(small_store.steps) + small_store.episode_of_step + 1
    each = np.asarray(bound.labels(jnp.asarray(view(None, small_store.state[row])))[0])
    own = with_costs(small_store, each)
    np.testing.assert_array_equal(own.team_costs, each.any(1))
    np.testing.assert_array_equal(own.episode_costs, small_store.episode_costs)
    assert worlds.fit(own, **QUICK_WORLD).barrier is not None
