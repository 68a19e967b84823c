"""The page of a report: one HTML file that needs nothing else, for screens, phones and printers."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Sequence

_STYLE = """
:root { color-scheme: light; --ink: #1d2a33; --soft: #5b6a75; --line: #d9dfe3; --pale: #f4f7f9; }
* { box-sizing: border-box; }
body { margin: 0; color: var(--ink); background: #fff; line-height: 1.5;
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", "Noto Sans", Helvetica, Arial, sans-serif; }
main { max-width: 1080px; margin: 0 auto; padding: 1.5rem 1.25rem 4rem; }
h1 { font-size: 1.75rem; line-height: 1.2; margin: .5rem 0 .25rem; overflow-wrap: anywhere; }
h2 { font-size: 1.25rem; margin: 2.6rem 0 .75rem; padding-bottom: .3rem;
  border-bottom: 2px solid var(--line); overflow-wrap: anywhere; }
h3 { font-size: 1.02rem; margin: 1.6rem 0 .5rem; overflow-wrap: anywhere; }
p { margin: .5rem 0; max-width: 75ch; }
.soft, figcaption { color: var(--soft); font-size: .875rem; }
nav { margin: 1rem 0 0; font-size: .9rem; } nav a { margin-right: 1.1rem; white-space: nowrap; }
a { color: #0b5c94; }
.figures { display: flex; flex-wrap: wrap; gap: .8rem 1.4rem; margin: 1rem 0; }
.figures div b { display: block; font-size: 1.35rem; font-weight: 600; line-height: 1.25; }
.figures div { min-width: 8.5rem; }
.box { border: 1px solid #d9a400; border-left: 6px solid #e69f00; background: #fff9ea;
  border-radius: 4px; padding: .7rem 1rem; margin: 1.2rem 0; overflow-wrap: anywhere; }
.box h2 { border: 0; margin: 0 0 .3rem; padding: 0; font-size: 1.05rem; }
.box ul { margin: .2rem 0 .5rem; padding-left: 1.3rem; }
.scroll { overflow-x: auto; margin: .8rem 0; }
table { border-collapse: collapse; font-size: .9rem; font-variant-numeric: tabular-nums; }
th, td { padding: .32rem .6rem; text-align: right; border-bottom: 1px solid var(--line);
  vertical-align: top; white-space: nowrap; }
th { font-weight: 600; white-space: normal; vertical-align: bottom;
  border-bottom: 1.5px solid var(--ink); }
th small { display: block; font-weight: 400; color: var(--soft); }
.left { text-align: left; } td.wrap { white-space: normal; min-width: 11rem; }
tfoot td { border-top: 1.5px solid var(--ink); border-bottom: 0; font-weight: 600; }
.swatch { display: inline-block; width: .8em; height: .8em; border-radius: 2px;
  margin-right: .45em; vertical-align: -.05em; }
figure { margin: 1.1rem 0 1.6rem; break-inside: avoid; }
figure .scroll { margin: 0; } figure img { display: block; width: 100%; min-width: 640px; }
figcaption { margin-top: .35rem; max-width: 85ch; }
pre { background: var(--pale); border: 1px solid var(--line); border-radius: 4px; margin: .4rem 0;
  padding: .6rem .8rem; font: .85rem/1.45 ui-monospace, "SF Mono", Menlo, Consolas, monospace;
  overflow-x: auto; }
pre.command { user-select: all; white-space: pre-wrap; overflow-wrap: anywhere; }
details { margin: .6rem 0; } summary { cursor: pointer; color: #0b5c94; }
footer { margin-top: 3rem; border-top: 1px solid var(--line); padding-top: .6rem; }
@media (max-width: 600px) { main { padding: 1rem .9rem 3rem; } h1 { font-size: 1.4rem; } }
@media print { @page { margin: 14mm; } body { font-size: 10.5pt; } main { max-width: none;
  padding: 0; } nav, details:not([open]) { display: none; } figure img { min-width: 0; }
  h2, h3 { break-after: avoid; } tr, .box { break-inside: avoid; } .scroll { overflow: visible; }
  th, td { white-space: normal; padding: .2rem .45rem; } a { color: inherit; } }
"""
GENERATOR = "mjx_revolve.report"


def escape(text: object) -> str:
    """Text for HTML, quotes included."""
    return html.escape(str(text), quote=True)


def picture(data: bytes, kind: str, alt: str, caption: str) -> str:
    """A picture inside the page.

    Args:
        data: the file's bytes.
        kind: "svg+xml", "png" or "jpeg".
        alt: what it shows, for those who cannot see it.
        caption: below it.

    Returns:
        HTML.
    """
    text = base64.b64encode(data).decode()
    return (
        f'<figure><div class="scroll"><img alt="{escape(alt)}" '
        f'src="data:image/{kind};base64,{text}"></div>'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


class Cell(str):
    """A cell that is HTML already."""


def table(
    header: Sequence[str],
    rows: Iterable[Sequence[object]],
    left: Sequence[int] = (0,),
    foot: Sequence[object] | None = None,
    wrap: Sequence[int] = (),
) -> str:
    """A table.

    Args:
        header: names of the columns; what follows a line break is small: the unit.
        rows: the cells; text is escaped, a `Cell` is not.
        left: columns set to the left.
        foot: a last row that sums up.
        wrap: columns with words that may break.

    Returns:
        HTML.
    """

    def cell(tag: str, value: object, k: int) -> str:
        classes = ["left"] * (k in left) + ["wrap"] * (k in wrap and tag == "td")
        text = value if isinstance(value, Cell) else escape(value)
        attribute = f' class="{" ".join(classes)}"' if classes else ""
        return f"<{tag}{attribute}>{text}</{tag}>"

    def head(text: str) -> Cell:
        name, _, unit = text.partition("\n")
        return Cell(escape(name) + (f"<small>{escape(unit)}</small>" if unit else ""))

    def line(tag: str, values: Iterable[object]) -> str:
        return "<tr>" + "".join(cell(tag, value, k) for k, value in enumerate(values)) + "</tr>"

    body = "".join(line("td", row) for row in rows)
    last = f"<tfoot>{line('td', foot)}</tfoot>" if foot is not None else ""
    return (
        f'<div class="scroll"><table><thead>{line("th", map(head, header))}</thead>'
        f"<tbody>{body}</tbody>{last}</table></div>"
    )


def figures(pairs: Iterable[tuple[str, str]]) -> str:
    """A few important numbers, large, each before what it is."""
    return (
        '<div class="figures">'
        + "".join(f"<div><b>{escape(value)}</b>{escape(name)}</div>" for value, name in pairs)
        + "</div>"
    )


def fold(summary: str, inside: str, is_open: bool = False) -> str:
    """Something long that opens on a click; printers leave it out while it is closed."""
    attribute = " open" if is_open else ""
    return f"<details{attribute}><summary>{escape(summary)}</summary>{inside}</details>"


def listing(text: str, command: bool = False) -> str:
    """Text as it is; one click selects all of a command."""
    attribute = ' class="command"' if command else ""
    return f"<pre{attribute}>{escape(text)}</pre>"


def problem_box(runs: Sequence[tuple[str, str, Sequence[str]]], is_grave: bool) -> str:
    """A box about what is wrong with the runs.

    Args:
        runs: for each its name, what its problems make of it, and the problems.
        is_grave: whether something could not be read.

    Returns:
        HTML; "" without problems.
    """
    if not runs:
        return ""
    parts = [
        f"<p><b>{escape(name)}</b>{escape(': ' + state if state else '')}</p><ul>"
        + "".join(f"<li>{escape(problem)}</li>" for problem in problems)
        + "</ul>"
        for name, state, problems in runs
    ]
    heading = "<h2>Worth knowing</h2>"
    if is_grave:
        heading = "<h2>Not everything could be read</h2><p>The report shows what is left.</p>"
    return f'<section class="box" role="alert">{heading}{"".join(parts)}</section>'


def make_page(title: str, lead: str, sections: Sequence[tuple[str, str, str]], foot: str) -> str:
    """The whole page.

    Args:
        title: of the page, plain text.
        lead: HTML below the title.
        sections: anchor, heading and HTML of each.
        foot: plain text at the end.

    Returns:
        A complete HTML document.
    """
    shown = [section for section in sections if section[2]]
    links = " ".join(
        f'<a href="#{anchor}">{escape(name.partition(":")[0].partition(",")[0])}</a>'
        for anchor, name, _ in shown
    )
    body = "".join(
        f'<section id="{anchor}"><h2>{escape(name)}</h2>{content}</section>'
        for anchor, name, content in shown
    )
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta name="generator" content="{GENERATOR}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{_STYLE}</style></head>"
        f"<body><main><header><h1>{escape(title)}</h1>{lead}<nav>{links}</nav></header>{body}"
        f'<footer class="soft"><p>{escape(foot)}</p></footer></main></body></html>\n'
    )
