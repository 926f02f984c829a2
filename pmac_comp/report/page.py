"""Self-contained HTML: one template, all text escaped, figures inside, nothing fetched."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from pmac_comp.base.atomic import atomic_write_text


@dataclass(frozen=True)
class Table:
    """A table: column names and rows of values; ``in_words`` where they are text, not figures."""

    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]
    caption: str = ""
    in_words: bool = False


@dataclass(frozen=True)
class Section:
    """One section of a page: paragraphs, statements as a list, tables, figures with captions."""

    title: str
    text: Sequence[str] = ()
    points: Sequence[str] = ()
    tables: Sequence[Table] = ()
    figures: Sequence[tuple[str, str]] = ()
    open: bool = True


@dataclass(frozen=True)
class Page:
    """A page: what it says first, what is simulated, then sections.

    Parameters
    ----------
    title, subtitle : str
        Heading.
    notice : str
        What is simulated and what is measured.
    headline : sequence of (str, str)
        Figure and what it is.
    sections : sequence of Section
        The rest.
    facts : Mapping
        Small print: bench, controller, versions.
    signed : sequence of str
        Blanks to be filled in by hand; they are seen on paper only.
    """

    title: str
    subtitle: str
    notice: str
    headline: Sequence[tuple[str, str]] = ()
    sections: Sequence[Section] = ()
    facts: Mapping[str, Any] = field(default_factory=dict)
    signed: Sequence[str] = ()


def write_page(page: Page, path: Path) -> Path:
    """Write a page, whole or not at all; gives back its path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic_write_text(path, render(page))
    return path


def render(page: Page) -> str:
    """HTML text of a page."""
    environment = Environment(
        loader=PackageLoader("pmac_comp.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["cell"] = cell
    # Figures are our own SVG, made by matplotlib, which escapes the text it is given.
    environment.filters["figure"] = Markup
    return environment.get_template("page.html").render(page=page)


def sentence(text: str) -> str:
    """Text of a remark as a sentence: a capital first, a full stop last."""
    said = text.strip().rstrip(".")
    return f"{said[:1].upper()}{said[1:]}."


def cell(value: Any) -> str:
    """Text of a table cell: four significant digits, a dash for nothing."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    return str(value)
