"""`mirrorwave security`: keys for links between machines, and what of a graph is open to others."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mirrorwave.completion import complete_launch_files
from mirrorwave.console import DEFAULT_DOMAIN, AsJson, Domain, ExitCode, print_json, print_line, print_table

app = typer.Typer(help="Keys for links between machines; what of a graph is open to others.", no_args_is_help=True)


@app.command()
def keygen(
    name: Annotated[
        str,
        typer.Argument(metavar="NAME", help="Of the peer that the keys are for: letters, digits, '_', '-', '.'."),
    ],
    out: Annotated[Path, typer.Option(help="Folder of the keys; made where it is missing.")] = Path("keys"),
    as_json: AsJson = False,
) -> None:
    """Make a pair of keys: NAME.key for the peers, NAME.key_secret for this machine alone; none is written over."""
    from contrib.two_machines.keys import generate, load_public

    public, secret = generate(name, out)
    if as_json:
        print_json({"public": str(public), "secret": str(secret), "public_key": load_public(public).decode()})
        return
    print_line(f"{public}: the public key; peers put it into their folder of allowed keys")
    print_line(f"{secret}: the secret; it stays on this machine, readable by its owner alone")


@app.command()
def check(
    launch_file: Annotated[
        Path | None,
        typer.Argument(
            metavar="LAUNCH_FILE", help="Launch file to look at, too.", autocompletion=complete_launch_files
        ),
    ] = None,
    domain: Domain = DEFAULT_DOMAIN,
    as_json: AsJson = False,
) -> None:
    """Say what others could reach, and the line that mends it; exit code 1 where something must be mended."""
    from contrib.two_machines.security_checks import Grade, all_findings

    findings = all_findings(launch_file, domain)
    if as_json:
        print_json([finding._asdict() for finding in findings])
    else:
        print_table(("CHECK", "STATUS", "DETAIL", "MEND"), findings)
    if any(finding.status is Grade.PROBLEM for finding in findings):
        raise typer.Exit(ExitCode.FAILED)
