"""A results folder as a repository keeps it: two archives in place of thousands of small files.

DIR/runs.tar.xz      config, environment, status and results of every cell, and the reference rows
DIR/curves.tar.xz    the training metrics of every cell

What reads a results folder calls `unpack` first; who has made cells calls `pack`. The loose files (`cells/`,
`reference/`) stand beside the archives, with checkpoints where the cells were made here, and may be deleted.
"""

from __future__ import annotations

import hashlib
import io
import json
import lzma
import tarfile
from pathlib import Path, PurePosixPath

from ringfence.errors import UserError, reading
from ringfence.training.runs import write_json
from ringfence.utils import schemas
from ringfence.utils.files import regular, whole, within

PLACES = ("cells", "reference")
ARCHIVES = {
    "runs.tar.xz": ("config.json", "env.json", "status.json", "results.json", "stress.json", "reference.json"),
    "curves.tar.xz": ("metrics.jsonl",),
}
LARGEST = 2**29  # bytes of an archive, unpacked
MANY = 20_000  # files in an archive; the largest of ours holds 2,700
LONGEST = 200  # bytes of a name in a path: `whole` adds some of its own to them
MARK = Path("cells", ".unpacked.json")  # digests of the archives whose files are loose


def unpack(out: str | Path) -> None:
    """Write what the archives of `out` hold and its loose files lack; what was made here since then stays.

    An archive is unpacked once: a cell that is deleted afterwards stays deleted, and the next `pack` forgets it.
    """
    out = Path(out)
    archives = [out / name for name in ARCHIVES if (out / name).exists()]
    if not archives:
        return
    for archive in archives:
        try:
            regular(archive)
        except ValueError as error:
            raise UserError(f"'{archive}' cannot be read ({error}); restore that file.") from None
    digests = {a.name: hashlib.sha256(a.read_bytes()).hexdigest() for a in archives}
    if (out / MARK).exists():
        done = schemas.read(out / MARK, dict[str, str], "holds a damaged mark; delete that file")
        if done == digests:
            return
    for archive in archives:
        with reading(archive, "archive of results", "restore that file", UserError):
            with tarfile.open(fileobj=io.BytesIO(_content(archive))) as tar:
                for number, member in enumerate(tar):
                    if number >= MANY:
                        raise ValueError(f"it holds more than {MANY:,} files")
                    _place(out, archive, member, tar)
    write_json(out / MARK, digests)


def _content(archive: Path) -> bytes:
    """The whole of it, so that its checksum is read, and no more than anybody packs."""
    unpacker = lzma.LZMADecompressor(format=lzma.FORMAT_XZ)
    content = unpacker.decompress(archive.read_bytes(), max_length=LARGEST)
    if not unpacker.eof:
        raise EOFError(f"its end is missing, or it holds more than {LARGEST / 2**20:.0f} MiB")
    return content


def _place(out: Path, archive: Path, member: tarfile.TarInfo, tar: tarfile.TarFile) -> None:
    """One file of an archive, where there is none yet; results join those that are there."""
    parts = PurePosixPath(member.name).parts
    known = parts and parts[0] in PLACES and ".." not in parts and parts[-1] in ARCHIVES[archive.name]
    short = all(len(part.encode(errors="replace")) <= LONGEST for part in parts) and len(member.name) <= 10 * LONGEST
    if not (known and short and member.isreg()) or member.issparse():  # a sparse one claims any size in a few bytes
        raise UserError(f"'{archive}' holds '{member.name}', which is no file of a cell; restore that archive.")
    file = out.joinpath(*parts)
    try:
        within(out, file)
    except ValueError as error:
        raise UserError(f"'{file}' cannot be written ({error}); remove that link.") from None
    packed = tar.extractfile(member)
    assert packed is not None  # it is a file
    content = packed.read()
    if file.exists():
        if parts[-1] != "results.json":
            return
        results = schemas.read(file, schemas.Results, "holds a damaged results.json; delete that file")
        content = json.dumps({**schemas.decode(content, schemas.Results), **results}, indent=1).encode()
    with whole(file) as temporary:
        temporary.write_bytes(content)


def pack(out: str | Path) -> list[Path]:
    """Write the archives of what is loose in `out`: the same bytes for the same contents."""
    out = Path(out)
    if not (out / "bench.json").exists():
        return []
    unpack(out)
    found = [f for p in PLACES for f in sorted((out / p).rglob("*.json*"))]
    written = []
    for name, kinds in ARCHIVES.items():
        chosen = [f for f in found if f.name in kinds and not f.parent.name.startswith(".")]
        if not chosen:
            continue
        with whole(out / name) as temporary, tarfile.open(temporary, "w:xz", format=tarfile.PAX_FORMAT) as tar:
            for file in chosen:
                content = file.read_bytes()
                member = tarfile.TarInfo(str(file.relative_to(out)))
                member.size = len(content)
                tar.addfile(member, io.BytesIO(content))
        written.append(out / name)
    write_json(out / MARK, {a.name: hashlib.sha256(a.read_bytes()).hexdigest() for a in written})
    return written
