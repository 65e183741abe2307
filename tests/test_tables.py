"""Tables of (time, agent) rows as episodes: what comes out is what went in, on one clock."""

from __future__ import annotations

import dataclasses
import datetime
from pathlib import Path

import numpy as np
import pytest

import ringfence
from ringfence.cli import app
from ringfence.datasets.audit import odd_actions
from ringfence.errors import StoreError, UserError
from ringfence.logs import large
from ringfence.logs.io.columns import numbers
from ringfence.logs.io.observe import observe
from ringfence.logs.io.table_schema import TableSchema
from ringfence.logs.io.tracks import cut, nearest, resample, teams
from ringfence.logs.store import EpisodeStore
from ringfence.problem.constraints import CostColumn, Separation
from tests.quick import QUICK_WORLD

NAMES = dict(time="t", agent="id", episode="run", state=["x", "y", "vx", "vy"], action=["ax", "ay"], cost="hit")


def fleet(episodes: int = 6, steps: int = 12, agents: int = 3, dt: float = 0.1, seed: int = 0) -> dict[str, np.ndarray]:
    """Columns of agents who are always there, sorted by run, time and agent."""
    rng = np.random.default_rng(seed)
    shape = (episodes, steps, agents)
    run, t, who = (x.ravel() for x in np.indices(shape))
    v = rng.uniform(-1, 1, (*shape, 2))
    p = rng.uniform(-3, 3, (episodes, 1, agents, 2)) + np.cumsum(v, 1) * dt
    columns = dict(run=run, t=100.0 * run + t * dt, id=np.array([f"robot{i}" for i in who]))
    columns |= dict(zip(("x", "y", "vx", "vy"), np.concatenate([p, v], -1).reshape(-1, 4).T))
    columns |= dict(zip(("ax", "ay", "gx", "gy"), rng.uniform(-1, 1, (len(run), 4)).T))
    return columns | {"hit": (rng.random(len(run)) < 0.2).astype(float), "paid": rng.normal(size=len(run))}


def entry(store: EpisodeStore, name: str) -> np.ndarray:
    """(T + E, N) of an observation's entry."""
    return store.observations[..., store.card.observation_names.index(name)]


def test_rows_on_one_clock_come_out_as_they_are():
    table = fleet()
    store = EpisodeStore.from_table(table, **NAMES, reward="paid", goal=["gx", "gy"])
    assert (store.episodes, store.steps, store.n_agents) == (6, 66, 3) and store.card.dt == 0.1
    grid = {name: x.reshape(6, 12, 3) for name, x in table.items()}
    for name in ("x", "y", "vx", "vy"):
        np.testing.assert_allclose(entry(store, f"own.{name}").reshape(6, 12, 3), grid[name], atol=2e-6)
    x, gx, vy = grid["x"], grid["gx"], grid["vy"]
    np.testing.assert_allclose(entry(store, "goal.dx").reshape(6, 12, 3), gx - x, atol=1e-5)
    np.testing.assert_allclose(entry(store, "other1.dx").reshape(6, 12, 3)[..., 0], x[..., 2] - x[..., 0], atol=1e-5)
    other = entry(store, "other0.dvy").reshape(6, 12, 3)
    np.testing.assert_allclose(other[..., 2], vy[..., 0] - vy[..., 2], atol=1e-5)
    np.testing.assert_allclose(store.actions[..., 0].reshape(6, 11, 3), grid["ax"][:, :-1], atol=1e-6)
    np.testing.assert_allclose(store.rewards.reshape(6, 11, 3), grid["paid"][:, 1:], atol=1e-5)
    np.testing.assert_array_equal(store.costs.reshape(6, 11, 3), grid["hit"][:, 1:])
    assert store.truncated.sum() == 6 and not store.terminated.any() and store.hazard == CostColumn()


def test_data_frames_files_and_shuffled_agents_are_the_same(tmp_path):
    import pandas as pd

    table = fleet()
    frame = pd.DataFrame(table)
    frame.to_csv(tmp_path / "fleet.csv", index=False)
    frame.to_parquet(tmp_path / "fleet.parquet")
    by_agent = frame.sort_values(["id", "run", "t"])
    whole = EpisodeStore.from_table(table, **NAMES)
    for other in (frame, by_agent, tmp_path / "fleet.csv", str(tmp_path / "fleet.parquet")):
        assert EpisodeStore.from_table(other, **NAMES).content == whole.content
    import pyarrow

    assert EpisodeStore.from_table(pyarrow.table(table), **NAMES).content == whole.content


def test_uneven_times_are_put_on_one_clock():
    """Against a loop over rows: states interpolated, what came up to half a row later held or added up."""
    rng = np.random.default_rng(1)
    sizes = (40, 25)
    clocks = [np.sort(rng.uniform(0, 4, n)) for n in sizes]
    clocks[0][0] = 0.0
    run, who = np.zeros(sum(sizes), int), np.repeat([0, 1], sizes)
    time, state = np.concatenate(clocks), rng.normal(size=(sum(sizes), 2))
    action, reward, cost = (rng.normal(size=(sum(sizes), k)) for k in (3, 1, 1))
    cost = np.maximum(cost, 0)
    got = resample(run, who, time, state, action, reward[:, 0], cost, np.zeros(len(time), bool), 0.25, 10.0)
    seen, late = 0, 0.499 * min(0.25, np.median(np.concatenate([np.diff(c) for c in clocks])))
    for agent in (0, 1):
        mine = np.flatnonzero(who == agent)
        rows = np.flatnonzero(got.agent == agent)
        before = -np.inf
        for row in rows:
            at = got.step[row] * 0.25
            assert time[mine[0]] - 0.0125 <= at <= time[mine[-1]] + 0.0125
            last = mine[time[mine] <= at + late][-1]
            for c in range(2):
                np.testing.assert_allclose(got.state[row, c], np.interp(at, time[mine], state[mine, c]))
            if row != rows[-1]:  # which nobody follows
                np.testing.assert_array_equal(got.action[row], action[last])
            since = mine[(time[mine] > before + late) & (time[mine] <= at + late)]
            if row == rows[-1]:  # and what comes after the last step
                since = mine[time[mine] > before + late]
            np.testing.assert_allclose(got.earned[row], reward[since].sum(), atol=1e-12)
            before, seen = at, seen + 1
        np.testing.assert_allclose(got.cost[rows].sum(0), cost[mine].sum(0))
    assert seen == len(got.step) > 25


def test_agents_that_come_and_go_make_windows_of_constant_membership():
    rng = np.random.default_rng(2)
    there = rng.random((3, 30, 4)) < 0.85
    run, t, who = (x.ravel()[there.ravel()] for x in np.indices(there.shape))
    order = np.lexsort((t, who, run))
    run, t, who = run[order], t[order], who[order]
    zeros = np.zeros(len(t))
    tracks = resample(
        run, who, t * 0.5, np.stack([t, who], 1), zeros[:, None], zeros, zeros[:, None], zeros > 0, 0.5, 0.75
    )
    rows, many, size = teams(tracks, 3)
    expected = set()
    for e in range(3):
        origin = np.flatnonzero(there[e].any(1))[0]
        for a in range(30):  # maximal windows of the same three
            team = tuple(np.flatnonzero(there[e, a]))
            if len(team) != 3 or (a > 0 and tuple(np.flatnonzero(there[e, a - 1])) == team):
                continue
            b = a
            while b + 1 < 30 and tuple(np.flatnonzero(there[e, b + 1])) == team:
                b += 1
            expected.add((e, a - origin, b - a + 1, team))
    got, begin = set(), 0
    for length in many:
        window = rows[begin : begin + length]
        team = tuple(tracks.agent[window[0]].tolist())
        assert all(tuple(tracks.agent[w].tolist()) == team for w in window)
        got.add((int(tracks.recording[window[0, 0]]), int(tracks.step[window[0, 0]]), int(length), team))
        begin += length
    assert got == expected and len(got) > 5 and size == 3
    steps = {n: sum(r - 1 for r in teams(tracks, n)[1]) * n for n in (1, 2, 3, 4) if (there.sum(2) == n).any()}
    assert teams(tracks, None)[2] == max(steps, key=steps.get)


def test_long_windows_are_cut_and_short_ones_left_out():
    index, many = cut(np.array([11, 3, 8]), fewest=3, most=5)
    assert many.tolist() == [6, 6, 6]  # 10 steps in two, 2 steps and the rest of 7 are too short
    assert index.tolist() == [*range(6), *range(5, 11), *range(14, 20)]
    assert cut(np.array([11, 3]), 1, None)[1].tolist() == [11, 3]


def test_neighbours_are_those_who_are_nearest_at_that_time(monkeypatch):
    rng = np.random.default_rng(3)
    there = rng.random((2, 15, 6)) < 0.7
    there[:, :, 0] = True
    run, t, who = (x.ravel()[there.ravel()] for x in np.indices(there.shape))
    order = np.lexsort((t, who, run))
    run, t, who = run[order], t[order], who[order]
    place, zeros = rng.uniform(-2, 2, (len(t), 2)), np.zeros(len(t))
    tracks = resample(run, who, t * 1.0, place, zeros[:, None], zeros, zeros[:, None], zeros > 0, 1.0, 100.0)
    got = nearest(tracks, tracks.state, 3, 2.0)
    for row in range(len(tracks.step)):
        same = (tracks.recording == tracks.recording[row]) & (tracks.step == tracks.step[row])
        same[row] = False
        far = np.linalg.norm(tracks.state - tracks.state[row], axis=1)
        wanted = [k for k in np.flatnonzero(same)[np.argsort(far[same])] if far[k] <= 2.0][:3]
        assert got[row].tolist() == wanted + [-1] * (3 - len(wanted))
    monkeypatch.setattr("ringfence.logs.io.tracks.CHUNK", 9)  # so that moments of four are of many
    np.testing.assert_array_equal(nearest(tracks, tracks.state, 3, 2.0), got)


def test_crowds_at_one_place_have_neighbours():
    """Their tree is none of one leaf, in which everybody looks at everybody."""
    many, zeros = 2500, np.zeros(2500)
    who = np.arange(many)
    tracks = resample(0 * who, who, zeros, zeros[:, None], zeros[:, None], zeros, zeros[:, None], zeros > 0, 1.0, 9.0)
    got = nearest(tracks, tracks.state, 2, 1.0)
    assert (np.abs(got - who[:, None]) <= 2).all() and (got != who[:, None]).all() and (got >= 0).all()


def test_one_agent_among_its_neighbours_is_a_team_of_any_number(tmp_path):
    """The whole way: a policy of one agent, its World from the distances, played by seven."""
    options = NAMES | dict(action=(), cost=None, goal=["gx", "gy"])
    table = fleet(agents=5, steps=20) | {"gx": np.full(600, 1.5), "gy": np.full(600, -0.5)}
    store = EpisodeStore.from_table(
        table, **options, danger=Separation(0.8, 0.2), neighbours=2, sensing_radius=2.5, max_episode_steps=10
    )
    assert store.n_agents == 1 and store.card.homogeneous and store.costs.any() and (store.lengths <= 10).all()
    far = np.hypot(entry(store, "other0.dx"), entry(store, "other0.dy"))
    seen = entry(store, "other0.seen") > 0
    assert (far[~seen] == 2.5).all() and (far[seen] <= 2.5).all() and 0 < seen.mean() < 1
    arrived = np.delete(far[:, 0], np.concatenate([[0], store.episode_ends[:-1]]) + np.arange(store.episodes))
    np.testing.assert_array_equal(store.costs[:, 0] > 0, arrived < np.float32(0.8))
    grid = table["x"].reshape(6, 20, 5)
    progress = -np.diff(np.hypot(1.5 - grid, -0.5 - table["y"].reshape(6, 20, 5)), axis=1)
    assert np.isclose(store.rewards.sum(), progress[:, :].sum(), atol=1e-2)

    world = ringfence.fit(store, **QUICK_WORLD)
    assert world.map.dt == 0.1  # as of the table, whatever the few rows tell
    run = ringfence.train("bc", store, out=tmp_path, changes={"num_updates": 4, "width": 16}, quiet=True)[0]
    pilot = ringfence.Controller(run, agents=7, guard="shield", world=world)
    acted = pilot.act(np.tile(store.observations[0], (7, 1)), None)
    assert acted.shape == (7, 2) and np.isfinite(acted).all()


def test_velocities_and_accelerations_that_nobody_logged():
    table = fleet()
    store = EpisodeStore.from_table(table, **NAMES | dict(state=["x", "y"], action=()))
    x = table["x"].reshape(6, 12, 3)
    v = np.diff(x, axis=1) / 0.1
    np.testing.assert_allclose(entry(store, "own.vx").reshape(6, 12, 3)[:, 1:], v, atol=1e-4)
    np.testing.assert_allclose(store.actions[..., 0].reshape(6, 11, 3)[:, 1:], np.diff(v, axis=1) / 0.1, atol=2e-3)
    assert any("accelerations" in note for note in store.card.warnings)


def test_costs_of_distances_and_of_the_team():
    table = fleet(agents=2)
    apart = np.hypot(*(np.diff(table[c].reshape(6, 12, 2))[..., 0] for c in "xy"))
    store = EpisodeStore.from_table(table, **NAMES | dict(cost=None), danger=Separation(2.0))
    np.testing.assert_array_equal(store.costs.reshape(6, 11) > 0, apart[:, 1:] < 2.0)
    assert any("taken for the team's" in note for note in store.card.warnings)


def test_published_layouts_read_as_they_are(tmp_path):
    """Two cars of highD's columns, x and y of a box's corner; and INTERACTION's, in milliseconds."""
    head = "frame,id,x,y,width,height,xVelocity,yVelocity,xAcceleration,yAcceleration,frontSightDistance,laneId"
    lines = [f"{f},1,{10 + f * 1.2:.3f},4.0,4.0,2.0,30.0,0.0,0.1,0.0,0,2" for f in range(1, 40)]
    lines += [f"{f},2,{90 - f * 1.0:.3f},8.0,6.0,2.0,-25.0,0.0,0.0,0.2,0,5" for f in range(11, 60)]
    (tmp_path / "01_tracks.csv").write_text("\n".join([head, *lines]) + "\n")
    store = EpisodeStore.from_layout(tmp_path / "01_tracks.csv", "highd", neighbours=1, danger=Separation(5.0))
    assert store.episodes == 2 and store.card.dt == 0.04 and store.actions.shape[2] == 2
    both = entry(store, "other0.seen")[:, 0] > 0
    assert both[10:39].all() and not both[:10].any()
    np.testing.assert_allclose(entry(store, "other0.dx")[10, 0], (90 - 11 + 3) - (10 + 11 * 1.2 + 2), atol=1e-4)
    np.testing.assert_allclose(entry(store, "other0.dvx")[10, 0], -55.0, atol=1e-4)

    head = "track_id,frame_id,timestamp_ms,agent_type,x,y,vx,vy,psi_rad,length,width"
    lines = [f"{i},{f},{f * 100},car,{f * 0.5 + i},{i},5.0,0.0,0.0,4.1,1.8" for i in (1, 2) for f in range(1, 20)]
    (tmp_path / "vehicle_tracks_000.csv").write_text("\n".join([head, *lines]) + "\n")
    store = EpisodeStore.from_layout(tmp_path / "vehicle_tracks_000.csv", "interaction")
    assert (store.episodes, store.steps, store.n_agents) == (1, 18, 2) and store.card.dt == 0.1
    np.testing.assert_allclose(entry(store, "own.x")[:, 0], np.arange(1, 20) * 0.5 + 1, atol=1e-5)
    with pytest.raises(UserError, match="No layout.*'hiway'|layout 'hiway'"):
        EpisodeStore.from_layout(tmp_path / "01_tracks.csv", "hiway")


def broken(**columns):
    """The fleet's table with some entries changed: name=(row, value)."""
    table = fleet()
    for name, (row, value) in columns.items():
        table[name] = table[name].astype(object if isinstance(value, str) else table[name].dtype)
        table[name][row] = value
    return table


@pytest.mark.parametrize(
    ("table", "options", "said"),
    [
        (broken(t=(30, -5.0)), {}, r"row 30: t=-5 is earlier than row 27 of the same agent \(id=robot0\); sort"),
        (broken(t=(30, fleet()["t"][27])), {}, "row 30: .* is the time of row 27 of the same agent"),
        (broken(x=(7, np.nan)), {}, r"row 7: x is nan \(1 such rows\); fill it, or drop the rows"),
        (broken(vx=(7, "fast")), {}, "row 7: vx is 'fast', no number"),
        (broken(x=(40, 300.0)), {}, "row 40: x, y moved at .* m/s since row 37 of the same agent, more than max_speed"),
        (fleet(), {"max_speed": 0.01}, "more than max_speed=0.01, as [0-9]+ others did; check the units"),
        (fleet(), {"state": ["x", "yy"]}, "column of the table.*yy"),
        (fleet(), {"state": []}, "state names no column"),
        (fleet(), {"team": 4}, "No 4 agents are together for 5 steps of 0.1 s"),
        (fleet(steps=4), {}, "together for 5 steps"),
        (fleet(), {"team": 2, "neighbours": 2}, "give one of them"),
        (fleet(), {"neighbours": 0}, "neighbours=0 must be a whole number"),
        (fleet(), {"gap": 0.05}, "gap=0.05 is less than the 0.1 s between"),
        (fleet(), {"max_episode_steps": 3}, "max_episode_steps=3 is less than min_episode_steps=5"),
        (fleet(), {"state": "x y"}, "state='x y' is one word"),
        (fleet(), {"state": ["x", "x", "y"]}, "names the column 'x' twice"),
        (fleet(), {"danger": Separation(1.0)}, "cost and danger both say"),
        (broken(run=(4, 3)) | {"id": np.array([None, *fleet()["id"][1:]], object)}, {}, "row 0: id is missing"),
        (fleet(), {"action_low": 0.0}, "action_low is said by the card, not by the table; give card={'action_low'"),
        (fleet(), {"dt": 0.0}, "dt=0.0 must be a number above 0"),
        (
            fleet() | {"end": np.arange(len(fleet()["t"])) % 2},
            {"terminated": "end", "sort": True},
            "ends an .* every row",
        ),
        (fleet(), {"goal": ["gx"]}, "goal names 1 columns, the position has 2"),
        (fleet(), {"danger": CostColumn(), "cost": None}, "danger=CostColumn is not read from a table"),
        (fleet(), {"state": ["vx", "vy"], "danger": Separation(1.0), "cost": None}, "state holds no x, y or z"),
        (fleet(), {"state": ["hit"], "action": ()}, "action names no column"),
        (broken(hit=(8, -1.0)), {}, r"costs holds negative entries: costs\[.*\] is -1 \(episode 0, step"),
        (fleet() | {"x": np.zeros(3)}, {}, "not of one length"),
        ({k: v[:0] for k, v in fleet().items()}, {}, "not of one length above 0"),
        ([1, 2, 3], {}, "The table is a "),
        ("nothing.csv", {}, "'nothing.csv' is no file"),
    ],
)
def test_tables_that_cannot_be_are_refused(table, options, said):
    with pytest.raises(UserError, match=said):
        EpisodeStore.from_table(table, **NAMES | options)


def test_steps_that_a_large_table_has_too_few_rows_for_are_refused():
    rows = np.arange(20_000.0)
    with pytest.raises(UserError, match=r"Steps of 0.005 s would be 4e\+06 for 20,000 rows; give a larger dt"):
        EpisodeStore.from_table({"t": rows, "id": 0 * rows, "x": rows}, time="t", agent="id", state=["x"], dt=0.005)


def test_files_that_are_no_tables_are_refused(tmp_path):
    odd = ("a.parquet", b"PAR1nonsense"), ("a.csv", b'x,y\n1,"2\n3'), ("a.xlsx", b"PK"), ("b.csv", b"t,t\n1,2\n")
    for name, content in odd:
        (tmp_path / name).write_bytes(content)
        with pytest.raises(
            UserError, match="no table that can be read|no Parquet file|ends in|column of the table|twice, or no header"
        ):
            EpisodeStore.from_table(tmp_path / name, **NAMES)


def test_units_that_disagree_are_noted():
    table = fleet()
    assert not any("times what" in note for note in EpisodeStore.from_table(table, **NAMES).card.warnings)
    table |= {"vx": table["vx"] * 3.6, "vy": table["vy"] * 3.6}
    assert any(
        "vx is 3.6 times what x changes by" in note for note in EpisodeStore.from_table(table, **NAMES).card.warnings
    )
    swapped = fleet() | {"vx": fleet()["vy"], "vy": -fleet()["vx"]}
    notes = EpisodeStore.from_table(swapped, **NAMES).card.warnings
    assert sum("times what" in note for note in notes) == 2


def test_clocks_that_jitter_change_no_action_and_no_cost():
    """Rows a few milliseconds early or late keep their own step."""
    table = fleet(steps=30)
    chance = np.random.default_rng(5)
    late = table | {"t": table["t"] + chance.uniform(-0.02, 0.02, len(table["t"]))}
    exact, got = EpisodeStore.from_table(table, **NAMES), EpisodeStore.from_table(late, **NAMES, dt=0.1)
    assert got.steps >= 0.9 * exact.steps
    for store in (exact, got):
        near = np.abs(store.actions[:, :, 0][:, :, None] - table["ax"][None, None]) < 1e-6
        assert near.any(-1).all()  # every action is one of the table's
    grid = {name: x.reshape(6, 30, 3) for name, x in table.items()}
    begin, held, cost = 0, 0, 0
    for run, steps in enumerate(got.lengths):
        mine = slice(begin, begin + steps)
        shifts = [k for k in range(30 - steps) if np.allclose(got.actions[mine, :, 0], grid["ax"][run, k : k + steps])]
        assert len(shifts) == 1
        costs = grid["hit"][run, shifts[0] + 1 : shifts[0] + 1 + steps]
        np.testing.assert_array_equal(got.costs[mine], costs)
        begin, held, cost = begin + steps, held + 1, cost + costs.sum()
    assert (
        held == 6
        and cost > 0
        and any("off the clock" in n for n in EpisodeStore.from_table(late, **NAMES).card.warnings)
    )


@pytest.mark.parametrize("how", [{}, {"neighbours": 2, "sensing_radius": 2.5}])
def test_what_is_observed_at_run_time_is_what_the_logs_hold(how):
    table = fleet(agents=3)
    store = EpisodeStore.from_table(table, **NAMES, goal=["gx", "gy"], **how)
    now = {c: table[c].reshape(6, 12, 3)[2, 5] for c in ("x", "y", "vx", "vy", "gx", "gy")}
    seen = observe(store.card, {c: now[c] for c in ("x", "y", "vx", "vy")}, {"x": now["gx"], "y": now["gy"]})
    logged = (
        store.observations[2 * 12 + 5]
        if not how
        else np.stack([store.observations[(2 * 3 + i) * 12 + 5, 0] for i in range(3)])
    )
    np.testing.assert_allclose(seen, logged, atol=2e-5)
    with pytest.raises(UserError, match="own.vx', .*; add vx to state: what x changed by since the row before"):
        observe(store.card, {c: now[c] for c in ("x", "y", "vy")}, {"x": now["gx"], "y": now["gy"]})
    with pytest.raises(UserError, match="give one number per agent"):
        observe(store.card, {"x": now["x"][:2], "y": now["y"]})


def test_velocities_that_a_table_lacks_are_named():
    store = EpisodeStore.from_table(fleet(), **(NAMES | {"state": ["x", "y", "vy"]}))
    assert "vx: what x changed by since the row before, per second; give these to observe()" in store.card.warnings
    assert not any("observe()" in note for note in EpisodeStore.from_table(fleet(), **NAMES).card.warnings)


def test_a_schema_says_what_its_options_say():
    schema = TableSchema(**NAMES, max_episode_steps=7)
    assert schema.state == ("x", "y", "vx", "vy") and schema.cost == ("hit",) and schema == dataclasses.replace(schema)
    assert (schema.position, schema.velocity, schema.axes) == (("x", "y"), ("vx", "vy"), ("x", "y"))
    store = EpisodeStore.from_table(fleet(), schema, notes=["first"], card={"task": "mine"})
    assert store.content == EpisodeStore.from_table(fleet(), **NAMES, max_episode_steps=7).content
    assert store.card.task == "mine" and store.card.warnings[0] == "first"
    with pytest.raises(UserError, match="schema and dt both say how the table is read"):
        EpisodeStore.from_table(fleet(), schema, dt=0.2)
    with pytest.raises(UserError, match="agent of the table is not named"):
        EpisodeStore.from_table(fleet(), time="t", state=["x"])
    with pytest.raises(UserError, match="max_speeds"):
        EpisodeStore.from_table(fleet(), **NAMES, max_speeds=3.0)
    with pytest.raises(UserError, match="leave state out"):
        EpisodeStore.from_layout(fleet(), "highd", state=["x"])


def test_others_without_places_are_observed():
    table = fleet()
    store = EpisodeStore.from_table(table, **(NAMES | {"state": ["vx", "vy"]}))
    now = {name: table[name][:3] for name in ("vx", "vy")}
    np.testing.assert_allclose(observe(store.card, now), store.observations[0], atol=1e-6)


def test_the_command_line_imports_tables_and_bags(tmp_path, capsys):
    import pandas as pd

    pd.DataFrame(fleet()).to_csv(tmp_path / "fleet.csv", index=False)
    app.main(
        ["data", "import-table", str(tmp_path / "fleet.csv"), "--time", "t", "--agent", "id", "--episode", "run"]
        + ["--state", "x", "y", "vx", "vy", "--action", "ax", "ay", "--cost", "hit", "--out", str(tmp_path / "f.h5")]
    )
    assert "6 episodes, 66 steps" in capsys.readouterr().out
    assert EpisodeStore.load(tmp_path / "f.h5").content == EpisodeStore.from_table(fleet(), **NAMES).content
    app.main(["data", "info", str(tmp_path / "f.h5")])
    with pytest.raises(SystemExit):
        app.main(["data", "import-table", str(tmp_path / "fleet.csv"), "--state", "x", "--out", str(tmp_path / "g.h5")])
    assert "column of the table" in capsys.readouterr().err and not (tmp_path / "g.h5").exists()

    from tests.test_bags import command, odometry, write

    logs = []
    for i in (1, 2):
        for k in range(60):
            logs.append(odometry(f"/robot_{i}/odom", 0.1 * k, x=0.05 * k, y=float(i), twist=(0.5, 0.0, 0.0)))
            logs.append(command(f"/robot_{i}/cmd_vel", 0.1 * k - 0.01, vx=0.5 + 0.001 * k))
    bag = write(tmp_path / "bag", logs)
    app.main(
        ["data", "import-bag", str(bag), "--agents", "/robot_{i}", "--separation", "1.5", "--max-episode-steps", "20"]
        + ["--out", str(tmp_path / "bag.h5")]
    )
    store = EpisodeStore.load(tmp_path / "bag.h5")
    assert (store.n_agents, store.lengths.tolist()) == (2, [20, 20, 19]) and (store.costs == 1).all()
    np.testing.assert_allclose(entry(store, "own.vx"), 0.5, atol=1e-6)
    np.testing.assert_allclose(entry(store, "other0.dy")[:, 0], 1.0, atol=1e-6)


def test_files_with_flipped_and_missing_bytes_are_refused_in_a_sentence_or_read(tmp_path):
    """CSV and Parquet alike: nothing but a `UserError` comes of them."""
    import pyarrow as pa
    from pyarrow import csv
    from pyarrow import parquet as pq

    rows = pa.table({k: np.asarray(v) for k, v in fleet(agents=2, steps=6).items()})
    pq.write_table(rows, tmp_path / "a.parquet")
    csv.write_csv(rows, tmp_path / "a.csv")
    rng = np.random.default_rng(0)
    for file in (tmp_path / "a.csv", tmp_path / "a.parquet"):
        whole, refused = file.read_bytes(), 0
        for k in range(60):
            data = bytearray(whole)
            for at in rng.integers(len(data), size=3):
                data[at] ^= 1 << rng.integers(8)
            damaged = tmp_path / f"b{file.suffix}"
            damaged.write_bytes(data[: rng.integers(len(data))] if k % 3 == 0 else data)
            try:
                EpisodeStore.from_table(damaged, **NAMES)
            except UserError:
                refused += 1
        assert refused > 20


def test_one_word_in_a_column_of_a_file_is_named_by_its_own_row():
    with pytest.raises(StoreError, match="row 1: x is 'foo', no number"):
        numbers({"x": np.array(["1.0", "foo", "2.0"], object)}, "x")


def valves(runs: int = 12, steps: int = 30) -> dict[str, np.ndarray]:
    """Two tanks, whose valves open from 0 to 1; the last rows have no command, and the first run spills at once."""
    rng = np.random.default_rng(0)
    lengths = np.where(np.arange(runs) == 0, 3, steps)
    rows = [(run, t, tank) for run in range(runs) for t in range(lengths[run]) for tank in (0, 1)]
    run, t, tank = np.array(rows).T
    last = t == lengths[run] - 1
    return {
        "run": run,
        "t": t * 0.5,
        "tank": tank,
        "level": rng.uniform(0, 3, len(t)),
        "valve": np.where(last, np.nan, rng.uniform(0, 1, len(t))),
        "turn": np.where(last, np.nan, rng.uniform(-2, 1, len(t))),
        "alarm": (last & (run == 0)).astype(float),
        "trip": (last & (run == 0)).astype(float),
    }


TANKS = {"time": "t", "agent": "tank", "episode": "run", "state": ["level"], "cost": "alarm"}


def test_commands_to_one_side_are_bounded_by_0_and_say_so():
    store = EpisodeStore.from_table(valves(), **TANKS, action=["valve", "turn"], card={"task": "tanks"})
    low, high = store.card.bounds
    assert low[0] == 0 and 0.9 < high[0] <= 1 and -2 <= low[1] < -1.8 and high[1] == -low[1]
    (said,) = [note for note in store.card.warnings if "never negative" in note]
    assert said.startswith("valve is never negative and bounded by 0; give --action-low")
    given = {"action_low": [-1.0, -3.0], "action_high": [1.0, 3.0]}
    store = EpisodeStore.from_table(valves(), **TANKS, action=["valve", "turn"], card={"task": "tanks", **given})
    np.testing.assert_array_equal(store.card.bounds, [[-1, -3], [1, 3]])
    assert not any("never negative" in note for note in store.card.warnings)
    (odd,) = odd_actions(store)
    assert odd.startswith("Entry 0 of the actions is never below 0, though bounded by -1 and 1")


def test_the_last_row_needs_no_command_and_a_short_time_is_counted():
    table = valves()
    store = EpisodeStore.from_table(table, **TANKS, action=["valve"], card={"task": "tanks"})
    assert store.episodes == 11 and np.isfinite(store.actions).all()
    (said,) = [note for note in store.card.warnings if "left out, since" in note]
    assert said.startswith("1 of 12 times are left out, since they have fewer than 5 steps (min_episode_steps), 1 of")
    all_of_it = EpisodeStore.from_table(
        table, **TANKS, action=["valve"], terminated="trip", min_episode_steps=1, card={"task": "tanks"}
    )
    assert all_of_it.episodes == 12 and all_of_it.lengths[0] == 2
    assert all_of_it.terminated.sum() == 1 and all_of_it.terminated[1] and all_of_it.costs[1].all()
    table["valve"][7] = np.nan
    with pytest.raises(StoreError, match="row 7: valve is nan"):
        EpisodeStore.from_table(table, **TANKS, action=["valve"])
    table = valves()
    table["trip"][7] = 2
    with pytest.raises(StoreError, match="row 7: trip is 2, no flag; write 0 or 1"):
        EpisodeStore.from_table(table, **TANKS, action=["valve"], terminated="trip")


def test_the_first_row_needs_no_reward_and_no_cost():
    table = valves()
    first = table["t"] == 0
    table = table | {"gain": np.where(first, np.nan, 1.0), "alarm": np.where(first, np.nan, table["alarm"])}
    store = EpisodeStore.from_table(table, **TANKS, action=["valve"], reward="gain", card={"task": "tanks"})
    assert np.isfinite(store.costs).all() and (store.rewards == 1).all()
    table["gain"][2] = np.nan
    with pytest.raises(StoreError, match="row 2: gain is nan"):
        EpisodeStore.from_table(table, **TANKS, action=["valve"], reward="gain", card={"task": "tanks"})


def test_who_never_acts_is_warned_of():
    table = valves()
    store = EpisodeStore.from_table(table | {"valve": np.full(len(table["t"]), 0.5)}, **TANKS, action=["valve"])
    assert "Actions of agent 0, 1 never vary: no World can learn what they do." in odd_actions(store)


def test_the_command_line_says_bounds_and_ends(tmp_path):
    import pyarrow as pa
    from pyarrow import parquet

    parquet.write_table(pa.table(valves()), file := tmp_path / "tanks.parquet")
    line = (
        f"data import-table {file} --time t --agent tank --episode run --state level --action valve turn --cost alarm"
    )
    app.main([*line.split(), *f"--terminated trip --action-low 0 -3 --action-high 2 --out {tmp_path}/tanks.h5".split()])
    store = EpisodeStore.load(tmp_path / "tanks.h5")
    assert store.card.bounds == ((0, -3), 2)
    with pytest.raises(SystemExit) as ended:
        app.main([*line.split(), *f"--action-low 0 1 2 --out {tmp_path}/other.h5".split()])
    assert ended.value.code == 2


def test_times_may_be_frames():
    table = valves()
    frames = table | {"t": 3 + 12 * np.round(table["t"] / 0.5).astype(int)}  # twelve frames a step
    how = TANKS | {"action": ["valve"]}
    one, two = EpisodeStore.from_table(table, **how), EpisodeStore.from_table(frames, **how, time_unit=0.5 / 12)
    assert one.card.dt == two.card.dt == 0.5
    np.testing.assert_array_equal(one.observations, two.observations)
    assert any(
        "or frames, say how long one is" in note for note in EpisodeStore.from_table(frames, **how).card.warnings
    )
    with pytest.raises(UserError, match="time_unit=0 must be a number above 0"):
        EpisodeStore.from_table(frames, **how, time_unit=0)


def test_what_is_cut_off_a_long_time_is_counted_too_and_costs_that_are_not_known_yet_are_not():
    how = TANKS | {"action": ["valve"], "max_episode_steps": 26}  # of 29, three are left
    store = EpisodeStore.from_table(valves(), **how)
    assert store.lengths.tolist() == [26] * 11
    (said,) = [note for note in store.card.warnings if "left out, since" in note]
    assert said.startswith("12 of 23 times are left out") and said.endswith("1 of them with a cost")
    places = valves() | {"x": np.arange(len(valves()["t"])) * 0.1}
    how = {name: given for name, given in TANKS.items() if name != "cost"} | {"state": ["x"], "action": ["valve"]}
    store = EpisodeStore.from_table(places, **how, danger=Separation(0.3), max_speed=50.0)
    (said,) = [note for note in store.card.warnings if "left out, since" in note]
    assert said.endswith("(min_episode_steps)")


def test_a_bound_that_is_given_is_not_explained_and_the_other_is():
    low, high = ({f"action_{side}": end} for side, end in (("low", -1.0), ("high", 2.0)))
    for card, explained in (({}, True), (high, True), (low, False)):
        store = EpisodeStore.from_table(valves(), **TANKS, action=["valve"], card=card)
        assert any("never negative" in note for note in store.card.warnings) == explained


def test_dates_that_are_written_as_text_are_dates():
    table = fleet()
    first = datetime.datetime(2026, 1, 1, 12)
    text = [(first + datetime.timedelta(seconds=float(s))).isoformat() for s in table["t"]]
    plain = EpisodeStore.from_table(table, **NAMES)
    for written in (text, np.array(text), [s + "Z" for s in text], [s + "+02:00" for s in text]):
        store = EpisodeStore.from_table(table | {"t": written}, **NAMES)
        np.testing.assert_allclose(store.observations, plain.observations, atol=1e-5)
    with pytest.raises(UserError, match="row 0: t is '2026-01-01T12:00:00Z', no number"):  # of which zone is the rest?
        EpisodeStore.from_table(table | {"t": [text[0] + "Z", *text[1:]]}, **NAMES)


@pytest.mark.parametrize("entry", ["oops", "", None, "2016-12-31T23:59:60"])
def test_a_time_that_is_none_is_named_by_its_own_row(entry):
    table = fleet()
    first = datetime.datetime(2026, 1, 1, 12)
    text = [(first + datetime.timedelta(seconds=float(s))).isoformat(timespec="microseconds") for s in table["t"]]
    wrong = [*text[:37], entry, *text[38:]]
    with pytest.raises(StoreError, match=f"row 37: t is '{entry}', no time in ISO 8601; repair or drop it"):
        EpisodeStore.from_table(table | {"t": wrong}, **NAMES)
    with pytest.raises(StoreError, match=f"row 37: t is '{entry}', no time as time_format=.*; repair or drop it"):
        EpisodeStore.from_table(table | {"t": wrong}, **NAMES, time_format="%Y-%m-%dT%H:%M:%S.%f")
    with pytest.raises(StoreError, match="row 0: t is .*, no time as time_format='%d'; say how it is written"):
        EpisodeStore.from_table(table | {"t": wrong}, **NAMES, time_format="%d")


def test_decimal_commas_are_read_wherever_they_stand(tmp_path):
    import pandas as pd

    table = fleet()
    commas = table | {name: [f"{x:.17g}".replace(".", ",") for x in table[name]] for name in ("t", "x", "hit")}
    frame = pd.DataFrame(commas)
    frame.to_json(tmp_path / "a.jsonl", orient="records", lines=True)
    frame.to_parquet(tmp_path / "a.parquet")
    plain = EpisodeStore.from_table(table, **NAMES)
    for given in (commas, frame, tmp_path / "a.jsonl", tmp_path / "a.parquet"):
        store = EpisodeStore.from_table(given, **NAMES, decimal=",")
        np.testing.assert_allclose(store.observations, plain.observations, atol=1e-6)
    with pytest.raises(StoreError, match="row 3: x is '1.234,5', no number; repair or drop it"):
        EpisodeStore.from_table(commas | {"x": [*commas["x"][:3], "1.234,5", *commas["x"][4:]]}, **NAMES, decimal=",")
    ids = commas | {"id": [x.replace("robot", "1,") for x in table["id"]]}
    assert EpisodeStore.from_table(ids, **NAMES, decimal=",").card.agents == ["1,0", "1,1", "1,2"]


def test_an_end_inside_a_track_ends_an_episode():
    """Trips that follow each other, the next from where the first began: no speed is of the way back."""
    steps = 20
    t = np.arange(2 * steps) * 0.1
    table = {"t": np.tile(t, 2), "id": np.repeat([0, 1], 2 * steps), "y": np.repeat([0.0, 3.0], 2 * steps)}
    table |= {"x": np.tile(np.linspace(0, 95, steps), 4), "end": np.tile(np.arange(2 * steps) % steps == steps - 1, 2)}
    table |= {"hit": np.zeros(4 * steps), "a": np.r_[np.ones(4 * steps - 1), np.nan]}
    table["a"][steps - 1] = np.nan  # nobody follows the command with which an episode ends
    options = dict(time="t", agent="id", state=["x", "y"], cost="hit", terminated="end", action=["a"])
    for dt, ends in ((None, [19, 38]), (0.3, [6, 12])):
        store = EpisodeStore.from_table(table, **options, dt=dt)
        assert np.array_equal(store.episode_ends, ends) and store.episode_terminated.all()
        assert np.ptp(entry(store, "own.vx")) < 1e-3  # never -950 m/s, which a seam would be
    flagged = table["end"] & (table["id"] == 0)  # by one of the team alone
    for late in (0.0, 0.02):
        alone = table | {"end": flagged, "t": table["t"] + late * table["id"]}
        store = EpisodeStore.from_table(alone, **options)
        assert np.ptp(entry(store, "own.vx")) < 1e-3 and store.episodes == 2 and store.episode_terminated.all()
    left = {
        name: column[(table["id"] == 0) | (table["t"] < 0.65) | (table["t"] > 2.95)] for name, column in table.items()
    }
    store = EpisodeStore.from_table(left | {"end": left["end"] & (left["id"] == 0)}, **options)
    assert store.episode_terminated.tolist() == [False, True]  # who left before did not end there
    one = EpisodeStore.from_table(table, **options, neighbours=1)
    assert one.episodes == 4 and one.episode_terminated.all()
    with pytest.raises(StoreError, match="moved at"):
        EpisodeStore.from_table(table, **options | {"terminated": None, "action": ()})


def clocked(t: np.ndarray, agents: int = 1, **options) -> tuple[EpisodeStore, int]:
    """A store of agents whose rows come at these times, and how many steps have another row's command."""
    k = np.tile(np.arange(len(t)), agents)
    who = np.repeat(np.arange(agents), len(t))
    table = {
        "t": np.tile(t, agents),
        "id": who,
        "x": np.sin(k * 0.01),
        "y": 1.0 * who,
        "a": k % 7 - 3.0,
        "hit": 0.0 * k,
    }
    options = {"max_speed": 1000.0} | options
    store = EpisodeStore.from_table(table, time="t", agent="id", state=["x", "y"], action=["a"], cost="hit", **options)
    wanted = np.arange(store.steps) % 7 - 3.0
    return store, int((store.actions[:, :, 0] != wanted[:, None]).sum())


ROWS = np.arange(30_000)
WOBBLE = 0.3 * np.sin(ROWS / 9000)


@pytest.mark.parametrize(
    ("times", "options", "dt"),
    [
        (np.arange(250_000) / 60, {}, 1 / 60),  # six digits of which are a step too long in an hour
        (1.7e9 + ROWS / 10, {}, 0.1),  # single numbers of such times are 2e-7 s apart
        (ROWS / 59.94, {"dt": 1 / 60}, 1 / 60),
        (ROWS / 60, {"dt": 0.0167}, 0.0167),
        (ROWS * 0.1 + WOBBLE, {}, None),
        (ROWS * 0.1 + WOBBLE, {"agents": 3}, None),
        (ROWS * 0.1 + WOBBLE + np.random.default_rng(0).uniform(-0.02, 0.02, len(ROWS)), {}, None),
        (np.where(ROWS == 0, 0.04, ROWS * 0.1), {}, 0.1),
        (np.arange(100) * 0.752, {}, 0.752),
    ],
)
def test_no_row_slips_however_long_or_wrong_the_clock(times, options, dt):
    store, slipped = clocked(times, **options)
    assert slipped == 0 and abs(store.steps - len(times)) <= 2
    assert store.card.dt == dt if dt else abs(store.card.dt - 0.1) < 1e-4
    seen = entry(store, "own.x")[:, 0]
    np.testing.assert_allclose(seen, np.sin(np.arange(len(seen)) * 0.01), atol=4e-3)
    drifts = [note for note in store.card.warnings if "drifts" in note]
    assert len(drifts) == (dt is None or "dt" in options)


@pytest.mark.parametrize(
    ("dt", "many", "rounded"),
    [
        (1 / 60, 30_000, lambda t: np.round(t, 3)),
        (1 / 60, 30_000, lambda t: np.floor(t * 100) / 100),
        (1 / 60, 30_000, lambda t: 1.7e9 + np.round(t, 3)),
        (1 / 60, 60, lambda t: np.round(t, 3)),
        (0.01, 20_000, lambda t: (1e5 + t).astype(np.float32)),
        (0.01, 20_000, lambda t: (1e4 + t).astype(np.float32)),
        (0.75, 30_000, lambda t: np.round(t, 1)),
    ],
)
@pytest.mark.parametrize("late", [0.0, 0.3])
def test_rounded_times_are_those_that_they_were_rounded_from(dt, many, rounded, late):
    """Of agents that share a clock, and of two that do not."""
    k = np.arange(many)
    times, other = rounded(k * dt), rounded((k + late) * dt)
    table = {
        "t": np.r_[times, other],
        "id": np.repeat([0, 1], many),
        "x": np.tile(k * dt, 2),
        "hit": np.zeros(2 * many),
    }
    store = EpisodeStore.from_table(table, time="t", agent="id", state=["x"], cost="hit")
    assert abs(store.card.dt / dt - 1) < 2e-5 and abs(store.steps - many) <= 2
    assert not any("drifts" in note for note in store.card.warnings)
    assert any("times are rounded to" in note for note in store.card.warnings)
    assert np.abs(np.diff(entry(store, "own.x"), axis=0) / dt - 1).max() < 0.03


def test_rows_that_are_lost_do_not_make_another_clock():
    chance = np.random.default_rng(0)
    for kept in (np.delete(ROWS, [40, 90]), np.sort(chance.permutation(ROWS)[:24_000]), ROWS[ROWS % 10 > 0]):
        store, _ = clocked(kept * 0.1)
        assert store.card.dt == 0.1 and not any("rounded" in note for note in store.card.warnings)


def test_times_without_a_clock_are_not_counted_by_rows():
    """Two rates that are far apart, and none: states are where they were at that time."""
    two = np.cumsum(np.where(ROWS[:4000] < 2000, 0.1, 0.115))
    none = np.cumsum(np.random.default_rng(1).exponential(0.1, 4000))
    for times in (two, none):
        store, _ = clocked(times, gap=10.0)
        assert not any("drifts" in note for note in store.card.warnings)
        at = np.arange(store.steps + 1) * store.card.dt
        expected = np.interp(at, times - times[0], np.sin(ROWS[:4000] * 0.01))
        np.testing.assert_allclose(entry(store, "own.x")[:, 0], expected, atol=1e-5)


def test_events_keep_their_sum_whatever_the_steps():
    t = np.delete(np.arange(50) * 0.1, [11, 12, 13, 14])
    table = {"t": t, "id": 0 * t, "x": np.sin(t), "y": t, "hit": np.isclose(t, 1.0) * 1.0, "paid": 1.0 + 0 * t}
    options = dict(time="t", agent="id", state=["x", "y"], cost="hit", reward="paid")
    for dt, at in ((None, 1.0), (0.05, 1.0), (0.3, 1.2)):
        store = EpisodeStore.from_table(table, **options, dt=dt)
        assert store.costs.sum() == 1 and store.rewards.sum() == len(t) - 1
        assert np.isclose((np.flatnonzero(store.costs)[0] + 1) * store.card.dt, at)
    after = table | {"hit": np.isclose(t, 1.5) * 1.0}  # of the hole, which is longer than the gap
    said = "1 episodes begin with a row that costs something, which no step leads to: that cost is left out"
    for pieces in ({}, {"max_episode_steps": 5, "min_episode_steps": 1}):
        store = EpisodeStore.from_table(after, **options, gap=0.3, **pieces)
        assert store.costs.sum() == 0 and sum(note.startswith(said) for note in store.card.warnings) == 1
    assert not any("begin with" in note for note in EpisodeStore.from_table(after, **options, gap=1.0).card.warnings)
    lasts = table | {"hit": ((t > 0.85) & (t < 2.05)) * 1.0}
    store = EpisodeStore.from_table(lasts, **options)
    assert store.costs.sum() == lasts["hit"].sum()  # danger on both sides of the hole is danger in it
    np.testing.assert_array_equal(store.costs > 0, [0.85 < 0.1 * k < 2.05 for k in range(1, 50)])
    halves = EpisodeStore.from_table(lasts, **options, dt=0.05)
    assert np.isclose(halves.costs.sum(), lasts["hit"].sum()) and (np.diff(halves.costs > 0) != 0).sum() == 2


@pytest.mark.parametrize("after", [0.03, 0.05, 0.08])
def test_agents_whose_rows_come_between_those_of_others_lose_no_command(after):
    """Two robots with timers of their own, both of which jitter by a fifth of a step."""
    k = np.arange(500)
    t = np.r_[k, k + after / 0.1] * 0.1 + np.random.default_rng(0).uniform(-0.02, 0.02, 1000)
    t[0] = 0.0
    table = {"t": t, "id": np.repeat([0, 1], 500), "x": np.tile(np.sin(k * 0.01), 2), "y": np.repeat([0.0, 1.0], 500)}
    table |= {"a": np.tile(k * 1.0, 2), "hit": np.zeros(1000)}
    store = EpisodeStore.from_table(table, time="t", agent="id", state=["x", "y"], action=["a"], cost="hit")
    assert store.steps > 490 and (np.diff(store.actions[:, :, 0], axis=0) == 1).all()


# --- larger than memory ---


def written(table: dict[str, np.ndarray], file: Path) -> Path:
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import csv, parquet

    (csv.write_csv if file.suffix == ".csv" else parquet.write_table)(pyarrow.table(table), file)
    return file


@pytest.mark.parametrize("kind", [".csv", ".parquet"])
def test_a_table_that_is_read_in_parts_makes_the_same_store(tmp_path, kind):
    """Recordings are not cut where parts end, and nothing tells that there were any."""
    table = fleet(episodes=20)
    options = {**NAMES, "card": {"task": "fleet"}}
    whole = EpisodeStore.from_table(table, **options)
    file = written(table, tmp_path / f"fleet{kind}")
    made = large.import_large([file], tmp_path / "fleet.h5", rows=150, quiet=True, **options)
    parts = EpisodeStore.load(tmp_path / "fleet.h5")
    assert (made.episodes, made.steps) == (parts.episodes, parts.steps) == (20, 220)
    for name in ("observations", "actions", "rewards", "costs", "terminated", "truncated", "episode_ends"):
        np.testing.assert_allclose(getattr(parts, name), getattr(whole, name), atol=2e-6, err_msg=name)
    assert parts.card.updated(warnings=[], action_low=-1, action_high=1) == whole.card.updated(
        warnings=[], action_low=-1, action_high=1
    )
    assert [p.name for p in tmp_path.iterdir() if p.name not in (file.name, "fleet.h5")] == []


def test_a_long_recording_is_cut_where_a_part_ends_and_loses_no_step(tmp_path):
    table = fleet(episodes=1, steps=300)
    table["x"] += 5e6  # of a map
    names = {k: v for k, v in NAMES.items() if k != "episode"}
    whole = EpisodeStore.from_table(table, **names)
    file = written(table, tmp_path / "day.parquet")
    large.import_large([file], tmp_path / "day.h5", rows=200, quiet=True, **names)
    parts = EpisodeStore.load(tmp_path / "day.h5")
    assert whole.episodes == 1 and parts.episodes == 5 and parts.steps == whole.steps == 299
    assert parts.costs.sum() == whole.costs.sum() and parts.card.observation_origins
    np.testing.assert_allclose(parts.actions, whole.actions)
    origin = parts.card.observation_origins[parts.card.observation_names.index("own.x")]
    x = entry(parts, "own.x").astype(float) + origin
    assert abs(np.delete(x, parts.first_rows[1:], 0) - table["x"].reshape(300, 3)).max() < 1e-2


def test_what_cannot_be_read_in_parts_is_refused_and_leaves_nothing(tmp_path):
    table = fleet(episodes=1, steps=300)
    by_agent = np.argsort(table["id"], kind="stable")
    names = {k: v for k, v in NAMES.items() if k != "episode"}
    for order, options in ((by_agent, names), (np.argsort(table["run"] + np.arange(900) % 7), NAMES)):
        file = written(
            {k: x[order] for k, x in (table | {"run": np.arange(900) % 7}).items()}, tmp_path / "odd.parquet"
        )
        with pytest.raises(StoreError, match=r"rows \d+ to \d+ of .* in parts; sort it by recording and time"):
            large.import_large([file], tmp_path / "odd.h5", rows=100, quiet=True, **options)
        assert [p.name for p in tmp_path.iterdir()] == ["odd.parquet"]


def test_large_tables_are_read_in_parts_by_the_command(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(large, "LARGE", 100)
    file = written(fleet(), tmp_path / "fleet.parquet")
    given = "--time t --agent id --episode run --state x y vx vy --action ax ay --cost hit"
    app.main(["data", "import-table", str(file), "--out", str(tmp_path / "f.h5"), *given.split()])
    assert "6 episodes, 66 steps of 0.1 s" in capsys.readouterr().out
    assert EpisodeStore.load(tmp_path / "f.h5").card.provenance == "table fleet.parquet"


def test_of_a_large_store_some_episodes_are_read(tmp_path):
    """Half of them with danger, as far as there are; its warnings say which share."""
    table = fleet(episodes=200)
    table["hit"] *= table["run"] % 10 == 0
    store = EpisodeStore.from_table(table, **NAMES)
    store.save(tmp_path / "fleet.h5")
    size = sum(x.nbytes for x in vars(store).values() if isinstance(x, np.ndarray))
    some = EpisodeStore.load(tmp_path / "fleet.h5", memory=size // 10)
    assert 0 < some.steps <= store.steps // 10 and (some.episode_costs > 0).sum() in (9, 10)
    assert some.card.warnings[-1] == (
        f"learned from {some.steps} of 2,200 steps: {(some.episode_costs > 0).sum()} of 20 episodes with danger, and "
        f"{(some.episode_costs == 0).sum()} of 180 others"
    )
    known = set(store.digests_of_episodes)
    assert set(some.digests_of_episodes) <= known
    assert EpisodeStore.load(tmp_path / "fleet.h5", memory=10 * size).content == store.content


@pytest.mark.parametrize("hertz, each", [(20, 3), (10, 4)])
def test_a_clock_that_loses_every_so_many_th_row_is_not_rounded(hertz, each):
    kept = np.delete(np.arange(400), np.arange(each - 1, 400, each))
    table = dict(t=kept / hertz, id=0 * kept, x=kept / hertz, y=0.0 * kept)
    store = EpisodeStore.from_table(table, time="t", agent="id", state=["x", "y"])
    assert not any("rounded" in note for note in store.card.warnings)
    np.testing.assert_allclose(entry(store, "own.vx"), 1.0, atol=1e-3)
    assert store.card.observation_origins is None, "a velocity is not moved"


def test_tables_in_parts_refuse_what_parts_would_make_different(tmp_path):
    table = fleet(episodes=20)
    names = {k: v for k, v in NAMES.items()}
    refused = []
    for k, (change, options) in enumerate(
        (
            ({}, {"neighbours": 1}),
            ({"id": np.where(table["run"] > 10, np.char.add(table["id"], "b"), table["id"])}, {}),
            ({"x": table["x"] + 5e6 * (table["run"] < 10), "y": table["y"]}, {}),
        )
    ):
        file = written(table | change, tmp_path / f"{k}.parquet")
        with pytest.raises(UserError) as error:
            large.import_large([file], tmp_path / "o.h5", rows=150, quiet=True, **names, **options)
        refused.append(str(error.value))
    assert "need sensing_radius" in refused[0] and "other agents than the rows before" in refused[1]
    assert "far from the rows before" in refused[2]
    file = tmp_path / "twice.csv"
    file.write_text("t,id,x,x\n" + "0,0,0,1\n" * 9)
    with pytest.raises(StoreError, match="has the column 'x' twice"):
        large.import_large([file], tmp_path / "o.h5", quiet=True, time="t", agent="id", state=["x"])


def test_points_and_flags_that_come_later_in_a_csv_are_read(tmp_path):
    file = tmp_path / "late.csv"
    rows = [f"{k if k < 2e5 else k + 0.0},0,{k % 7},{'true' if k % 50 == 49 else 'false'}" for k in range(400_000)]
    file.write_text("t,id,x,over\n" + "\n".join(rows))
    made = large.import_large(
        [file], tmp_path / "o.h5", rows=100_000, quiet=True, time="t", agent="id", state=["x"], terminated="over"
    )
    assert made.steps > 390_000 and EpisodeStore.load(tmp_path / "o.h5").terminated.sum() > 7000


def test_of_a_file_that_cannot_hold_what_it_claims_nothing_is_read(tmp_path):
    """However little of it is asked for."""
    import h5py

    store = EpisodeStore.from_table(fleet(), **NAMES)
    file = store.save(tmp_path / "bomb.h5")
    with h5py.File(file, "r+") as f:
        for name in set(f) - {"episode_ends"}:
            shape = (10**8 + store.episodes * (name == "observations"), *f[name].shape[1:])
            del f[name]
            f.create_dataset(name, shape, np.float32, chunks=(10**5, *shape[1:]), compression="gzip")
    with pytest.raises(StoreError, match="claims"):
        EpisodeStore.load(file, memory=2**20)
    other = store.save(tmp_path / "ends.h5")
    with h5py.File(other, "r+") as f:
        f["episode_ends"][0] = 0
    with pytest.raises(StoreError, match="episode_ends of '.*ends.h5' do not increase"):
        EpisodeStore.load(other, memory=2**10)
