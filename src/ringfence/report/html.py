"""Templates to pages, and numbers to the words in them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ringfence import __version__
from ringfence.errors import needs
from ringfence.utils.files import whole, writable
from ringfence.utils.text import page

HERE = Path(__file__).parent


def render(template: str, context: dict[str, Any]) -> str:
    """A page from one of the templates beside this file; a name that the context lacks is an error."""
    with needs("report", "Pages"):
        import jinja2
        from markupsafe import Markup

    engine = jinja2.Environment(
        loader=jinja2.FileSystemLoader(HERE),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    engine.filters |= {
        "count": count,
        "duration": duration,
        "number": number,
        "probability": probability,
        "share": share,
        "signed": signed,
    }
    return page(engine.get_template(template).render(version=__version__, css=Markup(asset("style.css")), **context))


def asset(name: str) -> str:
    """A file beside this one."""
    return (HERE / name).read_text(encoding="utf-8")


def page_file(out: str | Path) -> Path:
    """`out`, or `report.html` in it where it is a folder; refused where no page can be written."""
    out = Path(out)
    return writable(out / "report.html" if out.is_dir() else out)


def write(path: Path, text: str) -> Path:
    with whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path


def share(x: float) -> str:
    """A probability as a percentage that never rounds a danger away."""
    percent = 100 * x
    return f"{percent:.1f} %" if percent >= 1 or percent == 0 else f"{percent:.2f} %"


def number(x: float, digits: int) -> str:
    return f"{x:,.{digits}f}".replace("-", "−")


def signed(x: float, digits: int) -> str:
    return f"{x:+,.{digits}f}".replace("-", "−")


def probability(p: float) -> str:
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


def count(x: int | None) -> str:
    if x is None:
        return "–"
    for size, letter in ((1e6, " M"), (1e3, " k")):
        if x >= size:
            return f"{x / size:.3g}{letter}"
    return str(x)


def duration(seconds: float | None) -> str:
    return "–" if seconds is None else f"{seconds:,.0f}"
