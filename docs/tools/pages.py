"""What MkDocs asks while it builds the site: the pages that no file holds. One per task, from the registry and the
committed results; the Python reference, from docstrings; the changelog and the like, from the repository's root."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import os
import re
import textwrap
from collections import defaultdict
from pathlib import Path
from unittest import mock

import ringfence
from ringfence.cli import app
from ringfence.datasets.registry import TASKS
from ringfence.datasets.task import Task
from ringfence.envs import Crossing, SafeMuJoCo, SimpleSpread, System
from ringfence.problem import constraints

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "results"
WIDTH = 86  # letters of a line of code that a page shows
# In the order in which one reads them.
NOTEBOOKS = [
    ROOT / "examples" / f"{name}.ipynb"
    for name in ("your_logs", "danger_without_a_formula", "replay_and_verdict", "certificate_under_delay")
]

# --- the Python reference: pages of modules that belong together ---
REFERENCE = {
    "Logs": (
        "ringfence.logs.store",
        "ringfence.logs.late",
        "ringfence.datasets.make",
        "ringfence.datasets.audit",
    ),
    "Importers": (
        "ringfence.logs.io.table_schema",
        "ringfence.logs.io.table_options",
        "ringfence.logs.io.table",
        "ringfence.logs.io.observe",
        "ringfence.logs.io.rosbag",
        "ringfence.datasets.importers",
        "ringfence.logs.io.hdf5",
        "ringfence.logs.io.omar",
        "ringfence.logs.io.ogmarl",
    ),
    "Danger": ("ringfence.problem.constraints",),
    "Training": ("ringfence.training.loop", "ringfence.training.runs"),
    "Playing": (
        "ringfence.loading.resolve",
        "ringfence.deploy.controller",
        "ringfence.evaluation.evaluate",
        "ringfence.evaluation.protocol",
        "ringfence.evaluation.play",
        "ringfence.evaluation.stress",
        "ringfence.faults",
        "ringfence.evaluation.certify",
        "ringfence.evaluation.certificate",
        "ringfence.logs.collect",
        "ringfence.envs.padded",
        "ringfence.evaluation.reference",
        "ringfence.deploy.zoo",
    ),
    "Off-policy evaluation": ("ringfence.evaluation.ope", "ringfence.evaluation.ope_result"),
    "Replay": ("ringfence.evaluation.replay",),
    "Export": ("ringfence.deploy.export",),
    "World": ("ringfence.training.worlds", "ringfence.world"),
    "Parts of a World": (
        "ringfence.world.fit",
        "ringfence.world.dynamics",
        "ringfence.world.values",
        "ringfence.world.barrier",
    ),
    "Guards": (
        "ringfence.guards.policy",
        "ringfence.guards.filter",
        "ringfence.guards.barrier",
        "ringfence.guards.wrap",
    ),
    "Planners": ("ringfence.proposals.planner",),
    "Options": ("ringfence.guards.options", "ringfence.proposals.options"),
    "Algorithms": (
        "ringfence.types",
        "ringfence.algos",
        "ringfence.algos.bc",
        "ringfence.algos.returns",
        "ringfence.algos.td3bc",
        "ringfence.algos.omar",
        "ringfence.algos.fisor",
        "ringfence.algos.icbf",
        "ringfence.algos.untrained",
    ),
    "Tasks": ("ringfence.datasets.registry", "ringfence.problem.features"),
    "Simulators": ("ringfence.envs", "ringfence.envs.pettingzoo"),
    "Statistics": ("ringfence.evaluation.statistics",),
    "Benchmark": ("ringfence.bench",),
    "Reports": ("ringfence.report.page", "ringfence.report.board_page", "ringfence.report.export"),
    "Errors and files": ("ringfence.errors", "ringfence.utils.files"),
}
# Of an algorithm's module its settings and its values: losses and updates are read in the source.
VALUES = ("ringfence.algos.", "ringfence.world.fit")

# --- tasks ---
# Of a simulator's tasks, in words; of another one the first line of its docstring.
ABOUT: dict[type, str] = {
    SimpleSpread: "Agents cover landmarks without touching one another; physics and rewards of OMAR's data "
    "([data](../data.md#simple-spread)).",
    SafeMuJoCo: "Agents share the joints of one robot that must not run faster than a limit: safety-gymnasium's Safe "
    "Multi-Agent MuJoCo ([data](../data.md#halfcheetah-and-ant)).",
    Crossing: "Discs with momentum find their way through one another, any number of them; each sees and decides for "
    "itself ([data](../data.md#crossing)).",
    System: "A system of the proving ground: small, and of a kind that the library was not made for. Costs alone "
    "say what is dangerous.",
}
FILMS = {
    "halfcheetah_2x3-good": ("rollout.gif", "Left a planner as it is, right one that keeps the limit"),
    "crossing-hasty": (
        "crossing.gif",
        "Sixty-four discs that learned from this data, left alone, right each guarded by itself",
    ),
}
SUITES = (
    "simple_spread",
    "mujoco",
    "guards",
    "guards-mujoco",
    "own-sight",
    "own-sight-mujoco",
    "crossing",
    "crossing-guards",
    "crossing-teams",
    "spread-teams",
)
NAMED = ("algorithm", "variant", "guard", "barrier", "execution", "agents")  # what a row of a table is called by
# Pages that stand outside docs/, and their places on the site.
OUTSIDE = {
    "README.md": "README.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "results/README.md": "results-folders.md",
}


def on_config(config):
    """The navigation's sections that are made here."""
    nav = {title: pages for entry in config["nav"] for title, pages in entry.items()}
    nav["Tutorials"] += [f"tutorials/{file.stem}.md" for file in NOTEBOOKS]
    nav["Reference"].insert(1, {"Options of every command": "options-of-commands.md"})
    tasks = [{group: [f"tasks/{t.name}.md" for t in found]} for group, found in groups().items()]
    nav["Reference"] += [{"Tasks": ["tasks/README.md", *tasks]}]
    nav["Reference"] += [{"Python": ["reference/README.md", *({title: _place(title)} for title in REFERENCE)]}]
    nav["Reference"] += [{"Changelog": "changelog.md"}, {"Contributing": "contributing.md"}]
    nav["Reference"] += [{"Results folders": "results-folders.md"}]
    return config


def on_page_markdown(markdown, page, config, files):
    """On the site a notebook is a page, and so are some files of the root."""
    markdown = re.sub(r"\]\(\.\./examples/(\w+)\.ipynb\)", r"](tutorials/\1.md)", markdown)
    for file, place in OUTSIDE.items():
        markdown = re.sub(rf"\]\(\.\./{re.escape(file)}(#[\w-]+)?\)", rf"]({place}\1)", markdown)
    return markdown


def on_files(files, config):
    """Adds the pages themselves."""
    from mkdocs.structure.files import File

    for place, text in pages().items():
        files.append(File.generated(config, place, content=text))
    return files


def pages() -> dict[str, str]:
    """Every page that no file of docs/ holds, by its place there."""
    made = {"tasks/README.md": _tasks(), "reference/README.md": _names()}
    made |= {f"tasks/{task.name}.md": task_page(task) for task in TASKS.values()}
    made |= {_place(title): _modules(title, modules) for title, modules in REFERENCE.items()}
    made |= {f"tutorials/{file.stem}.md": notebook(file) for file in NOTEBOOKS}
    made["options-of-commands.md"] = options_of_commands()
    return made | {place: from_root(ROOT / file) for file, place in OUTSIDE.items()}


def options_of_commands() -> str:
    """What every command prints of itself."""
    commands = [[name] for name in app.COMMANDS]
    commands += [[group, name] for group, (found, _) in app.GROUPS.items() for name in found]
    parts = [
        "# Options of every command",
        "As `ringfence COMMAND --help` prints them; [commands](commands.md) has examples.",
    ]
    for words in commands:
        printed = io.StringIO()
        wide = mock.patch.dict(os.environ, {"COLUMNS": str(WIDTH), "NO_COLOR": "1"})
        with wide, contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
            app.main([*words, "--help"])
        lines = [line.rstrip() for line in printed.getvalue().strip().splitlines()]
        lines = [line if line.startswith(" ") else textwrap.fill(line, WIDTH) for line in lines]
        parts += [f"## ringfence {' '.join(words)}", "\n".join(["```text", *lines, "```"])]
    return "\n\n".join(parts) + "\n"


def notebook(file: Path) -> str:
    """A notebook as a page: its words, its code, and what that printed and drew when it was run."""
    parts = []
    for cell in json.loads(file.read_text())["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source.replace("](../docs/", "](../"))
            continue
        parts.append(f"```python\n{source}\n```")
        for output in cell["outputs"]:
            if "text" in output:
                parts.append(f"```text\n{''.join(output['text']).rstrip()}\n```")
            if drawn := output.get("data", {}).get("image/png"):
                parts.append(f"![What the lines above draw](data:image/png;base64,{''.join(drawn).strip()})")
    parts.append(f"*This page is `examples/{file.name}`, to be run in a clone.*")
    return "\n\n".join(parts) + "\n"


def from_root(file: Path) -> str:
    """A page that stands outside docs/, its links as from within: those to pages of docs/ lead there, those to other
    files, which the site does not hold, become the file's name."""

    def turned(found: re.Match) -> str:
        words, target = found.groups()
        if "://" in target or target.startswith("#"):
            return found[0]
        path, hash, place = target.partition("#")
        there = Path(os.path.normpath(file.parent / path)).relative_to(ROOT)
        if str(there) in OUTSIDE:
            return f"[{words}]({OUTSIDE[str(there)]}{hash}{place})"
        if there.suffix == ".ipynb":
            return f"[{words}](tutorials/{there.stem}.md)"
        if there.parts[0] == "docs":
            return f"[{words}]({there.relative_to('docs')}{hash}{place})"
        return words if words.strip("`") == str(there) else f"{words} (`{there}`)"

    text = file.read_text().replace("](docs/images/", "](images/")
    return re.sub(r"(?<!!)\[([^\]]*)\]\(([^)\s]+)\)", turned, text)


def _place(title: str) -> str:
    return f"reference/{title.lower().replace(' ', '-')}.md"


def _names() -> str:
    """The first page of the reference: what `import ringfence` offers."""
    page = {module: _place(title) for title, modules in REFERENCE.items() for module in modules}
    lines = ["# Python reference", "", "What `import ringfence` offers, loaded on first use:", ""]
    lines += ["| name | lives in |", "|---|---|"]
    for name, where in ringfence._WHERE.items():
        module, _, other = where.partition(":")
        module = module if module in page else getattr(ringfence, name).__module__
        there = Path(page[module]).name
        lines.append(f"| [`ringfence.{name}`]({there}#{module}.{other or name}) | [`{module}`]({there}#{module}) |")
    lines += ["", "The rest, by what it is for. Axis letters and shapes: [`ringfence.types`](algorithms.md).", ""]
    lines += ["| page | modules |", "|---|---|"]
    for title, modules in REFERENCE.items():
        lines.append(f"| [{title}]({Path(_place(title)).name}) | " + ", ".join(f"`{m}`" for m in modules) + " |")
    return "\n".join(lines) + "\n"


def _modules(title: str, modules: tuple[str, ...]) -> str:
    parts = [f"# {title}"]
    for module in modules:
        directive = f"::: {module}"
        if module.startswith(VALUES):
            directive += "\n    options:\n      filters: ['^Config$', '^Settings$', '^[A-Z][A-Z0-9_]+$']"
        elif title == "Options":  # and no types of their fields
            directive += "\n    options:\n      filters: ['!^_', '!^(?!GuardOptions|PlanOptions)[A-Z][a-z]']"
        parts.append(directive)
    return "\n\n".join(parts) + "\n"


def _tasks() -> str:
    lines = [
        "# Tasks",
        "",
        "A task is a simulator, a definition of danger, a data tier, and the constants of its table.",
    ]
    lines += ["`ringfence tasks` prints this list; one page each, made from the code and the committed results.", ""]
    for group, found in groups().items():
        lines += [f"## {group}", "", "| task | danger | cost limit | return 0 to 1 |", "|---|---|---|---|"]
        for t in found:
            constants = f"{t.return_min:g} to {t.return_max:g}"
            lines.append(f"| [{t.name}]({t.name}.md) | {danger(t.hazard)} | {t.cost_limit:g} | {constants} |")
        lines.append("")
    return "\n".join(lines)


def groups() -> dict[str, list[Task]]:
    """Tasks by simulator and, where it has several, by limit."""
    found = defaultdict(list)
    for task in TASKS.values():
        words = " ".join(re.findall("[A-Z][a-z]+", type(task.env).__name__)).replace("System", "Proving ground")
        found[f"Robots, {task.protocol} limits" if task.protocol else words].append(task)
    return dict(found)


def danger(hazard: constraints.Hazard) -> str:
    """A hazard in words."""
    if isinstance(hazard, constraints.SpeedLimit):
        return f"a speed above {hazard.limit:g} m/s"
    if isinstance(hazard, constraints.Separation):
        return f"two centres nearer than {hazard.radius:g} m"
    if isinstance(hazard, constraints.CostColumn):
        return "what the cost column says"
    return str(hazard)


def task_page(task: Task) -> str:
    """What a task is, how its data are made and learned from, and what the committed results say of it."""
    env = task.env
    ends = "; a fall ends it" if env.terminates else ""
    facts = {
        "danger": danger(task.hazard),
        "as a formula": f"`{task.hazard}`",
        "cost limit l": f"{task.cost_limit:g} per episode",
        "normalised return": f"(r − {_signed(task.return_min)}) / ({task.return_max:g} − {_signed(task.return_min)})",
        "team": f"{env.n_agents} agents, each with {env.action_dim} action entries between {task.action_low:g} and "
        f"{task.action_high:g}",
        "each observes": f"{env.observation_dim} entries",
        "global state": f"{len(env.state_names)} entries",
        "episode": f"{env.episode_length} steps{ends}",
        "data tier": task.tier,
        "full data set": f"{task.transitions:,} steps of the team",
    }
    if task.published_return:
        mean, deviation = task.published_return
        spread = "" if deviation is None else f" ± {deviation:g}"
        facts["public data set"] = f"return {mean:g}{spread}"
    facts |= _logged(task)
    lines = [f"# {task.name}", "", ABOUT.get(type(env)) or env.__doc__.splitlines()[0], ""]
    if task.name in FILMS:
        picture, words = FILMS[task.name]
        lines += [f"![{words}](../images/{picture})", "", f"*{words}.*", ""]
    lines += ["| what | here |", "|---|---|", *(f"| {k} | {v} |" for k, v in facts.items()), ""]
    lines += ["## Make, learn, play", "", *_commands(task), "", *_rows(task)]
    return "\n".join(lines) + "\n"


def _signed(x: float) -> str:
    return f"({x:g})".replace("-", "−") if x < 0 else f"{x:g}"


def _commands(task: Task) -> list[str]:
    guard = "adapt" if task.protocol else "shield"  # a limit that may be exceeded sometimes, or contact
    commands = {
        f"ringfence data make {task.name}": "the data set, seeded and cached",
        f"ringfence fit {task.name}": "its World; prints the card",
        f"ringfence train bc {task.name}": "a policy; prints its run folder",
        f"ringfence eval runs/{task.name} --guard {guard}": "played on the test resets under a guard",
        f"ringfence report runs/{task.name}": "report.html",
    }
    wide = max(map(len, commands)) + 3
    return ["```text", *(f"{command:{wide}}# {words}" for command, words in commands.items()), "```"]


def _logged(task: Task) -> dict[str, str]:
    """What results/data.csv tells of the full data set."""
    with open(RESULTS / "data.csv") as file:
        row = next((r for r in csv.DictReader(file) if r["task"] == task.name), None)
    if row is None:
        return {}
    mean, spread, low, high = (float(row[f"return_{k}"]) for k in ("mean", "std", "min", "max"))
    found = {
        "its episodes": f"{int(row['episodes']):,}, of {float(row['steps_mean']):.0f} steps in the mean",
        "their return": f"{mean:.2f} ± {spread:.2f}, from {low:.2f} to {high:.2f}",
        "their cost": f"{float(row['cost_mean']):.3g} per episode; {100 * float(row['unsafe']):.1f} % of the episodes "
        "have any",
    }
    if row["return_ceiling"]:
        found["return ceiling"] = (
            f"{float(row['return_ceiling']):.0f} within the limit, unless faster than all this data"
        )
    return found


def _rows(task: Task) -> list[str]:
    """The committed results, a table for each suite that played the task."""
    lines = []
    for suite in SUITES:
        if not (RESULTS / suite / "table.csv").exists():  # not played in full yet
            continue
        found = defaultdict(list)
        for row in csv.DictReader((RESULTS / suite / "table.csv").open(newline="")):
            if row["task"] == task.name:
                found[tuple(row[name] for name in NAMED)].append(row)
        if not found:
            continue
        lines += [f"### `results/{suite}`", ""]
        heads = ["method", "guard", "return", "normalised", "cost", "cost_safe_start", "violation_rate"]
        heads += ["fell"] * task.env.terminates + ["seeds"]
        lines += ["| " + " | ".join(heads) + " |", "|---|---|" + "---:|" * (len(heads) - 2)]
        lines += [*(_row(names, rows, task.env.terminates) for names, rows in found.items()), ""]
    if not lines:
        return []
    said = (
        "Means over seeds, as `table.csv` has them; one seed compares no methods. Intervals, ranks and what the rows "
    )
    said += "say: [results](../results.md)."
    return ["## Results", "", said, "", *lines]


def _row(names: tuple[str, ...], rows: list[dict], falls: bool) -> str:
    algorithm, variant, guard, barrier, execution, agents = names
    reference = variant == "reference"
    who = algorithm if reference else f"`{algorithm}` `{variant}`"
    who += f", {agents} agents" if agents else ""
    alone = ", decentralized" if execution == "decentralized" else ""
    how = "–" if guard == "none" else f"{guard}, {barrier}{alone}"
    cells = [f"{_mean(rows, key):.2f}" for key in ("return_mean", "return_norm")]
    cells += [f"{_mean(rows, key):.3g}" for key in ("cost_mean", "cost_safe_start")]
    rates = ["violation_rate", *["termination_rate"] * falls]
    cells += [f"{100 * _mean(rows, key):.3g} %" for key in rates]  # 1 of 5000 must not read as none
    return f"| {who} | {how} | " + " | ".join(cells) + f" | {'' if reference else len(rows)} |"


def _mean(rows: list[dict], key: str) -> float:
    """Of the seeds that tell it; older rows may not."""
    values = [float(row[key]) for row in rows if row[key]]
    return sum(values) / len(values) if values else float("nan")
