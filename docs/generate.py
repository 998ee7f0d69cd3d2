"""Write the pages of the reference that follow from the code: scenario, presets, messages, commands, summary and so on.

python docs/generate.py            write them
python docs/generate.py --check    exit code 1 if one is not up to date
"""

from __future__ import annotations

import inspect
import json
import re
import sys
from collections.abc import Callable, Iterable
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import typer

from testbed.cli.link_presets import lines_of
from testbed.cli.main import app
from testbed.conformance.form import ROUNDING
from testbed.conformance.kit import CHECKS, CLAIMS
from testbed.conformance.theory import EXACT, LOST, LOST_BLIND, NEES, SHORTFALL
from testbed.estimator.registry import kinds
from testbed.orchestrator.summary import summary_json_schema
from testbed.scenario import scenario_json_schema
from testbed.scenario.presets import presets
from testbed.wire.asyncapi import asyncapi
from testbed.wire.messages import messages_json_schema

PAGES = Path(__file__).parent / "reference"
Schema = dict[str, Any]

SCENARIO_TABLES = (
    ("Scenario", "The top of the file", ""),
    ("System", "`[system]`", "x_{k+1} = A x_k + ν_k B u_k + G w_k, y_k = C x_k + v_k."),
    ("Uncertainty", "`[uncertainty]`", "A(ε) = A + Σ ε_k dA_k, and so for G and C."),
    ("Actuator", "`[actuator]`", "a_k = ν_k u_k, or a_k = ν_k u_k + (1 − ν_k) a_{k−1} with a_{−1} = 0."),
    ("ConstantInput", '`[input]`, `kind = "constant"`', ""),
    ("ExponentialInput", '`[input]`, `kind = "exponential"`', ""),
    ("SineInput", '`[input]`, `kind = "sine"`', ""),
    ("UniformInput", '`[input]`, `kind = "uniform"`', ""),
    ("TableInput", '`[input]`, `kind = "table"`', ""),
    ("FeedbackInput", '`[input]`, `kind = "feedback"`', ""),
    ("LqgInput", '`[input]`, `kind = "lqg"`', ""),
    ("PidInput", '`[input]`, `kind = "pid"`', ""),
    ("PythonInput", '`[input]`, `kind = "python"`', ""),
    ("Cost", "`[cost]`", "J = Σ_{k=1}^{steps} (x_k − reference)'Qx(x_k − reference) + a_{k−1}'Ru a_{k−1}."),
    ("Links", "`[links]`", ""),
    ("Link", "`[links.control]`", ""),
    ("ObservationLink", "`[links.observation]`", ""),
    ("AckLink", "`[links.ack]`", ""),
    ("NoLoss", '`loss = { kind = "none" }`', ""),
    ("BernoulliLoss", '`loss = { kind = "bernoulli", … }`', ""),
    ("MarkovLoss", '`loss = { kind = "markov", … }`', ""),
    ("GilbertElliottLoss", '`loss = { kind = "gilbert-elliott", … }`', ""),
    ("FourStateLoss", '`loss = { kind = "four-state", … }`', ""),
    ("TraceLoss", '`loss = { kind = "trace", … }`', ""),
    ("ScriptedLoss", '`loss = { kind = "scripted", … }`', ""),
    ("Rate", "`rate = { … }`", ""),
    ("ConstantDelay", '`delay = { kind = "constant", … }`', ""),
    ("UniformDelay", '`delay = { kind = "uniform", … }`', ""),
    ("NormalDelay", '`delay = { kind = "normal", … }`', ""),
    ("LogNormalDelay", '`delay = { kind = "log-normal", … }`', ""),
    ("TableDelay", '`delay = { kind = "table", … }`', ""),
    ("Reorder", "`reorder = { … }`", ""),
    ("Duplicate", "`duplicate = { … }`", ""),
    ("Corrupt", "`corrupt = { … }`", ""),
    ("Impairments", "`back = { … }`", ""),
    ("UdpTransport", '`transport = { kind = "udp", … }`', ""),
    ("TcpTransport", '`transport = { kind = "tcp", … }`', ""),
    ("EstimatorSpec", "`[[estimators]]`", ""),
    ("LinkEvent", '`[[events]]`, `action = "set"`', ""),
    ("SwapEvent", '`[[events]]`, `action = "swap"`', ""),
    ("AddEvent", '`[[events]]`, `action = "add"`', ""),
    ("ShadowEvent", '`[[events]]`, `action = "shadow"`', ""),
    ("RemoveEvent", '`[[events]]`, `action = "remove"`', ""),
    ("AcksEvent", '`[[events]]`, `action = "acks"`', ""),
    ("InputEvent", '`[[events]]`, `action = "input"`', ""),
    ("PlantEvent", '`[[events]]`, `action = "plant"`', ""),
    ("PartitionEvent", '`[[events]]`, `action = "partition"`', ""),
    ("HealEvent", '`[[events]]`, `action = "heal"`', ""),
    ("MarkEvent", '`[[events]]`, `action = "mark"`', ""),
    ("SnapshotEvent", '`[[events]]`, `action = "snapshot"`', ""),
    ("KillEvent", '`[[events]]`, `action = "kill"`', ""),
    ("PauseEvent", '`[[events]]`, `action = "pause"`', ""),
    ("RestartEvent", '`[[events]]`, `action = "restart"`', ""),
    ("NewService", "`to = { … }`", ""),
    ("Recovery", "`[recovery]`", "See [Lose processes, and keep the run](../how-to/recovery.md)."),
    ("Clock", "`[clock]`", ""),
    ("Transport", "`[transport]`", ""),
    ("Tls", "`[transport.tls]`", ""),
)
SUMMARY_TABLES = (
    ("Summary", "The top of the file", ""),
    ("EstimatorFigures", "`estimators.NAME`", ""),
    ("BoundFigures", "`bounds`", ""),
    ("ControllerFigures", "`controller`", ""),
    ("CostFigures", "`cost`", ""),
    ("LinkFigures", "`links.NAME`", ""),
    ("Transitions", "`links.NAME.transitions`", ""),
    ("Happened", "`events[…]`", ""),
    ("Transient", "`events[…].transient`", ""),
    ("Recovered", "`recovered[…]`", ""),
    ("Check", "`checks[…]`", ""),
    ("Timing", "`timing`", ""),
    ("RealTime", "`realtime`", "Only in real time; see [Real time](../explanation/real-time.md)."),
    ("Stage", "`realtime.stages.TOPIC`", ""),
    ("Quantiles", "`realtime.stages.TOPIC.published` and the like", ""),
    ("Downtime", "`timing.swaps[…]`", ""),
)
COMMON_FIELDS = ("v", "type", "run", "source", "seq")
MEANINGS = {
    "acks": "where its ACKs came from",
    "arrays": "name, element type and shape of each array behind the header, in their order",
    "action": "what to do",
    "bounds": "bounds of the expected error covariance; null if they were not asked for",
    "checks": "statements about the run that were checked",
    "completed_steps": "steps of which every figure arrived",
    "counters": "what the role counted",
    "detail": "why, if it failed",
    "delivered": "that arrived, a duplicate once",
    "dropped": "that were lost",
    "duplicated": "that arrived twice",
    "estimator": "name of the estimator",
    "estimators": "figures by name of the estimator",
    "in_flight": "still on their way at the end",
    "kind": "which estimator it is",
    "lane_steps_per_s": "steps_per_s × lanes",
    "lanes": "realisations side by side",
    "late": "that arrived in a later step than they were sent for",
    "links": "figures by name of the link",
    "loss_rate": "packets of which no copy arrived / sent",
    "lower_mean": "mean of tr Pᴬ, the covariance with every ACK",
    "name": "name of the scenario, or of the check",
    "ok": "whether it holds",
    "policy": "what was done",
    "reason": "why the run is not complete",
    "role": "which role; orchestrator: the run was resumed",
    "seed": "seed of the scenario",
    "sent": "packets that entered the link",
    "startup_s": "from the command to the first step",
    "state": "how the role ended",
    "status": "how the run ended",
    "step": "k",
    "steps": "steps of the scenario",
    "steps_per_s": "completed steps / wall_s",
    "text": "the statement with its numbers",
    "timing": "how long it took",
    "transitions": "pairs of neighbouring packets",
    "upper_mean": "mean of tr S, for control losses that are independent from step to step",
    "version": "version of this format",
    "versions": "of Python and of the packages that compute",
    "wall_s": "from the first step to the last figure",
    "window": "steps that could be in flight",
    "00": "lost after lost",
    "01": "delivered after lost",
    "10": "lost after delivered",
    "11": "delivered after delivered",
}
"""For the fields of which the models say nothing."""


def scenario_page() -> str:
    return _page(
        "Scenario",
        "A scenario is a TOML file. Only `[system]` is required, and one `[[estimators]]` for a run. Every other key "
        "has a default. A key that does not exist is an error that names the nearest one that does. "
        "`testbed schema scenario` prints the same as JSON Schema, for editors that complete and check.\n\n"
        "Durations are texts with a unit: `ns`, `us`, `ms`, `s`, `min`. Paths are relative to the scenario's folder. "
        "Sizes: x has n entries, u has q, y has p, w has g.",
        [*_tables(scenario_json_schema(), SCENARIO_TABLES), _estimators()],
    )


def summary_page() -> str:
    return _page(
        "summary.json",
        "Every list along k has one entry for each completed step, k = 1 first. A figure that does not exist is "
        "`null`: a standard error with one lane, an estimator's steps after its `until`, a value that is not finite. "
        "`testbed schema summary` prints the same as JSON Schema.",
        _tables(summary_json_schema(), SUMMARY_TABLES),
    )


def messages_page() -> str:
    document, schemas = asyncapi(), messages_json_schema()
    rows = [
        (f"`{channel['address']}`", f"`{next(iter(channel['messages']))}`", channel["description"])
        for channel in document["channels"].values()
    ]
    common = schemas["$defs"]["control"]
    return _page(
        "Messages",
        "What goes over the bus, and on which key. `testbed schema messages` prints the JSON Schema of the headers, "
        "`testbed schema asyncapi` all of this as an AsyncAPI document.",
        [
            "## Format\n\n"
            + re.sub(r"'(\w+|x-arrays)'", r"`\1`", f"{schemas['description']}\n\n{schemas['x-bundle']}"),
            "## Keys\n\n"
            + _table(("key", "type", "from → to"), rows)
            + "\n\n"
            + document["info"]["description"]
            # the format is said above
            .replace(schemas["description"], "")
            .replace(schemas["x-bundle"], "")
            .strip(),
            "## Fields of every header\n\n"
            + _fields(common, [n for n in COMMON_FIELDS if n != "type"])
            + "\n\nBesides, `type`: one of the types below.",
            "## Fields of every packet\n\nA packet is a message of the loop; it has these fields besides.\n\n"
            + _fields(common, ("step", "lane", "lanes", "arrays")),
            *(_message(name, schema) for name, schema in schemas["$defs"].items()),
        ],
    )


def commands_page() -> str:
    return _page(
        "Commands",
        "Exit codes: 0 success, 1 a run or a check that failed, 2 wrong input, 130 interrupted. Errors are one line on "
        "standard error. `testbed --version` shows the version, `testbed COMMAND --help` the same as below.",
        list(_commands(app, "testbed")),
    )


def conformance_page() -> str:
    claims = {check.__name__ for check in CLAIMS}
    rows = []
    for check in CHECKS:
        needs = "may be not claimed" if check.__name__ in claims else "must hold"
        rows.append((f"`{check.__name__}`", _one_line(inspect.getdoc(check) or ""), needs))
    return _page(
        "Conformance",
        "What `testbed conformance` checks. [Your own estimator in 40 lines](../how-to/own-estimator.md) shows how.",
        [
            _table(("check", "what it wants", "kind"), rows),
            "The kit runs an estimator on systems with one, two and three states, unstable ones among them, with "
            "observation losses in bursts. Control losses are Markov or, where the estimator refuses those, i.i.d.; "
            "where it takes Markov ones, Gilbert–Elliott ones too. ACKs come in time, not at all, or late; an "
            "estimator that raises `MissingAck` gets them in time. Systems that it refuses with `UsageError` are left "
            "out, and `declaration` names them. `restart` and `hand_over` are skipped where it offers no snapshot, "
            "`entry_point` where no package registers it. All seeds are fixed.",
            f"Tolerances: symmetry, eigenvalues and lanes {ROUNDING:g}; `coordinates`, `kfio_with_acks` and "
            f"`hand_over` {EXACT:g}, and what the estimator certifies of itself; `ack_bound` {1 - SHORTFALL:g} times "
            "the bound; "
            f"`consistency` {NEES[0]} … {NEES[1]} n; `long_losses` {LOST} losses, {LOST_BLIND} without ACKs.",
        ],
    )


def presets_page() -> str:
    sections = []
    for name, preset in presets().items():
        rows = [("source", preset.source), ("confirmed", preset.confirmed)]
        rows += [("caveat", text) for text in preset.caveats] + [("assumed", text) for text in preset.assumed]
        keys = "\n".join(lines_of(preset)).replace("\n# down", "\n```\n\n```toml\n# down")
        sections.append(f"## `{name}`\n\n{preset.title}.\n\n```toml\n{keys}\n```\n\n{_table(('', ''), rows)}")
    return _page(
        "Link presets",
        'Named links, from what others measured or calibrated. `preset = "NAME"` in a `[links.X]` table stands for the '
        "keys below; other keys of the table replace its own, each as a whole. Where the directions differ, up is the "
        "way from the end device into the network, down the way back. `testbed link presets` prints the same.\n\n"
        "No preset is your network: losses come in bursts that two states do not describe well on Wi-Fi, and of 38 "
        "segments of Internet paths independent losses fitted 7 and two states 10 (M. Yajnik et al.: Measurement and "
        "modelling of the temporal dependence in packet loss. INFOCOM 1999; second hand). Measure your own and "
        "[fit it](../how-to/fit.md). There is none for 4G with bursts, because no published chain with its source was "
        "found; and none by the correlation of `tc netem`, whose losses are not the asked-for share.",
        sections,
    )


PAGE_MAKERS: dict[str, Callable[[], str]] = {
    "scenario.md": scenario_page,
    "summary.md": summary_page,
    "messages.md": messages_page,
    "commands.md": commands_page,
    "presets.md": presets_page,
    "conformance.md": conformance_page,
}


def _page(title: str, text: str, sections: Iterable[str]) -> str:
    note = "<!-- Written by docs/generate.py; do not edit. -->"
    return "\n\n".join([note, f"# {title}", text, *sections]) + "\n"


def _tables(schema: Schema, layout: tuple[tuple[str, str, str], ...]) -> list[str]:
    """A section for each part of a schema, in the order of ``layout``, which must name them all."""
    parts = {schema["title"]: schema, **schema["$defs"]}
    forgotten = parts.keys() - {name for name, _, _ in layout}
    if forgotten:
        raise SystemExit(f"docs/generate.py: no place for {', '.join(sorted(forgotten))}")
    out = []
    for name, heading, text in layout:
        part = parts[name]
        intro = " ".join(filter(None, [_one_line(part.get("description", "")), text]))
        out.append("\n\n".join(filter(None, [f"## {heading}", intro, _fields(part, part["properties"])])))
    return out


def _fields(part: Schema, names: Iterable[str]) -> str:
    required = set(part.get("required", ()))
    rows = []
    for name in names:
        field = part["properties"][name]
        if name == "kind" and "const" in field:
            continue
        text = _one_line(field.get("description", "")) or MEANINGS.get(name) or _of_mean(name)
        rows.append((f"`{name}`", _type(field), _default(field, name in required), text))
    return _table(("key", "type", "default", "meaning"), rows) if rows else "It has no other keys."


def _of_mean(name: str) -> str:
    if not name.endswith("_stderr"):
        raise SystemExit(f"docs/generate.py: nothing says what {name} is")
    return f"standard error of `{name.removesuffix('_stderr')}_mean`"


def _type(field: Schema) -> str:
    """The type of a field in words."""
    if "anyOf" in field:
        return " or ".join(dict.fromkeys(_type(option) for option in field["anyOf"] if option.get("type") != "null"))
    if any(option.get("type") == "string" for option in field.get("oneOf", ())):
        return "table or text"
    if "$ref" in field or "oneOf" in field:
        return "table"
    if "const" in field:
        return f"`{json.dumps(field['const'])}`"
    if "enum" in field:
        return ", ".join(f"`{json.dumps(value)}`" for value in field["enum"])
    kind = field.get("type", "")
    if kind == "array":
        return _array(field)
    if kind == "object":
        return "table"
    names = {"number": "number", "integer": "integer", "string": "text", "boolean": "true or false"}
    return names[kind] + _limits(field)


def _array(field: Schema) -> str:
    items = field.get("items", {})
    if "prefixItems" in field:
        return "list"
    if items.get("items", {}).get("type") == "array":
        return "list of matrices"
    if items.get("type") == "array":
        return "matrix" if items.get("items", {}).get("type") == "number" else "list of lists"
    return "list of tables" if "$ref" in items else f"list of {_type(items)}s"


def _limits(field: Schema) -> str:
    low, high = field.get("minimum"), field.get("maximum")
    high = None if high is not None and high > 2**30 else high
    if low is None and high is None:
        return ""
    return f", {low:g} or more" if high is None else f", {low:g} … {high:g}"


def _default(field: Schema, required: bool) -> str:
    if required:
        return "required"
    value = field.get("default")
    return "–" if value in (None, "", [], {}) or isinstance(value, dict) else f"`{json.dumps(value)}`"


def _message(name: str, schema: Schema) -> str:
    own = [key for key in schema["properties"] if key not in (*COMMON_FIELDS, "step", "lane", "lanes", "arrays")]
    if "lane" not in schema["properties"] and "step" in schema["properties"]:
        own.append("step")
    parts = [f"## `{name}`", _one_line(schema["description"])]
    if own:
        parts.append(_fields(schema, own))
    if "x-arrays" in schema:
        rows = [
            (
                f"`{key}`",
                f"`{rule['dtype']}`",
                f"({', '.join(rule['shape'])})",
                "yes" if rule["required"] else "no",
                rule["description"],
            )
            for key, rule in schema["x-arrays"].items()
        ]
        parts.append(_table(("array", "element", "shape", "required", "meaning"), rows))
    return "\n\n".join(parts)


def _estimators() -> str:
    rows = []
    for kind in kinds():
        try:
            module = import_module(f"testbed.estimator.{kind.replace('-', '_')}")
            made = getattr(module, "".join(part.capitalize() for part in kind.split("-")))
        except ImportError:  # of another package
            continue
        options = [
            f"`{p.name}`" if p.default is None else f"`{p.name} = {json.dumps(p.default)}`"
            for p in list(inspect.signature(made).parameters.values())[2:]
        ]
        text = _one_line((inspect.getdoc(import_module(made.__module__)) or "").split("\n\n")[0])
        rows.append((f"`{kind}`", text, ", ".join(options) or "–"))
    return "## Estimators\n\nThe letters and numbers are those of [theory](../explanation/theory.md).\n\n" + _table(
        ("kind", "what it is", "options"), rows
    )


def _commands(group: typer.Typer, prefix: str) -> Iterable[str]:
    for command in group.registered_commands:
        callback = command.callback
        assert callback is not None
        yield _command(f"{prefix} {command.name or callback.__name__}", callback)
    for sub in group.registered_groups:
        assert sub.typer_instance is not None
        outer = sub.typer_instance.registered_callback
        given = [text for text, _, _ in _parameters(outer.callback)[0]] if outer and outer.callback else []
        yield from _commands(sub.typer_instance, " ".join([prefix, str(sub.name), *given]))


Parameters = list[tuple[str, inspect.Parameter, Any]]


def _parameters(callback: Callable[..., Any]) -> tuple[Parameters, Parameters]:
    """The arguments and the options of a command, each as it is written."""
    arguments: Parameters = []
    options: Parameters = []
    hints = get_type_hints(callback, include_extras=True)
    for parameter in inspect.signature(callback).parameters.values():
        hint = hints[parameter.name]
        info = get_args(hint)[1] if get_origin(hint) is Annotated else None
        if isinstance(info, typer.models.ArgumentInfo):
            arguments.append((info.metavar or parameter.name.upper(), parameter, info))
        elif isinstance(info, typer.models.OptionInfo):
            declared = [text for text in (info.default, *(info.param_decls or ())) if isinstance(text, str)]
            spelt = declared or ["--" + parameter.name.replace("_", "-")]
            options.append((f"{', '.join(spelt)} {info.metavar or ''}".strip(), parameter, info))
    return arguments, options


def _command(name: str, callback: Callable[..., Any]) -> str:
    arguments, options = _parameters(callback)
    usage = " ".join([name, *(text for text, _, _ in arguments), "[OPTIONS]"])
    parts = [f"## {name}", f"```text\n{usage}\n```", (inspect.getdoc(callback) or "").strip()]
    rows = [(f"`{text}`", _needed(parameter), info.help or "") for text, parameter, info in (*arguments, *options)]
    return "\n\n".join([*parts, _table(("argument or option", "default", "meaning"), rows)])


def _needed(parameter: inspect.Parameter) -> str:
    if parameter.default is inspect.Parameter.empty:
        return "required"
    return "–" if parameter.default in (None, False) and not _is_number(parameter.default) else f"`{parameter.default}`"


def _is_number(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    lines = [head, ("---",) * len(head), *(tuple(cell.replace("|", "\\|") for cell in row) for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _one_line(text: str) -> str:
    return " ".join(text.replace("``", "`").split())


def main(arguments: list[str]) -> int:
    stale = []
    for name, make in PAGE_MAKERS.items():
        path, text = PAGES / name, make()
        if path.exists() and path.read_text(encoding="utf-8") == text:
            continue
        stale.append(name)
        if "--check" not in arguments:
            path.write_text(text, encoding="utf-8")
    if stale:
        print(f"{'not up to date' if '--check' in arguments else 'written'}: {', '.join(stale)}")
    return 1 if stale and "--check" in arguments else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
