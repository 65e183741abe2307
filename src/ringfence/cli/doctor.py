"""`ringfence doctor`."""

from __future__ import annotations

import importlib.metadata as metadata
import os

from rich.markup import escape

from ringfence.cli.console import console
from ringfence.errors import UserError

out = console()


def doctor() -> None:
    """Versions, devices, what is missing and how to get it."""
    from ringfence.utils.environment import environment
    from ringfence.utils.files import cache_dir

    versions = environment()
    for name in ("ringfence", "python", "system", "processor", "cores", "git"):
        out.print(f"{name:12} {escape(str(versions[name]))}")
    for name, version in versions["packages"].items():
        out.print(f"{name:12} {version}")
    out.print(f"{'devices':12} {escape(_devices(versions['devices']))}", soft_wrap=True)
    out.print(f"{'cache':12} {escape(str(cache_dir()))}", soft_wrap=True)
    from ringfence.report import video

    try:
        out.print(f"{'films':12} drawn by {video.backend()}")
    except UserError as error:
        out.print(f"{'films':12} [yellow]missing[/], {escape(str(error))}", soft_wrap=True)
    for package, extra, use in (
        ("tensorboardX", "tensorboard", "TensorBoard logs"),
        ("tensorstore", "vault", "OG-MARL's Vaults"),
        ("minari", "minari", "Minari's data sets by their names"),
        ("ray", "ray", "benchmarks on a cluster"),
        ("jax2onnx", "export", "policies as ONNX files"),
        ("mpe2", "test", "parity tests"),
    ):
        try:
            out.print(f"{package:12} {metadata.version(package)}")
        except metadata.PackageNotFoundError:
            out.print(f"{package:12} [yellow]missing[/], for {use}: pip install 'ringfence\\[{extra}]'")


def _devices(found: list[str]) -> str:
    """Devices in words; where JAX finds none, why, and what to do."""
    from ringfence.utils.environment import device_problem

    if found:
        return ", ".join(found)
    chosen = os.environ.get("JAX_PLATFORMS")
    remedy = f"JAX_PLATFORMS={chosen} asks for what is not here; unset it, or" if chosen else ""
    return f"none ({device_problem()}); {remedy} set JAX_PLATFORMS=cpu."
