"""Policies as files: what the file does is what the controller does, whoever plays it."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import jax
import msgspec
import numpy as np
import pytest

from ringfence.cli.app import main
from ringfence.deploy import export as exporting
from ringfence.deploy.controller import Controller
from ringfence.deploy.export import Entry, Step
from ringfence.errors import NoSafeAction, UserError
from ringfence.loading.resolve import load
from ringfence.logs.store import EpisodeStore
from ringfence.proposals.base import Constant
from ringfence.training import loop, worlds
from ringfence.world.stops import SPEED, Stop
from tests.quick import QUICK_WORLD

SHIELD = dict(guard="shield", horizon=1, correction_steps=3, margin=4.0)
FULL = dict(guard="full", horizon=1, correction_steps=1, optimizer_steps=2, num_restarts=3, num_samples=1)
STEPS = 12


@pytest.fixture(scope="module")
def run(small_store, tmp_path_factory):
    """Cloning of the small store."""
    out = tmp_path_factory.mktemp("runs")
    return loop.train("bc", small_store, changes={"num_updates": 4, "width": 16}, quiet=True, out=out)[0]


@pytest.fixture(scope="module")
def planner(small_store, tmp_path_factory):
    """A diffusion planner of the small store."""
    changes = dict(num_updates=2, batch=8, width=16, depth=1, diffusion_steps=10)
    out = tmp_path_factory.mktemp("runs")
    return loop.train("madiff", small_store, changes=changes, world=QUICK_WORLD, quiet=True, out=out)[0]


def played(run, store, noisy: bool = False, **options) -> list[tuple[dict, dict]]:
    """What a controller is given along some steps of the logs, with the noise that it draws, and what it tells."""
    controller = Controller(run, **options)
    draw = exporting.step_of(controller.job, controller.policy).draw if noisy else lambda key: []
    key, steps = jax.random.key(0), []
    for t in range(STEPS):
        seen, state, cost = store.observations[t], store.state[t], (None, 0.0, 1.0)[t % 3]
        action = controller.act(seen, state, cost)
        key, now = jax.random.split(key)
        given = {"observations": seen, "state": state, "cost": np.array(np.nan if cost is None else cost, np.float32)}
        given |= {f"noise.{k}": np.asarray(x) for k, x in enumerate(draw(now))}
        told = {f"info.{k}": v for k, v in controller.info.items() if np.ndim(v) == 0}
        steps.append((given, {"action": action} | told))
    return steps


def apart(call, told: dict, steps: list[tuple[dict, dict]]) -> float:
    """The largest difference between what a file gives, with a memory of its own, and what the controller did; `call`
    takes arrays by name and gives arrays by name."""
    inputs = {x["name"]: x for x in told["inputs"]}
    memory = {k: np.full(inputs[k]["shape"], v, inputs[k]["dtype"]) for k, v in told["initial"].items()}
    largest = 0.0
    for given, expected in steps:
        out = call({name: (given | memory)[name] for name in inputs})
        assert [*out] == [x["name"] for x in told["outputs"]]
        memory = {f"memory.{k[5:]}": np.asarray(v) for k, v in out.items() if k.startswith("next.")}
        for name, value in expected.items():
            ours, value = np.asarray(out[name]), np.asarray(value)
            assert ours.shape == value.shape and ours.dtype == value.dtype
            largest = max(largest, np.abs(ours.astype(float) - value.astype(float)).max())
    return float(largest)


def of_stablehlo(file: Path):
    """(call, told) of a StableHLO file, read by JAX alone."""
    with zipfile.ZipFile(file) as packed:
        told, program = (
            json.loads(packed.read("metadata.json")),
            jax.export.deserialize(bytearray(packed.read("policy.jax"))),
        )
        assert packed.read("policy.mlirbc") == program.mlir_module_serialized
    assert program.nr_devices == 1 and not program.uses_global_constants
    names = [x["name"] for x in told["outputs"]]
    call = jax.jit(program.call)
    return lambda given: dict(zip(names, call(*given.values()))), told


def of_onnx(file: Path):
    """(call, told) of an ONNX file, read by onnxruntime alone."""
    onnxruntime = pytest.importorskip("onnxruntime")
    session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
    told = json.loads(session.get_modelmeta().custom_metadata_map["ringfence"])
    assert [x.name for x in session.get_inputs()] == [x["name"] for x in told["inputs"]]
    assert [tuple(x.shape) for x in session.get_inputs()] == [tuple(x["shape"]) for x in told["inputs"]]
    names = [x.name for x in session.get_outputs()]
    return lambda given: dict(zip(names, session.run(names, given))), told


def test_cloning(run, small_store, tmp_path):
    steps = played(run, small_store)
    file = exporting.export(run, tmp_path / "a.stablehlo", "stablehlo")
    call, told = of_stablehlo(file)
    assert [x["name"] for x in told["inputs"]] == ["observations"] and apart(call, told, steps) <= 1e-6
    assert told["task"] == "simple_spread-random" and told["action_low"] == -1 and len(told["names"]["state"]) == 18
    assert exporting.export(run, tmp_path / "again", "stablehlo").read_bytes() == file.read_bytes()
    with zipfile.ZipFile(file) as packed:
        assert not any(b".py" in packed.read(name) for name in packed.namelist())  # nobody's paths
    pytest.importorskip("jax2onnx")
    assert apart(*of_onnx(exporting.export(run, tmp_path / "a.onnx")), steps) <= 1e-5


def test_a_shield(run, small_store, small_world, tmp_path, capsys):
    """Its rounds of correction are a loop that ends when nothing is missing, around one along the predicted rows. The
    file remembers what it did last, and knows where speeds end."""
    pytest.importorskip("jax2onnx")
    from ringfence import world as worlds_files

    ends = (Stop("own.vx", -0.3, 0.2), Stop(SPEED, None, 0.4))
    card = msgspec.structs.replace(small_world.card, data=msgspec.structs.replace(small_world.card.data, stops=ends))
    acts = dataclasses.replace(small_world.dynamics, stops=ends)
    small_world = dataclasses.replace(small_world, dynamics=acts, card=card)
    kept = worlds_files.save(small_world, tmp_path / "w.safetensors")
    words = [
        "--guard",
        "shield",
        "--horizon",
        "2",
        "--margin",
        "4",
        "--set",
        "correction_steps=3",
        "--world",
        str(kept),
    ]
    main(["export", str(run.path), "--out", str(tmp_path / "s.onnx"), *words])
    assert capsys.readouterr().out.strip().endswith("s.onnx")
    call, told = of_onnx(tmp_path / "s.onnx")
    assert [x["name"] for x in told["inputs"]] == ["observations", "state", "memory.action"]
    assert told["initial"] == {"memory.action": 0.0}
    assert told["variant"].startswith("default+shield-learned") and told["guard_options"]["margin"] == 4.0
    steps = played(run, small_store, world=small_world, **SHIELD | {"horizon": 2})
    assert apart(call, told, steps) <= 2e-5  # corrections add up what rounding does (docs/export.md)
    assert any(expected["info.infeasible"] for _, expected in steps), "there was something to correct"


def test_memory_costs_and_noise(run, small_store, small_world, tmp_path):
    """Refining loops over Adam's steps, the margin follows costs, the last plan is moved on."""
    options = {**FULL, "world": small_world}
    steps = played(run, small_store, noisy=True, **options)
    call, told = of_stablehlo(exporting.export(run, tmp_path / "full", "stablehlo", **options))
    names = [x["name"] for x in told["inputs"]]
    assert names == [
        "observations",
        "state",
        "cost",
        "noise.0",
        "memory.age",
        "memory.last",
        "memory.margin",
        "memory.action",
    ]
    assert apart(call, told, steps) <= 1e-5
    assert told["initial"]["memory.margin"] == 1.0


@pytest.mark.parametrize("format", exporting.FORMATS)
def test_what_is_not_finite_is_said_and_not_acted_upon(format, run, small_store, small_world, tmp_path):
    """A controller refuses; a file gives the same last action, is as it was, and acts again when it sees."""
    if format == "onnx":
        pytest.importorskip("jax2onnx")
    options = {**SHIELD, "adapt": 0.1, "world": small_world}
    file = exporting.export(run, tmp_path / f"g.{format}", format, **options)
    call, told = (of_onnx if format == "onnx" else of_stablehlo)(file)
    controller = Controller(run, **options)
    shapes = {x["name"]: x["shape"] for x in told["inputs"]}
    start = {k: np.broadcast_to(np.asarray(v, np.float32), shapes[k]) for k, v in told["initial"].items()}

    def at(t, memory):
        given = {"observations": small_store.observations[t], "state": small_store.state[t], "cost": np.float32(np.nan)}
        types = {x["name"]: x["dtype"] for x in told["inputs"]}
        return {k: np.array((given | memory)[k], types[k]) for k in shapes}

    def remembered(out):
        return {f"memory.{k[5:]}": np.asarray(v) for k, v in out.items() if k.startswith("next.")}

    for name in ("observations", "state"):
        for bad in (np.nan, np.inf):
            for place in (0, -1, slice(None)):
                first = at(0, start)
                first[name].flat[place] = bad
                out = call(first)
                assert (np.asarray(out["action"]) == 0).all() and out["info.infeasible"] and out["info.ood"]
                assert np.isnan(out["info.clearance"]) and np.isnan(out["info.next_clearance"])
    memory = remembered(call(at(0, start)))
    action = controller.act(small_store.observations[0], small_store.state[0])
    blind = at(1, memory)
    blind["observations"][1, 0] = np.nan
    with pytest.raises(NoSafeAction) as refused:
        controller.act(blind["observations"], blind["state"])
    out = call(blind)
    np.testing.assert_array_equal(refused.value.last_action, action)
    np.testing.assert_allclose(out["action"], action, atol=2e-5)
    for key, value in remembered(out).items():
        np.testing.assert_array_equal(value, memory[key])
    out = call(at(2, remembered(out)))
    np.testing.assert_allclose(
        out["action"], controller.act(small_store.observations[2], small_store.state[2]), atol=2e-5
    )
    assert out["info.infeasible"] == controller.info["infeasible"] and out["info.ood"] == controller.info["ood"]
    alone, _ = (of_onnx if format == "onnx" else of_stablehlo)(exporting.export(run, tmp_path / f"a.{format}", format))
    assert np.isnan(alone({"observations": blind["observations"]})["action"]).all(), "nobody acts upon half of a team"


def test_plans_are_drawn_from_the_noise_that_is_given(planner, small_store, tmp_path):
    options = {"sampling_steps": 2, "sampler": "ddpm"}
    steps = played(planner, small_store, noisy=True, **options)
    call, told = of_stablehlo(exporting.export(planner, tmp_path / "p", "stablehlo", **options))
    assert (
        sum(x["name"].startswith("noise.") for x in told["inputs"]) == 4
    )  # the driver's, the first of the plan, and one for every step
    assert apart(call, told, steps) <= 1e-5
    pytest.importorskip("jax2onnx")
    assert apart(*of_onnx(exporting.export(planner, tmp_path / "p.onnx", **options)), steps) <= 1e-5


def test_a_followed_plan_is_remembered(planner, small_store, tmp_path):
    options = {"sampling_steps": 2, "replan": 3}
    call, told = of_stablehlo(exporting.export(planner, tmp_path / "p", "stablehlo", **options))
    assert {"memory.plan", "memory.age"} <= {x["name"] for x in told["inputs"]}
    assert apart(call, told, played(planner, small_store, noisy=True, **options)) <= 1e-5


def test_a_flow_keeps_its_driver(small_store, small_world, tmp_path):
    """The driver is drawn from the noise that a file is given, and carried; also under a guard."""
    changes = dict(num_updates=4, batch=8, width=16, depth=2, drivers=4)
    flow = loop.train("flow", small_store, changes=changes, quiet=True, out=tmp_path)[0]
    steps = played(flow, small_store, noisy=True)
    call, told = of_stablehlo(exporting.export(flow, tmp_path / "f", "stablehlo"))
    assert {"memory.driver", "memory.age"} <= {x["name"] for x in told["inputs"]}
    assert apart(call, told, steps) <= 1e-5
    guarded = {**FULL, "num_samples": 3, "world": small_world}
    steps = played(flow, small_store, noisy=True, **guarded)
    assert apart(*of_stablehlo(exporting.export(flow, tmp_path / "g", "stablehlo", **guarded)), steps) <= 1e-5
    pytest.importorskip("jax2onnx")
    assert apart(*of_onnx(exporting.export(flow, tmp_path / "f.onnx")), played(flow, small_store, noisy=True)) <= 1e-5


def test_agents_who_are_alike(own_store, tmp_path):
    """Learned of three of them, without states; a file is of as many as are asked for."""
    names = own_store.card.observation_names
    card = {"observation_names": names, "hazard": own_store.card.hazard, "task": "fleet", "homogeneous": True}
    costs = np.repeat(own_store.costs[:, None], 3, 1)
    store = dataclasses.replace(own_store, costs=costs, card=card)
    run = loop.train("bc", store, changes={"num_updates": 2, "width": 8}, quiet=True, out=tmp_path)[0]
    call, told = of_stablehlo(exporting.export(run, tmp_path / "5", "stablehlo", agents=5))
    assert told["inputs"] == [{"name": "observations", "shape": [5, 14], "dtype": "float32"}] and told["n_agents"] == 5
    assert (
        told["names"] == {"observations": list(own_store.card.observation_names)}
        and told["execution"] == "decentralized"
    )
    seen = own_store.observations[:5, 0]
    action = Controller(run, agents=5).act(seen)
    np.testing.assert_allclose(call({"observations": seen})["action"], action, atol=1e-6)


def test_bad_input_is_refused_in_a_sentence(run, tmp_path, capsys, monkeypatch):
    pytest.importorskip("jax2onnx")
    (tmp_path / "file").write_text("mine")
    out = ["--out", str(tmp_path / "x.onnx")]
    both = tmp_path / "both"
    for name in "ab":
        (both / name).mkdir(parents=True)
        (both / name / "config.json").write_text("{}")
    for words, said in (
        ([str(run.path), "--out", str(tmp_path)], "is no regular file"),
        ([str(run.path), "--out", str(tmp_path / "file" / "x")], "is a file, no folder"),
        ([str(run.path), "--out", ""], "names no file"),
        ([str(tmp_path / "nowhere"), *out], "does not exist"),
        ([str(both), *out], "holds 2 runs"),
        ([str(both / "a"), *out], "config.json"),
        ([str(run.path), *out, "--guard", "shield"], "needs the World of its data"),
        ([str(run.path), *out, "--set", "horizn=3"], "did you mean 'horizon'"),
        ([str(run.path), *out, "--format", "tflite"], "invalid choice"),
        ([str(run.path), *out, "--checkpoint", "99"], "holds no checkpoint of step 99"),
    ):
        with pytest.raises(SystemExit) as stop:
            main(["export", *words])
        told = capsys.readouterr()
        assert stop.value.code == 2 and said in told.err + told.out, words
    with pytest.raises(UserError, match="Unknown format 'onx'; did you mean 'onnx'"):
        exporting.export(run, tmp_path / "x", "onx")
    with pytest.raises(UserError, match="'p.xyz' ends in .xyz, and what is written is onnx; end it in .onnx"):
        exporting.export(run, tmp_path / "p.xyz")
    monkeypatch.setitem(sys.modules, "jax2onnx", None)  # as if it were not installed
    with pytest.raises(UserError, match=r"pip install 'ringfence\[export\]'"):
        exporting.export(run, tmp_path / "x.onnx")
    monkeypatch.setitem(sys.modules, "flatbuffers", None)
    with pytest.raises(UserError, match="StableHLO files need flatbuffers, which is missing"):
        exporting.export(run, tmp_path / "x", "stablehlo")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["both", "file"]


def test_what_cannot_be_exported_is_named(run, tmp_path, monkeypatch):
    job, _ = load(run)
    with pytest.raises(UserError, match="draws more than normal noise"):
        exporting.step_of(job, Constant(job.spec, random=True))
    pytest.importorskip("jax2onnx")
    one, two = (Entry(name, (3,), "float32") for name in ("observations", "action"))
    there = jax.ShapeDtypeStruct((3,), "float32")
    odd = Step(lambda x: [jax.pure_callback(np.sin, there, x)], (one,), (two,), {}, lambda key: [], {})
    with monkeypatch.context() as few, pytest.raises(UserError, match="has .* operations.*look less far ahead"):
        few.setattr(exporting, "MAX_OPERATIONS", 3)
        exporting.export(run, tmp_path / "x.onnx")
    seen_then = []
    with monkeypatch.context() as watched:
        watched.setattr(exporting, "as_onnx", lambda step: seen_then.extend(tmp_path.iterdir()) or 1 / 0)
        with pytest.raises(ZeroDivisionError):
            exporting.export(run, tmp_path / "x.onnx")
    assert not seen_then and not [*tmp_path.iterdir()], "who is killed while converting leaves nothing"
    with pytest.raises(UserError, match="cannot be written as ONNX .*pure_callback.*; write it as StableHLO"):
        exporting.as_onnx(odd)


def test_the_node_plays_the_file(run, small_store, small_world, tmp_path):
    """The example for ROS 2 without ROS: what it makes of the file is what the controller does."""
    pytest.importorskip("jax2onnx")
    pytest.importorskip("onnxruntime")
    file = Path(__file__).parents[1] / "examples" / "ros2_node.py"
    spec = importlib.util.spec_from_file_location("ros2_node", file)
    node = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(node)  # without rclpy, which main() alone needs
    options = {**SHIELD, "adapt": 0.1, "world": small_world}
    main_file = exporting.export(run, tmp_path / "p.onnx", **options)
    pilot, controller = node.Pilot(str(main_file)), Controller(run, **options)
    for episode in range(2):
        pilot.reset(), controller.reset()
        for t in range(3):
            seen, state = small_store.observations[episode * 26 + t], small_store.state[episode * 26 + t]
            cost = (None, 1.0, 1.0)[t]
            told = np.nan if cost is None else cost
            np.testing.assert_allclose(pilot.act(seen, state, told), controller.act(seen, state, cost), atol=2e-5)
            assert pilot.info["infeasible"] == controller.info["infeasible"]
    place, speed, goal = (np.arange(4.0).reshape(2, 2) + k for k in (0, 10, 100))
    names = ["own.x", "own.vy", "goal.dx", "other0.dx", "other0.dvy", "other0.y"]
    np.testing.assert_array_equal(
        node.observed(names, place, speed, goal), [[0, 11, 100, 2, 2, 3], [2, 13, 100, -2, -2, 1]]
    )
    with pytest.raises(SystemExit, match="reads 'lidar3', which odometry does not tell"):
        node.observed(["lidar3"], place, speed, goal)


def test_the_c_example_plays_the_file(run, small_store, tmp_path):
    """Compiled against ONNX Runtime in $ORT, or where a distribution puts it; what it prints is what the controller
    does."""
    pytest.importorskip("jax2onnx")
    root = os.environ.get("ORT", "/usr")
    there = [
        f for f in ("onnxruntime_cxx_api.h", "onnxruntime/onnxruntime_cxx_api.h") if Path(root, "include", f).exists()
    ]
    if not there or not shutil.which("g++"):
        pytest.skip("no headers of ONNX Runtime; unpack a release and name it by $ORT")
    code, play = Path(__file__).parents[1] / "examples" / "export_cpp" / "play.cpp", tmp_path / "play"
    where = ["-I", str(Path(root, "include", there[0]).parent), f"-L{root}/lib", f"-Wl,-rpath,{root}/lib"]
    subprocess.run(["g++", "-std=c++17", str(code), *where, "-lonnxruntime", "-o", str(play)], check=True)
    file = exporting.export(run, tmp_path / "p.onnx")
    reads = [x.name for x in exporting.step_of(*load(run)).inputs]
    rows = [{"observations": small_store.observations[t], "state": small_store.state[t]} for t in range(3)]
    told = [" ".join(str(x) for name in reads for x in row[name].ravel()) for row in rows]
    out = subprocess.run([play, file, "3"], input="\n".join(told), capture_output=True, text=True, check=True).stdout
    acted = np.array([[float(x) for x in line.split()] for line in out.splitlines()])
    controller = Controller(run)
    np.testing.assert_allclose(acted, [controller.act(**row).ravel() for row in rows], atol=1e-4)


def test_metadata_is_json_where_nothing_was_told_yet(played, small_store, tmp_path):
    """JSON has no NaN; what `float` reads as one stands in its place, for programs of other languages, too."""

    def refuse(word):
        pytest.fail(f"JSON has no {word}")

    costs = {"near": played["costs"], "far": 1.0 - played["costs"]}
    card = small_store.card.updated(constraints={"near": 1.0, "far": 20.0})
    state = {"state": played["state"]}
    named = [played[name] for name in ("observations", "actions", "rewards")]
    store = EpisodeStore.from_episodes(*named, costs, card=card, **state)
    (run,) = loop.train("bc", store, changes={"num_updates": 4, "width": 16}, quiet=True, out=tmp_path)
    options = {**SHIELD, "adapt": 0.1, "world": worlds.fit(store, labels="costs", **QUICK_WORLD)}
    file = exporting.export(run, tmp_path / "p.stablehlo", "stablehlo", **options)
    with zipfile.ZipFile(file) as packed:
        metadata = json.loads(packed.read("metadata.json"), parse_constant=refuse)
    assert metadata["initial"]["memory.cost"] == "NaN" and np.isnan(np.asarray("NaN", np.float32))
    initial = {"a": np.array([np.nan, np.inf, 1.0], np.float32), "b": np.zeros(3), "c": np.zeros((0,))}
    assert [exporting._short(x) for x in initial.values()] == [["NaN", "Infinity", 1.0], 0.0, 0.0]
    assert exporting._flat(initial) == {"initial.a": "NaN Infinity 1.0", "initial.b": "0.0", "initial.c": "0.0"}


def test_the_c_example_reads_what_streams_do_not(tmp_path):
    """`operator>>` of C++ ends at NaN and leaves 0; the lines of the example do not."""
    if not shutil.which("g++"):
        pytest.skip("no g++")
    lines = (Path(__file__).parents[1] / "examples" / "export_cpp" / "play.cpp").read_text().splitlines()
    first = next(k for k, line in enumerate(lines) if "std::vector<float> given" in line)
    reads = "\n".join(lines[first : first + 2])
    code = (
        "#include <cstdlib>\n#include <iostream>\n#include <iterator>\n#include <sstream>\n#include <vector>\n"
        f'int main() {{ std::istringstream initial("NaN 2 -Infinity");\n{reads}\n'
        "for (float x : given) std::cout << x << ' '; }"
    )
    (tmp_path / "a.cpp").write_text(code)
    subprocess.run(["g++", "-std=c++17", str(tmp_path / "a.cpp"), "-o", str(tmp_path / "a")], check=True)
    out = subprocess.run([tmp_path / "a"], capture_output=True, text=True, check=True).stdout
    assert out.split() == ["nan", "2", "-inf"]
