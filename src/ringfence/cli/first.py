"""The first commands of a new installation: `ringfence doctor`, and the whole job in one, `ringfence demo`.

That is data, a World, a cloned policy and a planner, as they are and under guard, by the formula of danger and without
it, on the same resets; report. MADIFF is the planner whose plans nothing guides.
"""

from __future__ import annotations

import importlib.metadata as metadata
import os
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Column, Table

from ringfence.cli.shared import console
from ringfence.errors import UserError

out = console()


def doctor() -> None:
    """Versions, devices, what is missing and how to get it."""
    from ringfence.utils.environment import environment
    from ringfence.utils.files import cache_dir

    versions = environment()
    for name in ("ringfence", "python", "system", "processor", "cores", "git"):
        out.print(f"{name:12} {escape(str(versions[name]))}")
    for name, version in versions["packages"].items():
        out.print(f"{name:12} {version}")
    out.print(f"{'devices':12} {escape(_devices(versions['devices']))}", soft_wrap=True)
    out.print(f"{'cache':12} {escape(str(cache_dir()))}", soft_wrap=True)
    try:
        from ringfence.report import video

        out.print(f"{'films':12} drawn by {video.backend()}")
    except UserError as error:
        out.print(f"{'films':12} [yellow]missing[/], {escape(str(error))}", soft_wrap=True)
    for package, extra, use in (
        ("matplotlib", "report", "pages, figures and films"),
        ("mujoco", "sim", "robots"),
        ("pettingzoo", "sim", "PettingZoo's simulators"),
        ("pyarrow", "tables", "CSV and Parquet"),
        ("rosbags", "ros", "ROS bags"),
        ("tensorboardX", "tensorboard", "TensorBoard logs"),
        ("tensorstore", "vault", "OG-MARL's Vaults"),
        ("minari", "minari", "Minari's data sets by their names"),
        ("ray", "ray", "benchmarks on a cluster"),
        ("jax2onnx", "export", "policies as ONNX files"),
        ("flatbuffers", "export", "policies as StableHLO files"),
        ("mpe2", "test", "parity tests"),
    ):
        try:
            out.print(f"{package:12} {metadata.version(package)}")
        except metadata.PackageNotFoundError:
            out.print(f"{package:12} [yellow]missing[/], for {use}: pip install 'ringfence\\[{extra}]'")


def _devices(found: list[str]) -> str:
    """Devices in words; where JAX finds none, why, and what to do."""
    from ringfence.utils.environment import device_problem

    if found:
        return ", ".join(found)
    chosen = os.environ.get("JAX_PLATFORMS")
    remedy = f"JAX_PLATFORMS={chosen} asks for what is not here; unset it, or" if chosen else ""
    return f"none ({device_problem()}); {remedy} set JAX_PLATFORMS=cpu."


def demonstrate(folder: Path, tier: str = "expert", quick: bool = False) -> Path:
    """Make `folder`/report.html and print the table that it holds; a few minutes on two cores."""
    from ringfence.datasets import registry
    from ringfence.datasets.make import make
    from ringfence.evaluation import reference
    from ringfence.evaluation.evaluate import evaluate
    from ringfence.report import build_report
    from ringfence.training import loop, worlds
    from ringfence.utils.progress import beside

    said = Console(highlight=False)
    begun = time.monotonic()
    task = registry.get(f"simple_spread-{tier}")
    episodes = 10 if quick else 100
    store, path = make(task, 5_000 if quick else None)
    said.print(f"data        {store.episodes:,} episodes, return {store.returns.mean():.1f}: {path}", soft_wrap=True)
    small = {"num_updates": 60, "batch": 32, "barrier_batch": 16, "width": 64}
    known = {f"{part}_updates": 100 for part in ("dynamics", "value", "barrier", "future")}
    shared = {"out": folder / "runs", "changes": small if quick else {}, "world": known if quick else {}}
    of_clone: dict[str, Any] = {"changes": {"num_updates": 60} if quick else {}, "quiet": True}
    with beside(lambda: loop.train("bc", store, out=folder / "runs", **of_clone)) as clones:
        planner = loop.train("icbf", store, **shared)[0]
    cloned = clones()[0]
    rows = dict(reference.make(task, store, folder / "runs", episodes))
    protocol: dict[str, Any] = {"episodes": episodes, "num_recorded": 4, "quiet": False}
    fewer: dict[str, Any] = {"sampling_steps": 2} if quick else {}
    learned: dict[str, Any] = {"barrier": "learned", "anyway": quick}  # so little training is unfit to guard by
    world = worlds.of_run(planner)
    said.print(str(world.card), soft_wrap=True, markup=False)
    rounds: dict[str, Any] = {"optimizer_steps": 2} if quick else {}

    def planned() -> dict[str, dict]:
        of_plans: dict[str, Any] = protocol | fewer | {"quiet": True}
        alone = evaluate(planner, barrier_guidance=0.0, **of_plans)
        return {"MADIFF": alone, "ICBF": evaluate(planner, anyway=quick, **of_plans)}

    with beside(planned) as plans:
        rows["BC"] = evaluate(cloned, **protocol)
        rows["BC, shielded, formula"] = evaluate(cloned, guard="shield", barrier="analytic", world=world, **protocol)
        rows["BC, shielded, learned"] = evaluate(cloned, guard="shield", world=world, **learned, **protocol)
        full = evaluate(cloned, guard="full", world=world, **learned, **protocol, **rounds)
    rows |= plans() | {"BC, full guard, learned": full}
    table = Table(
        Column("", no_wrap=True), "return", "norm.", "cost", "safe starts", "unsafe episodes", title=task.name
    )
    for name, r in rows.items():
        table.add_row(
            name,
            f"{r['return_mean']:.1f} ± {r['return_std']:.1f}",
            f"{r['return_norm']:.3f}",
            f"{r['cost_mean']:.3f}",
            f"{r['cost_safe_start']:.3f}",
            f"{100 * r['violation_rate']:.1f} % (≤ {100 * r['violation_upper']:.1f} %)",
        )
    said.print(table)
    said.print(
        f"Per episode of {task.simulator.episode_length} steps, {episodes} test episodes, the same resets for every "
        "policy, 1 seed. Cost: steps with a collision; safe starts: in episodes that do not start in contact; unsafe "
        "episodes: "
        f"with any collision, exact 95 % upper bound in brackets. norm.: {task.return_min:g} → {task.return_max:g}.\n"
        f"Data regenerated by this program, not the public files. {time.monotonic() - begun:.0f} s.",
        soft_wrap=True,
    )
    page = build_report([cloned, planner], folder / "report.html")
    said.print(f"report      {page}", soft_wrap=True)
    return page
