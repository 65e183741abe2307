"""`ringfence log`: what `Controller(log=FILE)` wrote."""

from __future__ import annotations

from collections import Counter
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import tyro

from ringfence.cli.shared import console
from ringfence.errors import plain, whole_number
from ringfence.utils.text import lines

out = console()
Positional = tyro.conf.Positional


def verify(file: Positional[Path], last: str | None = None) -> None:
    """Tell whether a log is what was written. The first record that was changed, cut or lacks is named; exit status 2.

    Args:
        file: the log.
        last: digest of a record that was kept elsewhere; a log that lacks it was cut or made anew.
    """
    from ringfence.utils.chained import check

    found = check(file, last)
    ended = (
        "its writer ended it"
        if found.ended
        else "its writer did not end it: it runs, was stopped, or the end was cut off"
    )
    out.print(f"{found.records} records are what was written; {ended}.", soft_wrap=True)
    print(found.last)


def show(file: Positional[Path], first: int = 0, number: int = 20) -> None:
    """Show records of a log in words, and what all of it came to.

    Args:
        file: the log.
        first: record that is shown first.
        number: how many are shown.
    """
    from ringfence.utils import schemas
    from ringfence.utils.chained import LogError, records

    whole_number("first", first)
    whole_number("number", number)
    counts: Counter[str] = Counter()
    every = records(file)
    for record in every:
        try:
            schemas.check(record, schemas.RECORDS.get(record["kind"], schemas.Event))
        except ValueError as error:
            raise LogError(f"'{file}': record {record['n']} is none of a controller ({error}).", record["n"]) from None
        counts["records"] += 1
        kind = record["kind"]
        if kind in ("step", "refused"):
            counts["steps" if kind == "step" else "refusals"] += 1
        counts["steps with a correction"] += bool(record.get("corrected"))
        for flag in ("covered", "proved"):
            counts[f"not {flag}"] += record.get(flag) is False
        if first <= record["n"] < first + number:
            for line in in_words(record):
                out.print(lines(plain(line)), soft_wrap=True)
    shown = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
    out.print(f"In all: {shown}.", soft_wrap=True)


def in_words(record: dict[str, Any]) -> list[str]:
    """A record, a line each."""
    when = datetime.fromtimestamp(record["t"], UTC).isoformat(timespec="milliseconds").removesuffix("+00:00")
    head = f"{record['n']:>6}  {when}  {record['kind']}"
    if record["kind"] == "begin":
        names = ("agents", "policy", "world", "certificate", "barrier")
        return [f"{head}  " + ", ".join(f"{name} {record[name]}" for name in names if record.get(name) is not None)]
    if record["kind"] == "refused":
        return [f"{head}  {record['why']}"]
    if record["kind"] != "step":
        return [head]
    flags = [name for name in ("covered", "proved") if record.get(name)]
    flags += [f"not {name}" for name in ("covered", "proved") if record.get(name) is False]
    flags += [f"{name} of {record[name]}" for name in ("infeasible", "ood") if record.get(name)]
    found = [f"{head}  {record['ms']:.1f} ms" + "".join(f", {flag}" for flag in flags)]
    for one in record.get("corrected", ()):
        thing = f" of {one['thing']}" if one["thing"] else ""
        executed = dict(enumerate(record["executed"])).get(one["agent"])
        score = "no number of" if one["score"] is None else f"{one['score']:.3g}"
        found.append(
            f"        agent {one['agent']}: {one['requested']} -> {executed}, since {one['constraint']}{thing} came to "
            f"{score} margins in row {one['row']}"
        )
    return found


COMMANDS = {"verify": verify, "show": show}
