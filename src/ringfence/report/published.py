"""Results of others, as printed, for reading beside ours. They are not measured here and never ranked with our rows."""

from __future__ import annotations

from dataclasses import dataclass

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


def _spread(expert: float, replay: float, medium: float, random: float) -> dict[str, float]:
    return {
        "simple_spread-expert": expert,
        "simple_spread-medium-replay": replay,
        "simple_spread-medium": medium,
        "simple_spread-random": random,
    }


PUBLISHED = (
    Published("BC", OMAR, ("bc",), _spread(35.0, 10.0, 31.6, -0.5)),
    Published("MA-ICQ", OMAR, ("maicq",), _spread(104.0, 13.6, 29.3, 6.3)),
    Published("MA-TD3+BC", OMAR, ("matd3bc",), _spread(108.3, 15.4, 29.3, 9.8)),
    Published("MA-CQL", OMAR, ("macql",), _spread(98.2, 20.0, 34.1, 24.0)),
    Published("OMAR", OMAR, ("omar",), _spread(114.9, 37.9, 47.9, 34.4)),
    Published("MADiff-D (each agent plans for itself)", MADIFF, ("madiff",), _spread(95.0, 30.3, 64.9, 6.9)),
    Published("MADiff-C (one joint plan)", MADIFF, ("madiff",), _spread(116.7, 42.2, 58.2, 4.3)),
)


def matches(entry: Published, algorithm: str) -> bool:
    """Whether an algorithm of ours is meant, however its name is hyphenated."""
    return "".join(c for c in algorithm.lower() if c.isalnum()) in entry.algorithms
