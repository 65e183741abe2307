"""What names of entries say, once and everywhere."""

from __future__ import annotations

import numpy as np
import pytest

from ringfence.datasets.audit import read_as
from ringfence.evaluation.replay_scene import motion_of, names_of, windows_of
from ringfence.guards.shown import _going
from ringfence.logs.store import EpisodeStore
from ringfence.problem import constraints
from ringfence.problem.entries import Entries, Entry, Names, axes_of
from ringfence.problem.features import FeatureMap, constant_velocity, derived, from_data, headed, others_offsets
from ringfence.world import cause_candidates
from ringfence.world.barrier import shape_of
from ringfence.world.stops import Heading

FIELDS = ("d{0}", "d{1}", "dv{0}", "dv{1}")
OWN = ("{0}", "{1}", "v{0}", "v{1}")


def named(axes: str, *looks: str, others: int = 2) -> tuple[str, ...]:
    names = [f"own.{field.format(*axes)}" for field in OWN] + [f"own.{word}" for word in looks]
    return (*names, *(f"other{k}.{field.format(*axes)}" for k in range(others) for field in FIELDS))


def test_an_entry_says_whose_it_is_and_in_which_role():
    found = Entries.of(["own.vx", "other12.dy", "wall_b.dvz", "own.joint0.q", "lidar_3", "own.d", "Own.x", "own."])
    assert found.each == (
        Entry("own", None, "vx", "velocity", "x", 0),
        Entry("other", 12, "dy", "offset", "y", 1),
        Entry("wall_b", None, "dvz", "drift", "z", 2),
        Entry("own", None, "joint0.q", "number", "", 3),
        Entry("own", None, "d", "number", "", 5),  # alone it is no lane's
    )
    assert found.numbered == {"other": [{"dy": 1}]} and Entries.of(found.names) is found
    assert axes_of({"dx", "ds", "dd"}) == "x" and axes_of({"ds", "dd"}) == "sd" and axes_of({"ds"}) == ""
    assert not Entries.of(["other" + "9" * 6000 + ".dx"]).bodies  # more digits than Python makes a number of


def test_lanes_are_read_as_planes_are():
    """All that is asked of names, in x and y and in lane coordinates: the same entries."""
    plane, lane = named("xy"), named("sd")
    index = np.tile(np.arange(len(plane)), (3, 1))
    maps = [
        FeatureMap("decentralized", names, "observations", index, np.full_like(index, -1)) for names in (plane, lane)
    ]
    reads = (
        lambda m: derived(m.names, 3),
        lambda m: others_offsets(m.names).tolist(),
        lambda m: [(c.width, c.entries()) for c in cause_candidates.pairs(m.names)],
        lambda m: [c.entries() for c in cause_candidates.offsets(m.names)],
        lambda m: _going(list(m.names)),
        lambda m: constant_velocity(m, 0.1).follows,
        lambda m: Names.of(m.names, (), 3).slots,
        lambda m: Names.of(m.names, (), 3).as_logged,
        lambda m: [len(part) for part in (shape_of(m).own, *shape_of(m).offsets)],
    )
    for read in reads:
        assert read(maps[0]) == read(maps[1])
    x = np.random.default_rng(0).normal(size=(5, 3, len(plane)))
    formula = constraints.Separation(0.5)
    clear = [np.asarray(constraints.bind(formula, names, 3).clearance(x)) for names in (plane, lane)]
    np.testing.assert_array_equal(*clear)
    assert np.allclose(clear[0], np.linalg.norm(x[..., [[4, 5], [8, 9]]], axis=-1).min(-1) - 0.5, atol=1e-6)


@pytest.mark.parametrize("looks", [("cos", "sin"), ("cos_yaw", "sin_yaw"), ("psi",), ("heading",)])
def test_who_looks_into_a_direction_sees_things_ahead_and_aside(looks):
    names = named("sd" if looks == ("psi",) else "xy", *looks)
    (turned,) = (c for c in cause_candidates.pairs(names) if c.name == "other.ahead, other.aside")
    assert [entry.at for entry in turned.reads[0].direction] == [(4 + k,) for k in range(len(looks))]
    heading = Heading.of(names)
    assert (heading is None) == (len(looks) == 1)
    if heading is not None:
        assert heading.velocity == (2, 3) and heading.direction == (4, 5)
    alone = tuple(name for name in names if not name.startswith("own.v")) + ("own.v",)
    assert headed(alone) == (() if heading is None else ((12, 2), (12, 3)))


def test_vehicles_in_lane_coordinates_are_replayed_and_their_entries_follow():
    g = np.random.default_rng(0)
    speed = g.uniform(-1, 1, (8, 31, 2, 2)) + np.array([5.0, 0.0])
    place = np.cumsum(speed, 1) * 0.1 + g.uniform(0, 9, (8, 1, 2, 2))
    psi = np.arctan2(speed[..., 1], speed[..., 0])[..., None]
    own = np.concatenate([place, speed], -1)
    x = np.concatenate([own, psi, own[:, :, ::-1] - own], -1).astype(np.float32)
    card = {"task": "lane", "dt": 0.1, "observation_names": list(named("sd", "psi", others=1))}
    store = EpisodeStore.from_episodes(x, np.zeros((8, 30, 2, 2)), np.zeros((8, 30)), np.zeros((8, 30)), card=card)
    map = from_data("decentralized", store.observations, None, store.entry_names, (), store.first_rows)
    assert map.follows == (5, 6, 7, 8)
    names = names_of(store)
    assert names.axes == "sd" and names.as_logged == []
    motion = motion_of(store, names)
    np.testing.assert_allclose(motion.velocity, store.observations[..., 2:4])
    windows, _ = windows_of(store, names, motion, np.arange(8), 10, 8, 0.01, 0.1)
    moved = np.array([1.0, 0.5])
    turned = np.full(windows.count, 0.3)
    seen, _ = windows.observed(3, windows.place[:, 3] + moved, windows.velocity[:, 3], turned)
    mine = seen[np.arange(windows.count), windows.driven]
    logged = windows.observations[np.arange(windows.count), 3, windows.driven]
    np.testing.assert_allclose(mine[:, :2], logged[:, :2] + moved, atol=1e-5)
    np.testing.assert_allclose(mine[:, 5:7], logged[:, 5:7] - moved, atol=1e-5)
    np.testing.assert_allclose(mine[:, 4], 0.3, atol=1e-6)


def test_what_names_say_is_shown():
    """`ringfence data info` shows what was read of each name."""
    names = ["own.x", "own.y", "own.yaw", "goal.dx", "goal.dy", *(f"other{k}.d{axis}" for k in (0, 1) for axis in "xy")]
    names += ["obs9"]
    assert read_as(names) == (
        "oneself: place x y, heading yaw; goal: from one's own place dx dy; "
        "each of 2 other: from one's own place dx dy; 1 whose names say nothing"
    )
    assert read_as(["own.gap", "right.gap"]) == "oneself: number gap; right: number gap"
    assert read_as([]) == "no names"
