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
RATIO = 400  # times its size that an archive holds at most; ours hold 5 to 33 times theirs
PIECE = 2**20  # bytes that are unpacked at a time
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
            with tarfile.open(fileobj=_content(archive)) as tar:
                for member, file in _checked(out, archive, tar):
                    _place(file, member, tar)
    write_json(out / MARK, digests)


def _content(archive: Path) -> io.BytesIO:
    """The whole of it, so that its checksum is read, and no more than anybody packs."""
    unpacker = lzma.LZMADecompressor(format=lzma.FORMAT_XZ)
    packed = archive.read_bytes()
    most = min(LARGEST, RATIO * len(packed) + PIECE)
    content = io.BytesIO()
    piece = unpacker.decompress(packed, PIECE)
    while piece or not (unpacker.eof or unpacker.needs_input):
        if content.write(piece) and content.tell() > most:
            raise EOFError(f"it holds more than {most / 2**20:.0f} MiB")
        piece = b"" if unpacker.eof else unpacker.decompress(b"", PIECE)
    if not unpacker.eof:
        raise EOFError("its end is missing")
    if content.getbuffer()[-2 * tarfile.BLOCKSIZE :].tobytes().strip(b"\0"):
        raise EOFError("the end of what it holds is missing")
    content.seek(0)
    return content


def _checked(out: Path, archive: Path, tar: tarfile.TarFile) -> list[tuple[tarfile.TarInfo, Path]]:
    """The files of an archive and where each is to stand, before any is written."""
    found: dict[Path, tarfile.TarInfo] = {}
    for number, member in enumerate(tar):
        if number >= MANY:
            raise ValueError(f"it holds more than {MANY:,} files")
        parts = PurePosixPath(member.name).parts
        known = parts and parts[0] in PLACES and ".." not in parts and parts[-1] in ARCHIVES[archive.name]
        short = all(len(part.encode(errors="replace")) <= LONGEST for part in parts)
        short = short and len(member.name) <= 10 * LONGEST
        file = out.joinpath(*parts)
        inside = any(parent in found for parent in file.parents)
        if not (known and short and member.isreg()) or member.issparse() or inside:  # a sparse one claims any size
            raise UserError(f"'{archive}' holds '{member.name}', which is no file of a cell; restore that archive.")
        try:
            within(out, file)
        except ValueError as error:
            raise UserError(f"'{file}' cannot be written ({error}); remove that link.") from None
        found[file] = member
    return [(member, file) for file, member in found.items()]


def _place(file: Path, member: tarfile.TarInfo, tar: tarfile.TarFile) -> None:
    """One file of an archive, where there is none yet; results join those that are there."""
    packed = tar.extractfile(member)
    assert packed is not None  # it is a file
    content = packed.read()
    if file.exists():
        if file.name != "results.json":
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
