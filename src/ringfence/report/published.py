"""Results of others, as printed, for reading beside ours. They are not measured here and never ranked with our rows."""

from __future__ import annotations

from dataclasses import dataclass

from ringfence.datasets import registry

NOTE = "Published, on the public data files; ours are on regenerated data."


@dataclass(frozen=True)
class Published:
    """A method's printed values by task: normalised return times 100."""

    name: str
    source: str
    algorithms: tuple[str, ...]  # what the method is called here, without hyphens
    values: dict[str, float]


OMAR = "Pan et al. 2022 (OMAR), as tabulated in MADIFF's README"
MADIFF = "Zhu et al. 2024 (MADIFF), README"
COFLOW = "Guowei-Zou/coflow-release, raw returns of its table of MPE, normalised here"


def _spread(expert: float, replay: float, medium: float, random: float, pool: str = "") -> dict[str, float]:
    """OMAR and those before it learn one learner's logs a run; MADIFF and CoFlow learn five learners' at once, which
    are our tasks of the name's ending `pool`."""
    return {
        f"simple_spread-expert{pool}": expert,
        f"simple_spread-medium-replay{pool}": replay,
        f"simple_spread-medium{pool}": medium,
        f"simple_spread-random{pool}": random,
    }


def _robots(**raw: tuple[float, float, float]) -> dict[str, float]:
    """Raw returns of good, medium and poor by robot; no speed limit was known there, so both protocols show them."""
    found = {}
    for robot, returns in raw.items():
        for tier, value in zip(("good", "medium", "poor"), returns):
            for name in (f"{robot}-{tier}", f"{robot}-{tier}-quantile"):
                found[name] = round(100 * registry.get(name).normalised_return(value), 1)
    return found


PUBLISHED = (
    Published("BC", OMAR, ("bc",), _spread(35.0, 10.0, 31.6, -0.5)),
    Published(
        "BC",
        MADIFF,
        ("bc",),
        _robots(halfcheetah_2x3=(6846, 1627, 465), ant_2x4=(2697, 1145, 954), ant_4x2=(2802, 1617, 1033)),
    ),
    Published(
        "MA-TD3+BC",
        MADIFF,
        ("matd3bc",),
        _robots(halfcheetah_2x3=(7025, 2561, 736), ant_2x4=(2922, 744, 1256), ant_4x2=(2628, 1843, 1075)),
    ),
    Published(
        "OMAR",
        MADIFF,
        ("omar",),
        _robots(halfcheetah_2x3=(1434, 1892, 384), ant_2x4=(464, 799, 857), ant_4x2=(344, 929, 518)),
    ),
    Published(
        "MADiff-D (each agent plans for itself)",
        MADIFF,
        ("madiff",),
        _robots(halfcheetah_2x3=(8246, 2207, 759), ant_2x4=(2946, 1211, 946), ant_4x2=(3080, 1649, 1295)),
    ),
    Published("MA-ICQ", OMAR, ("maicq",), _spread(104.0, 13.6, 29.3, 6.3)),
    Published("MA-TD3+BC", OMAR, ("matd3bc",), _spread(108.3, 15.4, 29.3, 9.8)),
    Published("MA-CQL", OMAR, ("macql",), _spread(98.2, 20.0, 34.1, 24.0)),
    Published("OMAR", OMAR, ("omar",), _spread(114.9, 37.9, 47.9, 34.4)),
    Published("MADiff-D (each agent plans for itself)", MADIFF, ("madiff",), _spread(95.0, 30.3, 64.9, 6.9, "-pooled")),
    Published("MADiff-C (one joint plan)", MADIFF, ("madiff",), _spread(116.7, 42.2, 58.2, 4.3, "-pooled")),
    Published("CoFlow-C (one joint flow)", COFLOW, ("flow",), _spread(119.4, 47.6, 59.9, 53.9, "-pooled")),
)


def matches(entry: Published, algorithm: str) -> bool:
    """Whether an algorithm of ours is meant, however its name is hyphenated."""
    return "".join(c for c in algorithm.lower() if c.isalnum()) in entry.algorithms
