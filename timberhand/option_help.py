"""Help of options that can be read at 80 columns: an option on one line, what it does below it, indented.

Typer puts names, types and words side by side, and leaves the words twenty columns of an 80-column terminal.  It has no
setting for that, so its panel of options is replaced where the terminal is narrower than `WIDE_COLUMNS`.
"""

from __future__ import annotations

from typing import Any, Final

from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.panel import Panel
from rich.text import Text
from typer import rich_utils

WIDE_COLUMNS: Final = 110
INDENT: Final = 6
_side_by_side = rich_utils._print_options_panel


def install() -> None:
    """Replace Typer's panel."""
    rich_utils._print_options_panel = _print_options


def _print_options(*, name: str, params: list[Any], ctx: Any, markup_mode: Any, console: Console) -> None:
    """Print the panel ``name`` of options or arguments."""
    if console.width >= WIDE_COLUMNS or not params:
        _side_by_side(name=name, params=params, ctx=ctx, markup_mode=markup_mode, console=console)
        return
    entries: list[RenderableType] = []
    for param in params:
        entries.append(_names(param, ctx))
        help_text = rich_utils._get_parameter_help(param=param, ctx=ctx, markup_mode=markup_mode)
        entries.append(Padding(help_text, (0, 0, 0, INDENT)))
    border, align = rich_utils.STYLE_OPTIONS_PANEL_BORDER, rich_utils.ALIGN_OPTIONS_PANEL
    console.print(Panel(Group(*entries), border_style=border, title=name, title_align=align))


def _names(param: Any, ctx: Any) -> Text:
    """List every spelling of an option, and its values."""
    argument = param.param_type_name == "argument"
    shown = [param.display_name_raw if argument else ", ".join(param.opts)]
    if param.secondary_opts:
        shown.append(", ".join(param.secondary_opts))
    line = Text(" / ".join(shown), style=rich_utils.STYLE_OPTION)
    kind = param.display_type_rich(ctx=ctx) or ""
    if kind not in ("", "<bool>"):
        line.append(f" {kind}", style=rich_utils.STYLE_TYPES)
    return line
