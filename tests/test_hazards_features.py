"""Hazards against brute force, and the views of the state against the simulator's own observations."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ringfence.datasets import registry
from ringfence.envs import SimpleSpread
from ringfence.errors import UserError
from ringfence.logs.store import EpisodeStore
from ringfence.logs.windows import NOT_ARRIVED
from ringfence.problem import constraints, features

VIEWS = features.VIEWS


@pytest.fixture(scope="module")
def rows(played):
    """(observations (M, 3, 18), state (M, 18)) of real states, contacts among them."""
    return played["observations"][:, ::3].reshape(-1, 3, 18), played["state"][:, ::3].reshape(-1, 18)


def views_of(rows, view):
    table = SimpleSpread().feature_map(view)
    return table, table(*rows)


def distances(state):
    """(M, N) distance to the nearest other agent, by loops."""
    n = state.shape[1] // 6
    out = np.full((len(state), n), np.inf)
    for m, s in enumerate(state.astype(np.float64)):
        for i in range(n):
            for j in range(n):
                if i != j:
                    out[m, i] = min(out[m, i], np.hypot(*(s[2 * i : 2 * i + 2] - s[2 * j : 2 * j + 2])))
    return out


# ---------------------------------------------------------------------------------------------------------------------
# hazards


@pytest.mark.parametrize("view", VIEWS)
def test_clearance_is_distance_less_radius(rows, view):
    table, x = views_of(rows, view)
    bound = constraints.bind(constraints.Separation(0.30), table.names, 3)
    expected = distances(rows[1]) - 0.30
    np.testing.assert_allclose(bound.clearance(jnp.asarray(x)), expected, atol=1e-5)
    unsafe, safe = bound.labels(jnp.asarray(x))
    clear = np.abs(expected) > 1e-4
    assert (np.asarray(unsafe) == (expected < 0))[clear].all() and unsafe.any()
    margin = np.abs(expected - 0.075) > 1e-4
    assert (np.asarray(safe) == (expected >= 0.075))[margin].all()
    assert not (np.asarray(unsafe) & np.asarray(safe)).any()
    assert not (np.asarray(unsafe) | np.asarray(safe)).all()  # between them, neither


@pytest.mark.parametrize("view", VIEWS)
def test_gradient_of_clearance_is_finite_even_where_agents_coincide(rows, view):
    table, x = views_of(rows, view)
    bound = constraints.bind(constraints.Separation(0.30), table.names, 3)
    x = np.concatenate([x[:20], np.zeros_like(x[:1])])  # the last row: everybody at the same point
    gradient = jax.jit(jax.grad(lambda x: bound.clearance(x).sum()))(jnp.asarray(x))
    assert np.isfinite(gradient).all()
    assert (np.abs(gradient[:-1]).sum(-1) > 0.5).all()  # a unit step away from the nearest one


def test_absent_features_are_named_with_the_nearest():
    names = SimpleSpread().feature_map("pruned").names
    with pytest.raises(UserError, match=r"'other2\.dx'.*did you mean 'other[01]\.d.'"):
        constraints.bind(constraints.Separation(), names, 4)
    with pytest.raises(UserError, match=r"SpeedLimit reads the feature 'own\.vz'.*did you mean 'own\.v.'"):
        constraints.bind(constraints.SpeedLimit(1.0, ("own.vx", "own.vz")), names, 3)
    with pytest.raises(UserError, match="at least 2 agents"):
        constraints.bind(constraints.Separation(), SimpleSpread(n_agents=1).feature_map("pruned").names, 1)


def test_speed_limit(rows):
    table, x = views_of(rows, "pruned")
    x = np.concatenate([x, np.zeros_like(x[:5])])  # some at rest
    bound = constraints.bind(constraints.SpeedLimit(0.8, ("own.vx", "own.vy")), table.names, 3)
    speed = np.hypot(x[..., 0], x[..., 1])
    labels = jax.jit(bound.labels)
    np.testing.assert_allclose(jax.jit(bound.clearance)(x), 0.8 - speed, atol=1e-5)
    assert bound.safe_margin == pytest.approx(0.16)
    unsafe, safe = map(np.asarray, labels(x))
    assert unsafe.any() and safe.any()
    np.testing.assert_array_equal(unsafe, speed > 0.8)


def test_all_is_the_smallest_clearance(rows):
    table, x = views_of(rows, "pruned")
    parts = constraints.Separation(), constraints.SpeedLimit(0.8, ("own.vx", "own.vy"))
    bound = constraints.bind(constraints.All(parts), table.names, 3)
    each = [np.asarray(jax.jit(constraints.bind(p, table.names, 3).clearance)(x)) for p in parts]
    labels = [constraints.bind(p, table.names, 3).labels(x) for p in parts]
    unsafe, safe = bound.labels(x)
    np.testing.assert_array_equal(unsafe, labels[0][0] | labels[1][0])
    np.testing.assert_array_equal(safe, labels[0][1] & labels[1][1])  # metres and m/s by margins of their own
    clearance = jax.jit(bound.clearance)
    np.testing.assert_allclose(clearance(x), np.minimum(each[0], each[1] * 0.075 / 0.16), atol=1e-6)
    np.testing.assert_array_equal(safe, clearance(x) >= bound.safe_margin)  # so one share of the margin suits both
    with pytest.raises(UserError, match="safe_margin above 0"):
        constraints.bind(constraints.All((parts[0], constraints.SpeedLimit(0.8, ("own.vx",), 0.0))), table.names, 3)
    with pytest.raises(UserError, match="a formula for each"):
        constraints.bind(constraints.All((constraints.CostColumn(),)), table.names, 3)
    with pytest.raises(UserError, match="at least one hazard"):
        constraints.bind(constraints.All(()), table.names, 3)


def test_cost_column_labels_only_what_was_logged(rows):
    table, x = views_of(rows, "pruned")
    bound = constraints.bind(constraints.CostColumn(), table.names, 3)
    assert not bound.has_formula
    unsafe, safe = bound.labels(jnp.asarray(x[:3]), jnp.array([0.0, 2.0, NOT_ARRIVED]))
    assert unsafe.tolist() == [[False] * 3, [True] * 3, [False] * 3]
    assert safe.tolist() == [[True] * 3, [False] * 3, [False] * 3]  # an episode's first state is neither
    with pytest.raises(UserError, match="pass their costs"):
        bound.labels(jnp.asarray(x))


def test_hazards_survive_json():
    import json

    speed = constraints.SpeedLimit(2.5, ("own.vx",), 0.1)
    for hazard in (
        constraints.Separation(0.4),
        speed,
        constraints.CostColumn(),
        constraints.All((constraints.Separation(), speed)),
    ):
        assert constraints.from_dict(json.loads(json.dumps(constraints.to_dict(hazard)))) == hazard


# ---------------------------------------------------------------------------------------------------------------------
# features


def test_views_equal_the_simulators_observations(rows):
    observations, state = rows
    table, own = views_of(rows, "decentralized")
    np.testing.assert_array_equal(own, observations[..., :14])  # all but the silent channel
    table, pruned = views_of(rows, "pruned")
    np.testing.assert_allclose(pruned[..., :14], observations[..., :14], atol=1e-6)
    assert table.names[:14] == SimpleSpread().feature_map("decentralized").names
    velocity = observations[..., :2]
    for i in range(3):
        for k, j in enumerate(j for j in range(3) if j != i):
            np.testing.assert_allclose(
                pruned[:, i, 14 + 2 * k : 16 + 2 * k], velocity[:, j] - velocity[:, i], atol=1e-6
            )
            assert table.names[14 + 2 * k] == f"other{k}.dvx"
    table, shared = views_of(rows, "centralized")
    np.testing.assert_array_equal(shared, np.repeat(state[:, None], 3, 1))
    assert table.names == SimpleSpread().state_names


@pytest.mark.parametrize("agents", [1, 2, 5])
def test_views_of_other_teams(agents):
    env = SimpleSpread(n_agents=agents)
    observations = np.zeros((4, agents, env.observation_dim), np.float32)
    state = np.zeros((4, 6 * agents), np.float32)
    width = {"pruned": 4 + 2 * agents + 4 * (agents - 1), "centralized": 6 * agents, "decentralized": 2 + 4 * agents}
    for view in VIEWS:
        table = SimpleSpread(n_agents=agents).feature_map(view)
        x = table(observations, state)
        assert x.shape == (4, agents, width[view]) and len(set(table.names)) == len(table.names) == width[view]


def test_views_of_anybodys_data_drop_constants_and_duplicates():
    rng = np.random.default_rng(0)
    observations, state = rng.normal(size=(50, 2, 4)), rng.normal(size=(50, 3))
    observations[..., 1] = 7.0  # constant
    observations[..., 3] = observations[..., 0]  # duplicate
    state[:, 2] = 1.0
    names, shared = ("a", "b", "c", "d"), ("s", "t", "u")
    table = features.from_data("pruned", observations, state, names, shared)
    assert table.names == ("a", "c", "s", "t")
    x = table(observations, state)
    np.testing.assert_array_equal(x[..., :2], observations[..., [0, 2]])
    np.testing.assert_array_equal(x[:, 1, 2:], state[:, :2])
    again = features.from_dict(features.to_dict(table))
    np.testing.assert_array_equal(again(jnp.asarray(observations), jnp.asarray(state)), x.astype(np.float32))
    assert features.from_data("decentralized", observations, state, names, shared).names == ("a", "c")
    assert features.from_data("centralized", observations, state, names, shared).names == ("s", "t")
    assert features.from_data("pruned", observations, None, names, ()).names == ("a", "c")
    with pytest.raises(UserError, match="centralized.*global state"):
        features.from_data("centralized", observations, None, names, ())
    with pytest.raises(UserError, match="Every observation entry is constant"):
        features.from_data("pruned", np.zeros((5, 2, 3)), None, ("a", "b", "c"), ())


def test_entries_that_vary_late_in_a_log_are_kept():
    """A log sorted by site: an entry rests, and another repeats an earlier one, on all rows but the last hundred."""
    observations = np.random.default_rng(0).normal(size=(25_100, 2, 3)).astype(np.float32)
    observations[:25_000, :, 1] = 0.5
    observations[:25_000, :, 2] = observations[:25_000, :, 0]
    steps = len(observations) - 1
    store = EpisodeStore.from_episodes(observations[None], np.zeros((1, steps, 2, 1)), np.zeros((1, steps)), None)
    assert registry.from_store(store).feature_map("decentralized", store).names == ("obs0", "obs1", "obs2")


def test_a_view_of_the_state_needs_it(rows):
    with pytest.raises(UserError, match="needs the global state"):
        SimpleSpread().feature_map("pruned")(rows[0], None)
    with pytest.raises(UserError, match="did you mean 'pruned'"):
        SimpleSpread().feature_map("prune")


def test_in_a_crowd_somebody_is_always_seen():
    """Entries that say who is seen are left out of a view where they never vary; one of them may be, and all."""
    x = np.array([[[0.0, 3.0, 4.0, 0.3, 0.4, 1.0]]])
    for names in (
        ("own.vx", "other0.dx", "other0.dy", "other1.dx", "other1.dy", "goal.dx"),
        ("own.vx", "other0.dx", "other0.dy", "other1.dx", "other1.dy", "other1.seen"),
    ):
        bound = constraints.bind(constraints.Separation(0.2), names, 1)
        np.testing.assert_allclose(bound.clearance(x), [[0.3]], atol=1e-6)
    with pytest.raises(UserError, match="needs at least 2 agents"):
        constraints.bind(constraints.Separation(0.2), ("own.vx", "own.vy"), 1)


@pytest.mark.parametrize("late", [0.0, 0.5, 1.0])
def test_places_go_by_the_velocity_that_the_logs_have_them_go_by(late):
    """Of agents who know velocities alone; the map is stored, and says nothing where it is the next velocity."""
    rng = np.random.default_rng(0)
    dt, rows = 0.2, 400
    velocity = np.cumsum(rng.normal(0, 0.3, (rows, 2)), 0)
    theirs = np.cumsum(rng.normal(0, 0.3, (rows, 2)), 0)
    gone = [((1 - late) * v[:-1] + late * v[1:]) * dt for v in (velocity, theirs)]
    place, there = (np.concatenate([np.zeros((1, 2)), moved.cumsum(0)]) for moved in gone)
    names = ("own.vx", "own.vy", "goal.dx", "goal.dy", "other0.dx", "other0.dy", "other0.dvx", "other0.dvy")
    x = np.concatenate([velocity, 3 - place, there - place, theirs - velocity], -1)[:, None]
    map = features.from_data("decentralized", x, None, names, (), np.array([0]), homogeneous=True, dt=dt)
    assert map.late == late and features.from_dict(features.to_dict(map)) == map
    assert ("late" in features.to_dict(map)) == (late < 1)
    plan = x[10:14][None].copy()
    plan[0, 1:, :, 2:] = 0.0  # what follows from own velocities
    found = np.asarray(map.reconcile(jnp.asarray(plan, jnp.float32)))[0, :, 0]
    np.testing.assert_allclose(found[:, 2:4], x[10:14, 0, 2:4], atol=1e-5)
    seen = there[10] + np.arange(4)[:, None] * dt * theirs[10] - place[10:14]  # as if it kept its velocity
    np.testing.assert_allclose(found[:, 4:6], seen, atol=1e-5)


def test_the_least_of_several_has_the_slope_of_the_first_that_is_least():
    """Also where two are equal, of which `min` takes half of each, and for arrays of any shape."""
    x = jnp.array([[3.0, 1.0, 2.0], [5.0, 4.0, 4.0]])
    least, slope = jax.value_and_grad(lambda x: constraints.lowest(x).sum())(x)
    assert least == 5.0
    np.testing.assert_array_equal(slope, [[0, 1, 0], [0, 1, 0]])
    _, moved = jax.jvp(jax.vmap(constraints.lowest), (x[:, None],), (jnp.arange(6.0).reshape(2, 1, 3),))
    np.testing.assert_array_equal(moved, [[1.0], [4.0]])
