"""The notebooks run, cell by cell, with small numbers in the cell of parameters."""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib
import pytest

from ringfence.guards import GUARDS
from tests.quick import QUICK_WORLD

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"
SMALL = {"WORLD": QUICK_WORLD, "POLICY": {"num_updates": 4, "width": 16}, "RUNS": 40, "EPISODES": 60, "PLAYED": 2}
SMALL |= {
    "PEOPLE": 60,
    "REPLAY": {"drivers": (), "windows": 6, "baselines": False},
    "ROWS": {"delay, known to the guard": {"faults": {"delay": 2}, "compensate": True}},
    "CALIBRATION": 9,
    "FRESH": 9,
    "GUARD": {"correction_steps": 1, "horizon": 1},
}
SMALL["OPE"] = dict(states=100, transitions=400, updates=20, num_ensemble=2, rollout_episodes=8, rollout_steps=5)


@pytest.mark.parametrize("file", sorted(EXAMPLES.glob("*.ipynb")), ids=lambda f: f.stem)
def test_it_runs(file, tmp_path, monkeypatch, capsys):
    matplotlib.use("Agg")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(EXAMPLES))
    monkeypatch.setitem(GUARDS, "shield", {"correction_steps": 1, "horizon": 1})
    space: dict = {}
    for cell in json.loads(file.read_text())["cells"]:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), f"{file.name}, {cell['id']}", "exec"), space)
        if "parameters" in cell["metadata"].get("tags", ()):
            assert {k for k in SMALL if k in space}, "the cell names what can be made smaller"
            space |= {k: v for k, v in SMALL.items() if k in space}
    assert capsys.readouterr().out


@pytest.mark.parametrize("file", sorted(EXAMPLES.glob("*.ipynb")), ids=lambda f: f.stem)
def test_kept_outputs_are_of_todays_words(file):
    """A card that is printed in a notebook was printed by this version: it has causes, and ends with the verdict."""
    cells = [cell for cell in json.loads(file.read_text())["cells"] if cell["cell_type"] == "code"]
    for cell in cells:
        assert cell["outputs"] or "print" not in "".join(cell["source"])
        if "print(world.card)" in "".join(cell["source"]):
            said = "".join(line for out in cell["outputs"] for line in out.get("text", ()))
            assert "Causes of danger" in said and "VERDICT" in said
