"""Logs of own homogeneous agents in all that a card may say of them: a global state, coordinates of a map, a formula
and no costs."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ringfence import Controller
from ringfence.datasets.audit import audit
from ringfence.errors import UserError
from ringfence.evaluation import ope
from ringfence.evaluation.replay import check_view
from ringfence.loading.resolve import load, load_job
from ringfence.logs.store import EpisodeStore
from ringfence.training import loop, worlds
from tests.quick import QUICK_WORLD

FAR = np.array([5e5, 5.4e6])
NAMES = ["own.x", "own.y", "other0.dx", "other0.dy"]


@pytest.fixture(scope="module")
def store():
    """Two points that walk about and are pushed."""
    rng = np.random.default_rng(0)
    pushes = rng.uniform(-1, 1, (30, 20, 2, 2))
    begun = rng.uniform(-0.6, 0.6, (30, 1, 2, 2))
    x = FAR + np.concatenate([begun, begun + 0.1 * pushes.cumsum(1)], 1)
    seen = np.concatenate([x, x[:, :, ::-1] - x], -1)
    formula = {"kind": "Separation", "radius": 0.3}
    card = {"task": "walkers", "homogeneous": True, "observation_names": NAMES, "hazard": formula, "dt": 0.1}
    state = x.reshape(*x.shape[:2], 4)
    return EpisodeStore.from_episodes(seen, pushes, np.zeros((30, 20)), None, state=state, card=card)


def test_they_are_judged_learned_and_guarded(store, tmp_path):
    assert "cost and hazard disagree" in audit(store).facts
    assert store.card.origins.observations is not None and store.card.origins.state is not None
    world = worlds.fit(store, **QUICK_WORLD)
    tiny = {"num_updates": 2, "batch": 16, "width": 16, "depth": 1}
    run = loop.train("bc", store, out=tmp_path, changes=tiny, quiet=True)[0]
    cheap = {"horizon": 1, "correction_steps": 1, "correction_restarts": 0, "within_logs": False}
    pilot = Controller(run, guard="shield", world=world, **cheap)
    seen = store.card.origins.measured(store.observations[0], None)[0]
    action = pilot.act(seen)
    pilot.reset()
    np.testing.assert_array_equal(pilot.act(seen, np.zeros(4)), action)  # they read no state


def test_logs_without_the_state_that_is_read_are_refused(small_store, small_world, tmp_path):
    tiny = {"num_updates": 2, "batch": 16, "width": 16, "depth": 1}
    card = small_store.card.updated(task="mine", hazard={"kind": "CostColumn"}, state_names=None)
    own = dataclasses.replace(small_store, card=card)
    run = loop.train("bc", own, out=tmp_path, changes=tiny | {"view": "pruned"}, quiet=True)[0]
    blind = dataclasses.replace(own, state=None)
    with pytest.raises(UserError, match="reads the global state, and the logs hold none"):
        ope.ope(run, blind)
    with pytest.raises(UserError, match="reads a global state of 18 entries, the logs hold none"):
        check_view(small_world, blind)


def test_a_formula_that_the_state_alone_tells_guards_who_does_not_see_it(small_store, tmp_path):
    """And a World is cached by all that its card tells."""
    card = small_store.card.updated(task="mine", hazard={"kind": "Separation", "radius": 0.3})
    own = dataclasses.replace(small_store, observations=small_store.observations[:, :, :2], card=card)  # velocities
    world = worlds.fit(own, **QUICK_WORLD)
    tiny = {"num_updates": 2, "batch": 16, "width": 16, "depth": 1}
    run = loop.train("bc", own, out=tmp_path, changes=tiny, quiet=True)[0]
    assert load_job(run).hazard.has_formula is False
    cheap = {"horizon": 1, "correction_steps": 1, "correction_restarts": 0, "within_logs": False}
    assert load(run, guard="shield", barrier="analytic", world=world, **cheap)[1].guard.barrier.hazard.has_formula
    wider = dataclasses.replace(own, card=card.updated(task="theirs", dt=0.1, hazard={"kind": "CostColumn"}))
    told = worlds.fit(wider, **QUICK_WORLD).card.data
    assert (told.task, told.dt, told.hazard["kind"]) == ("theirs", 0.1, "CostColumn")
