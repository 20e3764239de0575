"""The help page of a subcommand: its docstring in flowing paragraphs, its options, its examples."""

from collections.abc import Callable
from inspect import cleandoc
from typing import Any

from cyclopts import App
from rich.markup import escape


def command_page(function: Callable[..., Any], examples: str, name: str = "") -> App:
    """Return the application of one subcommand. ``examples``: a command line each."""
    text = cleandoc(function.__doc__ or "")
    paragraphs = [escape(" ".join(part.split())) for part in text.split("\n\n")]
    lines = "\n".join(f"  {line.strip()}" for line in escape(examples).strip().splitlines())
    app = App(
        name=name or function.__name__,
        help="\n\n".join(paragraphs),
        help_epilogue=f"[bold]Examples[/bold]\n\n{lines}\n",
        help_format="rich",
    )
    app.default(function)
    return app
