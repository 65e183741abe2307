"""What logs without names tell of their entries."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ringfence.envs.proving.system import DEVELOPMENT, TEST
from ringfence.problem import on_map
from ringfence.problem.entries import loosely
from ringfence.problem.inferred_names import inferred_names
from ringfence.problem.partners import others as others_of
from ringfence.training import worlds
from ringfence.world.card import Card, Data, HeldOut, summary
from tests.quick import QUICK_WORLD

DT = 0.1


def team(agents: int = 3, episodes: int = 20, steps: int = 30) -> tuple[np.ndarray, tuple[str, ...], np.ndarray]:
    """Observations (M, N, O) of points that are pushed about, what their entries are, and the first rows."""
    g = np.random.default_rng(0)
    speed = g.normal(size=(episodes, steps + 1, agents, 2)).cumsum(1) * 0.2
    place = g.normal(size=(episodes, 1, agents, 2)) * 3 + DT * speed.cumsum(1)
    goal = g.normal(size=(episodes, 1, agents, 2)) * 3 - place
    who = others_of(agents)
    seen = np.concatenate([(x[:, :, who] - x[:, :, :, None]) for x in (place, speed)], -1)
    charge = g.random((episodes, steps + 1, agents, 1)).cumsum(1)
    x = np.concatenate([charge, speed, goal, place, seen.reshape(*seen.shape[:3], -1)], -1)
    names = ["obs0", "own.vx", "own.vy", "still_a.dx", "still_a.dy", "own.x", "own.y"]
    names += [f"other{k}.{field}" for k in range(agents - 1) for field in ("dx", "dy", "dvx", "dvy")]
    first = np.arange(episodes) * (steps + 1)
    return x.reshape(-1, *x.shape[2:]).astype(np.float32), tuple(names), first


def numbers(width: int) -> tuple[str, ...]:
    return tuple(f"obs{d}" for d in range(width))


@pytest.mark.parametrize("agents", [2, 3, 5])
def test_what_agents_see_of_each_other_names_it(agents):
    x, true, first = team(agents)
    assert inferred_names(x, numbers(len(true)), first) == true


def test_many_entries_that_mean_nothing_hide_no_others():
    x, true, first = team(episodes=10)
    noise = np.random.default_rng(1).normal(size=(*x.shape[:2], 400))
    found = inferred_names(np.concatenate([x, noise], -1), numbers(len(true) + 400), first)
    assert found[: len(true)] == true


def test_in_any_order_of_entries():
    x, true, first = team()
    order = np.random.default_rng(1).permutation(len(true))
    found = inferred_names(x[..., order], numbers(len(true)), first)
    kind = [name.rstrip("xyz") for name in found]  # which axis is the first does not matter
    assert kind == [true[d].rstrip("xyz").replace("obs0", f"obs{k}") for k, d in enumerate(order)]


def test_places_that_nobody_sees_of_himself():
    x, true, first = team()
    kept = [d for d, name in enumerate(true) if name not in ("own.x", "own.y")]
    found = inferred_names(x[..., kept], numbers(len(kept)), first)
    expected = [true[d] for d in kept]
    assert found == ("obs0", "own.vx", "own.vy", "obs3", "obs4", *expected[5:])


def test_speeds_that_nobody_sees_of_others():
    x, true, first = team()
    kept = [d for d, name in enumerate(true) if ".dv" not in name]
    assert inferred_names(x[..., kept], numbers(len(kept)), first) == tuple(true[d] for d in kept)


def test_what_is_there_twice_is_named_once():
    x, true, first = team()
    twice = np.concatenate([x, x[..., 7:9]], -1)
    assert inferred_names(twice, numbers(len(true) + 2), first)[: len(true)] == true


def test_where_a_body_heads_for_and_what_else_moves():
    """A direction that velocities are along; a place that goes on by a velocity less one's own."""
    g = np.random.default_rng(0)
    shape = (20, 31, 2)
    turn = g.normal(size=shape).cumsum(1) * 0.3
    pace = np.abs(g.normal(size=shape).cumsum(1) * 0.2)
    look = np.stack([np.cos(turn), np.sin(turn)], -1)
    speed = pace[..., None] * look
    place = g.normal(size=(20, 1, 2, 2)) * 3 + DT * speed.cumsum(1)
    phase = 0.05 * np.arange(31)[:, None, None] + g.random((20, 1, 1, 1)) * 6
    thing = np.concatenate([np.cos(phase), np.sin(phase)], -1)
    drift = 0.05 / DT * np.concatenate([-np.sin(phase), np.cos(phase)], -1)
    who = others_of(2)
    seen = [(x[:, :, who] - x[:, :, :, None])[..., 0, :] for x in (place, speed)]
    x = np.concatenate([look, speed, *seen, thing - place, drift - speed], -1)
    fields = [f"thing_a.d{k}{axis}" for k in ("", "v") for axis in "xy"]
    others = [f"other0.d{k}{axis}" for k in ("", "v") for axis in "xy"]
    true = ("own.cos", "own.sin", "own.vx", "own.vy", *others, *fields)
    flat = x.reshape(-1, *x.shape[2:]).astype(np.float32)
    assert inferred_names(flat, numbers(len(true)), np.arange(20) * 31) == true
    sideways = flat.copy()
    sideways[..., :2] = flat[..., [1, 0]] * [-1, 1]
    found = inferred_names(sideways, numbers(len(true)), np.arange(20) * 31)
    assert found == ("obs0", "obs1", *true[2:]), "nobody moves along that direction"


@pytest.mark.parametrize("looks", ["cos and sin", "angle"])
def test_where_a_body_looks_that_logs_its_place_and_its_speed(looks):
    """And no velocity: the direction is the one that its place changes along, and the speed by how much."""
    g = np.random.default_rng(0)
    shape = (20, 31, 2)
    turn = g.normal(size=shape).cumsum(1) * 0.1
    pace = 0.1 + np.abs(g.normal(size=shape).cumsum(1) * 0.2)
    look = np.stack([np.cos(turn), np.sin(turn)], -1)
    place = g.normal(size=(20, 1, 2, 2)) * 3 + DT * (pace[..., None] * look).cumsum(1)
    seen = (place[:, :, others_of(2)] - place[:, :, :, None])[..., 0, :]
    heading = turn[..., None] if looks == "angle" else look
    x = np.concatenate([g.normal(size=(*shape, 1)), pace[..., None], place, heading, seen], -1)
    direction = ("own.heading",) if looks == "angle" else ("own.cos", "own.sin")
    true = ("obs0", "own.v", "own.x", "own.y", *direction, "other0.dx", "other0.dy")
    flat = x.reshape(-1, *x.shape[2:]).astype(np.float32)
    assert inferred_names(flat, numbers(len(true)), np.arange(20) * 31) == true


def test_others_by_distance_are_named_in_that_order():
    x, true, first = team()
    seen = x[..., 7:].reshape(*x.shape[:2], 2, 4)
    nearest = (seen[..., :2] ** 2).sum(-1).argsort(-1)
    x[..., 7:] = np.take_along_axis(seen, nearest[..., None], 2).reshape(*x.shape[:2], -1)
    assert inferred_names(x, numbers(len(true)), first) == true


def test_what_is_measured_has_no_names():
    x, true, first = team()
    noisy = x + np.random.default_rng(2).normal(size=x.shape) * 0.01
    assert inferred_names(noisy, numbers(len(true)), first) == numbers(len(true))
    assert inferred_names(x[:, :1], numbers(len(true)), first) == numbers(len(true))
    assert inferred_names(x[:20], numbers(len(true)), first[:1]) == numbers(len(true))


def test_what_names_may_mean():
    said = {"x": ("place", "x"), "robot0_dvy": ("drift", "y"), "post1X": ("place", "x"), "goal.dz": ("offset", "z")}
    said |= {"ego_vel_x": ("velocity", "x"), "delta_x": ("offset", "x"), "truck0_speed": ("number", "")}
    said |= {"cos": ("number", ""), "index": (None, ""), "obs7": (None, ""), "power_kw": (None, "")}
    assert {name: loosely(name) for name in said} == said


def test_a_view_without_names_is_one_with_them():
    bare = DEVELOPMENT["room"]
    bare, named = (dataclasses.replace(bare, names=names).feature_map("pruned") for names in ("none", "all"))
    assert [name.replace("still_a", "goal") for name in bare.names] == list(named.names)
    assert bare.follows == named.follows


def test_whatever_is_relative_to_oneself_follows():
    found = TEST["shafts"].feature_map("pruned")
    assert {"goal.dangle", "other0.dangle", "other2.dspeed"} <= {found.names[d] for d in found.follows}


def test_names_that_say_nothing_of_whose_an_entry_is_give_way():
    x, true, first = team()
    given = tuple(f"column {d}" for d in range(len(true)))
    expected = tuple(name.replace("obs0", "column 0") for name in true)
    assert inferred_names(x, given, first) == expected
    assert inferred_names(x, given, first, keep=("column 1",)) == ("column 0", "column 1", *expected[2:])
    half = tuple("own.vx" if name == "own.vx" else entry for name, entry in zip(true, given))
    assert inferred_names(x, half, first) == half


def trucks(backwards: bool = False) -> tuple[np.ndarray, tuple[str, ...], tuple[str, ...], np.ndarray]:
    """Observations of three bodies that turn, what they are called, what they are, and the first rows."""
    g = np.random.default_rng(0)
    shape = (20, 31, 3)
    turn = g.normal(size=shape).cumsum(1) * 0.1
    pace = g.normal(size=shape).cumsum(1) * 0.2
    pace = pace if backwards else 0.1 + np.abs(pace)
    look = np.stack([np.cos(turn), np.sin(turn)], -1)
    place = g.normal(size=(20, 1, 3, 2)) * 3 + DT * (pace[..., None] * look).cumsum(1)
    who = others_of(3)
    gap = place[:, :, who] - place[:, :, :, None]
    seen = np.concatenate([gap, look[:, :, who], pace[:, :, who, None]], -1)
    x = np.concatenate([place, look, pace[..., None], seen.reshape(*shape, -1)], -1)
    own = ("x", "y", "cos", "sin", "speed")
    given = (*own, *(f"truck{k}_{e}" for k in range(2) for e in ("dx", "dy", "cos", "sin", "speed")))
    true = ["own.x", "own.y", "own.cos", "own.sin", "own.v"]
    true += [f"other{k}.{e}" for k in range(2) for e in ("dx", "dy", "dcos", "dsin", "dv")]
    return x.reshape(-1, *x.shape[2:]).astype(np.float32), given, tuple(true), np.arange(20) * 31


@pytest.mark.parametrize("backwards", [False, True])
def test_given_names_tell_places_from_other_differences(backwards):
    """Others' headings and speeds differ from one's own as exactly as their places do."""
    x, given, true, first = trucks(backwards)
    columns = on_map.relative(x, given, None, first)
    assert columns.names == true
    swapped = np.arange(len(true))
    swapped[[5, 6]] = 6, 5
    names = tuple(given[d] for d in swapped)
    assert on_map.relative(x[..., swapped], names, None, first).names == tuple(true[d] for d in swapped)


def test_numbers_of_others_are_theirs_where_these_have_them():
    x, given, true, first = trucks()
    load = np.broadcast_to(np.array([1.0, 1.0, 5.0], np.float32)[:, None], (len(x), 3, 1))  # of each its own, always
    theirs = load[:, others_of(3), 0]
    more = ("load", "truck0_load", "truck1_load")
    found = on_map.relative(np.concatenate([x, load, theirs], -1), (*given, *more), None, first).names
    assert found == (*true, "own.load", "other0.load", "other1.load")
    found = on_map.relative(np.concatenate([x, load, theirs[..., ::-1]], -1), (*given, *more), None, first).names
    assert found == (*true, *more), "they are not"


def test_given_names_that_logs_refute_name_nothing():
    x, given, _, first = trucks()
    noisy = x.copy()
    noisy[..., 5:7] += np.random.default_rng(1).normal(size=noisy[..., 5:7].shape)
    found = on_map.relative(noisy, given, None, first).names
    assert found[5:7] == given[5:7] and not any(name.startswith("other0.") for name in found[5:7])
    moved = inferred_names(x[..., [2, 7, 12]], ("x", "truck0_dvx", "truck1_dvx"), first)
    assert not any(name.endswith(".dx") for name in moved), "a velocity by its name is no place"


def test_offsets_by_their_names_are_no_places_on_a_map():
    """Nor where all go along with each other, so that they do not change as one moves."""
    x, true, first = team()
    together = np.random.default_rng(3).normal(size=(20, 31, 1, 2)).cumsum(1)
    x = x.reshape(20, 31, *x.shape[1:])
    x[..., 5:7] += together
    x[..., 3:5] -= together
    x[..., 1:3] += np.diff(together, axis=1, prepend=0) / DT
    x = x.reshape(-1, *x.shape[2:])
    own = ["charge", "vx", "vy", "goal_dx", "goal_dy", "x", "y"]
    given = own + [f"robot{k}_{e}" for k in range(2) for e in ("dx", "dy", "dvx", "dvy")]
    columns = on_map.relative(x, given, None, first)
    assert not columns.differ
    assert columns.names == ("charge", *(name.replace("still_a", "goal") for name in true[1:]))


def test_things_are_called_as_given_names_call_them():
    """So that things of a kind, which they number, are of one; a name that says nothing, or not enough, is none."""
    x, true, first = team()
    post = np.random.default_rng(1).normal(size=(1, 1, 2)) + x[..., [3, 4]]
    x = np.concatenate([x, post], -1)

    def named(goal: tuple[str, str], other: tuple[str, str]) -> tuple[str, ...]:
        given = ["column"] * 3 + [*goal] + [f"seen {d}" for d in range(5, len(true))] + [*other]
        found = inferred_names(x, given, first)
        return (*found[3:5], *found[-2:])

    still = ("still_a.dx", "still_a.dy", "still_b.dx", "still_b.dy")
    assert named(("post_0_dx", "post_0_dy"), ("post1X", "post1Y")) == ("post0.dx", "post0.dy", "post1.dx", "post1.dy")
    assert named(("to_goal_x", "to_goal_y"), ("obs7", "obs8")) == ("to_goal.dx", "to_goal.dy", *still[2:])
    assert named(("goal_x", "goal_y"), ("goal_dx", "goal_dy")) == still
    assert named(("other_0_dx", "other_0_dy"), ("dx", "dy"))[2:] == still[2:]


def test_the_card_says_which_names_were_inferred_and_a_formula_reads_them(own_store):
    bare = dataclasses.replace(own_store, card=own_store.card.updated(observation_names=None))
    world = worlds.fit(bare, labels="formula", **QUICK_WORLD)
    given = own_store.card.observation_names
    for entry, name in world.card.data.inferred_names.items():
        true = given[int(entry.removeprefix("obs"))]
        assert name == true or (name.startswith("still_") and true.startswith("landmark"))
    assert "Logs tell what these entries are, which nobody named: " in str(world.card)
    assert "other0.dx (obs" in str(world.card) and "by other names" not in str(world.card)
    assert worlds.fit(own_store, **QUICK_WORLD).card.data.inferred_names is None


def test_the_card_says_which_given_names_are_read_otherwise():
    said = {"s": "own.x", "obs3": "own.vx", "truck0_speed less speed": "other0.dv"}
    card = Card(data=Data(task="t", hazard={}, inferred_names=said), held_out=HeldOut(1, 1))
    lines = summary(card)
    assert "Logs tell what these entries are, which nobody named: own.vx (obs3)." in lines
    assert any(line.endswith("than given: own.x (s).") for line in lines)
    assert "Entries are read less one's own, too: other0.dv (truck0_speed less speed)." in lines


@pytest.mark.parametrize("agents", [1, 3])
def test_who_sees_nobody_is_known_by_what_its_places_change_by(agents):
    """One robot, or several that do not see each other; whatever their entries are called."""
    rng = np.random.default_rng(0)
    place, goal, post = (rng.normal(0, size, (30, agents, 2)) for size in (2, 3, 3))
    velocity, walk = np.zeros_like(place), rng.normal(0, 0.3, place.shape)
    rows = []
    for _ in range(60):
        rows.append(np.concatenate([place, velocity, goal - place, post - place, walk - velocity], -1))
        push = np.clip(0.5 * (goal - place) - velocity + rng.normal(0, 0.3, place.shape), -1, 1)
        velocity = velocity + 0.1 * push
        place, post = place + 0.1 * velocity, post + 0.1 * walk
    x = np.stack(rows, 1).reshape(-1, agents, 10).astype(np.float32)
    first = np.arange(30) * 60
    own = ("own.x", "own.y", "own.vx", "own.vy")
    assert inferred_names(x[..., :4], ["along", "aside", "v_along", "v_aside"], first) == own
    assert inferred_names(x[..., [0, 2]], ["s", "speed"], first) == ("own.x", "own.vx")
    things = ("still_a.dx", "still_a.dy", "thing_a.dx", "thing_a.dy", "thing_a.dvx", "thing_a.dvy")
    assert inferred_names(x, [f"obs{k}" for k in range(10)], first) == own + things
    unknown = ("a", "b", "c", "d")
    assert inferred_names(x[..., 6:], ["a_dx", "a_dy", "a_dvx", "a_dvy"], first)[:2] == ("a_dx", "a_dy"), "so called"
    assert inferred_names(x[..., [0, 1, 4, 5]], unknown, first) == unknown, "no velocity"
    assert inferred_names(rng.normal(size=x.shape)[..., :4], unknown, first) == unknown
