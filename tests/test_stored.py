"""Results of older versions are read under today's names."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from ringfence.logs.schema import complete_card
from ringfence.training.runs import Run
from ringfence.utils import schemas, stored

RESULTS = Path(__file__).parents[1] / "results"
OLD = {
    "episodes": 4,
    "variant": "split+climbing+steps10+plans1@validation",
    "avoidable_cost": 0.5,
    "avoidable_interval": [0.0, 1.0],
    "avoidable_violation_upper": 0.25,
    "infeasible": 0.1,
    "strange": 0.2,
    "planner": "climbing",
    "options": {"steps": 10, "guidance": 1.0, "target": 1.5, "ascent": 100.0, "replan": 1},
    "guard": "shield",
    "danger": "formula",
    "sight": "own",
    "guard_options": {"plans": 1, "rows": 7, "shield": 10, "future": False, "margin": 1.0},
    "world_settings": {"members": 3, "missed": 0.001, "discount": 0.9},
    "constraints": {"contact": {"cost_mean": 1.0, "violation_rate": 0.5, "within": 0.75}},
}
NEW = {
    "episodes": 4,
    "variant": "split+value_guided+sampling_steps10+num_samples1@validation",
    "cost_safe_start": 0.5,
    "cost_safe_start_interval": [0.0, 1.0],
    "violation_upper_safe_start": 0.25,
    "infeasible_rate": 0.1,
    "ood_rate": 0.2,
    "planner": "value_guided",
    "options": {"sampling_steps": 10, "cfg_scale": 1.0, "target_return": 1.5, "value_guidance": 100.0, "replan": 1},
    "guard": "shield",
    "barrier": "analytic",
    "execution": "decentralized",
    "guard_options": {
        "num_samples": 1,
        "horizon": 7,
        "correction_steps": 10,
        "terminal_value": False,
        "margin": 1.0,
    },
    "world_settings": {"num_ensemble": 3, "miscoverage": 0.001, "discount": 0.9},
    "constraints": {"contact": {"cost_mean": 1.0, "violation_rate": 0.5, "limit_satisfied_rate": 0.75}},
}


def test_a_result_is_read_under_todays_names():
    assert stored.result(OLD) == NEW
    assert stored.result(NEW) == NEW


def test_a_run_gives_todays_names_and_keeps_its_file_until_the_next_result(tmp_path):
    file = tmp_path / "results.json"
    text = json.dumps({"split+climbing@validation": OLD})
    file.write_text(text)
    run = Run(tmp_path)
    assert run.results == {"split+value_guided@validation": NEW} and file.read_text() == text
    run.add_result("split", NEW)
    assert json.loads(file.read_text()) == {"split+value_guided@validation": NEW, "split": NEW}


@pytest.mark.parametrize(
    ("planner", "options", "guard", "barrier"),
    [
        ("plain", {}, "none", "none"),
        ("guarded", {}, "shield", "analytic"),
        ("adaptive", {}, "adapt", "analytic"),
        ("plain", {"plans": 4}, "select", "analytic"),
    ],
)
def test_a_result_that_is_older_than_guards_says_what_its_planner_did(planner, options, guard, barrier):
    found = stored.result({"planner": planner, "options": options})
    assert (found["guard"], found["barrier"], found["execution"]) == (guard, barrier, "centralized")


def test_a_reference_row_gets_no_guard():
    assert stored.results({"do-nothing": {"avoidable_cost": 0.0}}) == {"do-nothing": {"cost_safe_start": 0.0}}


def test_tables_are_read_under_todays_names(tmp_path):
    file = tmp_path / "table.csv"
    file.write_text('who,danger,options,infeasible\ncloning,formula,"rows=3 future=True guidance=1.0",0.5\n')
    row = {
        "method": "BC",
        "barrier": "analytic",
        "options": "horizon=3 terminal_value=True cfg_scale=1.0",
        "infeasible_rate": "0.5",
    }
    assert stored.table(file) == [row]
    file.write_text("guard,danger,barrier\nshield,formula,V from l\n")  # a table with a column of that name
    assert stored.table(file) == [{"guard": "shield", "danger": "formula", "barrier": "V from l"}]


def test_no_committed_table_has_a_name_twice():
    for file in RESULTS.rglob("*.csv"):
        with open(file, newline="") as opened:
            heads = next(csv.reader(opened))
        assert len(stored.table(file)[0]) == len(heads), file


def test_every_new_name_is_checked_where_results_are_read():
    known = schemas.Result.__annotations__
    assert set(stored.COLUMNS) <= set(known) and set(stored.COLUMNS.values()) <= set(known)


def test_homogeneous_agents_of_older_files_are_known():
    spec = {"alike": True, "n_agents": 1}
    assert stored.config({"task": "x", "spec": spec})["spec"] == {"homogeneous": True, "n_agents": 1}
    assert complete_card({"task": "fleet", "alike": True}).homogeneous


def test_settings_of_algorithms_of_older_runs_are_known():
    older = {"algorithm": "bc-return", "config": {"steps": 20, "target": 1.5, "width": 8}, "world": None}
    assert stored.config(older)["world"] is None
    older["world"] = {"sight": "own", "members": 3, "both_ends": None, "missed": 0.001}
    assert stored.config(older)["world"] == {
        "execution": "decentralized",
        "num_ensemble": 3,
        "use_transition": None,
        "miscoverage": 0.001,
    }
    assert stored.config(older)["config"] == {"num_updates": 20, "target_return": 1.5, "width": 8}
