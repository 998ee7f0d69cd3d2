"""Scenarios of every kind, as tables, for Hypothesis."""

from typing import Any

from hypothesis import strategies as st

numbers = st.floats(allow_nan=False, allow_infinity=False)
small_numbers = st.floats(-100, 100)
probabilities = st.floats(0, 1)
positive = st.floats(1e-6, 1e6)
names = st.from_regex(r"[a-z][a-z0-9_-]{0,31}", fullmatch=True)
texts = st.text(st.characters(exclude_categories=["Cc", "Cs"]), min_size=1, max_size=128)


def matrix(
    rows: int, columns: int, entries: st.SearchStrategy[float] = numbers
) -> st.SearchStrategy[list[list[float]]]:
    row = st.lists(entries, min_size=columns, max_size=columns)
    return st.lists(row, min_size=rows, max_size=rows)


def covariance(size: int, diagonal: float = 0.0) -> st.SearchStrategy[list[list[float]]]:
    """L L' + diagonal * I."""

    def product(L: list[list[float]]) -> list[list[float]]:
        return [
            [sum(a * b for a, b in zip(L[i], L[j], strict=True)) + (diagonal if i == j else 0.0) for j in range(size)]
            for i in range(size)
        ]

    return matrix(size, size, small_numbers).map(product)


@st.composite
def systems(draw: st.DrawFn, n: int, q: int, p: int) -> dict[str, Any]:
    g = draw(st.integers(0, 3))
    table: dict[str, Any] = {"A": draw(matrix(n, n)), "C": draw(matrix(p, n))}
    if q:
        table["B"] = draw(matrix(n, q))
    if g:
        table["G"] = draw(matrix(n, g))
    table["Q"] = draw(covariance(g or n))
    table["R"] = draw(covariance(p, diagonal=1.0))
    if draw(st.booleans()):
        table["x0_mean"] = draw(st.lists(numbers, min_size=n, max_size=n))
    if draw(st.booleans()):
        table["P0"] = draw(covariance(n))
    return table


@st.composite
def uncertainties(draw: st.DrawFn, n: int, g: int, p: int) -> dict[str, Any]:
    parameters = draw(st.integers(1, 3))
    sizes = {"dA": (n, n), "dG": (n, g), "dC": (p, n)}
    keys = draw(st.lists(st.sampled_from(sorted(sizes)), min_size=1, unique=True))
    lists = {key: draw(st.lists(matrix(*sizes[key]), min_size=parameters, max_size=parameters)) for key in keys}
    return {**lists, "delta": draw(st.floats(0, 1e6))}


@st.composite
def inputs(draw: st.DrawFn, n: int, q: int, steps: int, estimators: list[str]) -> dict[str, Any]:
    def channels(entries: st.SearchStrategy[float]) -> st.SearchStrategy[Any]:
        return entries | st.lists(entries, min_size=q, max_size=q)

    closed = ["feedback", "lqg", "pid", "python"] if estimators else []
    kinds = ["constant", "exponential", "sine", "uniform", "table", *closed]
    kind = draw(st.sampled_from(kinds))
    vector = st.lists(numbers, min_size=q, max_size=q)
    optional = {"offset": channels(numbers), "amplitude": channels(numbers)}
    following = {
        "estimator": st.sampled_from(estimators or [""]),
        "low": channels(st.floats(-9, 0)),
        "high": channels(st.floats(0, 9)),
    }
    tables: dict[str, st.SearchStrategy[dict[str, Any]]] = {
        "constant": st.fixed_dictionaries({"value": vector}),
        "exponential": st.fixed_dictionaries({"tau": channels(positive)}, optional=optional),
        "sine": st.fixed_dictionaries(
            {"period": channels(positive)}, optional={**optional, "phase": channels(small_numbers)}
        ),
        "uniform": st.fixed_dictionaries({"low": channels(st.floats(-9, 0)), "high": channels(st.floats(0, 9))}),
        "table": st.fixed_dictionaries({"values": matrix(steps, q)}),
        "feedback": st.fixed_dictionaries(
            {"gain": matrix(q, n)},
            optional={
                **following,
                "reference": st.lists(numbers, min_size=n, max_size=n),
                "feedforward": channels(numbers),
            },
        ),
        "lqg": st.one_of(
            st.fixed_dictionaries({"Qx": covariance(n), "Ru": covariance(q, diagonal=1.0)}, optional=following),
            st.fixed_dictionaries(
                {"Qx": covariance(n), "Ru": covariance(q, diagonal=1.0), "horizon": st.just("run")},
                optional={**following, "terminal": covariance(n)},
            ),
        ),
        "pid": st.fixed_dictionaries(
            {"output": matrix(q, n)},
            optional={
                **following,
                **{key: channels(numbers) for key in ("setpoint", "kp", "ki", "kd", "feedforward")},
                "filter": channels(st.floats(0, 9)),
                "tracking": channels(st.floats(1, 9)),
            },
        ),
        "python": st.fixed_dictionaries(
            {"controller": st.sampled_from(["own:Controller", "registered"])},
            optional={**following, "options": st.fixed_dictionaries({}, optional={"a": numbers, "b": st.text()})},
        ),
    }
    return {"kind": kind, **draw(tables[kind])}


loss_laws: st.SearchStrategy[dict[str, Any]] = st.one_of(
    st.just({"kind": "none"}),
    st.fixed_dictionaries({"kind": st.just("bernoulli"), "arrival": probabilities}),
    st.fixed_dictionaries({"kind": st.just("bernoulli"), "loss": probabilities}),
    st.fixed_dictionaries(
        {"kind": st.just("markov"), "recovery": probabilities, "failure": st.floats(0.01, 1)},
        optional={"start": probabilities},
    ),
    st.fixed_dictionaries(
        {"kind": st.just("gilbert-elliott"), "to_bad": probabilities, "to_good": st.floats(0.01, 1)},
        optional={"loss_good": st.floats(0, 0.3), "loss_bad": st.floats(0.3, 1), "start_good": probabilities},
    ),
    st.fixed_dictionaries({"kind": st.just("markov"), "loss": st.floats(0, 0.5), "mean_burst": st.floats(1, 1e6)}),
    st.fixed_dictionaries(
        {"kind": st.just("four-state"), "to_burst": st.floats(0, 0.5), "to_good": st.floats(0.01, 0.5)},
        optional={
            "to_pause": st.floats(0, 0.5),
            "from_pause": st.floats(0.01, 1),
            "to_isolated": st.floats(0, 0.5),
            "start": st.sampled_from([[1.0, 0.0, 0.0, 0.0], [0.1, 0.2, 0.3, 0.4]]),
        },
    ),
)
words = st.text("01", min_size=1, max_size=20)
losses: st.SearchStrategy[dict[str, Any]] = st.one_of(
    loss_laws,
    st.fixed_dictionaries(
        {"kind": st.just("trace"), "fates": words},
        optional={"offset": st.just(0), "repeat": st.just(True), "assumed": loss_laws},
    ),
    st.fixed_dictionaries({"kind": st.just("scripted"), "pattern": words}, optional={"assumed": loss_laws}),
    st.fixed_dictionaries(
        {
            "kind": st.just("scripted"),
            "lost": st.lists(st.integers(0, 9) | st.sampled_from(["1-4", "3-3"]), min_size=1, max_size=4),
        },
        optional={"assumed": loss_laws},
    ),
)
links = st.fixed_dictionaries({}, optional={"loss": losses})
observation_links = st.fixed_dictionaries(
    {}, optional={"loss": losses, "on_loss": st.sampled_from(["nothing", "noise"])}
)
acks = st.one_of(
    st.fixed_dictionaries({"mode": st.sampled_from(["none", "perfect"])}),
    st.fixed_dictionaries({"mode": st.just("link")}, optional={"loss": losses}),
)
durations = st.builds("{} {}".format, st.integers(1, 10**6), st.sampled_from(["ns", "us", "ms", "s", "min"]))
clocks = st.fixed_dictionaries(
    {}, optional={"mode": st.just("virtual"), "period": durations, "window": st.integers(1, 100)}
)
transports = st.fixed_dictionaries(
    {},
    optional={
        "endpoint": st.just("tcp/127.0.0.1:7447"),
        "deadline": durations,
        "lanes_per_packet": st.integers(1, 10**6),
        "users_file": st.just("/etc/users.txt"),
    },
)
option_values = st.recursive(
    st.booleans() | st.integers(-(2**63), 2**63 - 1) | numbers | texts,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(texts, inner, max_size=3),
    max_leaves=5,
)


@st.composite
def estimators(draw: st.DrawFn, steps: int) -> list[dict[str, Any]]:
    options = st.dictionaries(
        texts.filter(lambda key: key not in ("name", "kind", "acks", "until", "options")), option_values
    )
    fields = st.fixed_dictionaries({}, optional={"kind": names, "acks": st.sampled_from(["none", "perfect"])})
    tables = [
        {"name": name, **draw(options), **draw(fields)} for name in draw(st.lists(names, unique=True, max_size=3))
    ]
    for table in tables[1:]:
        table["until"] = draw(st.integers(1, steps))
    return tables


@st.composite
def scenarios(draw: st.DrawFn) -> dict[str, Any]:
    n, q, p, steps = (draw(st.integers(low, high)) for low, high in ((1, 3), (0, 2), (1, 3), (1, 5)))
    table: dict[str, Any] = {"system": draw(systems(n, q, p)), "steps": steps, "estimators": draw(estimators(steps))}
    if draw(st.booleans()):
        system = table["system"]
        table["uncertainty"] = draw(uncertainties(n, len(system["Q"]), p))
    if q and draw(st.booleans()):
        complete = [spec["name"] for spec in table["estimators"] if "until" not in spec]
        table["input"] = draw(inputs(n, q, steps, complete))
    policies = ["zero", "hold"] if q else ["zero"]
    optional: dict[str, st.SearchStrategy[Any]] = {
        "name": texts,
        "lanes": st.integers(1, 10**6),
        "seed": st.integers(0, 2**63 - 1),
        "record": st.sampled_from(["first", "all", "none"]),
        "bounds": st.booleans(),
        "clock": clocks,
        "actuator": st.fixed_dictionaries({}, optional={"on_loss": st.sampled_from(policies)}),
        "cost": st.fixed_dictionaries(
            {"Qx": covariance(n)},
            optional={
                **({"Ru": covariance(q)} if q else {}),
                "terminal": covariance(n),
                "reference": st.lists(numbers, min_size=n, max_size=n),
            },
        ),
        "links": st.fixed_dictionaries({}, optional={"control": links, "observation": observation_links, "ack": acks}),
        "transport": transports,
    }
    return {**table, **draw(st.fixed_dictionaries({}, optional=optional))}
