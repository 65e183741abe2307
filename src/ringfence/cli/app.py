"""The command line: parses, calls, prints. Everything here can be done from Python with the same words."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Column, Table

from ringfence.cli import data as data_commands
from ringfence.cli.playing import AS_IT_IS, Assignments, How, assignments
from ringfence.cli.renamed import rewritten
from ringfence.errors import UserError, whole_number
from ringfence.utils import interrupts
from ringfence.utils.escape import terminal
from ringfence.utils.files import writable

out = Console(highlight=False)
Positional = tyro.conf.Positional
# --tasks a b and --tasks a --tasks b mean the same.
Names = Annotated[list[list[str]], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="NAME")]


def tasks() -> None:
    """List the tasks with their hazards, limits and constants."""
    from ringfence.datasets import registry
    from ringfence.problem import constraints

    def danger(h: constraints.Hazard) -> str:
        if isinstance(h, constraints.SpeedLimit):
            return f"> {h.limit:g} m/s"
        return f"< {h.radius:g} m" if isinstance(h, constraints.Separation) else type(h).__name__

    names = ("task", "danger", "limit l", "r_min to r_max")
    table = Table(*(Column(n, no_wrap=True) for n in names), box=box.SIMPLE)
    for t in registry.TASKS.values():
        constants = f"{t.return_min:g} to {t.return_max:g}"
        table.add_row(terminal(t.name), danger(t.hazard), f"{t.cost_limit:g}", constants)
    out.print(table)


def train(
    algorithm: Positional[str],
    data: Positional[str],
    seeds: int = 1,
    first_seed: int = 0,
    preset: str | None = None,
    set: Assignments = [],  # noqa: B006 (tyro reads it, nobody writes it)
    out: Path = Path("runs"),
    together: bool = False,
    tensorboard: bool = False,
) -> None:
    """Train an algorithm on a task or on a store of your own; an interrupted run is resumed by the same command.

    Args:
        algorithm: icbf, madiff, mpc, bc, bc-safe, bc-best, bc-return, ma-td3bc, ma-td3bc-lag, omar, ma-cql or fisor.
        data: a task (its data set is regenerated if need be) or a store's file.
        seeds: how many, starting with first_seed.
        first_seed: the first one.
        preset: named differences from the defaults, e.g. split or paper; by default that of the data tier, if any.
        set: config fields, e.g. --set barrier_weight=0.5 steps=8000.
        out: folder of runs.
        together: train all seeds in one program.
        tensorboard: write TensorBoard logs, too.
    """
    from ringfence.training import loop

    changes = assignments(set)
    whole_number("seeds", seeds, 1, 10_000)
    _early(algorithm, preset, changes)
    runs = loop.train(
        algorithm,
        _store(data),
        preset=preset,
        seeds=tuple(range(first_seed, first_seed + seeds)),
        out=out,
        changes=changes,
        together=together,
        tensorboard=tensorboard,
    )
    for run in runs:
        print(run.path)


def fit(
    data: Positional[str],
    seed: int = 0,
    sight: Literal["all", "own"] | None = None,
    set: Assignments = [],  # noqa: B006
    out_file: Annotated[Path | None, tyro.conf.arg(name="out")] = None,
    report: Path | None = None,
) -> None:
    """Fit the World of a task's data or of a store, and print its card: what can be foreseen, how well, where not.

    Cached by content: the same data, settings and seed are fitted once, and an interrupted fit goes on.

    Args:
        data: a task (its data set is regenerated if need be) or a store's file.
        seed: of the fit, and of which episodes are held out.
        sight: all for guards that see the team (default), own for agents that each guard their own action by their
            own view (always so of agents who are alike).
        set: settings of the World, e.g. --set barrier_updates=3000 labels=formula.
        out_file: keep the World in a file, too, for `ringfence eval --world`.
        report: write the card as an HTML page: are these logs enough?
    """
    from ringfence import world
    from ringfence.training import worlds

    report = None if report is None else writable(report)
    store = _store(data)
    made = worlds.fit(store, seed=seed, sight=sight, quiet=False, **assignments(set))
    out.print(str(made.card), soft_wrap=True, markup=False)
    if out_file is not None:
        print(world.save(made, out_file))
    if report is not None:
        from ringfence.datasets.audit import audit
        from ringfence.report.ope_page import build_ope

        print(build_ope(report, made.card, audit(store)))


def evaluate(
    runs: Positional[list[Path]],
    episodes: int = 200,
    split: Literal["test", "validation"] = "test",
    record: int = 4,
    step: int | None = None,
    video: bool = False,
    playing: How = AS_IT_IS,
) -> None:
    """Play a trained policy on the protocol's resets, as it is or under guard; all of it are evaluation-time choices.

    Args:
        runs: run folders, or folders that hold some.
        episodes: at least 200 for a table.
        split: test resets, or validation resets for choosing settings.
        record: episodes kept for the animation of the report.
        step: of the checkpoint that is played; the last one by default.
        video: make a GIF of the first episode (robots).
    """
    from ringfence.evaluation.evaluate import evaluate as run_evaluation

    given = playing.arguments()
    names = (
        "run",
        "variant",
        "return",
        "cost",
        "safe starts",
        "violations/episode (95 % ≤)",
        "return norm",
        "cost norm",
    )
    table = Table(*names, "ended early")
    if not runs:
        raise UserError("No run was given; name run folders that `ringfence train` made.")
    found = _runs(runs)
    if video:
        from ringfence.loading.resolve import load_job
        from ringfence.report.video import check, film

        for run in {run.config["task"]: run for run in found}.values():
            check(load_job(run).task)
        record = record or 1
    given |= {"episodes": episodes, "split": split, "record": record, "step": step, "quiet": False}
    refused: dict[str, list] = {}  # what several runs are refused for is said once
    for run in found:
        try:
            r = run_evaluation(run, **given)
        except UserError as error:
            refused.setdefault(str(error), []).append(run)
            continue
        if video:
            try:
                print(film(run, r["variant"]))
            except UserError as error:
                refused.setdefault(str(error), []).append(run)
        table.add_row(
            terminal(run.path),
            terminal(r["variant"]),
            f"{r['return_mean']:.1f}",
            f"{r['cost_mean']:.3f}",
            f"{r['cost_safe_start']:.3f}",
            f"{r['violation_rate']:.3f} (≤ {r['violation_upper']:.3f})",
            f"{r['return_norm']:.3f}" if _of_usual_size(r) else "–",  # constants are those of the logs' team
            f"{r['cost_norm']:.3f}",
            f"{100 * r['termination_rate']:.0f} %",
        )
    _told(table, refused, len(found))


def _of_usual_size(r: dict) -> bool:
    """Whether as many agents played as a task's constants are of."""
    from ringfence.datasets.registry import TASKS

    task = TASKS.get(r["task"])
    return task is None or r["agents"] == task.env.n_agents


def play(
    runs: Positional[list[Path]],
    env: str,
    episodes: int = 100,
    split: Literal["test", "validation"] = "test",
    at_once: int = 16,
    playing: How = AS_IT_IS,
) -> None:
    """Play a trained policy in a simulator of your own, a PettingZoo ParallelEnv, and keep the result for reports.

    Args:
        runs: run folders, or folders that hold some.
        env: what makes the simulator, as FILE.py:NAME or MODULE:NAME, e.g. examples/yard.py:Yard. It is run.
        episodes: a bound of 1 % takes 300 without an accident.
        split: test resets, or validation resets for choosing settings.
        at_once: simulators that are stepped side by side.
    """
    from ringfence.evaluation.play import play as run_play
    from ringfence.evaluation.simulators import simulator

    given = playing.arguments()
    if not runs:
        raise UserError("No run was given; name run folders that `ringfence train` made.")
    found, make = _runs(runs), simulator(env)
    table, refused = Table("run", "guard", "return", "cost", "violations/episode (95 % ≤)", "infeasible"), {}
    given |= {"episodes": episodes, "split": split, "at_once": at_once, "keep": True, "quiet": False}
    for run in found:
        try:
            r = run_play(run, make, **given)
        except UserError as error:
            refused.setdefault(str(error), []).append(run)
            continue
        each = [
            f"{terminal(name)} {c['cost_mean']:.3f}" + (f" of {c['limit']:g}" if "limit" in c else "")
            for name, c in r.get("constraints", {}).items()
        ]
        table.add_row(
            terminal(run.path),
            r["guard"],
            f"{r['return_mean']:.4g} ({r['return_interval'][0]:.4g} to {r['return_interval'][1]:.4g})",
            "\n".join([f"{r['cost_mean']:.3f}", *each]),
            f"{r['violation_rate']:.3f} (≤ {r['violation_upper']:.3f})",
            f"{100 * r['infeasible_rate']:.2g} %" if "infeasible_rate" in r else "",
        )
    _told(table, refused, len(found))


def _told(table: Table, refused: dict[str, list], many: int) -> None:
    """What was measured, and what runs were refused for; the process ends where any was."""
    if table.row_count:
        out.print(table)
    for message, those in refused.items():
        unsaid = [str(run.path) for run in those if str(run.path) not in message]
        _complain(", ".join(unsaid) + ": " * bool(unsaid) + message if many > 1 else message)
    if refused:
        sys.exit(2)


def get(
    names: Positional[tuple[str, ...]] = (), out_folder: Annotated[Path, tyro.conf.arg(name="out")] = Path("runs")
) -> None:
    """Trained policies that come with the package, to be evaluated, filmed and played at once; without a name, which.

    Args:
        names: e.g. crossing-hasty/icbf.
        out_folder: where their run folders go.
    """
    from ringfence.deploy import zoo

    if not names:
        print(*zoo.names(), sep="\n")
    for run in [zoo.get(name, out_folder) for name in names]:
        print(run.path)


def export(
    run: Positional[Path],
    out_file: Annotated[Path, tyro.conf.arg(name="out")],
    format: Literal["onnx", "stablehlo"] = "onnx",
    step: int | None = None,
    playing: How = AS_IT_IS,
) -> None:
    """Write a trained policy, guard included, as one file that needs neither Python nor this library.

    Args:
        run: a run folder.
        out_file: the file to write.
        format: onnx, for onnxruntime and the like, needs the extra `ringfence[export]`; stablehlo needs nothing.
        step: of the checkpoint that is written; the last one by default.
    """
    given = playing.arguments()
    found = _runs([run])
    if len(found) > 1:
        raise UserError(f"'{run}' holds {len(found)} runs, and a file is of one; name it, e.g. {found[0].path}.")
    from ringfence.deploy.export import export as write

    print(write(found[0], out_file, format, step, **given))


def ope(
    run: Positional[Path],
    data: Positional[str],
    states: int = 3000,
    transitions: int = 20_000,
    updates: int = 3000,
    seed: int = 0,
    report: Path | None = None,
    playing: How = AS_IT_IS,
) -> None:
    """Evaluate a policy by logs alone, without a simulator: what it would do there, where that leads, what it is worth.

    Args:
        run: folder of a trained run.
        data: a store of its task, best one that it was not trained on (or a task, whose data set is regenerated).
        states: logged states that it is asked in.
        transitions: logged steps that fitted Q evaluation learns from.
        updates: of the evaluation.
        seed: of what is drawn, and of the World that evaluates (seed + 1), which is fitted to `data`.
        report: write an HTML page.
    """
    from ringfence.datasets.audit import audit
    from ringfence.evaluation import ope as evaluation
    from ringfence.loading.spec import PolicySpec
    from ringfence.report.ope_page import build_ope
    from ringfence.training import worlds

    given = playing.arguments()
    report = None if report is None else writable(report)
    found = _runs([run])[0]
    store = _store(data)
    evaluation.check(found, store)
    world = worlds.fit(store, seed=seed + 1, sight=PolicySpec.of(found, **given).sight, quiet=False)
    sizes = {"states": states, "transitions": transitions, "updates": updates, "seed": seed}
    result = evaluation.ope(found, store, evaluation_world=world, quiet=False, **sizes, **given)
    for line in result.summary():
        out.print(line, soft_wrap=True, markup=False)
    if report is not None:
        print(build_ope(report, world.card, audit(store), result))


def report(
    runs: Positional[list[Path]], out_file: Annotated[Path, tyro.conf.arg(name="out")] = Path("report.html")
) -> None:
    """One self-contained HTML page from evaluated runs, or the leaderboard of a benchmark's results folder.

    Args:
        runs: run folders, or folders that hold some; or one results folder, which has a bench.json.
        out_file: the page.
    """
    from ringfence.report import build_board, build_report
    from ringfence.report.board import is_board

    boards = [path for path in runs if is_board(path)]
    if boards and len(runs) > 1:
        raise UserError(f"'{boards[0]}' is a results folder, and a page shows one of them; give it alone.")
    print(build_board(boards[0], out_file) if boards else build_report(_runs(runs), out_file))


def doctor() -> None:
    """Versions, devices, what is missing and how to get it."""
    import importlib.metadata as metadata

    from ringfence.utils.cache import cache_dir
    from ringfence.utils.environment import environment

    told = environment()
    for name in ("ringfence", "python", "system", "processor", "cores", "git"):
        out.print(f"{name:12} {escape(str(told[name]))}")
    for name, version in told["packages"].items():
        out.print(f"{name:12} {version}")
    out.print(f"{'devices':12} {', '.join(told['devices'])}")
    out.print(f"{'cache':12} {escape(str(cache_dir()))}", soft_wrap=True)
    from ringfence.report import video

    try:
        out.print(f"{'films':12} drawn by {video.backend()}")
    except UserError as error:
        out.print(f"{'films':12} [yellow]missing[/], {escape(str(error))}", soft_wrap=True)
    for package, extra, use in (
        ("tensorboardX", "tensorboard", "TensorBoard logs"),
        ("tensorstore", "vault", "OG-MARL's Vaults"),
        ("minari", "minari", "Minari's data sets by their names"),
        ("ray", "ray", "benchmarks on a cluster"),
        ("jax2onnx", "export", "policies as ONNX files"),
        ("mpe2", "test", "parity tests"),
    ):
        try:
            out.print(f"{package:12} {metadata.version(package)}")
        except metadata.PackageNotFoundError:
            out.print(f"{package:12} [yellow]missing[/], for {use}: pip install 'ringfence\\[{extra}]'")


def demo(
    out_dir: Annotated[Path, tyro.conf.arg(name="out")] = Path("demo"), tier: str = "expert", quick: bool = False
) -> None:
    """The whole job on Simple Spread: data, training without and with barrier, evaluation, report.

    Args:
        out_dir: folder for runs and the page.
        tier: expert, medium, medium-replay or random.
        quick: a smoke test of a minute or two, with numbers that mean nothing.
    """
    from ringfence.cli.demo import run

    run(out_dir, tier, quick)


def bench(
    suite: Positional[str],
    seeds: int = 5,
    episodes: int | None = None,
    out_dir: Annotated[Path | None, tyro.conf.arg(name="out")] = None,
    tasks: Names = [],  # noqa: B006
    algorithms: Names = [],  # noqa: B006
    steps: int | None = None,
    engine: Literal["local", "ray"] = "local",
    workers: int | None = None,
    threads: int = 1,
    memory: float | None = None,
    address: str | None = None,
) -> None:
    """Make the grid task x algorithm x seed; the same command goes on where it was left, and repeats nothing.

    Of a results folder: `ringfence bench status FOLDER`, `bench results FOLDER`, `bench export FOLDER`; of two,
    `bench paper-table`.

    Args:
        suite: simple_spread, mujoco, or paper: the paper's 13 tasks and three methods, from those two suites. Under
            guard: guards, guards-mujoco, crossing, crossing-guards, all four of them as attribution; own-sight,
            own-sight-mujoco, crossing-teams, spread-teams.
        seeds: per algorithm and task.
        episodes: test episodes per run; the suite's number by default.
        out_dir: folder of results, results/SUITE by default; of paper and attribution, the folder that holds theirs.
        tasks: these alone.
        algorithms: these alone, as algorithm or algorithm:preset.
        steps: updates of every algorithm, for a quick trial.
        engine: processes on this machine, or Ray tasks.
        workers: local processes; one per `threads` cores by default.
        threads: per worker; cores that Ray sets aside per task.
        memory: GiB that a local process may hold before it is stopped.
        address: of the Ray cluster, e.g. auto; without it a local one is started.
    """
    from ringfence.bench import COLLECTIONS, collected, make_grid, make_grids, pack, paper

    only_tasks, only = sum(tasks, []), sum(algorithms, [])
    if steps is not None and out_dir is None:
        raise UserError(
            f"--steps {steps} makes other rows than the suite's own; give a folder of their own with --out."
        )
    root, sizes = out_dir or Path("results"), dict(seeds=seeds, episodes=episodes, steps=steps)
    if suite == "paper":
        grids = paper.grids(root, only_tasks, only, **sizes)
    elif suite in COLLECTIONS:
        grids = make_grids(collected(suite, only_tasks), root, only, **sizes)
    else:
        root = out_dir or root / suite
        grids = [make_grid(suite, root, only_tasks=only_tasks, only=only, **sizes)]
    for grid in grids:  # what is wrong with the last one is said before the first begins
        grid.check()
    complete, idle = True, True
    for grid in grids:
        idle = idle and not grid.groups()
        try:
            counts = _run_grid(grid, engine, workers, threads, memory, address)
        finally:
            pack(grid.out)
        out.print(", ".join(f"{n} {state}" for state, n in counts.items()))
        if counts["done"] and suite != "paper":
            bench_results(grid.out)
        if lacking := grid.references():
            _complain(f"The reference rows of {', '.join(lacking)} could not be made; see above.")
        if counts["failed"] or counts["to do"]:
            bench_status(grid.out)
        complete = complete and not (lacking or counts["failed"] or counts["to do"])
    if suite == "paper":
        bench_paper(root)
    if idle:
        out.print(
            f"All cells were there already, nothing was made; to make them yourself, give another --out than {root}."
        )
    if not complete:
        sys.exit(1)


def _run_grid(grid, engine: str, workers: int | None, threads: int, memory: float | None, address: str | None) -> dict:
    """Cells by state after the run."""
    if engine == "ray":
        for name, value in (("workers", workers), ("memory", memory)):
            if value is not None:
                raise UserError(f"--{name} is about local processes, Ray divides its cluster itself; leave it out.")
        from ringfence.bench.cluster import run_ray

        return run_ray(grid, address=address, threads=threads)
    from ringfence.bench import run_local

    return run_local(grid, workers=workers, threads=threads, memory=memory)


def bench_status(folder: Positional[Path]) -> None:
    """What a results folder holds: finished cells, and failed ones with the reason."""
    from ringfence.bench.cells import statuses

    table = Table("task", "run", "state", "train s", "eval s", "why")
    for s in statuses(folder):
        seconds = [f"{s[k]:.0f}" if k in s else "" for k in ("train_seconds", "eval_seconds")]
        table.add_row(*map(terminal, (s["task"], s["run"], s["state"], *seconds, s.get("error", ""))))
    out.print(table)


def bench_results(folder: Positional[Path]) -> None:
    """Rank the methods of every task and write FOLDER/table.csv."""
    from ringfence.bench import write_csv
    from ringfence.report import board, standings

    for task, rows in standings.standings(board.read(folder)).items():
        table = Table(
            "", "method", "seeds", "return", "norm", "cost", "safe starts", "unsafe (95 % ≤)", title=terminal(task)
        )
        for r in rows:
            low, high = r.returns_interval
            table.add_row(
                str(r.rank),
                terminal(r.label),
                str(len(r.seeds)),
                f"{r.returns:.1f} [{low:.1f}, {high:.1f}]",
                f"{r.returns_norm:.3f}",
                f"{r.cost:.3f}" + ("" if r.safe else " over"),
                f"{r.cost_safe_start:.4f}",
                f"{r.violation_rate:.3f} (≤ {r.violation_upper:.3f})",
            )
        out.print(table)
    print(write_csv(folder))


def bench_paper(folder: Positional[Path] = Path("results")) -> None:
    """The paper's 13 tasks, printed values beside ours, from FOLDER/simple_spread and FOLDER/mujoco.

    Writes FOLDER/paper.csv. The printed values are on other data.
    """
    from ringfence.bench import paper

    lines = paper.lines(folder / name for name in paper.FOLDERS)
    table = Table(Column("reward/cost", no_wrap=True), box=box.SIMPLE, padding=(0, 0, 0, 1))
    for method in paper.OURS:
        for whose in (f"{method}\npaper", "\nours"):
            table.add_column(whose, justify="right", no_wrap=True)
    for task, (name, _) in paper.PRINTED.items():
        cells = []
        for x in (x for x in lines if x.task == task):
            cells += [f"{x.printed[0]:.2f}/{x.printed[2]:.2f}", paper.brief(x).replace(" / ", "/")]
        table.add_row(name, *cells)
    Console(highlight=False, width=max(out.width, 100)).print(table)
    print(paper.write(lines, folder / "paper.csv"))


def bench_export(
    folder: Positional[Path],
    format: Literal["csv", "markdown", "markdown-short", "latex"] = "markdown",
    out_file: Annotated[Path | None, tyro.conf.arg(name="out")] = None,
) -> None:
    """Write the ranked tables of a results folder.

    Args:
        folder: the --out of `ringfence bench`.
        format: csv, markdown, markdown-short (return and cost alone) or latex (booktabs).
        out_file: where to; FOLDER/ranked.EXT by default.
    """
    from ringfence.report import export_board

    kind = {"csv": "csv", "latex": "tex"}.get(format, "md")
    print(export_board(folder, format, out_file or folder / f"ranked.{kind}"))


BENCH = {"status": bench_status, "results": bench_results, "paper-table": bench_paper, "export": bench_export}
COMMANDS = {
    "tasks": tasks,
    "fit": fit,
    "train": train,
    "eval": evaluate,
    "play": play,
    "get": get,
    "export": export,
    "bench": bench,
    "ope": ope,
    "report": report,
    "demo": demo,
    "doctor": doctor,
}


def main(arguments: list[str] | None = None) -> None:
    arguments = rewritten(sys.argv[1:] if arguments is None else arguments)
    interrupts.listen()
    for stream in (sys.stdout, sys.stderr):  # a terminal of few letters shows a question mark for the others
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")
    try:
        if arguments[:1] == ["data"]:
            tyro.extras.subcommand_cli_from_dict(
                data_commands.COMMANDS,
                prog="ringfence data",
                description="Episode stores: make, import, inspect.",
                args=arguments[1:],
            )
        elif arguments[:1] == ["bench"] and arguments[1:2] and arguments[1] in BENCH:
            tyro.extras.subcommand_cli_from_dict(
                BENCH, prog="ringfence bench", description="Look into a results folder.", args=arguments[1:]
            )
        else:
            tyro.extras.subcommand_cli_from_dict(
                COMMANDS | {"data": lambda: main(["data", "--help"])},
                prog="ringfence",
                description="Safe offline multi-agent reinforcement learning.",
                args=arguments,
            )
    except UserError as error:
        _complain(str(error))
        sys.exit(2)
    except KeyboardInterrupt:
        print("interrupted; the same command goes on from the last checkpoint", file=sys.stderr)
        sys.exit(130)
    except BrokenPipeError:
        sys.exit(1)
    except OSError as error:  # of a path that nobody looked at before
        what = f"'{error.filename}': {error.strerror}" if error.filename else str(error)
        _complain(f"{what}; check that the path is what you mean and that you may use it.")
        sys.exit(2)


def _complain(message: str) -> None:
    Console(stderr=True, highlight=False).print(f"[red]error:[/] {escape(message)}", soft_wrap=True)


def _early(algorithm: str, preset: str | None, changes: dict[str, str]) -> None:
    """Refuse bad names before a data set is made for them."""
    from ringfence import algos
    from ringfence.errors import unknown
    from ringfence.utils.config import build_config

    a = algos.get(algorithm)
    if preset is not None and preset not in a.presets:
        raise unknown(f"preset of {a.name}", preset, a.presets)
    build_config(a.Config, changes, a.name)


def _store(data: str):
    from ringfence.datasets import registry
    from ringfence.datasets.make import make
    from ringfence.logs.store import EpisodeStore

    if Path(data).suffix in (".h5", ".hdf5", ".hdf") or Path(data).is_file() or len(Path(data).parts) > 1:
        return EpisodeStore.load(data)
    return make(registry.get(data), must_keep=False)[0]


def _runs(paths: list[Path]) -> list:
    from ringfence.training.runs import Run

    found = []
    for path in paths:
        if not path.exists():
            raise UserError(f"'{path}' does not exist; give a folder that `ringfence train` made.")
        files = [path / "config.json"] if (path / "config.json").exists() else sorted(path.rglob("config.json"))
        files = [f for f in files if not any(p.startswith(".") for p in f.relative_to(path).parts)]  # half-copied
        if not files:
            raise UserError(f"'{path}' holds no run; give a folder that `ringfence train` made.")
        found += [Run(f.parent) for f in files]
    return found


if __name__ == "__main__":
    main()
