"""The command line: what it prints, what it refuses, and the whole job from data to page."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace

import pytest
from rich.table import Table

from ringfence.cli.app import main
from ringfence.cli.first import demonstrate
from ringfence.cli.shared import console
from ringfence.errors import UserError
from ringfence.evaluation import protocol
from ringfence.guards import GUARDS
from ringfence.logs.schema import ARRAYS
from ringfence.logs.store import EpisodeStore
from ringfence.training import worlds
from ringfence.training.runs import Run


def test_lists_tasks(capsys):
    main(["tasks"])
    told = capsys.readouterr().out
    assert "halfcheetah_2x3-medium-quantile" in told and "> 2.197 m/s" in told, "names are never cut"


def test_makes_and_describes_data(tmp_path, capsys):
    file = tmp_path / "d.h5"
    main(["data", "make", "simple_spread-random", "--size", "1000", "--seed", "3", "--out", str(file)])
    assert EpisodeStore.load(file).episodes == 40
    capsys.readouterr()
    main(["data", "info", str(file)])
    told = capsys.readouterr().out
    assert "not the public files" in told and "warning" in told and "episodes starting unsafe" in told


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["train", "icfb", "simple_spread-medium"], "did you mean 'icbf'"),
        (["train", "icbf", "simple_spread-medum"], "did you mean 'simple_spread-medium'"),
        (["train", "icbf", "simple_spread-medium", "--set", "barier_weight=3"], "did you mean 'barrier_weight'"),
        (["train", "icbf", "simple_spread-medium", "--set", "num_updates"], "name=value"),
        (["train", "icbf", "simple_spread-medium", "--set", "lr=1", "--set", "lr=2"], "gives lr twice, 1 and 2"),
        (["train", "icbf", "simple_spread-medium", "--set", "num_updates=many"], "cannot be read as int"),
        (["train", "icbf", "simple_spread-medium", "--set", "net=unit"], "did you mean 'unet'"),
        (["train", "icbf", "nowhere.h5"], "No episode store"),
        (["eval", "nowhere"], "does not exist"),
        (["report", "nowhere"], "does not exist"),
        (["data", "info", "nowhere.h5"], "No episode store"),
        (["data", "make", "simple_spread-medium-replay", "--size", "1000000"], "3900 episodes"),
    ],
)
def test_refuses_in_one_sentence(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    told = capsys.readouterr().err
    assert stop.value.code == 2 and message in told and "Traceback" not in told
    assert not list(tmp_path.iterdir())


def test_places_that_cannot_be_written_are_refused(tmp_path, monkeypatch, capsys):
    (tmp_path / "file").write_text("mine")
    monkeypatch.chdir(tmp_path)
    make = ["data", "make", "simple_spread-random", "--size", "25"]
    bench = ["bench", "simple_spread", "--tasks", "simple_spread-random", "--algorithms", "bc"]
    told = [
        ([*make, "--out", "file/x.h5"], "'file/x.h5' could not be written"),
        ([*make, "--out", ""], "names no file"),
        (["bench", "status", "file"], "no results folder"),
        ([*bench, "--out", "file"], "'file' is a file"),
        ([*bench, "--num-updates", "10"], "--num-updates 10 makes other rows than the suite's own"),
        ([*bench, "--out", "new", "--threads", "0"], "threads=0 must be at least 1"),
        ([*bench, "--out", "new", "--engine", "ray", "--memory", "4"], "--memory is about local processes"),
        (["report", "file/x"], "does not exist"),
    ]
    for words, said in told:
        with pytest.raises(SystemExit) as stop:
            main(words)
        assert stop.value.code == 2 and said in capsys.readouterr().err, words
    monkeypatch.setenv("RINGFENCE_HOME", str(tmp_path / "file"))
    for words in (make, ["demo", "--quick", "--out", "demo"]):
        with pytest.raises(SystemExit) as stop:
            main(words)
        assert stop.value.code == 2 and "error:" in capsys.readouterr().err


def test_errors_of_the_system_are_told_in_one_sentence(monkeypatch, capsys, tmp_path):
    def refuses(self):
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr("pathlib.Path.exists", refuses)
    with pytest.raises(SystemExit) as stop:
        main(["eval", str(tmp_path)])
    assert stop.value.code == 2 and "Permission denied; check that the path" in capsys.readouterr().err


def test_it_is_said_which_of_several_runs_was_refused(monkeypatch, capsys, tmp_path):
    def refuse(run, **told):
        raise UserError("this policy has diverged." if run.path.name != "b" else f"'{run.path}' is damaged.")

    monkeypatch.setattr("ringfence.evaluation.evaluate.evaluate", refuse)
    for name in "abc":
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.json").write_text("{}")
    with pytest.raises(SystemExit):
        main(["eval", str(tmp_path)])
    told = capsys.readouterr().err
    assert f"error: {tmp_path}/a, {tmp_path}/c: this policy has diverged." in told
    assert f"error: '{tmp_path}/b' is damaged." in told


@pytest.mark.parametrize("share, said", [(0.22, True), (0.01, False), (None, False)])
def test_it_is_said_where_a_guard_often_finds_nothing(monkeypatch, capsys, tmp_path, share, said):
    names = "return_mean cost_mean cost_safe_start violation_rate violation_upper return_norm cost_norm"
    result = dict.fromkeys([*names.split(), "termination_rate"], 0.0) | {"variant": "shield", "task": "", "agents": 2}
    result |= {} if share is None else {"infeasible_rate": share}
    monkeypatch.setattr("ringfence.evaluation.evaluate.evaluate", lambda run, **_: result)
    (tmp_path / "config.json").write_text("{}")
    main(["eval", str(tmp_path)])
    assert ("in 22 % of the steps the guard found no action that keeps its margin" in capsys.readouterr().out) == said


def test_cells_are_whole_where_no_terminal_reads_them(capsys):
    table = Table("run", "guard")
    table.add_row("runs/" + "x" * 300, "shield")
    console().print(table)
    assert "x" * 300 in capsys.readouterr().out


def test_every_set_counts(monkeypatch):
    heard = []
    monkeypatch.setattr("ringfence.training.loop.train", lambda *_, changes, **__: heard.append(changes) or [])
    monkeypatch.setattr("ringfence.cli.app._store", lambda data: None)
    main(["train", "bc", "mine.h5", "--set", "num_updates=3", "batch=4", "--set", "width=8", "--seeds", "2"])
    assert heard == [{"num_updates": "3", "batch": "4", "width": "8"}]


def test_info_says_where_cost_and_hazard_disagree(small_store, tmp_path, capsys):
    """Every step's cost is what the formula says of the state after it; three are changed by hand."""
    costs = small_store.costs.copy()
    costs[[3, 24, 25]] = 1 - (costs[[3, 24, 25]] > 0)
    for name, store in (("a", small_store), ("b", replace(small_store, costs=costs))):
        main(["data", "info", str(store.save(tmp_path / f"{name}.h5"))])
    told = [line for line in capsys.readouterr().out.splitlines() if line.startswith("cost and hazard disagree")]
    assert [line.split()[4] for line in told] == ["0.00", f"{300 / small_store.steps:.2f}"]


def test_brackets_in_messages_are_no_markup(capsys, tmp_path, monkeypatch):
    folder = tmp_path / "[bold]" / "[" / "abs]"
    folder.mkdir(parents=True)
    (folder / "metadata.json").write_text("{}")
    with pytest.raises(SystemExit):
        main(["data", "import-ogmarl", str(folder), "--task", "ant_2x4", "--out", str(tmp_path / "x.h5")])
    assert "[bold]/[/abs]/metadata.json' is truncated, damaged" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "tensorstore", None)  # as if it were not installed
    with pytest.raises(SystemExit):
        main(["data", "import-ogmarl", str(folder), "--task", "ant_2x4", "--out", str(tmp_path / "x.h5")])
    assert "run pip install 'ringfence[vault]'" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["data", "import-madiff", str(folder), "--task", "ant_2x4", "--out", str(tmp_path / "x.h5")])
    assert "[bold]/[/abs]' lacks obs.npy" in capsys.readouterr().err


def test_the_whole_job(tmp_path, monkeypatch, capsys):
    """`make demo`, tiny: data, two trainings, evaluations on the same resets, the table and the page."""
    monkeypatch.setenv("RINGFENCE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(protocol, "CHUNK", 10)
    monkeypatch.setitem(GUARDS, "full", {**GUARDS["full"], "horizon": 2, "num_restarts": 2, "correction_steps": 1})
    monkeypatch.setitem(GUARDS, "shield", {"correction_steps": 1, "horizon": 1})
    page = demonstrate(tmp_path / "demo", "random", quick=True)
    text = page.read_text()
    assert "http://" not in text.replace("http://www.w3.org", "") and "https://" not in text
    results = [json.loads(f.read_text()) for f in (tmp_path / "demo").rglob("results.json")]
    starts = {tuple(r["per_episode"]["unsafe_start"]) for found in results for r in found.values()}
    assert len(results) == 2 and len(starts) == 1
    told = capsys.readouterr().out
    assert "BC, full guard, learned" in told and "MADIFF" in told
    assert "of 1000 held-out steps" in told


@pytest.mark.parametrize("platform", ["tpu", "cuda"])
def test_the_doctor_works_where_jax_finds_no_device(platform):
    """The one moment that it is for. Of a platform without a plugin JAX tells nothing."""
    code = "from ringfence.cli.app import main; main(['doctor'])"
    environment = {**os.environ, "JAX_PLATFORMS": platform}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert done.returncode == 0 and "Traceback" not in done.stderr
    line = next(line for line in done.stdout.splitlines() if line.startswith("devices"))
    assert "none (" in line and line.endswith(
        f"JAX_PLATFORMS={platform} asks for what is not here; unset it, or set JAX_PLATFORMS=cpu."
    )


def test_a_folder_of_runs_is_what_it_holds(tmp_path):
    """From Python, as the command line resolves it."""
    for seed in (0, 1):
        (tmp_path / "toy" / "bc" / f"seed-{seed}").mkdir(parents=True)
        (tmp_path / "toy" / "bc" / f"seed-{seed}" / "config.json").write_text("{}")
    with pytest.raises(UserError, match=r"holds 2 runs; name one of them: .*seed-0.*seed-1'\.$"):
        Run.of(tmp_path / "toy")
    shutil.rmtree(tmp_path / "toy" / "bc" / "seed-1")
    assert Run.of(str(tmp_path)).path == tmp_path / "toy" / "bc" / "seed-0"
    assert Run.of(tmp_path / "nothing").path == tmp_path / "nothing", "refused where its config is read"


def test_a_card_does_not_speak_to_the_terminal(small_store, tmp_path, capsys):
    """Warnings and names of a stranger's store are shown, controls and all, as letters."""
    card = {**small_store.card.to_dict(), "warnings": ["a\x1b]0;title\x07b"]}
    arrays = {name: getattr(small_store, name) for name in ARRAYS if name != "costs"}
    store = EpisodeStore(**arrays, costs=small_store.costs, state=small_store.state, card=card)
    main(["data", "info", str(store.save(tmp_path / "s.h5"))])
    said = capsys.readouterr().out
    assert "a\\x1b]0;title\\x07b" in said and "\x1b" not in said


@pytest.mark.parametrize("flag, value", [("--states", "0"), ("--seed", "-1"), ("--seed", str(2**31 - 1))])
def test_ope_refuses_before_it_reads_anything(flag, value, tmp_path, capsys):
    """Not after the World was fitted."""
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.json").write_text("{}")
    with pytest.raises(SystemExit):
        main(["ope", str(run), str(tmp_path / "nothing.h5"), flag, value])
    assert f"{flag[2:]}={value} must be a whole number" in capsys.readouterr().err


@pytest.mark.parametrize("seed", [-1, 2**31, 10**30, True, "0"])
def test_seeds_that_jax_does_not_take_are_refused(seed, small_store):
    with pytest.raises(UserError, match="seed=.* must be a whole number from 0 to 2,147,483,647"):
        worlds.fit(small_store, seed=seed)


def test_the_core_needs_neither_simulators_nor_pages_nor_films():
    """A robot that acts installs neither MuJoCo nor matplotlib; what needs them says how to get them."""
    script = """
import sys
for name in ("matplotlib", "PIL", "jinja2", "pettingzoo", "gymnasium", "mujoco", "flatbuffers"):
    sys.modules[name] = None
import ringfence
from ringfence.cli import app
from ringfence.envs import SafeMuJoCo
for name in set(ringfence.__all__) - {"build_report"}:
    getattr(ringfence, name)
from ringfence.report import board, export_board, table, video
for use in (lambda: ringfence.build_report, lambda: SafeMuJoCo("2x4").model()):
    try:
        use()
    except ringfence.UserError as error:
        print(error)
for words in (["ope", "a", "b"], ["replay", "a", "b"], ["bench", "results", "a"], ["fit", "a", "--report", "b.html"]):
    try:
        app.main(words)
    except SystemExit:
        pass
"""
    found = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    said = found.stdout
    assert found.stderr.count("is missing") == 1, "of the page that was asked for"
    assert "Pages, figures and films need matplotlib, which is missing; run pip install 'ringfence[report]'." in said
    assert "Robots need gymnasium, which is missing; run pip install 'ringfence[sim]'." in said
