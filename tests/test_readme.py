"""What the first page says runs, and its links lead somewhere."""

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import ringfence
from ringfence import algos
from ringfence.guards import GUARDS
from tests.quick import QUICK_WORLD

ROOT = Path(__file__).resolve().parent.parent
PAGES = [
    ROOT / "README.md",
    ROOT / "CHANGELOG.md",
    ROOT / "CONTRIBUTING.md",
    *sorted((ROOT / "docs").glob("*.md")),
    ROOT / "results" / "README.md",
]


def test_the_first_lines_of_python_run(tmp_path, monkeypatch):
    """Word by word, but for how long things are fitted and how hard the shield tries."""
    monkeypatch.setitem(GUARDS, "shield", {"correction_steps": 1, "horizon": 1})
    rng = np.random.default_rng(0)
    names = ["own.x", "own.y", "goal.dx", "goal.dy"]
    told = SimpleNamespace(
        EpisodeStore=ringfence.EpisodeStore,
        Controller=ringfence.Controller,
        guard=ringfence.guard,
        train=lambda *a: ringfence.train(*a, out=tmp_path, changes={"num_updates": 20, "width": 16}, quiet=True),
        fit=lambda store: ringfence.fit(store, **QUICK_WORLD),
    )
    observations = rng.normal(size=(40, 11, 2, 4)).astype(np.float32)
    space = {
        "ringfence": told,
        "names": names,
        "observations": observations,
        "actions": rng.uniform(-1, 1, (40, 10, 2, 2)).astype(np.float32),
        "rewards": rng.normal(size=(40, 10, 2)),
        "costs": (rng.random((40, 10)) < 0.1).astype(float),
        "my_policy": lambda observations, state: np.zeros((2, 2)),
        "observation": observations[0, 0],
    }
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S)
    exec(code.replace("import ringfence\n", ""), space)
    assert space["action"].shape == (2, 2)
    assert space["pilot"].act(observations[0, 0]).shape == (2, 2)


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        file, _, place = target.partition("#")
        if "://" in target:
            continue
        there = page.parent / file if file else page
        assert there.exists(), f"{page.name} links to {target}"
        if place and there.suffix == ".md":
            heads = re.findall(r"^#+ (.*)$", there.read_text(), re.M)
            anchors = {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in heads}
            assert place in anchors, f"{page.name} links to {target}"


def test_the_first_page_fits_a_screen():
    """But for the table of the paper's tasks."""
    page = re.sub(r"<!-- glance -->.*<!-- /glance -->", "", (ROOT / "README.md").read_text(), flags=re.S)
    assert len(page.encode()) <= 5000


# Blocks `python` are run as they stand; sketches, which need something of the reader's, are `py`.
RUN = [f.stem for f in sorted((ROOT / "docs").glob("*.md")) if "```python" in f.read_text()]


@pytest.mark.parametrize("page", RUN)
def test_code_of_a_page_runs(page, tmp_path, monkeypatch, capsys):
    """In examples/, block after block; the World, the policy and the logs are small."""
    fit, train = ringfence.fit, ringfence.train
    small = {"num_updates": 4, "width": 16}
    monkeypatch.setattr(ringfence, "fit", lambda store, quiet=True: fit(store, **QUICK_WORLD), raising=False)
    monkeypatch.setattr(ringfence, "train", lambda *a: train(*a, changes=small, quiet=True), raising=False)
    monkeypatch.setitem(GUARDS, "shield", {"correction_steps": 1, "horizon": 1})
    monkeypatch.setitem(algos.ALGORITHMS, "mine", None)  # a page adds one
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / f"{page}.md").read_text(), re.S)
    assert blocks
    space: dict = {}
    for block in blocks:
        for large, less in (("record(600)", "record(60)"), ("episodes=50, num_envs=50", "episodes=2, num_envs=2")):
            block = block.replace(large, less)
        exec(compile(block, f"{page}.md", "exec"), space)
    if page == "start":
        assert "shield" in capsys.readouterr().out
