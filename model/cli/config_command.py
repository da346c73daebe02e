"""`forehoi config`: the whole of a configuration, or what differs between two."""

import click
import yaml

from model.cli.options import plain_errors
from model.recipes.components.component_identity import as_yaml
from model.recipes.config import load_config
from shards.configuration.differences import differences

__all__ = ["config_command"]


@click.command("config")
@click.argument("name", metavar="NAME|FILE")
@click.option("--diff", "other", metavar="NAME|FILE", help="Print only what differs from this configuration.")
@plain_errors
def config_command(name: str, other: str | None) -> None:
    """Print the whole of a configuration, merged with all that it extends, as YAML that reads back the same.

    With --diff: a line for each setting that differs, `key: value of the other -> value of this one`.

    \b
    Example:
      forehoi config small
      forehoi config own.yaml --diff tiny
    """
    text = as_yaml(load_config(name))
    if other is None:
        click.echo(text, nl=False)
        return
    for line in differences(yaml.safe_load(as_yaml(load_config(other))), yaml.safe_load(text)):
        click.echo(line)
