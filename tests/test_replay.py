"""Replay: one agent driven, the others as logged, on walkers whose contacts are known by construction."""

import dataclasses
import json

import numpy as np
import pytest
from msgspec.structs import replace

import ringfence
from ringfence.cli import app
from ringfence.deploy.controller import Controller
from ringfence.errors import UserError
from ringfence.evaluation import replay
from ringfence.evaluation.certificate import Certificate
from ringfence.evaluation.certify import Windowed, certify
from ringfence.evaluation.replay import Body, Film, Played, check_view, radius_of, rows_of
from ringfence.evaluation.replay_scene import motion_of, names_of, windows_of
from ringfence.evaluation.replay_stage import Stage, kinematics_of
from ringfence.evaluation.statistics import upper_bound
from ringfence.faults import Faults
from ringfence.guards.policy import build
from ringfence.guards.wrap import Nothing
from ringfence.logs.store import EpisodeStore
from ringfence.problem.entries import Names
from ringfence.report import logs_pages
from ringfence.world import save
from ringfence.world.card import Verdict
from ringfence.world.causes import Cause, Edge, Found
from ringfence.world.quantities import Entry, Length
from tests.quick import QUICK_WORLD

DT, STEPS, EPISODES, RADIUS = 0.1, 40, 12, 0.5
NAMES = ["own.vx", "own.vy", "other0.dx", "other0.dy", "other0.dvx", "other0.dvy"]


def walkers(reach=2.0, late=0.5, **card) -> EpisodeStore:
    """Two walk at 1 m/s toward a crossing, each `reach` m away. The first one brakes and stands 0.8 m before it, the
    second one walks on. So nobody touches as logged; who drives the first one straight on touches in every episode,
    and who drives the second one straight on never does. `late` is how much of a step they go with the next velocity.
    """
    turns = np.random.default_rng(0).uniform(0, 2 * np.pi, EPISODES)
    along = np.stack([np.stack([np.cos(turns), np.sin(turns)], -1), np.stack([-np.sin(turns), np.cos(turns)], -1)], 1)
    speed = np.ones((STEPS + 1, 2))
    speed[:, 0] = np.clip(1.0 - 0.1 * (np.arange(STEPS + 1) - 7), 0, 1)
    velocity = speed[None, :, :, None] * along[:, None]
    moved = (late * velocity[:, 1:] + (1 - late) * velocity[:, :-1]) * DT
    place = np.concatenate([np.zeros_like(moved[:, :1]), moved.cumsum(1)], 1) - reach * along[:, None]
    relative = [x[:, :, ::-1] - x for x in (place, velocity)]
    given = {"task": "walkers", "dt": DT, "action_low": -2.0, "action_high": 2.0, "observation_names": NAMES}
    costs = (np.linalg.norm(relative[0][:, 1:, 0], axis=-1) < RADIUS).astype(float)
    return EpisodeStore.from_episodes(
        np.concatenate([velocity, *relative], -1).astype(np.float32),
        (np.diff(velocity, axis=1) / DT).astype(np.float32),
        np.zeros((EPISODES, STEPS, 2), np.float32),
        costs,
        card=given | card,
    )


def stage_of(store: EpisodeStore) -> Stage:
    names = names_of(store)
    motion = motion_of(store, names)
    cut, _ = windows_of(store, names, motion, np.arange(store.episodes), STEPS, 300, RADIUS, DT)
    return Stage(cut, kinematics_of(None, store, motion, None, DT, 2.7), RADIUS, 0)


@pytest.fixture(scope="module")
def close():
    """Logs of walkers of whom the second one passes closely, and their World."""
    store = walkers(reach=0.9)
    assert store.costs.any()
    return store, ringfence.fit(store, **QUICK_WORLD)


@pytest.fixture(autouse=True)
def shortsighted(monkeypatch):
    """The formula's guard looks five rows ahead, not twenty, which take long to compile."""
    monkeypatch.setattr(replay, "LONG", 5 * DT)


def test_who_drives_blindly_touches_and_a_guard_prevents_or_causes():
    stage = stage_of(walkers())
    assert stage.kinematics.name == "double_integrator"
    assert stage.kinematics.gain == pytest.approx(DT, rel=1e-3)
    straight = stage.play("straight")
    first = stage.windows.driven == 0
    assert straight.contact[first].all() and not straight.contact[~first].any()
    np.testing.assert_allclose(straight.place[~first], stage.windows.place[~first], atol=1e-4)  # as it walked
    brake, seek = stage.play("straight", brake=True), stage.play("seek")
    none, perfect, bad = rows_of(stage, Played("straight", straight, {"brake": brake, "seek": seek}))
    assert (none.windows, none.logged, none.alone, none.contacts) == (2 * EPISODES, 0, EPISODES, EPISODES)
    assert (perfect.contacts, perfect.prevented, perfect.caused) == (0, EPISODES, 0)
    assert (bad.prevented, bad.caused) == (0, EPISODES)  # it leads the second one to the first one, who stands
    assert perfect.prevented_interval == pytest.approx((0.7354, 1.0), abs=1e-3)  # Clopper and Pearson, 12 of 12


def flyers() -> EpisodeStore:
    """The walkers in a plane that stands aslant in space."""
    aslant = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0][:2]
    store = walkers()
    pairs = store.observations.reshape(*store.observations.shape[:2], 3, 2)
    names = [f"{of}{axis}" for of in ("own.v", "other0.d", "other0.dv") for axis in "xyz"]
    return dataclasses.replace(
        store,
        observations=(pairs @ aslant).reshape(*pairs.shape[:2], 9).astype(np.float32),
        actions=(store.actions @ aslant).astype(np.float32),
        card=store.card.updated(observation_names=names),
    )


def test_who_flies_is_replayed_in_space(tmp_path):
    plane, stage = stage_of(walkers()), stage_of(flyers())
    assert stage.kinematics.name == "double_integrator" and stage.kinematics.gain == pytest.approx(DT, rel=1e-3)
    assert stage.windows.place.shape[-1] == 3
    for driver in ("straight", "accelerate", "hasty", "seek"):
        np.testing.assert_array_equal(stage.play(driver).contact, plane.play(driver).contact)
    moved = np.array([0.3, -0.2, 0.5])
    w = stage.windows
    seen, _ = w.observed(5, w.place[:, 5] + moved, w.velocity[:, 5], np.zeros(w.count))
    mine = seen[np.arange(w.count), w.driven] - w.observations[np.arange(w.count), 5, w.driven]
    np.testing.assert_allclose(mine[:, 3:6], np.tile(-moved, (w.count, 1)), atol=1e-5)
    with pytest.raises(UserError, match="kinematics='bicycle' moves in a plane, and these logs are of space"):
        ringfence.replay(None, flyers(), radius=RADIUS, guard="none", kinematics="bicycle")
    place = stage.play("seek").place[0]
    film = Film("seek", others=w.others_at[0], logged=w.place[0], alone=place, guarded=place)
    assert "<svg" in logs_pages._drawn(film, RADIUS, 0)


def test_driven_agents_observe_what_they_would():
    stage = stage_of(walkers())
    w = stage.windows
    moved, faster = np.array([0.3, -0.2]), np.array([0.1, 0.4])
    seen, state = w.observed(5, w.place[:, 5] + moved, w.velocity[:, 5] + faster, np.zeros(w.count))
    mine, logged = seen[np.arange(w.count), w.driven], w.observations[np.arange(w.count), 5, w.driven]
    expected = np.concatenate([faster, -moved, -faster])
    np.testing.assert_allclose(mine - logged, np.tile(expected, (w.count, 1)), atol=1e-5)
    other = seen[np.arange(w.count), 1 - w.driven] - w.observations[np.arange(w.count), 5, 1 - w.driven]
    np.testing.assert_allclose(other, np.tile([0, 0, *moved, *faster], (w.count, 1)), atol=1e-5)
    assert state is None


def test_a_world_guards_bad_drivers_in_the_command_and_on_a_page(close, tmp_path, capsys):
    store, world = close
    store.save(tmp_path / "walkers.h5")
    save(world, tmp_path / "world.safetensors")
    held_out = ringfence.replay(None, store, world=world, radius=0.1, drivers=())
    assert held_out.windows == 2 * world.card.held_out.episodes < 2 * EPISODES
    fresh = dataclasses.replace(store, rewards=store.rewards + 1)
    assert ringfence.replay(None, fresh, world=world, radius=0.1, drivers=()).windows == 2 * EPISODES
    command = ["replay", str(tmp_path / "world.safetensors"), str(tmp_path / "walkers.h5"), "--every-episode"]
    command += ["--anyway", "--windows", "6", "--radius", "0.1", "--out", str(tmp_path / "r.json")]
    app.main([*command, "--report", str(tmp_path / "r.html")])
    assert "straight" in capsys.readouterr().out
    result = json.loads((tmp_path / "r.json").read_text())
    assert result["radius_from"] == "given" and result["windows"] == 6
    assert {row["filter"] for row in result["rows"]} == {"none", "shield", "formula", "brake"}
    guarded = next(row for row in result["rows"] if row["filter"] == "shield")
    assert {"agent", "contacts", "infeasible", "ood", "clearance"} <= guarded["by_agent"][0].keys()
    page = (tmp_path / "r.html").read_text()
    assert "<svg" in page and "http://" not in page.replace("http://www.w3.org", "")


def test_the_radius_is_told_by_the_formula_or_by_costs():
    store = walkers(reach=0.9)
    motion = motion_of(store, names_of(store))
    radius, source = radius_of(store, motion, None)
    assert source == "the logged costs" and radius == pytest.approx(RADIUS, abs=0.1)
    assert radius_of(store, motion, 0.3) == (0.3, "given")
    with pytest.raises(UserError, match="Nothing says how close is contact"):
        radius_of(walkers(), motion, None)


def test_the_radius_is_that_of_the_worlds_cause_where_costs_tell_no_distance():
    """Half of the danger is a speed, say, and the World's card knows below what distance the rest of it is."""
    store = walkers(reach=0.9)
    motion = motion_of(store, names_of(store))
    elsewhere = np.random.default_rng(0).random(store.costs.shape) < 0.5
    several = dataclasses.replace(store, costs=np.maximum(store.costs, elsewhere).astype(np.float32))
    near = Cause((Length((Entry((2,), "other.dx"), Entry((3,), "other.dy"))),))
    fast = Cause((Length((Entry((4,), "other.dvx"), Entry((5,), "other.dvy"))),))
    edges = (Edge((0.0,), (2.0,), at=0.9, below=False), Edge((0.0,), (2.0,), at=0.45))
    found = Found((fast, near), shares=(0.6, 0.4), edges=edges)
    radius, source = radius_of(several, motion, None, {"contact": found})
    assert radius == 0.45 and source.startswith("the World's cause 'length of other.dx, other.dy'")
    assert "other dangers are not counted" in source
    assert radius_of(store, motion, None, {"contact": found}) == radius_of(store, motion, None)
    assert radius_of(walkers(), motion, None, {"": found})[0] == 0.45, "and where nothing has a cost"
    for causes in ({}, {"": Found((fast,), shares=(0.6,), edges=edges[:1])}):
        with pytest.raises(UserError, match=r"No distance tells .* give radius= \(--radius\)"):
            radius_of(several, motion, None, causes)


def test_replays_show_their_progress_unless_they_are_quiet(capsys):
    stage = stage_of(walkers())
    quiet = replay._played(stage, {"straight": "straight"}, {}, brake=True)
    assert capsys.readouterr().err == ""
    shown = replay._played(stage, {"straight": "straight"}, {}, brake=True, quiet=False)
    said = capsys.readouterr().err
    assert f"straight, no guard (1 of 2): {STEPS}/{STEPS}" in said and "straight, brake (2 of 2)" in said
    np.testing.assert_array_equal(shown[0].plain.contact, quiet[0].plain.contact)
    assert list(shown[0].under) == ["brake"]


def test_what_cannot_be_replayed_is_refused_in_a_sentence():
    store = walkers()
    unnamed = store.card.updated(observation_names=None)
    assert names_of(dataclasses.replace(store, card=unnamed)).slots == names_of(store).slots, (
        "they are told by the logs"
    )
    noise = np.random.default_rng(0).normal(size=store.observations.shape)
    blind = dataclasses.replace(store, card=unnamed, observations=(store.observations + noise).astype(np.float32))
    with pytest.raises(UserError, match="hold no places"):
        ringfence.replay(None, blind, radius=RADIUS)
    alone = EpisodeStore.from_episodes(
        np.zeros((12, 5, 1, 2)), np.zeros((12, 4, 1, 2)), np.zeros((12, 4, 1)), None, card={"task": "one", "dt": 0.1}
    )
    with pytest.raises(UserError, match="has one agent"):
        ringfence.replay(None, alone, radius=RADIUS)
    with pytest.raises(UserError, match="Nothing says which World"):
        ringfence.replay(None, store, radius=RADIUS)
    with pytest.raises(UserError, match="kinematics='rocket'"):
        ringfence.replay(None, store, radius=RADIUS, guard="none", kinematics="rocket")
    for wrong in ({"wheelbase": -1}, {"wheelbase": np.inf}, {"radius": "a"}, {"radius": True}):
        with pytest.raises(UserError, match="must be a number of metres above 0"):
            ringfence.replay(None, store, guard="none", **wrong)
    slow = dataclasses.replace(store, card=store.card.updated(dt=10.0))
    with pytest.raises(UserError, match=r"A step of .* is 10 s, and a window has 8 s; .* \(--steps, steps=\)"):
        ringfence.replay(None, slow, radius=RADIUS, guard="none")


@pytest.mark.verdicts
def test_a_world_of_other_logs_or_unfit_is_refused(close):
    store, world = close
    check_view(world, store)
    swapped = [NAMES[1], NAMES[0], *NAMES[2:]]
    with pytest.raises(UserError, match="reads 'own.vx' where these logs hold 'own.vy'"):
        check_view(world, dataclasses.replace(store, card=store.card.updated(observation_names=swapped)))
    with pytest.raises(UserError, match="actions are within"):
        check_view(world, dataclasses.replace(store, card=store.card.updated(action_high=3.0)))
    verdict = Verdict("unfit", ("it is made up",), ("fit",))
    unfit = dataclasses.replace(world, card=replace(world.card, verdict=verdict))
    with pytest.raises(UserError, match="unfit to guard by: it is made up"):
        ringfence.replay(None, store, world=unfit, radius=0.1)


@pytest.mark.parametrize("late", [0.0, 0.5, 1.0])
def test_bodies_go_with_the_velocity_that_the_logs_have_them_go_with(late):
    store = walkers(late=late)
    motion = motion_of(store, names_of(store))
    assert motion.late == late
    stage = stage_of(store)
    first = stage.windows.driven == 0
    np.testing.assert_allclose(stage.play("straight").place[~first], stage.windows.place[~first], atol=1e-4)
    there, _, _ = stage.kinematics.moved(np.zeros((1, 2)), np.zeros((1, 2)), np.zeros(1), np.array([[1.0, 0.0]]), None)
    assert there == pytest.approx(np.array([[late * DT**2, 0.0]]), abs=1e-6)


def test_kinematics_move_as_they_say():
    store = walkers()
    motion = motion_of(store, names_of(store))
    place, velocity, heading = np.zeros((1, 2)), np.array([[1.0, 0.0]]), np.zeros(1)
    unicycle = kinematics_of("unicycle", store, motion, None, DT, 2.7)
    there, after, turned = unicycle.moved(place, velocity, heading, np.array([[2.0, 1.0]]), None)
    assert turned == pytest.approx([DT]) and np.linalg.norm(after) == pytest.approx(unicycle.max_speed)
    _, slower, _ = unicycle.moved(place, velocity, heading, np.array([[-2.0, 0.0]]), None)
    assert slower == pytest.approx(np.array([[1 - 2 * DT, 0.0]]))
    bicycle = kinematics_of("bicycle", store, motion, None, DT, 2.0)
    _, _, turned = bicycle.moved(place, velocity, heading, np.array([[0.0, 0.3]]), None)
    assert turned == pytest.approx([np.tan(0.3) / 2.0 * DT])
    with pytest.raises(UserError, match="as kinematics='holonomic' would"):  # these actions are accelerations
        kinematics_of("holonomic", store, motion, None, DT, 2.7)
    speeds = dataclasses.replace(store, actions=np.float32(0.5) * store.observations[:-EPISODES, :, :2])
    rows = np.arange(store.steps) + store.episode_of_step + 1
    speeds.actions[:] = 0.5 * store.observations[rows][..., :2]
    holonomic = kinematics_of("holonomic", speeds, motion, None, DT, 2.7)
    assert holonomic.gain == pytest.approx(2.0, rel=1e-3)
    _, after, _ = holonomic.moved(place, velocity, heading, np.array([[0.0, 0.25]]), None)
    assert after == pytest.approx(np.array([[0.0, 0.5]]), rel=1e-3)


def test_a_run_is_replayed_under_every_filter(close, tmp_path):
    store, world = close
    (run,) = ringfence.train("bc", store, seeds=(0,), out=tmp_path, changes={"num_updates": 5})
    given = dict(world=world, radius=0.1, windows=4, every_episode=True, drivers=("seek",))
    result = ringfence.replay(run, store, guard="shield", **given)
    names = [(row.policy, row.filter) for row in result.rows]
    filters = ("none", "shield", "formula", "brake")
    assert names == [(policy, filter) for policy in ("bc", "seek") for filter in filters]
    for row in result.rows:
        assert row.contacts == row.alone - row.prevented + row.caused


@pytest.fixture(scope="module")
def cloned(close, tmp_path_factory):
    (run,) = ringfence.train("bc", close[0], out=tmp_path_factory.mktemp("cloned"), changes={"num_updates": 5})
    return run


SMALL = {"anyway": True, "horizon": 2, "terminal_value": False, "correction_steps": 2, "correction_restarts": 0}
WINDOWS = {"radius": 0.1, "steps": 20, "every_episode": True, **SMALL}


def test_a_run_without_a_simulator_is_certified_by_replaying_logs(close, cloned, tmp_path, capsys):
    """The margin is calibrated on one half of the logs, and the bound is counted on the other."""
    store, world = close
    save(world, tmp_path / "world.safetensors")
    store.save(tmp_path / "walkers.h5")
    given = {"world": world, "quantile": 0.9, "calibration": 9, "episodes": 10, **WINDOWS}
    made = certify(cloned, {"delay": 1}, logs=store, **given)
    assert made.guard["delay"] == 1 and made.episodes == 10 and made.rounds[0]["episodes"] == 9
    assert made.bound == pytest.approx(upper_bound(made.violations, 10))
    about = {"windows": [9, 10], "seconds": 2.0, "kinematics": "double_integrator", "radius": 0.1}
    assert about.items() <= made.replayed.items()
    file = made.save(tmp_path / "cert.json")
    assert Certificate.load(file) == made
    assert any("one agent is driven" in line for line in made.summary())
    how = {"guard": "shield", "world": world, **SMALL}
    controller = Controller(cloned, certificate=file, delay=1, driven=1, **how)
    controller.act(store.observations[0])
    assert "covered" in controller.info
    with pytest.raises(UserError, match="decides for 1 of 2 agents, and this one decides for 2; say for whom"):
        Controller(cloned, certificate=file, delay=1, **how)
    for wrong, words in (
        ({"logs": None}, "radius is of replays; give logs="),
        ({"logs": None, **dict.fromkeys(("radius", "steps")), "every_episode": False}, "or logs that are replayed"),
        ({"calibration": 5}, "calibration=5 episodes tell no quantile of 0.9; give 9 or more"),
        ({"steps": STEPS, "every_episode": False}, "The first half of these logs has . windows"),
    ):
        with pytest.raises(UserError, match=words):
            certify(cloned, {}, **{"logs": store, **given, **wrong})
    command = ["certify", str(cloned.path), "--logs", str(tmp_path / "walkers.h5"), "--out", str(file), "--anyway"]
    command += ["--quantile", "0.9", "--calibration", "9", "--episodes", "10", "--steps", "20", "--every-episode"]
    command += ["--world", str(tmp_path / "world.safetensors"), "--radius", "0.1", "--delay", "1", "--horizon", "2"]
    app.main([*command, "--set", "terminal_value=false", "correction_steps=2", "correction_restarts=0"])
    assert "windows violate" in capsys.readouterr().out
    assert Certificate.load(file).violations == made.violations


def test_windows_are_halved_by_the_order_of_logs_and_what_was_foreseen_is_compared_with_what_came(close, cloned):
    store, world = close
    body = Body(radius=0.1, steps=20, every_episode=True)
    windowed = Windowed.of(store, cloned, world, body, Faults(), {"calibration": 100, "test": 100}, 1, True)
    first, second = (set(zip(w.episode, w.start)) for w in (windowed.calibration.windows, windowed.test.windows))
    assert first and max(first) < min(second)
    guard = build(Nothing(), world, None, "shield", "learned", margin=-50.0, **SMALL)
    driven = windowed.test.play("straight", guard)
    came = windowed.test.scores(guard.guard, driven)
    foreseen = driven.info["next_clearance"]
    assert came.shape == foreseen.shape == (windowed.test.windows.count, 20)
    error = [np.abs(foreseen[:, : 20 - lag] - came[:, lag:]).mean() for lag in range(3)]
    assert np.argmin(error) == 0


def test_a_replayed_guard_that_knows_of_faults_has_the_options_for_them(close, cloned, monkeypatch):
    store, world = close
    guards = []
    monkeypatch.setattr(replay, "_played", lambda stage, players, filters, *_: guards.append(filters["shield"]) or [])
    monkeypatch.setattr(replay, "rows_of", lambda *_: [])
    for run in (None, cloned):
        given = {"world": world, "radius": 0.1, "baselines": False, "anyway": True, "every_episode": True}
        result = ringfence.replay(run, store, faults={"delay": 1, "drop": 0.2}, compensate=True, **given)
        options = guards.pop().guard.options
        assert options.delay == 1 and options.max_age > 0
        assert "which the guard knows" in result.notes[0]
    with pytest.raises(UserError, match="compensate is read by nothing without a guard"):
        ringfence.replay(None, store, radius=0.1, guard="none", faults={"delay": 1}, compensate=True)


def test_a_driven_agent_of_undelayed_logs_acts_as_late_as_they_did_and_its_guard_knows(close, monkeypatch):
    store, world = close
    late = dataclasses.replace(store, card=store.card.updated(action_delay=1))
    knows = dataclasses.replace(world, card=replace(world.card, data=replace(world.card.data, action_delay=1)))
    seen = []
    monkeypatch.setattr(replay, "_played", lambda stage, _, filters, *__: seen.append((stage, filters["shield"])) or [])
    monkeypatch.setattr(replay, "rows_of", lambda *_: [])
    given = {"world": knows, "radius": 0.1, "baselines": False, "anyway": True, "every_episode": True}
    result = ringfence.replay(None, late, **given)
    assert "take effect 1 step late, as whoever was logged" in result.notes[0]
    ringfence.replay(None, late, faults={"delay": 1}, compensate=True, **given)
    assert [(stage.faults.delay, guard.guard.options.delay) for stage, guard in seen] == [(1, 1), (2, 2)]
    with pytest.raises(UserError, match="undelayed by 1 steps, these by 0"):
        ringfence.replay(None, store, **given)


def test_the_driven_agent_has_faults_and_the_others_none():
    """Three late steps: it goes on as it began for three, and then does what it did at first without them."""
    stage = stage_of(walkers())
    plain = stage.play("seek").place
    late = dataclasses.replace(stage, faults=Faults(delay=3)).play("seek").place
    steps = np.diff(late[:, :5], axis=1)
    np.testing.assert_allclose(steps[:, 1:3], steps[:, :2], atol=1e-6)
    assert np.abs(np.diff(plain[:, :3], 2, axis=1)).max() > 1e-3
    gained = [np.linalg.norm(np.diff(place, axis=1), axis=-1) for place in (late[:, 3:5], plain[:, :2])]
    np.testing.assert_allclose(*gained, atol=1e-5)


def test_a_guard_of_a_team_decides_for_the_driven_agent_alone(close):
    store, world = close
    stage = stage_of(store)
    team = build(Nothing(), world, None, "shield", "learned", anyway=True)
    assert not world.alone and team.driven is None
    driven = np.asarray(stage._of_one(team).driven)
    np.testing.assert_array_equal(driven.argmax(1), stage.windows.driven)
    assert (driven.sum(1) == 1).all()


def test_whatever_is_relative_to_a_driven_agent_moves_with_it_and_what_no_name_explains_is_said():
    names = ("own.vx", "own.vy", "other0.dx", "other0.dy", "still_a.dx", "still_a.dy", "wall0.dx", "own.charge", "obs8")
    found = Names.of(names, (), 2)
    assert found.things == ["still_a", "wall0"]
    assert found.as_logged == ["own.charge", "obs8"]
