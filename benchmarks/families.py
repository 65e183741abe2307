"""Nine families of small systems that were written from the documentation alone, to try the search for causes on them.

Each is a value of `systems.Kind`. Whoever wrote them did not read how danger is searched for, and no number was tuned
but to keep danger on some logged steps. Half are open: who works on the search may look at them. Those that are kept
are for the end. Where `danger` gives a number for each agent, costs are by agent; else they are the team's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from systems import (
    MOVES,
    Array,
    Body,
    Careful,
    Kind,
    Moment,
    at_most,
    crowd_careful,
    driven,
    entries,
    length,
    offsets,
    own_and_others,
    placed,
    pushed,
    sprayers_begin,
    sprayers_move,
    spring,
    turned,
    wrapped,
)

GO = "x y vx vy goal_dx goal_dy"


@dataclass(frozen=True)
class Family:
    """Systems whose danger is alike."""

    name: str
    says: str
    open: tuple[Kind, ...]
    kept: tuple[Kind, ...]


def dotted(own: str, others: int, each: str) -> list[str]:
    """Names as the documentation has them: `own.x`, `other0.dx`."""
    return [f"own.{e}" for e in own.split()] + [f"other{k}.{e}" for k in range(others) for e in each.split()]


def each(seen: Array, first: int, numbers: int) -> Array:
    """(N, K, numbers) of each thing that is listed from entry `first` on."""
    return seen[:, first:].reshape(len(seen), -1, numbers)


def column(values: Array) -> Array:
    return np.asarray(values, float)[:, None]


def of_others(s: Moment, *values: Array) -> Array:
    """(N, (N − 1) · K) these values (N, K) of everybody else, one agent after the other."""
    return np.concatenate([v[s.others] for v in values], -1).reshape(s.kind.n, -1)


def away(gap: Array, near: float, strength: float, aside: float = 0.0) -> Array:
    """(N, 2) pushes away from who is within `near`, and past them on the right, of offsets (N, K, 2)."""
    far = np.maximum(length(gap), 0.05)[..., None]
    right = np.stack([-gap[..., 1], gap[..., 0]], -1) / far
    return np.where(far < near, -strength * (near - far) * gap / far + aside * right, 0.0).sum(1)


# Sums over the team.

FEEDER, RAMP, FULL = 70.0, 4.0, 22.0  # kW together; kW a minute; kW of one
LEVER = 22.0  # kN m
SIZES, SUPPLY, LOSS, LEAST = np.array([4.0, 4.0, 6.0, 6.0, 8.0]), 6.0, 0.008, 3.0  # L/s wide open; bar; bar s²/L²; bar
AIM = 2.0  # m of water


def chargers_begin(s: Moment) -> None:
    s.charge = s.rng.uniform(0.15, 0.8, s.kind.n)
    s.wanted = np.minimum(s.charge + s.rng.uniform(0.02, 0.3, s.kind.n), 0.95)
    s.power = s.rng.uniform(0, 8, s.kind.n)


def chargers_move(s: Moment, actions: Array) -> float:
    """Cars of 60 kWh take less from 80 % on, and nothing once they have what they want."""
    most = np.where(s.charge < s.wanted, FULL * np.clip((1 - s.charge) / 0.2, 0, 1), 0.0)
    s.power = np.clip(s.power + RAMP * actions[:, 0], 0, most)
    s.charge = s.charge + s.power / 60 / 60
    return float(s.power.mean() / 60)


def chargers_seen(s: Moment) -> list[Array]:
    return [np.stack([s.charge, s.wanted, s.power], 1), of_others(s, s.power[:, None])]


def chargers_naive(k: Kind, seen: Array) -> Array:
    """All that the car takes."""
    charge, wanted, power = seen[:, :3].T
    return column(np.clip((np.where(charge < wanted, FULL, 0.0) - power) / RAMP, -1, 1))


def chargers_careful(k: Kind, seen: Array, care: float) -> Array:
    """A fair share of what the feeder gives."""
    charge, wanted, power = seen[:, :3].T
    hungry = charge < wanted
    share = min((FEEDER - 14) / max(hungry.sum(), 1), FULL)
    return column(np.clip((np.where(hungry, share + (1 - care) * (FULL - share), 0.0) - power) / RAMP, -1, 1))


def lever(loads: Array, places: Array) -> float:
    """kN m of loads (t) at places (m) on the beam."""
    return 9.81 * float((loads * places).sum())


def beam_begin(s: Moment) -> None:
    while True:
        placed(s)
        s.load = s.rng.uniform(0.5, 2.0, s.kind.n)
        if max(abs(lever(s.load, s.p[:, 0])), abs(lever(s.load, s.goal[:, 0]))) < 0.9 * LEVER:
            return


def beam_seen(s: Moment) -> list[Array]:
    load = s.load[:, None]
    others = np.concatenate([s.p[s.others] - s.p[:, None], s.v[s.others] - s.v[:, None], load[s.others]], -1)
    return [s.p, s.v, load, s.goal - s.p, others.reshape(s.kind.n, -1)]


def beam_naive(k: Kind, seen: Array) -> Array:
    gap = seen[:, 3:4]
    wanted = np.sign(gap) * np.minimum(1.4, np.sqrt(1.2 * np.abs(gap)))
    return np.clip((wanted - seen[:, 1:2]) / (2 * k.dt * k.push), -1, 1)


def beam_careful(k: Kind, seen: Array, care: float) -> Array:
    """Waits where going on would tip the beam further."""
    x, v, load, gap = seen[:, :4].T
    soon = lever(load, x + 1.0 * v)
    stop = (abs(soon) > 0.6 * LEVER) & (np.sign(gap) == np.sign(soon))
    return np.where(column(stop), (1 - care) * k.naive(seen) - care * 2 * seen[:, 1:2], k.naive(seen))


def pipe_begin(s: Moment) -> None:
    s.level = s.rng.uniform(0.8, 2.2, s.kind.n)
    s.valve = s.rng.uniform(0, 0.5, s.kind.n)
    s.demand = s.rng.uniform(0.5, 3.5, s.kind.n)


def pressure(s: Moment) -> float:
    """bar in the pipe that all tanks draw from."""
    return SUPPLY - LOSS * float((SIZES * s.valve).sum()) ** 2


def pipe_move(s: Moment, actions: Array) -> float:
    """Valves of tanks of 1.5 m² turn; users draw more or less water."""
    s.valve = np.clip(s.valve + 0.2 * actions[:, 0], 0, 1)
    s.demand = np.clip(s.demand + s.rng.normal(0, 0.25, s.kind.n), 0.5, 4.5)
    s.level = np.clip(s.level + s.kind.dt * (SIZES * s.valve - s.demand) / 1500, 0, 4)
    return -float(np.abs(s.level - AIM).mean())


def pipe_wanted(seen: Array) -> Array:
    return np.clip(seen[:, 1] / SIZES + 3 * (AIM - seen[:, 0]), 0, 1)


def pipe_naive(k: Kind, seen: Array) -> Array:
    """Fills the own tank."""
    return column(np.clip((pipe_wanted(seen) - seen[:, 2]) / 0.2, -1, 1))


def pipe_careful(k: Kind, seen: Array, care: float) -> Array:
    """All draw less where they want too much together."""
    wanted = pipe_wanted(seen)
    less = min(1.0, 0.85 * np.sqrt((SUPPLY - LEAST) / LOSS) / max(float((SIZES * wanted).sum()), 1e-6))
    return column(np.clip((wanted * (1 - care + care * less) - seen[:, 2]) / 0.2, -1, 1))


SUMS = Family(
    "sums",
    "Sums over the team",
    (
        Kind(
            "chargers",
            "Six chargers at one feeder: together they may not draw more than 70 kW",
            lambda s: s.power.sum() > FEEDER,
            chargers_naive,
            chargers_careful,
            entries("charge wanted_charge power_kw", "charger", 5, "power_kw"),
            chargers_seen,
            chargers_begin,
            chargers_move,
            body=Body(n=6, dt=60.0, actions=1, noise=(0.85, 0.3)),
        ),
        Kind(
            "pipe",
            "Five tanks on one pipe: its pressure, which nobody logs, may not fall below 3 bar",
            lambda s: pressure(s) < LEAST,
            pipe_naive,
            pipe_careful,
            ["level", "demand", "valve"],
            lambda s: [np.stack([s.level, s.demand, s.valve], 1)],
            pipe_begin,
            pipe_move,
            body=Body(n=5, dt=10.0, actions=1, noise=(0.85, 0.3)),
        ),
    ),
    (
        Kind(
            "beam",
            "Four carts with loads on a beam that is held in its middle: their moment may not exceed 22 kN m",
            lambda s: abs(lever(s.load, s.p[:, 0])) > LEVER,
            beam_naive,
            beam_careful,
            entries("x vx load_t target_dx", "cart", 3, "dx dvx load_t"),
            beam_seen,
            beam_begin,
            body=Body(steps=90, actions=1, room=(6.0,), apart=0.0),
        ),
    ),
)


# Room and speed together.


def capture_begin(s: Moment) -> None:
    """Each in the frame of its own port."""
    s.p = np.stack([s.rng.uniform(18, 26, 3), s.rng.uniform(-4, 4, 3)], 1)
    s.v = np.stack([-s.rng.uniform(0.2, 0.6, 3), s.rng.uniform(-0.1, 0.1, 3)], 1)
    s.goal = np.zeros((3, 2))


def capture_move(s: Moment, actions: Array) -> float:
    """Who is within 0.6 m is latched."""
    latched = length(s.p) < 0.6
    before, rest = s.p, (s.p, np.zeros_like(s.v))
    reward = pushed(s, actions)
    s.p, s.v = np.where(latched[:, None], rest[0], s.p), np.where(latched[:, None], rest[1], s.v)
    return reward if not latched.any() else float((length(before) - length(s.p)).mean())


def capture_danger(s: Moment) -> Array:
    far = length(s.p)
    fast = length(s.v) > 0.15 + 0.06 * far
    return (fast | (np.abs(s.p[:, 1]) > 0.3 * s.p[:, 0] + 0.5)) & (far >= 0.6)


def capture_drive(k: Kind, seen: Array, share: float) -> Array:
    """At a share of the speed from which it can just stop."""
    far = length(seen[:, :2])[:, None]
    wanted = -seen[:, :2] / np.maximum(far, 0.1) * np.minimum(1.0, share * np.sqrt(2 * k.push * far) + 0.08)
    return np.clip((wanted - seen[:, 2:4]) / (2 * k.dt * k.push), -1, 1)


def capture_careful(k: Kind, seen: Array, care: float) -> Array:
    far = length(seen[:, :2])[:, None]
    towards = seen[:, :2] * np.array([1.0, 1.6])
    way = -towards / np.maximum(length(towards)[:, None], 0.1)
    wanted = way * np.minimum(1.0, 0.08 + 0.045 * far)
    slow = np.clip((wanted - seen[:, 2:4]) / (2 * k.dt * k.push), -1, 1)
    return care * slow + (1 - care) * k.naive(seen)


def ramp_limit(place: Array) -> Array:
    """m/s that is allowed so far down the ramp (m)."""
    return 12.0 - 0.02 * np.clip(place, 0, 300)


def ramp_begin(s: Moment) -> None:
    s.p = -np.sort(-s.rng.uniform(-140, 0, (4, 1)), 0)
    s.load = s.rng.uniform(0, 40, 4)
    s.wanted = s.rng.uniform(6.5, 9.5, 4)
    s.v = s.rng.uniform(3, 6, (4, 1))


def ramp_move(s: Moment, actions: Array) -> float:
    """Loaded trucks brake and speed up less."""
    strength = 1.6 / (1 + s.load[:, None] / 60)
    s.v = np.clip(s.v + s.kind.dt * (strength * actions + 0.15), 0, 14)
    s.p = s.p + s.kind.dt * s.v
    return float(s.v.mean() * s.kind.dt)


def ramp_seen(s: Moment) -> list[Array]:
    return [s.p, s.v, column(s.load), column(s.wanted), s.relative(s.p[s.others], s.v[s.others])]


def ramp_careful(k: Kind, seen: Array, care: float) -> Array:
    wanted = np.minimum(seen[:, 3], ramp_limit(seen[:, 0] + 2 * seen[:, 1]) - 1.5)
    return column(np.clip(care * wanted + (1 - care) * seen[:, 3] - seen[:, 1], -1, 1))


def harbour_allowed(far: Array) -> Array:
    return 0.25 + 0.4 * far


def harbour_careful(k: Kind, seen: Array, care: float) -> Array:
    far = length(offsets(k, seen)).min(1) - 0.5 * length(seen[:, 2:4])
    allowed = np.clip(0.75 * harbour_allowed(far), 0.15, 1.6)
    return driven(k, seen, (care * allowed + (1 - care) * 1.6)[:, None])


ROOM = Family(
    "room",
    "Room and speed together",
    (
        Kind(
            "ramp",
            "Trucks down a ramp of 300 m: the speed limit falls along it, from 12 to 6 m/s",
            lambda s: (s.v > ramp_limit(s.p)).any(),
            lambda k, seen: column(np.clip(seen[:, 3] - seen[:, 1], -1, 1)),
            ramp_careful,
            entries("s speed load_t cruise_speed", "truck", 3, "ds dspeed"),
            ramp_seen,
            ramp_begin,
            ramp_move,
            body=Body(steps=60, dt=0.5, actions=1, noise=(0.85, 0.3)),
        ),
    ),
    (
        Kind(
            "capture",
            "Three craft, each before its port: at most 0.15 m/s and 0.06 m/s for each metre, and within a cone",
            capture_danger,
            lambda k, seen: capture_drive(k, seen, 0.9),
            capture_careful,
            ["along", "aside", "v_along", "v_aside"],
            lambda s: [s.p, s.v],
            capture_begin,
            capture_move,
            body=Body(n=3, steps=90, dt=1.0, push=0.08, noise=(0.8, 0.2)),
        ),
        Kind(
            "harbour",
            "Three boats: nobody may be faster than 0.25 m/s and 0.4 m/s for each metre to the nearest other",
            lambda s: (length(s.v) > harbour_allowed(s.gaps().min(1))).any(),
            at_most(1.6),
            harbour_careful,
            entries("x y vx vy berth_dx berth_dy", "boat", 2, MOVES),
            body=Body(n=3, noise=(0.9, 0.2), push=1.2, apart=1.5),
        ),
    ),
)


# Vehicles that look somewhere.

LANES, WIDE, BASE, STEER = np.array([0.0, 3.5]), 1.9, 3.0, 0.08  # m, m, m, rad


def overlap(places: Array, heading: Array, half: Array) -> Array:
    """(N, N) whether boxes overlap, of places (N, 2), headings (N,) and half lengths and widths (N, 2)."""
    cos, sin = np.cos(heading), np.sin(heading)
    axes = np.stack([np.stack([cos, sin], -1), np.stack([-sin, cos], -1)], 1)  # (N, axis, 2)
    along = np.abs(np.einsum("ijc,iac->ija", places[None] - places[:, None], axes))
    reach = half[:, None] + np.abs(np.einsum("jb,jbc,iac->ijab", half, axes, axes)).sum(-1)
    apart = (along > reach).any(-1)
    return ~(apart | apart.T) & ~np.eye(len(places), dtype=bool)


def lanes_begin(s: Moment) -> None:
    n = s.kind.n
    s.p = np.stack([np.cumsum(s.rng.uniform(7, 16, n))[s.rng.permutation(n)], s.rng.choice(LANES, n)], 1)
    s.cruise, s.aim = s.rng.uniform(9, 15, n), s.rng.choice(LANES, n)
    s.speed = s.cruise + s.rng.normal(0, 1.0, n)
    s.heading, s.long = np.zeros(n), s.rng.choice([4.5, 4.5, 8.0], n)


def lanes_move(s: Moment, actions: Array) -> float:
    dt, before = s.kind.dt, s.p[:, 0]
    s.speed = np.clip(s.speed + dt * 3.0 * actions[:, 0], 0, 18)
    s.heading = s.heading + dt * s.speed / BASE * np.tan(STEER * actions[:, 1])
    s.p = s.p + dt * s.speed[:, None] * np.stack([np.cos(s.heading), np.sin(s.heading)], 1)
    return float((s.p[:, 0] - before).mean() / 10 - 0.05 * np.abs(s.p[:, 1] - s.aim).mean())


def lanes_seen(s: Moment) -> list[Array]:
    look = np.stack([s.heading, s.speed, s.long], 1)
    others = np.concatenate([s.p[s.others] - s.p[:, None], look[s.others]], -1).reshape(s.kind.n, -1)
    return [s.p, look, np.stack([s.aim, s.cruise], 1), others]


def lanes_drive(seen: Array, speed: Array, aim: Array) -> Array:
    way = np.clip(0.15 * (aim - seen[:, 1]), -0.1, 0.1)
    return np.clip(np.stack([0.8 * (speed - seen[:, 3]), 8 * (way - seen[:, 2])], 1), -1, 1)


def lanes_careful(k: Kind, seen: Array, care: float) -> Array:
    """Keeps behind who is ahead in its lane or where it goes, and does not change beside somebody."""
    ds, dd, _, v, long = np.moveaxis(each(seen, 7, 5), -1, 0)
    room = np.abs(ds) - (long + seen[:, 4:5]) / 2
    aside = np.abs(dd + seen[:, 1:2] - seen[:, 5:6]) < 2.4
    busy = (aside & (room < 3 + 0.3 * seen[:, 3:4])).any(1)
    lane = LANES[np.abs(seen[:, 1:2] - LANES).argmin(1)]
    ahead = (ds > 0) & (np.abs(dd) < 2.6)
    follow = np.where(ahead, v + 0.6 * (room - 4 - 0.4 * seen[:, 3:4]), 99.0).min(1)
    careful = lanes_drive(seen, np.clip(follow, 0, seen[:, 6]), np.where(busy, lane, seen[:, 5]))
    return care * careful + (1 - care) * k.naive(seen)


def soon(s: Moment) -> Array:
    """(N,) whether one reaches the car ahead in its lane within 1.5 s, as both go now; cars are 4.5 m long."""
    gap = s.p[None] - s.p[:, None]
    closing = s.v[:, None, 0] - s.v[None, :, 0]
    ahead = (gap[..., 0] > 0) & (np.abs(gap[..., 1]) < 1.8)
    return (ahead & (gap[..., 0] - 4.5 < 1.5 * np.maximum(closing, 0)) & (closing > 0)).any(1)


def headway_begin(s: Moment) -> None:
    n = s.kind.n
    s.p = np.stack([np.cumsum(s.rng.uniform(9, 22, n))[s.rng.permutation(n)], s.rng.choice(LANES, n)], 1)
    s.cruise, s.aim = s.rng.uniform(9, 15, n), s.rng.choice(LANES, n)
    s.v = np.stack([s.cruise + s.rng.normal(0, 1.0, n), np.zeros(n)], 1)


def headway_move(s: Moment, actions: Array) -> float:
    s.v = np.clip(s.v + s.kind.dt * actions * np.array([3.5, 1.5]), [0.0, -1.2], [18.0, 1.2])
    s.p = s.p + s.kind.dt * s.v
    return float(s.v[:, 0].mean() * s.kind.dt / 10 - 0.05 * np.abs(s.p[:, 1] - s.aim).mean())


def headway_seen(s: Moment) -> list[Array]:
    return [s.p, s.v, np.stack([s.aim - s.p[:, 1], s.cruise], 1), s.relative(s.p[s.others], s.v[s.others])]


def headway_drive(seen: Array, speed: Array, aside: Array) -> Array:
    sideways = np.clip(0.5 * aside, -1, 1) - seen[:, 3]
    return np.clip(np.stack([0.7 * (speed - seen[:, 2]), 2.5 * sideways], 1), -1, 1)


def headway_careful(k: Kind, seen: Array, care: float) -> Array:
    ds, dd, dvs, _ = np.moveaxis(each(seen, 6, 4), -1, 0)
    busy = ((np.abs(dd - seen[:, 4:5]) < 2) & (np.abs(ds) < 9)).any(1)
    ahead = (ds > 0) & (np.abs(dd) < 2.2)
    follow = np.where(ahead, seen[:, 2:3] + dvs + 0.35 * (ds - 9), 99.0).min(1)
    back = LANES[np.abs(seen[:, 1:2] - LANES).argmin(1)] - seen[:, 1]
    careful = headway_drive(seen, np.clip(follow, 0, seen[:, 5]), np.where(busy, back, seen[:, 4]))
    return care * careful + (1 - care) * k.naive(seen)


def forks(s: Moment) -> bool:
    """Whether anybody's middle is within 0.7 m of another's forks, which reach from 0.5 to 2.2 m ahead."""
    look = np.stack([np.cos(s.heading), np.sin(s.heading)], 1)
    gap = s.p[None] - s.p[:, None]
    along = np.clip((gap * look[:, None]).sum(-1), 0.5, 2.2)
    far = length(gap - along[..., None] * look[:, None]) + 9 * np.eye(s.kind.n)
    return bool((far < 0.7).any())


def forklifts_seen(s: Moment) -> list[Array]:
    look = np.stack([np.cos(s.heading), np.sin(s.heading)], 1)
    s.v = s.speed[:, None] * look
    others = np.concatenate([s.p[s.others] - s.p[:, None], look[s.others], column(s.speed)[s.others]], -1)
    return [s.p, look, column(s.speed), s.goal - s.p, others.reshape(s.kind.n, -1)]


def forklifts_naive(k: Kind, seen: Array) -> Array:
    off, far = turned(seen[:, 5:7], seen[:, 3], seen[:, 2]), length(seen[:, 5:7])
    wanted = np.minimum(1.1, np.sqrt(1.5 * far)) * np.maximum(np.cos(off), 0.0)
    return np.clip(np.stack([2.0 * off, 3.0 * (wanted - seen[:, 4])], 1), -1, 1)


def forklifts_careful(k: Kind, seen: Array, care: float) -> Array:
    """Turns away from who would be before the forks, slower."""
    action = k.naive(seen)
    for gap in each(seen, 7, 5)[..., :2].swapaxes(0, 1):
        off, far = turned(gap, seen[:, 3], seen[:, 2]), length(gap)
        near = (far < 3.2) & (np.abs(off) < np.radians(50))
        action[:, 0] -= care * np.where(near, 1.8 * np.where(off >= 0, 1.0, -1.0), 0.0)
        action[:, 1] -= care * np.where(near & (far < 2.6), 0.5, 0.0)
    return action


ORIENTED = Family(
    "oriented",
    "Vehicles that look somewhere",
    (
        Kind(
            "lanes",
            "Cars and vans on two lanes, which change them: no two boxes of 4.5 or 8 m by 1.9 m may overlap",
            lambda s: overlap(s.p, s.heading, np.stack([s.long, np.full(s.kind.n, WIDE)], 1) / 2).any(),
            lambda k, seen: lanes_drive(seen, seen[:, 6], seen[:, 5]),
            lanes_careful,
            dotted("s d psi v length target_d cruise", 3, "ds dd psi v length"),
            lanes_seen,
            lanes_begin,
            lanes_move,
            body=Body(dt=0.2, noise=(0.8, 0.25)),
        ),
        Kind(
            "forklifts",
            "Forklifts: nobody may be within 0.7 m of another's forks, which reach from 0.5 to 2.2 m ahead",
            forks,
            forklifts_naive,
            forklifts_careful,
            entries("x y cos sin speed pallet_dx pallet_dy", "truck", 3, "dx dy cos sin speed"),
            forklifts_seen,
            sprayers_begin,
            sprayers_move,
            body=Body(noise=(0.9, 0.25), push=2.0, fastest=1.2, apart=2.6),
        ),
    ),
    (
        Kind(
            "headway",
            "Five cars on two lanes: 1.5 s at least to the bumper of the car ahead, as both go now",
            soon,
            lambda k, seen: headway_drive(seen, seen[:, 5], seen[:, 4]),
            headway_careful,
            dotted("s d vs vd to_lane cruise", 4, "ds dd dvs dvd"),
            headway_seen,
            headway_begin,
            headway_move,
            body=Body(n=5, dt=0.2, noise=(0.8, 0.25)),
        ),
    ),
)


# Agents of different kinds.

RADII = np.array([1.2, 1.2, 0.5, 0.4, 0.4])  # m: two trucks, a cart, two persons
PACES = np.array([1.3, 1.3, 1.6, 0.9, 0.9])[:, None]  # m/s
TRUCKS = np.array([1.0, 1.0, 0.0, 0.0, 0.0])
ROVERS = np.array([1.0, 1.0, 0.0, 0.0])


def paced(paces: Array) -> Callable[[Moment, Array], float]:
    """A step of agents whose greatest speeds differ (N, 1)."""

    def move(s: Moment, actions: Array) -> float:
        before = length(s.goal - s.p)
        s.v = np.clip(s.v + s.kind.dt * s.kind.push * actions, -paces, paces)
        s.p = s.p + s.kind.dt * s.v
        return float((before - length(s.goal - s.p)).mean())

    return move


def marked(mark: Array) -> Callable[[Moment], list[Array]]:
    """Own and others' entries, each with a number (N,) that says of what kind one is."""

    def seen(s: Moment) -> list[Array]:
        gap = [s.p[s.others] - s.p[:, None], s.v[s.others] - s.v[:, None], column(mark)[s.others]]
        return [s.p, s.v, s.goal - s.p, column(mark), np.concatenate(gap, -1).reshape(s.kind.n, -1)]

    return seen


def close_pairs(s: Moment) -> Array:
    """(N, N) m between the edges of two."""
    return s.gaps() - RADII[:, None] - RADII


def wide_careful(k: Kind, seen: Array, care: float) -> Array:
    """Away from whom it would touch, with 0.8 m to spare."""
    other = each(seen, 7, 5)
    far = length(other[..., :2])
    room = (far - seen[:, 6:7] - other[..., 4])[..., None]
    way = other[..., :2] / np.maximum(far, 0.1)[..., None]
    right = np.stack([-way[..., 1], way[..., 0]], -1)
    return k.naive(seen) + care * np.where(room < 0.8, -2.5 * (1.0 - room) * way + 0.5 * right, 0).sum(1)


def near_people(s: Moment) -> bool:
    """Whether a truck is within 1.4 m of one who is none."""
    return bool(s.gaps()[TRUCKS == 1][:, TRUCKS == 0].min() < 1.4)


def works_careful(k: Kind, seen: Array, care: float) -> Array:
    """Trucks keep away from people, who keep away from trucks a little."""
    other = each(seen, 7, 5)
    gap = np.where((other[..., 4:] != seen[:, None, 6:7]), other[..., :2], 99.0)
    return k.naive(seen) + care * np.where(seen[:, 6:7] == 1, 1.0, 0.6) * away(gap, 2.6, 3.5, 0.6)


def survey_danger(s: Moment) -> Array:
    """Rovers pay 1 where they are faster than 0.9 m/s on sand (x > 1.5), drones 2 where two are within 1 m or one is
    more than 5 m from each rover."""
    rover = ROVERS == 1
    sand = rover & (s.p[:, 0] > 1.5) & (length(s.v) > 0.9)
    gaps = s.gaps()
    lost = ~rover & ((gaps[:, rover].min(1) > 5.0) | (gaps[:, ~rover].min(1) < 1.0))
    return sand + 2.0 * lost


def survey_careful(k: Kind, seen: Array, care: float) -> Array:
    other, rover = each(seen, 7, 5), seen[:, 6:7] == 1
    sand = rover & (seen[:, :1] + seen[:, 2:3] > 1.2)
    action = driven(k, seen, np.where(sand, 1.4 - 0.8 * care, 1.4))
    drone = np.where(other[..., 4:] == 0, other[..., :2], 99.0)
    base = np.where(other[..., 4:] == 1, other[..., :2], 99.0)
    gap = base[np.arange(k.n), length(base).argmin(1)]
    far = length(gap)[:, None]
    back = np.where(far > 3.2, 2.5 * (far - 3.2) * gap / np.maximum(far, 0.1), 0.0)
    return np.where(rover, action, action + care * (back + away(drone, 2.0, 2.5, 0.5)))


MIXED = Family(
    "kinds",
    "Agents of different kinds",
    (
        Kind(
            "works",
            "Two trucks and three people: no truck may be within 1.4 m of a person; trucks may meet, and people",
            near_people,
            at_most(1.4),
            works_careful,
            entries(f"{GO} is_truck", "other", 4, f"{MOVES} is_truck"),
            marked(TRUCKS),
            move=paced(PACES),
            body=Body(n=5, room=(4.5, 4.5), apart=2.0, noise=(0.9, 0.25)),
        ),
    ),
    (
        Kind(
            "site",
            "Two trucks, a cart and two persons, round, of different radii: no two may touch",
            lambda s: (close_pairs(s) + 9 * np.eye(5)).min() < 0,
            at_most(1.4),
            wide_careful,
            entries(f"{GO} radius", "other", 4, f"{MOVES} radius"),
            marked(RADII),
            move=paced(PACES),
            body=Body(n=5, room=(5.5, 5.5), apart=2.6, noise=(0.9, 0.25)),
        ),
        Kind(
            "survey",
            "Two rovers that may not drive fast on sand, two drones that may not meet nor lose the rovers; each pays",
            survey_danger,
            at_most(1.4),
            survey_careful,
            entries(f"{GO} is_rover", "other", 3, f"{MOVES} is_rover"),
            marked(ROVERS),
            body=Body(apart=1.4, noise=(0.9, 0.25)),
        ),
    ),
)


# What was before, and is logged.

HOT, AIR = 90.0, 25.0  # degrees Celsius
DRY, FULL_TANK = 0.5, 3.5  # m
DOSE = 1.0  # mSv


def jobs(s: Moment, near: float = 0.5) -> None:
    """Who is at its goal gets another."""
    done = length(s.goal - s.p) < near
    fresh = s.rng.uniform(-np.array(s.kind.room), s.kind.room, s.goal.shape)
    s.goal = np.where(done[:, None], fresh, s.goal)


def motors_begin(s: Moment) -> None:
    placed(s)
    s.heat = s.rng.uniform(40, 80, s.kind.n)


def motors_move(s: Moment, actions: Array) -> float:
    reward = pushed(s, actions)
    s.heat = s.heat + s.kind.dt * (4.5 * (actions**2).sum(-1) - 0.045 * (s.heat - AIR))
    jobs(s)
    return reward


def motors_careful(k: Kind, seen: Array, care: float) -> Array:
    """With less force where the motor is warm."""
    share = np.clip((HOT - 4 - seen[:, 6:7]) / 20, 0.1, 1)
    return k.naive(seen) * (1 - care + care * share)


def with_own(*names: str) -> Callable[[Moment], list[Array]]:
    """Own numbers before the others."""

    def seen(s: Moment) -> list[Array]:
        *own, others = own_and_others(s)
        return [*own, *(getattr(s, n).reshape(s.kind.n, -1) for n in names), others]

    return seen


def levels_begin(s: Moment) -> None:
    n = s.kind.n
    s.level, s.pump = s.rng.uniform(1.2, 2.8, n), s.rng.uniform(0.3, 0.7, n)
    s.order, s.river = s.rng.uniform(0.3, 0.7, n), s.rng.uniform(0.4, 0.6)


def levels_move(s: Moment, actions: Array) -> float:
    """Each pumps up to 10 L/s into the next tank of 3 m²; what is ordered, and what comes from outside, varies."""
    s.pump = np.clip(s.pump + 0.1 * actions[:, 0], 0, 1)
    s.order = np.clip(s.order + s.rng.normal(0, 0.03, s.kind.n), 0.2, 0.8)
    s.river = np.clip(s.river + s.rng.normal(0, 0.03), 0.2, 0.8)
    come = np.concatenate([[s.river], s.pump[:-1]])
    s.level = np.clip(s.level + s.kind.dt * 0.01 * (come - s.pump) / 3, 0, 5)
    return -float(np.abs(s.pump - s.order).mean())


def levels_seen(s: Moment) -> list[Array]:
    come = np.concatenate([[s.river], s.pump[:-1]])
    own = np.stack([s.level, s.pump, come, s.order], 1)
    return [own, of_others(s, column(s.level), column(s.pump))]


def levels_careful(k: Kind, seen: Array, care: float) -> Array:
    """Pumps what comes, and more where the tank is full."""
    wanted = np.clip(seen[:, 2] + 0.5 * (seen[:, 0] - 2.0), 0, 1)
    return column(np.clip(((1 - care) * seen[:, 3] + care * wanted - seen[:, 1]) / 0.1, -1, 1))


def dose_begin(s: Moment) -> None:
    placed(s)
    s.sources = s.rng.uniform(-3, 3, (2, 2))
    s.dose = s.rng.uniform(0, 0.6, s.kind.n)


def sources(s: Moment) -> Array:
    """(N, 2, 2) where the sources are, from each."""
    return s.sources[None] - s.p[:, None]


def dose_move(s: Moment, actions: Array) -> float:
    reward = pushed(s, actions)
    s.dose = s.dose + s.kind.dt * (0.12 / (sources(s) ** 2 + 0.15).sum(-1)).sum(1)
    return reward


def dose_seen(s: Moment) -> list[Array]:
    *own, others = own_and_others(s)
    return [*own, column(s.dose), sources(s).reshape(s.kind.n, -1), others]


def dose_careful(k: Kind, seen: Array, care: float) -> Array:
    """Around the sources, and away from them the more was taken."""
    taken = seen[:, 6:7]
    gap = seen[:, 7:11].reshape(-1, 2, 2)
    return k.naive(seen) + care * (1 + 2 * taken) * away(gap, 2.2, 1.2, 0.6)


MOTORS = Kind(
    "motors",
    "Carts whose motors warm up by force and cool down slowly: at most 90 degrees; each pays for its own",
    lambda s: (s.heat > HOT).astype(float),
    lambda k, seen: driven(k, seen, 2.0),
    motors_careful,
    entries(f"{GO} motor_temperature", "cart", 3, MOVES),
    with_own("heat"),
    motors_begin,
    motors_move,
    body=Body(dt=0.5, push=0.8, fastest=2.0, room=(8.0, 8.0), noise=(0.8, 0.2)),
)
DOSES = Kind(
    "dose",
    "Three robots between two sources of radiation: nobody may have taken more than 1 mSv",
    lambda s: (s.dose > DOSE).any(),
    at_most(1.2),
    dose_careful,
    entries(f"{GO} dose_mSv source0_dx source0_dy source1_dx source1_dy", "robot", 2, MOVES),
    dose_seen,
    dose_begin,
    dose_move,
    body=Body(n=3, noise=(0.9, 0.25)),
)
LOGGED = Family(
    "logged memory",
    "What was before, and is logged",
    (MOTORS, DOSES),
    (
        Kind(
            "levels",
            "Four tanks in a row, each pumped into the next: no level may be below 0.5 m or above 3.5 m",
            lambda s: ((s.level < DRY) | (s.level > FULL_TANK)).any(),
            lambda k, seen: column(np.clip((seen[:, 3] - seen[:, 1]) / 0.1, -1, 1)),
            levels_careful,
            entries("level pump inflow order", "tank", 3, "level pump"),
            levels_seen,
            levels_begin,
            levels_move,
            body=Body(dt=20.0, actions=1, noise=(0.8, 0.4)),
        ),
    ),
)


# What was before, and is not logged.

LOW = 0.15  # of the charge


def charge_begin(s: Moment) -> None:
    placed(s)
    s.charge = s.rng.uniform(0.5, 1.0, s.kind.n)


def charge_move(s: Moment, actions: Array) -> float:
    """Flying takes charge, and force takes more."""
    reward = pushed(s, actions)
    s.charge = np.maximum(s.charge - s.kind.dt * (0.004 + 0.012 * (actions**2).sum(-1)), 0)
    jobs(s)
    return reward


def gently(k: Kind, seen: Array, care: float) -> Array:
    """With less force."""
    return (1 - 0.6 * care) * k.naive(seen)


UNLOGGED = Family(
    "memory not logged",
    "What was before, and is not logged: nobody can tell where danger begins",
    (
        replace(
            DOSES,
            name="fumes",
            says="The robots of `dose`, who log neither what they have taken nor where the sources are",
            takes_care=lambda k, seen, care: driven(k, seen, 1.2 + 0.3 * care),
            names=entries(GO, "robot", 2, MOVES),
            seen=own_and_others,
        ),
    ),
    (
        replace(
            MOTORS,
            name="warm",
            says="The carts of `motors`, who do not log how warm these are",
            takes_care=gently,
            names=entries(GO, "cart", 3, MOVES),
            seen=own_and_others,
        ),
        Kind(
            "empty",
            "Four drones whose batteries may not fall below 15 %, which nobody logs; they begin with 50 to 100 %",
            lambda s: (s.charge < LOW).any(),
            lambda k, seen: driven(k, seen, 2.0),
            gently,
            entries(GO, "drone", 3, MOVES),
            begin=charge_begin,
            move=charge_move,
            body=Body(dt=0.5, push=0.8, fastest=2.0, room=(8.0, 8.0), noise=(0.8, 0.2)),
        ),
    ),
)


# Rays.

POST, ROBOT, FAR = 0.35, 0.25, 6.0  # m
FAN = np.linspace(-np.pi / 2, np.pi / 2, 9)


def ranges(s: Moment, angles: Array, posts: Array, walls: Array | None = None) -> Array:
    """(N, R) m along rays at angles (N, R) to posts, other robots and the walls of a room of these half widths."""
    n = s.kind.n
    at = np.concatenate([np.repeat(posts[None], n, 0), s.p[s.others]], 1)
    radius = np.repeat([POST, ROBOT], [len(posts), n - 1])[:, None]
    ray = np.stack([np.cos(angles), np.sin(angles)], -1)  # (N, R, 2)
    gap = at - s.p[:, None]
    along = gap @ ray.swapaxes(1, 2)  # (N, things, R)
    aside = (gap**2).sum(-1)[..., None] - along**2
    far = along - np.sqrt(np.maximum(radius**2 - aside, 0))
    far = np.where((along > 0) & (aside < radius**2), far, FAR).min(1)
    if walls is not None:
        ray = np.where(np.abs(ray) < 1e-9, 1e-9, ray)
        to_wall = (np.sign(ray) * walls - s.p[:, None]) / ray
        far = np.minimum(far, to_wall.min(-1))
    return np.clip(far, 0, FAR)


ROUND = np.arange(16) * np.pi / 8


def hall_scan(s: Moment) -> Array:
    return ranges(s, np.repeat(ROUND[None], s.kind.n, 0), s.posts, s.walls)


def among_posts(count: int, room: float) -> Callable[[Moment], None]:
    """Places and goals at random, away from posts."""

    def begin(s: Moment) -> None:
        s.walls = s.rng.uniform([3.4, 2.6], [5.0, 4.0])
        while True:
            placed(s)
            s.posts = s.rng.uniform(-room, room, (count, 2))
            if min(length(at[:, None] - s.posts).min() for at in (s.p, s.goal)) > 1.0:
                return

    return begin


def scan_careful(first: int, near: float, strength: float) -> Careful:
    """Away from what is near along rays all around."""

    def drive(k: Kind, seen: Array, care: float) -> Array:
        scan = seen[:, first:]
        angle = np.arange(scan.shape[1]) * 2 * np.pi / scan.shape[1]
        weight = np.where(scan < near, strength * (near - scan), 0.0)
        return k.naive(seen) - care * weight @ np.stack([np.cos(angle), np.sin(angle)], 1)

    return drive


def fans_begin(s: Moment) -> None:
    among_posts(4, 3.5)(s)
    gap = s.goal - s.p
    s.heading = np.arctan2(gap[:, 1], gap[:, 0]) + s.rng.normal(0, 0.3, s.kind.n)
    s.speed = np.zeros(s.kind.n)


def fans_scan(s: Moment) -> Array:
    return ranges(s, s.heading[:, None] + FAN, s.posts)


def fans_seen(s: Moment) -> list[Array]:
    gap = s.goal - s.p
    bearing = wrapped(np.arctan2(gap[:, 1], gap[:, 0]) - s.heading)
    return [np.stack([s.speed, length(gap), bearing], 1), fans_scan(s)]


def fans_naive(k: Kind, seen: Array) -> Array:
    speed, far, bearing = seen[:, :3].T
    wanted = np.minimum(1.1, np.sqrt(1.2 * far)) * np.maximum(np.cos(bearing), 0.0)
    return np.clip(np.stack([2.0 * bearing, 3.0 * (wanted - speed)], 1), -1, 1)


def fans_careful(k: Kind, seen: Array, care: float) -> Array:
    """Turns to where there is room, slower."""
    scan, action = seen[:, 3:], k.naive(seen)
    weight = np.where(scan < 1.6, 1.6 - scan, 0.0) * np.cos(FAN)
    side = np.sign((weight * np.where(FAN >= 0, 1, -1)).sum(1) + 1e-9)
    action[:, 0] -= care * side * np.minimum(2.5 * weight.max(1), 2.5)
    action[:, 1] -= care * 2.0 * np.maximum(weight[:, 2:7].max(1) - 0.4, 0)
    return action


def sonar(s: Moment) -> Array:
    """(N, 8) m to the edge of the nearest other within each of eight cones of 45 degrees, at most 3 m."""
    gap = s.p[s.others] - s.p[:, None]
    cone = np.round(np.arctan2(gap[..., 1], gap[..., 0]) / (np.pi / 4)).astype(int) % 8
    far = np.where(cone[..., None] == np.arange(8), (length(gap) - ROBOT)[..., None], 3.0).min(1)
    return np.clip(far, 0, 3.0)


RAYED = Family(
    "rays",
    "Ranges along rays",
    (
        Kind(
            "halls",
            "Three robots in a room with pillars, which log odometry and sixteen ranges: none may be below 0.35 m",
            lambda s: (hall_scan(s) < 0.35).any(),
            lambda k, seen: driven(k, np.concatenate([seen[:, :2], seen], 1), 1.2),
            scan_careful(4, 1.1, 2.0),
            ["vx", "vy", "goal_dx", "goal_dy", *(f"range_{j}" for j in range(16))],
            lambda s: [s.v, s.goal - s.p, hall_scan(s)],
            among_posts(3, 2.5),
            body=Body(n=3, room=(2.6, 1.9), apart=1.2, noise=(0.9, 0.25)),
        ),
        Kind(
            "sonars",
            "Four robots with eight sonars each, which reach 3 m: nothing may be within 0.45 m; each pays",
            lambda s: (sonar(s) < 0.45).any(1).astype(float),
            at_most(1.3),
            scan_careful(6, 1.4, 2.2),
            [*GO.split(), *(f"sonar_{j}" for j in range(8))],
            lambda s: [s.p, s.v, s.goal - s.p, sonar(s)],
            body=Body(room=(3.0, 3.0), noise=(0.9, 0.25)),
        ),
    ),
    (
        Kind(
            "fans",
            "Three robots that turn, among posts, with nine ranges ahead of them: none may be below 0.4 m",
            lambda s: (fans_scan(s) < 0.4).any(),
            fans_naive,
            fans_careful,
            ["speed", "goal_range", "goal_bearing", *(f"scan_{j}" for j in range(9))],
            fans_seen,
            fans_begin,
            sprayers_move,
            body=Body(n=3, push=2.0, fastest=1.2, noise=(0.9, 0.25)),
        ),
    ),
)


# Lists of the nearest.


def nearest(s: Moment, count: int) -> Array:
    """(N, count) who is nearest, the nearest first."""
    return (s.gaps() + 99 * np.eye(s.kind.n)).argsort(1)[:, :count]


def nearest_of(count: int) -> Callable[[Moment], list[Array]]:
    """Own place, velocity and way to the goal, and the same of the nearest as one sees them."""

    def seen(s: Moment) -> list[Array]:
        who = nearest(s, count)
        return [s.p, s.v, s.goal - s.p, s.relative(s.p[who], s.v[who])]

    return seen


def aside_of(first: int, numbers: int, near: float, strength: float, aside: float) -> Careful:
    """Away from who is listed, from that entry on, of so many numbers each."""
    return lambda k, seen, care: k.naive(seen) + care * away(each(seen, first, numbers)[..., :2], near, strength, aside)


def mail_seen(s: Moment) -> list[Array]:
    """Range, bearing and closing speed of the three nearest."""
    look = np.stack([np.cos(s.heading), np.sin(s.heading)], 1)
    s.v, who = s.speed[:, None] * look, nearest(s, 3)
    gap, moves = s.p[who] - s.p[:, None], s.v[who] - s.v[:, None]
    far = length(gap)
    bearing = wrapped(np.arctan2(gap[..., 1], gap[..., 0]) - s.heading[:, None])
    closing = -(gap * moves).sum(-1) / np.maximum(far, 1e-6)
    goal = s.goal - s.p
    own = [look, s.speed[:, None], column(length(goal))]
    own.append(column(wrapped(np.arctan2(goal[:, 1], goal[:, 0]) - s.heading)))
    return [s.p, *own, np.stack([far, bearing, closing], -1).reshape(s.kind.n, -1)]


def mail_begin(s: Moment) -> None:
    placed(s)
    gap = s.goal - s.p
    s.heading = np.arctan2(gap[:, 1], gap[:, 0]) + s.rng.normal(0, 0.3, s.kind.n)
    s.speed = np.zeros(s.kind.n)


def mail_naive(k: Kind, seen: Array) -> Array:
    return fans_naive(k, seen[:, 4:7])


def mail_careful(k: Kind, seen: Array, care: float) -> Array:
    """Turns away from who comes ahead, slower."""
    far, bearing, closing = np.moveaxis(each(seen, 7, 3), -1, 0)
    action = k.naive(seen)
    urge = np.where((np.abs(bearing) < 1.7) & (far < 2.2), 2.2 - far + 0.4 * np.maximum(closing, 0), 0.0)
    action[:, 0] -= care * np.clip(1.6 * urge * np.where(bearing >= -0.1, 1, -1), -2, 2).sum(1)
    action[:, 1] -= care * 1.5 * np.maximum(urge - 0.6, 0).max(1)
    return action


def three_careful(k: Kind, seen: Array, care: float) -> Array:
    """Away in space from who is within 1.9 m."""
    gap = each(seen, 9, 6)[..., :3]
    far = np.maximum(length(gap), 0.05)[..., None]
    return k.naive(seen) - care * np.where(far < 1.9, 2.2 * (1.9 - far) * gap / far, 0.0).sum(1)


LISTS = Family(
    "lists",
    "Lists of the nearest, which do not say who they are",
    (
        Kind(
            "mail",
            "Six robots that turn, which list range, bearing and closing speed of the three nearest: 0.6 m at least",
            lambda s: s.gaps().min() < 0.6,
            mail_naive,
            mail_careful,
            [f"own.{e}" for e in "x y cos sin speed".split()]
            + ["goal.range", "goal.bearing"]
            + [f"near{k}.{e}" for k in range(3) for e in ("range", "bearing", "closing")],
            mail_seen,
            mail_begin,
            sprayers_move,
            body=Body(n=6, push=2.0, fastest=1.2, room=(4.5, 4.5), noise=(0.9, 0.25)),
        ),
    ),
    (
        Kind(
            "geese",
            "Five drones at one height that list the two nearest: nobody may be within 0.8 m of another",
            lambda s: s.gaps().min() < 0.8,
            spring,
            aside_of(6, 4, 1.9, 2.5, 0.6),
            entries(GO, "near", 2, MOVES),
            nearest_of(2),
            body=Body(n=5, room=(4.5, 4.5), apart=1.1, noise=(0.9, 0.25)),
        ),
        Kind(
            "hive",
            "Six drones in space that list the three nearest: nobody may be within 0.9 m of another; each pays",
            lambda s: (s.gaps().min(1) < 0.9).astype(float),
            spring,
            three_careful,
            entries("x y z vx vy vz goal_dx goal_dy goal_dz", "neighbour", 3, "dx dy dz dvx dvy dvz"),
            nearest_of(3),
            body=Body(n=6, actions=3, push=2.0, room=(3.0, 3.0, 2.0), apart=1.2, noise=(0.9, 0.25)),
        ),
    ),
)


# Three at once.


def knot(s: Moment) -> bool:
    """Whether three are within 1 m of each other."""
    near = (s.gaps() < 1.0).astype(float)
    return bool(np.trace(near @ near @ near) > 0)


def corners(s: Moment) -> Array:
    """(3,) rad of the triangle of three."""
    gap = s.p[s.others] - s.p[:, None]
    cosine = (gap[:, 0] * gap[:, 1]).sum(-1) / np.maximum(length(gap).prod(1), 1e-9)
    return np.arccos(np.clip(cosine, -1, 1))


def surface(s: Moment) -> float:
    """m² of the triangle of three."""
    (ax, ay), (bx, by) = s.p[1] - s.p[0], s.p[2] - s.p[0]
    return 0.5 * abs(ax * by - ay * bx)


def opens(k: Kind, seen: Array, care: float) -> Array:
    """Away from the line through the two others, where it is near, and from both where these are near."""
    gap = offsets(k, seen)
    line = gap[:, 1] - gap[:, 0]
    normal = np.stack([-line[:, 1], line[:, 0]], 1) / np.maximum(length(line)[:, None], 0.1)
    off = (gap[:, 0] * normal).sum(1, keepdims=True)
    push = -np.where(off >= 0, 1.0, -1.0) * np.maximum(1.8 - np.abs(off), 0) * 2.0 * normal
    wide = 0.8 * gap.mean(1) * (length(gap).max(1, keepdims=True) > 4)
    return (1 - 0.5 * care) * k.naive(seen) + care * (push + wide + away(gap, 1.6, 2.0))


def payload_begin(s: Moment) -> None:
    """Three around a payload, to where they stand around it alike."""
    turn = s.rng.uniform(0, 2 * np.pi, 2)[:, None] + np.array([0, 1, 2]) * 2 * np.pi / 3
    around = 0.9 * np.stack([np.cos(turn), np.sin(turn)], -1)
    middle = s.rng.uniform(-4, 4, (2, 1, 2))
    if s.rng.random() < 0.5:
        around[1] = around[0]
    s.p, s.goal = around + middle
    s.v = np.zeros((3, 2))


def stretch(s: Moment) -> Array:
    """(3,) m from each to the payload, which hangs in their middle."""
    return length(s.p - s.p.mean(0))


def payload_careful(k: Kind, seen: Array, care: float) -> Array:
    """Keeps 0.9 m to the middle, and goes with the others."""
    gap = seen[:, 6:].reshape(3, 2, 4)
    middle, moves = gap[..., :2].sum(1) / 3, gap[..., 2:].sum(1) / 3
    far = np.maximum(length(middle), 0.1)[:, None]
    keep = 4.0 * (far - 0.9) * middle / far + 1.2 * moves
    return (1 - 0.3 * care) * k.naive(seen) + care * keep


TRIPLES = Family(
    "three at once",
    "Danger of three at once",
    (
        Kind(
            "knots",
            "Five robots: no three may be within 1 m of each other",
            knot,
            spring,
            crowd_careful,
            entries(GO, "robot", 4, MOVES),
            body=Body(n=5, apart=0.5, fastest=1.2, room=(2.0, 2.0)),
        ),
        Kind(
            "payload",
            "Three robots that carry a payload in their middle: 0.45 m to 1.4 m to it",
            lambda s: (np.abs(stretch(s) - 0.925) > 0.475).any(),
            at_most(1.3),
            payload_careful,
            entries(GO, "robot", 2, MOVES),
            begin=payload_begin,
            move=paced(np.array([[1.5], [1.2], [0.9]])),
            body=Body(n=3, noise=(0.9, 0.2)),
        ),
    ),
    (
        Kind(
            "triangle",
            "Three robots that measure by each other: no corner of their triangle may be below 10 degrees, nor its area"
            " below 0.5 m²",
            lambda s: corners(s).min() < np.radians(10) or surface(s) < 0.5,
            spring,
            opens,
            entries(GO, "robot", 2, MOVES),
            body=Body(n=3, noise=(0.9, 0.25)),
        ),
    ),
)

FAMILIES: tuple[Family, ...] = (SUMS, ROOM, ORIENTED, MIXED, LOGGED, UNLOGGED, RAYED, LISTS, TRIPLES)
OPEN: tuple[Kind, ...] = tuple(kind for family in FAMILIES for kind in family.open)
KEPT: tuple[Kind, ...] = tuple(kind for family in FAMILIES for kind in family.kept)
