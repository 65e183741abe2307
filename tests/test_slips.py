"""Names and formulas that nobody reads are told before minutes are spent on a World."""

from __future__ import annotations

import dataclasses
import warnings

import numpy as np
import pytest

from ringfence.datasets import registry
from ringfence.datasets.audit import audit, odd_danger, slips
from ringfence.logs.store import EpisodeStore
from ringfence.problem.constraints import Separation, to_dict
from ringfence.training import worlds

NAMES = ["own.x", "own.y", "goal.dx", "goal.dy", "other0.dx", "other0.dy", "other1.dx", "other1.dy"]


@pytest.mark.parametrize(
    "name, slip, pair",
    [
        ("other0.dx", "othr0.dx", ("other0.dy", "othr0.dx")),
        ("own.x", "onw.x", None),  # too far from it for a guess
        ("other1.dx", "other1.ddx", ("other0.dx", "other1.ddx")),
        ("goal.dy", "gaol.dy", ("goal.dx", "gaol.dy")),
    ],
)
def test_a_slip_of_the_pen_is_seen(name, slip, pair):
    found = slips([slip if one == name else one for one in NAMES])
    assert len(found) == (pair is not None)
    if pair:
        assert all(f"'{one}'" in found[0] for one in pair) and "name them alike" in found[0]


def test_names_that_are_right_are_left_alone():
    assert slips(NAMES) == []
    assert slips(["own.x", "speed", "other0.dx", "other0.dy", "other0.dvx", "other1.dx", "other1.dy", "lidar.0"]) == []
    for task in registry.TASKS.values():
        names = [*getattr(task.env, "observation_names", ()), *getattr(task.env, "state_names", ())]
        assert slips(names) == [], task.name


def logs(names: list[str], cost: float = 1.0, hazard=None) -> EpisodeStore:
    rng = np.random.default_rng(0)
    shape = (6, 9, 3, len(names))
    costs = cost * (rng.random((6, 8)) < 0.3)
    card = {"task": "mine", "observation_names": names} | ({"hazard": hazard} if hazard else {})
    return EpisodeStore.from_episodes(
        rng.normal(size=shape), rng.uniform(-1, 1, (6, 8, 3, 2)), rng.normal(size=(6, 8)), costs, card=card
    )


def test_what_a_world_would_not_know_is_told_before_it_is_fitted(monkeypatch):
    """By `fit`, and by `data info`."""

    class Begun(Exception):
        pass

    def stop(*_, **__):
        raise Begun

    monkeypatch.setattr(worlds, "Fit", stop)
    unnamed = [f"o{k}" for k in range(8)]
    for store, said in (
        (logs([n.replace("other0.dx", "othr0.dx") for n in NAMES]), "look like one kind of entry"),
        (logs(unnamed, hazard=Separation(0.3)), "formula of danger is left aside.* reads the feature 'other0.dx'"),
        (logs(NAMES, cost=0.0), "no guard can use this World"),
    ):
        with pytest.warns(UserWarning, match=said), pytest.raises(Begun):
            worlds.fit(store)
    for store in (logs(NAMES), logs(NAMES, hazard=Separation(0.3))):
        with warnings.catch_warnings(), pytest.raises(Begun):
            warnings.simplefilter("error")
            worlds.fit(store)
    told = audit(logs(unnamed, hazard=Separation(0.3))).warnings
    assert any("left aside" in warning for warning in told)


def test_simulators_of_the_package_are_not_warned_of(small_store):
    assert odd_danger(small_store, registry.from_store(small_store)) == []
    costs = dataclasses.replace(small_store, card=small_store.card.updated(hazard=to_dict(Separation(0.3))))
    assert odd_danger(costs, registry.from_store(costs)) == []
