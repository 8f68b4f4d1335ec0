"""The settings of a run as a table on the terminal: every setting resolved, and marked where it
differs from the recipe's.
"""

from dataclasses import asdict
from typing import Any

from rich import box
from rich.table import Table
from rich.text import Text

from jobs.training.recipes import RECIPES
from jobs.training.recipes.recipe import Recipe
from pipeline.core.progress import console


def print_config(recipe: Recipe, **run: object) -> None:
    """Print all settings of a recipe and of the run (shards, out, ...) on standard error."""
    # The console's soft wrap, meant for sentences, would let the cells run out of the table.
    console.print(config_table(recipe, run), soft_wrap=False)


def config_table(recipe: Recipe, run: dict[str, object]) -> Table:
    """One row per group of settings; `*` marks one that differs from the named recipe's own, which
    follows in brackets.

    A recipe that is not in RECIPES has nothing to differ from.
    """
    own = settings_by_group(recipe)
    known = recipe.name in RECIPES
    named = settings_by_group(RECIPES[recipe.name]()) if known else own
    changed = sum(
        value != named[group][name] for group in own for name, value in own[group].items()
    )
    differs = (
        f"{changed} changed (*)" if changed else "as it is" if known else "none of the named ones"
    )
    table = Table(
        title=f"recipe {recipe.name}, {differs}",
        box=box.SIMPLE_HEAD, show_header=False, show_edge=False, title_justify="left",
    )  # fmt: skip
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    for group, settings in own.items():
        table.add_row(
            group,
            Text("  ").join(cell(name, settings[name], named[group][name]) for name in settings),
        )
    table.add_row("run", Text("  ").join(Text(f"{name}={value}") for name, value in run.items()))
    return table


def settings_by_group(recipe: Recipe) -> dict[str, dict[str, Any]]:
    """The recipe's settings by group: network, optimization, ...; the others under `training`."""
    plain = asdict(recipe)
    parts = {name: value for name, value in plain.items() if isinstance(value, dict)}
    return parts | {"training": {name: value for name, value in plain.items() if name not in parts}}


def cell(name: str, value: object, named: object) -> Text:
    if value == named:
        return Text(f"{name}={value}")
    return Text(f"*{name}={value} (not {named})", style="bold yellow")
