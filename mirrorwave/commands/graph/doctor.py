"""`mirrorwave doctor`: is this machine fit, and does the graph do well; names what fails and why."""

from __future__ import annotations

import typer

from mirrorwave.console import DEFAULT_DOMAIN, AsJson, Domain, ExitCode, print_result, print_table


def doctor(domain: Domain = DEFAULT_DOMAIN, as_json: AsJson = False) -> None:
    """Check this machine and, if one runs, the graph; exit code 1 if a check failed."""
    from mirrorwave.diagnose.doctor_machine import all_findings
    from mirrorwave.diagnose.findings import Status

    findings = all_findings(domain)
    rows = [finding._asdict() for finding in findings]
    print_result(as_json, rows, lambda: print_table(("CHECK", "STATUS", "DETAIL"), findings))
    if any(finding.status is Status.FAILED for finding in findings):
        raise typer.Exit(ExitCode.FAILED)
