"""Look at the built site as a reader without a network would: `python docs/tools/check.py site`.

Scripts, styles, fonts and pictures must lie in the folder; links within the site must lead to a page and a place in it;
and no table, list or fence may have been left as text, which Python-Markdown does where a blank line is missing.
"""

from __future__ import annotations

import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

LOADED = {
    "script": "src",
    "img": "src",
    "link": "href",
    "iframe": "src",
    "source": "src",
    "video": "src",
    "audio": "src",
}
ADDRESS = re.compile(r"""(?:url\(|@import)\s*["']?((?:https?:)?//[^"')\s]+)""")
# A line of Markdown in what should have become HTML: a table's second line, a list's line, a fence.
RAW = re.compile(r"\|\s*:?-{3,}|^\s*(?:[*-]|\d+\.)\s+\S|```|^\s*#{2,}\s", re.M)


class Page(HTMLParser):
    """What a page loads, where it leads, which places it has, and the text of its paragraphs."""

    def __init__(self, text: str):
        super().__init__()
        self.loaded: list[str] = []
        self.led: list[str] = []
        self.places: set[str] = set()
        self.paragraphs: list[str] = []
        self.heads = 0
        self._open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        self.places |= {values[k] for k in ("id", "name") if k in values}
        kind = values.get("rel", "")
        if LOADED.get(tag) in values and kind not in ("canonical", "prev", "next", "edit", "alternate"):
            self.loaded.append(values[LOADED[tag]])
        if tag == "a" and "href" in values:
            self.led.append(values["href"])
        self.heads += tag == "h1"
        if tag == "p":
            self.paragraphs.append("")
        if tag in ("p", "code", "script", "style"):
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag in self._open:
            del self._open[len(self._open) - 1 - self._open[::-1].index(tag) :]

    def handle_data(self, data: str) -> None:
        if self._open == ["p"]:
            self.paragraphs[-1] += data


def problems(site: Path) -> list[str]:
    """In words, one for each thing that is wrong with a built site."""
    pages = {file: Page(file.read_text()) for file in sorted(site.rglob("*.html"))}
    if not pages:
        return [f"'{site}' holds no page; build it with `make docs`."]
    found = []
    for file, page in pages.items():
        name = file.relative_to(site)
        found += [f"{name} has {page.heads} first headings" for _ in [0] if page.heads != 1 and name.name != "404.html"]
        for text in page.paragraphs:
            if raw := RAW.search(text):
                found.append(f"{name} shows Markdown as text: {text[max(0, raw.start() - 40) : raw.end() + 60]!r}")
        for address in page.loaded:
            if address.startswith("data:"):
                continue
            if _outside(address):
                found.append(f"{name} loads {address} from outside")
            elif (
                name.name != "404.html" and not _there(file, address)[0].is_file()
            ):  # its links are from a server's root
                found.append(f"{name} loads {address}, which is not there")
        for address in page.led if name.name != "404.html" else ():
            if _outside(address) or urlsplit(address).scheme:
                continue
            there, place = _there(file, address)
            there = there / "index.html" if there.is_dir() else there
            if not there.exists():
                found.append(f"{name} leads to {address}, which is not there")
            elif place and there in pages and place not in pages[there].places:
                found.append(f"{name} leads to {address}, where there is no such place")
    for file in sorted(site.rglob("*.css")):
        found += [f"{file.relative_to(site)} loads {a} from outside" for a in ADDRESS.findall(file.read_text())]
    return found


def _outside(address: str) -> bool:
    return bool(urlsplit(address).netloc)


def _there(file: Path, address: str) -> tuple[Path, str]:
    """The file that an address leads to from another, and the place in it."""
    parts = urlsplit(address)
    return (file.parent / unquote(parts.path)).resolve() if parts.path else file, unquote(parts.fragment)


def main() -> None:
    site = Path(sys.argv[1] if len(sys.argv) > 1 else "site").resolve()
    wrong = problems(site)
    if wrong:
        sys.exit("\n".join([*wrong, f"{len(wrong)} things are wrong with '{site}'."]))
    print(f"{len(list(site.rglob('*.html')))} pages, complete and without a word from outside: {site / 'index.html'}")


if __name__ == "__main__":
    main()
