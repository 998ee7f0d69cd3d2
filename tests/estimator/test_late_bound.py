"""The lower bound with late observations: the covariance given all that has come by then, by conditioning."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from estimator.reference import gaussian
from estimator.reference.cases import check, random_system
from estimator.reference.compare import covariance_error
from estimator.reference.drive import model_of
from testbed.estimator.bounds import Bounds, LateBound
from testbed.numerics.lanes import matrices_of

STEPS, LANES = 12, 3


@check(25)
@given(st.integers(0, 2**32 - 1), st.integers(1, 14), st.integers(1, 2), st.sampled_from([1, 3]))
def test_is_the_covariance_given_what_has_come(seed: int, depth: int, p: int, lanes: int) -> None:
    rng = np.random.default_rng(seed)
    system = random_system(rng, 2, p, 1)
    step = np.arange(1, STEPS + 1)[:, None]
    comes = step + rng.integers(0, 8, (STEPS, lanes)) * rng.integers(0, 2, (STEPS, lanes))
    comes[rng.random((STEPS, lanes)) < 0.2] = STEPS + 1
    bound = LateBound(model_of(system), lanes, depth)
    for k in range(1, STEPS + 1):
        late = [(j, comes[j - 1] == k) for j in range(1, k) if (comes[j - 1] == k).any()]
        rng.shuffle(late)
        found = matrices_of(bound.step(comes[k - 1] == k, late), lanes)
        known = (comes <= k) & (comes - step <= depth)
        for lane in range(lanes):
            expected = gaussian.lower_bound(system, known[:k, lane])
            assert covariance_error(found[lane], expected) < 1e-10
    came = (comes <= STEPS) & (comes - step > depth)
    assert bound.old == int(came.sum())


def test_without_late_ones_it_is_the_bound_in_order() -> None:
    rng = np.random.default_rng(4)
    model = model_of(random_system(rng, 3, 1, 1))
    late, plain = LateBound(model, LANES, 5), Bounds(model, None, LANES)
    for _ in range(40):
        arrived = rng.random(LANES) < 0.6
        np.testing.assert_array_equal(matrices_of(late.step(arrived), LANES), plain.step(arrived)[0])
    assert late.old == 0


def test_what_is_told_twice_changes_nothing() -> None:
    rng = np.random.default_rng(5)
    model = model_of(random_system(rng, 2, 1, 1))
    once, twice = LateBound(model, LANES, 6), LateBound(model, LANES, 6)
    none, some = np.zeros(LANES, dtype=bool), np.array([True, False, True])
    for bound, again in ((once, []), (twice, [(1, some), (2, some)])):
        bound.step(some)
        bound.step(none)
        bound.step(none, [(2, some)])
        bound.step(none, again)
    after = [matrices_of(bound.step(~some), LANES) for bound in (once, twice)]
    np.testing.assert_array_equal(*after)
    assert (once.old, twice.old) == (0, 0)
