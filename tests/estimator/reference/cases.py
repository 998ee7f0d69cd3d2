"""Systems and trials to test estimators on: random, seeded, with every pattern of arrivals and ACKs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise, product

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

ACKS = ("none", "all", "subset", "late")
ARRIVALS = ("all", "none", "random")
CHAINS = ("bernoulli", "markov")
HIDDEN = "gilbert-elliott"
FOUR = "four-state"
"""The kinds of losses that not every estimator holds."""


def check(examples: int) -> settings:
    """Hypothesis settings of all property tests here: the same examples in every run, no time limit on one."""
    return settings(max_examples=examples, deadline=None, derandomize=True)


@dataclass(frozen=True)
class Channel:
    """A Gilbert–Elliott channel: P(good→bad), P(bad→good), P(loss) in each state, P(first state good)."""

    to_bad: float
    to_good: float
    loss_good: float
    loss_bad: float
    start_good: float

    states = (0, 1)

    def start(self, good: int) -> float:
        return self.start_good if good else 1.0 - self.start_good

    def move(self, good: int, to: int) -> float:
        to_good = 1.0 - self.to_bad if good else self.to_good
        return to_good if to else 1.0 - to_good

    def fate(self, good: int, nu: int) -> float:
        """P(ν | state)."""
        lost = self.loss_good if good else self.loss_bad
        return 1.0 - lost if nu else lost


@dataclass(frozen=True)
class FourStates:
    """Good, pause, burst, isolated loss; p13 … as in netem's ``loss state``, and the law of the first state."""

    p13: float
    p31: float
    p32: float
    p23: float
    p14: float
    first: tuple[float, float, float, float]

    states = (0, 1, 2, 3)

    def start(self, state: int) -> float:
        return self.first[state]

    def move(self, state: int, to: int) -> float:
        moves = {(0, 2): self.p13, (0, 3): self.p14, (1, 2): self.p23, (2, 0): self.p31, (2, 1): self.p32, (3, 0): 1.0}
        stays = 1.0 - sum(chance for (before, _), chance in moves.items() if before == state)
        return stays if to == state else moves.get((state, to), 0.0)

    def fate(self, state: int, nu: int) -> float:
        return float((state < 2) == bool(nu))


@dataclass(frozen=True)
class System:
    """x⁺ = A x + ν B u + w, y = C x + v; ν a chain with P(0→1) = recovery, P(1→0) = failure, P(ν_0 = 1) = start.

    With a ``channel``, ν is that of it instead. With ``hold``, what is applied in place of a lost u is the last one
    that arrived, and zero before the first.
    """

    A: Floats
    B: Floats
    C: Floats
    Q: Floats
    R: Floats
    x0_mean: Floats
    P0: Floats
    recovery: float
    failure: float
    start: float
    channel: Channel | FourStates | None = None
    hold: bool = False

    @property
    def n(self) -> int:
        return int(self.A.shape[0])

    @property
    def p(self) -> int:
        return int(self.C.shape[0])

    @property
    def q(self) -> int:
        return int(self.B.shape[1])

    def arrival(self, last: int | None) -> float:
        """P(ν_k = 1 | ν_{k-1} = last); last None: the first packet."""
        assert self.channel is None
        if last is None:
            return self.start
        return 1.0 - self.failure if last else self.recovery

    def applied(self, u: Floats, histories: Floats) -> Floats:
        """What is applied at each step: u (k, q), histories (N, k) → (N, k, q)."""
        if not self.hold:
            return histories[:, :, None] * u
        out = np.zeros((*histories.shape, u.shape[1]))
        for i, history in enumerate(histories):
            for j in range(len(u)):
                newest = [m for m in range(j + 1) if history[m] == 1]
                if newest:
                    out[i, j] = u[newest[-1]]
        return out

    def prior(self, history: tuple[int, ...]) -> float:
        """P(ν_0 … ν_{k−1} = history); with a channel the sum over all paths of its state."""
        if self.channel is not None:
            return _over_paths(self.channel, history)
        prior = 1.0
        for j, nu in enumerate(history):
            arrival = self.arrival(history[j - 1] if j else None)
            prior *= arrival if nu else 1.0 - arrival
        return prior

    def moved(self, T: Floats) -> System:
        """The same system in the coordinates T x."""
        inverse = np.linalg.inv(T)
        return replace(
            self,
            A=T @ self.A @ inverse,
            B=T @ self.B,
            C=self.C @ inverse,
            Q=_symmetric(T @ self.Q @ T.T),
            x0_mean=T @ self.x0_mean,
            P0=_symmetric(T @ self.P0 @ T.T),
        )


@lru_cache(maxsize=4096)
def _over_paths(channel: Channel | FourStates, history: tuple[int, ...]) -> float:
    total = 0.0
    for path in product(channel.states, repeat=len(history)):
        chance = channel.start(path[0]) if path else 1.0
        for good, to in pairwise(path):
            chance *= channel.move(good, to)
        for good, nu in zip(path, history, strict=True):
            chance *= channel.fate(good, nu)
        total += chance
    return total


@dataclass(frozen=True)
class Trial:
    """What happens on M lanes over K steps; row k - 1 of u, y, arrived is step k, row j of nu and ack_step is packet j.

    u (K, M, q), y (K, M, p), arrived (K, M), nu (K, M) in {0, 1}, ack_step (K, M): the step at which ν_j becomes
    known (j + 1 is in time, later is late), 0 if never.
    """

    system: System
    u: Floats
    y: Floats
    arrived: Bools
    nu: Ints
    ack_step: Ints

    @property
    def steps(self) -> int:
        return int(self.u.shape[0])

    @property
    def lanes(self) -> int:
        return int(self.u.shape[1])

    def known(self, k: int, lane: int) -> dict[int, int]:
        """{j: ν_j} of all packets that are known at step k, however late."""
        rows = self.ack_step[:k, lane]
        return {j: int(self.nu[j, lane]) for j in range(k) if 0 < rows[j] <= k}

    def known_in_time(self, k: int, lane: int) -> dict[int, int]:
        """{j: ν_j} of the packets j < k that became known at step j + 1."""
        return {j: int(self.nu[j, lane]) for j in range(k) if self.ack_step[j, lane] == j + 1}

    def of_lanes(self, index: Ints | slice) -> Trial:
        return replace(
            self,
            u=self.u[:, index],
            y=self.y[:, index],
            arrived=self.arrived[:, index],
            nu=self.nu[:, index],
            ack_step=self.ack_step[:, index],
        )


def _symmetric(S: Floats) -> Floats:
    return (S + S.T) / 2


def _psd(rng: np.random.Generator, n: int, rank: int) -> Floats:
    root = rng.normal(size=(n, rank))
    return _symmetric(root @ root.T + (0.1 * np.eye(n) if rank >= n else 0.0))


def random_system(
    rng: np.random.Generator, n: int, p: int, q: int, chain: str = "markov", noise_rank: int | None = None
) -> System:
    """Random matrices; spectral radius of A in 0.3 … 1.3; Q of the given rank (full if None)."""
    A = rng.normal(size=(n, n))
    A *= rng.uniform(0.3, 1.3) / max(float(np.abs(np.linalg.eigvals(A)).max()), 1e-3)
    if chain == "bernoulli":
        rate = float(rng.uniform(0.1, 0.9))
        recovery, failure, start = rate, 1.0 - rate, rate
    else:
        recovery, failure, start = (float(rng.uniform(0.05, 0.95)) for _ in range(3))
    kinds = {HIDDEN: random_channel, FOUR: random_four_states}
    channel = kinds[chain](rng) if chain in kinds else None
    return System(
        A=A,
        B=rng.normal(size=(n, q)) * rng.uniform(0.3, 3.0),
        C=rng.normal(size=(p, n)),
        Q=_psd(rng, n, n if noise_rank is None else noise_rank),
        R=_psd(rng, p, p) + 0.1 * np.eye(p),
        x0_mean=rng.normal(size=n),
        P0=_psd(rng, n, int(rng.integers(0, n + 1))),
        recovery=recovery,
        failure=failure,
        start=start,
        channel=channel,
    )


def random_channel(rng: np.random.Generator) -> Channel:
    """In one of three a state that loses nothing, or everything."""
    kind = int(rng.integers(3))
    return Channel(
        to_bad=float(rng.uniform(0.05, 0.95)),
        to_good=float(rng.uniform(0.05, 0.95)),
        loss_good=0.0 if kind == 1 else float(rng.uniform(0.02, 0.4)),
        loss_bad=1.0 if kind == 2 else float(rng.uniform(0.5, 0.95)),
        start_good=float(rng.uniform(0.05, 0.95)),
    )


def random_four_states(rng: np.random.Generator) -> FourStates:
    """In one of three without isolated losses, or without pauses."""
    kind = int(rng.integers(3))
    good, burst = (rng.dirichlet((1.0, 1.0, 1.0)) for _ in range(2))
    first = rng.dirichlet((1.0, 1.0, 1.0, 1.0)) * [1.0, kind != 2, 1.0, kind != 1]
    first /= first.sum()
    return FourStates(
        p13=float(good[0]),
        p31=float(burst[0]),
        p32=0.0 if kind == 2 else float(burst[1]),
        p23=float(rng.uniform(0.05, 0.95)),
        p14=0.0 if kind == 1 else float(good[1]),
        first=tuple(first.tolist()),
    )


def _losses(rng: np.random.Generator, system: System, steps: int, lanes: int) -> Ints:
    nu = np.zeros((steps, lanes), dtype=np.int64)
    for lane in range(lanes):
        if system.channel is not None:
            nu[:, lane] = _channel_losses(rng, system.channel, steps)
            continue
        last: int | None = None
        for j in range(steps):
            last = int(rng.random() < system.arrival(last))
            nu[j, lane] = last
    return nu


def _channel_losses(rng: np.random.Generator, channel: Channel | FourStates, steps: int) -> list[int]:
    def drawn(chances: list[float]) -> int:
        return int(rng.choice(channel.states, p=chances))

    state, nu = drawn([channel.start(s) for s in channel.states]), []
    for _ in range(steps):
        nu.append(int(rng.random() < channel.fate(state, 1)))
        state = drawn([channel.move(state, to) for to in channel.states])
    return nu


def _ack_steps(rng: np.random.Generator, pattern: str, steps: int, lanes: int) -> Ints:
    in_time = np.broadcast_to(np.arange(1, steps + 1)[:, None], (steps, lanes))
    if pattern == "none":
        return np.zeros((steps, lanes), dtype=np.int64)
    if pattern == "all":
        return np.array(in_time, dtype=np.int64)
    arrives = rng.random((steps, lanes)) < 0.6
    delay = rng.integers(0, 4, size=(steps, lanes)) if pattern == "late" else 0
    return np.where(arrives, in_time + delay, 0).astype(np.int64)


def random_trial(
    rng: np.random.Generator,
    system: System,
    steps: int,
    lanes: int,
    acks: str = "none",
    arrivals: str = "random",
) -> Trial:
    """Simulate the system; each lane has its own u, noise, losses and ACKs. y is zero where nothing arrived."""
    u = rng.normal(size=(steps, lanes, system.q)) * rng.uniform(0.5, 5.0)
    nu = _losses(rng, system, steps, lanes)
    arrived = {"all": np.ones, "none": np.zeros}.get(arrivals, np.ones)((steps, lanes), dtype=bool)
    if arrivals == "random":
        arrived = rng.random((steps, lanes)) < rng.uniform(0.3, 0.9)
    x = rng.multivariate_normal(system.x0_mean, system.P0, size=lanes, method="eigh")
    y = np.zeros((steps, lanes, system.p))
    applied = np.stack([system.applied(u[:, i], nu[None, :, i])[0] for i in range(lanes)], axis=1)
    for k in range(steps):
        w = rng.multivariate_normal(np.zeros(system.n), system.Q, size=lanes, method="eigh")
        x = x @ system.A.T + applied[k] @ system.B.T + w
        y[k] = x @ system.C.T + rng.multivariate_normal(np.zeros(system.p), system.R, size=lanes)
    y[~arrived] = 0.0
    return Trial(system, u, y, arrived, nu, _ack_steps(rng, acks, steps, lanes))


@st.composite
def systems(draw: st.DrawFn, chains: tuple[str, ...] = CHAINS) -> System:
    n = draw(st.integers(1, 3), label="n")
    p = draw(st.integers(1, 2), label="p")
    q = draw(st.integers(1, 2), label="q")
    noise_rank = draw(st.integers(max(0, n - 1), n), label="rank of Q")
    chain = draw(st.sampled_from(chains), label="chain")
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1), label="seed of the system"))
    return random_system(rng, n, p, q, chain, noise_rank)


@st.composite
def trials(
    draw: st.DrawFn,
    acks: tuple[str, ...] = ACKS,
    chains: tuple[str, ...] = CHAINS,
    steps: tuple[int, int] = (1, 6),
    lanes: tuple[int, int] = (1, 4),
) -> Trial:
    system = draw(systems(chains))
    length = draw(st.integers(*steps), label="steps")
    width = draw(st.integers(*lanes), label="lanes")
    ack = draw(st.sampled_from(acks), label="acks")
    arrivals = draw(st.sampled_from(ARRIVALS), label="arrivals")
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1), label="seed of the trial"))
    return random_trial(rng, system, length, width, ack, arrivals)
