"""Compiled loops give numpy's bits, and are never needed."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from testbed.channel.gilbert_elliott import GilbertElliott
from testbed.channel.loss import Chain
from testbed.estimator.bounds import Bounds
from testbed.estimator.model import Ack, Model
from testbed.estimator.registry import create
from testbed.numerics import kernels
from testbed.numerics.kernels import LANES_MIN, SWITCH, available, kernel
from testbed.numerics.lanes import Component, clip, exp, reciprocal, sqrt, where
from testbed.numerics.loops import COMPARISONS_MAX

pytest.importorskip("numba")

MODEL = Model(
    A=np.array([[1.1, 0.2], [-0.1, 0.9]]),
    B=np.array([[1.0], [-0.5]]),
    C=np.array([[1.0, 0.3], [0.0, 2.0]]),
    Q=np.array([[0.5, 0.1], [0.1, 0.2]]),
    R=np.eye(2),
    x0_mean=np.array([1.0, -1.0]),
    P0=np.eye(2),
    control=Chain.bernoulli(0.7),
)


HIDDEN = replace(MODEL, control=GilbertElliott.of(0.2, 0.4, 0.1, 0.8))


def steps(kind: str, lanes: int, model: Model = MODEL) -> list[np.ndarray]:
    rng = np.random.default_rng(5)
    estimator, out = create(kind, model, lanes=lanes), []
    for k in range(6):
        u, y = rng.normal(size=(lanes, 1)) * 3, rng.normal(size=(lanes, 2)) * 4
        arrived, nu = rng.random(lanes) < 0.6, rng.random(lanes) < 0.7
        known = np.ones(lanes) if kind == "kfio" else rng.random(lanes) < 0.3
        y.flags.writeable = u.flags.writeable = False
        estimate = estimator.step(u, y, arrived, (Ack(k, nu, known),))
        out += [estimate.x_hat, estimate.P]
    return out


@pytest.mark.parametrize(
    ("kind", "model"),
    [(kind, MODEL) for kind in ("aoe", "ff", "gpb", "imm", "kfio", "lmmse")]
    + [("aoe", HIDDEN), ("gpb", HIDDEN), pytest.param("imm", HIDDEN, marks=pytest.mark.slow)],
)
def test_estimators_have_the_same_bits_compiled_and_not(
    kind: str, model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    lanes = LANES_MIN + 3
    assert available()
    compiled = steps(kind, lanes, model)
    monkeypatch.setenv(SWITCH, "off")
    assert not available()
    for a, b in zip(compiled, uncached(kind, lanes, model), strict=True):
        np.testing.assert_array_equal(a, b)


def uncached(kind: str, lanes: int, model: Model) -> list[np.ndarray]:
    """The same steps, with the step functions made anew."""
    module = sys.modules[f"testbed.estimator.{kind}"]
    caches = [getattr(module, name) for name in ("_stepper", "_merger") if hasattr(module, name)]
    for cache in caches:
        cache.cache_clear()
    try:
        return steps(kind, lanes, model)
    finally:
        for cache in caches:
            cache.cache_clear()


def test_bounds_have_the_bits_of_single_lanes() -> None:
    lanes = LANES_MIN
    many = Bounds(MODEL, np.eye(2), lanes)
    few = [Bounds(MODEL, np.eye(2), 1) for _ in range(3)]
    rng = np.random.default_rng(1)
    for _ in range(5):
        arrived = rng.random(lanes) < 0.5
        lower, upper = many.step(arrived)
        for lane, one in enumerate(few):
            for whole, part in zip((lower, upper), one.step(arrived[lane : lane + 1]), strict=True):
                assert whole is not None
                assert part is not None
                np.testing.assert_array_equal(whole[lane], part[0])


def strange(mask: Component, x: Component, y: Component) -> tuple[Component, ...]:
    first = exp(clip(x * y, -5.0, 5.0))
    second = exp(-1.0 * sqrt(first + y * y))
    return where(mask, first, second / (1.0 + first)), reciprocal(x) - first, x, 2.0


@pytest.mark.parametrize("comparisons", [COMPARISONS_MAX, 0])
def test_functions_are_cut_around_exp(comparisons: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where no loop is short enough, what is needed later is kept instead."""
    monkeypatch.setattr(kernels, "COMPARISONS_MAX", comparisons)
    shapes = (("mask", 1), ("scalar", 1), ("scalar", 1))
    run = kernel(strange, shapes, (("scalar", 1),) * 4, {"exp": exp})
    values = [0.0, -0.0, 1.0, -2.5, 1e-310, 1e300, np.inf, np.nan]
    x, y = (np.array(v) for v in zip(*product(values, values), strict=True))
    mask = np.arange(len(x)) % 3 == 0
    with np.errstate(all="ignore"):
        expected = strange(mask, x, y)
        got = run(mask, x, y)
    for a, b in zip(got[:3], expected[:3], strict=True):
        np.testing.assert_array_equal(a, b)
    assert got[3] == 2.0


def test_without_numba_everything_is_there() -> None:
    code = (
        "import sys; sys.modules['numba'] = None\n"
        "from testbed.numerics.kernels import available\n"
        "assert not available()\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
