"""Episode stores: what they refuse, what they keep, and the windows drawn from them."""

from __future__ import annotations

import dataclasses
import json
import os
import pathlib

import h5py
import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ringfence.errors import StoreError, UserError
from ringfence.logs.schema import ARRAYS, StoreCard, complete_card
from ringfence.logs.store import EpisodeStore
from ringfence.logs.windows import NOT_ARRIVED, WindowData, at, returns_to_go
from ringfence.problem.constraints import CostColumn
from ringfence.proposals.conditions import raw_scores, return_scores
from ringfence.utils import arrays


def logs(lengths=(3, 1, 4), agents=2, seed=0, **card) -> EpisodeStore:
    """A store of noise with a global state; `other` entries of the card are passed on."""
    rng = np.random.default_rng(seed)
    ends = np.cumsum(lengths)
    t, e = int(ends[-1]), len(lengths)
    return EpisodeStore.from_steps(
        rng.normal(size=(t, agents, 5)),
        rng.uniform(-1, 1, size=(t, agents, 2)),
        rng.normal(size=(t, agents)),
        episode_ends=ends,
        final_observations=rng.normal(size=(e, agents, 5)),
        costs=rng.integers(0, 2, t),
        state=rng.normal(size=(t, 6)),
        final_state=rng.normal(size=(e, 6)),
        terminated=rng.integers(0, 2, e).astype(bool),
        card=card,
    )


def assert_same(a: EpisodeStore, b: EpisodeStore):
    for name in (*ARRAYS, "state"):
        x, y = getattr(a, name), getattr(b, name)
        assert x.dtype == y.dtype, name
        np.testing.assert_array_equal(x, y, err_msg=name)
    assert a.card == b.card


# ---------------------------------------------------------------------------------------------------------------------
# disk


def test_round_trip(tmp_path, small_store):
    for store in (small_store, logs(note="kept", agents=3)):
        loaded = EpisodeStore.load(store.save(tmp_path / "deep" / "store.h5"))
        assert_same(store, loaded)
    assert os.listdir(tmp_path / "deep") == ["store.h5"]


def test_a_store_without_state_round_trips(tmp_path):
    store = dataclasses.replace(logs(), state=None)
    assert EpisodeStore.load(store.save(tmp_path / "s.h5")).state is None


@pytest.mark.parametrize("share", [0.0, 0.3, 0.7, 0.99])
def test_truncated_file_is_refused(tmp_path, small_store, share):
    path = small_store.save(tmp_path / "s.h5")
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(StoreError, match=r"s\.h5.*truncated, damaged or no episode store"):
        EpisodeStore.load(path)


@pytest.mark.parametrize("name", ARRAYS)
def test_a_group_is_no_array(tmp_path, name):
    path = logs().save(tmp_path / "s.h5")
    with h5py.File(path, "a") as f:
        del f[name]
        f.create_group(name)
    with pytest.raises(StoreError, match=f"holds a group where the array '{name}' belongs"):
        EpisodeStore.load(path)


@pytest.mark.parametrize(
    ("card", "said"),
    [
        ("null", "got `null`"),
        ("[]", "got `array`"),
        ("{", "no episode store .Input data was truncated"),
        ('{"hazard": null}', "hazard=None; it must be a Separation"),
        ('{"hazard": "near"}', "hazard='near'; it must be"),
        ('{"hazard": {"kind": "All", "hazards": [3]}}', "which is none"),
        ('{"hazard": {"kind": []}}', "Unknown hazard"),
        ('{"hazard": {"kind": "Separation", "radius": null}}', "radius is a NoneType; give a number"),
        ('{"hazard": {"kind": "SpeedLimit", "limit": 1, "features": 3}}', "which is none"),
        ('{"task": 3}', "task=3; it must be a name without slashes"),
        ('{"task": null}', "task=None"),
        ('{"observation_names": 3}', "observation_names=3; it must be a list of words"),
        ('{"warnings": 3}', "warnings=3; it must be a list of words"),
        ('{"action_low": NaN}', "malformed"),
        ('{"action_low": 2}', "the first must be the smaller one"),
        ('{"cost_limit": "few"}', "cost_limit='few'"),
    ],
)
def test_a_card_written_by_hand_is_checked(tmp_path, card, said):
    path = logs().save(tmp_path / "s.h5")
    with h5py.File(path, "a") as f:
        f.attrs["card"] = card
    with pytest.raises(StoreError, match="has another card than was written.* delete its attribute 'card_digest'"):
        EpisodeStore.load(path)
    with h5py.File(path, "a") as f:
        del f.attrs["card_digest"]
    with pytest.raises(StoreError, match=said) as refused:
        EpisodeStore.load(path)
    assert str(path) in str(refused.value)


def test_a_card_that_says_nothing_is_completed(tmp_path):
    path = logs().save(tmp_path / "s.h5")
    with h5py.File(path, "a") as f:
        f.attrs["card"] = "{}"
        del f.attrs["card_digest"]
    loaded = EpisodeStore.load(path)
    assert loaded.card.task == "custom" and loaded.hazard == CostColumn()


@pytest.mark.parametrize("task", ["", " ", ".", "..", "a/b", "../x", "/x", "a\\b", None, 3])
def test_names_of_tasks_are_names_of_folders(task):
    with pytest.raises(StoreError, match="it must be a name without slashes"):
        logs(task=task)


@pytest.mark.parametrize("name", ARRAYS)
def test_missing_array_is_named(tmp_path, name):
    path = logs().save(tmp_path / "s.h5")
    with h5py.File(path, "a") as f:
        del f[name]
    with pytest.raises(StoreError, match=f"lacks the array '{name}'"):
        EpisodeStore.load(path)


def test_foreign_files_are_refused(tmp_path):
    foreign = tmp_path / "foreign.h5"
    with h5py.File(foreign, "w") as f:
        f["observations"] = np.zeros(3)
    with pytest.raises(StoreError, match="not an episode store"):
        EpisodeStore.load(foreign)
    text = tmp_path / "notes.txt"
    text.write_text("nothing here")
    with pytest.raises(StoreError, match=r"notes\.txt' is no episode store, by its first bytes"):
        EpisodeStore.load(text)
    with pytest.raises(StoreError, match="No episode store at"):
        EpisodeStore.load(tmp_path / "absent.h5")


def test_an_invalid_file_is_refused_by_name(tmp_path):
    path = logs().save(tmp_path / "s.h5")
    with h5py.File(path, "a") as f:
        f["costs"][2] = np.nan
    with pytest.raises(StoreError, match=r"s\.h5.*costs\[2\] is nan"):
        EpisodeStore.load(path)


@pytest.mark.parametrize("broken", ["create_dataset", "replace"])
def test_nothing_is_left_when_saving_fails(tmp_path, monkeypatch, broken):
    path = logs().save(tmp_path / "s.h5")
    before = path.read_bytes()

    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(*((h5py.Group, "create_dataset") if broken == "create_dataset" else (os, "replace")), full)
    with pytest.raises(UserError, match="No space left"):
        logs(seed=1).save(path)
    monkeypatch.undo()
    assert os.listdir(tmp_path) == ["s.h5"] and path.read_bytes() == before


# ---------------------------------------------------------------------------------------------------------------------
# validation


def changed(name, index, value):
    """A mutation: entry `index` of array `name` becomes `value`."""

    def mutate(store):
        array = getattr(store, name).copy()
        array[index] = value
        return {name: array}

    return mutate


def ends_inside(store):
    flags = store.terminated.copy()
    flags[0] = True
    return {"terminated": flags}


RULES = {
    "nan": (changed("observations", (5, 1, 2), np.nan), r"observations\[5, 1, 2\] is nan \(episode 1, step 1\)"),
    "inf": (changed("state", (3, 2), np.inf), r"state\[3, 2\] is inf"),
    "nan reward": (changed("rewards", (0, 1), np.nan), r"rewards\[0, 1\] is nan \(episode 0, step 0\)"),
    "action": (changed("actions", (5, 0, 1), 1.5), r"actions\[5, 0, 1\] is 1.5, outside \[-1, 1\]"),
    "negative cost": (changed("costs", 5, -1.0), r"costs\[5\] is -1 \(episode 2, step 1\); a cost is 0 or positive"),
    "flat actions": (lambda s: {"actions": s.actions[:, 0]}, r"actions has shape \(8, 2\), expected \(T, N, A\)"),
    "no last state": (lambda s: {"observations": s.observations[:-3]}, r"observations has shape \(8, 2, 5\)"),
    "agents": (lambda s: {"observations": s.observations[:, :1]}, "observations has shape"),
    "rewards": (lambda s: {"rewards": s.rewards[:, 0]}, r"rewards has shape \(8,\), expected \(8, 2\)"),
    "costs": (lambda s: {"costs": s.rewards[:, :1]}, r"costs has shape \(8, 1\), expected \(8, 2\)"),
    "flags": (lambda s: {"truncated": s.truncated[:-1]}, r"truncated has shape \(7,\)"),
    "state": (lambda s: {"state": s.state[:-1]}, r"state has shape \(10, 6\), expected \(11, S\)"),
    "no episode": (lambda s: {"episode_ends": s.episode_ends[:0]}, "episode_ends is empty"),
    "ends fall": (lambda s: {"episode_ends": np.array([4, 3, 8])}, "episode_ends must increase"),
    "unfinished": (lambda s: {"episode_ends": s.episode_ends[:-1]}, "episode_ends ends at 4, actions has 8 steps"),
    "both flags": (lambda s: {"terminated": s.truncated | s.terminated}, "terminated and truncated are both set"),
    "no flag": (
        lambda s: {"terminated": s.terminated & False, "truncated": s.truncated & False},
        "Episode 0 is unfinished",
    ),
    "flag inside": (ends_inside, "inside an episode is flagged"),
    "names": (
        lambda s: {"card": s.card.updated(observation_names=["a"])},
        "names 1 observation entries, the data has 5",
    ),
    "kind of ends": (lambda s: {"episode_ends": s.episode_ends.astype(float)}, "type float64; it must hold whole"),
    "words": (lambda s: {"rewards": s.rewards.astype(str)}, "rewards holds entries of type <U.*; it must hold real"),
    "flags of numbers": (lambda s: {"truncated": s.truncated * 1.0}, "truncated holds .*; it must hold true or false"),
    "lists": (lambda s: {"costs": s.costs.tolist()}, "costs is a list; give a NumPy array"),
    "nobody": (
        lambda s: {k: getattr(s, k)[:, :0] for k in ("observations", "actions", "rewards")},
        "at least one agent and one action entry",
    ),
    "state names": (lambda s: {"card": s.card.updated(state_names=["a"])}, "names 1 state entries, not 6"),
}


@pytest.mark.parametrize("rule", RULES)
def test_broken_rule_is_named(rule):
    mutate, message = RULES[rule]
    store = logs()
    if rule == "both flags":
        assert store.truncated.any()
    with pytest.raises(StoreError, match=message):
        dataclasses.replace(store, **mutate(store))


def test_bounds_of_actions_come_from_the_card():
    store = logs()
    wide = dataclasses.replace(store, card=store.card.updated(action_low=-3.0, action_high=3.0))
    dataclasses.replace(wide, actions=wide.actions * 3)
    with pytest.raises(StoreError, match=r"outside \[-3, 3\]"):
        dataclasses.replace(wide, actions=wide.actions * 30)


def test_bad_cards_are_refused():
    with pytest.raises(UserError, match="Unknown hazard 'Separatoin'; did you mean 'Separation'"):
        logs(hazard={"kind": "Separatoin"})
    with pytest.raises(UserError, match="did you mean 'radius'"):
        logs(hazard={"kind": "Separation", "radus": 0.3})
    with pytest.raises(UserError, match="SpeedLimit.*limit"):
        logs(hazard={"kind": "SpeedLimit"})


def test_select_keeps_whole_episodes():
    store = logs((3, 1, 4, 2))
    part = store.select(np.array([False, True, False, True]))
    assert part.lengths.tolist() == [1, 2]
    np.testing.assert_array_equal(part.actions, store.actions[[3, 8, 9]])
    np.testing.assert_array_equal(part.observations, store.observations[[4, 5, 11, 12, 13]])
    np.testing.assert_array_equal(part.state, store.state[[4, 5, 11, 12, 13]])
    np.testing.assert_allclose(part.returns, store.returns[[1, 3]], rtol=1e-6)
    np.testing.assert_allclose(part.episode_costs, store.episode_costs[[1, 3]])
    with pytest.raises(StoreError, match="No episode is left"):
        store.select(np.zeros(4, bool))


def test_from_steps_equals_from_episodes(small_store, played):
    flat = lambda x: x.reshape(-1, *x.shape[2:])  # noqa: E731
    again = EpisodeStore.from_steps(
        flat(played["observations"][:, :-1]),
        flat(played["actions"]),
        flat(played["rewards"]),
        episode_ends=np.arange(1, 41) * 25,
        final_observations=played["observations"][:, -1],
        costs=flat(played["costs"]),
        state=flat(played["state"][:, :-1]),
        final_state=played["state"][:, -1],
        card=small_store.card,
    )
    assert_same(small_store, again)


def test_makers_refuse_incomplete_logs(played):
    with pytest.raises(StoreError, match="keep the state that the last action leads to"):
        EpisodeStore.from_episodes(
            played["observations"][:, :-1], played["actions"], played["rewards"], played["costs"]
        )
    steps = dict(observations=np.zeros((4, 1, 2)), actions=np.zeros((4, 1, 1)), rewards=np.zeros(4))
    with pytest.raises(StoreError, match="drop an unfinished last episode"):
        EpisodeStore.from_steps(**steps, episode_ends=[3], final_observations=np.zeros((1, 1, 2)))
    with pytest.raises(StoreError, match="state was given without final_state"):
        EpisodeStore.from_steps(
            **steps, episode_ends=[4], final_observations=np.zeros((1, 1, 2)), state=np.zeros((4, 1))
        )
    with pytest.raises(StoreError, match="episode_ends must increase"):
        EpisodeStore.from_steps(**steps, episode_ends=[9, 4], final_observations=np.zeros((2, 1, 2)))
    with pytest.raises(StoreError, match="final_observations has shape"):
        EpisodeStore.from_steps(**steps, episode_ends=[2, 4], final_observations=np.zeros((1, 1, 2)))
    whole = dict(**steps, episode_ends=[4], final_observations=np.zeros((1, 1, 2)))
    assert EpisodeStore.from_steps(**whole).episodes == 1
    for name, value, said in (
        ("actions", np.zeros(4), r"actions has shape \(4,\), which is not 3 axes"),
        ("episode_ends", [[4]], r"episode_ends has shape \(1, 1\), which is not 1 axes"),
        ("episode_ends", [3.5, 4], "episode_ends holds fractions"),
        ("episode_ends", [], "ends at nothing"),
        ("observations", None, "observations is None; it is needed"),
        ("rewards", [[1.0], [1.0, 2.0], [0.0], [0.0]], "rewards is no array .*; give every row the same length"),
        ("rewards", ["1", "2", "3", "4"], "rewards holds entries that are no real numbers"),
    ):
        with pytest.raises(StoreError, match=said):
            EpisodeStore.from_steps(**{**whole, name: value})
    named = EpisodeStore.from_steps(**whole, card={"observation_names": np.array(["a", "b"])})
    assert named.card.observation_names == ["a", "b"]


def test_one_reward_for_the_team_is_everybodys():
    store = EpisodeStore.from_episodes(np.zeros((1, 3, 4, 2)), np.zeros((1, 2, 4, 1)), [[1.0, 2.0]], [[0.0, 1.0]])
    assert store.rewards.tolist() == [[1.0] * 4, [2.0] * 4]
    assert store.returns.tolist() == [3.0] and store.episode_costs.tolist() == [1.0]


# ---------------------------------------------------------------------------------------------------------------------
# windows


@st.composite
def partitions(draw, total=12, parts=4):
    """Lengths of `parts` episodes that sum to `total`; fixed sizes, so that one compilation serves all examples."""
    cuts = draw(st.lists(st.integers(1, total - 1), min_size=parts - 1, max_size=parts - 1, unique=True))
    return np.diff([0, *sorted(cuts), total])


drawn = jax.jit(at, static_argnums=(2, 3))


@pytest.mark.parametrize("horizon, history", [(5, 0), (3, 2)])
@settings(max_examples=15, deadline=None)
@given(lengths=partitions())
def test_windows_repeat_rows_at_the_ends_of_episodes(horizon, history, lengths):
    store = logs(tuple(lengths))
    data = WindowData(store, lambda observations, state: observations)
    steps = np.arange(store.steps)
    batch = jax.tree.map(np.asarray, drawn(data.arrays, steps, horizon, history))
    row, step = 0, 0
    for length in lengths:
        for t in range(length):
            for j in range(horizon + history):
                time = t + j - history
                here = row + min(max(time, 0), length)
                np.testing.assert_array_equal(batch.features[step, j], store.observations[here])
                assert batch.valid[step, j] == (time <= length)
                arrived = min(max(time, 0), length)
                assert batch.costs[step, j] == (store.costs[step - t + arrived - 1] if arrived else NOT_ARRIVED)
                if j < horizon + history - 1:
                    acted = 0 <= time < length
                    wanted = store.actions[step - t + time] if acted else np.zeros((2, 2))
                    np.testing.assert_array_equal(batch.actions[step, j], wanted)
            step += 1
        row += length + 1


@settings(max_examples=50, deadline=None)
@given(
    lengths=st.lists(st.integers(1, 9), min_size=1, max_size=6), discount=st.floats(0.0, 1.0), seed=st.integers(0, 999)
)
def test_returns_to_go_is_the_discounted_sum(lengths, discount, seed):
    lengths = np.array(lengths)
    reward = np.random.default_rng(seed).normal(size=lengths.sum())
    expected, start = [], 0
    for length in lengths:
        for t in range(length):
            expected.append(sum(discount**i * r for i, r in enumerate(reward[start + t : start + length])))
        start += length
    np.testing.assert_allclose(returns_to_go(reward, lengths, discount), expected, rtol=1e-9, atol=1e-9)


@settings(max_examples=30, deadline=None)
@given(lengths=st.lists(st.integers(1, 12), min_size=1, max_size=80), seed=st.integers(0, 999))
def test_raw_scores_are_shares_of_the_largest_also_where_nothing_was_earned(lengths, seed):
    left = np.random.default_rng(seed).normal(size=sum(lengths))
    np.testing.assert_allclose(raw_scores(left) * np.abs(left).max(), left)
    assert (raw_scores(np.zeros(3)) == 0).all()


@settings(max_examples=30, deadline=None)
@given(lengths=st.lists(st.integers(1, 12), min_size=1, max_size=80), seed=st.integers(0, 999))
def test_return_scores_keep_the_order_within_a_time_step(lengths, seed):
    time = np.concatenate([np.arange(n) for n in lengths])
    returns_to_go = np.random.default_rng(seed).normal(size=len(time)).round(1)  # rounded: ties occur
    scores = return_scores(returns_to_go, time)
    assert np.isfinite(scores).all() and abs(scores.mean()) < 0.3
    for t in range(max(lengths)):
        here = time == t
        order = np.argsort(returns_to_go[here])
        assert (np.diff(scores[here][order]) >= 0).all()
        for value in np.unique(returns_to_go[here]):
            assert len(np.unique(scores[here & (returns_to_go == value)])) == 1


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("rewards", lambda x: x.T),
        ("costs", lambda x: x.T),
        ("costs", lambda x: x[:, :-1]),
        ("observations", lambda x: x[:-1]),
        ("state", lambda x: x[:, :-1]),
        ("terminated", lambda x: x[:-1]),
    ],
)
def test_arrays_that_do_not_fit_together_are_refused_by_name(played, name, wrong):
    """Reshaped as they are, they would be spread over other episodes in silence."""
    arrays = {k: played[k] for k in ("observations", "actions", "rewards", "costs", "state")}
    arrays["rewards"] = arrays["rewards"].mean(-1)
    arrays["terminated"] = np.zeros(len(arrays["costs"]), bool)
    arrays[name] = wrong(arrays[name])
    with pytest.raises(StoreError, match=f"got {name} of shape .*40 episodes of 25 steps and 3 agents|and actions"):
        EpisodeStore.from_episodes(**arrays)


@pytest.mark.parametrize("shape", [(0, 4, 2, 1), (3, 0, 2, 1), (3, 4, 0, 1)])
def test_nothing_that_was_done_is_no_log(shape):
    episodes, length, agents, _ = shape
    seen = np.zeros((episodes, length + 1, agents, 5))
    with pytest.raises(StoreError, match="nothing was done; give a step or more"):
        EpisodeStore.from_episodes(seen, np.zeros(shape), np.zeros((episodes, length)), None)


def test_logs_without_costs_and_odd_cards(played):
    arrays = [played[k] for k in ("observations", "actions", "rewards")]
    assert not EpisodeStore.from_episodes(*arrays, None).costs.any()
    for card, said in (
        ({"hazard": "Separation"}, "hazard='Separation'; it must be a Separation, SpeedLimit"),
        ({"action_low": [-1, None]}, r"action_low=\[-1, None\]; it must be one number"),
        (["task"], "card is a list"),
        ({"hazard": {"kind": "Separation", "radius": "big"}}, "radius='big'; it must be a number, 0 or more"),
        ({"hazard": {"kind": "SpeedLimit", "limit": -1.0}}, "limit=-1.0; it must be a number, 0 or more"),
    ):
        with pytest.raises(UserError, match=said):
            EpisodeStore.from_episodes(*arrays, None, card=card)


def test_a_file_larger_than_memory_is_refused_before_it_is_read(tmp_path, small_store, monkeypatch):
    monkeypatch.setattr(arrays, "_memory", lambda: 1000.0)
    with pytest.raises(StoreError, match="GiB of arrays, this machine has 0.0 GiB of memory; take a larger"):
        EpisodeStore.load(small_store.save(tmp_path / "s.h5"))


def test_places_far_from_the_origin_are_warned_of(small_store):
    from ringfence.datasets.audit import audit

    def coarse(store):
        return [w for w in audit(store).warnings if "so far from 0" in w]

    assert not coarse(small_store)
    far = small_store.observations + np.float32(5.4e6) * np.eye(1, 18, 4, dtype=np.float32)[0]  # a northing in metres
    assert coarse(dataclasses.replace(small_store, observations=far))[0].startswith("Observation entries 4 are so far")


def test_entries_that_vary_for_one_agent_alone_are_no_constants(small_store):
    """100 000 rows of all agents and more are thinned out by rows."""
    from ringfence.datasets.audit import audit

    def constant(store):
        return [w for w in audit(store).warnings if "never vary" in w]

    times = -(-200_000 // len(small_store.observations))
    seen = np.tile(small_store.observations, (times, 1, 1))
    seen[:, 0, 1] = 0.5  # of one agent
    seen[:, :, 2] = 0.5  # of all
    large = dataclasses.replace(
        small_store,
        observations=seen,
        state=None,
        **{k: np.tile(getattr(small_store, k), (times, 1, 1)) for k in ("actions",)},
        **{k: np.tile(getattr(small_store, k), (times, 1)) for k in ("rewards",)},
        **{k: np.tile(getattr(small_store, k), times) for k in ("costs", "terminated", "truncated")},
        episode_ends=np.arange(1, times * small_store.episodes + 1) * 25,
    )
    silent = [w for w in constant(small_store)]
    warning = constant(large)[0]
    assert " 2," in warning and " 1," not in warning and (not silent or " 1," not in silent[0])
    kinds = small_store.observations.copy()
    kinds[:, :, 1] = np.arange(kinds.shape[1])
    apart = constant(dataclasses.replace(small_store, observations=kinds))[-1]
    assert " 1 never vary but from agent to agent" in apart


def test_content_tells_steps_apart(small_store):
    same = dataclasses.replace(small_store, costs=small_store.costs.copy())
    other = dataclasses.replace(small_store, costs=small_store.costs + 1)
    assert small_store.content == same.content != other.content


def test_a_card_is_written_as_it_was_read(small_store, tmp_path):
    """Order, fields that nobody knows, and those that are said to be nothing stay; what is not said stays away."""
    given = {"vehicle": {"wheels": 4}, "task": "fleet", "agents": None, "dt": 0.1, "hazard": {"kind": "CostColumn"}}
    store = dataclasses.replace(small_store, card=given)
    assert (store.card.task, store.card.dt, store.card.agents, store.card.warnings) == ("fleet", 0.1, None, [])
    assert store.card.extra == {"vehicle": {"wheels": 4}} and not store.card.homogeneous
    defaults = {"task": "custom", "simulator": None, "provenance": "user data", "action_low": -1.0, "action_high": 1.0}
    defaults |= {"observation_names": None, "state_names": None, "hazard": {"kind": "CostColumn"}}
    text = json.dumps({**defaults, **given})
    assert json.dumps(store.card.to_dict()) == text
    for _ in range(2):
        with h5py.File(store.save(tmp_path / "s.h5")) as file:
            assert file.attrs["card"] == text
        store = EpisodeStore.load(tmp_path / "s.h5")
    assert dataclasses.replace(store, card=dict(reversed(given.items()))).card == store.card
    assert store.card.updated(task="other", wheels=3).to_dict() == {**defaults, **given, "task": "other", "wheels": 3}
    assert EpisodeStore.load(tmp_path / "s.h5").card != store.card.updated(dt=0.2)
    with pytest.raises(StoreError, match="dt=0; it must be the seconds of a step"):
        store.card.updated(dt=0)
    store.card.to_dict()["hazard"]["kind"] = "another"
    assert store.card.hazard == {"kind": "CostColumn"}


def test_a_card_can_be_made_by_its_fields(small_store):
    card = StoreCard(task="fleet", dt=0.1, extra={"wheels": 4})
    store = dataclasses.replace(small_store, card=card)
    assert store.card == complete_card({"task": "fleet", "dt": 0.1, "wheels": 4}) and store.card.extra == {"wheels": 4}
    with pytest.raises(StoreError, match="task='a/b'; it must be a name"):
        dataclasses.replace(small_store, card=StoreCard(task="a/b"))


def test_a_mistyped_field_of_a_card_is_refused_where_it_is_written_by_hand(tmp_path):
    arrays = (np.zeros((2, 5, 1, 2)), np.zeros((2, 4, 1, 2)), np.zeros((2, 4)), None)
    with pytest.raises(StoreError, match="'observation_name', which is no field of it; did you mean 'observation_n"):
        EpisodeStore.from_episodes(*arrays, card={"observation_name": ["x", "y"]})
    steps = dict(episode_ends=[2], final_observations=np.zeros((1, 1, 2)))
    with pytest.raises(StoreError, match="did you mean 'cost_limit'"):
        EpisodeStore.from_steps(np.zeros((2, 1, 2)), np.zeros((2, 1, 2)), [0, 0], **steps, card={"cost_limits": 3})
    store = EpisodeStore.from_episodes(*arrays, card={"seed": 3, "site": "hall"})
    assert store.card.extra == {"seed": 3, "site": "hall"}
    before = dataclasses.replace(store, card=store.card.updated(observation_name="of before"))
    before.save(tmp_path / "before.h5")
    found = EpisodeStore.load(tmp_path / "before.h5")
    assert found.card.extra["observation_name"] == "of before"
    assert EpisodeStore.from_episodes(*arrays, card=found.card).card.extra == found.card.extra


def test_episodes_are_selected_by_flags_or_numbers(small_store):
    flags = np.arange(small_store.episodes) % 7 == 0
    one, two = small_store.select(flags), small_store.select(np.flatnonzero(flags))
    np.testing.assert_array_equal(one.observations, two.observations)
    for wrong in (flags[:-1], flags.astype(int), [small_store.episodes], [0.5], [[0]]):
        with pytest.raises(StoreError, match="select got .* or different numbers of episodes from 0 to 39"):
            small_store.select(wrong)


def test_names_of_each_agent_are_refused_with_the_way_out(played):
    with pytest.raises(StoreError, match="one list of words for all agents: an entry for each quantity"):
        EpisodeStore.from_episodes(
            *(played[k] for k in ("observations", "actions", "rewards", "costs")),
            card={"observation_names": [["a"], ["b"]]},
        )


def test_early_ends_that_nobody_explains_are_warned_of(played):
    from ringfence.datasets.audit import audit

    steps = played["actions"].shape[1]
    kept = np.arange(10 * steps) >= 5  # the first episode lacks five steps
    flat = [
        played[name][:10, :steps].reshape(10 * steps, *played[name].shape[2:])[kept]
        for name in ("observations", "actions", "rewards", "costs")
    ]

    def warned(**ends):
        store = EpisodeStore.from_steps(
            *flat[:3],
            costs=flat[3],
            episode_ends=np.arange(1, 11) * steps - 5,
            final_observations=played["observations"][:10, -1],
            **ends,
        )
        return any("1 of 10 episodes end before the usual" in warning for warning in audit(store).warnings)

    assert warned()
    assert not warned(terminated=np.arange(10) == 0)


def test_another_kind_of_file_is_imported_or_given_as_arrays(tmp_path):
    np.savez(tmp_path / "logs.npz", actions=np.zeros(3))
    (tmp_path / "logs.npz").rename(tmp_path / "logs.h5")  # whatever its name
    with pytest.raises(StoreError, match=r"logs\.h5' is no episode store, by its first bytes; import it"):
        EpisodeStore.load(tmp_path / "logs.h5")


def test_a_file_that_cannot_be_read_is_refused_like_a_damaged_one(tmp_path, monkeypatch):
    """Whoever asks for its first bytes may be refused, too."""
    (tmp_path / "s.h5").write_bytes(b"PK")

    def denied(*_, **__):
        raise PermissionError("Permission denied")

    monkeypatch.setattr(h5py, "File", denied)
    monkeypatch.setattr(pathlib.Path, "open", denied)
    with pytest.raises(StoreError, match=r"s\.h5' is truncated, damaged or no episode store \(Permission denied\)"):
        EpisodeStore.load(tmp_path / "s.h5")


def test_flat_logs_need_the_state_that_each_episode_ended_in():
    with pytest.raises(StoreError, match="no final_observations .* give the last observation of each episode"):
        EpisodeStore.from_steps(np.zeros((4, 2, 3)), np.zeros((4, 2, 1)), np.zeros(4), episode_ends=[4])


@pytest.mark.parametrize("room", [0, 600, 5000, 60_000])
def test_a_full_disk_is_told_and_leaves_nothing(room, small_store, tmp_path):
    """HDF5 that meets it in the middle keeps the file half open, and ends the process when the interpreter goes."""
    import resource

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, before[1]))
    try:
        with pytest.raises(UserError, match="could not be written .*free some space"):
            small_store.save(tmp_path / "s.h5")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(tmp_path.iterdir()) and not h5py.h5f.get_obj_count(types=h5py.h5f.OBJ_FILE)
    assert EpisodeStore.load(small_store.save(tmp_path / "s.h5")).content == small_store.content
