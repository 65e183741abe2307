"""Compiled programs are kept for the next process, and never in the way of anybody's own choice."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

# What is kept, after a program was compiled before and one afterwards.
CODE = """
import jax, jax.numpy as jnp
{before}
jax.jit(lambda x: x + 1)(1.0)
from ringfence.utils.compilation import keep_programs
print(keep_programs())
print(keep_programs())
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
print(jax.jit(lambda x: jnp.sin(x) * 2)(1.0))
print(jax.config.jax_compilation_cache_dir, jax.config.jax_compilation_cache_max_size)
"""


def played(home: Path, before: str = "", **variables: str) -> list[str]:
    """The lines that a process of its own prints."""
    inherited = {
        k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "RINGFENCE_")) or k == "JAX_PLATFORMS"
    }
    environment = inherited | {"RINGFENCE_HOME": str(home)} | variables
    code = CODE.format(before=before)
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    return done.stdout.splitlines()


def kept(folder: Path) -> list[str]:
    return sorted(file.name for file in folder.rglob("*-cache"))


def test_programs_are_kept_in_the_users_cache(tmp_path):
    """Though one was compiled before; a second process finds what the first has kept."""
    folder, again, result, config = played(tmp_path)
    assert Path(folder).parent == tmp_path / "compiled" and again == folder
    assert config == f"{folder} {2**28}", "bounded"
    files = kept(tmp_path)
    assert files and all(name.startswith("jit_") for name in files)
    assert played(tmp_path) == [folder, again, result, config] and kept(tmp_path) == files


def test_a_folder_may_be_chosen(tmp_path):
    played(tmp_path / "home", RINGFENCE_COMPILATION_CACHE=str(tmp_path / "mine"))
    assert kept(tmp_path / "mine") and not (tmp_path / "home").exists()


@pytest.mark.parametrize("word", ["0", "off", "False"])
def test_it_can_be_turned_off(tmp_path, word):
    assert played(tmp_path, RINGFENCE_COMPILATION_CACHE=word)[0] == "None"
    assert not kept(tmp_path)


def test_whoever_has_chosen_a_folder_for_jax_keeps_it(tmp_path):
    mine = tmp_path / "mine"
    home = tmp_path / "home"
    lines = played(home, JAX_COMPILATION_CACHE_DIR=str(mine))
    assert lines[0] == "None" and lines[-1] == f"{mine} -1" and not kept(home)
    lines = played(home, f"jax.config.update('jax_compilation_cache_dir', {str(mine)!r})")
    assert lines[0] == "None" and lines[-1] == f"{mine} -1" and not kept(home)
    lines = played(home, "jax.config.update('jax_enable_compilation_cache', False)")
    assert lines[0] == "None" and not kept(home)


def test_what_others_have_set_of_it_stays(tmp_path):
    lines = played(tmp_path, "jax.config.update('jax_compilation_cache_max_size', 10**9)")
    assert lines[-1].endswith(f" {10**9}") and kept(tmp_path)


def test_a_place_that_cannot_be_written_is_passed_over(tmp_path):
    (tmp_path / "file").write_text("mine")
    first, _, result, _ = played(tmp_path / "file" / "below")
    assert first == "None" and float(result) > 1


def test_a_damaged_program_is_compiled_again(tmp_path):
    lines = played(tmp_path)
    for file in tmp_path.rglob("*-cache"):
        file.write_bytes(b"no program")
    assert played(tmp_path) == lines


def test_an_import_sets_nothing_up():
    code = "import sys, ringfence; assert 'jax' not in sys.modules; import ringfence.deploy.controller, jax; "
    code += "assert jax.config.jax_compilation_cache_dir is None"
    inherited = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    subprocess.run([sys.executable, "-c", code], env=inherited, check=True)
