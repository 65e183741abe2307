"""Causes of danger: found by what is never safe, learned by small networks, asked, judged."""

import dataclasses
import types

import equinox as eqx
import jax
import jax.numpy as jnp
import msgspec
import numpy as np
import pytest

from ringfence import EpisodeStore, fit, guard
from ringfence.datasets.audit import audit
from ringfence.errors import UserError
from ringfence.guards import searched, shown
from ringfence.problem import features
from ringfence.problem.features import FeatureMap
from ringfence.problem.motion import Turn
from ringfence.problem.partners import others as others_of
from ringfence.report.logs_pages import build_ope
from ringfence.world import (
    cause_candidates,
    cause_counts,
    cause_search,
    causes,
    judging,
    margins,
    probes,
    verdict,
)
from ringfence.world.card import (
    PUT,
    Avoidable,
    BarrierScores,
    Card,
    Data,
    Foresight,
    PredictionError,
    Probe,
    ValueScores,
    Verdict,
)
from ringfence.world.cause_nets import FAR, LEAST, blank, scores, with_margin
from ringfence.world.causes import Cause, Cells, Edge, Found
from ringfence.world.logged import Logged, held_out, labels_of
from ringfence.world.quantities import Entry, Length
from tests.quick import IN_FULL, QUICK_WORLD

N, STEPS = 3, 40
NAMES = ["own.x", "own.y", "own.v", "goal.dx", "goal.dy"] + [f"other{j}.d{c}" for j in range(N - 1) for c in "xy"]
OTHERS = np.array([[j for j in range(N) if j != i] for i in range(N)])
NEAR, POST, FAST = 0.25, 0.4, 0.97


def walks(episodes=400, seed=0):
    """(observations (E, STEPS + 1, N, O), unsafe (E, STEPS, N, 3) by pair, post at the origin and speed)."""
    rng = np.random.default_rng(seed)
    place = rng.uniform(-1.5, 1.5, (episodes, 1, N, 2)) + np.cumsum(rng.normal(0, 0.12, (episodes, STEPS + 1, N, 2)), 1)
    speed = rng.uniform(0, 1, (episodes, STEPS + 1, N, 1))
    goal = np.broadcast_to(rng.uniform(-1.5, 1.5, (episodes, 1, N, 2)), place.shape)
    others = place[:, :, OTHERS] - place[:, :, :, None]
    rows = np.concatenate([place, speed, goal - place, others.reshape(*place.shape[:3], -1)], -1)
    far = np.linalg.norm(others, axis=-1).min(-1)
    causes_of = np.stack([far < NEAR, np.linalg.norm(place, axis=-1) < POST, speed[..., 0] > FAST], -1)
    return rows.astype(np.float32), causes_of[:, 1:]


@pytest.fixture(scope="module")
def logged():
    rows, unsafe = walks()
    x = rows[:, 1:].reshape(-1, N, rows.shape[-1])
    return x, unsafe.any(-1).reshape(-1, N), np.repeat(np.arange(len(rows)), STEPS)


@pytest.mark.parametrize("each", [False, True])
def test_every_cause_is_found_and_no_other(logged, each):
    """A pair, a place and a speed, by one cost of the team or by each agent's own; goals are left out."""
    x, unsafe, episode = logged
    found, cells = cause_search.find(x, unsafe if each else unsafe.any(1), episode, NAMES)
    assert {c.name for c in found.causes} == {"length of other.dx, other.dy", "own.x, own.y", "own.v"} or {
        c.name for c in found.causes
    } == {"length of other.dx, other.dy", "length of own.x, own.y", "own.v"}
    edges = {c.name: edge for c, edge in zip(found.causes, found.edges)}
    assert abs(edges["length of other.dx, other.dy"].at - NEAR) < 0.05 and edges["length of other.dx, other.dy"].below
    assert abs(edges["own.v"].at - FAST) < 0.02 and not edges["own.v"].below
    assert found.explained > 0.75 and found.false_alarms < 0.05 and len(cells) == 3


@pytest.mark.parametrize("called", ["lidar_{}", "own.ray{}", "scan[{}]"])
def test_rays_of_a_lidar_are_one_cause(called):
    """Twelve of them: nearer than any was is dangerous, too."""
    rng = np.random.default_rng(0)
    rays = np.minimum(rng.uniform(0.5, 9, (300, 1, N, 12)) + rng.normal(0, 0.2, (300, 40, N, 12)).cumsum(1), 5.0)
    unsafe = (rays < 0.6).any((2, 3)).reshape(-1)
    x = np.concatenate([rng.normal(size=(300, 40, N, 1)), rays.clip(0.2)], -1).reshape(-1, N, 13).astype(np.float32)
    names = ["own.v", *(called.format(k) for k in range(12))]
    found, _ = cause_search.find(x, unsafe, np.repeat(np.arange(300), 40), names)
    (cause,), (edge,) = found.causes, found.edges
    assert (cause.name, cause.things) == (f"|{called[:-2].rstrip('[_{')}|", 12)
    assert edge.at == pytest.approx(0.6, abs=0.01) and edge.below
    assert edge.bounds == (pytest.approx(0.6, abs=0.01),)
    assert found.explained > 0.99


def test_numbers_alone_make_no_row():
    rows = cause_candidates.candidates([f"obs{d}" for d in range(5)] + ["a_1", "a_2"])
    assert not any(cause.things > 1 for cause in rows)


def test_causes_are_found_without_names(logged):
    x, unsafe, episode = logged
    found, _ = cause_search.find(x, unsafe.any(1), episode, [f"e{d}" for d in range(x.shape[-1])])
    entries = {tuple(sorted(c.entries()[0])) for c in found.causes}
    assert {(5, 6), (7, 8), (2,), (0, 1)} == entries


def thresholds(cause: Cause) -> list[float]:
    """Of the conditions of a rule."""
    return [-one.more / one.weights[0] for one in cause.reads[0].parts]


@pytest.mark.parametrize("axes", ["xy", "xyz"])
def test_danger_may_be_a_box_or_a_cylinder(axes):
    """Vehicles are too near where they are along and aside, aircraft where they are across and in height."""
    rng = np.random.default_rng(0)
    others = (rng.normal(size=(9000, N, N - 1, len(axes))) * [6.0, 6.0, 2.0][-len(axes) :]).astype(np.float32)
    across = np.linalg.norm(others[..., :-1], axis=-1)
    unsafe = ((across < 3.0) & (np.abs(others[..., -1]) < 0.5)).any((1, 2))
    names = [f"other{j}.d{c}" for j in range(N - 1) for c in axes]
    found, cells = cause_search.find(others.reshape(9000, N, -1), unsafe, np.arange(9000) // 30, names)
    (cause,), (edge,) = found.causes, found.edges
    assert [at for at in thresholds(cause)] == [pytest.approx(3.0, abs=0.05), pytest.approx(0.5, abs=0.01)]
    assert cause.name.endswith(f"|other.d{axes[-1]}| below 0.5") and edge.bounds == (0.0,)
    assert found.explained > 0.9 and found.false_alarms < 0.01
    x = others[:50].reshape(50, N, -1)
    np.testing.assert_allclose(cause.of(x), cause.of(jnp.asarray(x)), rtol=1e-4, atol=1e-4)
    loaded = msgspec.json.decode(msgspec.json.encode(found), type=Found)
    assert loaded == found


@pytest.mark.parametrize(
    "what, name",
    [
        ("soon", "other.distance less 1.5 times how fast other.distance shrinks below"),
        ("braking", "post.distance less 1.5 times how fast post.distance shrinks below"),
        ("fast", "other.distance below 5 and length of own.vx, own.vy above 3"),
        ("seen", "other.distance below 8 and angle to other below 0.79"),
        ("ahead", "other.distance below 8 and angle to other below 0.79"),
        ("head-on", "other.distance below 12 and how fast other.distance shrinks above 3"),
        ("strip", "own.x above 6 and length of own.vx, own.vy above 3"),
        ("crowded", "other.distance of the second nearest"),
        ("lost", "other.distance of the nearest"),
    ],
)
def test_danger_may_be_a_distance_or_a_place_and_one_number_more(what, name):
    """How soon bodies meet, or what stands still, who is near and fast, what is in sight, or where one drives, who
    comes fast, is fast somewhere, crowded or alone: no entry tells it alone, nor a distance."""
    rng = np.random.default_rng(0)
    offset, velocity = rng.normal(0, 15, (9000, N, N - 1, 2)), rng.normal(0, 4, (9000, N, N - 1, 2))
    own, heading = rng.normal(0, 4, (9000, N, 2)), rng.uniform(-np.pi, np.pi, (9000, N))
    place, fast = rng.uniform(-9, 9, (9000, N)), np.linalg.norm(own, axis=-1) > 3
    far = np.linalg.norm(offset, axis=-1)
    where = np.arctan2(offset[..., 1], offset[..., 0])
    away, off = where - heading[..., None], where - np.arctan2(own[..., 1], own[..., 0])[..., None]
    closing = -(offset * velocity).sum(-1) / far
    unsafe = {
        "soon": far < 1.5 * closing,
        "braking": far < 1.5 * (offset * own[..., None, :]).sum(-1) / far,
        "fast": (far < 5) & fast[..., None],
        "seen": (far < 8) & (np.cos(away) > 0.7),
        "ahead": (far < 8) & (np.cos(off) > 0.7),
        "head-on": (far < 12) & (closing > 3),
        "strip": ((place > 6) & fast)[..., None],
        "crowded": (np.sort(far, -1)[..., 1] < 9)[..., None],
        "lost": (far.min(-1) > 25)[..., None],
    }[what]
    names = ["own.x", "own.vx", "own.vy", *(["own.cos", "own.sin"] if what != "ahead" else ["obs3", "obs4"])]
    names += [f"other{j}.{d}" for j in range(N - 1) for d in ("dx", "dy", "dvx", "dvy")]
    if what == "braking":
        names = [name.replace("other", "post").replace(".dv", ".obs") for name in names]
    looks = np.stack([np.cos(heading), np.sin(heading)], -1)
    others = np.concatenate([offset, velocity], -1).reshape(9000, N, -1)
    x = np.concatenate([place[..., None], own, looks, others], -1).astype(np.float32)
    found, _ = cause_search.find(x, unsafe.any((1, 2)), np.arange(9000) // 30, names)
    (cause,) = found.causes
    assert found.explained > 0.9 and found.false_alarms < 0.03
    at = found.edges[0].at
    if what in ("soon", "braking"):
        assert cause.name.startswith(name) and abs(cause.reads[0].more) < 0.1
    elif what in ("crowded", "lost"):
        assert cause.name == name
        assert abs(at - {"crowded": 9, "lost": 25}[what]) < 0.1 and found.edges[0].below == (what == "crowded")
    else:
        told = {"fast": (5.0, 3.0), "head-on": (12.0, 3.0), "strip": (6.0, 3.0)}.get(what, (8.0, np.arccos(0.7)))
        np.testing.assert_allclose(thresholds(cause), told, atol=0.05)
        assert [part.words.rpartition(" ")[0] for part in cause.reads[0].parts] == [
            part.rpartition(" ")[0] for part in name.split(" and ")
        ]
    np.testing.assert_allclose(found.causes[0].of(x), found.causes[0].of(jnp.asarray(x)), rtol=1e-3, atol=1e-3)
    here = jnp.zeros((N, x.shape[-1]))
    assert np.isfinite(jax.grad(lambda x: found.causes[0].of(x).sum())(here)).all()


def test_what_has_room_for_one_is_dangerous_for_two():
    place = np.random.default_rng(0).uniform(-6, 6, (30_000, N, 2))
    unsafe = (np.abs(place) < 3).all(-1).sum(1) > 1
    relative = place[:, others_of(N)] - place[:, :, None]
    x = np.concatenate([place, relative.reshape(30_000, N, -1)], -1).astype(np.float32)
    names = ["own.x", "own.y", *(f"other{j}.{d}" for j in range(N - 1) for d in ("dx", "dy"))]
    found, _ = cause_search.find(x, unsafe, np.arange(30_000) // 30, names)
    (cause,) = found.causes
    assert len(thresholds(cause)) == 8 and np.allclose(np.abs(thresholds(cause)), 3.0, atol=0.1)
    assert "own.x plus other.dx below" in cause.name
    assert found.explained > 0.99 and found.false_alarms < 0.01
    np.testing.assert_allclose(cause.of(jnp.asarray(x)), cause.of(x), atol=1e-5)


def of_team(power: np.ndarray, more: np.ndarray) -> tuple:
    """What `find` is given of steps (T, N) of powers and what else varies, of which nobody sees another's."""
    x = np.stack([power, more], -1).astype(np.float32)
    return x, np.arange(len(x)) // 30, ["own.power", "own.heat"]


@pytest.mark.parametrize("weights", [(1.0, 1.0, 1.0), (0.5, 1.0, 0.25)])
def test_danger_may_be_a_sum_over_the_team(weights):
    """Of what each draws, and of some more than of others; who acts alone knows of no sum."""
    rng = np.random.default_rng(0)
    power = np.cumsum(rng.normal(0, 0.2, (9000, N)), 0) % 4.0
    x, episode, names = of_team(power, rng.normal(size=power.shape))
    unsafe = power @ weights > 0.7 * 4.0 * sum(weights)
    found, _ = cause_search.find(x, unsafe, episode, names)
    assert found.explained > 0.95 and found.false_alarms < 0.02
    assert "over the team" in found.causes[0].name and "own.power" in found.causes[0].name
    if len(set(weights)) > 1:
        np.testing.assert_allclose(found.causes[0].reads[0].weights, weights, atol=0.06)
    alone, _ = cause_search.find(x, unsafe, episode, names, team=False)
    assert not any("team" in cause.name for cause in alone.causes)


@pytest.mark.parametrize("room", [12.0, 58.0, 3000.0])
def test_near_and_fast_is_found_however_large_the_room_is(room):
    """Who walks through a city is in danger within half a metre: of equal slices of the city that is nothing."""
    rng = np.random.default_rng(0)
    offset = rng.uniform(-room, room, (9000, 2, 1, 2))
    offset[::4] = rng.normal(0, 0.6, (2250, 2, 1, 2))
    own = rng.normal(0, 0.6, (9000, 2, 2))
    unsafe = (np.linalg.norm(offset[..., 0, :], axis=-1) < 0.5) & (np.linalg.norm(own, axis=-1) > 0.6)
    x = np.concatenate([own, offset[..., 0, :]], -1).astype(np.float32)
    found, _ = cause_search.find(x, unsafe, np.arange(9000) // 30, ["own.vx", "own.vy", "other.dx", "other.dy"])
    (cause,) = found.causes
    assert cause.name == "other.distance below 0.5 and length of own.vx, own.vy above 0.6"
    assert found.explained > 0.98 and found.false_alarms < 0.001


def test_a_threshold_that_depends_on_more_moves_the_others():
    """Too soon behind the car ahead in one's lane: where danger begins aside is known once how soon is."""
    rng = np.random.default_rng(0)
    ahead, aside, drift = (rng.uniform(*ends, (20_000, 2)) for ends in ((-40, 40), (-8, 8), (-6, 6)))
    unsafe = (ahead > 0) & (np.abs(aside) < 1.8) & (drift < 0) & (ahead - 4.5 < -1.5 * drift)
    x = np.stack([ahead, aside, drift], -1).astype(np.float32)
    found, _ = cause_search.find(x, unsafe, np.arange(20_000) // 40, ["other.ds", "other.dd", "other.dvs"])
    assert found.explained > 0.97 and found.false_alarms < 0.002 and found.edges[0].bounds


def test_thresholds_may_depend_on_other_numbers():
    """Boxes as long as both are, side by side; and a limit that falls along a way."""
    rng = np.random.default_rng(0)
    long = rng.choice([4.0, 8.0], (9000, N))
    offset = rng.normal(0, 1, (9000, N, N - 1, 2)) * [12.0, 3.0]
    theirs = long[:, OTHERS]
    touch = (np.abs(offset[..., 0]) < 0.5 * (long[..., None] + theirs)) & (np.abs(offset[..., 1]) < 1.8)
    others = np.concatenate([offset, theirs[..., None]], -1).reshape(9000, N, -1)
    x = np.concatenate([long[..., None], others], -1).astype(np.float32)
    names = ["own.length", *(f"other{j}.{d}" for j in range(N - 1) for d in ("ds", "dd", "length"))]
    found, _ = cause_search.find(x, touch.any((1, 2)), np.arange(9000) // 30, names)
    (cause,) = found.causes
    assert found.explained > 0.95 and "times own.length" in cause.name and "times other.length" in cause.name
    (along,) = [one for one in cause.reads[0].parts if len(one.parts) == 3]
    np.testing.assert_allclose(np.array(along.weights[1:]) / along.weights[0], -0.5, atol=0.03)
    way, speed = rng.uniform(0, 300, (9000, N)), rng.uniform(2, 11, (9000, N))
    x = np.stack([way, speed], -1).astype(np.float32)
    fast = (speed > 12 - 0.02 * way).any(1)
    found, _ = cause_search.find(x, fast, np.arange(9000) // 30, ["own.x", "own.vx"])
    (cause,) = found.causes
    assert found.explained > 0.98 and cause.is_rule
    np.testing.assert_allclose(cause.reads[0].weights[1] / cause.reads[0].weights[0], 50.0, rtol=0.02)


def test_a_threshold_may_depend_on_how_far_a_number_is_from_0():
    """Leaves of a gate that closes from both sides, and a joint that may bend less the faster one goes either way."""
    rng = np.random.default_rng(0)
    x, y, opening = (rng.uniform(*ends, (20_000, 1)) for ends in ((-8, 8), (-4, 4), (0, 4)))
    unsafe = ((np.abs(x) < 1.2) & (np.abs(y) > opening - 0.45)).any(1)
    seen = np.stack([x, y, opening], -1).astype(np.float32)
    found, _ = cause_search.find(seen, unsafe, np.arange(20_000) // 40, ["own.x", "own.y", "gate.opening"])
    assert found.explained > 0.98 and found.false_alarms < 0.01
    assert any("|own.y|" in one.name for one in found.causes)
    speed, bend = rng.uniform(-1.6, 1.6, (20_000, 2)), rng.normal(0, 0.4, (20_000, 2))
    unsafe = (np.abs(bend) > 1 - 0.25 * np.abs(speed)).any(1)
    seen = np.stack([speed, bend], -1).astype(np.float32)
    found, _ = cause_search.find(seen, unsafe, np.arange(20_000) // 40, ["own.v", "own.bend"])
    (cause,) = found.causes
    assert found.explained > 0.98 and found.false_alarms < 0.01 and cause.is_rule
    np.testing.assert_allclose(cause.reads[0].weights[1] / cause.reads[0].weights[0], 4.0, atol=0.1)


def test_a_threshold_may_depend_on_another_number_of_the_rule():
    """A cone that widens below or above another, and ends."""
    offset = np.random.default_rng(0).normal(0, 1, (30_000, 2, 1, 3)) * [1.2, 1.2, 1.5]
    far, up = np.linalg.norm(offset[..., :2], axis=-1), np.abs(offset[..., 2])
    unsafe = ((up < 2.0) & (far < 0.2 + 0.3 * up)).any((1, 2))
    names = ["other0.dx", "other0.dy", "other0.dz"]
    x = offset.reshape(30_000, 2, -1).astype(np.float32)
    found, _ = cause_search.find(x, unsafe, np.arange(30_000) // 60, names)
    (cause,) = found.causes
    assert found.explained > 0.98 and found.false_alarms < 0.005 and cause.is_rule


def test_danger_may_grow_with_a_square_or_a_product():
    """Too fast to stop before a wall, too near to stop, thrown aside in a bend, and too much power."""
    rng = np.random.default_rng(0)
    place, speed, turn = (rng.normal(0, size, (20_000, 2)) for size in (3.0, 1.5, 0.7))
    ahead = rng.uniform(0, 12, (20_000, 2))
    cases = {
        "the signed square of own.vx": (["own.x", "own.vx"], (place, speed), place + 0.5 * speed * np.abs(speed) > 6),
        "the signed square of own.v": (["own.gap", "own.v"], (ahead, np.abs(speed)), ahead < speed**2 / 3),
        "|own.v times own.yaw_rate|": (["own.v", "own.yaw_rate"], (speed, turn), np.abs(speed * turn) > 2),
        "own.v times own.force": (["own.v", "own.force"], (speed, place), speed * place > 8),
    }
    for name, (names, numbers, unsafe) in cases.items():
        x = np.stack(numbers, -1).astype(np.float32)
        found, _ = cause_search.find(x, unsafe.any(1), np.arange(20_000) // 40, names)
        assert found.explained > 0.98 and found.false_alarms < 0.004, (name, found)
        assert name in found.causes[0].name


def test_any_of_several_thresholds_may_depend_on_a_number():
    """Who crosses while somebody comes from the right within 2 s, and who is in sight to either side of a heading."""
    rng = np.random.default_rng(0)
    own, right, speed = (rng.uniform(*ends, (30_000, 1)) for ends in ((-8, 12), (-8, 12), (0, 2.5)))
    unsafe = ((np.abs(own) < 1.6) & (right > 0) & (right < 2.0 * speed))[:, 0]
    x = np.stack([own, right, speed], -1).astype(np.float32)
    found, _ = cause_search.find(x, unsafe, np.arange(30_000) // 50, ["own.gap", "right.gap", "right.speed"])
    (cause,) = found.causes
    assert found.explained > 0.99 and found.false_alarms < 0.001
    (soon,) = [one for one in cause.reads[0].parts if len(one.parts) == 2]
    np.testing.assert_allclose(soon.weights[1] / soon.weights[0], -2.0, atol=0.05)
    bearing = rng.uniform(-2, 2, (30_000, 1))
    unsafe = ((right > 0) & (right < 6) & (np.abs(bearing - 0.5 * speed) < 0.6))[:, 0]
    x = np.stack([right, speed, bearing], -1).astype(np.float32)
    found, _ = cause_search.find(x, unsafe, np.arange(30_000) // 50, ["own.ahead", "own.rate", "own.bearing"])
    assert found.explained > 0.97 and found.false_alarms < 0.002
    slanted = [one for one in found.causes[0].reads[0].parts if len(one.parts) == 2]
    assert len(slanted) == 2, "both sides"


@pytest.mark.parametrize("what", ["three", "flat", "middle"])
def test_danger_may_be_of_three_or_of_all(what):
    """No three within a metre of each other; an area between them; how far the middle of all is."""
    rng = np.random.default_rng(0)
    place = rng.uniform(-1.4, 1.4, (20_000, 4, 2))
    offset = place[:, others_of(4)] - place[:, :, None]
    far = np.linalg.norm(place[:, None] - place[:, :, None], axis=-1)
    trios = [(i, j, k) for i in range(4) for j in range(i) for k in range(j)]
    widest = np.stack([np.max([far[:, i, j], far[:, i, k], far[:, j, k]], 0) for i, j, k in trios], -1)
    one, two = (np.stack([place[:, t[m]] - place[:, t[0]] for t in trios], 1) for m in (1, 2))
    area = 0.5 * np.abs(one[..., 0] * two[..., 1] - one[..., 1] * two[..., 0])
    middle = np.linalg.norm(offset.sum(2) / 4, axis=-1)
    unsafe = {"three": widest.min(1) < 0.8, "flat": area.min(1) < 0.02, "middle": middle.max(1) > 1.6}[what]
    x = offset.reshape(20_000, 4, -1).astype(np.float32)
    names = [f"other{j}.{d}" for j in range(3) for d in ("dx", "dy")]
    found, _ = cause_search.find(x, unsafe, np.arange(20_000) // 30, names)
    (cause,), (edge,) = found.causes, found.edges
    assert found.explained > 0.95 and found.false_alarms < 0.05
    assert edge.at == pytest.approx({"three": 0.8, "flat": 0.02, "middle": 6.4}[what], rel=0.05)
    assert cause.things == (1 if what == "middle" else 3)


def test_who_looks_somewhere_does_so_by_an_angle_or_its_cosine_and_sine():
    names = ["other0.dx", "other0.dy", "own.cos", "own.sin"]
    ahead, angle = (
        next(one for one in cause_candidates.pairs(of) if "other.ahead" in one.name)
        for of in (names, [*names[:2], "own.yaw"])
    )
    x = np.random.default_rng(0).normal(0, 2, (50, 1, 3)).astype(np.float32)
    looks = np.concatenate([x[..., :2], np.cos(x[..., 2:]), np.sin(x[..., 2:])], -1)
    np.testing.assert_allclose(ahead.of(looks), angle.of(x), atol=1e-5)
    np.testing.assert_allclose(angle.of(jnp.asarray(x)), angle.of(x), atol=1e-5)


def test_danger_that_nothing_tells_has_no_cause(logged):
    x, unsafe, episode = logged
    chance = np.random.default_rng(0).random(len(x)) < 0.05
    assert cause_search.find(x, chance, episode, NAMES)[0].causes == ()


def scarce(logged, episodes: int):
    """The logged steps with contacts in so many episodes alone, one of which holds most of them."""
    x, _, episode = logged
    pairs = x[..., [5, 6, 7, 8]].reshape(*x.shape[:2], 2, 2)
    near = (np.linalg.norm(pairs, axis=-1) < NEAR).any((1, 2))
    touched = np.unique(episode[near], return_counts=True)
    some = [touched[0][touched[1].argmax()], *touched[0][touched[1] == 2][: episodes - 1]]
    kept = np.isin(episode, some) | ~np.isin(episode, touched[0])
    return x[kept], near[kept], episode[kept]


def test_scarce_danger_has_a_cause_that_tells_all_of_it(logged, monkeypatch):
    """Seven episodes are too few for any standard error, but not where a distance tells each from what the others say;
    three are."""
    x, unsafe, episode = scarce(logged, 7)
    found, _ = cause_search.find(x, unsafe, episode, NAMES)
    assert [c.name for c in found.causes] == ["length of other.dx, other.dy"]
    assert found.edges[0].at == pytest.approx(NEAR, abs=0.03)
    chance = unsafe[np.random.default_rng(1).permutation(len(unsafe))]
    assert not cause_search.find(x, chance, episode, NAMES)[0].causes
    assert not cause_search.find(*scarce(logged, 3), NAMES)[0].causes
    monkeypatch.setattr(cause_search, "NEARLY_ALL", 2.0)
    assert not cause_search.find(x, unsafe, episode, NAMES)[0].causes


def test_who_must_be_near_some_is_lost_near_others():
    """Within 4 m of either base, and away from who is no base, which is known once the first is."""
    rng = np.random.default_rng(0)
    offset = rng.normal(0, 3.5, (20_000, 1, 3, 2))
    far = np.linalg.norm(offset, axis=-1)
    lost, met = far[..., :2].min(-1) > 4, far[..., 2] < 1.5
    x = offset.reshape(20_000, 1, 6).astype(np.float32)
    names = [f"other{j}.{d}" for j in range(3) for d in ("dx", "dy")]
    found, _ = cause_search.find(x, (lost | met)[:, 0], np.arange(20_000) // 40, names)
    assert found.explained > 0.98 and found.false_alarms < 0.005
    assert any("the nearest among other0, other1" in cause.name for cause in found.causes)


def test_what_holds_for_some_agents_alone_is_found(logged):
    """The first two must not drift apart; the third may go where it likes."""
    x, _, episode = logged
    apart = np.linalg.norm(x[:, 0, 5:7], axis=-1) > 3.0
    found, _ = cause_search.find(x, apart, episode, NAMES)
    assert len(found.causes) == 1 and found.explained > 0.9
    assert found.causes[0].vector and set(found.causes[0].who) <= {(0, 0), (1, 0)}
    assert "of agent" in found.causes[0].name
    assert abs(found.edges[0].at - 3.0) < 0.05 and not found.edges[0].below
    net = blank(found, 8)[0]
    each = np.asarray(scores(net, jnp.asarray(x[:5])))
    held = net.cause.holds(N)
    assert (each[:, ~held] == FAR).all() and (each[:, held] < FAR).all()


def test_a_blurred_cause_of_all_does_not_hide_those_of_some(monkeypatch):
    """Agents in a row, each too far from the next: by entries without names, which hold others in the team's order, the
    distance to two others tells some of it of everybody, and the one to its own neighbours all of it."""
    n, episodes, steps = 5, 300, 40
    rng = np.random.default_rng(0)
    place = np.cumsum(rng.normal(0, 0.06, (episodes, steps, n)), 1) + rng.normal(0, 0.3, (episodes, 1, n))
    others = np.array([[j for j in range(n) if j != i] for i in range(n)])
    x = (place[..., others] - place[..., None]).reshape(-1, n, n - 1).astype(np.float32)
    unsafe = (np.abs(np.diff(place, axis=-1)) > 1.0).any(-1).reshape(-1)
    about = (x, unsafe, np.repeat(np.arange(episodes), steps), [f"obs{d}" for d in range(n - 1)])
    found, _ = cause_search.find(*about)
    assert found.explained > 0.97 and found.false_alarms < 0.01
    assert {c.name.split(" of ")[0] for c in found.causes} == {f"obs{d}" for d in range(n - 1)}
    assert all({agent for agent, _ in c.who} <= {int(c.name[3]), int(c.name[3]) + 1} for c in found.causes)
    for edge in found.edges:
        np.testing.assert_allclose(edge.bounds, (-1.0, 1.0), atol=0.05)
    monkeypatch.setattr(cause_search, "ENOUGH", 0.0)
    assert cause_search.find(*about)[0].false_alarms < 0.01, "causes of fewer entries take a blurred one's place"
    monkeypatch.setattr(cause_search, "_split", lambda steps, chosen, names: chosen)
    assert cause_search.find(*about)[0].false_alarms > 0.01, "without both"


def test_a_cause_is_not_about_agents_who_have_nothing_of_it():
    """Two batteries and an engine, whose charge is 0 in the logs: it would stand in the midst of their danger."""
    chance = np.random.default_rng(0)
    x = np.zeros((300, 60, 3, 3))
    steps = chance.normal(0, 0.05, x.shape)
    charge = 0.5 + np.cumsum(steps[..., :2, 0], 1)
    charge = np.abs(charge - 2 * np.floor(charge / 2) - 1)  # mirrored at 0 and 1
    x[..., :2, 0] = charge
    x[..., 2, 1] = 20 + 10 * np.cumsum(steps[..., 2, 1], 1)
    load = np.cumsum(steps[..., 0, 2], 1)
    x[..., 2] = load[..., None]
    unsafe = (charge < 0.1).any(-1) | (np.abs(load) > 0.8)
    names = ["own.charge", "own.heat", "bus.load"]
    episode = np.repeat(np.arange(300), 60)
    found, _ = cause_search.find(x.reshape(-1, 3, 3), unsafe.ravel(), episode, names)
    told = {cause.name: edge.bounds for cause, edge in zip(found.causes, found.edges)}
    assert set(told) == {"own.charge of agent 0, agent 1", "bus.load"} and found.explained > 0.98
    assert [round(bound, 1) for bound in told["own.charge of agent 0, agent 1"]] == [0.1, 1.0]  # danger, end of logs
    wide = next(cause_candidates.wider(found.causes[list(told).index("own.charge of agent 0, agent 1")], names))
    assert wide.name == "own.charge, own.heat of agent 0, agent 1" and wide.who == ((0, 0), (1, 0))


def row_of(agents: int, steps: int, seed: int = 0):
    """A row of agents who keep their order, each of whom sees how far all others are; the next may not come nearer than
    0.3. Returns what `find` takes."""
    rng = np.random.default_rng(seed)
    gaps = np.where(rng.random((steps, agents - 1)) < 0.1, rng.uniform(0.1, 0.5, (steps, agents - 1)), 2.0)
    gaps = gaps + 0.2 * rng.random(gaps.shape)
    place = np.concatenate([np.zeros((steps, 1)), np.cumsum(gaps, 1)], 1)
    others = [[j for j in range(agents) if j != i] for i in range(agents)]
    x = np.stack([place[:, who] - place[:, [i]] for i, who in enumerate(others)], 1).astype(np.float32)
    return x, (gaps < 0.3).any(1), np.arange(steps) // 40, [f"e{d}" for d in range(agents - 1)]


def test_causes_of_fewer_entries_take_the_place_of_one_of_more():
    """Two entries tell who is next to the agents in the middle; each by itself tells it, too, wherever the other is."""
    x, unsafe, episode, names = row_of(3, 20_000)
    steps = cause_counts.some_steps(x, unsafe, episode, np.random.default_rng(0))
    both = Cause((Entry((0,), "e0"), Entry((1,), "e1")))
    whole = cause_counts.counted(steps, both, cause_counts.Explained.by(steps, []))
    split = cause_search._split(steps, [whole], names)
    assert {one.cause.name for one in split} == {"e0", "e1"}
    place = Cause((Entry((0,), "x"), Entry((1,), "y")))  # a post: neither entry tells it
    x = np.random.default_rng(0).uniform(-1, 1, (20_000, 1, 2)).astype(np.float32)
    steps = cause_counts.some_steps(x, (x**2).sum((1, 2)) < 0.1, episode, np.random.default_rng(0))
    post = cause_counts.counted(steps, place, cause_counts.Explained.by(steps, []))
    assert cause_search._split(steps, [post], ["x", "y"]) == [post]


def test_ranges_are_those_of_all_agents():
    """However many steps there are: of four agents every other row would be of two of them."""
    x = np.broadcast_to(np.arange(4.0)[:, None], (110_000, 4, 1))
    steps = cause_counts.some_steps(x, np.zeros(110_000, bool), np.arange(110_000) // 100, np.random.default_rng(0))
    assert steps.low == 0.0 and steps.high == 3.0


def cells_of(pattern, length=True, visits=100.0):
    """Cells of one number from 0 to 1, as dangerous as the pattern says; None: never visited."""
    known = np.array([v is not None for v in pattern])
    danger = np.array([v or 0.0 for v in pattern])
    entry = Entry((0,), "d")
    cause = Cause((Length((entry,)) if length else entry,))
    return Cells(cause, np.linspace(0, 1, len(pattern) + 1)[None], visits * known, danger)


def test_an_edge_does_not_flicker_and_unvisited_ends_are_unsafe():
    """One odd cell of few visits is no edge; a distance is trusted beyond what was seen, another number is not."""
    pattern = [0.99] * 4 + [0.0] * 2 + [0.99] + [0.0] * 13
    odd = cells_of(pattern)
    odd.visits[6] = 4
    assert odd.edge.bounds == (0.2,) and odd.edge.at == 0.2 and odd.edge.below
    speed = cells_of([None, *[0.0] * 15, *[0.99] * 4], length=False).edge
    assert np.allclose(speed.bounds, (-0.05, 0.8)) and speed.unseen == (True, False) and not speed.below
    corridor = cells_of([0.99] * 4 + [0.0] * 10 + [0.99] * 6, length=False).edge
    assert np.allclose(corridor.bounds, (0.2, 0.7)) and corridor.at is None and corridor.inside
    gap = cells_of([0.0] * 5 + [None] * 10 + [0.0] * 5, length=False)
    gap.danger[0] = 0.99
    assert len(gap.edge.bounds) >= 3, "what nobody visited may be a wall"


def test_a_distance_grows_without_end_and_nearer_is_worse():
    found = Found((Cause((Length((Entry((0,), "d"),)),)),), edges=(cells_of([0.99] * 4 + [0.0] * 16).edge,))
    net = blank(found, 8)[0]
    at = jnp.linspace(0.0, 50.0, 500)[:, None]
    along = np.asarray(net.of_values(at))
    assert (np.diff(along) > 0).all() and along[0] < 0 < along[-1]
    np.testing.assert_allclose(along, at[:, 0] - 0.2, atol=1e-4)
    own = with_margin(net, 0.05)
    assert float(own.of_values(jnp.array([[0.25]]))[0]) == pytest.approx(LEAST, rel=1e-3)


def test_what_nobody_visited_is_as_unsafe_as_it_should_be(logged):
    """Nearer than anybody came is unsafe, farther away is safe; a place that nobody saw is not trusted."""
    x, unsafe, episode = logged
    _, cells = cause_search.find(x, unsafe.any(1), episode, NAMES)
    by_name = {one.cause.name: one for one in cells}
    pair = by_name["length of other.dx, other.dy"]
    values, bad = pair.beyond(500, np.random.default_rng(0))
    assert not bad[values[:, 0] > 1.0].any() and bad[values[:, 0] < 0.5 * NEAR].all()
    place = next(one for name, one in by_name.items() if "own.x" in name)
    if place.cause.width == 2:
        values, bad = place.beyond(500, np.random.default_rng(0))
        assert bad[np.abs(values).max(1) > 5].all()


def test_scores_of_causes_read_what_they_name(logged):
    x, unsafe, episode = logged
    found, _ = cause_search.find(x, unsafe.any(1), episode, NAMES)
    for net in blank(found, 8, jax.random.key(0)):
        each = scores(net, jnp.asarray(x[:5]))
        assert each.shape == (5, N, net.cause.things)
        np.testing.assert_allclose(net.of_values(jnp.asarray(net.cause.of(x[:5]))), each, atol=1e-4)


# --- a World of them ---

QUICK = dict(num_ensemble=2, dynamics_updates=400, dynamics_width=32, value_updates=50, future_updates=100)


def store_of(episodes=200, unsafe=None, **card):
    rows, why = walks(episodes)
    actions = np.diff(rows[..., :2], axis=1)
    costs = (why.any(-1) if unsafe is None else unsafe(why)).any(-1)
    card = {"task": "walks", "observation_names": NAMES, **card}
    return EpisodeStore.from_episodes(rows, actions / 0.8, actions.sum((-1, -2)), costs.astype(float), card=card)


@pytest.fixture(scope="module")
def fitted():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(judging, "JUDGING", IN_FULL)
        return fit(store_of(), **QUICK, barrier_updates=1500)


def test_a_world_tells_danger_by_its_causes(fitted, tmp_path):
    from ringfence import world

    card = fitted.card
    assert card.barrier.recall > 0.97 and card.barrier.auroc > 0.99
    assert card.barrier.probed == 1.0, "somebody inside the radius is unsafe, at rest and closing"
    assert "Causes of danger" in str(card) and str(card).splitlines()[-1].startswith("VERDICT ")
    assert len(card.causes[""].causes) == len(fitted.barrier.causes) == 3
    again = world.load(world.save(fitted, tmp_path / "w.safetensors"))
    assert again.card == card
    x = again.map(jnp.asarray(walks(5)[0]), None)
    np.testing.assert_array_equal(again.barrier.of_steps(x, x), fitted.barrier.of_steps(x, x))


def test_a_guard_stays_within_what_the_logs_have_shown(fitted):
    """Beyond the logs may be a wall that nobody touched."""
    ranges = fitted.card.data.ranges
    names = ["own.x", "own.y", "own.v", *[one.name for one in cause_candidates.offsets(NAMES)]]
    assert sorted(ranges) == sorted(names), "entries of goals and others have none"
    seen = shown.Shown.by(fitted)
    row = np.zeros((N, len(NAMES)), np.float32)
    row[:, :2] = 1.0  # no post is there
    row[:, [5, 6, 7, 8]] = 2.0  # others are far
    row[:, 2] = 0.5
    most = ranges["own.x"][1]
    along = np.stack([row] * 5)
    along[:, 0, 0] = most + np.array([-1.0, 0.0, 0.05, 0.2, 5.0])
    score = np.asarray(seen.score(jnp.asarray(along)))[:, 0]
    assert score[0] > 10 and 1.0 < score[1] < 1.2 and (np.diff(score) < 0).all() and score[-1] > 0
    touching = row.copy()
    touching[1, 5:7] = 0.0
    assert np.asarray(seen.score(jnp.asarray(touching)))[1] < 1.0, "nobody was so near"

    narrow = msgspec.structs.replace(fitted.card.data, ranges=ranges | {"own.x": (ranges["own.x"][0], 1.2)})
    world = dataclasses.replace(fitted, card=msgspec.structs.replace(fitted.card, data=narrow))
    out = np.zeros((N, 2), np.float32)
    out[0, 0] = 0.5
    ends = {}
    for name, how in {"usual": {}, "no margin": {"margin": 0.0}, "beyond": {"within_logs": False}}.items():
        pilot = guard(lambda seen, state: out, world, guard="shield", **how)
        ends[name] = row[0, 0] + 0.8 * pilot.act(row)[0, 0]
    kept = max(ends["usual"], ends["no margin"])
    assert kept < 1.23 and kept + 0.1 < ends["beyond"], "whatever margin is kept"
    rows = np.stack([row] * 11)[None, None]
    slowest, fastest = ranges["own.v"]
    rows[0, 0, [1, -2], 0, 2] = fastest + 0.02 * (fastest - slowest)
    rows[0, 0, -1, 0, 0] = 1.5  # however far ahead: it may take that long to brake
    support = shown.Shown.by(world).along(jnp.asarray(rows[..., 1:, :, :]))[0, 0, :, 0]
    np.testing.assert_array_equal(support < 1, [True, *[False] * 8, True], "a speed, soon; a place, at any time")
    still = msgspec.structs.replace(fitted.card.data, ranges={"own.x": (1.0, 1.0)})
    with pytest.raises(UserError, match="within_logs keeps to what varies in the logs, and no entry of an agent does"):
        shown.Shown.by(dataclasses.replace(fitted, card=msgspec.structs.replace(fitted.card, data=still)))
    older = dataclasses.replace(fitted, card=msgspec.structs.replace(fitted.card, data=Data("walks", {})))
    with pytest.raises(UserError, match="within_logs needs a World that says what its logs have shown.*; fit it again"):
        guard(lambda seen, state: out, older, guard="shield", within_logs=True)


def test_answers_are_drawn_on_the_page_of_a_fit(fitted, tmp_path):
    answers = {probe.name: probe for probe in fitted.card.barrier.probes}
    near = answers["length of other.dx, other.dy, put into held-out states"]
    assert near.unsafe[:3] == (1.0, 1.0, 1.0) and near.unsafe[-1] == 0.0
    assert near.unsafe_closing == (), "nothing tells how fast others move"
    assert abs(answers["own.v"].edge - FAST) < 0.02
    page = build_ope(tmp_path / "card.html", fitted.card, audit(store_of())).read_text()
    assert "Called unsafe by length of other.dx, other.dy" in page and "Score along own.v" in page
    assert "http" not in page


def test_networks_on_all_entries_are_a_setting(tmp_path):
    plain = fit(store_of(60), **QUICK_WORLD, causes=False)
    assert plain.card.causes == {"": causes.Found()} and not plain.barrier.causes and plain.barrier.label
    (place,) = plain.card.barrier.maps
    assert place.name.startswith("own.x, own.y") and np.shape(place.scores) == (len(place.y), len(place.x))
    assert any(probe.name.startswith("own speed (own.v)") for probe in plain.card.barrier.probes)
    page = build_ope(tmp_path / "card.html", plain.card, audit(store_of(60))).read_text()
    assert "Score over own.x, own.y" in page and "Score along own speed" in page


def test_somebody_is_put_at_rest_and_closing():
    """Somebody 1 m away in front, who is put at half a metre: at rest, and as fast as anybody was."""
    names = ("other0.dx", "other0.dy", "other0.dvx", "other0.dvy")
    states = np.tile(np.array([1.0, 0.0, -2.0, 0.0], np.float32), (5, 1, 1))
    (cause,) = cause_candidates.offsets(names)

    class Closing(eqx.Module):
        """Danger is how fast it closes."""

        def of_steps(self, before, after):
            return after[..., 2]

    scores = probes._put(Closing(), states, names, cause, 0.5)
    np.testing.assert_allclose(scores, [[0.0] * 5, [-2.0] * 5], atol=1e-6)
    assert probes._put(Closing(), states, ("other0.dx", "other0.dy", "a", "b"), cause, 0.5).shape == (1, 5)


def test_a_cause_of_a_place_has_a_map():
    cause = Cause((Entry((0,), "own.x"), Entry((1,), "own.y")))
    found = Found((cause,), edges=(Edge((-1.0, -2.0), (1.0, 2.0)),))
    plane = probes._map(blank(found, 8, jax.random.key(0))[0], 1.0)
    assert plane.x[0] == -1.2 and plane.y[-1] == 2.4 and np.shape(plane.scores) == (len(plane.y), len(plane.x))


@pytest.mark.verdicts
def test_a_world_that_is_unfit_is_refused_unless_one_insists():
    chance = np.random.default_rng(3)
    world = fit(store_of(80, lambda why: chance.random(why.shape[:3]) < 0.02), **QUICK_WORLD)
    assert world.card.verdict.word == "unfit" and world.card.causes == {"": Found(searched=True)}, (
        "no cause explains chance"
    )
    assert any("log what tells danger" in remedy for remedy in world.card.verdict.remedies), "all are named"
    still = lambda observations, state: np.zeros((N, 2))  # noqa: E731
    with pytest.raises(UserError, match="'walks' is unfit to guard by: only .*anyway=True"):
        guard(still, world)
    assert guard(still, world, anyway=True).act(walks(1)[0][0, 0]).shape == (N, 2)


def test_verdicts_give_their_reasons():
    good = BarrierScores(entries=100, recall=0.99, margin_kept=0.9, probed=1.0)
    data = Data(task="t", hazard={})
    carried = ("99.0% of unsafe steps are found", "90.0% of safe steps keep the margin")
    assert verdict.judge(Card(data=data, barrier=good)) == Verdict("fit", carried)
    assert str(Verdict("fit", carried)) == f"fit: {carried[0]}; {carried[1]}"
    near = Probe(name="length of other.dx" + PUT, at=(), scores=(), edge=1.25, unsafe=(0.5,))
    put = verdict.judge(Card(data=data, barrier=msgspec.structs.replace(good, probed=0.5, probes=(near,))))
    assert "something put nearer than 1.25 (length of other.dx) are called unsafe" in put.reasons[0]
    cases = (
        (dict(entries=10), "weak", "only 10 held-out steps enter danger"),
        (dict(entries=2), "unfit", "only 2 held-out steps enter danger"),
        (dict(recall=0.5), "unfit", "only 50.0% of unsafe steps are found"),
        (dict(margin_kept=0.01), "unfit", "only 1.0% of safe steps keep the margin"),
        (
            dict(probed=0.5),
            "unfit",
            "only 50.0% of states with something put nearer than danger begins are called unsafe",
        ),
        (dict(warning="no held-out step is unsafe"), "unfit", "no held-out step is unsafe"),
    )
    for changes, word, reason in cases:
        found = verdict.judge(Card(data=data, barrier=msgspec.structs.replace(good, **changes)))
        assert found.word == word and found.reasons == (reason,) and found.remedies
    of_cause = Cause((Entry((0,), "own.x"),))
    for told, recall, word in ((0.59, 0.96, "weak"), (0.59, 1.0, "fit"), (0.93, 0.96, "fit")):
        causes = {"": Found((of_cause,), told)}
        found = verdict.judge(Card(data=data, barrier=msgspec.structs.replace(good, recall=recall), causes=causes))
        assert found.word == word and (word == "fit" or f"tell only {told:.1%} of the danger" in found.reasons[0])
        assert word == "fit" or "give a formula of danger" in found.remedies[0]
    for looked, word in ((True, "weak"), (False, "fit")):
        none = verdict.judge(Card(data=data, barrier=good, causes={"": Found(searched=looked)}))
        assert none.word == word and (word == "fit" or none.reasons[0].startswith("no cause of its danger is found"))
    for names, remedy in (
        (("obs0", "obs1"), "name the entries that tell danger, or log them"),
        (
            ("own.x", "own.y"),
            "log what tells danger, or give a formula of danger (hazard) if it is of distances or speeds",
        ),
    ):
        known = PredictionError(steps_ahead=(1,), error_of_change=(0.1,), by_entry=dict.fromkeys(names, (0.1,)))
        missed = msgspec.structs.replace(good, recall=0.5)
        found = verdict.judge(Card(data=data, barrier=missed, prediction_error=known))
        assert found.remedies[0].startswith(remedy)
    both = verdict.judge(Card(data=data, barrier=msgspec.structs.replace(missed, probed=0.5), prediction_error=known))
    assert len(both.reasons) == 2 and str(both).count("give a formula of danger") == 1, "no remedy is said twice"
    for error, word, reason in (
        (0.95, "weak", "constant velocity errs by 90%"),
        (1.3, "unfit", "err by 1.3 times as much as what they predict changes at all"),
        (3e6, "unfit", "err by hundreds of times as much"),
    ):
        blind = PredictionError(steps_ahead=(1,), error_of_change=(error,), by_entry={}, coasting=(0.9,))
        found = verdict.judge(Card(data=data, barrier=good, prediction_error=blind))
        assert found.word == word and reason in found.reasons[0]


def test_the_number_that_is_too_few_is_said():
    """Entries into danger, of which there is one: its episode is unsafe for thirty steps."""

    def four_stay_in_danger(why):
        unsafe = np.zeros(why.shape[:3], bool)
        unsafe[:4, 10:] = True
        return unsafe

    scores = fit(store_of(80, four_stay_in_danger), **QUICK_WORLD).card.barrier
    assert scores.warning.startswith("too few held-out steps enter danger (1) to say how well")


@pytest.mark.verdicts
def test_values_that_are_worse_than_none_are_not_climbed(small_world):
    """By `anyway` they are; who does not climb them is not asked."""
    card = msgspec.structs.replace(small_world.card, values=ValueScores(0.5, -0.274), verdict=Verdict("fit"))
    misled = dataclasses.replace(small_world, card=card)
    assert "returns-to-go are predicted worse than by their mean: guards that climb them" in str(card)
    still = lambda observations, state: np.zeros((3, 2))  # noqa: E731
    with pytest.raises(UserError, match="returns-to-go worse than by their mean, and these options climb them"):
        guard(still, misled, guard="full")
    assert guard(still, misled, guard="full", anyway=True) and guard(still, misled, guard="shield")


def test_a_world_of_before_says_that_it_has_no_verdict():
    card = Card(data=Data(task="t", hazard={}), format=4, barrier=BarrierScores(entries=100))
    assert str(card).splitlines()[-1] == "VERDICT none: an earlier version fitted it; fit it again to have one."


def test_a_card_says_how_far_guards_look_and_what_their_margin_is():
    def words(rows):
        avoidable = Avoidable(before=(1, 3), avoided=(0.5, 0.9), rows=rows)
        scores = BarrierScores(unsafe_share=0.1, margin=4.0, miscoverage=0.001, avoidable=avoidable)
        return str(Card(data=Data(task="t", hazard={}), barrier=scores))

    assert "(horizon=30; guards look up to 15 ahead by themselves)" in words(30)
    assert "(horizon=15)" in words(15)
    assert "Default margin 4 (--margin 1 stands for it)" in words(15)
    assert "Margins that are added" not in words(15)
    wider = BarrierScores(margin=4.0, widening=((0.0,) * 15, (0.0,) * 4 + (0.5,) * 11))
    two = Found(tuple(Cause((Entry((0,), name),)) for name in ("own.v", "own.x")), edges=(Edge((0.0,), (1.0,)),) * 2)
    said = str(Card(data=Data(task="t", hazard={}), barrier=wider, causes={"": two}))
    assert "rows ahead, which are predicted worse: own.x 0.5 at 5, 0.5 at 10, 0.5 at 15." in said


def test_a_world_that_foresees_worse_than_constant_velocity_says_so():
    data = Data(task="t", hazard={})
    good = BarrierScores(entries=100, recall=0.99, margin_kept=0.9, probed=1.0)

    def card(error, coasting, seconds=(0.96, 2.0)):
        one = Foresight("length of other.dx, other.dy, of the nearest", (12, 25), error, coasting, 2.0, seconds)
        prediction = PredictionError(steps_ahead=(1,), error_of_change=(0.1,), by_entry={}, read=(one,))
        return Card(data=data, barrier=good, prediction_error=prediction)

    blind = card((0.1, 0.4), (0.2, 0.3))
    assert verdict.judge(blind).word == "weak"
    assert verdict.judge(blind).reasons == (
        "it errs by 0.4 in length of other.dx, other.dy, of the nearest at 2 s, and constant velocity by 0.3",
    )
    said = "predicted to 0.1 at 0.96 s, 0.4 at 2 s (constant velocity: 0.2, 0.3, which predicts it better)"
    assert said in str(blind)
    assert verdict.judge(card((0.1, 0.2), (0.2, 0.3))).word == "fit"
    assert verdict.judge(card((0.0, 0.019), (0.0, 0.0))).word == "fit", "so little is no error"
    assert "at 25 steps" in str(card((0.1, 0.2), (0.2, 0.3), ()))
    rays = card((0.9, 1.2), (1.0, 1.4))
    assert verdict.judge(rays).word == "fit", "of networks on all entries that is no single number"
    told = msgspec.structs.replace(rays, causes={"": Found((Cause((Entry((0,), "ray"),)),), 1.0)})
    assert verdict.judge(told).reasons == (
        "length of other.dx, other.dy, of the nearest is predicted to 0.9 at 0.96 s, 45% of its deviation",
    )
    assert verdict.judge(told).word == "weak"
    worse = msgspec.structs.replace(card((2.2, 2.4), (2.3, 2.5)), causes=told.causes)
    assert verdict.judge(worse).word == "unfit", "worse than by its mean"


@pytest.mark.judged
def test_a_guards_search_finds_no_danger_in_a_good_barrier_and_some_in_a_bad_one(fitted):
    """The second one is blind to others, and drives into them."""
    assert fitted.card.barrier.searched < 0.02 and fitted.card.barrier.avoidable is not None
    store = store_of()
    blind = dataclasses.replace(fitted.barrier, causes=fitted.barrier.causes[:1])
    assert "other" not in blind.causes[0].cause.name
    map = fitted.map
    logged = Logged.of(store, map, held_out(store, 0), labels_of(store, map, fitted.card.settings, None))
    assert searched.false_safe(dataclasses.replace(fitted, barrier=blind), logged, IN_FULL) > 0.02


def test_entries_that_a_cause_does_not_explain_leave_its_margin(fitted):
    """Of a distance the margin is the same where posts and speeds are dangerous, too, of which it knows nothing."""
    net = next(net for net in fitted.barrier.causes if net.cause.vector and "other" in net.cause.name)

    def length(unsafe) -> float:
        store = store_of(unsafe=unsafe)
        labels = labels_of(store, fitted.map, fitted.card.settings, None)
        logged = Logged.of(store, fitted.map, held_out(store, 0), labels)
        (own,) = margins.in_own_margins([net], fitted.dynamics, logged, np.random.default_rng(0))
        return float(LEAST / jnp.exp(own.log_gain) * own.scale)

    of_pairs = length(lambda why: why[..., 0])
    assert of_pairs < 0.5 * NEAR
    assert length(lambda why: why.any(-1)) == pytest.approx(of_pairs, rel=0.3)


@pytest.mark.judged
def test_margins_widen_by_what_rows_ahead_are_predicted_worse(fitted):
    """Where every step is predicted to lead farther apart than it does, by more in every row ahead; rows for which the
    margin itself is calibrated ask for no more."""
    store = store_of()
    logged = Logged.of(store, fitted.map, held_out(store, 0), labels_of(store, fitted.map, fitted.card.settings, None))

    class Sparse(eqx.Module):
        """Dynamics by which others part."""

        def step(self, x, action):
            after, spread = fitted.dynamics.step(x, action)
            return after.at[..., 5:].multiply(1.05), spread

    def of(dynamics):
        found = margins.widening(fitted.barrier, dynamics, logged, np.random.default_rng(2), IN_FULL.widened, 1000)
        return dict(zip((net.cause.name for net in fitted.barrier.causes), found))

    pair = "length of other.dx, other.dy"
    good, bad = of(fitted.dynamics), of(Sparse())
    for one in (*good.values(), *bad.values()):
        assert one[:3] == (0.0, 0.0, 0.0) and list(one) == sorted(one)
    assert bad[pair][9] > good[pair][9] + 0.5
    assert bad["own.v"] == good["own.v"]


def test_scores_of_rows_ahead_are_less_by_what_they_ask_for(fitted):
    rows = jnp.asarray(walks(1)[0][:, :7])
    plain = fitted.barrier.along(rows)
    np.testing.assert_array_equal(plain, fitted.barrier.apart(rows[:, :-1], rows[:, 1:]))
    count = len(fitted.barrier.causes)
    nothing = fitted.barrier.along(rows, [(0.0,)] * count)
    np.testing.assert_allclose(jnp.maximum(nothing, 0.0), jnp.maximum(plain, 0.0), atol=1e-5)
    wider = fitted.barrier.along(rows, [(0.0, 0.0, 1.0)] * count)
    np.testing.assert_array_equal(wider[:, :2], nothing[:, :2])
    assert (wider[:, 2:] < nothing[:, 2:]).all()
    parts = fitted.barrier.parts(rows, [(0.0, 0.0, 1.0)] * count)
    np.testing.assert_allclose(parts.min(-1), wider[..., 0], atol=1e-5)
    far = fitted.barrier.along(rows, [(60.0,)] * count), fitted.barrier.along(rows, [(61.0,)] * count)
    assert (far[1] < far[0] - 0.01).all(), "deep in danger there is still a way out"


def test_an_entry_that_few_steps_show_has_the_edges_of_another():
    """Pairs in a row: those in front hardly ever touch, and where they do is told by those behind."""
    rng = np.random.default_rng(0)
    x = rng.uniform(-3, 3, (40_000, 1, 2))
    episode = np.repeat(np.arange(400), 100)
    touch = np.abs(x[:, 0]) < 0.3
    rare = np.flatnonzero(touch[:, 1])
    x[rare, 0, 1] += np.where(np.arange(len(rare)) % 300, 1.0, 0.0)
    touch = np.abs(x[:, 0]) < 0.3
    assert touch[:, 1].sum() < 20
    found, cells = cause_search.find(x, touch.any(1), episode, ["e0", "e1"])
    assert [one.name for one in found.causes] == ["e0", "e1"] and len(cells) == 2
    assert [pytest.approx(edge.bounds[1:3], abs=0.03) for edge in found.edges] == [(-0.3, 0.3)] * 2
    alone, _ = cause_search.find(x, touch[:, 1], episode, ["e0", "e1"])
    assert not alone.causes, "too few by themselves"
    safe = touch.any(1) & ~(touch[:, 1] & (np.cumsum(touch[:, 1]) % 3 == 0))
    assert [one.name for one in cause_search.find(x, safe, episode, ["e0", "e1"])[0].causes] == ["e0"]


def test_foresight_is_of_what_the_barrier_reads(fitted):
    read = {one.name: one for one in fitted.card.prediction_error.read}
    assert set(read) == {"own.v", *(n for n in read if "own.x" in n), "length of other.dx, other.dy, of the nearest"}
    near = read["length of other.dx, other.dy, of the nearest"]
    assert near.steps_ahead == (1, 3, 5, 10, 15) and near.seconds == ()
    assert near.error[0] < near.coasting[0] and near.beats_coasting


def test_foresight_reads_the_thing_in_most_danger():
    """Two others at 3 and 4 m, who change places in the list: the nearest is where it was."""
    x = np.array([3.0, 0.0, 0.0, 4.0]).reshape(1, 1, 1, 4)
    (cause,) = cause_candidates.offsets([f"other{j}.d{c}" for j in range(2) for c in "xy"])
    near, far = Edge((0.0,), (9.0,), at=1.0), Edge((0.0,), (9.0,), at=1.0, below=False)
    asked = ((x, cause, near), (x[..., [2, 3, 0, 1]], cause, near), (x, cause, far))
    found = [judging._read(*one).item() for one in (*asked, (x, causes.narrowed(cause, ((0, 1),)), near))]
    np.testing.assert_allclose(found, [3.0, 3.0, 4.0, 4.0])
    place = judging._read(x, Cause((Entry((0,), "own.x"), Entry((3,), "own.y"))), None)
    assert place.shape == (1, 1, 2) and judging._lengths(place) == (5.0,)


def test_constant_velocity_is_that_of_the_names():
    """Who changes places in a list of others has not jumped."""
    table = np.arange(4)[None]
    names = ("own.x", "other0.dx", "other0.dvx", "own.yaw")
    map = FeatureMap("pruned", names, "observations", table, -np.ones_like(table), turns=(Turn(3, -np.pi, 2 * np.pi),))
    before, now = np.array([[[0.0, 5.0, 1.0, 3.0]]]), np.array([[[1.0, -3.0, 2.0, -3.0]]])
    turned = 2 * np.pi - 6.0
    np.testing.assert_allclose(judging._moved(map, now, before, 0.5), [[[1.0, 1.0, 1.0, turned]]])
    np.testing.assert_allclose(judging._moved(map, now, before, None), [[[1.0, -8.0, 1.0, turned]]])


def test_foresight_is_told_in_seconds_where_logs_say_how_long_a_step_is():
    """Of as many rows, since these are what guards look at."""
    world = fit(store_of(60, dt=20.0), **QUICK_WORLD)
    assert world.card.data.dt == 20.0
    for one in world.card.prediction_error.read:
        assert one.steps_ahead == (1, 3, 5, 10, 15) and one.seconds == (20.0, 60.0, 100.0, 200.0, 300.0)


def test_episodes_with_danger_are_held_out_like_the_others():
    store = store_of(100)
    unsafe = np.zeros(store.steps, bool)
    unsafe[::STEPS][:20] = True  # the first step of twenty episodes
    out = held_out(store, 0, unsafe)
    assert out[:20].sum() == 6 and out[20:].sum() == 8, "three tenths of the few dangerous ones, a tenth of the rest"
    assert held_out(store, 0, np.zeros(store.steps, bool)).sum() == 10


def test_velocities_follow_from_speed_and_heading():
    """`otherJ.dvx` is the other's v cos less one's own, so it is predicted from what everybody does."""
    rng = np.random.default_rng(0)
    steps = 60
    turn = np.cumsum(rng.normal(0, 0.2, (steps, 2)), 0)
    speed = rng.uniform(0, 1, (steps, 2))
    velocity = speed[..., None] * np.stack([np.cos(turn), np.sin(turn)], -1)
    other = velocity[:, ::-1] - velocity
    rows = np.concatenate([speed[..., None], np.cos(turn)[..., None], np.sin(turn)[..., None], other], -1)
    names = ("own.v", "own.cos", "own.sin", "other0.dvx", "other0.dvy")
    found = features.from_data("pruned", rows.astype(np.float32), None, names, ())
    assert found.follows == (3, 4)
    guess = jnp.asarray(rows, jnp.float32).at[1:, :, 3:].set(0.0)
    np.testing.assert_allclose(found.agreed(guess[None])[0], rows, atol=1e-5)
    assert features.from_dict(features.to_dict(found)) == found


def test_no_card_asks_for_more_rows_than_a_planner_plans():
    from ringfence.guards.policy import _held_by_plans

    asked = {"horizon": 15, "within_logs": True}
    planner = types.SimpleNamespace(rows_planned=7)
    assert _held_by_plans(planner, asked) == {"horizon": 7, "within_logs": True}
    assert _held_by_plans(planner, {"horizon": 5}) == {"horizon": 5}
    assert _held_by_plans(planner, {"terminal_value": True}) == {"terminal_value": True}
    assert _held_by_plans(lambda obs: obs, asked) == asked


def test_a_guard_looks_as_far_as_the_card_asks(fitted):
    from ringfence.guards.policy import by_card

    def asked(card):
        card = msgspec.structs.replace(card, look=verdict.look_of(card))
        return by_card(dataclasses.replace(fitted, card=card), "shield", {})

    def seen(rows, avoided, error):
        barrier = BarrierScores(avoidable=Avoidable(before=(1, 3, 10), avoided=avoided, rows=rows))
        prediction = PredictionError(steps_ahead=(8,), error_of_change=(error,), by_entry={})
        card = Card(data=Data("walks", {}), barrier=barrier, prediction_error=prediction)
        return asked(card)

    assert seen(10, (0.1, 0.4, 0.9), 0.1) == {"horizon": 10}
    assert seen(3, (0.1, 0.9, 0.9), 0.1) == {}, "three rows see nearly all"
    assert seen(10, (0.1, 0.4, 0.9), 0.8) == {}, "rows that are predicted badly see nothing"

    def foreseen(*errors, wide=((0.0,), (0.0,)), late=None):
        read = [Foresight(str(error), (4, 10, 20), error, error, 1.0) for error in errors]
        error = PredictionError(steps_ahead=(8,), error_of_change=(0.8,), by_entry={}, read=tuple(read))
        barrier = BarrierScores(widening=wide, avoidable=late)
        return asked(Card(data=Data("walks", {}), barrier=barrier, prediction_error=error)).get("horizon")

    assert foreseen((0.1, 0.1, 0.2), (0.0, 0.1, 0.3)) == 15
    assert foreseen((0.1, 0.1, 0.2), (0.0, 0.1, 0.4)) == 10, "as far as all that is read is foreseen"
    assert foreseen((0.1, 0.5, 0.6)) == 4
    assert foreseen((0.4, 0.5, 0.6)) is None
    sums, soon = (Avoidable((3, 15, 30), (0.0, share, 1.0), 30) for share in (0.3, 0.6))
    assert foreseen((0.1, 0.1, 0.2), late=sums) == 30, "a dose adds up, and is avoided long before"
    assert foreseen((0.1, 0.1, 0.2), late=soon) == 15 and foreseen((0.1, 0.1, 0.4), late=sums) == 10
    assert foreseen((0.1, 0.1, 0.2), wide=()) is None, "Worlds of before do not say what rows ahead ask for"
