"""Pages: escaped, self-contained, and says what is simulated."""

import re

import numpy as np

from pmac_comp.report import figures
from pmac_comp.report.page import Page, Section, Table, cell, render, sentence


def page(text: str) -> str:
    return render(
        Page(
            title=text,
            subtitle=text,
            notice=text,
            headline=[(text, text)],
            sections=[Section(text, text=[text], tables=[Table((text,), [(text,)], text)])],
            facts={text: text},
        )
    )


def test_every_place_escapes_html() -> None:
    html = page('<script>alert("x")</script>')
    assert "<script" not in html
    assert html.count("&lt;script&gt;") >= 9


def test_page_fetches_nothing() -> None:
    image = figures.svg(lambda f: f.subplots().plot([0, 1], [1, 2]) and None, 3.0, 2.0)
    html = render(Page("t", "s", "n", sections=[Section("f", figures=[(image, "caption")])]))
    assert "<svg" in html
    loaded = re.findall(r"(?:src|href)\s*=\s*[\"'](?!#)([^\"']*)", html)
    assert [x for x in loaded if not x.startswith("data:")] == []
    assert "@import" not in html.replace("@media", "")


def test_figure_text_is_escaped_by_the_figure() -> None:
    image = figures.summary_marks([("<b>&name", 1.0, 0.1, None)], 0.05, "mechanical")
    assert "<b>" not in image
    assert "&lt;b&gt;&amp;name" in image


def test_long_text_wraps_in_its_cell() -> None:
    shown = render(Page("t", "s", "n", sections=[Section("x", tables=[
        Table(("name", "how"), [("a", "a sentence that would push the table off the page")])
    ])]))  # fmt: skip
    assert '<td class="text">a sentence' in shown
    assert "<td>a</td>" in shown


def test_thinning_keeps_every_peak() -> None:
    x = np.arange(100_000.0)
    y = np.zeros(x.size)
    y[[123, 77_777]] = 5.0, -7.0
    thin_x, thin_y = figures.thin_pair(x, y)
    assert thin_x.size <= 3000
    assert (thin_y.max(), thin_y.min()) == (5.0, -7.0)
    assert np.all(np.diff(thin_x) >= 0)


def test_cells() -> None:
    assert [cell(v) for v in (None, True, 1.23456789, 7, "x")] == ["–", "yes", "1.235", "7", "x"]


def test_no_promise_makes_no_empty_table() -> None:
    from pmac_comp.report.verification import _promise_tables

    assert _promise_tables((), 0.05) == []


def test_statements_are_a_list_and_text_is_read_from_the_left() -> None:
    scheme = Table(("run scheme", "value"), [("targets", "7")], in_words=True)
    html = render(Page("t", "s", "n", sections=[Section("x", points=["one"], tables=[scheme])]))
    assert "<li>one</li>" in html
    assert '<table class="words">' in html
    assert [sentence(text) for text in ("said", " so it is. ", "")] == ["Said.", "So it is.", "."]


def test_paper_shows_what_is_folded_and_asks_for_a_signature() -> None:
    folded = Section("x", text=["inside"], open=False)
    html = render(Page("t", "s", "n", sections=[folded], signed=("Measured by",)))
    paper = html[html.index("@media print") : html.index("</style>")]
    for said in ("details::details-content", "break-inside: avoid", ".signed { display: flex"):
        assert said in paper
    assert "<span>Measured by</span>" in html
    assert "@page { size: A4" in html


def test_long_names_break_and_heads_wrap() -> None:
    html = page("x")
    style = html[html.index("<style>") : html.index("</style>")]
    heads = [line for line in style.splitlines() if line.startswith("th {")]
    assert len(heads) == 1
    assert "white-space: normal" in heads[0]
    assert "overflow-wrap: anywhere" in style
