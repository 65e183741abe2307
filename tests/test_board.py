"""The leaderboard is tested on a results folder of made-up episodes whose numbers can be worked out by hand."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from ringfence import algos
from ringfence.cli import app
from ringfence.datasets import registry
from ringfence.errors import UserError
from ringfence.evaluation import protocol
from ringfence.report import board_csv, board_latex, board_markdown, board_markdown_short, build_board, export_board
from ringfence.report.board import aggregate, aggregates, contests, read
from ringfence.report.board_page import PUBLISHED, matches, published, rankings
from ringfence.report.page import danger
from ringfence.report.table import Method
from ringfence.utils.text import latex, markdown, shell, spreadsheet, terminal

EXPERT, MEDIUM = "simple_spread-expert", "simple_spread-medium"
LOW, HIGH = 159.8, 516.8  # Simple Spread's normalisation
BENCH = {"format": 1, "protocol": 1, "suite": "simple_spread", "episodes": 4, "split": "test"}


def summary(returns, costs, task=EXPERT, unsafe=(0, 0, 0, 0), **more) -> dict:
    """The protocol's summary of four episodes of two steps with these returns and costs."""
    rewards = np.stack([np.asarray(returns, float), np.zeros(len(returns))], 1)
    steps = np.stack([np.asarray(costs, float), np.zeros(len(costs))], 1)
    played = {"rewards": rewards, "costs": steps, "steps": np.full(4, 2), "terminated": np.zeros(4, bool)}
    made = protocol.summarise(played, registry.get(task), np.asarray(unsafe, bool))
    made |= {"protocol": 1, "task": task, "split": "test", "parameters": 1234, "train_seconds": 10.0}
    return made | more


def write(path: Path, data) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(data))
    return path


def cell(root: Path, results: dict | None, algorithm="bc", preset="default", seed=0, task=EXPERT, mark="a1", **config):
    """One cell of the grid, with what the runner leaves in it."""
    job = algorithm if preset == "default" else f"{algorithm}-{preset}"
    path = root / "cells" / task / job / f"seed-{seed}-{mark}"
    config = {
        "algorithm": algorithm,
        "preset": preset,
        "config": {"num_updates": 100} | config,
        "task": task,
        "seed": seed,
        "hazard": {"kind": "Separation", "radius": 0.3, "safe_margin": 0.075},
        "data": {"provenance": "made up"},
    }
    write(path / "config.json", config)
    if results is not None:
        specs = {name: name.removeprefix(preset).removeprefix("+").split("@")[0] or "default" for name in results}
        write(path / "results.json", {name: {"spec": specs[name], **result} for name, result in results.items()})
        write(path / "env.json", {"python": "3.11"})
    return path


@pytest.fixture
def folder(tmp_path) -> Path:
    """Two tasks. On expert: BC (two seeds, over the limit), ICBF plain (over) and guarded (within), one seed 1 that
    failed. On medium: BC alone."""
    root = tmp_path / "results"
    write(root / "bench.json", BENCH)
    cell(root, {"default": summary([300, 300, 300, 300], [3, 3, 3, 3])})
    cell(root, {"default": summary([320, 320, 320, 320], [0, 4, 4, 0], unsafe=(0, 1, 0, 0))}, seed=1)
    guarded = summary([400, 420, 410, 410], [0, 0, 0, 1], plan_ms_p50=7.25, parameters=5678)
    results = {"default": summary([200] * 4, [2, 2, 2, 2]), "default+guarded": guarded}
    cell(root, results, "icbf", "default")
    failed = cell(root, None, "icbf", "default", seed=1)
    write(failed / "status.json", {"state": "failed", "error": "Traceback ...\nMemoryError: no memory"})
    for seed in (0, 1):
        cell(root, {"default": summary([250] * 4, [0, 0, 0, 0], MEDIUM)}, seed=seed, task=MEDIUM)
    data = summary([530] * 4, [4, 4, 3, 3], split="data", episodes=40)
    del data["per_episode"]
    write(
        root / "reference" / EXPERT / "reference.json",
        {"behaviour data": data, "do nothing": summary([180] * 4, [0] * 4)},
    )
    return root


def entries(board) -> list:
    """Every evaluation of a board."""
    return [row for lines in board.lines.values() for line in lines for row in line.rows]


def row(folder: Path, label: str, task: str = EXPERT):
    return next(r for r in read(folder).lines[task] if r.label == label)


# --- reading ---


def test_rows_are_read_with_their_folders(folder):
    board = read(folder)
    assert (board.suite, board.episodes, board.split, board.protocol) == ("simple_spread", 4, "test", 1)
    assert board.tasks == [EXPERT, MEDIUM] and board.seeds == (0, 1)
    assert len(entries(board)) == 6  # BC 2 + 2, ICBF two variants
    guarded = next(e for e in entries(board) if e.variant == "default+guarded")
    assert (guarded.task, guarded.algorithm, guarded.seed) == (EXPERT, "icbf", 0)
    assert guarded.file == folder / "cells" / EXPERT / "icbf" / "seed-0-a1" / "results.json"
    assert guarded.result["return_mean"] == 410.0


def test_cells_without_results_are_named_with_the_reason(folder):
    assert [(m.task, m.job, m.seed, m.why) for m in read(folder).missing] == [
        (EXPERT, "icbf", 1, "failed: MemoryError: no memory"),
        (MEDIUM, "icbf", 0, "not started"),
        (MEDIUM, "icbf", 1, "not started"),
    ]


def test_a_cell_done_under_another_mark_is_not_missing(folder):
    cell(folder, {"default": summary([1] * 4, [0] * 4)}, "icbf", "default", seed=1, mark="b2")
    assert not [m for m in read(folder).missing if m.task == EXPERT]


def test_cells_that_the_suite_leaves_out_are_not_missing_and_entries_without_cells_are_named(folder):
    cell(folder, {"long": summary([1] * 4, [0] * 4)}, "icbf", "long")
    replay = "simple_spread-medium-replay"  # the suite has no icbf:long there
    cell(folder, {"default": summary([1] * 4, [0] * 4, replay)}, task=replay)
    board = read(folder)
    missing = {(m.task, m.seed) for m in board.missing if m.job == "icbf-long" and m.why == "not started"}
    assert missing == {(EXPERT, 1), (MEDIUM, 0), (MEDIUM, 1)}
    assert board.untouched == ["simple_spread-random"]
    assert "omar" in board.unstarted and not {"bc", "icbf:default", "icbf:long"} & set(board.unstarted)


def test_a_cell_that_failed_after_an_evaluation_keeps_its_row_and_is_named(folder):
    path = folder / "cells" / EXPERT / "icbf" / "seed-0-a1"
    write(path / "status.json", {"state": "failed", "error": "KeyError: 'x'"})
    board = read(folder)
    assert ("icbf", 0, "not every evaluation is there, one failed: KeyError: 'x'") in {
        (m.job, m.seed, m.why) for m in board.missing
    }
    assert len(entries(board)) == 6


def test_the_preset_of_the_tier_is_the_default_of_its_task(folder):
    for task, preset in ((EXPERT, "expert"), (MEDIUM, "default")):
        results = {preset: summary([1] * 4, [0] * 4, task), f"{preset}+num_samples8": summary([2] * 4, [0] * 4, task)}
        for seed in (0, 1):
            cell(folder, results, "omar", preset, seed, task)
    board = read(folder)
    labels = {m.label for m in board.methods if m.algorithm == "omar"}
    assert labels == {"OMAR", "OMAR num_samples8"}
    assert {m.label for m in aggregate(board).methods} == {"BC"} | labels
    assert not [m for m in board.missing if "omar" in m.job]
    assert {e.name for e in entries(board) if e.algorithm == "omar" and e.task == EXPERT} == {
        "expert",
        "expert+num_samples8",
    }


def test_fields_younger_than_a_run_do_not_set_it_apart(folder):
    steps = cell(folder, {"default": summary([1] * 4, [0] * 4)}, seed=2)
    config = json.loads((steps / "config.json").read_text())
    defaults = {f.name: f.default for f in dataclasses.fields(algos.get("bc").Config)}
    write(steps / "config.json", config | {"config": defaults | {"num_updates": 100}})
    assert [m.label for m in read(folder).methods if m.algorithm == "bc"] == ["BC"]


def test_references_lie_in_a_folder_of_the_task(folder):
    write(folder / "reference" / MEDIUM / "reference.json", {"do nothing": summary([170] * 4, [0] * 4, MEDIUM)})
    found = read(folder).sections
    assert [r.name for r in found[EXPERT].references] == ["behaviour data", "do nothing"]
    assert [r.returns for r in found[MEDIUM].references] == [170.0]


def test_settings_that_differ_between_tasks_are_one_method_within_a_task_two(folder):
    cell(folder, {"default": summary([1] * 4, [0] * 4)}, "omar", alpha=1.0)
    cell(folder, {"default": summary([1] * 4, [0] * 4, MEDIUM)}, "omar", task=MEDIUM, alpha=2.0)
    assert [m.label for m in read(folder).methods if m.algorithm == "omar"] == ["OMAR"]
    cell(folder, {"default": summary([2] * 4, [0] * 4)}, "omar", mark="b2", alpha=2.0)
    assert {m.label for m in read(folder).methods if m.algorithm == "omar"} == {"OMAR [alpha=1.0]", "OMAR [alpha=2.0]"}
    medium = [line.method for line in read(folder).lines[MEDIUM]]
    assert {m.apart for m in medium if m.algorithm == "omar"} == {"[alpha=2.0]"}


ODD = {
    "protocol": ({"protocol": 2}, "protocol 2.*bench.json' has 1"),
    "split": ({"split": "validation"}, "split validation.*bench.json.*has test"),
    "task": ({"task": MEDIUM}, "of task 'simple_spread-medium'"),
    "another version": ({"per_episode": None}, "per_episode"),
}


@pytest.mark.parametrize("change, said", ODD.values(), ids=ODD)
def test_results_that_do_not_belong_are_refused_with_their_file(folder, change, said):
    odd = {k: v for k, v in (summary([1] * 4, [0] * 4) | change).items() if v is not None}
    cell(folder, {"default": odd}, "omar")
    with pytest.raises(UserError, match=f"omar/seed-0-a1/results.json' variant 'default'.*{said}"):
        read(folder)


def test_another_number_of_episodes_is_refused(folder):
    cell(folder, {"default": summary([1] * 5, [0] * 5, unsafe=[0] * 5)}, "omar")
    with pytest.raises(UserError, match="omar/seed-0-a1/results.json.*episodes 5.*bench.json' has 4"):
        build_board(folder, folder / "page.html")
    assert not (folder / "page.html").exists()


def test_other_constants_are_refused_and_both_files_named(folder):
    odd = summary([1] * 4, [0] * 4)
    odd["constants"] = odd["constants"] | {"cost_limit": 2.0}
    cell(folder, {"default": odd}, "omar")
    with pytest.raises(UserError, match=r"omar/seed-0-a1/results\.json.*constants.*bc/seed-0-a1/results\.json"):
        read(folder)


def test_reference_rows_are_held_to_the_same_rules(folder):
    file = folder / "reference" / EXPERT / "reference.json"
    write(file, {"do nothing": summary([1] * 4, [0] * 4, protocol=3)})
    with pytest.raises(UserError, match="reference/simple_spread-expert/reference.json' row 'do nothing'.*protocol 3"):
        read(folder)
    write(file, {"do nothing": summary([1] * 4, [0] * 4, split="validation")})
    with pytest.raises(UserError, match="row 'do nothing'.*split validation"):
        read(folder)


def test_another_format_no_format_and_a_damaged_file_are_refused(folder):
    write(folder / "bench.json", BENCH | {"format": 2})
    with pytest.raises(UserError, match="bench.json' has format 2, this version reads format 1"):
        read(folder)
    write(folder / "bench.json", {k: v for k, v in BENCH.items() if k != "split"})
    with pytest.raises(UserError, match="lacks 'split'"):
        read(folder)
    (folder / "bench.json").write_text("{")
    with pytest.raises(UserError, match="damaged bench.json"):
        read(folder)
    (folder / "bench.json").unlink()
    with pytest.raises(UserError, match="no bench.json"):
        read(folder)


def test_a_folder_without_finished_cells_is_refused(tmp_path):
    write(tmp_path / "bench.json", BENCH)
    cell(tmp_path, None)
    with pytest.raises(UserError, match="no finished cell"):
        read(tmp_path)


def test_a_task_without_any_result_is_shown_as_such(folder):
    write(folder / "cells" / "simple_spread-random" / "bc" / "seed-0-a1" / "status.json", {"state": "failed"})
    page = build_board(folder, folder / "page.html").read_text()
    assert "simple_spread-random" in page
    assert board_markdown_short(read(folder))


def test_a_folder_of_validation_results_is_refused(tmp_path):
    write(tmp_path / "bench.json", BENCH)
    cell(tmp_path, {"default@validation": summary([1] * 4, [0] * 4, split="validation")})
    with pytest.raises(UserError, match="results on other resets or of earlier checkpoints alone"):
        read(tmp_path)


def test_the_same_cell_twice_a_moved_cell_and_other_data_are_refused(folder):
    copied = cell(folder, {"default": summary([1] * 4, [0] * 4)}, mark="b2")
    with pytest.raises(UserError, match="seed-0-a1' and .*seed-0-b2' are the same job with the same seed 0"):
        read(folder)
    config = json.loads((copied / "config.json").read_text())
    write(copied / "config.json", config | {"seed": 5})
    with pytest.raises(UserError, match="seed-0-b2/config.json' names seed 5, its folder 0"):
        read(folder)
    write(copied / "config.json", config | {"data": {"provenance": "public"}, "config": {"num_updates": 1}})
    with pytest.raises(UserError, match=r"seed-0-b2' was trained on other data \(its provenance is public\)"):
        read(folder)


# --- numbers ---


def test_numbers_of_a_row_by_hand(folder):
    bc = row(folder, "BC")
    assert bc.returns == 310.0 and bc.returns_sd == pytest.approx(200**0.5)  # of 300 and 320
    assert bc.returns_norm == pytest.approx((310 - LOW) / (HIGH - LOW))
    assert bc.returns_norm_sd == pytest.approx(200**0.5 / (HIGH - LOW))
    assert bc.cost == 2.5 and bc.cost_sd == pytest.approx(0.5**0.5)  # of 3 and 2
    assert bc.cost_safe_start == pytest.approx((12 + 4) / 7)  # without the unsafe start of seed 1
    assert (bc.violations, bc.episodes, bc.seeds) == (6, 8, (0, 1)) and not bc.safe
    assert (bc.train_seconds, bc.parameters, bc.plan_ms) == (10.0, 1234, None)
    guarded = row(folder, "ICBF-Diffuser guarded")
    assert guarded.returns_sd is None and guarded.plan_ms == 7.25 and guarded.violations == 1
    # 1 of 4: the bound p solves P(at most 1 of 4) = (1 - p)^4 + 4 p (1 - p)^3 = 0.05
    p = guarded.violation_upper
    assert (1 - p) ** 4 + 4 * p * (1 - p) ** 3 == pytest.approx(0.05)


def test_ranks_are_lexicographic(folder):
    rows = read(folder).lines[EXPERT]
    # guarded alone is within the limit; plain costs 2 and BC 2.5, although BC earns more
    assert [(r.label, r.rank, r.safe, r.best) for r in rows] == [
        ("ICBF-Diffuser guarded", 1, True, True),
        ("ICBF-Diffuser", 2, False, False),
        ("BC", 3, False, False),
    ]
    cell(folder, {"default": summary([405] * 4, [0] * 4)}, "omar")
    rows = read(folder).lines[EXPERT]
    assert [(r.label, r.rank) for r in rows[:2]] == [("ICBF-Diffuser guarded", 1), ("OMAR", 2)]


def test_equal_methods_share_a_place(folder):
    cell(folder, {"default": summary([400, 420, 410, 410], [0, 0, 0, 1])}, "omar")
    rows = read(folder).lines[EXPERT]
    assert [(r.label, r.rank, r.best) for r in rows] == [
        ("OMAR", 1, True),
        ("ICBF-Diffuser guarded", 1, True),
        ("ICBF-Diffuser", 3, False),
        ("BC", 4, False),
    ]


def test_settings_chosen_on_validation_stay_off_the_table(folder):
    path = folder / "cells" / EXPERT / "bc" / "seed-0-a1" / "results.json"
    results = json.loads(path.read_text())
    write(path, results | {"default@validation": summary([999] * 4, [0] * 4, split="validation")})
    assert len(entries(read(folder))) == 6 and row(folder, "BC").returns == 310.0


def test_one_seed_has_no_interval_between_runs_and_twin_limits_are_no_two_tasks(tmp_path):
    root = tmp_path / "results"
    write(root / "bench.json", BENCH | {"suite": "mujoco"})
    names = [f"halfcheetah_2x3-{tier}{limit}" for limit in ("", "-quantile") for tier in ("good", "poor")]
    for task in names:
        cell(root, {"mujoco": summary([300] * 4, [3] * 4, task)}, preset="mujoco", task=task)
    cell(root, {"mujoco": summary([400] * 4, [0] * 4, names[0])}, "icbf", preset="mujoco", task=names[0])
    board = read(root)
    first, second = rankings(board)
    assert [(r.line.name, r.mean) for r in first.rows] == [("BC", 1.0), ("ICBF-Diffuser", None)]
    assert second.tasks == names[2:] and [r.line.name for r in second.rows] == ["BC"]  # who has no result has no row
    native, quantile = aggregates(board)
    assert (native.protocol, native.tasks, quantile.tasks) == ("native", names[:2], names[2:])
    (iqm,) = native.iqm_returns.values()
    assert iqm[1] is None and native.return_bands == native.cost_bands == [None]
    page = text_of(build_board(root, tmp_path / "p.html").read_text())
    assert page.count("The 2 tasks with quantile limits") == 2 and "Older revisions" in page
    assert f"{names[0]}, ICBF-Diffuser, seed 0" in page  # whose run tells no revision, so it is of the first
    assert "1 seed; 4 episodes" in page and "nothing is known of its spread between runs" in page
    assert "A step costs 1 for a distance below 0.3 m. Cost limit l = 25" in page
    assert danger({"kind": "SpeedLimit", "limit": 1.026}) == "a speed above 1.026 m/s"


def test_falls_are_shown(folder, tmp_path):
    fallen = summary([400] * 4, [0] * 4) | {"termination_rate": 0.75, "steps_mean": 12.0}
    cell(folder, {"default": fallen}, "omar")
    page = text_of(section_of(build_board(folder, tmp_path).read_text(), EXPERT))
    assert "ended early mean length" in page and "75.0 % 12 steps" in page
    assert "| 75.0 % |" in board_markdown(read(folder)) and "ended early" not in section_of(
        (tmp_path / "report.html").read_text(), MEDIUM
    )
    line = next(r for r in csv.DictReader(io.StringIO(board_csv(read(folder)))) if r["algorithm"] == "omar")
    assert (line["ended_early"], line["steps_mean"]) == ("0.75", "12")


def test_nobody_within_the_limit_means_no_best(folder):
    path = folder / "cells" / EXPERT / "icbf" / "seed-0-a1" / "results.json"
    write(path, {"default": summary([900] * 4, [2] * 4)})
    assert not any(r.best for r in read(folder).lines[EXPERT])
    assert (
        "★"
        not in build_board(folder, folder / "p.html")
        .read_text()
        .split(f'<h2 id="task0-title">{EXPERT}')[1]
        .split("</section>")[0]
    )


def test_references_keep_their_own_numbers(folder):
    data, idle = read(folder).sections[EXPERT].references
    assert (data.name, data.returns, data.episodes, data.reference) == ("behaviour data", 530.0, 40, True)
    assert idle.cost == 0.0 and idle.rank == 0 and idle.seeds == ()


def test_aggregate_takes_methods_with_every_task(folder):
    found = aggregate(read(folder))
    bc = Method("bc", "default", "default")
    assert found.methods == [bc] and found.seeds == {bc: (0, 1)}
    assert {m.label: t for m, t in found.left_out.items()} == {
        "ICBF-Diffuser": [MEDIUM],
        "ICBF-Diffuser guarded": [MEDIUM],
    }
    scores = np.array([[300, 250], [320, 250]])
    assert found.returns[bc] == pytest.approx((scores - LOW) / (HIGH - LOW))
    assert found.costs[bc] == pytest.approx(np.array([[3, 0], [2, 0]]))
    # the middle half of the four runs: 250 and 300
    assert found.iqm_returns[bc][0] == pytest.approx((275 - LOW) / (HIGH - LOW))
    assert found.iqm_costs[bc][0] == pytest.approx(1.0)  # of 0, 0, 2, 3
    # 10 of the 16 episodes cost nothing, 4 cost three, 2 cost four
    at = [int(np.argmin(abs(found.cost_thresholds - x))) for x in (0.0, 3.0)]
    assert found.cost_profiles[0, at] == pytest.approx([10 / 16, 14 / 16])
    assert found.return_profiles[0, 0] == 1.0 and found.return_profiles[0, -1] == 0.0
    for shares, bands in ((found.return_profiles, found.return_bands), (found.cost_profiles, found.cost_bands)):
        assert (bands[0][0] <= shares[0] + 1e-12).all() and (shares[0] <= bands[0][1] + 1e-12).all()
    # at cost 0, expert has 0 of 4 and 2 of 4 episodes, medium all: drawing a seed twice gives 1/2 or 3/4
    assert found.cost_bands[0][:, at[0]] == pytest.approx([0.5, 0.75])


def test_the_first_is_tested_against_the_rest_on_the_same_resets(folder):
    against = {c.other.label: c for c in contests(read(folder).lines[EXPERT])}
    assert list(against) == ["ICBF-Diffuser", "BC"]  # the first is ICBF-Diffuser guarded
    assert against["BC"].returns == 100.0 and against["BC"].cost == 0.25 - 2.5
    assert against["BC"].cost_interval[0] <= -2.25 <= against["BC"].cost_interval[1]
    # 400 420 410 410 against 310 each: four differences of one sign have p = 2/2^4 or, with ties, nearly so; the
    # smallest of four tests counts four times
    assert 0.2 <= against["BC"].returns_p <= 1.0
    assert contests(read(folder).lines[MEDIUM]) == []


def test_probability_of_improvement_has_the_row_ahead(folder):
    for seed in (0, 1):
        cell(folder, {"default": summary([310] * 4, [1] * 4)}, "omar", seed=seed)
        cell(folder, {"default": summary([240] * 4, [0] * 4, MEDIUM)}, "omar", seed=seed, task=MEDIUM)
    found = aggregate(read(folder))
    assert [m.label for m in found.methods] == ["BC", "OMAR"]
    # BC over OMAR: expert 300, 320 against 310 is one of two, medium 250 against 240 always
    assert found.improves[0, 1] == pytest.approx(0.75) and found.improves[1, 0] == pytest.approx(0.25)
    # cost: expert 3, 2 against 1 never less; medium 0 against 0 are ties
    assert found.cheaper[0, 1] == pytest.approx(0.25) and found.cheaper[1, 0] == pytest.approx(0.75)


def test_seeds_that_some_task_lacks_do_not_count_over_tasks(folder):
    cell(folder, {"default": summary([330] * 4, [1] * 4)}, seed=2)
    found = aggregate(read(folder))
    assert list(found.seeds.values()) == [(0, 1)] and row(folder, "BC").seeds == (0, 1, 2)


def test_nothing_is_averaged_when_no_method_has_every_task(folder, tmp_path):
    for seed in (0, 1):
        (folder / "cells" / MEDIUM / "bc" / f"seed-{seed}-a1" / "results.json").unlink()
    cell(folder, {"default": summary([1] * 4, [0] * 4, MEDIUM)}, "omar", task=MEDIUM)
    assert aggregate(read(folder)) is None
    assert "nothing is averaged over tasks" in build_board(folder, tmp_path / "p.html").read_text()


# --- the page ---


class Checker(HTMLParser):
    """Collects links and text, and holds every element to be closed in order."""

    VOID = {"meta", "link", "br", "input"}

    def __init__(self):
        super().__init__()
        self.open, self.links, self.ids, self.wrong = [], [], [], []

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.links += [values[k] for k in ("href", "src") if k in values]
        self.ids += [values["id"]] if "id" in values else []
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if not self.open or self.open.pop() != tag:
            self.wrong.append((tag, self.getpos()))


def text_of(html: str) -> str:
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", html))


def section_of(page: str, title: str) -> str:
    return re.search(rf"<h2[^>]*>{title}</h2>.*?</section>", page, re.S)[0]


def test_page_parses_links_resolve_and_nothing_is_loaded(folder, tmp_path):
    page = build_board(folder, tmp_path / "out" / "page.html")
    html = page.read_text()
    checker = Checker()
    checker.feed(html)
    assert not checker.wrong and not checker.open
    assert not re.search(r"https?:|//cdn|@import|<script|url\(['\"]?http", html)
    assert len(checker.ids) == len(set(checker.ids))
    inner = [x[1:] for x in checker.links if x.startswith("#")]
    assert inner and all(x in checker.ids for x in inner)
    files = [x for x in checker.links if not x.startswith(("#", "data:"))]
    assert len(files) == 6 and all((page.parent / f).is_file() for f in files)  # one per row and seed
    assert list(page.parent.iterdir()) == [page]


def test_page_shows_the_numbers(folder, tmp_path):
    expert = text_of(section_of(build_board(folder, tmp_path).read_text(), EXPERT))
    assert (tmp_path / "report.html").is_file()
    assert "ICBF-Diffuser guarded ★ best within the limit 1 410.0" in expert
    assert "BC 3 310.0 ± 14.1" in expert and "2.500 ± 0.707" in expert
    assert "6 of 8" in expert and "1 of 2" in expert  # unsafe episodes of BC; seeds of ICBF
    assert "For reference behaviour data – 530.0" in expert
    assert "Cost limit l = 1 per episode. Normalised return = (return − 159.8) / (516.8 − 159.8)" in expert
    assert "nan" not in expert.lower() and "None" not in expert


def test_page_does_not_hide_what_is_missing(folder, tmp_path):
    html = build_board(folder, tmp_path).read_text()
    medium = text_of(section_of(html, MEDIUM))
    assert "ICBF-Diffuser not measured on this task" in medium
    assert "3 of the grid's cells have no result" in text_of(html)
    assert "2 of the suite's 4 tasks were not begun" in text_of(html)
    made = text_of(section_of(html, "How it was made"))
    assert "simple_spread-expert, icbf, seed 1: failed: MemoryError: no memory" in made
    assert "simple_spread-medium, icbf, seeds 0, 1: not started" in made
    assert "ICBF-Diffuser is left out of this section: it has no result on medium" in text_of(html)


def test_ranking_puts_methods_with_every_task_first(folder, tmp_path):
    text = text_of(section_of(build_board(folder, tmp_path).read_text(), "Ranking"))
    assert text.index("BC 1.00") < text.index("ICBF-Diffuser guarded –")
    # the only method with every task: the mean of its ranks among such methods is 1, whatever the others did on one
    assert "BC 1.00 1 3 0.42, cost 2.50 over limit 1 ★ 0.25, cost 0.00 within limit" in text
    assert "1 ★ 0.70, cost 0.25 within limit 1 of 2 seeds" in text


def test_published_values_stand_beside_ours_and_apart(folder, tmp_path):
    board = read(folder)
    table = published(board)
    assert table is not None
    bc = next(row for row in table.rows if row.name == "BC")
    assert table.tasks == ["expert", "medium"] and bc.numbers == [35.0, 31.6]
    assert bc.ours[0].label == "BC"
    assert bc.ours[0].numbers == pytest.approx([100 * (x - LOW) / (HIGH - LOW) for x in (310, 250)])
    omar = next(row for row in table.rows if row.name == "OMAR")
    assert omar.numbers == [114.9, 47.9] and omar.ours == []
    assert "on the public data files; ours are on regenerated data" in build_board(folder, tmp_path).read_text()
    assert {p.name for p in PUBLISHED if matches(p, "ma-td3bc")} == {"MA-TD3+BC"}
    names = [row.name for row in table.rows]
    assert len(names) == len(set(names)), "robots' values stay off this board"
    robot = next(p for p in PUBLISHED if p.name == "BC" and "ant_2x4-good" in p.values)
    assert robot.values["ant_2x4-good"] == pytest.approx(100 * (2697 + 325.6) / (3362.44 + 325.6), abs=0.05)
    assert not any(matches(p, "bc-safe") for p in PUBLISHED)


def test_validation_boards_say_so(folder, tmp_path):
    root = tmp_path / "validation"
    write(root / "bench.json", BENCH | {"split": "validation"})
    cell(root, {"default@validation": summary([300] * 4, [0] * 4, split="validation")})
    assert "no result may be claimed" in build_board(root, tmp_path / "v.html").read_text()


def test_the_command_line_makes_the_board(folder, tmp_path, capsys):
    app.main(["report", str(folder), "--out", str(tmp_path / "page.html")])
    assert "page.html" in capsys.readouterr().out
    assert "Leaderboard: simple spread" in (tmp_path / "page.html").read_text()
    with pytest.raises(SystemExit):
        app.main(["report", str(folder), str(folder / "cells"), "--out", str(tmp_path / "two.html")])
    assert "give it alone" in capsys.readouterr().err


# --- exports ---


def test_csv_by_hand(folder):
    lines = list(csv.DictReader(io.StringIO(board_csv(read(folder)))))
    assert len(lines) == 3 + 2 + 3  # expert, its references, medium with two rows that were not measured
    bc = next(r for r in lines if r["algorithm"] == "bc" and r["task"] == EXPERT)
    assert (bc["return_mean"], bc["return_sd"], bc["cost_mean"], bc["unsafe_episodes"]) == (
        "310",
        "14.1421",
        "2.5",
        "0.75",
    )
    assert (bc["rank"], bc["within_limit"], bc["best"], bc["seeds"], bc["plan_ms_p50"]) == ("3", "0", "0", "2", "")
    assert float(bc["return_norm"]) == pytest.approx((310 - LOW) / (HIGH - LOW), rel=1e-5)
    absent = next(r for r in lines if r["task"] == MEDIUM and r["variant"] == "default+guarded")
    assert absent["seeds"] == "0" and absent["return_mean"] == "" and absent["rank"] == ""
    assert [r["method"] for r in lines if r["variant"] == "reference"] == ["behaviour data", "do nothing"]


def test_latex_by_hand(folder):
    cell(folder, {"default": summary([1] * 4, [2] * 4)}, "my_method", mark="a1")
    text = board_latex(read(folder))
    assert text.count(r"\begin{tabular}") == text.count(r"\end{tabular}") == text.count(r"\bottomrule") == 2
    assert (
        r"BC & $310.0 \pm 14.1$ & $0.42 \pm 0.04$ & $2.50 \pm 0.71^{\dagger}$ & $2.286$ & $75.0\;(100.0)$ & 2 \\"
        in text
    )
    assert r"\textbf{ICBF-Diffuser guarded} & $\mathbf{410.0}$" in text and text.count(r"\textbf") == 2
    assert r"my\_method & $1.0$" in text
    assert r"ICBF-Diffuser guarded & -- & -- & -- & -- & -- & 0 \\" in text
    body = [x for x in text.splitlines() if x.endswith(r"\\")]
    assert {x.count("&") for x in body} == {6}


def test_latex_special_characters_are_escaped():
    assert latex(r"a_b & 50% {x} #1 $ ~ ^ \ ≤") == (
        r"a\_b \& 50\% \{x\} \#1 \$ \textasciitilde{} \textasciicircum{} \textbackslash{} $\le$"
    )


def test_markdown_whole_and_short(folder):
    board = read(folder)
    whole = board_markdown(board)
    assert r"**simple\_spread-expert**, cost limit 1, normalised with 159.8 → 516.8" in whole
    assert "| BC | 3 | 310.0 ± 14.1 | 0.421 ± 0.040 | 2.500 ± 0.707 † | 2.286 (" in whole
    assert "| ICBF-Diffuser guarded | 1 | **410.0** | 0.701 | 0.250 |" in whole
    assert "| ICBF-Diffuser | – | not measured |" in whole and "0 of 2" in whole
    short = board_markdown_short(board)
    assert "| BC | 0.42 (2.286) † | **0.25 (0.000)** | 1.00 |" in short
    assert "| ICBF-Diffuser guarded | **0.70 (0.250) [1]** | not measured | – |" in short
    assert "| do nothing | 0.06 (0.000) | not measured | – |" in short
    for text in (whole, short):
        for block in re.findall(r"(?:^\|.*\n)+", text, re.M):
            assert len({line.replace("\\|", "").count("|") for line in block.splitlines()}) == 1


def test_exports_are_files(folder, tmp_path):
    for form in ("csv", "latex", "markdown", "markdown-short"):
        assert export_board(folder, form, tmp_path / "out" / form).read_text()
    with pytest.raises(UserError, match="Unknown format 'xlsx'"):
        export_board(folder, "xlsx", tmp_path / "x")


NAMES = [
    "$x^$",
    "x; curl evil|sh",
    "=HYPERLINK(1)",
    "<script>alert(1)</script>",
    "\x1b[31mred",
    "[/red]",
    "a\nb",
    "a|b_c*d`e",
]


@pytest.mark.parametrize("name", NAMES)
def test_names_stay_words_in_every_language(name):
    import shlex

    assert terminal(name).plain.isprintable() and not terminal(name).spans
    assert not str(spreadsheet(name)).startswith(("=", "+", "-", "@"))
    assert "\n" not in latex(name) and "<script>" not in markdown(name)
    assert len(shlex.split(shell(name))) == 1
    bar = markdown(name).replace("\\|", "")
    assert "|" not in bar


def test_pages_take_any_name(folder, tmp_path):
    """A method whose name is mathematics, markup and a formula."""
    for k, name in enumerate(("$x^$", "=1+1", "[red]b")):
        cell(folder, {"default": summary([1] * 4, [2] * 4)}, name, mark=f"a{k}")
    page = build_board(folder, tmp_path / "board.html").read_text()
    assert "$x^$" in page and "mathdefault" not in page  # nor are the numbers of logarithmic axes left to be typeset
    for form in ("csv", "markdown", "markdown-short", "latex"):
        export_board(folder, form, tmp_path / form)
    assert "\n=1" not in (tmp_path / "csv").read_text() and ",=1" not in (tmp_path / "csv").read_text()
