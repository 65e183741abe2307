"""Places on a map are read as how far away they are."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from ringfence.evaluation.replay_scene import names_of
from ringfence.logs.store import EpisodeStore
from ringfence.problem import features
from ringfence.problem.partners import others as others_of
from ringfence.training import worlds
from tests.quick import QUICK_WORLD

DT = 0.1
OWN = ("own.x", "own.y", "own.vx", "own.vy")


class Team:
    """Points that are pushed about among a post and a walker, as places on a map."""

    def __init__(self, agents: int = 3, episodes: int = 20, steps: int = 30):
        g = np.random.default_rng(0)
        self.agents, self.episodes, self.steps = agents, episodes, steps
        self.speed = g.normal(size=(episodes, steps + 1, agents, 2)).cumsum(1) * 0.2
        self.place = g.normal(size=(episodes, 1, agents, 2)) * 3 + DT * self.speed.cumsum(1)
        self.post = np.broadcast_to(g.normal(size=(episodes, 1, 1, 2)) * 3, self.place.shape)
        walk = np.broadcast_to(g.normal(size=(episodes, 1, 1, 2)), (episodes, steps + 1, 1, 2))
        self.walk = np.broadcast_to(walk, self.place.shape)
        walker = g.normal(size=(episodes, 1, 1, 2)) * 3 + DT * walk.cumsum(1)
        self.walker = np.broadcast_to(walker, self.place.shape)

    @property
    def own(self) -> np.ndarray:
        return np.concatenate([self.place, self.speed], -1)

    @property
    def first(self) -> np.ndarray:
        return np.arange(self.episodes) * (self.steps + 1)

    def others(self) -> np.ndarray:
        """(E, L+1, N, N − 1, 4) what the others log of themselves."""
        return self.own[:, :, others_of(self.agents)]

    def map(self, x, names, state=None, state_names=(), view="pruned", **options) -> features.FeatureMap:
        rows = x.reshape(-1, *x.shape[2:]).astype(np.float32)
        state = None if state is None else state.reshape(-1, state.shape[-1]).astype(np.float32)
        return features.from_data(view, rows, state, tuple(names), tuple(state_names), first_rows=self.first, **options)


def flat(x: np.ndarray) -> np.ndarray:
    return x.reshape(*x.shape[:3], -1)


def of_others(count: int) -> list[str]:
    return [f"other{k}.{field}" for k in range(count) for field in ("dx", "dy", "dvx", "dvy")]


def called(how: str, count: int) -> list[str]:
    """Names of one's own entries and of those of others, as people write them."""
    if how == "none":
        return [f"obs{d}" for d in range(4 + 4 * count)]
    if how == "dotted":
        return [*OWN, *(f"other{k}.{field}" for k in range(count) for field in ("x", "y", "vx", "vy"))]
    return ["x", "y", "vx", "vy", *(f"cart{k}_{field}" for k in range(count) for field in ("x", "y", "vx", "vy"))]


@pytest.mark.parametrize("how", ["none", "dotted", "words"])
@pytest.mark.parametrize("agents", [2, 3, 4])
def test_others_are_as_far_away_as_they_are(agents, how):
    team = Team(agents)
    x = np.concatenate([team.own, flat(team.others())], -1)
    map = team.map(x, called(how, agents - 1))
    assert map.names == (*OWN, *of_others(agents - 1))
    assert map.follows == tuple(range(4, 4 * agents)), "others go where they say that they go"
    seen = map(x, None)
    assert np.allclose(seen[..., 4:], flat(team.others() - team.own[..., None, :]), atol=1e-5)


def test_in_lists_of_the_nearest():
    team = Team(4)
    gap = team.others() - team.own[..., None, :]
    nearest = (gap[..., :2] ** 2).sum(-1).argsort(-1)[..., :2, None]
    x = np.concatenate([team.own, flat(np.take_along_axis(team.others(), nearest, 3))], -1)
    map = team.map(x, called("words", 2))
    assert map.names == (*OWN, *of_others(2))
    assert len(map.mirrored) == 4, "whoever sees is seen"


@pytest.mark.parametrize("dotted", [True, False])
def test_of_the_state_where_nobody_sees_another(dotted):
    team = Team()
    state = flat(team.own[:, :, None])[:, :, 0]
    state = np.concatenate([state, np.random.default_rng(1).normal(size=(*state.shape[:2], 1))], -1)
    names = OWN if dotted else ("x", "y", "vx", "vy")
    state_names = [f"s{d}" for d in range(13)]
    map = team.map(team.own, names, state, state_names)
    assert set(map.names) == {*OWN, *of_others(2), "s12"}, "and the rest of the state as it is"
    at = [map.names.index(name) for name in of_others(2)]
    assert np.allclose(map(team.own, state)[..., at], flat(team.others() - team.own[..., None, :]), atol=1e-5)
    alone = team.map(team.own, names, state, state_names, view="decentralized")
    assert not any(name.startswith("other") for name in alone.names)
    kept = team.map(team.own, names, state, state_names, keep={"s4"})
    assert "s4" in kept.names


def test_of_the_team_where_nobody_sees_another_and_there_is_no_state():
    """Whoever judges for the team knows what each observes; one agent's own policy does not."""
    team = Team()
    x = np.concatenate([team.own, team.post - team.place], -1)
    names = ("x", "y", "vx", "vy", "goal_x", "goal_y")
    assert len(team.map(x, names).names) == 6
    map = team.map(x, names, team=True)
    assert set(map.names) == {*OWN, "goal.dx", "goal.dy", *of_others(2)}
    assert not map.reads_state
    assert map.width == 6
    assert map.beyond(6, None) is None
    assert map.beyond(5, None) is not None
    at = [map.names.index(name) for name in of_others(2)]
    assert np.allclose(map(x, None)[..., at], flat(team.others() - team.own[..., None, :]), atol=1e-5)
    assert features.given_names(map, names)[at[0]] == "x of agent 1 less x"
    assert features.from_dict(features.to_dict(map)) == map
    given = jnp.asarray(x[0], jnp.float32)
    again, _ = map.written(jnp.zeros_like(given), None, map(given, None))
    assert np.allclose(again, given, atol=1e-5)
    unnamed = [f"obs{d}" for d in range(6)]
    assert len(team.map(x, unnamed, team=True).names) == 6, "nothing says what is a place"


@pytest.mark.parametrize("dotted", [True, False])
def test_of_the_team_where_lists_tell_of_the_nearest_alone(dotted):
    """Who is in which place of a list changes, and where all are is known: who comes from farther away is seen, too."""
    team = Team(4)
    gap = team.others() - team.own[..., None, :]
    nearest = (gap[..., :2] ** 2).sum(-1).argsort(-1)[..., :2, None]
    x = np.concatenate([team.own, flat(np.take_along_axis(gap, nearest, 3))], -1)
    names = (
        [*OWN, *of_others(2)]
        if dotted
        else ["x", "y", "vx", "vy", *(f"near{k}_{d}" for k in range(2) for d in ("dx", "dy", "dvx", "dvy"))]
    )
    map = team.map(x, names, team=True)
    assert set(map.names) == {*OWN, *of_others(3)} and len(map.follows) == 12
    at = [map.names.index(name) for name in of_others(3)]
    assert np.allclose(map(x, None)[..., at], flat(gap), atol=1e-5)
    blind = np.delete(x, (0, 1), -1)  # nobody logs where he is
    assert "other2.dvx" not in team.map(blind, np.delete(names, (0, 1)).tolist(), team=True).names
    whole = np.concatenate([team.own, flat(gap)], -1)
    assert team.map(whole, [*OWN, *of_others(3)], team=True).names == (*OWN, *of_others(3)), "all are seen already"
    walkers = np.random.default_rng(0).normal(size=gap[..., :2, :].shape)  # nobody of the team
    of_people = np.concatenate([team.own, flat(walkers)], -1)
    assert team.map(of_people, [*OWN, *of_others(2)], team=True).width == 12
    assert "other2.dx" not in team.map(of_people, [*OWN, *of_others(2)], team=True).names


@pytest.mark.parametrize("agents", [1, 3])
def test_things_that_stand_and_that_walk(agents):
    team = Team(agents)
    x = np.concatenate([team.own, team.post, team.walker, team.walk], -1)
    names = ["px", "py", "speed_x", "speed_y", "post0_x", "post0_y"]
    names += ["person0_pos_x", "person0_pos_y", "person0_vel_x", "person0_vel_y"]
    map = team.map(x, names)
    things = ["post0.dx", "post0.dy", "person0.dx", "person0.dy", "person0.dvx", "person0.dvy"]
    assert map.names == (*OWN, *things)
    assert np.allclose(map(x, None)[..., 4:6], team.post - team.place, atol=1e-5)
    assert np.allclose(map(x, None)[..., 8:], team.walk - team.speed, atol=1e-5)


def test_what_is_relative_stays_so():
    team = Team()
    gaps = [flat(team.others() - team.own[..., None, :]), team.post - team.place]
    names = [
        "x",
        "y",
        "vx",
        "vy",
        *(f"cart{k}_{f}" for k in range(2) for f in ("x", "y", "vx", "vy")),
        "goal_x",
        "goal_y",
    ]
    map = team.map(np.concatenate([team.own, *gaps], -1), names)
    assert map.names == (*OWN, *of_others(2), "goal.dx", "goal.dy")
    assert (map.minus < 0).all()


def test_what_is_no_place_stays_as_it_is():
    """One number of each other, what all see alike, flags, angles and what a hazard reads."""
    team = Team(2)
    g = np.random.default_rng(2)
    level = DT * g.normal(size=(20, 31, 2, 1)).cumsum(1)
    time = np.broadcast_to(np.arange(31)[None, :, None, None] * DT, level.shape)
    flag = (g.random(level.shape) < 0.9).astype(float)
    turn = np.mod(g.random((20, 1, 2, 1)) * 6 + 3 * np.arange(31)[None, :, None, None], 2 * np.pi)
    for own in (level, flag, turn):
        x = np.concatenate([own, time, own[:, :, ::-1]], -1)
        assert (team.map(x, ("level", "time", "other_level")).minus < 0).all()
    x = np.concatenate([team.own, flat(team.others())], -1)
    kept = team.map(x, called("words", 1), keep={"cart0_x"})
    assert kept.minus[0, kept.names.index("cart0_x")] < 0


@pytest.mark.parametrize("joined", [True, False])
def test_features_are_written_back(joined):
    team = Team()
    if joined:
        x, state = team.own, flat(team.own[:, :, None])[:, :, 0]
        map = team.map(x, OWN, state, [f"s{d}" for d in range(12)])
    else:
        x, state = np.concatenate([team.own, flat(team.others())], -1), None
        map = team.map(x, called("none", 2))
    given = jnp.asarray(x[0], jnp.float32), None if state is None else jnp.asarray(state[0], jnp.float32)
    wanted = map(*given)
    blank = jnp.zeros_like(given[0]), None if given[1] is None else jnp.zeros_like(given[1])
    assert np.allclose(map(*map.written(*blank, wanted)), wanted, atol=1e-5)
    again = features.from_dict(features.to_dict(map))
    assert again == map
    assert np.array_equal(again(*given), wanted)


def test_a_world_of_places_on_a_map():
    """It finds the distance at which the cost begins, says what it reads, and its logs can be replayed."""
    team = Team(3, 60)
    x = np.concatenate([team.own, flat(team.others())], -1)
    gaps = np.linalg.norm((team.others() - team.own[..., None, :])[..., :2], axis=-1).min((2, 3))
    actions = np.diff(team.speed, axis=1).clip(-1, 1)
    card = {"task": "mapped", "observation_names": called("words", 2), "dt": DT}
    costs = (gaps[:, 1:] < 1.5).astype(float)
    store = EpisodeStore.from_episodes(x, actions, np.zeros((60, 30)), costs, card=card)
    world = worlds.fit(store, **QUICK_WORLD)
    (cause,) = world.card.causes[""].causes
    (edge,) = world.card.causes[""].edges
    assert cause.name == "length of other.dx, other.dy"
    assert edge.at == pytest.approx(1.5, abs=0.1)
    assert "other0.dx (cart0_x less x)" in str(world.card)
    names = names_of(store)
    assert names.placed
    assert "cart0_x" in names.as_logged
