"""The help page of a subcommand: its docstring in flowing paragraphs, its options, its examples."""

import re
from collections.abc import Callable
from inspect import cleandoc
from typing import Any, Final

from cyclopts import App

_MARKUP: Final = re.compile(r"\[(?=[a-z#/@][^\[]*\])")  # what begins a mark of rich's: importing rich for this takes 20 ms


def command_page(function: Callable[..., Any], examples: str, name: str = "") -> App:
    """Return the application of one subcommand. ``examples``: a command line each."""
    text = cleandoc(function.__doc__ or "")
    paragraphs = [_escaped(" ".join(part.split())) for part in text.split("\n\n")]
    lines = "\n".join(f"  {line.strip()}" for line in _escaped(examples).strip().splitlines())
    app = App(
        name=name or function.__name__,
        help="\n\n".join(paragraphs),
        help_epilogue=f"[bold]Examples[/bold]\n\n{lines}\n",
        help_format="rich",
    )
    app.default(function)
    return app


def _escaped(text: str) -> str:
    """Return a text of which rich takes nothing for a mark."""
    return _MARKUP.sub(r"\\[", text)
