"""Logs of machines whose commands take effect some steps late: how many is told, undone, and known to guards."""

import numpy as np
import pytest

import ringfence
from ringfence.cli import app
from ringfence.datasets.audit import audit
from ringfence.errors import StoreError, UserError
from ringfence.evaluation.compensation import compensated
from ringfence.evaluation.replay import check_view
from ringfence.faults import Faults
from ringfence.guards.policy import build
from ringfence.guards.wrap import Nothing
from ringfence.loading.resolve import resolve
from ringfence.logs.late import lateness
from ringfence.logs.store import EpisodeStore
from tests.quick import QUICK_WORLD

EPISODES, STEPS = 40, 30
NAMES = ["own.x", "own.y", "own.vx", "own.vy"]


def carts(delays=(2, 2), lag=0.0, pushed=True, steps=STEPS, noise=0.5, smooth=0.0, **card) -> EpisodeStore:
    """Carts that steer for the middle, as far as `noise` that is more or less `smooth` lets them. What each is told
    takes effect so many steps later, and with a `lag` little by little."""
    rng = np.random.default_rng(0)
    speed, push, drift = (np.zeros((EPISODES, len(delays), 2)) for _ in range(3))
    place = rng.normal(0, 2, speed.shape)
    seen, told = [np.concatenate([place, speed], -1)], []
    for t in range(steps):
        drift = smooth * drift + rng.normal(0, noise, place.shape)
        told.append(np.clip(-place - speed + drift, -1, 1))
        due = np.stack([told[t - late][:, i] if t >= late else 0 * push[:, i] for i, late in enumerate(delays)], 1)
        push = lag * push + (1 - lag) * due * pushed
        place, speed = place + 0.1 * speed, 0.95 * speed + 0.2 * push
        seen.append(np.concatenate([place, speed], -1))
    costs = (np.abs(np.stack(seen[1:], 1)[..., 0]) > 2).any(-1).astype(float)
    given = {"task": "carts", "dt": 0.1, "observation_names": NAMES}
    return EpisodeStore.from_episodes(
        np.stack(seen, 1), np.stack(told, 1), np.zeros((EPISODES, steps, len(delays))), costs, card=given | card
    )


@pytest.fixture(scope="module")
def world():
    """Of logs that were undelayed by two steps, and are as many as those that were not: one program fits both."""
    return ringfence.fit(ringfence.undelay(carts(steps=STEPS + 2), 2), **QUICK_WORLD)


@pytest.mark.parametrize(
    ("how", "told"),
    [
        ({"delays": (0, 0)}, (0, 0)),
        ({"delays": (2, 2)}, (2, 2)),
        ({"delays": (5,)}, (5,)),
        ({"delays": (0, 3)}, (0, 3)),
        ({"delays": (0, 0), "lag": 0.6}, (0, 0)),  # slow is not late
        ({"delays": (1,), "lag": 0.6}, (1,)),
        ({"delays": (1, 2), "noise": 0.0}, (1, 2)),  # commands follow from what is seen
        ({"delays": (0, 1), "noise": 0.05, "smooth": 0.98}, (0, 1)),  # and hardly change from step to step
        ({"delays": (2, 2), "pushed": False}, (None, None)),  # they do nothing
    ],
)
def test_how_late_commands_take_effect_is_told_by_what_agents_do(how, told):
    assert lateness(carts(**how)).steps == told


def test_logs_that_are_too_short_tell_nothing():
    store = carts()
    few = store.select(np.arange(3))
    assert lateness(few).steps == (None, None)


def test_who_reads_about_a_store_is_told_what_to_do():
    (told,) = [note for note in audit(carts()).warnings if "late" in note]
    assert "take effect 2 steps late" in told and "`ringfence data undelay --delay 2`" in told
    (told,) = [note for note in audit(carts((0, 3))).warnings if "late" in note]
    assert "0 steps late of agent 0, 3 steps late of agent 1" in told and "undelay" not in told
    assert not [note for note in audit(carts((0, 0))).warnings if "late" in note]
    with pytest.warns(UserWarning, match="take effect 2 steps late"):
        card = ringfence.fit(carts(), **QUICK_WORLD).card
    assert card.data.late == (2, 2)
    assert card.verdict.word == "unfit"
    assert "it takes commands to act at once, and these act 2 steps late" in card.verdict.reasons
    assert "undelay the logs (`ringfence data undelay --delay 2`)" in card.verdict.remedies


def test_undelayed_logs_hold_the_command_that_moved_each_step():
    store = carts()
    now = ringfence.undelay(store, 2)
    assert (now.steps, now.episodes, now.card.action_delay) == (EPISODES * (STEPS - 2), EPISODES, 2)
    old, new = (x.reshape(EPISODES, -1, *x.shape[1:]) for x in (store.actions, now.actions))
    np.testing.assert_array_equal(new, old[:, :-2])
    old, new = (x.reshape(EPISODES, -1, *x.shape[1:]) for x in (store.observations, now.observations))
    np.testing.assert_array_equal(new, old[:, 2:])
    np.testing.assert_array_equal(now.costs.reshape(EPISODES, -1), store.costs.reshape(EPISODES, -1)[:, 2:])
    assert lateness(now).steps == (0, 0)


def test_episodes_that_are_no_longer_than_the_delay_are_left_out_and_counted():
    store = carts()
    ends = np.sort(np.concatenate([store.episode_ends, [STEPS + 2]]))  # the second one is cut after two steps
    cut = EpisodeStore.from_steps(
        np.delete(store.observations, store.episode_ends + np.arange(EPISODES), 0),
        store.actions,
        store.rewards,
        costs=store.costs,
        episode_ends=ends,
        final_observations=store.observations[ends + np.searchsorted(store.episode_ends, ends)],
        card=store.card,
    )
    now = ringfence.undelay(cut, 2)
    assert now.episodes == EPISODES and now.lengths.tolist()[:3] == [STEPS - 2, STEPS - 4, STEPS - 2]
    assert now.card.warnings == ["1 episodes of 2 steps or fewer were left out by undelaying"]


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: ringfence.undelay(carts(), 0), "delay=0 must be a whole number from 1"),
        (lambda: ringfence.undelay(ringfence.undelay(carts(), 2), 1), "were undelayed by 2 steps before"),
        (lambda: ringfence.undelay(carts().select([0]), STEPS), "must be a whole number"),
        (lambda: carts(action_delay=1.5), "action_delay=1.5; it must be a whole number of steps"),
        (lambda: carts().followed_by(ringfence.undelay(carts(), 2)), "undelayed by other steps"),
    ],
)
def test_what_cannot_be_undelayed_is_refused(make, words):
    with pytest.raises((StoreError, UserError), match=words):
        make()


def test_a_guard_decides_for_so_much_later_by_itself(world):
    def delay(**options):
        return build(Nothing(), world, None, "shield", "learned", anyway=True, **options).guard.options.delay

    assert world.card.data.action_delay == 2
    assert (delay(), delay(delay=0), delay(delay=3)) == (2, 0, 3)


def test_a_delay_that_faults_add_comes_on_top(world):
    guard = build(Nothing(), world, None, "shield", "learned", anyway=True).guard
    told = compensated(None, Faults(delay=1, drop=0.3), {"guard": "shield", "world": world}, lambda spec: guard)
    assert told["delay"] == 3 and 0 < told["max_age"] <= 5


def test_a_world_and_logs_that_were_not_undelayed_alike_are_kept_apart(world):
    check_view(world, ringfence.undelay(carts(), 2))
    with pytest.raises(UserError, match="undelayed by 2 steps, these by 0"):
        check_view(world, carts())


def test_evaluation_by_undelayed_logs_alone_acts_at_once(world, tmp_path, monkeypatch):
    store = ringfence.undelay(carts(steps=STEPS + 2), 2)  # the World's own
    run = ringfence.train("bc", store, out=tmp_path, changes={"num_updates": 2, "width": 8}, quiet=True)[0]
    asked = []
    monkeypatch.setattr("ringfence.evaluation.ope.resolve", lambda spec: asked.append(spec) or resolve(spec))
    monkeypatch.setattr("ringfence.training.worlds.fit", lambda *_, **__: 1 / 0)
    for options in ({}, {"delay": 2}):
        with pytest.raises(ZeroDivisionError):
            ringfence.ope(run, store, guard="shield", world=world, anyway=True, **options)
    assert [dict(spec.guard_options)["delay"] for spec in asked] == [0, 2]


def test_the_command_line_undelays(tmp_path, capsys):
    late, now = tmp_path / "late.h5", tmp_path / "now.h5"
    carts().save(late)
    app.main(["data", "undelay", str(late), "--delay", "2", "--out", str(now)])
    assert EpisodeStore.load(now).card.action_delay == 2
    with pytest.raises(SystemExit):
        app.main(["data", "undelay", str(late), "--delay", "2", "--out", str(late)])
    assert "would be overwritten" in capsys.readouterr().err
