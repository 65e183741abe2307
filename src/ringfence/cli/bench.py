"""`ringfence bench`: a grid is made, looked into, exported."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from rich import box
from rich.console import Console
from rich.table import Column, Table

from ringfence.cli.shared import complain, console
from ringfence.errors import UserError, one_of
from ringfence.utils.text import terminal

if TYPE_CHECKING:
    from ringfence.bench import Grid
    from ringfence.evaluation.certificate import Certificate

out = console()
Positional = tyro.conf.Positional
# --tasks a b and --tasks a --tasks b mean the same.
Names = Annotated[list[list[str]], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="NAME")]


@dataclass(frozen=True)
class Machines:
    """Who makes the cells."""

    engine: Literal["local", "ray"] = "local"
    """processes on this machine, or Ray tasks."""
    workers: int | None = None
    """local processes; one per `threads` cores by default."""
    threads: int = 1
    """per worker; cores that Ray sets aside per task."""
    memory: float | None = None
    """GiB that a local process may hold before it is stopped."""
    address: str | None = None
    """of the Ray cluster, e.g. auto; without it a local one is started."""

    def run(self, grid: Grid) -> dict[str, int]:
        """Cells by state after the run."""
        if self.engine == "ray":
            for name, value in (("workers", self.workers), ("memory", self.memory)):
                if value is not None:
                    raise UserError(f"--{name} is about local processes, Ray divides its cluster itself; leave it out.")
            from ringfence.bench.engines import run_ray

            return run_ray(grid, address=self.address, threads=self.threads)
        from ringfence.bench import run_local

        return run_local(grid, workers=self.workers, threads=self.threads, memory=self.memory)


HERE = Machines()


def bench(
    suite: Positional[str],
    seeds: int = 5,
    episodes: int | None = None,
    out_dir: Annotated[Path | None, tyro.conf.arg(name="out")] = None,
    tasks: Names = [],  # noqa: B006
    algorithms: Names = [],  # noqa: B006
    num_updates: int | None = None,
    machines: Annotated[tyro.conf.OmitArgPrefixes[Machines], tyro.conf.arg(name="machines")] = HERE,
    certificate: Path | None = None,
) -> None:
    """Make the grid task x algorithm x seed; the same command goes on where it was left, and repeats nothing.

    Of a results folder: `ringfence bench status FOLDER`, `bench results FOLDER`, `bench export FOLDER`; of two,
    `bench paper-table`.

    Args:
        suite: simple_spread, mujoco, or paper: the paper's 13 tasks and three methods, from those two suites. Under
            guard: guards, guards-mujoco, crossing, crossing-guards, all four of them as attribution; own-sight,
            own-sight-mujoco, crossing-teams, spread-teams, proving-ground. Behind faults: stress.
        seeds: per algorithm and task.
        episodes: test episodes per run; the suite's number by default.
        out_dir: folder of results, results/SUITE by default, of stress results/stress-suite; of paper and
            attribution, the folder that holds theirs.
        tasks: these alone.
        algorithms: these alone, as algorithm or algorithm:preset.
        num_updates: of every algorithm, for a quick trial.
        certificate: of a run of the suite stress, whose table then says behind which faults it is kept.
    """
    from ringfence.bench import pack

    if num_updates is not None and out_dir is None:
        raise UserError(
            f"--num-updates {num_updates} makes other rows than the suite's own; give a folder of their own with --out."
        )
    if certificate is not None:
        _load_certificate(certificate, suite)
    sizes = {"seeds": seeds, "episodes": episodes, "num_updates": num_updates}
    root, grids = _grids(suite, out_dir, sum(tasks, []), sum(algorithms, []), sizes)
    for grid in grids:  # what is wrong with the last one is said before the first begins
        grid.check()
    complete = True
    idle = True
    for grid in grids:
        idle = idle and not grid.groups()
        try:
            counts = machines.run(grid)
        finally:
            pack(grid.out)
        whole = _say_made(grid, counts, suite != "paper", certificate)
        complete = complete and whole
    if suite == "paper":
        paper_table(root)
    if idle:
        out.print(
            f"All cells were there already, nothing was made; to make them yourself, give another --out than {root}."
        )
    if not complete:
        sys.exit(1)


def _grids(
    suite: str, out_dir: Path | None, only_tasks: list[str], only: list[str], sizes: dict[str, Any]
) -> tuple[Path, list[Grid]]:
    """(folder that holds the results, the grids of a suite or of a collection of them)."""
    from ringfence.bench import COLLECTIONS, SUITES, collected, make_grid, make_grids, paper

    root = out_dir or Path("results")
    if suite == "paper":
        return root, paper.grids(root, only_tasks, only, **sizes)
    if suite in COLLECTIONS:
        return root, make_grids(collected(suite, only_tasks), root, only, **sizes)
    root = out_dir or root / (one_of("suite", suite, SUITES).folder or suite)
    return root, [make_grid(suite, root, only_tasks=only_tasks, only=only, **sizes)]


def _load_certificate(file: Path, suite: str) -> Certificate:
    """What is read by the suite that plays behind faults alone."""
    from ringfence.evaluation.certificate import Certificate

    if suite != "stress":
        raise UserError(f"--certificate is read by the suite stress alone, and this is {suite}; leave it out.")
    return Certificate.load(file)


def _say_made(grid: Grid, counts: dict[str, int], ranked: bool, certificate: Path | None) -> bool:
    """Print what became of a grid's cells; whether nothing of it is lacking."""
    out.print(", ".join(f"{n} {state}" for state, n in counts.items()))
    if counts["done"] and ranked:
        results(grid.out, certificate)
    lacking = grid.references()
    if lacking:
        complain(f"The reference rows of {', '.join(lacking)} could not be made; see above.")
    unfinished = counts["failed"] or counts["to do"]
    if unfinished:
        status(grid.out)
    return not lacking and not unfinished


def status(folder: Positional[Path]) -> None:
    """What a results folder holds: finished cells, and failed ones with the reason."""
    from ringfence.bench.cells import statuses

    table = Table("task", "run", "state", "train s", "eval s", "why")
    for s in statuses(folder):
        seconds = [f"{s[k]:.0f}" if k in s else "" for k in ("train_seconds", "eval_seconds")]
        table.add_row(*map(terminal, (s["task"], s["run"], s["state"], *seconds, s.get("error", ""))))
    out.print(table)


def results(folder: Positional[Path], certificate: Path | None = None) -> None:
    """Rank the methods of every task and write FOLDER/table.csv; of the suite stress FOLDER/stress.csv, too.

    Args:
        folder: the --out of `ringfence bench`.
        certificate: of a run of the suite stress; a column says behind which faults it is kept.
    """
    from ringfence.bench import stressed, write_csv
    from ringfence.bench.cells import read_about
    from ringfence.report import board

    promise = None if certificate is None else _load_certificate(certificate, read_about(folder)["suite"])

    for task, rows in board.read(folder).lines.items():
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
    behind_faults = stressed.write_csv(folder, promise)
    if behind_faults is not None:
        print(behind_faults)


def paper_table(folder: Positional[Path] = Path("results")) -> None:
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


def export(
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


COMMANDS = {"status": status, "results": results, "paper-table": paper_table, "export": export}
