"""The command line: parses, calls, prints. Everything here can be done from Python with the same words."""

from __future__ import annotations

import io
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn

import tyro
from rich import box
from rich.table import Column, Table
from rich.text import Text

from ringfence.cli import bench as bench_commands
from ringfence.cli import data as data_commands
from ringfence.cli import log as log_commands
from ringfence.cli.first import demonstrate, doctor
from ringfence.cli.shared import (
    AS_IT_IS,
    AS_LOGGED,
    NO_FAULTS,
    Assignments,
    How,
    Playing,
    Refusals,
    Replayed,
    Wrong,
    assignments,
    complain,
    console,
    page_at,
    plain_warnings,
)
from ringfence.errors import Interrupted, UserError, one_of, whole_number
from ringfence.utils import interrupts
from ringfence.utils.files import writable
from ringfence.utils.text import lines, terminal

if TYPE_CHECKING:
    from ringfence.logs.store import EpisodeStore
    from ringfence.training.runs import Run
    from ringfence.utils.schemas import Outcomes

out = console()
OFTEN = 0.05  # share of steps without an action that keeps the margin, from which on it is said
Positional = tyro.conf.Positional
# --tasks a b and --tasks a --tasks b mean the same.
Names = Annotated[list[list[str]], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="NAME")]


def tasks() -> None:
    """List the tasks with their constraints, limits and constants."""
    from ringfence.datasets import registry
    from ringfence.problem import constraints

    def danger(h: constraints.Hazard) -> str:
        if isinstance(h, constraints.SpeedLimit):
            return f"> {h.limit:g} m/s"
        return f"< {h.radius:g} m" if isinstance(h, constraints.Separation) else type(h).__name__

    names = ("task", "danger", "limit l", "r_min to r_max")
    table = Table(*(Column(n, no_wrap=True) for n in names), box=box.SIMPLE, pad_edge=False)
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
    vmap_seeds: bool = False,
    tensorboard: bool = False,
) -> None:
    """Train an algorithm on a task or on a store of your own; an interrupted run is resumed by the same command.

    Args:
        algorithm: icbf, madiff, flow, mpc, bc, bc-safe, bc-best, bc-return, ma-td3bc, ma-td3bc-lag,
            omar, ma-cql or fisor.
        data: a task (its data set is regenerated if need be) or a store's file.
        seeds: how many, starting with first_seed.
        first_seed: the first one.
        preset: named differences from the defaults, e.g. split or paper; by default that of the data tier, if any.
        set: config fields, e.g. --set barrier_weight=0.5 num_updates=8000.
        out: folder of runs.
        vmap_seeds: train all seeds in one program.
        tensorboard: write TensorBoard logs, too.
    """
    from ringfence import algos
    from ringfence.training import loop

    changes = assignments(set)
    whole_number("seeds", seeds, 1, 10_000)
    # Refuse bad names before a data set is made for them.
    chosen = algos.get(algorithm)
    named = preset or chosen.preset_for(())
    one_of(f"preset of {chosen.name}", named, chosen.presets)
    algos.configured(chosen, named, changes)
    runs = loop.train(
        algorithm,
        _store(data),
        preset=preset,
        seeds=tuple(range(first_seed, first_seed + seeds)),
        out=out,
        changes=changes,
        vmap_seeds=vmap_seeds,
        tensorboard=tensorboard,
    )
    for run in runs:
        print(run.path)


UNFIT = 3  # exit status of a fit whose World is unfit to guard by


def fit(
    data: Positional[str],
    seed: int | None = None,
    execution: Literal["centralized", "decentralized"] | None = None,
    set: Assignments = [],  # noqa: B006
    out_file: Annotated[Path | None, tyro.conf.arg(name="out")] = None,
    report: Path | None = None,
) -> None:
    """Fit the World of a task's data, of a store or of a run, and print its card: what can be predicted, how well,
    where not. The last line is the verdict; exit status 3 says that it is unfit to guard by.

    Cached by content: the same data, settings and seed are fitted once, and an interrupted fit goes on with the part
    that it was at. The World that guards a run has its seed and its task's settings, and is kept in its folder.

    Args:
        data: a task (its data set is regenerated if need be), a store's file, or the folder of a run of such a task.
        seed: of the fit, and of which episodes are held out; 0 by default.
        execution: centralized for guards that see the team (default), decentralized for agents that each guard their
            own action by their own view (always so of homogeneous agents).
        set: settings of the World, e.g. --set barrier_updates=3000 labels=formula.
        out_file: keep the World in a file, too, for `ringfence eval --world`.
        report: write the card as an HTML page: are these logs enough?
    """
    from ringfence import world
    from ringfence.datasets import registry
    from ringfence.training import worlds

    report = page_at(report)
    out_file = None if out_file is None else writable(out_file)
    settings: dict[str, Any] = dict(assignments(set))
    store = None
    if data not in registry.TASKS and Path(data).is_dir():
        for name, value in {"seed": seed, "set": settings or None, "report": report}.items():
            if value is not None:
                raise UserError(
                    f"--{name} is for data, and '{data}' is a run's folder; leave it out, or give its data."
                )
        made = worlds.fit_run(_one_run(Path(data)), execution=execution, quiet=False)
    else:
        seed = worlds.check(seed or 0, settings)
        store = _store(data)
        made = worlds.fit(store, seed=seed, execution=execution, quiet=False, **settings)
    out.print(lines(str(made.card)), soft_wrap=True)
    if out_file is not None:
        print(world.save(made, out_file))
    if report is not None and store is not None:
        from ringfence.datasets.audit import audit
        from ringfence.report import build_ope

        print(build_ope(report, made.card, audit(store)))
    if made.card.verdict is not None and made.card.verdict.word == "unfit":
        raise SystemExit(UNFIT)


def evaluate(
    runs: Positional[list[Path]],
    episodes: int = 200,
    split: Literal["test", "validation"] = "test",
    num_recorded: int = 4,
    checkpoint: int | None = None,
    video: bool = False,
    playing: How = AS_IT_IS,
) -> None:
    """Play a trained policy on the protocol's resets, as it is or under guard; all of it are evaluation-time choices.

    Args:
        runs: run folders, or folders that hold some.
        episodes: at least 200 for a table.
        split: test resets, or validation resets for choosing settings.
        num_recorded: episodes kept for the animation of the report.
        checkpoint: step of the one that is played; the last one by default.
        video: make a GIF of the first episode (robots).
    """
    from ringfence.evaluation.evaluate import evaluate as run_evaluation
    from ringfence.training.worlds import with_world

    given = playing.arguments()
    found = _some_runs(runs)
    if video:
        from ringfence.loading.resolve import load_job
        from ringfence.report.video import check

        for run in {run.config["task"]: run for run in found}.values():
            check(load_job(run).task)
        num_recorded = num_recorded or 1
    given |= {"episodes": episodes, "split": split, "num_recorded": num_recorded, "checkpoint": checkpoint}
    names = ("run", "variant", "return", "cost", "safe starts", "unsafe episodes (95 % ≤)", "return norm", "cost norm")
    table = Table(*names, "ended early")
    doubts: list[str] = []
    refusals = Refusals()
    for run in found:
        with refusals.of(run):
            result = with_world(run_evaluation, run, quiet=False, **given)
            table.add_row(*_evaluated(run, result))
            share = result.get("infeasible_rate", 0.0)
            if share > OFTEN:  # it has no column
                doubts.append(
                    f"{result['variant']}: in {100 * share:.2g} % of the steps the guard found no action that keeps "
                    "its margin; it took the best one that it found, which may be unsafe."
                )
            if video:
                from ringfence.report.video import film

                print(film(run, result["variant"]))
    _say(table, refusals, len(found), doubts)


def _evaluated(run: Run, result: dict[str, Any]) -> list[Text | str]:
    """A result's row of the table."""
    from ringfence.datasets.registry import TASKS

    task = TASKS.get(result["task"])
    usual_size = task is None or result["agents"] == task.simulator.n_agents
    return [
        terminal(run.path),
        terminal(result["variant"]),
        f"{result['return_mean']:.1f}",
        f"{result['cost_mean']:.3f}",
        f"{result['cost_safe_start']:.3f}",
        f"{result['violation_rate']:.3f} (≤ {result['violation_upper']:.3f})",
        # Constants are those of the logs' team.
        f"{result['return_norm']:.3f}" if usual_size else "–",
        f"{result['cost_norm']:.3f}",
        f"{100 * result['termination_rate']:.0f} %",
    ]


def play(
    runs: Positional[list[Path]],
    env: str,
    episodes: int = 100,
    split: Literal["test", "validation"] = "test",
    num_envs: int = 16,
    early_ends: Literal["refuse", "cut", "skip"] = "refuse",
    wrong: Wrong = NO_FAULTS,
    compensate: bool = False,
    playing: How = AS_IT_IS,
) -> None:
    """Play a trained policy in a simulator of your own, a PettingZoo ParallelEnv, and print it beside its logs. The
    result is kept for reports, unless faults are asked for.

    Args:
        runs: run folders, or folders that hold some.
        env: what makes the simulator, as FILE.py:NAME or MODULE:NAME, e.g. examples/yard.py:Yard. It is run.
        episodes: a bound of 1 % takes 300 without an accident.
        split: test resets, or validation resets for choosing settings.
        num_envs: simulators that are stepped side by side.
        early_ends: what becomes of an episode that an agent leaves before its team.
        compensate: tell the guard of the faults, as `ringfence stress` does.
    """
    from ringfence.evaluation.play import play as run_play
    from ringfence.evaluation.play import simulator
    from ringfence.training.worlds import with_world

    given = playing.arguments()
    faults = wrong.faults()
    found = _some_runs(runs)
    make = simulator(env)
    given |= {"episodes": episodes, "split": split, "num_envs": num_envs, "early_ends": early_ends}
    given |= {"faults": faults, "compensate": compensate, "keep": not faults.given, "quiet": False}
    table = Table("run", "guard", "return", "cost", "unsafe episodes (95 % ≤)", "infeasible")
    refusals = Refusals()
    for run in found:
        with refusals.of(run):
            try:
                table.add_row(*_played(run, with_world(run_play, run, make, **given)))
            except Interrupted as stopped:
                if stopped.finished:
                    table.add_row(*_played(run, stopped.finished))
                if table.row_count:
                    out.print(table)
                raise
    if len(found) == 1 and table.row_count and (logs := found[0].logs):
        table.add_row(*_logged(logs))
    _say(table, refusals, len(found))


def _logged(logs: Outcomes) -> list[str]:
    """The row of what a run was trained on."""
    from statistics import fmean

    unsafe = fmean(cost > 0 for cost in logs["costs"])
    return ["its logs", "", f"{fmean(logs['returns']):.4g}", f"{fmean(logs['costs']):.3f}", f"{unsafe:.3f}", ""]


def _played(run: Run, result: dict[str, Any]) -> list[Text | str]:
    """A result's row of the table."""
    low, high = result["return_interval"]
    costs = [f"{result['cost_mean']:.3f}"]
    for name, cost in result.get("constraints", {}).items():
        limit = f" of {cost['limit']:g}" if "limit" in cost else ""
        costs.append(f"{terminal(name)} {cost['cost_mean']:.3f}{limit}")
    return [
        terminal(run.path),
        result["guard"] + (" (compensated)" if result.get("compensated") else ""),
        f"{result['return_mean']:.4g} ({low:.4g} to {high:.4g})",
        "\n".join(costs),
        f"{result['violation_rate']:.3f} (≤ {result['violation_upper']:.3f})",
        f"{100 * result['infeasible_rate']:.2g} %" if "infeasible_rate" in result else "",
    ]


def stress(
    runs: Positional[list[Path]],
    episodes: int = 100,
    split: Literal["test", "validation"] = "test",
    checkpoint: int | None = None,
    wrong: Wrong = NO_FAULTS,
    compensate: bool = False,
    env: str | None = None,
    playing: How = AS_IT_IS,
) -> None:
    """Play a trained policy behind faults, on the resets of `ringfence eval` or in a simulator of your own; kept in the
    run's stress.json.

    Args:
        runs: run folders, or folders that hold some.
        episodes: a bound of 1 % takes 300 without an accident.
        split: test resets, or validation resets for choosing settings.
        checkpoint: step of the one that is played; the last one by default.
        compensate: tell the guard of late actions, old observations and actions that are held, which it then makes
            good for.
        env: what makes a simulator of your own, as FILE.py:NAME or MODULE:NAME. It is run.
    """
    from ringfence.evaluation.play import simulator
    from ringfence.evaluation.stress import stress as run_stress
    from ringfence.training.worlds import with_world

    faults = wrong.faults()
    given = playing.arguments()
    found = _some_runs(runs)
    given |= {"episodes": episodes, "split": split, "checkpoint": checkpoint, "compensate": compensate}
    given |= {"make_env": None if env is None else simulator(env), "quiet": False}
    names = ("guard", "return", "cost", "unsafe episodes (95 % ≤)", "infeasible")
    table = Table("run", Column("faults", no_wrap=True), *names)
    refusals = Refusals()
    shown = "\n".join(f"{name} {value}" for name, value in faults.given.items()) or "none"
    for run in found:
        with refusals.of(run):
            first, *rest = _played(run, with_world(run_stress, run, faults, **given))
            table.add_row(first, shown, *rest)
    _say(table, refusals, len(found))


def certify(
    run: Positional[Path],
    out_file: Annotated[Path, tyro.conf.arg(name="out")],
    wrong: Wrong = NO_FAULTS,
    confidence: float = 0.95,
    quantile: float = 0.95,
    calibration: int = 100,
    episodes: int = 300,
    env: str | None = None,
    logs: str | None = None,
    replaying: Replayed = AS_LOGGED,
    playing: How = AS_IT_IS,
) -> None:
    """Calibrate a guard's margin behind faults, and bound the episodes that violate; `Controller(certificate=)` reads
    it. The guard knows of late actions, old observations and held actions. docs/certificates.md says what is promised.

    Episodes are those of a simulator of your own (--env), or windows of logs that are replayed (--logs): then the
    certificate says so.

    Args:
        run: a run folder.
        out_file: the certificate, JSON.
        confidence: of the bound.
        quantile: of episodes, whose shortfall the margin is to cover.
        calibration: episodes of each batch that the margin is calibrated on.
        episodes: fresh ones, for the bound.
        env: what makes a simulator of your own, as FILE.py:NAME or MODULE:NAME. It is run.
        logs: a store of its task, which is replayed: its first half calibrates the margin, its second gives the bound.
    """
    from ringfence.evaluation.certify import certify as run_certify
    from ringfence.evaluation.play import simulator
    from ringfence.training.worlds import with_world

    faults = wrong.faults()
    given = playing.arguments()
    if given.get("guard", "none") == "none":
        given |= {"guard": "shield"}
    file = writable(out_file)
    found = _one_run(run)
    given |= {"confidence": confidence, "quantile": quantile, "calibration": calibration, "episodes": episodes}
    given |= replaying.arguments() | {"logs": None if logs is None else _store(logs)}
    given |= {"make_env": None if env is None else simulator(env)}
    made = with_world(run_certify, found, faults, quiet=False, **given)
    for line in made.summary():
        out.print(lines(line), soft_wrap=True)
    print(made.save(file))


def _say(table: Table, refusals: Refusals, runs: int, doubts: Sequence[str] = ()) -> None:
    """What was measured, how far it is in doubt, and what runs were refused for; the process ends where any was."""
    if table.row_count:
        out.print(table)
    for doubt in doubts:
        out.print(terminal(doubt), soft_wrap=True)
    for message, refused in refusals.runs.items():
        unsaid = [str(run.path) for run in refused if str(run.path) not in message]
        whose = ", ".join(unsaid) + ": " if unsaid else ""
        complain(whose + message if runs > 1 else message)
    if refusals.runs:
        sys.exit(2)


def pretrained(
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
    for run in [zoo.pretrained(name, out_folder) for name in names]:
        print(run.path)


def export(
    run: Positional[Path],
    out_file: Annotated[Path, tyro.conf.arg(name="out")],
    format: Literal["onnx", "stablehlo"] = "onnx",
    checkpoint: int | None = None,
    playing: How = AS_IT_IS,
) -> None:
    """Write a trained policy, guard included, as one file that needs neither Python nor this library.

    Args:
        run: a run folder.
        out_file: the file to write.
        format: onnx, for onnxruntime and the like, or stablehlo; both need the extra `ringfence[export]`.
        checkpoint: step of the one that is written; the last one by default.
    """
    given = playing.arguments()
    from ringfence.deploy.export import export as write
    from ringfence.training.worlds import with_world

    found = _one_run(run)
    print(with_world(write, found, out_file, format, checkpoint, quiet=False, **given))


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
    from ringfence.training import worlds

    given = playing.arguments()
    report = page_at(report)
    found = _one_run(run)
    sizes = {"states": states, "transitions": transitions, "updates": updates, "seed": seed}
    evaluation.check_sizes(**sizes)
    store = _store(data)
    result = worlds.with_world(evaluation.ope, found, store, quiet=False, **sizes, **given)
    for line in result.summary():
        out.print(lines(line), soft_wrap=True)
    if report is not None:
        from ringfence.report import build_ope

        execution = PolicySpec.of(found, **given).execution
        evaluated_by = worlds.fit(store, seed=seed + 1, execution=execution)  # the one that did, from the cache
        print(build_ope(report, evaluated_by.card, audit(store), result))


def replay(
    run: Positional[Path],
    data: Positional[str],
    windows: int = 300,
    seed: int = 0,
    out_file: Annotated[Path | None, tyro.conf.arg(name="out")] = None,
    report: Path | None = None,
    wrong: Wrong = NO_FAULTS,
    compensate: bool = False,
    replaying: Replayed = AS_LOGGED,
    playing: How = Playing(guard="shield"),  # noqa: B008
) -> None:
    """Judge a policy and its guard by logs alone: one agent is driven, the others do what they did. Contacts without
    and with guard are counted, by the run and by drivers that are bad on purpose, in windows that do not overlap.

    Args:
        run: folder of a trained run, or the file of a World, which then guards the bad drivers alone.
        data: a store of its task, best one that neither was trained on (or a task, whose data set is regenerated).
        windows: at most so many, drawn evenly.
        seed: of what policies draw.
        out_file: write the result as JSON.
        report: write an HTML page.
        compensate: tell the guard of the faults, as `ringfence stress` does.
    """
    from ringfence.evaluation.replay import replay as replayed
    from ringfence.training.runs import write_json
    from ringfence.training.worlds import with_world

    given: dict[str, Any] = {**playing.arguments(), "faults": wrong.faults(), "compensate": compensate}
    out_file = None if out_file is None else writable(out_file)
    report = page_at(report)
    policy = None if run.is_file() else _one_run(run)
    if policy is None:
        given["world"] = playing.world or run
    given |= replaying.arguments() | {"windows": windows, "seed": seed, "quiet": False}
    result = with_world(replayed, policy, _store(data), **given)
    for line in result.summary():
        out.print(lines(line), soft_wrap=True)
    if out_file is not None:
        write_json(out_file, result.to_json())
        print(out_file)
    if report is not None:
        from ringfence.report import build_replay

        print(build_replay(report, result))


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


def demo(
    out_dir: Annotated[Path, tyro.conf.arg(name="out")] = Path("demo"), tier: str = "expert", quick: bool = False
) -> None:
    """The whole job on Simple Spread: data, training without and with barrier, evaluation, report.

    Args:
        out_dir: folder for runs and the page.
        tier: expert, medium, medium-replay or random.
        quick: a smoke test of a minute or two, with numbers that mean nothing.
    """
    demonstrate(out_dir, tier, quick)


COMMANDS = {
    "tasks": tasks,
    "fit": fit,
    "train": train,
    "eval": evaluate,
    "play": play,
    "stress": stress,
    "certify": certify,
    "pretrained": pretrained,
    "export": export,
    "bench": bench_commands.bench,
    "ope": ope,
    "replay": replay,
    "report": report,
    "demo": demo,
    "doctor": doctor,
}


KEEPING = (["train"], ["fit"], ["bench"], ["demo"])  # those that keep what is finished

GROUPS: dict[str, tuple[dict[str, Any], str]] = {
    "data": (data_commands.COMMANDS, "Episode stores: make, import, inspect."),
    "log": (log_commands.COMMANDS, "Look into a log that Controller(log=) wrote."),
    "bench": (bench_commands.COMMANDS, "Look into a results folder."),
}


def main(arguments: list[str] | None = None) -> None:
    arguments = sys.argv[1:] if arguments is None else arguments
    interrupts.listen()
    plain_warnings()
    for stream in (sys.stdout, sys.stderr):  # a terminal of few letters shows a question mark for the others
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        group, commands, description = _group_of(arguments)
        tyro.extras.subcommand_cli_from_dict(
            commands,
            prog=" ".join(["ringfence", *group]),
            description=description,
            args=arguments[len(group) :],
        )
        interrupts.check()  # a library may have swallowed it
    except KeyboardInterrupt as stopped:
        _say_interrupted(arguments, str(stopped))
    except Exception as error:
        if interrupts.asked():  # a library may have made another error of it
            _say_interrupted(arguments)
        sys.exit(_say_refused(error))


def _say_refused(error: Exception) -> int:
    """The exit status after an error, which is said in a sentence where it is a user's to mend."""
    if isinstance(error, BrokenPipeError):
        return 1
    if isinstance(error, UserError):
        complain(str(error))
    elif isinstance(error, OSError):  # of a path that nobody looked at before
        what = f"'{error.filename}': {error.strerror}" if error.filename else str(error)
        complain(f"{what}; check that the path is what you mean and that you may use it.")
    else:
        raise error
    return 2


def _say_interrupted(arguments: list[str], said: str = "") -> NoReturn:
    goes_on = "; the same command goes on from the last checkpoint" if arguments[:1] in KEEPING else ""
    print(said or f"interrupted{goes_on}", file=sys.stderr)
    sys.exit(interrupts.STATUS)


def _group_of(arguments: list[str]) -> tuple[list[str], dict[str, Any], str]:
    """(words that name a group of commands, its commands, its description); without such words all commands.
    `bench` is a command as well, unless one of its group follows."""
    name = arguments[0] if arguments else ""
    if name in GROUPS:
        commands, description = GROUPS[name]
        if name not in COMMANDS or (len(arguments) > 1 and arguments[1] in commands):
            return [name], commands, description
    helps = {"data": lambda: main(["data", "--help"]), "log": lambda: main(["log", "--help"])}
    return [], COMMANDS | helps, "Safe offline multi-agent reinforcement learning."


def _store(data: str) -> EpisodeStore:
    """A store's file, or the data set of a task."""
    from ringfence.datasets import registry
    from ringfence.datasets.make import make
    from ringfence.logs.store import LEARNED, EpisodeStore

    if Path(data).suffix in (".h5", ".hdf5", ".hdf") or Path(data).is_file() or len(Path(data).parts) > 1:
        store = EpisodeStore.load(data, LEARNED)
        if store.card.warnings and store.card.warnings[-1].startswith("learned from"):
            out.print(terminal(f"note {store.card.warnings[-1]}"), soft_wrap=True)
        return store
    return make(registry.get(data), must_keep=False)[0]


def _some_runs(paths: list[Path]) -> list[Run]:
    if not paths:
        raise UserError("No run was given; name run folders that `ringfence train` made.")
    return _runs(paths)


def _one_run(path: Path) -> Run:
    """The run in a folder, or the only one below it."""
    found = _runs([path])
    if len(found) > 1:
        raise UserError(f"'{path}' holds {len(found)} runs, and one is asked for; name it, e.g. {found[0].path}.")
    return found[0]


def _runs(paths: list[Path]) -> list[Run]:
    """The runs in folders, or in folders of them."""
    from ringfence.training.runs import runs_below

    found: list[Run] = []
    for path in paths:
        if not path.exists():
            raise UserError(f"'{path}' does not exist; give a folder that `ringfence train` made.")
        below = runs_below(path)
        if not below:
            raise UserError(f"'{path}' holds no run; give a folder that `ringfence train` made.")
        found += below
    return found


if __name__ == "__main__":
    main()
