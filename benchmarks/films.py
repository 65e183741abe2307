"""Films of docs/images/: two runs on the same test reset side by side, and what a guard does.

    ringfence pretrained crossing-hasty/bc; RUN=runs/crossing-hasty/bc/seed-0
    ringfence eval $RUN --agents 64 --episodes 1 --num-recorded 1
    ringfence eval $RUN --agents 64 --episodes 1 --num-recorded 1 --guard shield
    python benchmarks/films.py pair $RUN default+agents64 $RUN default+shield-learned+agents64 --out crossing.gif
    python benchmarks/films.py guard    # docs/images/guard.gif; a minute

docs/images/rollout.gif is of seed 0 of madiff, mujoco+low_temperature, and of icbf, mujoco+adaptive, both of
halfcheetah_2x3-good in results/mujoco (revision 3). Recordings are not in the repository. The guard's film has discs of
Crossing under a shield, beside what their clone asked for and what was done.
"""

from __future__ import annotations

import argparse
import io
import os
import tempfile
from pathlib import Path

import matplotlib
import numpy as np
from common import ROOT
from PIL import Image, ImageDraw, ImageFont

import ringfence
from ringfence.deploy import zoo
from ringfence.envs import film
from ringfence.envs.pettingzoo import CrossingParallel
from ringfence.errors import UserError
from ringfence.loading.resolve import load_job
from ringfence.report import video
from ringfence.report.table import NAMES
from ringfence.training.runs import Run

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

IMAGES = ROOT / "docs" / "images"
STEPS = 160  # from the start
HEAD, WIDEST = 20, 400  # pixels of the title's height, of a half
AGENTS, SIDE, EVERY = 8, 380, 2  # of the guard's film: pixels of each half; steps per frame
ASKED, DONE = "#D55E00", "#0072B2"
LOWEST, HIGHEST = -2.0, 2.5  # margins that are drawn


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ways = parser.add_subparsers(dest="what", required=True)
    two, one = ways.add_parser("pair"), ways.add_parser("guard")
    for side in ("left", "right"):
        two.add_argument(side, type=Path, help="run folder with a recording")
        two.add_argument(f"{side}_variant", help="as results.json names it")
    two.add_argument("--out", type=Path, default=IMAGES / "rollout.gif")
    one.add_argument("--reset", type=int, default=0)
    one.add_argument("--out", type=Path, default=IMAGES / "guard.gif")
    a = parser.parse_args()
    try:
        frames, shown = guarded(a.reset) if a.what == "guard" else of_two(a)
    except UserError as error:
        parser.exit(2, f"error: {error}\n")
    films = video.with_one_palette(frames)
    films[0].save(a.out, save_all=True, append_images=films[1:], duration=shown, loop=0, optimize=True)
    print(a.out, f"{a.out.stat().st_size / 1e6:.1f} MB")


def of_two(a: argparse.Namespace) -> tuple[list[Image.Image], int]:
    """Frames of two runs, and how long each is shown, ms."""
    left, shown = half(Run(a.left), a.left_variant)
    right, _ = half(Run(a.right), a.right_variant)
    return [pair(*frames) for frames in zip(left, right)], shown


def half(run: Run, variant: str) -> tuple[list[Image.Image], int]:
    """Frames with a title, the method and what its whole episode came to, and how long each is shown, ms."""
    task = load_job(run, run.results.get(variant, {}).get("agents")).task
    if getattr(task.env, "opengl", False):
        os.environ["MUJOCO_GL"] = video.backend()  # read when mujoco is imported
    kept = video.recorded(run, variant)
    states, costs, rewards = kept["states"][0], kept["costs"][0], kept["rewards"][0]
    called = [part for part in variant.split("+")[1:] if not part.startswith("agents")]
    name = ", ".join([NAMES[run.config["algorithm"]].removesuffix(" (no barrier)"), *called])
    over = f"{int(costs.sum())} of {len(costs)} steps " + ("with contact" if task.homogeneous else "over")
    title = f"{name}: return {rewards.sum():.{1 if task.homogeneous else 0}f}, {over}"
    made = []
    for frame in task.env.frames(states[: STEPS + 1], video.moments(costs[:STEPS])):
        frame.thumbnail((WIDEST, WIDEST), Image.Resampling.LANCZOS)
        whole = Image.new("RGB", (frame.width, frame.height + HEAD), film.PAPER)
        whole.paste(frame, (0, HEAD))
        ImageDraw.Draw(whole).text((10, 4), title, fill=film.DARK, font=ImageFont.load_default(13))
        made.append(whole)
    return made, round(1000 * task.env.dt * video.stride(len(costs[:STEPS])))


def pair(left: Image.Image, right: Image.Image) -> Image.Image:
    both = Image.new("RGB", (left.width + right.width + 8, left.height), "white")
    both.paste(left, (0, 0))
    both.paste(right, (left.width + 8, 0))
    return both


def guarded(reset: int) -> tuple[list[Image.Image], int]:
    """Likewise of discs under a shield."""
    env = CrossingParallel(n_agents=AGENTS)
    with tempfile.TemporaryDirectory() as folder:
        run = zoo.pretrained("crossing-hasty/bc", folder)
        # what is recorded of every step holds what was asked for
        pilot = ringfence.Controller(run, guard="shield", log=Path(folder) / "log.jsonl")
        states, asked, done, costs = played(env, pilot, reset)
        pilot.close()
    moments = [(step, bool(np.any(costs[max(0, step - EVERY) : step]))) for step in range(0, len(states), EVERY)]
    frames = []
    for (step, _), frame in zip(moments, env.core.frames(states, moments)):
        frame.thumbnail((SIDE, SIDE), Image.Resampling.LANCZOS)
        frames.append(pair(frame, curves(asked[:step], done[:step], len(asked), frame.height)))
    print(f"contact in {int((costs > 0).sum())} steps")
    return frames, round(1000 * env.core.dt * EVERY)


def played(
    env: CrossingParallel, pilot: ringfence.Controller, reset: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """An episode: states (T+1, S), least scores of any agent along what was asked for and along what was done (T,), and
    what it cost (T,)."""
    seen, _ = env.reset(seed=reset)
    states, asked, done, costs = [env.state()], [], [], []
    while env.agents:
        names = list(env.agents)
        action = pilot.act(np.stack([seen[name] for name in names]))
        asked.append(pilot.info["agent_reason_score"].min())
        done.append(pilot.info["agent_clearance"].min())
        seen, _, _, _, info = env.step(dict(zip(names, action)))
        costs.append(max(info[name]["cost"] for name in names))
        states.append(env.state())
    return tuple(np.array(x, np.float32) for x in (states, asked, done, costs))


def curves(asked: np.ndarray, done: np.ndarray, steps: int, height: int) -> Image.Image:
    """The two scores so far."""
    figure, axis = plt.subplots(figsize=(SIDE / 100, height / 100), dpi=100, layout="constrained")
    axis.axhspan(LOWEST, 0, color="#f6dcd2", lw=0)
    axis.axhline(1, color="0.35", lw=1, ls="--")
    for scores, colour, words in ((asked, ASKED, "the clone asked for"), (done, DONE, "the guard did")):
        axis.plot(np.clip(scores, LOWEST, HIGHEST), color=colour, lw=1.6, label=words)
    axis.set(xlim=(0, steps), ylim=(LOWEST, HIGHEST), xlabel="step", ylabel="least predicted score, margins")
    axis.text(steps, 1.08, "margin ", ha="right", fontsize=8, color="0.35")
    axis.text(steps, LOWEST + 0.1, "called unsafe ", ha="right", fontsize=8, color="#a04020")
    axis.legend(loc="upper left", fontsize=8, frameon=False)
    made = io.BytesIO()
    figure.savefig(made)
    plt.close(figure)
    return Image.open(made).convert("RGB").resize((SIDE, height))


if __name__ == "__main__":
    main()
