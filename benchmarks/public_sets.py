"""Public logs, each imported by one command: what comes of it.

python benchmarks/public_sets.py FOLDER    # writes results/public_sets.csv; half a minute

FOLDER holds clones of the repositories in SETS, each under its own name (OpenTraj, SynDrone-Swarm, ...). Sets that are
not there keep the row that they had.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

from common import RESULTS, read, write

from ringfence.logs.store import EpisodeStore

OUT = RESULTS / "public_sets.csv"
PEDESTRIANS = "--layout obsmat --neighbours 4 --separation 0.5"
SETS = {  # name: (owner of the repository, command, file in FOLDER, options)
    "ETH, seq_eth": ("crowdbotp", "import-table", "OpenTraj/datasets/ETH/seq_eth/obsmat.txt", PEDESTRIANS),
    "ETH, hotel": ("crowdbotp", "import-table", "OpenTraj/datasets/ETH/seq_hotel/obsmat.txt", PEDESTRIANS),
    "UCY, zara02": ("crowdbotp", "import-table", "OpenTraj/datasets/UCY/zara02/obsmat.txt", PEDESTRIANS),
    "UCY, students03": ("crowdbotp", "import-table", "OpenTraj/datasets/UCY/students03/obsmat.txt", PEDESTRIANS),
    "SynDrone-Swarm, A-DEN": (
        "MehmetUnall",
        "import-table",
        "SynDrone-Swarm/sample/A-DEN/telemetry.csv",
        "--layout syndrone --separation 2",
    ),
    "SUMO, fcd-output": (
        "LAURAMICHAELLA",
        "import-table",
        "NS3-SUMO-EVALVID/Performance_Evaluation/sumo-examples/my-first/fcd.xml",
        "--layout sumo --neighbours 4 --separation 5",
    ),
    "LeRobot v2, a G1's two arms": ("YifanTian07", "import-lerobot", "G1-policy-train", "--arms kLeft kRight"),
    "LeRobot v3, an SO-101": ("SamueleSandrini", "import-lerobot", "record-test", ""),
}


def row(name: str, folder: Path) -> dict[str, object]:
    """What the command makes of a set."""
    _, command, place, options = SETS[name]
    with tempfile.TemporaryDirectory() as made:
        out = Path(made) / "store.h5"
        call = [sys.executable, "-m", "ringfence", "data", command, str(folder / place), *options.split(), "--out"]
        said = subprocess.run([*call, str(out)], capture_output=True, text=True)
        if said.returncode:
            return {"set": name, "episodes": "", "steps": "", "agents": "", "dt": "", "unsafe": said.stderr.strip()}
        store = EpisodeStore.load(out)
    return {
        "set": name,
        "episodes": store.episodes,
        "steps": store.steps,
        "agents": store.n_agents,
        "dt": f"{store.card.dt:.3g}",
        "unsafe": f"{100 * (store.team_costs > 0).mean():.2g} %" if "--separation" in options else "not logged",
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    found: dict[str, dict[str, object]] = {each["set"]: dict(each) for each in read(OUT)}
    for name, (_, _, place, _) in SETS.items():
        if (folder / place).exists():
            found[name] = row(name, folder)
            print(*found[name].values(), flush=True)
    write(OUT, [found[name] for name in SETS if name in found])


if __name__ == "__main__":
    main()
