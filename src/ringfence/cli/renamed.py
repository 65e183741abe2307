"""Commands and flags of before: they work for one release, and a line on stderr says today's name."""

from __future__ import annotations

import sys

from ringfence.utils import stored

# Of `ringfence data X` the command is "data X", of `ringfence bench X` it is "bench X".
OLD_COMMANDS: dict[str, str] = {"judge": "ope", "get": "pretrained"}
# By today's command; "" holds flags of every command.
OLD_FLAGS: dict[str, dict[str, str]] = {
    command: {
        "--danger": "--barrier",
        "--sight": "--execution",
        "--rows": "--horizon",
        "--plans": "--num-samples",
        "--steps": "--sampling-steps",
        "--guidance": "--cfg-scale",
        "--target": "--target-return",
    }
    for command in ("eval", "play", "export", "ope")
}
OLD_FLAGS["eval"] |= {"--record": "--num-recorded", "--step": "--checkpoint"}
OLD_FLAGS["export"] |= {"--step": "--checkpoint"}
OLD_FLAGS["play"] |= {"--at-once": "--num-envs"}
OLD_FLAGS["fit"] = {"--sight": "--execution"}
OLD_FLAGS["bench"] = {"--steps": "--num-updates"}
OLD_FLAGS["train"] = {"--together": "--vmap-seeds"}
for importer in ("data import-table", "data import-bag"):
    OLD_FLAGS[importer] = {
        "--longest": "--max-episode-steps",
        "--shortest": "--min-episode-steps",
        "--fastest": "--max-speed",
        "--sight": "--sensing-radius",
    }
# By today's flag.
OLD_VALUES: dict[str, dict[str, str]] = {
    "--barrier": stored.BARRIERS,
    "--execution": stored.EXECUTIONS,
    "--planner": stored.PLANNERS,
}


def rewritten(arguments: list[str]) -> list[str]:
    """The same command under today's names."""
    words = list(arguments)
    length = 2 if words[:1] in (["data"], ["bench"]) else 1
    command = " ".join(words[:length])
    if command in OLD_COMMANDS:
        _say(command, OLD_COMMANDS[command])
        command = OLD_COMMANDS[command]
        words[:length] = command.split()
    flags = OLD_FLAGS.get("", {}) | OLD_FLAGS.get("".join(words[:1]), {}) | OLD_FLAGS.get(command, {})
    for k, word in enumerate(words):
        flag, equals, value = word.partition("=")
        if flag in flags:
            _say(flag, flags[flag])
            words[k] = flags[flag] + equals + value
    return _values(words)


def _values(words: list[str]) -> list[str]:
    """Words whose values have other names now, e.g. `--barrier formula`."""
    for k, word in enumerate(words):
        flag, equals, value = word.partition("=")
        values = OLD_VALUES.get(flag, {})
        if equals and value in values:
            _say(f"{flag} {value}", f"{flag} {values[value]}")
            words[k] = f"{flag}={values[value]}"
        elif not equals and words[k + 1 : k + 2] and words[k + 1] in values:
            _say(f"{flag} {words[k + 1]}", f"{flag} {values[words[k + 1]]}")
            words[k + 1] = values[words[k + 1]]
    return words


def _say(old: str, new: str) -> None:
    print(f"note: '{old}' is called '{new}' now; the old name goes with the next release.", file=sys.stderr)
