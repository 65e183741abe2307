"""Fixtures that several files share; small, and made once per session."""

from __future__ import annotations

import gc
import os
import shutil
import tempfile
from importlib.metadata import version
from pathlib import Path

# The tests compile many programs and run each a few times, so the compiler's optimisations cost twice what they give,
# and so do threads: each worker has a core.
# Set before JAX starts; whoever sets XLA_FLAGS himself, even to nothing, tests with those.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true --xla_cpu_multi_thread_eigen=false"
    # one that does not know a flag ends at once
    + " --xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
    * version("jaxlib").startswith("0.10."),
)
os.environ.setdefault("NPROC", "1")  # threads of XLA
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # of NumPy

# Programs that several tests compile alike (a resumed training, a policy loaded again) are compiled once.
os.environ["JAX_COMPILATION_CACHE_DIR"] = os.environ.get("JAX_COMPILATION_CACHE_DIR") or tempfile.mkdtemp(
    prefix="ringfence-tests-"
)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")

# Worlds that tests fit are not the user's; workers share those of the process that began them.
os.environ["RINGFENCE_TESTS_HOME"] = os.environ.get("RINGFENCE_TESTS_HOME") or tempfile.mkdtemp(
    prefix="ringfence-home-"
)
os.environ["RINGFENCE_HOME"] = os.environ["RINGFENCE_TESTS_HOME"]

import jax
import numpy as np
import pytest

from ringfence.datasets.behaviour import collect
from ringfence.envs import SimpleSpread
from ringfence.logs.store import EpisodeStore
from ringfence.problem import constraints
from ringfence.world import judging
from tests import quick

# What judges a World, and not what it is made of, takes a third of a small fit: whether actions could have avoided
# danger, what a guard's search would call safe, what rows far ahead ask for. Worlds of tests are judged where
# `@pytest.mark.judged` says so, of fewer entries and by a search that never begins again.
judging.JUDGING = quick.LITTLE

# Tracing makes many objects that stay; looking through them for garbage as often as usual takes a tenth of the time.
gc.set_threshold(50_000, 20, 20)


# Files that take longest, begun first: one of them begun last would leave the other workers idle.
LONGEST = (
    "guard crossing export proving ope replay causes algorithms constraints spread_alike world bench cli limits stress "
    "notebooks precision bounds flow parallel behaviour"
).split()


def pytest_configure(config):
    config.option.loadscopereorder = False  # pytest-xdist would begin with the files of most tests


def pytest_collection_modifyitems(items):
    place = {f"test_{name}": k for k, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path.stem, len(place)))


def pytest_unconfigure(config):
    """Leave nothing in the folder for temporary files; workers share the cache of the process that began them."""
    if hasattr(config, "workerinput"):
        return
    for name, ours in (("RINGFENCE_TESTS_HOME", "ringfence-home-"), ("JAX_COMPILATION_CACHE_DIR", "ringfence-tests-")):
        if ours in os.environ[name]:
            shutil.rmtree(os.environ[name], ignore_errors=True)


@pytest.fixture(autouse=True, scope="module")
def forget_programs():
    """A process may map so many pieces of memory and no more, and each program takes some: before they run out, what
    was compiled is forgotten. Programs that files share stay until then."""
    yield
    maps, limit = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
    if limit.exists() and len(maps.read_bytes().splitlines()) > int(limit.read_text()) // 2:
        jax.clear_caches()
        gc.collect()


@pytest.fixture(scope="session")
def played() -> dict[str, np.ndarray]:
    """Forty episodes of Simple Spread under uniform actions, as arrays (E, L, ...)."""
    return collect(SimpleSpread(), "random", 40, jax.random.key(7))


@pytest.fixture(scope="session")
def own_store(played) -> EpisodeStore:
    """The same episodes as anybody's own logs: what agents see, by name, a hazard, and no state."""
    names = SimpleSpread().feature_map("decentralized").names
    seen = played["observations"][..., : len(names)]
    card = {"task": "my-robots", "observation_names": list(names), "hazard": constraints.Separation(0.3)}
    return EpisodeStore.from_episodes(seen, played["actions"], played["rewards"], played["costs"], card=card)


@pytest.fixture(scope="session")
def small_store(played) -> EpisodeStore:
    """The same episodes as a store."""
    return EpisodeStore.from_episodes(
        played["observations"],
        played["actions"],
        played["rewards"],
        played["costs"],
        state=played["state"],
        card={
            "task": "simple_spread-random",
            "state_names": list(SimpleSpread().state_names),
            "hazard": constraints.to_dict(constraints.Separation()),
            "provenance": "made by the tests",
        },
    )


@pytest.fixture(scope="session")
def small_world(small_store):
    """The World of the small store."""
    from ringfence.training import worlds

    return worlds.fit(small_store, **quick.QUICK_WORLD)


@pytest.fixture(autouse=True)
def insist(request, monkeypatch):
    """Worlds of tests are fitted in a second and unfit to guard by, so guards insist on them; but where a test is of
    verdicts (`@pytest.mark.verdicts`)."""
    if request.node.get_closest_marker("judged") is not None:
        monkeypatch.setattr(judging, "JUDGING", quick.IN_FULL)
    if request.node.get_closest_marker("verdicts") is None:
        for name in ("require", "require_values"):
            monkeypatch.setattr(f"ringfence.guards.policy.{name}", lambda card, anyway=False: None)
