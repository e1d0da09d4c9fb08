"""`mapstream check-plugin`: whether a package's operators keep their promises."""

from __future__ import annotations

from typing import Annotated

import anyio
import typer

from mapstream.graph.catalogue import Catalogue
from mapstream.graph.cli.output import ExitCode, JsonFlag, say, say_json
from mapstream.graph.plugins import check_operator, operators_of


def check_plugin(
    package: Annotated[str, typer.Argument(help="An installed package that offers operators.")],
    *,
    json: JsonFlag = False,
) -> None:
    """Check the operators of a package: ports, defaults, documentation, time, and that they repeat themselves."""
    catalogue = Catalogue()
    findings = {name: anyio.run(check_operator, name, catalogue) for name in operators_of(package)}
    if json:
        say_json(findings)
    else:
        for name, found in findings.items():
            has_error = any(finding.level == "error" for finding in found)
            say(f"{name}: {'does not hold' if has_error else 'fine'}")
            for finding in found:
                say(f"  {finding.level}: {finding.message}")
    if any(finding.level == "error" for found in findings.values() for finding in found):
        raise typer.Exit(ExitCode.FAILED)
