"""Sections of a report as text for a terminal, and as one HTML page that needs no other file."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import wrap

from sb3_rpto.sysid.report.sections import Section, Table
from sb3_rpto.version import __version__

#: Columns of the text, and the fewest of a cell that is wrapped.
WIDTH, NARROW = 100, 12


def html_of(title: str, sections: Sequence[Section]) -> str:
    """A page without scripts or links; what names hold is escaped.

    :raises ImportError: matplotlib, which draws the figures, is not installed
    """
    from jinja2 import Environment, PackageLoader

    loader = PackageLoader("sb3_rpto.sysid.report", "templates")
    environment = Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    shown = [section for section in sections if section.medium != "text"]
    template = environment.get_template("report.html.j2")
    return template.render(title=title, sections=shown, version=__version__) + "\n"


def text_of(sections: Sequence[Section]) -> str:
    """Lines of at most 100 columns, but for longer names and numbers."""
    lines: list[str] = []
    for section in sections:
        if section.medium == "page":
            continue
        indent = "  " * (section.level - 1)
        title = section.title[:1].lower() + section.title[1:]
        lines += ["", title] if section.level == 2 else [f"  {section.title}"]
        for paragraph in (*section.paragraphs, *([section.formula] if section.formula else [])):
            lines += _wrapped(paragraph, indent)
        if section.table is not None:
            lines += aligned(section.table)
        for item in section.evidence:
            lines += _wrapped(item, indent)
    return "\n".join(lines[1:])


def _wrapped(text: str, indent: str) -> list[str]:
    return wrap(
        text,
        WIDTH,
        initial_indent=indent,
        subsequent_indent=f"{indent}  ",
        break_long_words=False,
        break_on_hyphens=False,
    )


def aligned(table: Table, indent: str = "  ") -> list[str]:
    """Lines of a table whose columns stand under each other; the widest is wrapped where it has no room."""
    rows = [[*table.header], *([*row] for row in table.rows)]
    widths = [max(map(len, column)) for column in zip(*rows)]
    beyond = len(indent) + sum(widths) + 2 * (len(widths) - 1) - WIDTH
    if beyond > 0:
        widest = widths.index(max(widths))
        widths[widest] = max(NARROW, widths[widest] - beyond)
    lines = []
    for row in rows:
        cells = [wrap(cell, width, break_long_words=False) or [""] for cell, width in zip(row, widths)]
        for at in range(max(map(len, cells))):
            line = [(cell[at] if at < len(cell) else "").ljust(width) for cell, width in zip(cells, widths)]
            lines.append((indent + "  ".join(line)).rstrip())
    return lines
