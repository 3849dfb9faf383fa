"""Small parts of generated Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table; bars in cells are escaped."""

    def line(cells: Sequence[object]) -> str:
        return "| " + " | ".join(str(cell).replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"

    return "\n".join([line(head), "|" + "---|" * len(head), *map(line, rows)])


def generated(title: str, source: str, introduction: str) -> str:
    """The head of a generated page: title, where it comes from, what it says."""
    return (
        f"# {title}\n\n<!-- generated from {source} by `python -m timberhand.reference`; do not edit -->\n\n"
        f"{introduction}\n"
    )
