"""The README's film: two runs on the same test reset, side by side, with speed and limit drawn in.

python benchmarks/film.py LEFT VARIANT RIGHT VARIANT    # run folders with recordings -> docs/images/rollout.gif

The README's: seed 0 of madiff, mujoco+steady, and of icbf, mujoco+adaptive, both in results/mujoco/cells/
halfcheetah_2x3-good. Recordings are not in the repository; `ringfence eval RUN --record 1 --planner steady` makes one.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from PIL import Image, ImageDraw

from ringfence.envs import film
from ringfence.envs.mujoco import DT
from ringfence.errors import UserError
from ringfence.evaluate import load_job
from ringfence.report import video
from ringfence.report.table import NAMES
from ringfence.runs import Run

OUT = Path(__file__).resolve().parent.parent / "docs" / "images" / "rollout.gif"
STEPS = 160  # from the start
HEAD = 20  # pixels


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for side in ("left", "right"):
        parser.add_argument(side, type=Path, help="run folder with a recording")
        parser.add_argument(f"{side}_variant", help="as results.json names it")
    told = parser.parse_args()
    try:
        os.environ["MUJOCO_GL"] = video.backend()  # read when mujoco is imported
        left, right = half(Run(told.left), told.left_variant), half(Run(told.right), told.right_variant)
    except UserError as error:
        parser.exit(2, f"error: {error}\n")
    films = video.with_one_palette([pair(*frames) for frames in zip(left, right)])
    shown = round(1000 * DT * video.stride(STEPS))  # ms
    films[0].save(OUT, save_all=True, append_images=films[1:], duration=shown, loop=0, optimize=True)
    print(OUT, f"{OUT.stat().st_size / 1e6:.1f} MB")


def half(run: Run, variant: str) -> list[Image.Image]:
    """Frames with a title: the method, and what its whole episode came to."""
    env, kept = load_job(run).task.env, video.recorded(run, variant)
    states, costs, rewards = kept["states"][0], kept["costs"][0], kept["rewards"][0]
    planner = variant.partition("+")[2]
    name = NAMES[run.config["algorithm"]].removesuffix(" (no barrier)") + f", {planner}" * bool(planner)
    title = f"{name}: return {rewards.sum():.0f}, {int(costs.sum())} of {len(costs)} steps over"
    made = []
    for frame in env.frames(states[: STEPS + 1], video.moments(costs[:STEPS])):
        whole = Image.new("RGB", (frame.width, frame.height + HEAD), film.PAPER)
        whole.paste(frame, (0, HEAD))
        ImageDraw.Draw(whole).text((10, 5), title, fill=film.DARK)
        made.append(whole)
    return made


def pair(left: Image.Image, right: Image.Image) -> Image.Image:
    both = Image.new("RGB", (left.width + right.width + 8, left.height), "white")
    both.paste(left, (0, 0))
    both.paste(right, (left.width + 8, 0))
    return both


if __name__ == "__main__":
    main()
