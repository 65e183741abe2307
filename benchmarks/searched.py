"""What a guard's search finds in Worlds of the proving ground, with causes and with networks on all entries.

python benchmarks/searched.py results/searched [--tasks proving-hall ...]

For every system and both ways: the share of the steps that a shield's search calls safe and the logs dangerous, and
what the card says else. Every task has a file, which is written after every World; what it holds is not fitted again.
A World takes one to two minutes on two cores.
"""

import argparse
import json
from pathlib import Path

from ringfence.datasets.make import make
from ringfence.datasets.registry import TASKS
from ringfence.envs.proving.suite import TEST
from ringfence.training import worlds
from ringfence.world.card import Card

WAYS = {"causes": True, "networks on all entries": False}


def main() -> None:
    reader = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    reader.add_argument("out", type=Path)
    reader.add_argument("--tasks", nargs="*", default=[f"proving-{name}" for name in TEST], choices=sorted(TASKS))
    given = reader.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    for task in given.tasks:
        file = given.out / f"{task}.json"
        rows = json.loads(file.read_text()) if file.exists() else {}
        for way, causes in WAYS.items():
            if way in rows:
                continue
            store, _ = make(TASKS[task])
            rows[way] = row(worlds.fit(store, seed=0, causes=causes).card)
            print(task, way, rows[way]["searched"], rows[way]["verdict"], flush=True)
            file.write_text(json.dumps(rows, indent=1) + "\n")


def row(card: Card) -> dict:
    """What a card says, as JSON holds it; what is not known is null."""
    scores = card.barrier
    known = scores.searched == scores.searched
    return {
        "searched": scores.searched if known else None,
        "auroc": round(scores.auroc, 4),
        "recall": round(scores.recall, 4),
        "verdict": card.verdict.word,
        "reasons": list(card.verdict.reasons),
    }


if __name__ == "__main__":
    main()
