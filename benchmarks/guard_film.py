"""A film of what a guard does: discs of Crossing under a shield, beside what their clone asked for and what was done.

python benchmarks/guard_film.py    # docs/images/guard.gif; a minute
"""

from __future__ import annotations

import argparse
import io
import tempfile
from pathlib import Path

import matplotlib
import numpy as np
from film import pair
from PIL import Image

import ringfence
from ringfence.deploy import zoo
from ringfence.envs.pettingzoo import CrossingParallel
from ringfence.report import video

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

OUT = Path(__file__).resolve().parent.parent / "docs" / "images" / "guard.gif"
AGENTS, SIDE, EVERY = 8, 380, 2  # pixels of each half; steps per frame
ASKED, DONE = "#D55E00", "#0072B2"
LOWEST, HIGHEST = -2.0, 2.5  # margins that are drawn


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--reset", type=int, default=0)
    env = CrossingParallel(n_agents=AGENTS)
    with tempfile.TemporaryDirectory() as folder:
        run = zoo.pretrained("crossing-hasty/bc", folder)
        # what is recorded of every step holds what was asked for
        pilot = ringfence.Controller(run, guard="shield", log=Path(folder) / "log.jsonl")
        states, asked, done, costs = played(env, pilot, parser.parse_args().reset)
        pilot.close()
    moments = [(step, bool(np.any(costs[max(0, step - EVERY) : step]))) for step in range(0, len(states), EVERY)]
    frames = []
    for (step, _), frame in zip(moments, env.core.frames(states, moments)):
        frame.thumbnail((SIDE, SIDE), Image.Resampling.LANCZOS)
        frames.append(pair(frame, curves(asked[:step], done[:step], len(asked), frame.height)))
    films = video.with_one_palette(frames)
    films[0].save(
        OUT, save_all=True, append_images=films[1:], duration=round(1000 * env.core.dt * EVERY), loop=0, optimize=True
    )
    print(OUT, f"{OUT.stat().st_size / 1e6:.1f} MB; contact in {int((costs > 0).sum())} steps")


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
