"""Robots that are tracked by range and bearing: a list of the two nearest, which does not say who they are.

    python benchmarks/trackers.py            # writes results/proving/trackers.json; a quarter of an hour
    python benchmarks/trackers.py --table    # writes its table of docs/proving-ground.md

Four unicycles with momentum share a field. Each logs its own speed and turn, range and bearing of its goal, and range,
bearing and range rate of the two that are nearest. A team's cost tells that two were nearer than NEAR. Rows differ in
what a World's dynamics know of such logs: that bearings are angles, and who it is that is seen. The system was made to
find faults in both, and has chosen no setting.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from gymnasium.spaces import Box
from pettingzoo import ParallelEnv

import ringfence
from ringfence.problem import partners, turns
from ringfence.utils.files import whole

OUT = Path(__file__).resolve().parent.parent / "results" / "proving" / "trackers.json"
N, LISTED, DT, LENGTH = 4, 2, 0.2, 80
NEAR, FIELD = 0.5, 3.0  # m: between two, and to the middle
FASTEST, TURNING = 1.1, 1.6  # m/s, rad/s
PUSH, TWIST = 0.9, 3.0  # m/s², rad/s²: braking takes six steps
NAMES = ["own.speed", "own.yaw_rate", "goal.range", "goal.bearing"]
NAMES += [f"near{k}.{what}" for k in range(LISTED) for what in ("range", "bearing", "range_rate")]
LOGGED = 600  # episodes
UNTOLD = {"as it is": (), "not who is seen": (partners,), "nor what is an angle": (partners, turns)}
HEAD = ("verdict", "clone", "clone, shield", "naive", "naive, shield")


def round_(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2 * np.pi) - np.pi


class Field:
    """E fields at once."""

    def __init__(self, rng: np.random.Generator, fields: int):
        self.rng = rng
        self.place = rng.uniform(-2.7, 2.7, (fields, N, 2))
        while (close := self.apart().min((1, 2)) < 1.3).any():
            self.place[close] = rng.uniform(-2.7, 2.7, (close.sum(), N, 2))
        self.heading = rng.uniform(-np.pi, np.pi, (fields, N))
        self.speed = np.zeros((fields, N))
        self.turn = np.zeros((fields, N))
        self.goal = self._goals()

    def apart(self) -> np.ndarray:
        """(E, N, N) m between two; far from oneself."""
        return np.linalg.norm(self.place[:, :, None] - self.place[:, None], axis=-1) + 1e3 * np.eye(N)

    def _goals(self) -> np.ndarray:
        """Mostly on the other side."""
        across = np.where(self.place > 0, -1.0, 1.0) * self.rng.uniform(0.3, 2.8, self.place.shape)
        anywhere = self.rng.uniform(-2.8, 2.8, self.place.shape)
        return np.where(self.rng.random(self.place.shape) < 0.3, anywhere, across)

    def polar(self, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Range and bearing (E, N, ...) of offsets (E, N, ..., 2)."""
        heading = self.heading.reshape(*self.heading.shape, *[1] * (offset.ndim - 3))
        return np.linalg.norm(offset, axis=-1), round_(np.arctan2(offset[..., 1], offset[..., 0]) - heading)

    def others(self) -> np.ndarray:
        """(E, N, N - 1, 3) range, bearing and range rate of all others, the nearest first."""
        velocity = np.stack([np.cos(self.heading), np.sin(self.heading)], -1) * self.speed[..., None]
        offset = self.place[:, None] - self.place[:, :, None]
        far, bearing = self.polar(offset)
        rate = ((velocity[:, None] - velocity[:, :, None]) * offset).sum(-1) / np.maximum(far, 1e-6)
        order = self.apart().argsort(-1)[..., : N - 1, None]
        return np.take_along_axis(np.stack([far, bearing, rate], -1), order, 2)

    def seen(self) -> np.ndarray:
        """(E, N, O) as NAMES says."""
        own = np.stack([self.speed, self.turn, *self.polar(self.goal - self.place)], -1)
        listed = self.others()[:, :, :LISTED].reshape(*own.shape[:2], -1)
        return np.concatenate([own, listed], -1).astype(np.float32)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rewards (E, N) and costs (E,) of actions (E, N, 2): push and twist."""
        outside = np.clip(np.abs(self.place).max(-1) - FIELD, 0, 1)  # who leaves the field is turned to its middle
        home = 2 * outside * np.sin(self.polar(-self.place)[1])
        self.turn = np.clip(self.turn + DT * (TWIST * action[..., 1] + home), -TURNING, TURNING)
        self.speed = np.clip(self.speed + DT * PUSH * action[..., 0], 0, FASTEST)
        way = self.heading + 0.5 * DT * self.turn
        before = np.linalg.norm(self.goal - self.place, axis=-1)
        self.place = self.place + DT * self.speed[..., None] * np.stack([np.cos(way), np.sin(way)], -1)
        self.heading = round_(self.heading + DT * self.turn)
        after = np.linalg.norm(self.goal - self.place, axis=-1)
        reached = after < 0.35
        self.goal = np.where(reached[..., None], self._goals(), self.goal)
        return before - after + 0.3 * reached, (self.apart().min((1, 2)) < NEAR).astype(float)


class Drivers:
    """Who looks at nobody, brakes late, swerves, or does both in time: each by habits of its own."""

    def __init__(self, rng: np.random.Generator, fields: int):
        shape = (fields, N)
        self.rng = rng
        self.habit = rng.choice(4, shape, p=[0.03, 0.17, 0.35, 0.45])
        self.fastest = rng.uniform(0.6, 1.0, shape)
        self.heeds = rng.uniform(1.0, 3.2, (*shape, 1))  # s
        self.turns = rng.uniform(1.5, 3.5, shape)
        self.drift = np.zeros((*shape, 2))

    def __call__(self, field: Field) -> np.ndarray:
        far, bearing, rate = np.moveaxis(field.others(), -1, 0)
        goal, angle = field.polar(field.goal - field.place)
        left = np.where((rate < -0.05) & (far > NEAR), (far - NEAR) / np.maximum(-rate, 0.05), 9.0)  # s
        ahead = np.abs(bearing) < 1.9
        urge = (left < self.heeds) * np.clip(1.5 - left / self.heeds, 0, 1) * (far < 2.6)
        brake = (urge * ahead).max(-1)
        late = (ahead & (left < 0.45 * self.heeds)).any(-1)
        stuck = 0.8 * (ahead & (far < 0.8) & (field.speed < 0.25)[..., None])
        swerve = -(np.where(np.abs(bearing) < 0.5, 1.0, np.sign(bearing)) * (urge + stuck)).sum(-1)
        close = (np.clip(1.0 - far, 0, 0.5) * ahead * (far > NEAR)).max(-1)
        slower = np.select(
            [self.habit == 1, self.habit == 2, self.habit == 3],
            [1.0 - late, 1 - 0.4 * brake, np.clip(1 - 1.2 * brake - 0.5 * close, 0, 1)],
            1.0,
        )
        speed = self.fastest * np.minimum(1, 0.2 + goal) * np.clip(1.1 - np.abs(angle) / 1.6, 0.05, 1) * slower
        turn = np.clip(self.turns * angle, -1.3, 1.3) + swerve * np.choose(self.habit, [0.0, 1.4, 2.0, 1.4])
        turn = np.clip(turn, -TURNING, TURNING)
        wanted = [(speed - field.speed) / PUSH, (turn - field.turn) / TWIST]
        self.drift = 0.9 * self.drift + self.rng.normal(0, 0.1, self.drift.shape)
        noise = self.drift + self.rng.normal(0, 0.15, self.drift.shape)
        return np.clip(np.stack(wanted, -1) / (1.5 * DT) + noise, -1, 1)


def naive(observations: np.ndarray, state: None) -> np.ndarray:
    """At full speed to the goal, past nobody."""
    speed, turn, _, angle = np.moveaxis(observations[..., :4], -1, 0)
    wanted = FASTEST * np.clip(1.2 - np.abs(angle) / 1.6, 0.1, 1), np.clip(2.5 * angle, -TURNING, TURNING)
    return np.clip(np.stack([(wanted[0] - speed) / (PUSH * DT), (wanted[1] - turn) / (TWIST * DT)], -1), -1, 1)


class Tracked(ParallelEnv):
    """One field."""

    metadata = {"name": "tracked"}

    def __init__(self) -> None:
        self.possible_agents = [f"robot{i}" for i in range(N)]

    def observation_space(self, agent: str) -> Box:
        return Box(-np.inf, np.inf, (len(NAMES),))

    def action_space(self, agent: str) -> Box:
        return Box(-1.0, 1.0, (2,))

    def _each(self, values: Any) -> dict[str, Any]:
        return dict(zip(self.possible_agents, values))

    def reset(self, seed: int | None = None, options: Any = None):
        self.agents = list(self.possible_agents)
        self.field, self.steps = Field(np.random.default_rng(seed), 1), 0
        return self._each(self.field.seen()[0]), self._each([{}] * N)

    def step(self, actions: dict[str, np.ndarray]):
        rewards, costs = self.field.step(np.stack([actions[a] for a in self.possible_agents])[None])
        self.steps += 1
        over = self._each([self.steps >= LENGTH] * N)
        infos = self._each([{"cost": float(costs[0])}] * N)
        return self._each(self.field.seen()[0]), self._each(rewards[0]), self._each([False] * N), over, infos


def logs() -> ringfence.EpisodeStore:
    rng = np.random.default_rng(11)
    field, drive = Field(rng, LOGGED), Drivers(rng, LOGGED)
    seen, kept = [field.seen()], []
    for _ in range(LENGTH):
        action = drive(field)
        kept.append((action, *field.step(action)))
        seen.append(field.seen())
    actions, rewards, costs = (np.stack(each, 1) for each in zip(*kept))
    card = {"task": "tracked", "dt": DT, "observation_names": NAMES, "provenance": "benchmarks/trackers.py"}
    return ringfence.EpisodeStore.from_episodes(np.stack(seen, 1), actions, rewards, costs, card=card)


@contextmanager
def untold(parts: tuple[Any, ...]) -> Iterator[None]:
    """While it is open, nothing of these is found in logs."""
    with ExitStack() as stack:
        for part in parts:
            stack.enter_context(mock.patch.object(part, "found_in", lambda *_: ()))
        yield


def judged(store: ringfence.EpisodeStore, episodes: int) -> dict[str, Any]:
    """A World's verdict and errors, and what a clone and a naive driver do without and with its guard."""
    world = ringfence.fit(store, quiet=False)
    error = world.card.prediction_error
    found: dict[str, Any] = {"verdict": world.card.verdict.word, "error of change": error.error_of_change}
    found |= {"read": {one.name: dict(zip(one.seconds, one.error)) for one in error.read}, "episodes": episodes}
    with tempfile.TemporaryDirectory() as runs:
        (run,) = ringfence.train("bc", store, seeds=(0,), out=runs)
        guarded = {"guard": "shield", "world": world, "anyway": True}
        looking = ringfence.guard(naive, world, guard="none")  # it looks on
        for who, player, options in (
            ("clone", run, {}),
            ("clone, shield", run, guarded),
            ("naive", looking, {}),
            ("naive, shield", ringfence.guard(naive, world, anyway=True), {}),
        ):
            result = ringfence.play(player, Tracked, episodes=episodes, num_envs=episodes, **options)
            found[who] = {k: round(float(result[f"{k}"]), 4) for k in ("return_mean", "violation_rate")}
            print(who, found[who], flush=True)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--table", action="store_true")
    a = parser.parse_args()
    found = json.loads(OUT.read_text()) if OUT.exists() else {}
    for name, parts in UNTOLD.items():
        if not a.table and name not in found:
            with untold(parts):
                found[name] = judged(logs(), a.episodes)
            with whole(OUT) as file:
                file.write_text(json.dumps(found, indent=1) + "\n")
    write_table(found)


def write_table(found: dict[str, Any]) -> None:
    from readme import put

    lines = [f"| dynamics know | {' | '.join(HEAD)} |", "|---" * (len(HEAD) + 1) + "|"]
    for name, row in found.items():
        cells = [f"{100 * row[who]['violation_rate']:.0f}, {row[who]['return_mean']:.2f}" for who in HEAD[1:]]
        lines.append(f"| {name} | {row['verdict']} | {' | '.join(cells)} |")
    put("docs/proving-ground.md", "trackers", "\n".join(lines))


if __name__ == "__main__":
    main()
