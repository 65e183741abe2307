"""What several test files ask for by name."""

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
