"""The grid: cells are made once, survive whatever happens to the runner, and make one honest table."""

import csv
import dataclasses
import io
import json
import os
import queue
import shutil
import signal
import subprocess
import sys
import tarfile
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from ringfence.bench import cells as grid
from ringfence.bench import (
    collected,
    engines,
    make_grid,
    make_grids,
    pack,
    packed,
    paper,
    rows,
    run_local,
    stressed,
    suites,
    write_csv,
)
from ringfence.bench.engines import decode, encode
from ringfence.bench.stressed import Trial
from ringfence.cli.app import _runs, main
from ringfence.datasets import registry
from ringfence.errors import UserError
from ringfence.evaluation import protocol, reference
from ringfence.evaluation.evaluate import evaluate_spec
from ringfence.guards import GUARDS, GuardOptions
from ringfence.problem.constraints import Separation, to_dict
from ringfence.training import loop
from ringfence.training.runs import Run
from ringfence.utils import files
from ringfence.world import Settings

QUICK = dict(seeds=2, episodes=4, only_tasks=["simple_spread-random"], num_updates=20, transitions=500)


@pytest.fixture(scope="module", autouse=True)
def home(tmp_path_factory):
    """Data of 500 steps, in a cache of its own."""
    before = os.environ.get("RINGFENCE_HOME")
    os.environ["RINGFENCE_HOME"] = str(tmp_path_factory.mktemp("home"))
    yield
    os.environ.pop("RINGFENCE_HOME") if before is None else os.environ.__setitem__("RINGFENCE_HOME", before)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A finished grid of two algorithms and two seeds."""
    g = make_grid("simple_spread", tmp_path_factory.mktemp("grid") / "out", only=["bc", "ma-td3bc"], **QUICK)
    counts = run_local(g, workers=2, quiet=True)
    assert counts == {"done": 4, "failed": 0, "to do": 0}
    return g


def stamps(g) -> dict[Path, int]:
    return {f: f.stat().st_mtime_ns for f in g.out.glob("cells/*/*/*/*.json")}


def test_a_finished_grid_is_not_made_again(made):
    before = stamps(made)
    assert len(before) == 4 * 5  # config, env, episodes, results, status
    assert run_local(made, workers=1, quiet=True)["done"] == 4
    assert stamps(made) == before


def test_cells_are_addressed_by_what_training_depends_on(made):
    a = made.cells[0]
    assert a.id == grid.Cell(**{**a.__dict__, "evaluations": ()}).id
    for change in ({"seed": 7}, {"changes": (("num_updates", 21),)}, {"transitions": 525}):
        assert grid.Cell(**{**a.__dict__, **change}).id != a.id
    ids = [c.id for c in made.cells]
    assert len(set(ids)) == 4
    assert all(c.folder(made.out).name.endswith(c.id) for c in made.cells)


def test_ids_of_cells_do_not_follow_the_names_of_settings():
    """Those of committed results, whose settings had other names, and had none that are younger."""
    assert grid.Cell("simple_spread-expert", "madiff", "attention", 0).id == "9da3a6ef4d"
    told = grid.Cell("simple_spread-expert", "madiff", "attention", 0, changes=(("drivers", 2),))
    assert told.id != "9da3a6ef4d"
    assert grid.Cell("crossing-hasty", "bc", "default", 0).id == "c6a6824abb"
    assert grid.Cell("simple_spread-expert", "bc-return", "default", 0).id == "7e05f0949f"


def test_an_evaluation_with_other_options_is_missing_again(tmp_path, monkeypatch):
    """Results that the named planner of today would not give do not count."""
    cell = grid.Cell("simple_spread-random", "bc", "default", 0, (), (("default+shield-learned", "shield-learned"),))
    options = grid.dataclasses.asdict(GuardOptions(**{**GUARDS["shield"], "margin": 1.0}))
    result = {"episodes": 4, "protocol": protocol.PROTOCOL, "options": {}, "guard_options": options}
    Run(cell.folder(tmp_path)).add_result("default+shield-learned", result)
    assert cell.state(tmp_path, 4) == "done"
    assert cell.state(tmp_path, 5) == "to do"
    with monkeypatch.context() as patch:
        patch.setitem(GUARDS, "shield", {**GUARDS["shield"], "horizon": 5})
        assert cell.state(tmp_path, 4) == "to do"
    world = grid.dataclasses.asdict(Settings(labels="formula"))  # which follows from the data
    for change, state in (({}, "done"), ({"num_ensemble": 5}, "to do"), ({"view": "centralized"}, "to do")):
        stored = result | {"world_settings": world | change}
        Run(cell.folder(tmp_path)).add_result("default+shield-learned", stored)
        assert cell.state(tmp_path, 4) == state


def test_playing_again_does_not_change_what_training_took(made, tmp_path):
    out = shutil.copytree(made.out, tmp_path / "again")
    cell = made.cells[0]
    before = cell.status(out)
    file = cell.folder(out) / "results.json"
    results = json.loads(file.read_text())
    file.write_text(json.dumps({k: {**v, "protocol": -1} for k, v in results.items()}))  # of an older protocol
    grid.write_json(cell.folder(out) / "status.json", {**before, "train_seconds": 1234.0, "adopted": "cells/elsewhere"})
    grid.run_group([cell], out, made.episodes, lambda event, cell: None)
    after = cell.status(out)
    assert after["state"] == "done" and cell.state(out, made.episodes) == "done"
    assert after["train_seconds"] == 1234.0 and after["adopted"] == "cells/elsewhere"
    assert after["eval_seconds"] > before["eval_seconds"]


def test_looking_at_an_unfinished_cell_does_not_finish_it(tmp_path):
    cell = grid.Cell("simple_spread-expert", "bc", "default", 0, (), (("default", "default"),))
    result = {"episodes": 4, "protocol": protocol.PROTOCOL, "options": {}, "step": 7}
    Run(cell.folder(tmp_path)).add_result("default", result)
    assert cell.state(tmp_path, 4) == "to do"
    Run(cell.folder(tmp_path)).add_result("default", {**result, "step": cell.config.num_updates})
    assert cell.state(tmp_path, 4) == "done"


@pytest.mark.parametrize(("task", "state"), [("ant_4x2-poor", "to do"), ("halfcheetah_2x3-poor", "done")])
def test_a_result_that_hides_falls_is_played_again(tmp_path, task, state):
    cell = grid.Cell(task, "bc", "mujoco", 0, (), (("mujoco", "default"),))
    result = {"episodes": 4, "protocol": protocol.PROTOCOL, "options": {}}
    Run(cell.folder(tmp_path)).add_result("mujoco", result)
    assert cell.state(tmp_path, 4) == state
    Run(cell.folder(tmp_path)).add_result("mujoco", {**result, "termination_rate": 0.0})
    assert cell.state(tmp_path, 4) == "done"


@pytest.mark.parametrize("suite", ["simple_spread", "guards", "guards-mujoco", "crossing-guards", "own-sight"])
def test_committed_results_need_not_be_made_again(tmp_path, suite):
    """What a cell of the repository holds is what its suite asks for today."""
    out = tmp_path / suite
    results = Path(__file__).parents[1] / "results" / suite
    shutil.copytree(results, out, ignore=shutil.ignore_patterns("cells", "reference", "compiled"))
    packed.unpack(out)
    made = make_grid(suite, out)
    held = {c: set(Run(c.folder(out)).results) for c in made.cells}
    assert sum(map(len, held.values())) > 5
    stale = [(c.task, c.algorithm, v) for c in made.cells for v, _ in c.missing(out, made.episodes) if v in held[c]]
    assert not stale


def test_every_suite_names_algorithms_and_presets_that_exist():
    for name, suite in suites.SUITES.items():
        g = make_grid(name, "nowhere", seeds=1)
        assert {c.task for c in g.cells} == set(suite.tasks)
        assert len({c.id for c in g.cells}) == len(g.cells)


def test_entries_are_chosen_by_algorithm_or_preset(tmp_path):
    def presets(task, only):
        g = make_grid("mujoco", tmp_path, seeds=1, only_tasks=[task], only=only)
        return [(c.algorithm, c.preset) for c in g.cells]

    assert presets("ant_2x4-good", ["icbf"]) == [("icbf", "algorithm1-mujoco"), ("icbf", "mujoco")]
    assert presets("ant_2x4-good", ["icbf:mujoco", "bc"]) == [("bc", "mujoco"), ("icbf", "mujoco")]
    assert presets("ant_2x4-good-quantile", ["icbf", "bc"]) == [
        ("bc", "mujoco"),
        ("icbf", "algorithm1-mujoco"),
        ("icbf", "mujoco"),
    ]


def test_the_papers_grids_are_refused_or_made_as_a_whole(tmp_path, capsys):
    few = dict(seeds=1, episodes=4)
    both = paper.grids(tmp_path, **few)
    assert [g.suite for g in both] == ["simple_spread", "mujoco"]
    assert {c.algorithm for g in both for c in g.cells} == set(paper.METHODS)
    for name, suite in (("icbf:default", "simple_spread"), ("icbf:mujoco", "mujoco")):
        (only,) = paper.grids(tmp_path, only=[name], **few)
        assert only.suite == suite
    with pytest.raises(UserError, match="did you mean 'icbf'"):
        paper.grids(tmp_path, only=["icfb"], **few)
    both[1].open()
    with pytest.raises(SystemExit):
        main(["bench", "paper", "--out", str(tmp_path), "--seeds", "1", "--episodes", "5"])
    assert "has episodes=4, this grid 5" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "simple_spread").exists(), "the second part was looked at before the first was begun"


def test_a_reference_whose_worker_dies_is_reported(made, caplog):
    pool = engines._Pool(made, queue.Queue(), None, 1, 2.0, -1)
    dead, job = SimpleNamespace(pid=1, returncode=-9), {"reference": "simple_spread-random"}
    pool._died(dead, None, [], job)
    assert pool.jobs.get_nowait() == job and not caplog.text, "tried again"
    pool._died(dead, None, [], job)
    pool.too_big.add(2)
    pool._died(SimpleNamespace(pid=2, returncode=-9), None, [], {"reference": "other"})
    said = caplog.text
    assert pool.jobs.empty()
    assert "simple_spread-random could not be made: its worker died 2 times (exit status -9)" in said
    assert "other could not be made: its worker grew beyond 2 GiB" in said


def test_a_folder_that_was_moved_aside_is_found(made, tmp_path):
    """As a kill between the two renames of a returned run leaves it."""
    cell = dataclasses.replace(made.cells[0])
    folder = cell.folder(tmp_path)
    shutil.copytree(cell.folder(made.out), folder)
    kept = engines.begun(cell, tmp_path)
    folder.replace(folder.with_name(f".{folder.name}.old"))
    assert len(engines.begun(cell, tmp_path)) == len(kept) and folder.exists()
    shutil.copytree(folder, folder.with_name(f".{folder.name}.part"))
    assert [r.path for r in _runs([tmp_path])] == [folder]


def test_table(made):
    found = rows(made.out)
    ours = [r for r in found if r["variant"] != "reference"]
    assert len(ours) == 4 and all((made.out / r["run"] / "config.json").exists() for r in ours)
    lines = write_csv(made.out).read_text().splitlines()
    assert len(lines) == 1 + len(found)


def test_a_grid_is_played_behind_faults(made, tmp_path, capsys):
    """Like every evaluation: once, resumed, in a table of its own; a certificate says where it is kept."""
    out = shutil.copytree(made.out, tmp_path / "stressed")
    grid.write_json(out / "bench.json", grid.about("stress", made.episodes))
    trials = (Trial("default", "delay1"), Trial("default", "drop0.3+noise0.02"))
    cell = dataclasses.replace(made.cells[0], trials=trials)
    assert decode(json.loads(json.dumps(encode(cell)))) == cell and cell.id == made.cells[0].id
    assert cell.state(out, made.episodes) == "to do" and cell.missing_trials(out, made.episodes) == [*trials]
    grid.run_group([cell], out, made.episodes, lambda event, cell: None)
    assert cell.state(out, made.episodes) == "done" and cell.state(out, made.episodes + 1) == "to do"
    file = cell.folder(out) / "stress.json"
    before = file.read_bytes()
    grid.run_group([cell], out, made.episodes, lambda event, cell: None)
    assert file.read_bytes() == before
    main(["bench", "results", str(out)])
    assert "stress.csv" in capsys.readouterr().out
    table = list(csv.DictReader((out / "stress.csv").open()))
    assert [(r["faults"], r["compensated"], r["guard"]) for r in table] == [
        ("delay1", "False", "none"),
        ("drop0.3+noise0.02", "False", "none"),
    ]
    assert stressed.write_csv(made.out) is None, "of another suite"
    promise = SimpleNamespace(policy="p", world="w", agents=3, barrier="learned", guard={"margin": 1.0}, bound=0.02)
    promise.faults = {"delay": 1}
    played = {"digests": {"policy": "p", "world": "w"}, "agents": 3, "barrier": "learned", "violation_rate": 0.01}
    played |= {"guard_options": {"margin": 1.0}, "faults": {"delay": 1}}
    assert stressed.covers(promise, played) == "promised"
    assert stressed.covers(promise, {**played, "faults": {"delay": 2}}) == "kept"
    assert stressed.covers(promise, {**played, "faults": {"delay": 3}, "violation_rate": 0.03}) == "broken"
    for other in ({"agents": 4}, {"guard_options": {"margin": 1.5}}, {"digests": {}}):
        assert stressed.covers(promise, {**played, **other}) == ""
    with pytest.raises(UserError, match="is of no guard that was played"):
        stressed.rows(out, promise)
    with pytest.raises(SystemExit):
        main(["bench", "crossing", "--certificate", "cert.json"])
    assert "read by the suite stress alone" in " ".join(capsys.readouterr().err.split())


def test_mixed_protocols_are_refused(made, tmp_path):
    file = made.cells[0].folder(made.out) / "results.json"
    kept = file.read_text()
    results = json.loads(kept)
    results["default"]["episodes"] = 5
    file.write_text(json.dumps(results))
    try:
        with pytest.raises(UserError, match="episodes 5"):
            rows(made.out)
        file.write_text(kept.replace('"algorithm": "bc"', '"algorithm": "omar"'))
        with pytest.raises(UserError, match="of algorithm 'omar'"):
            rows(made.out)
    finally:
        file.write_text(kept)
    with pytest.raises(UserError, match="episodes"):
        make_grid("simple_spread", made.out, **{**QUICK, "episodes": 6}).open()


def test_one_cell_under_two_settings_is_no_table(made):
    """As when a default changed, or a trial with fewer updates was left behind."""
    folder = made.cells[0].folder(made.out)
    other = folder.with_name("seed-0-0123456789")
    shutil.copytree(folder, other)
    try:
        with pytest.raises(UserError, match="are both simple_spread-random bc default seed 0, with other settings"):
            rows(made.out)
    finally:
        shutil.rmtree(other)


def test_reference_rows_follow_the_size_of_the_data(made, tmp_path):
    task, place = registry.get("simple_spread-random"), made.out / "reference"
    n = made.episodes
    assert reference.there(task, place, n, 500)
    assert not reference.there(task, place, n, 600) and not reference.there(task, place, n)
    assert not reference.there(task, place, n + 1, 500)
    assert not reference.there(dataclasses.replace(task, hazard=Separation(0.4)), place, n, 500)
    assert not reference.there(registry.get("simple_spread-expert"), place, n, 500)
    # a card that tells no size asked for: whole episodes, a little more
    file = tmp_path / task.name / "reference.json"
    file.parent.mkdir()
    card = {"transitions": 1_000_988, "hazard": to_dict(task.hazard)}
    file.write_text(json.dumps({"behaviour data": {"data": card}, "do-nothing": {"episodes": n}}))
    assert reference.there(task, tmp_path, n) and not reference.there(task, tmp_path, n, 900_000)


def test_references_that_cannot_be_made_stop_nobody(tmp_path, caplog):
    g = make_grid("simple_spread", tmp_path / "out", only=["bc"], **{**QUICK, "seeds": 1})
    g.open()
    (g.out / "reference" / "simple_spread-random").mkdir(parents=True)
    # The rows of another size, in which one lacks what it is compared by.
    damaged = {"behaviour data": {}, "do-nothing": {"episodes": 4}, "data within the limit": {}}
    (g.out / "reference" / "simple_spread-random" / "reference.json").write_text(json.dumps(damaged))
    assert run_local(g, workers=1, quiet=True)["done"] == 1
    assert "reference rows of simple_spread-random could not be made: KeyError" in caplog.text


def test_bad_names_and_folders_are_refused(made, tmp_path):
    with pytest.raises(UserError, match="did you mean 'simple_spread'"):
        make_grid("simple_sprad", tmp_path)
    with pytest.raises(UserError, match="did you mean 'omar'"):
        make_grid("simple_spread", tmp_path, only=["omarr"])
    with pytest.raises(UserError, match="task"):
        make_grid("simple_spread", tmp_path, only_tasks=["simple_spread-exprt"])
    with pytest.raises(UserError, match="no results folder"):
        rows(tmp_path)
    (tmp_path / "bench.json").write_text(json.dumps({**grid.about("simple_spread", 4), "format": 0}))
    with pytest.raises(UserError, match="format 0"):
        rows(tmp_path)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thing").write_text("mine")
    with pytest.raises(UserError, match="something else"):
        make_grid("simple_spread", tmp_path / "other", **QUICK).open()


def test_a_failing_cell_is_recorded_and_stops_nobody(tmp_path, monkeypatch):
    g = make_grid("simple_spread", tmp_path / "out", only=["bc"], **QUICK)
    g.open()
    broken = g.cells[0].folder(g.out)

    def fails(spec, **options):
        if spec.run.path == broken:
            raise RuntimeError("the moon is in the way")
        return evaluate_spec(spec, **options)

    monkeypatch.setattr(grid, "evaluate_spec", fails)
    heard = []
    grid.run_group(list(g.cells), g.out, g.episodes, lambda event, cell: heard.append((event, cell.seed)))
    assert heard == [("start", 0), ("failed", 0), ("start", 1), ("done", 1)]
    assert g.count() == {"done": 1, "failed": 1, "to do": 0}
    status = g.cells[0].status(g.out)
    assert "moon" in status["error"] and "Traceback" in status["traceback"]
    monkeypatch.undo()
    grid.run_group(g.groups()[0], g.out, g.episodes, lambda *_: None)
    assert g.count()["done"] == 2 and g.cells[0].status(g.out)["attempts"] == 2


def test_a_worker_that_outgrows_its_memory_is_stopped_and_said_so(tmp_path):
    g = make_grid("simple_spread", tmp_path / "out", only=["bc"], **{**QUICK, "seeds": 1})
    (tmp_path / "out" / "reference" / "simple_spread-random").mkdir(parents=True)
    grid.write_json(g.out / "bench.json", grid.about(g.suite, g.episodes))
    card = {"size": 500, "hazard": to_dict(registry.get("simple_spread-random").hazard)}
    known = {"behaviour data": {"data": card}, "do-nothing": {"episodes": g.episodes}}
    (tmp_path / "out" / "reference" / "simple_spread-random" / "reference.json").write_text(json.dumps(known))
    assert run_local(g, workers=1, memory=0.05, quiet=True) == {"done": 0, "failed": 1, "to do": 0}
    assert "grew beyond 0.05 GiB" in g.cells[0].status(g.out)["error"]


def test_a_file_system_without_locks_trains_all_the_same(tmp_path, monkeypatch):
    import fcntl

    def none(*_):
        raise OSError(38, "Function not implemented")

    monkeypatch.setattr(fcntl, "flock", none)
    with files.owned(tmp_path, "not said"):
        pass


def test_a_killed_runner_loses_no_finished_cell(tmp_path):
    """Killed without warning after its first cell; the next runner keeps that cell and finishes the others."""
    g = make_grid("simple_spread", tmp_path / "out", only=["bc"], **QUICK)
    code = (
        "from ringfence.bench import make_grid, run_local\n"
        f"run_local(make_grid('simple_spread', {str(g.out)!r}, only=['bc'], **{QUICK!r}), workers=1, quiet=True)"
    )
    runner = subprocess.Popen([sys.executable, "-c", code], start_new_session=True)
    first = g.cells[0]
    until = time.monotonic() + 120
    while first.status(g.out).get("state") != "done" and time.monotonic() < until:
        time.sleep(0.05)
    os.kill(runner.pid, signal.SIGKILL)  # the worker is left to notice by itself
    runner.wait()
    assert first.state(g.out, g.episodes) == "done"
    before = (first.folder(g.out) / "results.json").stat().st_mtime_ns
    assert run_local(g, workers=1, quiet=True) == {"done": 2, "failed": 0, "to do": 0}
    assert (first.folder(g.out) / "results.json").stat().st_mtime_ns == before
    assert first.status(g.out)["attempts"] == 1


def test_workers_keep_to_cores_of_their_own_only_where_they_fill_the_machine():
    assert engines.slots_of([0, 1, 2, 3], 2, 2) == [[0, 1], [2, 3]]
    assert engines.slots_of([0, 1], 3, 1) == [[0], [1], []]
    assert engines.slots_of([0, 1], 1, 1) == [[]], "another grid beside it would keep to the same core"


def test_one_runner_per_folder(tmp_path):
    g = make_grid("simple_spread", tmp_path / "out", only=["bc"], **QUICK)
    g.open()
    with files.owned(g.out, "not said"):
        code = (
            f"import pathlib, ringfence.utils.files as x\nwith x.owned(pathlib.Path({str(g.out)!r}), {g.taken!r}): pass"
        )
        second = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "Another runner works on" in second.stderr
    with files.owned(g.out, "not said"):
        pass


def test_one_training_per_run_folder(small_store, tmp_path):
    settings = dict(out=tmp_path, changes={"num_updates": 2, "batch": 4, "width": 8, "depth": 1}, quiet=True)
    folder = tmp_path / "simple_spread-random" / "bc" / "seed-0"
    with files.owned(folder, "not said"):
        with pytest.raises(UserError, match="Another process trains '.*seed-0'; wait for it or stop it"):
            loop.train("bc", small_store, preset="default", **settings)
    assert not (folder / "metrics.jsonl").exists()


def test_what_a_grid_cannot_be_is_refused(tmp_path):
    with pytest.raises(UserError, match="plays icbf:long on none of simple_spread-random; choose other"):
        make_grid("simple_spread", tmp_path, only=["icbf:long"], only_tasks=["simple_spread-random"])
    g = make_grid("simple_spread", tmp_path / "out", only=["bc"], **QUICK)
    for wrong in ({"threads": 0}, {"workers": 0}, {"memory": 0.0}, {"memory": -1.0}):
        with pytest.raises(UserError, match="must be"):
            run_local(g, quiet=True, **wrong)
    (tmp_path / "file").write_text("mine")
    for place in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(UserError, match="is a file|Not a directory"):
            make_grid("simple_spread", place, only=["bc"], **QUICK).open()
    with pytest.raises(UserError, match="could not be locked"), files.owned(tmp_path / "file", "not said"):
        pass


def test_a_cell_that_failed_before_it_began_is_reported(tmp_path):
    g = make_grid("simple_spread", tmp_path / "out", only=["bc"], **{**QUICK, "seeds": 1})
    g.open()
    grid.record_failure(g.cells[0], g.out, "RuntimeError: no data")
    assert [(s["state"], s["error"]) for s in grid.statuses(g.out)] == [("failed", "RuntimeError: no data")]


def test_an_unreachable_cluster_is_refused(tmp_path):
    pytest.importorskip("ray", reason="ray is an extra")
    from ringfence.bench.engines import connect

    with pytest.raises(UserError, match="No Ray cluster answers at address '127.0.0.1:1'"):
        connect("127.0.0.1:1")


def test_ray_makes_the_same_cells_and_survives_a_killed_worker(made, tmp_path):
    """Two nodes on this machine; the process that works on the first cell is killed, and Ray makes the cell again."""
    ray = pytest.importorskip("ray", reason="ray is an extra")
    from ray.cluster_utils import Cluster

    from ringfence.bench import engines as engine

    g = make_grid("simple_spread", tmp_path / "out", only=["bc"], **QUICK)
    # What the driver would make itself is given, so that the tasks begin at once.
    (g.out / "reference" / "simple_spread-random").mkdir(parents=True)
    grid.write_json(g.out / "bench.json", grid.about(g.suite, g.episodes))
    known = made.out / "reference" / "simple_spread-random" / "reference.json"
    (g.out / "reference" / "simple_spread-random" / "reference.json").write_text(known.read_text())
    killed = tmp_path / "killed"
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        cluster.add_node(num_cpus=1)
        ray.init(address=cluster.address, log_to_driver=False, logging_level="ERROR")
        assert len(ray.nodes()) == 2
        real = engine.packed

        def packed(cell, episodes, begun):
            """The first task kills its own process once, half-way."""
            if not killed.exists():
                killed.write_text("")
                os.kill(os.getpid(), signal.SIGKILL)
            return real(cell, episodes, begun)

        engine.packed = packed
        try:
            counts = engine.run_ray(g, quiet=True)
        finally:
            engine.packed = real
    finally:
        ray.shutdown()
        cluster.shutdown()
    assert killed.exists() and counts == {"done": 2, "failed": 0, "to do": 0}
    for a, b in zip(g.cells, [c for c in made.cells if c.algorithm == "bc"]):
        mine, other = a.folder(g.out), b.folder(made.out)
        assert mine.name == other.name
        same = [json.loads((f / "results.json").read_text())["default"]["per_episode"] for f in (mine, other)]
        assert same[0] == same[1]


def test_what_reads_no_danger_is_trained_once(tmp_path, monkeypatch):
    names = ["halfcheetah_2x3-medium", "halfcheetah_2x3-medium-quantile"]
    few = dict(seeds=1, episodes=1, only_tasks=names, only=["bc"], num_updates=20, transitions=1000)
    g = make_grid("mujoco", tmp_path / "out", **few)
    native, other = g.cells
    assert other.paired() == native and native.paired() is None
    assert grid.Cell(names[1], "bc-safe", "mujoco", 0).paired() is None
    g.open()
    grid.run_group([native], g.out, 1, lambda event, cell: None)
    with monkeypatch.context() as m:
        m.setattr(loop, "_loop", lambda *_: pytest.fail("it was trained again"))
        grid.run_group([other], g.out, 1, lambda event, cell: None)
    assert other.status(g.out)["adopted"] == str(native.folder(g.out).relative_to(g.out))
    weights = {c.task: Run(c.folder(g.out)).checkpoints()[-1][1].read_bytes() for c in g.cells}
    assert weights[names[0]] == weights[names[1]]
    found = {r["task"]: r for r in rows(g.out)}
    assert len(found) == 2 and found[names[0]]["return_mean"] == found[names[1]]["return_mean"]
    grid.make_reference(names[0], g.out, 1, 1000)
    configs = [Run(c.folder(g.out)).config for c in g.cells]
    assert [t["task"] for t in configs] == names and configs[0]["hazard"]["limit"] > configs[1]["hazard"]["limit"]
    shutil.rmtree(other.folder(g.out))
    card = grid.data_of(other.task, 1000).card.to_dict()
    assert grid.adopt(other, g.out, card | {"simulator": "another"}) is None  # what other steps taught
    config = native.folder(g.out) / "config.json"
    now = config.read_text()
    config.write_text(json.dumps(json.loads(now) | {"revision": 0}))
    assert grid.adopt(other, g.out, card) is None  # or an older algorithm
    config.write_text(now)
    shutil.rmtree(native.folder(g.out) / "ckpt")  # results alone, as a copied folder has them, teach nobody
    assert grid.adopt(other, g.out, card) is None


def test_a_stale_cell_is_named_and_stops_no_other(tmp_path):
    g = make_grid("simple_spread", tmp_path / "out", seeds=2, episodes=2, only_tasks=["simple_spread-random"],
                  only=["bc"], num_updates=20, transitions=1000)  # fmt: skip
    g.open()
    stale = g.cells[1].folder(g.out)
    grid.run_group([g.cells[1]], g.out, 2, lambda event, cell: None)
    config = json.loads((stale / "config.json").read_text())
    (stale / "config.json").write_text(json.dumps(config | {"revision": 0}))
    (stale / "results.json").unlink()
    grid.run_group(list(g.cells), g.out, 2, lambda event, cell: None)
    assert [c.status(g.out)["state"] for c in g.cells] == ["done", "failed"]
    assert "its revision differs" in g.cells[1].status(g.out)["error"]
    # a card that has come to tell more is of the same data
    (stale / "config.json").write_text(json.dumps(config | {"data": config["data"] | {"more": 1}}))
    grid.run_group([g.cells[1]], g.out, 2, lambda event, cell: None)
    assert g.cells[1].status(g.out)["state"] == "done"


def test_reference_rows_tell_the_data_from_its_safe_part(small_store, tmp_path):
    task = registry.get("simple_spread-random")
    found = reference.make(task, small_store, tmp_path, 2)
    safe = small_store.episode_costs <= task.cost_limit
    assert 0 < safe.sum() < small_store.episodes
    assert found["behaviour data"]["return_mean"] == pytest.approx(small_store.returns.mean())
    part = found["data within the limit"]
    assert part["episodes"] == safe.sum() and part["cost_mean"] <= task.cost_limit
    assert part["return_mean"] == pytest.approx(small_store.returns[safe].mean())
    assert reference.make(task, small_store, tmp_path, 2) == json.loads(json.dumps(found))  # as it was kept
    # an episode that ends early is no safe one, however little it costs
    cut = dataclasses.replace(small_store, terminated=small_store.terminated.copy())
    cut.terminated[cut.episode_ends[np.flatnonzero(safe)[0]] - 1] = True
    found = reference.make(task, cut, tmp_path / "cut", 2)
    assert found["data within the limit"]["episodes"] == safe.sum() - 1
    assert found["behaviour data"]["termination_rate"] == pytest.approx(1 / cut.episodes)
    # a limit that no logged episode keeps: the row is missing, not empty
    none = dataclasses.replace(task, cost_limit=-1.0)
    assert list(reference.make(none, small_store, tmp_path, 2)) == ["behaviour data", "do-nothing", "random actions"]


def test_the_table_of_the_paper_keeps_others_data_apart(made, tmp_path):
    with pytest.raises(UserError, match="Neither .*nothing' is a results folder"):
        paper.lines([tmp_path / "nothing"])
    table = paper.lines([made.out, tmp_path / "nothing"])
    assert len(table) == 13 * 3
    ours = [x for x in table if x.ours]
    assert [(x.task, x.method, x.seeds) for x in ours] == [("simple_spread-random", "MA-TD3+BC", 2)]
    assert ours[0].printed == (0.23, 0.01, 0.00, 0.00)
    measured = [r["return_norm"] for r in rows(made.out) if r["algorithm"] == "ma-td3bc"]
    assert ours[0].ours[0] == pytest.approx(sum(measured) / 2)
    text = paper.markdown(table).splitlines()
    assert len(text) == 2 + 13 and "[2]" in next(line for line in text if "spread-random" in line)
    lines = paper.write(table, tmp_path / "paper.csv").read_text().splitlines()
    assert len(lines) == 1 + 13 * 3


def test_a_packed_folder_says_what_the_loose_one_said(made, tmp_path):
    """Two archives stand for all files of the cells but checkpoints; the same contents give the same bytes."""
    out = shutil.copytree(made.out, tmp_path / "there")
    before, archives = rows(out), pack(out)
    assert [a.name for a in archives] == list(packed.ARCHIVES)
    first = [a.read_bytes() for a in archives]
    assert [a.read_bytes() for a in pack(out)] == first
    bare = tmp_path / "bare"
    bare.mkdir()
    for name in ("bench.json", *packed.ARCHIVES):
        shutil.copyfile(out / name, bare / name)
    assert rows(bare) == before
    there = dataclasses.replace(made, out=bare)
    assert there.count() == {"done": 4, "failed": 0, "to do": 0} and not there.references()
    assert Run(made.cells[0].folder(bare)).metrics == Run(made.cells[0].folder(out)).metrics


def test_unpacking_overwrites_nothing_and_brings_back_nothing(made, tmp_path):
    out = shutil.copytree(made.out, tmp_path / "there")
    pack(out)
    kept, gone = (c.folder(out) for c in made.cells[:2])
    Run(kept).add_result("mine", {"episodes": 1})
    shutil.rmtree(gone)
    packed.unpack(out)
    assert "mine" in Run(kept).results and not gone.exists()
    shutil.rmtree(out / "cells")  # all loose files: what is packed comes back
    packed.unpack(out)
    assert "mine" not in Run(kept).results and (gone / "results.json").exists()
    Run(kept).add_result("mine", {"episodes": 1})
    (out / packed.MARK).unlink()  # as if other archives had come: theirs and ours
    packed.unpack(out)
    assert {"mine", "default"} <= set(Run(kept).results)


def test_a_collection_is_its_suites(tmp_path):
    grids = make_grids(collected("attribution"), tmp_path, seeds=1)
    assert [g.out.name for g in grids] == list(suites.COLLECTIONS["attribution"])
    (one,) = make_grids(collected("attribution", ["simple_spread-expert"]), tmp_path, ["icbf:shaped"], seeds=2)
    assert [(c.task, c.preset, c.seed) for c in one.cells] == [("simple_spread-expert", "shaped", s) for s in (0, 1)]
    with pytest.raises(UserError, match="did you mean 'ant_2x4-good'"):
        collected("attribution", ["ant_2x4-goodd"])


@pytest.mark.parametrize("name", ["../../outside/results.json", "cells/a/b/c/evil.sh", "/cells/a/b/c/results.json"])
def test_an_archive_writes_cells_and_nothing_else(made, tmp_path, name):
    out = shutil.copytree(made.out, tmp_path / "there")
    with tarfile.open(out / "runs.tar.xz", "w:xz") as tar:
        member = tarfile.TarInfo(name)
        member.size = 2
        tar.addfile(member, io.BytesIO(b"{}"))
    with pytest.raises(UserError, match="which is no file of a cell"):
        rows(out)
    (out / "runs.tar.xz").write_bytes(b"no archive")
    with pytest.raises(UserError, match="truncated, damaged"):
        rows(out)
