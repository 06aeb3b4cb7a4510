"""`mirrorwave param`: parameters of running nodes, read and changed."""

from __future__ import annotations

import json
from typing import Annotated, Any

import typer

from mirrorwave.completion import NodeName, complete_nodes
from mirrorwave.console import DEFAULT_DOMAIN, AsJson, Domain, print_json, print_line, print_result, print_table
from msgs.values.wording import did_you_mean

app = typer.Typer(help="Read and change parameters of running nodes.", no_args_is_help=True)


@app.command("list")
def list_params(
    node: Annotated[
        str | None, typer.Argument(metavar="NODE", help="Only this node.", autocompletion=complete_nodes)
    ] = None,
    domain: Domain = DEFAULT_DOMAIN,
    as_json: AsJson = False,
) -> None:
    """All parameters of the nodes of a graph."""
    from mirrorwave.control.node_params import current_params

    said = current_params(domain, node)
    values = {name: json.loads(item.params) for name, item in said.items() if node in (None, name)}
    if as_json:
        print_json(values)
        return
    rows = [(name, key, _text(value)) for name, params in values.items() for key, value in _leaves(params)]
    print_table(("NODE", "PARAMETER", "VALUE"), rows)


@app.command("get")
def get_param(
    node: NodeName,
    key: Annotated[str | None, typer.Argument(metavar="KEY", help="Dotted name; all if left out.")] = None,
    domain: Domain = DEFAULT_DOMAIN,
    as_json: AsJson = False,
) -> None:
    """Show one parameter of a node, or all."""
    from mirrorwave.control.node_params import current_params

    value = json.loads(current_params(domain, node)[node].params)
    for part in key.split(".") if key else ():
        if not isinstance(value, dict) or part not in value:
            known = f"known are {', '.join(value)}" if isinstance(value, dict) else "it has no parts"
            near = did_you_mean(part, value if isinstance(value, dict) else ())
            raise ValueError(f"{node}: unknown parameter {key!r}; {known}{near}")
        value = value[part]
    if as_json:
        print_json(value)
    elif isinstance(value, dict):
        print_table(("PARAMETER", "VALUE"), [(name, _text(item)) for name, item in _leaves(value)])
    else:
        print_line(_text(value))


@app.command("set")
def set_params(
    node: NodeName,
    changes: Annotated[list[str], typer.Argument(metavar="KEY=VALUE", help="Dotted name and YAML value.")],
    domain: Domain = DEFAULT_DOMAIN,
    as_json: AsJson = False,
) -> None:
    """Change parameters of a running node between two scans; exit code 2 if it refuses, and nothing has changed."""
    from mirrorwave.control.node_params import change_params, parse_changes

    wanted = parse_changes(node, changes)
    answer = change_params(domain, node, wanted)
    if answer.error:
        raise ValueError(f"{node} refuses: {answer.error}")
    changed = ", ".join(f"{key} = {_text(value)}" for key, value in _leaves(wanted))
    print_result(as_json, json.loads(answer.params), f"{node}: {changed}")


def _leaves(value: dict[str, Any], path: str = "") -> list[tuple[str, Any]]:
    """Return the plain values of nested mappings by their dotted names."""
    leaves: list[tuple[str, Any]] = []
    for key, item in value.items():
        name = f"{path}{key}"
        leaves += _leaves(item, f"{name}.") if isinstance(item, dict) and item else [(name, item)]
    return leaves


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)
