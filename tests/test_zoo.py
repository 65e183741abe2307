"""Trained policies that come with the package."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ringfence.cli import app
from ringfence.deploy import zoo
from ringfence.deploy.controller import Controller
from ringfence.errors import UserError
from ringfence.loading.resolve import load
from ringfence.training import loop, worlds
from ringfence.training.runs import Run


@pytest.mark.parametrize("name", zoo.names())
def test_every_one_is_loaded_with_the_world_that_guards_it(name, tmp_path, monkeypatch):
    """Nothing is regenerated, fitted or trained for it."""
    for maker in ("make", "fit"):
        monkeypatch.setattr(worlds, maker, lambda *_, **__: pytest.fail("made or fitted something"))
    run = zoo.pretrained(name, tmp_path)
    job, policy = load(run, guard="shield")
    assert (job.task.name, job.algorithm.name) == tuple(name.split("/"))
    assert policy.initial_state(2)
    assert run.path == tmp_path / name / "seed-0" and zoo.pretrained(name, tmp_path).path == run.path


def test_they_are_few_and_small():
    files = [f for f in zoo.FOLDER.rglob("*.safetensors")]
    assert len(zoo.names()) == 6 and sum(f.stat().st_size for f in files) < 12e6


def test_a_run_is_packed_and_comes_back(small_store, small_world, tmp_path):
    run = loop.train("bc", small_store, changes={"num_updates": 4, "width": 16}, quiet=True, out=tmp_path / "runs")[0]
    other = dataclasses.replace(small_world, ood_threshold=2 * small_world.ood_threshold)
    assert len(zoo.put(run, "mine/bc", small_world, small_world, tmp_path)) == 2
    made = zoo.put(run, "mine/bc", other, small_world, tmp_path)
    assert [f.name for f in made] == ["bc.safetensors", "world.safetensors", "bc-world.safetensors"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(zoo, "FOLDER", tmp_path)
        back = zoo.pretrained("mine/bc", tmp_path / "got")
    seen, state = small_store.observations[0], small_store.state[0]
    was, now = (
        Controller(r, guard="shield", horizon=1, correction_steps=1, correction_restarts=0, world=small_world)
        for r in (run, back)
    )
    np.testing.assert_allclose(now.act(seen, state), was.act(seen, state), atol=0.02)
    assert worlds.of_run(back).ood_threshold == 2 * worlds.for_guard(back).ood_threshold
    assert back.checkpoints()[0][0] == 4 and back.config == run.config


def test_what_does_not_fit_or_is_not_there_is_refused(tmp_path, capsys):
    with pytest.raises(UserError, match="beyond 65504"):
        zoo.half(np.float32([1e6]), "ema/actor")
    with pytest.raises(SystemExit):
        app.main(["pretrained", "crossing-hasty/bd"])
    assert "did you mean 'crossing-hasty/bc'" in capsys.readouterr().err
    (tmp_path / "crossing-hasty/bc/seed-0").mkdir(parents=True)
    config = zoo.pretrained("simple_spread-expert/bc", tmp_path).path / "config.json"
    (tmp_path / "crossing-hasty/bc/seed-0/config.json").write_text(config.read_text())
    with pytest.raises(UserError, match="holds another run"):
        zoo.pretrained("crossing-hasty/bc", tmp_path)
    assert not Run(tmp_path / "crossing-hasty/bc/seed-0").checkpoints()
    app.main(["pretrained"])
    assert capsys.readouterr().out.split() == zoo.names()
