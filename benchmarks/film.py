"""Films of two runs on the same test reset, side by side: robots with speed and limit drawn in, discs with who touches.

    ringfence pretrained crossing-hasty/bc; RUN=runs/crossing-hasty/bc/seed-0
    ringfence eval $RUN --agents 64 --episodes 1 --num-recorded 1
    ringfence eval $RUN --agents 64 --episodes 1 --num-recorded 1 --guard shield
    python benchmarks/film.py $RUN default+agents64 $RUN default+shield-learned+agents64 --out docs/images/crossing.gif

docs/images/rollout.gif is of seed 0 of madiff, mujoco+low_temperature, and of icbf, mujoco+adaptive, both of
halfcheetah_2x3-good in results/mujoco (revision 3). Recordings are not in the repository.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

from ringfence.envs import film
from ringfence.errors import UserError
from ringfence.loading.resolve import load_job
from ringfence.report import video
from ringfence.report.table import NAMES
from ringfence.training.runs import Run

STEPS = 160  # from the start
HEAD, WIDEST = 20, 400  # pixels of the title's height, of a half


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for side in ("left", "right"):
        parser.add_argument(side, type=Path, help="run folder with a recording")
        parser.add_argument(f"{side}_variant", help="as results.json names it")
    parser.add_argument("--out", type=Path, default=Path("docs/images/rollout.gif"))
    arguments = parser.parse_args()
    try:
        left, shown = half(Run(arguments.left), arguments.left_variant)
        right, _ = half(Run(arguments.right), arguments.right_variant)
    except UserError as error:
        parser.exit(2, f"error: {error}\n")
    films = video.with_one_palette([pair(*frames) for frames in zip(left, right)])
    films[0].save(arguments.out, save_all=True, append_images=films[1:], duration=shown, loop=0, optimize=True)
    print(arguments.out, f"{arguments.out.stat().st_size / 1e6:.1f} MB")


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


if __name__ == "__main__":
    main()
