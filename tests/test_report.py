"""The report is tested on run folders of small made-up files: nothing is trained."""

from __future__ import annotations

import json
import os
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from ringfence.algos import ICBF
from ringfence.errors import UserError
from ringfence.evaluation import statistics
from ringfence.report import build_report, page, provenance
from ringfence.report.table import sections
from ringfence.training.runs import Run

TASK = "simple_spread-medium"
CONSTANTS = {"return_min": 159.8, "return_max": 516.8, "cost_limit": 1.0, "cost_offset": 0.0}
NAMES = ["own.vx", "own.vy", "own.x", "own.y"]


def result(returns, costs, unsafe=None, **more) -> dict:
    returns, costs = np.asarray(returns, float), np.asarray(costs, float)
    unsafe = np.zeros(len(costs), bool) if unsafe is None else np.asarray(unsafe)
    fine = costs[~unsafe]
    return {
        "episodes": len(returns),
        "return_mean": returns.mean(),
        "return_interval": [returns.min(), returns.max()],
        "cost_mean": costs.mean(),
        "cost_interval": [costs.min(), costs.max()],
        "cost_cvar10": statistics.cvar(costs),
        "violation_rate": float((costs > 0).mean()),
        "unsafe_starts": int(unsafe.sum()),
        "cost_safe_start": fine.mean(),
        "cost_safe_start_interval": [fine.min(), fine.max()],
        "constants": CONSTANTS,
        "per_episode": {"return": returns.tolist(), "cost": costs.tolist(), "unsafe_start": unsafe.tolist()},
        "protocol": 1,
        "task": TASK,
        "split": "test",
        "options": {},
        "command": ["eval", "--episodes", str(len(returns))],
        "parameters": 12345,
        "train_seconds": 60.0,
    } | more


def folder(
    root, algorithm="icbf", preset="split", seed=0, results=None, task=TASK, provenance="made up", **config
) -> Run:
    """A run folder without checkpoint."""
    name = algorithm if preset == "default" else f"{algorithm}-{preset}"
    path = root / "runs" / task / name / f"seed-{seed}"
    path.mkdir(parents=True)
    config = {
        "algorithm": algorithm,
        "preset": preset,
        "config": {"num_updates": 4000, "history": 0} | config,
        "task": task,
        "spec": {"n_agents": 2, "feature_names": NAMES, "episode_length": 5},
        "hazard": {"kind": "Separation", "radius": 0.3, "safe_margin": 0.075},
        "seed": seed,
        "data": {"provenance": provenance, "collected": "by hand <b>", "seed": 0},
    }
    (path / "config.json").write_text(json.dumps(config))
    (path / "env.json").write_text(json.dumps({"python": "3.11", "packages": {"jax": "0.5"}}))
    rows = [{"step": s, "seconds": 1.0, "loss/denoising": 1 / s, "barrier/weight": 0.3} for s in (10, 20, 30)]
    (path / "metrics.jsonl").write_text("".join(json.dumps(r) + "\n" for r in rows))
    if results is not None:
        (path / "results.json").write_text(json.dumps(results))
    return Run(path)


def record(run: Run, variant: str, plans: int, episodes: int = 2, steps: int = 5, agents: int = 2, rows: int = 3):
    rng = np.random.default_rng(0)
    kept = {
        "states": rng.uniform(-1, 1, (episodes, steps + 1, 6 * agents)),
        "rewards": rng.normal(size=(episodes, steps)),
        "costs": rng.integers(0, 2, (episodes, steps)).astype(float),
        "plans": rng.uniform(-1, 1, (episodes, steps, plans, rows, agents, len(NAMES))),
        "chosen": rng.integers(0, plans, (episodes, steps)),
    }
    np.savez_compressed(run.path / f"rollout-{variant}.npz", **kept)
    return kept


@pytest.fixture
def runs(tmp_path) -> list[Run]:
    rng = np.random.default_rng(1)
    made = []
    for seed in (0, 1):
        costs = rng.integers(0, 2, 20)
        results = {
            "split": result(rng.normal(250, 30, 20), costs, costs > 0, options={"sampling_steps": 10}),
            "split+sampling_steps4": result(
                rng.normal(260, 30, 20), np.zeros(20), options={"sampling_steps": 4}, plan_ms_p50=7.25
            ),
        }
        if seed == 0:
            results["split@validation"] = result([1.0, 2.0], [0, 1], split="validation")
        made.append(folder(tmp_path, seed=seed, results=results))
    made.append(folder(tmp_path, "bc", "default", results={"default": result([200, 210], [3, 4])}))
    for name in ("split", "split+sampling_steps4"):
        record(made[0], name, 4 if "steps4" in name else 1)
    data = result([270.0, 272.0], [0, 1], split="data")
    del data["per_episode"], data["options"]
    idle = result([170.0, 172.0], [0, 0])
    (tmp_path / "runs" / TASK / "reference.json").write_text(json.dumps({"behaviour data": data, "do-nothing": idle}))
    return made


def test_page_is_whole_and_self_contained(runs, tmp_path):
    page = build_report(runs, tmp_path / "out" / "page.html", title="A & B")
    text = page.read_text()
    assert not re.search(r"https?://|//cdn|@import|<script[^>]+src=|<link(?![^>]+href=\"data:)", text)
    assert "<title>A &amp; B</title>" in text and "by hand &lt;b&gt;" in text
    for row in ("BC", "ICBF-Diffuser", "split+sampling_steps4", "behaviour data", "do-nothing"):
        assert row in text
    assert "Validation results" in text and "return − 159.8" in text
    assert text.count("<tr class") == 6  # three methods, one on validation, two references
    assert "NaN" not in text and "nan" not in re.findall(r"<td>(.*?)</td>", text)
    identifiers = re.findall(r'\bid="([^"]+)"', text)
    assert len(identifiers) == len(set(identifiers))
    assert all(target in identifiers for target in re.findall(r"url\(#([^)]+)\)", text))
    assert list(page.parent.iterdir()) == [page]  # nothing temporary stays behind


def test_page_goes_into_a_folder(runs, tmp_path):
    assert build_report(map(lambda r: str(r.path), runs), tmp_path) == tmp_path / "report.html"


def test_what_is_no_row_is_refused(runs):
    config = json.loads((runs[1].path / "config.json").read_text())
    write = lambda more: (runs[1].path / "config.json").write_text(json.dumps(config | more))  # noqa: E731
    write({"data": config["data"] | {"seed": 3}})
    with pytest.raises(UserError, match="its seed is 3"):
        sections(runs)
    write({})
    results = json.loads((runs[1].path / "results.json").read_text())
    results["split"] = result([1.0, 2.0], [0, 1], options={"sampling_steps": 10})
    (runs[1].path / "results.json").write_text(json.dumps(results))
    with pytest.raises(UserError, match="'split' were played for 2 and for 20 episodes"):
        sections(runs)


def test_what_was_played_before_training_went_on_is_dated(runs):
    config = json.loads((runs[0].path / "config.json").read_text())
    for run in runs[:2]:
        config = json.loads((run.path / "config.json").read_text())
        (run.path / "config.json").write_text(json.dumps(config | {"config": config["config"] | {"num_updates": 30}}))
    results = runs[0].results
    results["split"]["step"] = 10
    (runs[0].path / "results.json").write_text(json.dumps(results))
    (section,) = sections(runs)
    seeds = {r.variant: r.seeds for r in section.tables["test"] if r.method.algorithm == "icbf"}
    assert seeds["split@step10"] == (0,) and seeds["split"] == (1,)
    assert any(
        "--checkpoint 10" in line and str(runs[0].path) in line for line in provenance.commands(section, Path("r.html"))
    )


def test_a_run_that_is_older_than_a_field_had_its_default(runs):
    config = json.loads((runs[0].path / "config.json").read_text())
    whole = config["config"] | {"barrier_width": ICBF.Config().barrier_width}
    (runs[0].path / "config.json").write_text(json.dumps(config | {"config": whole}))
    (section,) = sections(runs)
    assert [r.seeds for r in section.tables["test"] if r.label == "ICBF-Diffuser split"] == [(0, 1)]


def test_seeds_are_pooled(runs):
    (section,) = sections(runs)
    bc, plain, chosen = section.tables["test"]
    assert [r.label for r in (bc, plain, chosen)] == [
        "BC",
        "ICBF-Diffuser split",
        "ICBF-Diffuser split+sampling_steps4",
    ]
    episodes = [r.results["split"]["per_episode"] for r in runs[:2]]
    returns, costs = (np.array([t[k] for t in episodes]) for k in ("return", "cost"))
    assert plain.seeds == (0, 1) and plain.episodes == 40
    assert plain.returns == pytest.approx(returns.mean())
    low, high = plain.returns_interval
    assert high - low > abs(returns[0].mean() - returns[1].mean())  # two seeds know little of a third
    assert plain.cost == pytest.approx(costs.mean()) and plain.cost_safe_start == 0.0
    assert plain.violations == int(costs.sum())
    assert plain.violation_upper == statistics.upper_bound(int((costs > 0).any(0).sum()), 20)  # resets, not episodes
    assert plain.returns_norm == pytest.approx((returns.mean() - 159.8) / 357.0)
    assert chosen.violation_upper == pytest.approx(1 - 0.05 ** (1 / 20)) and chosen.plan_ms == 7.25
    assert chosen.safe and not bc.safe
    assert [r.name for r in section.references] == ["behaviour data", "do-nothing"]
    assert [r.variant for r in section.tables["validation"]] == ["split"]


def test_commands_are_those_that_made_the_results(runs):
    """Runs that were played in the same words share a line."""
    results = runs[0].results
    results["split"]["command"] = ["play", "--env", "yard.py:Yard", "--agents", "5"]
    del results["split+sampling_steps4"]["command"]
    (runs[0].path / "results.json").write_text(json.dumps(results))
    (section,) = sections(runs)
    lines = provenance.commands(section, Path("r.html"))
    played = f"ringfence play {runs[0].path} --env THEIR.py:SIMULATOR --agents 5"
    assert any(line.startswith(played) and "yard.py:Yard of whoever played" in line for line in lines)
    assert f"ringfence eval {runs[1].path} --episodes 20" in lines
    assert sum(line.startswith("# of ") and "split+sampling_steps4" in line for line in lines) == 1
    results["split"]["command"] = ["data", "make", "x", "--out", "/etc/passwd"]
    (runs[0].path / "results.json").write_text(json.dumps(results))
    with pytest.raises(UserError, match="made by 'data', which plays nothing"):
        provenance.commands(sections(runs)[0], Path("r.html"))


def test_training_is_a_line_for_seeds_that_follow_each_other(runs):
    (section,) = sections(runs)
    trained = [line for line in provenance.commands(section, Path("r.html")) if line.startswith("ringfence train")]
    assert "ringfence train icbf DATA.h5 --preset split --seeds 2" in " ".join(trained)
    assert len(trained) == 2


def test_headline_names_the_best_safe_method(runs, tmp_path):
    text = build_report(runs, tmp_path).read_text()
    said = (
        r"ICBF-Diffuser split\+sampling_steps4 is the only one of 3 "
        r".*0\.0 % of 40 episodes \(2 seeds\), at most 13\.9 %"
    )
    assert re.search(f'class="headline">{said}', text)


def test_revisions_get_rows_of_their_own(runs):
    config = json.loads((runs[1].path / "config.json").read_text())
    (runs[1].path / "config.json").write_text(json.dumps(config | {"revision": 2}))
    (section,) = sections(runs)
    rows = {r.variant: r.seeds for r in section.tables["test"] if r.method.algorithm == "icbf"}
    assert rows["split [revision=1]"] == (0,) and rows["split [revision=2]"] == (1,)


def test_one_run_and_one_path_make_a_page(runs, tmp_path):
    for one in (runs[2], str(runs[2].path), runs[2].path):
        assert "BC" in build_report(one, tmp_path / "one.html").read_text()


@pytest.mark.parametrize(
    "lost", ["cost_cvar10", "cost_safe_start_interval", "unsafe_starts", "return_interval", "split"]
)
def test_results_of_another_version_are_named(runs, tmp_path, lost):
    results = runs[2].results
    del results["default"][lost]
    (runs[2].path / "results.json").write_text(json.dumps(results))
    with pytest.raises(UserError, match=f"lacks '{lost}'|has split 'None'"):
        build_report(runs, tmp_path)


def test_lists_in_configs_are_shown(tmp_path):
    run = folder(tmp_path, "mine", "default", results={"default": result([1.0, 2.0], [0, 1])}, sizes=[64, 64])
    assert "sizes=[64, 64]" in build_report([run], tmp_path).read_text()


def test_configs_that_differ_get_rows_of_their_own(tmp_path):
    results = {"split": result([1.0, 2.0], [0, 1])}
    two = [folder(tmp_path / str(k), results=results, num_updates=k) for k in (10, 20)]
    (section,) = sections(two)
    assert sorted(r.variant for r in section.tables["test"]) == ["split [num_updates=10]", "split [num_updates=20]"]


def test_tasks_are_kept_apart(tmp_path):
    other = "simple_spread-expert"
    runs = [
        folder(tmp_path, results={"split": result([1.0, 2.0], [0, 1])}),
        folder(tmp_path, task=other, results={"split": result([3.0, 4.0], [0, 1], task=other)}),
    ]
    assert [(s.task, len(s.lines)) for s in sections(runs)] == [(TASK, 1), (other, 1)]
    assert build_report(runs, tmp_path).read_text().count("<h2") == 3  # how it was made is the third


@pytest.mark.parametrize(
    "change, said",
    [
        ({"protocol": 2}, "protocol 2"),
        ({"task": "simple_spread-expert"}, "simple_spread-expert"),
        ({"split": "train"}, "train"),
        ({"constants": CONSTANTS | {"cost_limit": 2.0}}, "constants"),
        ({"per_episode": None}, None),
    ],
)
def test_numbers_that_do_not_belong_together_are_refused(tmp_path, change, said):
    odd = result([1.0, 2.0], [0, 1]) | change
    if said is None:
        del odd["per_episode"]
    runs = [
        folder(tmp_path, results={"split": result([1.0, 2.0], [0, 1])}),
        folder(tmp_path, "madiff", "default", results={"default": odd}),
    ]
    with pytest.raises(UserError, match="madiff/seed-0") as caught:
        build_report(runs, tmp_path / "page.html")
    assert said is None or said in str(caught.value)
    assert not (tmp_path / "page.html").exists()


def test_reference_of_another_protocol_is_refused(runs, tmp_path):
    file = tmp_path / "runs" / TASK / "reference.json"
    file.write_text(json.dumps({"do-nothing": result([1.0], [0], protocol=7)}))
    with pytest.raises(UserError, match="reference.json.*protocol 7"):
        build_report(runs, tmp_path)


def test_other_data_and_a_seed_given_twice_are_refused(tmp_path):
    results = {"split": result([1.0, 2.0], [0, 1])}
    one = folder(tmp_path / "a", results=results)
    with pytest.raises(UserError, match="other data"):
        build_report([one, folder(tmp_path / "b", seed=1, results=results, provenance="public")], tmp_path)
    with pytest.raises(UserError, match="same seed 0"):
        build_report([one, folder(tmp_path / "c", results=results)], tmp_path)
    assert sections([one, one])[0].lines[0].seeds == (0,)  # the same folder twice is one run


def test_runs_without_results_are_refused(tmp_path):
    run = folder(tmp_path)
    with pytest.raises(UserError, match="ringfence eval"):
        build_report([run], tmp_path)
    with pytest.raises(UserError, match="No run"):
        build_report([], tmp_path)


def test_players_keep_the_chosen_plan_first(runs):
    (section,) = sections(runs)
    many, one = page.players(section)
    assert (many["label"], one["label"]) == ("ICBF-Diffuser split+sampling_steps4", "ICBF-Diffuser split")
    kept = np.load(runs[0].path / "rollout-split+sampling_steps4.npz")
    shown = np.array(many["episodes"][1]["plans"]) / 1000
    step = 3
    expected = kept["plans"][1, step, kept["chosen"][1, step], ..., 2:4]
    assert shown.shape[1] == 4 and np.allclose(shown[step, 0], expected, atol=5.1e-4)
    positions = np.array(many["episodes"][0]["positions"]) * many["episodes"][0]["unit"]
    assert np.allclose(positions.reshape(len(positions), -1), kept["states"][0, :, :4], atol=5.1e-4)


def test_many_plans_are_cut_to_the_budget(monkeypatch):
    plans = np.arange(2 * 6 * 3 * 2 * 2, dtype=float).reshape(2, 6, 3, 2, 2) / 1000
    monkeypatch.setattr(page, "NUMBERS", 2 * 3 * 2 * 2 * 2)
    shown = np.array(page.few(plans, np.array([5, 0])))
    assert shown.shape == (2, 2, 3, 2, 2) and np.allclose(shown[0, 0] / 1000, plans[0, 5])


def test_a_plan_is_repeated_while_it_is_followed():
    plans = np.zeros((1, 3, 1, 2, 1, 4))
    plans[0, 0, ..., 2] = 0.5
    plans[0, 2, ..., 2] = 0.7
    xy = page.tracks({"plans": plans}, NAMES, 1, 0)
    assert np.allclose(xy[0, :, 0, 0, 0, 0], [0.5, 0.5, 0.7])


def test_missing_checkpoint_is_said_on_the_page(tmp_path):
    run = folder(tmp_path, results={"split": result([1.0, 2.0], [0, 1])}, barrier=True)
    assert "Not drawn:" in build_report([run], tmp_path).read_text()


@pytest.mark.parametrize("damage", ["another file", "cut to nothing", "flipped bits"])
def test_damaged_recording_is_an_error_that_helps(runs, tmp_path, damage):
    file = runs[0].path / "rollout-split.npz"
    np.savez_compressed(file, states=np.arange(1000.0))
    data = file.read_bytes()
    middle = bytes(255 - b for b in data[100:200])
    wrong = {"another file": b"PK nonsense", "cut to nothing": b"", "flipped bits": data[:100] + middle + data[200:]}
    file.write_bytes(wrong[damage])
    with pytest.raises(UserError, match="damaged"):
        build_report(runs, tmp_path)


def test_a_shell_reads_every_word_of_a_command_as_it_was(runs, tmp_path):
    """Whoever wrote the run folders chose these words."""
    evil = 'x\'; touch "$HOME"/y & `z` $(z) | > \n # ~'
    config = json.loads((runs[0].path / "config.json").read_text())
    config |= {"config": config["config"] | {"history": evil}}
    (runs[0].path / "config.json").write_text(json.dumps(config))
    results = runs[0].results
    results["split"]["command"] = ["play", "--env", evil, "--set", f"horizon={evil}", f"temperature={evil}"]
    (runs[0].path / "results.json").write_text(json.dumps(results))
    (section,) = sections(runs)
    lines = provenance.commands(section, tmp_path / evil.replace("/", ""))
    shown = evil.replace("\n", "\\n")
    words = [word for line in lines for word in shlex.split(line)]
    for word in (f"history={shown}", f"horizon={shown}", f"temperature={shown}", shown):
        assert word in words
    assert all("touch" not in line for line in map(unquoted, lines))


def unquoted(line: str) -> str:
    """What a shell would read as its own language."""
    return re.sub(r"'[^']*'|\"[^\"]*\"", "", line)


@pytest.mark.parametrize("name", ["seed", "size"])
def test_counts_on_a_card_are_counts(runs, name, tmp_path):
    for run in runs:
        config = json.loads((run.path / "config.json").read_text())
        config["data"] |= {"provenance": "regenerated by x", name: "0; touch x"}
        (run.path / "config.json").write_text(json.dumps(config))
    with pytest.raises(UserError, match=f"data card's {name}=0; touch x must be a whole number"):
        build_report(runs, tmp_path / "r.html")


@pytest.mark.parametrize("kind", ["link", "no GIF", "pipe"])
def test_a_page_embeds_films_of_its_runs_alone(kind, runs, tmp_path):
    """A page is passed on; it must not hold what a link in a stranger's run folder points to."""
    film = runs[0].path / f"rollout-{next(iter(runs[0].results))}.gif"
    (tmp_path / "secret").write_bytes(b"GIF89a secret")
    if kind == "link":
        film.symlink_to(tmp_path / "secret")
    elif kind == "no GIF":
        film.write_bytes(b"secret")
    else:
        os.mkfifo(film)
    with pytest.raises(UserError, match="is no film of this run"):
        build_report(runs, tmp_path / "r.html")


def test_names_of_strangers_are_letters_in_every_language():
    """What Markdown strikes through or escapes, and what the end of LaTeX's row before would read as its own."""
    from ringfence.utils import text

    assert text.markdown("~~a~~ \\| $x$") == r"\~\~a\~\~ \\\| \$x\$"
    assert text.latex("[2cm]*<|>") == r"{[}2cm{]}{*}\textless{}\textbar{}\textgreater{}"
    assert text.page("a\x00\x1b[31m\u202e\ud800\n\tb") == "a\\x00\\x1b[31m\\u202e\\ud800\n\tb"
    assert str(text.lines("a\x1b]0;x\x07\n[red]b")) == "a\\x1b]0;x\\x07\n[red]b"


def test_a_page_holds_no_control_characters(runs, tmp_path):
    for run in runs:
        config = json.loads((run.path / "config.json").read_text())
        config["data"] |= {"simulator": "a\x00b\x1b[31mc"}
        (run.path / "config.json").write_text(json.dumps(config))
    text = build_report(runs, tmp_path / "r.html").read_text(encoding="utf-8")
    assert "a\\x00b\\x1b[31mc" in text and not set(text) & {"\x00", "\x1b"}


def test_a_page_that_cannot_be_written_is_refused(runs, tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(UserError, match="is a file, no folder"):
        build_report(runs, tmp_path / "file" / "r.html")
