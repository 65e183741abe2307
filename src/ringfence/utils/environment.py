"""What a run was made with: versions, devices, the machine."""

from __future__ import annotations

import os
import platform
import subprocess
from pathlib import Path

import jax

from ringfence import __version__


def environment() -> dict:
    """Versions and hardware, for env.json."""
    import importlib.metadata as metadata

    packages = ("jax", "jaxlib", "equinox", "optax", "numpy", "scipy", "h5py", "safetensors")
    return {
        "ringfence": __version__,
        "python": platform.python_version(),
        "packages": {p: metadata.version(p) for p in packages},
        "devices": [] if device_problem() else [f"{d.platform}: {d.device_kind}" for d in jax.devices()],
        "processor": processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "system": platform.platform(terse=True),
        "git": _git(),
    }


def device_problem() -> str:
    """Why JAX finds no device; empty where it finds some."""
    try:
        jax.devices()
    except RuntimeError as error:
        return (str(error).splitlines() or [type(error).__name__])[0]
    except AssertionError:  # JAX's own, where the platform that is asked for has no plugin here
        return "JAX knows no such platform"
    return ""


def processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def _git() -> str | None:
    here = Path(__file__).resolve().parent
    try:
        out = subprocess.run(
            ["git", "-C", str(here), "describe", "--always", "--dirty"], capture_output=True, text=True, timeout=5
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return out.stdout.strip() or None
