"""Angles among the entries of anybody's logs, and who it is that a list of the nearest holds."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ringfence import EpisodeStore
from ringfence.errors import UserError
from ringfence.problem import features, motion, partners
from ringfence.problem.inferred_names import inferred_names
from ringfence.problem.motion import Turn
from ringfence.training import worlds
from ringfence.world import model
from ringfence.world.dynamics import fit_dynamics
from ringfence.world.settings import Settings
from tests.quick import QUICK_WORLD

WHOLE = 2 * np.pi


def headings(rng: np.random.Generator, low: float = -np.pi, whole: float = WHOLE) -> np.ndarray:
    """(E, L, N) of bodies that turn at random, for long."""
    rate = rng.normal(size=(20, 1, 3)) * 0.15 + rng.normal(size=(20, 80, 3)) * 0.02
    angle = rng.uniform(0, WHOLE, (20, 1, 3)) + rate.cumsum(1)
    return low + whole * np.mod(angle / WHOLE, 1.0)


def steps_of(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Features (W, N, 1) before and after steps of one entry (E, L, N)."""
    return x[:, :-1].reshape(-1, x.shape[-1], 1), x[:, 1:].reshape(-1, x.shape[-1], 1)


@pytest.mark.parametrize(("low", "whole"), [(-np.pi, WHOLE), (0.0, WHOLE), (-180.0, 360.0), (0.0, 360.0)])
def test_an_angle_is_found_from_wherever_it_goes(low, whole):
    (found,) = motion.turns_in(*steps_of(headings(np.random.default_rng(0), low, whole)))
    assert found == Turn(0, pytest.approx(low), pytest.approx(whole))


def test_what_only_looks_like_an_angle_is_none():
    rng = np.random.default_rng(1)
    drawn = np.repeat(rng.uniform(-np.pi, np.pi, (20, 8, 3)), 10, 1)  # a goal that is drawn anew
    swings = np.pi * np.sin(np.linspace(0, 60, 80))[None, :, None] * np.ones((20, 1, 3))
    half = np.mod(headings(rng), np.pi)
    listed = np.sort(rng.uniform(-np.pi, np.pi, (20, 80, 3)), -1)
    for x in (drawn, swings, half, listed):
        assert motion.turns_in(*steps_of(x)) == ()


def test_the_shorter_way_round():
    angle = (Turn(1, -np.pi, WHOLE),)
    one, two = np.array([5.0, 3.1]), np.array([4.0, -3.1])
    np.testing.assert_allclose(motion.apart(angle, two, one), [-1.0, WHOLE - 6.2])
    np.testing.assert_allclose(motion.apart(angle, jnp.array(two), jnp.array(one)), [-1.0, WHOLE - 6.2], rtol=1e-5)
    np.testing.assert_allclose(motion.within(angle, jnp.array([9.0, 3.1 + 0.2])), [9.0, 3.3 - WHOLE], rtol=1e-5)
    ends = [motion.pointing(angle, jnp.array([5.0, a]), jnp.array([0.5, a])) for a in (-np.pi, np.pi)]
    np.testing.assert_allclose(*ends, atol=1e-5)
    assert ends[0].shape == (3,)


def test_a_world_predicts_past_the_end_of_a_turn():
    """Read as a number, the angle is predicted to go on where no angle is, and to be half a turn off beside its end."""
    rng = np.random.default_rng(2)
    angle = headings(rng)
    rate = motion.apart((Turn(0, -np.pi, WHOLE),), angle[:, 1:, :, None], angle[:, :-1, :, None])[..., 0]
    seen = np.stack([angle[:, 1:], rate], -1).astype(np.float32)  # (E, L, N, 2)
    store = EpisodeStore.from_episodes(
        seen, np.zeros((20, 78, 3, 1)), np.zeros((20, 78)), None, card={"observation_names": ["own.yaw", "own.rate"]}
    )
    map = features.from_data("pruned", store.observations, None, ("own.yaw", "own.rate"), (), store.first_rows)
    assert [turn.entry for turn in map.turns] == [0]
    assert features.from_dict(features.to_dict(map)) == map
    row = jnp.asarray(np.arange(store.steps) + store.episode_of_step)
    acts = fit_dynamics(
        jnp.asarray(map(store.observations, None)),
        jnp.asarray(store.actions),
        row,
        map,
        jax.random.key(0),
        Settings(num_ensemble=2, dynamics_updates=600, dynamics_width=32),
    )
    x, errors = jnp.asarray(seen[:, 0]), []
    for k in range(1, 20):
        x, _ = acts.step(x, jnp.zeros((20, 3, 1)))
        errors.append(np.abs(map.apart(np.asarray(x), seen[:, k])[..., 0]))
    assert np.abs(np.asarray(x)[..., 0]).max() <= np.pi + 1e-5
    assert np.quantile(errors, 0.95) < 1.0


def test_a_damaged_angle_is_refused():
    data = {"view": "pruned", "names": ["a"], "source": "observations", "plus": [[0]], "minus": [[-1]], "joint": False}
    with pytest.raises(UserError, match="its angles are none of its entries"):
        features.from_dict(data | {"turns": [[1, -3.14, 6.28]]})
    with pytest.raises(UserError, match="others are none of its entries"):
        features.from_dict(data | {"mirrored": [[[4], 1]]})


def crowd(rng: np.random.Generator, agents: int = 5, places: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Features (W, N, 3 + 2 places): own speed, a clock that all see, a place in a list that nobody has; range and
    range rate of the nearest; and (W, N, places) who these are."""
    place, speed = rng.normal(size=(2, 400, agents, 2))
    off = place[:, None] - place[:, :, None]
    away = np.linalg.norm(off, axis=-1) + 1e9 * np.eye(agents)
    who = away.argsort(-1)[..., :places]
    rate = ((speed[:, None] - speed[:, :, None]) * off).sum(-1) / away
    own = np.linalg.norm(speed, axis=-1)[..., None]
    clock = np.broadcast_to(rng.normal(size=(400, 1, 1)), own.shape)
    listed = [np.take_along_axis(x, who, -1) for x in (away, rate)]
    return np.concatenate([own, clock, np.zeros_like(own), *listed], -1), who


def test_who_is_seen_is_who_sees_the_same():
    x, who = crowd(np.random.default_rng(3))
    found = partners.found_in(x)
    assert sorted(found) == [((3, 4), 1), ((5, 6), 1)]
    scale = jnp.asarray(x.std((0, 1)))
    seen, known = partners.seen_by(found, jnp.asarray(x), scale, partners.SAME)
    mutual = np.array([[[i in who[w, j] for j in who[w, i]] for i in range(5)] for w in range(len(who))])
    np.testing.assert_array_equal(np.asarray(known), mutual)  # who is not on the other's list, is not known
    np.testing.assert_array_equal(np.asarray(seen)[mutual], who[mutual])
    again = partners.seen_in(found, jnp.asarray(x), scale)
    np.testing.assert_array_equal(again, (seen, known))
    off = x + np.random.default_rng(4).normal(size=x.shape) * 0.02 * np.asarray(scale)
    seen, known = partners.seen_by(found, jnp.asarray(off), scale)
    assert (np.asarray(seen)[mutual] == who[mutual]).mean() > 0.97 and np.asarray(known)[mutual].mean() > 0.97


def test_what_they_have_is_looked_up():
    have = jnp.arange(6.0).reshape(1, 3, 2)
    who = jnp.array([[[1, 2], [0, 2], [0, 1]]])
    known = jnp.array([[[True, False], [True, True], [False, True]]])
    found = partners.looked_up(have, who, known)[0]
    np.testing.assert_array_equal(found[0], [2, 3, 1, 0, 0, 0])
    np.testing.assert_array_equal(found[1], [0, 1, 1, 4, 5, 1])


def test_opposite_signs_and_lists_that_are_nobodys():
    rng = np.random.default_rng(5)
    place = rng.normal(size=(400, 4, 2))
    off = place[:, None] - place[:, :, None]
    order = (np.linalg.norm(off, axis=-1) + 1e9 * np.eye(4)).argsort(-1)[..., :3]
    x = np.take_along_axis(off, order[..., None], 2).reshape(400, 4, 6)
    assert sorted(partners.found_in(x)) == [((0, 2, 4), -1), ((1, 3, 5), -1)]
    assert partners.found_in(rng.normal(size=(400, 4, 6))) == ()
    wide = np.concatenate([x, rng.normal(size=(*x.shape[:2], 400))], -1)
    assert partners.found_in(wide) == partners.found_in(x)
    assert partners.found_in(x[:, :1]) == ()


def test_a_world_reads_who_is_seen_only_where_that_tells_more(tmp_path, monkeypatch):
    """Robots on a line, each of whom sees how far the nearest is: who brakes is not told by the list."""
    rng = np.random.default_rng(6)
    place, speed = rng.uniform(-4, 4, (60, 4)).cumsum(1), rng.normal(size=(60, 4))
    seen, actions = [], rng.uniform(-1, 1, (60, 30, 4, 1))
    for t in range(31):
        off = place[:, None] - place[:, :, None]
        rate = speed[:, None] - speed[:, :, None]
        first = (np.abs(off) + 1e9 * np.eye(4)).argmin(-1)[..., None]
        seen.append(np.concatenate([speed[..., None], *(np.take_along_axis(x, first, -1) for x in (off, rate))], -1))
        if t < 30:
            speed = speed + 0.8 * actions[:, t, :, 0]
            place = place + 0.1 * speed
    seen = np.stack(seen, 1)
    costs = (np.abs(seen[:, 1:, :, 1]) < 0.4).any(-1)
    store = EpisodeStore.from_episodes(seen, actions, costs * 0.0, costs)
    how = QUICK_WORLD | {"dynamics_updates": 1500, "barrier": False}
    told = worlds.fit(store, cached=False, **how)
    monkeypatch.setattr(partners, "found_in", lambda x: ())
    plain = worlds.fit(store, cached=False, **how)
    assert told.card.data.partners and not plain.card.data.partners
    errors = [world.card.prediction_error.error_of_change[0] for world in (told, plain)]
    assert errors[0] < 0.95 * errors[1], errors
    assert "Who is in lists of the nearest is found" in str(told.card)
    kept = model.load(model.save(told, tmp_path / "told.world"))
    assert kept.dynamics.map.mirrored and kept.map == told.map
    assert not model.load(model.save(plain, tmp_path / "plain.world")).dynamics.map.mirrored


def test_lists_that_nobody_named_are_named():
    """Three of five seen, by how near they are: the same place is another's at another step."""
    rng = np.random.default_rng(7)
    place, speed = rng.normal(size=(30, 5, 2)) * 2, rng.normal(size=(30, 5, 2))
    seen = []
    for _ in range(41):
        off, gap = (x[:, None] - x[:, :, None] for x in (place, speed))
        order = (np.linalg.norm(off, axis=-1) + 1e9 * np.eye(5)).argsort(-1)[..., :3, None]
        listed = [np.take_along_axis(x, order, 2) for x in (off, gap)]
        seen.append(np.concatenate([speed, np.concatenate(listed, -1).reshape(30, 5, -1)], -1))
        speed = speed + 0.2 * rng.normal(size=speed.shape) - 0.02 * place
        place = place + 0.1 * speed
    seen = np.stack(seen, 1).astype(np.float32)
    found = inferred_names(seen.reshape(-1, *seen.shape[2:]), [f"obs{d}" for d in range(14)], np.arange(30) * 41)
    wanted = [f"other{k}.{what}" for k in range(3) for what in ("dx", "dy", "dvx", "dvy")]
    assert found == ("own.vx", "own.vy", *wanted)
