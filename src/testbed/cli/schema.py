"""``testbed schema``."""

from __future__ import annotations

import json
from typing import Annotated, Any

import typer

from testbed.errors import UsageError, did_you_mean


def schema(
    what: Annotated[
        str, typer.Argument(metavar="[scenario|messages|asyncapi|summary]", help="Which schema.")
    ] = "scenario",
) -> None:
    """Print a published schema: JSON Schema of the scenario, the messages or summary.json, or the AsyncAPI document."""
    from testbed.orchestrator.summary import summary_json_schema
    from testbed.scenario import scenario_json_schema
    from testbed.wire.asyncapi import asyncapi
    from testbed.wire.messages import messages_json_schema

    makers = {
        "scenario": scenario_json_schema,
        "messages": messages_json_schema,
        "asyncapi": asyncapi,
        "summary": summary_json_schema,
    }
    if what not in makers:
        raise UsageError(f"unknown schema {what!r}; allowed: {', '.join(makers)}{did_you_mean(what, makers)}")
    made: dict[str, Any] = makers[what]()
    typer.echo(json.dumps(made, indent=2, ensure_ascii=False))
