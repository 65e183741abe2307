"""What several test files ask for by name."""

import dataclasses

# A World that is fitted in a second and knows little.
QUICK_WORLD = dict(
    num_ensemble=2,
    dynamics_updates=20,
    dynamics_width=16,
    value_updates=20,
    barrier_updates=20,
    barrier_width=8,
    future_updates=20,
)


def insisted(world):
    """The World with a verdict that lets guards use it, however little it knows."""
    import msgspec

    from ringfence.world.card import Verdict

    return dataclasses.replace(world, card=msgspec.structs.replace(world.card, verdict=Verdict("fit")))
