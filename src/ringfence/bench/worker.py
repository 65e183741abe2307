"""A worker process: takes groups of cells as JSON lines, makes them, tells what happened as JSON lines.

It leaves when its pipe closes or its parent is gone, so that a killed runner leaves nobody writing behind.
"""

from __future__ import annotations

import gc
import json
import os
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # a worker says that it is there before it imports JAX
    from ringfence.bench.cells import Cell


def encode(cell: Cell) -> dict[str, Any]:
    return dict(vars(cell))


def decode(message: dict[str, Any]) -> Cell:
    from ringfence.bench.cells import Cell

    pairs = {name: tuple(tuple(pair) for pair in message[name]) for name in ("changes", "evaluations", "trials")}
    return Cell(**{**message, **pairs})


def leave_with(parent: int) -> None:
    """End this process once its parent is another one than it was."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.2)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def forget() -> None:
    """Let go of compiled programs: the next job's are others, and kept they grow a worker by 80 MiB a small job."""
    import jax

    jax.clear_caches()
    gc.collect()


def main() -> None:
    leave_with(os.getppid())
    wire = sys.stdout
    sys.stdout = sys.stderr  # prints of libraries must not mix with the messages

    def say(**message: Any) -> None:
        print(json.dumps(message), file=wire, flush=True)

    from ringfence.bench import cells as grid
    from ringfence.utils import interrupts

    interrupts.listen()
    say(event="ready")
    for line in sys.stdin:
        job = json.loads(line)
        out = Path(job["out"])
        try:
            if "reference" in job:
                grid.make_reference(job["reference"], out, job["episodes"], job["transitions"])
            else:
                group = [decode(c) for c in job["cells"]]
                grid.run_group(group, out, job["episodes"], lambda event, cell: say(event=event, cell=encode(cell)))
            say(event="finished")
        except KeyboardInterrupt:
            return
        except Exception as error:
            say(event="broken", error=f"{type(error).__name__}: {error}")
        forget()
