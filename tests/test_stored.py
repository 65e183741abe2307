"""What lies in results/ is in the words of the code that reads it."""

from __future__ import annotations

import csv
import dataclasses
import json
import tarfile
from pathlib import Path

import pytest

from ringfence import algos
from ringfence.bench import table
from ringfence.guards import GUARDS, GuardOptions
from ringfence.proposals.options import PlanOptions
from ringfence.utils import schemas
from ringfence.utils.config import build_config, fields_of
from ringfence.world import Settings

RESULTS = Path(__file__).parents[1] / "results"
SOME = 3  # files of each kind that are looked at in an archive: all of them were written by one program
OPTIONS = {"options": PlanOptions, "guard_options": GuardOptions, "world_settings": Settings}


def files_of(archive: Path, name: str) -> list[dict]:
    """Some of the files of that name."""
    with tarfile.open(archive) as tar:
        found = [member for member in tar if member.name.endswith(f"/{name}")]
        return [json.loads(tar.extractfile(member).read()) for member in found[:: max(1, len(found) // SOME)]]


@pytest.mark.parametrize("archive", sorted(RESULTS.glob("*/runs.tar.xz")), ids=lambda file: file.parent.name)
def test_committed_runs_and_results_say_all_that_todays_do(archive):
    for config in files_of(archive, "config.json"):
        algorithm = algos.get(config["algorithm"])
        assert config["config"].keys() == fields_of(algorithm.Config).keys()
        build_config(algorithm.Config, config["config"], algorithm.name)
        assert config.keys() >= set(schemas.Config.__annotations__)
    for result in (result for file in files_of(archive, "results.json") for result in file.values()):
        assert result.get("guard", "none") in GUARDS
        assert result.keys() <= {*schemas.Result.__annotations__, "provenance"}
        for part, kind in OPTIONS.items():
            assert (result.get(part) or {}).keys() <= {f.name for f in dataclasses.fields(kind)}, part


@pytest.mark.parametrize("file", sorted(RESULTS.glob("*/table.csv")), ids=lambda file: file.parent.name)
def test_committed_tables_have_columns_of_today(file):
    with file.open(newline="") as opened:
        heads = csv.DictReader(opened).fieldnames
    assert heads and set(heads) <= set(table.COLUMNS)
