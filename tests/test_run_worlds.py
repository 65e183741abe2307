"""The World that guards a run: read where there is one, and made by nobody but those who are asked to."""

from __future__ import annotations

import dataclasses
import json
import shutil

import jax
import numpy as np
import pytest

from ringfence.cli import app
from ringfence.datasets import registry
from ringfence.datasets.make import make
from ringfence.errors import NoWorld, UserError
from ringfence.loading.resolve import load, resolve
from ringfence.loading.spec import PolicySpec
from ringfence.logs.schema import other_data
from ringfence.training import loop, worlds
from ringfence.training.runs import Run
from ringfence.world import load as load_world
from ringfence.world import save
from tests.quick import QUICK_WORLD

TASK = "simple_spread-random"
TRAINING = {"changes": {"num_updates": 2, "width": 8}, "quiet": True}
USUAL = worlds.usual


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Tasks ask for Worlds that are fitted in a second."""
    monkeypatch.setattr(worlds, "usual", lambda *given: {**QUICK_WORLD, **USUAL(*given)})


@pytest.fixture(scope="module")
def regenerated():
    """A few of a task's own episodes."""
    return make(registry.get(TASK), 500)[0]


@pytest.fixture
def run(regenerated, tmp_path, monkeypatch) -> Run:
    """A run of them, where nothing was fitted yet."""
    monkeypatch.setenv("RINGFENCE_HOME", str(tmp_path / "home"))
    return loop.train("bc", regenerated, out=tmp_path / "runs", **TRAINING)[0]


def nothing_is_made(monkeypatch):
    for maker in ("make", "fit", "fitted"):
        monkeypatch.setattr(worlds, maker, lambda *_, **__: pytest.fail("data or a World were made"))


def same_world(one, other):
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("execution, flag", [(None, ""), ("decentralized", " --execution decentralized")])
def test_who_resolves_a_run_is_told_the_command_and_makes_nothing(run, monkeypatch, execution, flag):
    nothing_is_made(monkeypatch)
    with pytest.raises(
        NoWorld, match=f"^A guard of '{run.path}' needs .*; make it with `ringfence fit {run.path}{flag}`"
    ):
        resolve(PolicySpec.of(run, guard="shield", execution=execution))
    assert not (run.path / worlds.GUARD).exists()
    assert load(run)[0].task.name == TASK  # without a guard none is needed


def test_a_fitted_run_plays(run, monkeypatch, capsys):
    """Each execution has a file of its own, and a second fit reads what is there."""
    with pytest.raises(SystemExit):  # so quick a World is unfit, and that is its exit status
        app.main(["fit", str(run.path)])
    assert "unfit" in capsys.readouterr().out
    worlds.fit_run(run, execution="decentralized")
    shutil.rmtree(run.path.parents[3] / "home")
    nothing_is_made(monkeypatch)
    for execution, name in (("centralized", worlds.GUARD), ("decentralized", worlds.GUARD_ALONE)):
        made = load_world(run.path / name)
        policy = resolve(PolicySpec.of(run, guard="shield", execution=execution, anyway=True)).policy
        same_world(made, policy.guard.world)
        same_world(made, worlds.fit_run(run, execution=execution))


def test_a_cached_world_is_found_without_data(run, regenerated, monkeypatch):
    """By what the run's config tells; that of another seed is another's."""
    fitted = worlds.fit(regenerated)
    nothing_is_made(monkeypatch)
    same_world(fitted, worlds.for_guard(run))
    config = run.config
    (run.path / "config.json").write_text(json.dumps(config | {"seed": 1}))
    with pytest.raises(NoWorld):
        worlds.for_guard(run)
    card = {name: entry for name, entry in config["data"].items() if name != "content"}
    (run.path / "config.json").write_text(json.dumps(config | {"data": card}))
    with pytest.raises(NoWorld):
        worlds.for_guard(run)


def homogeneous(store):
    card = store.card.updated(task="alike", homogeneous=True)
    return dataclasses.replace(store, costs=np.repeat(store.costs[:, None], store.n_agents, 1), card=card)


def harmless(store):
    """Without costs, so that its formula labels."""
    return dataclasses.replace(store, costs=np.zeros_like(store.costs))


@pytest.mark.parametrize("of", [lambda store: store, homogeneous, harmless])
def test_so_is_one_of_own_data(own_store, tmp_path, monkeypatch, of):
    store = of(own_store)
    fitted = worlds.fit(store)
    run = loop.train("bc", store, out=tmp_path, **TRAINING)[0]
    nothing_is_made(monkeypatch)
    same_world(fitted, worlds.for_guard(run))
    same_world(worlds.fit_run(run), load_world(run.path / worlds.GUARD))


def test_what_a_world_is_made_of_names_it(own_store, tmp_path, monkeypatch):
    """The same arrays with other names, bounds or danger have another."""
    monkeypatch.setenv("RINGFENCE_HOME", str(tmp_path / "home"))
    worlds.fit(own_store)
    names = [f"entry{k}" for k in range(own_store.observations.shape[2])]
    for change in ({"observation_names": names}, {"action_high": 2.0}, {"hazard": {"kind": "CostColumn"}}, {"dt": 0.2}):
        other = dataclasses.replace(own_store, card=own_store.card.updated(**change))
        run = loop.train("bc", other, out=tmp_path / str(len(str(change))), **TRAINING)[0]
        with pytest.raises(UserError, match="needs the World of its data, which is not there; make one with"):
            worlds.for_guard(run)


def test_a_world_of_other_data_is_refused(run, own_store, small_world, tmp_path):
    """Under the name of the run's in the cache it is passed over; given, or in the folder, it is refused."""
    run_of_own = loop.train("bc", own_store, out=tmp_path / "own", **TRAINING)[0]
    fitted = worlds.fit(own_store)
    (file,) = (f for f in (tmp_path / "home/worlds").iterdir() if f.name.startswith("world"))
    same_world(fitted, worlds.for_guard(run_of_own))
    save(small_world, file)
    with pytest.raises(UserError, match="needs the World of its data"):
        worlds.for_guard(run_of_own)
    with pytest.raises(UserError, match="of other data"):
        worlds.for_guard(run_of_own, world=small_world)
    save(small_world, run_of_own.path / worlds.GUARD)
    with pytest.raises(UserError, match="of other data"):
        worlds.fit_run(run_of_own)


def test_the_command_line_fits_first_and_once(run, monkeypatch, capsys):
    command = ["eval", str(run.path), "--guard", "shield", "--anyway", "--episodes", "2", "--set"]
    command += ["correction_steps=1", "correction_restarts=0", "horizon=1"]
    app.main(command)
    assert (run.path / worlds.GUARD).exists() and run.results
    nothing_is_made(monkeypatch)
    app.main(command)
    assert "World of 'simple_spread-random'" in capsys.readouterr().err


def test_a_run_of_own_data_is_fitted_by_its_store(own_store, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("RINGFENCE_HOME", str(tmp_path / "home"))
    run = loop.train("bc", own_store, out=tmp_path, **TRAINING)[0]
    for words, said in (
        ([], "make one with `ringfence fit STORE --out FILE` and name it"),
        (["--seed", "1"], "--seed is for data, and"),
        (["--set", "causes=False"], "--set is for data"),
        (["--report", str(tmp_path / "c.html")], "--report is for data"),
    ):
        with pytest.raises(SystemExit):
            app.main(["fit", str(run.path), *words])
        assert said in " ".join(capsys.readouterr().err.split())


def test_regenerated_data_are_the_same_however_they_were_rounded():
    """Unlike anybody's own, of which the digest tells."""
    cards = [{"provenance": "regenerated by ringfence, seed 0", "content": content} for content in "ab"]
    assert not other_data(*cards)
    assert other_data(*({**card, "provenance": "user data"} for card in cards)) == [("content", "a", "b")]
