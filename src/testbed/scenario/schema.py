"""The published JSON Schema of a scenario file."""

from typing import Any

from testbed.scenario.models import Scenario

DIALECT = "https://json-schema.org/draft/2020-12/schema"


def scenario_json_schema() -> dict[str, Any]:
    """The JSON Schema (draft 2020-12) of a scenario file, with the shorthand forms of losses and tables."""
    schema = Scenario.model_json_schema()
    for part in schema["$defs"].values():
        kind = part["properties"].get("kind", {})
        if "const" in kind:
            part["required"] = ["kind", *(key for key in part.get("required", []) if key != "kind")]
    return {"$schema": DIALECT, **schema}
