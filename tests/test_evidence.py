"""The log of a controller, and what tells that it was changed."""

import errno
import hashlib
import importlib.util
import os
from pathlib import Path

import jax
import numpy as np
import pytest

from ringfence.cli.app import main
from ringfence.deploy import zoo
from ringfence.deploy.controller import Controller
from ringfence.deploy.watch import Evidence
from ringfence.envs import Crossing
from ringfence.errors import NoSafeAction, UserError
from ringfence.evaluation.certificate import digest
from ringfence.loading.resolve import load
from ringfence.utils.chained import ChainedLog, LogError, check, records

LIGHT = {"correction_steps": 2, "correction_restarts": 0, "horizon": 1, "terminal_value": False}


@pytest.fixture
def written(tmp_path):
    """A log of six records."""
    log = ChainedLog(tmp_path / "run.log")
    for k in range(5):
        log.add({"kind": "step", "value": k})
    log.add({"kind": "end"})
    log.close()
    return tmp_path / "run.log"


@pytest.mark.parametrize("at", ["begin", "end"])
def test_a_log_on_a_full_disk_is_given_back(at, tmp_path, monkeypatch):
    begun = None if at == "begin" else Evidence(tmp_path / "run.log", None, 2, None)

    def full(file, line):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as disk:
        disk.setattr(os, "write", full)
        with pytest.raises(UserError, match="free some space"):
            begun.close() if begun else Evidence(tmp_path / "run.log", None, 2, None)
    assert (tmp_path / "run.log").exists() == bool(begun), "without a record nothing is left"
    Evidence(tmp_path / "run.log", None, 2, None).close()
    assert check(tmp_path / "run.log").ended


def test_a_log_says_what_was_written_and_goes_on(written):
    found = check(written)
    assert found.records == 6 and found.ended
    assert [record.get("value") for record in records(written)] == [0, 1, 2, 3, 4, None]
    log = ChainedLog(written)
    last = log.add({"kind": "step"})
    assert check(written, last=last).records == 7 and not check(written).ended
    with pytest.raises(UserError, match="is written by another process"):
        ChainedLog(written)
    with pytest.raises(UserError, match="is not JSON"):
        log.add({"kind": "step", "x": float("nan")})
    log.close()
    with pytest.raises(UserError, match="was closed"):
        log.add({"kind": "step"})


def test_whatever_is_done_to_a_log_is_named_with_its_record(written):
    """Every byte of it, every line taken out, doubled or moved, and every cut within a line."""
    whole = written.read_bytes()
    lines = whole.splitlines(keepends=True)

    def first_wrong(content, **given):
        written.write_bytes(content)
        with pytest.raises(LogError) as refused:
            check(written, **given)
        return refused.value.record

    for place in range(len(whole)):
        changed = bytearray(whole)
        changed[place] = changed[place] ^ 1
        record = whole[:place].count(b"\n")
        assert first_wrong(bytes(changed)) == record
    for k in range(5):
        assert first_wrong(b"".join(lines[:k] + lines[k + 1 :])) == k
        assert first_wrong(b"".join(lines[: k + 1] + lines[k:])) == k + 1
        assert first_wrong(b"".join([*lines[:k], lines[k + 1], lines[k], *lines[k + 2 :]])) == k
        assert first_wrong(b"".join(lines[: k + 1]) + lines[k + 1][:-1]) == k + 1
    last = lines[-1].split(b" ")[0].decode()
    assert first_wrong(b"".join(lines[:-1]), last=last) == 5
    written.write_bytes(b"".join(lines[:-1]))
    assert not check(written).ended


def test_a_log_goes_on_after_a_full_disk(written, monkeypatch):
    """What was written of a record is taken back; where that fails, nothing is added any more."""
    log = ChainedLog(written)
    write = os.write
    monkeypatch.setattr("os.write", lambda file, line: write(file, line[:9]))
    with pytest.raises(UserError, match="the disk is full"):
        log.add({"kind": "step"})
    monkeypatch.undo()
    assert check(written).records == 6
    log.add({"kind": "step"})
    assert check(written, last=log.last).records == 7
    monkeypatch.setattr("os.write", lambda file, line: write(file, line[:9]))
    monkeypatch.setattr("os.ftruncate", lambda *_: write(-1, b""))  # which no file has
    with pytest.raises(UserError, match="the disk is full"):
        log.add({"kind": "step"})
    monkeypatch.undo()
    with pytest.raises(UserError, match="was closed"):
        log.add({"kind": "step"})
    with pytest.raises(LogError, match="record 7 is cut"):
        check(written)


@pytest.mark.parametrize(
    "record",
    [
        {"kind": "step"},
        {"kind": "step", "t": 1e300, "ms": 1.0, "executed": []},
        {"kind": "step", "t": 0, "ms": "long", "executed": []},
        {"kind": "step", "t": 0, "ms": 1.0, "executed": [[0.0]], "corrected": [{"agent": -1}]},
        {"kind": "refused", "t": 0, "why": 7},
        {"kind": "reset", "t": None},
    ],
)
def test_a_chain_that_no_controller_wrote_is_refused(record, tmp_path, capsys):
    log = ChainedLog(tmp_path / "forged")
    log.add({"kind": "begin", "t": 0.0})
    log.add(record)
    log.close()
    main(["log", "verify", str(log.path)])
    with pytest.raises(SystemExit) as stop:
        main(["log", "show", str(log.path)])
    assert stop.value.code == 2 and "record 1 is none of a controller" in " ".join(capsys.readouterr().err.split())


def test_words_of_a_log_are_on_the_line_of_their_record(tmp_path, capsys):
    log = ChainedLog(tmp_path / "forged")
    log.add({"kind": "refused", "t": 0.0, "why": "late\n     1  1970-01-01T00:00:01.000  end"})
    log.close()
    main(["log", "show", str(log.path)])
    assert len(capsys.readouterr().out.splitlines()) == 2


def test_deep_nesting_is_refused(tmp_path):
    body = '{"n":0,"kind":"step","x":' + "[" * 10**5 + "]" * 10**5 + "}"
    digest = hashlib.blake2b(f"ringfence log 1 {body}".encode(), digest_size=16).hexdigest()
    (tmp_path / "deep").write_text(f"{digest} {body}\n")
    with pytest.raises(LogError, match="record 0 is none .it is nested too deeply"):
        check(tmp_path / "deep")


def test_what_is_no_log_is_refused(tmp_path):
    for content, words in ((b"", "is empty"), (b"hello\n", "record 0 is none"), (b"\xff\n", "record 0 is none")):
        (tmp_path / "x").write_bytes(content)
        with pytest.raises(UserError, match=words):
            check(tmp_path / "x")
    for path in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(UserError, match="is no log"):
            check(path)
    (tmp_path / "x").write_bytes(b"hello\n")
    with pytest.raises(UserError, match="record 0"):
        ChainedLog(tmp_path / "x")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return zoo.pretrained("crossing-hasty/bc", tmp_path_factory.mktemp("runs"))


def test_a_controller_keeps_evidence_of_every_step(run, tmp_path, capsys):
    """It acts as without; each record can be checked against what happened."""
    file = tmp_path / "run.log"
    env = Crossing()
    logged = Controller(run, guard="shield", log=file, **LIGHT)
    plain = Controller(run, guard="shield", **LIGHT)
    unguarded = Controller(run)
    state = env.reset(jax.random.key(3), 1)
    acted, requested = [], []
    for _ in range(40):
        seen = np.asarray(env.observe(state))[0]
        acted.append(logged.act(seen))
        requested.append(unguarded.act(seen))
        np.testing.assert_allclose(plain.act(seen), acted[-1], atol=1e-6)
        state, _ = env.step(state, acted[-1][None])
    with pytest.raises(NoSafeAction):
        logged.act(np.full_like(seen, np.nan))
    logged.close()
    every = list(records(file))
    kinds = [record["kind"] for record in every]
    assert kinds == ["begin", "reset", *["step"] * 40, "refused", "end"]
    guarded = load(run, guard="shield")[1].one
    assert every[0]["policy"] == digest(guarded.proposal) and every[0]["world"] == digest(guarded.guard.world)
    assert every[0]["guard"]["horizon"] == 1 and every[0]["certificate"] is None
    assert "nan" in every[-2]["why"]
    corrected = 0
    for record, action, wanted in zip(every[2:-2], acted, requested):
        np.testing.assert_array_equal(np.float32(record["executed"]), action)
        asked = action.copy()
        for one in record["corrected"]:
            asked[one["agent"]] = one["requested"]
            assert one["constraint"] == "length of other.dx, other.dy" and one["thing"].startswith("other")
            assert one["row"] == 1
            assert one["score"] < 1.0  # the margin
        np.testing.assert_allclose(asked, wanted, atol=1e-5)
        corrected += len(record["corrected"])
    assert corrected > 3
    assert file.stat().st_size / len(every) < 1500
    main(["log", "verify", str(file)])
    assert "44 records are what was written; its writer ended it" in capsys.readouterr().out
    main(["log", "show", str(file), "--number", "50"])
    assert "since length of other.dx, other.dy of other" in " ".join(capsys.readouterr().out.split())
    file.write_bytes(file.read_bytes().replace(b'"corrected":[]', b'"corrected":[ ]', 1))
    with pytest.raises(SystemExit):
        main(["log", "verify", str(file)])
    assert "is not what was written" in " ".join(capsys.readouterr().err.split())


def test_the_node_keeps_a_log_that_can_be_verified(tmp_path):
    pytest.importorskip("onnxruntime")
    example = Path(__file__).parents[1] / "examples" / "ros2_node.py"
    spec = importlib.util.spec_from_file_location("ros2_node", example)
    node = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(node)
    (tmp_path / "policy.onnx").write_bytes(b"a policy")
    log = node.Evidence(str(tmp_path / "log"), str(tmp_path / "policy.onnx"))
    assert log.add({"kind": "step", "t": 0.0, "executed": [[0.5]]}).startswith(log.last)
    assert [record["kind"] for record in records(tmp_path / "log")] == ["begin", "step"]
    with pytest.raises(FileExistsError):
        node.Evidence(str(tmp_path / "log"), str(tmp_path / "policy.onnx"))


def test_callables_and_unguarded_runs_are_logged_too(run, tmp_path):
    env = Crossing()
    seen = np.asarray(env.observe(env.reset(jax.random.key(0), 1)))[0]
    world = load(run, guard="shield")[1].one.guard.world
    given = dict(world=world, agents=8, correction_steps=1, correction_restarts=0, horizon=1)
    controller = Controller(lambda seen, state: np.ones((len(seen), 2)), log=tmp_path / "a", **given)
    action = controller.act(seen)
    controller.close()
    with pytest.raises(NoSafeAction, match="was closed") as refused:  # what is not recorded is not done
        controller.act(seen)
    np.testing.assert_array_equal(refused.value.last_action, action)
    begin, _, step, _ = records(tmp_path / "a")
    assert begin["policy"] is None and begin["world"] == digest(world)
    np.testing.assert_array_equal(np.float32(step["executed"]), action)
    controller = Controller(run, log=tmp_path / "b")
    controller.act(seen)
    step = list(records(tmp_path / "b"))[-1]
    assert "corrected" not in step and not check(tmp_path / "b").ended
    with pytest.raises(UserError, match="is written by another process"):
        Controller(run, log=tmp_path / "b")
