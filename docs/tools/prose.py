"""Measure the prose of README.md, docs/ and the notebooks: `python docs/tools/prose.py`.

Prose is what is left of a page without headings, tables, code, quoted messages and generated blocks. A list's item is a
paragraph of its own. A page fails where its sentences are too long in the mean, a paragraph is too long or holds too
many numbers, or a word stands that only this project uses; all of them, where they are too many or hold too many words.

    python docs/tools/prose.py                       # a line for each page, and the total
    python docs/tools/prose.py --pages start guard   # some pages, and where each of them fails
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
GOAL = 14  # words a sentence, in the mean of a page
LIMIT = 17
MEAN = 12  # and of all
WORDS, PAGES = 26_000, 28  # of README.md and docs/, tables and code included
LONGEST = 120  # words of a paragraph
NUMBERS = 3  # of a paragraph
# The project's own words, and the field's or plain English for them.
OURS = {
    r"told": "given, said, reported; or the thing itself",
    r"strange(?:ness|ly)?": "out of distribution",
    r"sights?": "observation, sensing radius, decentralized",
    r"alike": "homogeneous, equal",
    r"hears?|heard": "observe, receive",
    r"twins?(?! critic)": "paired baseline, ablation",
    r"wires?|wired": "connects, passes",
    r"foresee[ns]?|foresaw|foresight": "predicts, predicted, prediction",
    r"avoidable": "cost of episodes that start safe",
    r"hazards?": "constraint, danger",
    r"togo": "returns-to-go",
    r"blind(?:ly)?": "naive",
}
PRIVATE = re.compile(r"\b(?:" + "|".join(OURS) + r")\b", re.I)

BLOCK = re.compile(r"<!-- (\S[^>]*?) -->.*?<!-- /\1 -->", re.S)
FENCE = re.compile(r"^[ ]*(```|~~~).*?^[ ]*\1[ ]*$", re.M | re.S)
FORMULA = re.compile(r"\$\$.*?\$\$|\$[^$\n]+\$", re.S)
ITEM = re.compile(r"\s*(?:[*+-]|\d+\.)\s+")
WORD = re.compile(r"\S*[^\W\d_]\S*")
SHORTENED = re.compile(r"\b(e\.g|i\.e|et al|vs|cf|Eq|Eqs|Fig|resp|etc)\.")
END = re.compile(r"""[.!?]["')\]*_]*(?=\s+["'(\[*_]*(?:[A-Z0-9À-Þ]|CODE))""")
NUMBER = re.compile(r"(?<![\w.,])[−+-]?\d[\d.,]*(?:e-?\d+)?")
# A year of a paper or of a collection, and numbers that belong to a name.
NAMED = re.compile(
    r"\b(?:19|20)\d\d[a-z]?\b|\b(?:ROS|Python|MuJoCo|Gymnasium|format|version|Eqs?\W+|Equations?|Section|CUDA)\s*\(?\d[\d.]*\)?|"
    r"\b\d+\.\d+\.\d+\b|\bv\d[\d.]*\b"
)


class Paragraph(NamedTuple):
    """A paragraph as it is read, and as it stands in the file."""

    text: str
    line: int

    @property
    def words(self) -> int:
        return len(WORD.findall(self.text))

    @property
    def numbers(self) -> int:
        return len(NUMBER.findall(NAMED.sub(" ", self.text)))

    @property
    def private(self) -> list[str]:
        return PRIVATE.findall(self.text)

    @property
    def sentences(self) -> int:
        """At least one: a list's item without a full stop is a sentence, too."""
        marked = SHORTENED.sub(r"\1", self.text)
        return len([s for s in END.split(marked) if WORD.search(s)])


def paragraphs(page: str) -> list[Paragraph]:
    """The prose of a page of Markdown."""
    for kind in (BLOCK, FENCE):
        page = kind.sub(lambda found: "\n" * found.group().count("\n"), page)
    found: list[Paragraph] = []
    gathered: list[str] = []
    first, listed = 1, False

    def close() -> None:
        if gathered and WORD.search(text := readable(" ".join(gathered))):
            found.append(Paragraph(text, first))
        gathered.clear()

    for number, line in enumerate(page.splitlines(), 1):
        if not line.strip():
            close()
            continue
        item = ITEM.match(line)
        if not gathered and not item and line.startswith("    ") and not listed:
            continue  # a block of code
        if line.startswith(("|", "#", ">")) or re.match(r"\s*(?:<|!\[)", line):
            close()
            listed = False
            continue
        if item or not gathered:
            close()
            first = number
            listed = bool(item) or (listed and line.startswith(" "))
        gathered.append(line[item.end() :] if item else line.strip())
    close()
    return found


def readable(text: str) -> str:
    """As a reader sees it: code is one word, a link is its words."""
    text = FORMULA.sub("CODE", text)
    text = re.sub(r"`[^`]*`", "CODE", text)
    text = re.sub(r"!\[[^\]]*\]\([^)]*\)", "", text)
    text = re.sub(r"\[([^\]]*)\]\([^)\s]*\)", r"\1", text)
    text = re.sub(r"https?://\S+|<!--.*?-->|<[^>]+>", "", text)
    return re.sub(r"[*_]{1,2}(?=\S)|(?<=\S)[*_]{1,2}", "", text).strip()


class Measured(NamedTuple):
    """What the check knows of one page."""

    name: str
    paragraphs: list[Paragraph]

    @property
    def words(self) -> int:
        return sum(p.words for p in self.paragraphs)

    @property
    def mean(self) -> float:
        return self.words / max(sum(p.sentences for p in self.paragraphs), 1)

    @property
    def private(self) -> list[str]:
        return [word for p in self.paragraphs for word in p.private]

    def failures(self) -> list[str]:
        """In words, each with its line."""
        found = []
        if self.mean > LIMIT:
            found.append(f"{self.name}: {self.mean:.1f} words a sentence, at most {LIMIT}")
        for p in self.paragraphs:
            place = f"{self.name}:{p.line}"
            if p.words > LONGEST:
                found.append(f"{place}: a paragraph of {p.words} words, at most {LONGEST}")
            if p.numbers > NUMBERS:
                found.append(f"{place}: {p.numbers} numbers in a paragraph, at most {NUMBERS}; make it a table")
            for word in p.private:
                (better,) = {say for own, say in OURS.items() if re.fullmatch(own.split("(?!")[0], word, re.I)}
                found.append(f"{place}: '{word}' is a word of this project; say {better}")
        return found

    def row(self) -> str:
        longest = max((p.words for p in self.paragraphs), default=0)
        numbers = max((p.numbers for p in self.paragraphs), default=0)
        verdict = "FAILS" if self.failures() else "long sentences" if self.mean > GOAL else ""
        measured = f"{self.words:7d}{self.mean:10.1f}{longest:9d}{numbers:9d}{len(self.private):9d}"
        return f"{self.name:42s}{measured}  {verdict}".rstrip()


def pages(root: Path = ROOT) -> dict[str, Path]:
    """By the name that `--pages` takes."""
    found = {"README": root / "README.md"}
    found |= {f.stem: f for f in sorted((root / "docs").glob("*.md"))}
    found |= {f.stem: f for f in sorted((root / "examples").glob("*.ipynb"))}
    return found


def measure(file: Path, root: Path = ROOT) -> Measured:
    """Of a notebook the cells of words are the page."""
    text = file.read_text()
    if file.suffix == ".ipynb":
        words = ("".join(c["source"]) for c in json.loads(text)["cells"] if c["cell_type"] == "markdown")
        text = "\n\n".join(words)
    return Measured(str(file.relative_to(root)), paragraphs(text))


def too_much(mean: float) -> list[str]:
    """What fails of all pages together."""
    files = [file for file in pages().values() if file.suffix == ".md"]
    words = sum(len(file.read_text().split()) for file in files)
    print(f"{len(files)} pages of {words} words, tables and code included")
    limits = (("words a sentence", mean, MEAN), ("words", words, WORDS), ("pages", len(files), PAGES))
    return [f"{value:.4g} {what}, at most {most}" for what, value, most in limits if value > most]


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pages", nargs="+", choices=list(pages()), metavar="PAGE", help="some alone, with reasons")
    chosen = parser.parse_args(arguments).pages
    measured = [measure(file) for name, file in pages().items() if not chosen or name in chosen]
    print(f"{'page':42s}{'words':>7s}{'a sentence':>10s}{'longest':>9s}{'numbers':>9s}{'private':>9s}")
    print("\n".join(page.row() for page in measured))
    words = sum(page.words for page in measured)
    sentences = sum(p.sentences for page in measured for p in page.paragraphs)
    print(f"{'together':42s}{words:7d}{words / max(sentences, 1):10.1f}")
    wrong = [line for page in measured for line in page.failures()]
    if not chosen:
        wrong += too_much(words / max(sentences, 1))
    if chosen:
        print(*wrong, sep="\n")
    elif wrong:
        print(f"{len(wrong)} things to mend; `python docs/tools/prose.py --pages NAME` says where.")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
