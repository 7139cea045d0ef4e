"""A motion with contacts by another hand: all modes are enumerated, SciPy's DOP853 runs from event to event.

A contact is open, sticks, or slides one way or the other; k contacts have up to 4^k modes, and each is a system of
linear equations by NumPy. A motion is in one of them until a watch falls through zero: a gap, a normal force, a slip or
what friction has left. There every mode is tried. One whose watches are zero is judged by where they are a thousandth
of a time later, along its own motion. A blow is judged in the same way, by complementarity of velocities (Newton,
Moreau, Glocker, Coulomb's tangential impulse). Bounces are followed one by one until they last less than 1e-6.

Nothing of lagjax is used: JAX differentiates the scene's functions, and the rest is here. What two answers fit, or
none, is `Ambiguous`.
"""

import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import DOP853, solve_ivp
from scipy.optimize import brentq

STILL = 1e-9  # rates, slips and gaps below this are zero: all are solved to 1e-12, and numbers of scenes are 1
TOGETHER = 5e-15  # gaps below this beside one that closes are zero by symmetry, and not by rounding
ARMED = 1e-12  # a watch that was above this once is one that may fall
LATER, LONGEST = 1e-3, 0.02  # where a watch that is zero is judged; the longest step
SHORTEST_FLIGHT = 1e-6  # bounces that are shorter are rest: a sequence that ends here moves by 1e-11
MOST_EVENTS, NODES = 3000, np.linspace(0.0, 1.0, 13)[1:]
OPEN, SLIDES, STICKS = (0, 0), (1, 0), (2, 0)  # kind, direction


class Ambiguous(Exception):
    """A motion that the law does not settle, or that rounding decides."""


def no_numbers(q, *_):
    """No gaps, or no one-way velocities."""
    return jnp.zeros(0)


class Scene(NamedTuple):
    """The functions of a scene, of vectors: q and v of n numbers, gaps and one-way velocities of k, slips of k."""

    lagrangian: Callable  # (q, v, t, p)
    gaps: Callable = no_numbers  # (q, t, p)
    one_way: Callable = no_numbers  # (q, v, t, p), after the gaps
    slip: Callable | None = None  # (q, v, t, p)
    forces: Callable = lambda q, v, t, p: jnp.zeros_like(q)
    restitution: Callable = lambda p: 0.0  # numbers, one for each contact or one for all
    friction: Callable = lambda p: 0.0
    impacts: str = "simultaneous"


class Terms(NamedTuple):
    """All that a state gives: M a = f + W' λ + T' F; d(rates)/dt = W a + w; d(slips)/dt = T a + s."""

    M: np.ndarray
    f: np.ndarray
    W: np.ndarray
    w: np.ndarray
    T: np.ndarray
    s: np.ndarray
    free: np.ndarray  # gaps, and velocities of one-way contacts
    rates: np.ndarray
    slips: np.ndarray


class Event(NamedTuple):
    """An event: its time, the state before and after, the contact whose watch fell, and the impulses."""

    t: float
    before: np.ndarray
    after: np.ndarray
    contact: int
    impulse: np.ndarray


class Motion(NamedTuple):
    """The end, the events on the way, and when contacts began to rest after bounces: (t, contact)."""

    z: np.ndarray
    events: list
    rests: list


class Reference:
    """The motions of one scene; its functions compile once for all starts and parameters."""

    def __init__(self, scene: Scene, q, p):
        self.scene, self.n = scene, len(q)
        q, p = jnp.asarray(q, float), jnp.asarray(p, float)
        self.k_gaps = scene.gaps(q, 0.0, p).size
        self.k = self.k_gaps + scene.one_way(q, q, 0.0, p).size
        self.is_gap = np.arange(self.k) < self.k_gaps
        self._compiled = jax.jit(self._evaluate)

    def _evaluate(self, z, t, p):
        s, (q, v) = self.scene, jnp.split(z, 2)
        zero = jnp.zeros_like(q)

        def rates(q, v, t):
            return jnp.concatenate([jax.jvp(lambda q, t: s.gaps(q, t, p), (q, t), (v, 1.0))[1], s.one_way(q, v, t, p)])

        def slips(q, v, t):
            return jnp.zeros(self.k) if s.slip is None else s.slip(q, v, t, p)

        def change(f):
            return jax.jvp(f, (q, v, t), (v, zero, 1.0))[1]

        def momentum(q, v, t):
            return jax.grad(s.lagrangian, 1)(q, v, t, p)

        f = jax.grad(s.lagrangian, 0)(q, v, t, p) + s.forces(q, v, t, p) - change(momentum)
        free = jnp.concatenate([s.gaps(q, t, p), s.one_way(q, v, t, p)])
        W, T = jax.jacfwd(rates, 1)(q, v, t), jax.jacfwd(slips, 1)(q, v, t)
        M = jax.hessian(s.lagrangian, 1)(q, v, t, p)
        parts = M, f, W, change(rates), T, change(slips), free, rates(q, v, t), slips(q, v, t)
        self.shapes = [part.shape for part in parts]
        return jnp.concatenate([part.ravel() for part in parts])  # one array comes over faster than nine

    def terms(self, z, t) -> Terms:
        """The numbers of a state."""
        flat = np.asarray(self._compiled(z, float(t), self.p))
        ends = np.cumsum([0, *map(math.prod, self.shapes)])
        return Terms(*(flat[a:b].reshape(s) for a, b, s in zip(ends, ends[1:], self.shapes, strict=False)))

    def solve(self, x: Terms, mode, force, normal, tangential):
        """Accelerations or changes of velocity, with normal and tangential forces or impulses."""
        n, k, i = self.n, self.k, np.arange(self.k)
        kind, c = np.array([m[0] for m in mode], int), np.array([m[1] for m in mode], float)
        closed, stick = kind > 0, kind == 2
        A, b = np.zeros((n + 2 * k, n + 2 * k)), np.concatenate([force, closed * normal, stick * tangential])
        A[:n, :n], A[:n, n : n + k], A[:n, n + k :] = x.M, -x.W.T, -x.T.T
        A[n : n + k, :n], A[n + i, n + i] = closed[:, None] * x.W, ~closed
        A[n + k :, :n], A[n + k + i, n + k + i] = stick[:, None] * x.T, ~stick
        A[n + k + i, n + i] = np.where(stick, 0.0, self.mu * c)
        try:
            y = np.linalg.solve(A, b)
        except np.linalg.LinAlgError:
            y = np.full(len(b), np.nan)
        return y[:n], y[n : n + k], y[n + k :]

    def accelerations(self, x: Terms, mode):
        """q̈, normal and tangential forces of a mode."""
        return self.solve(x, mode, x.f, -x.w, -x.s)

    def flow(self, z, t, mode):
        """ż."""
        return np.concatenate([z[self.n :], self.accelerations(self.terms(z, t), mode)[0]])

    def watches(self, z, t, mode) -> np.ndarray:
        """(k, 3) numbers that stay positive: gap or force; slip, or friction's reserve on both sides."""
        x = self.terms(z, t)
        _, normal, f = self.accelerations(x, mode)
        out = np.ones((self.k, 3))
        for i, (kind, c) in enumerate(mode):
            out[i, 0] = normal[i] if kind else x.free[i]
            if kind == 1 and c:
                out[i, 1] = c * x.slips[i]
            if kind == 2:
                out[i, 1:] = self.mu[i] * normal[i] - f[i], self.mu[i] * normal[i] + f[i]
        return out

    # ---- decisions --------------------------------------------------------------------------------------------------

    def _choices(self, i, slip):
        """The modes of a contact that may stay closed."""
        if self.scene.slip is None or self.mu[i] == 0:
            return [SLIDES, OPEN]
        if abs(slip) > STILL:
            return [(1, int(np.sign(slip))), OPEN]
        return [STICKS, (1, 1), (1, -1), OPEN]

    def decide(self, z, t, touching):
        """The one mode that goes on from here."""
        x = self.terms(z, t)
        still = touching & (np.abs(x.rates) <= STILL)
        still |= touching & ~self.is_gap & (x.rates <= STILL)
        choices = [self._choices(i, x.slips[i]) if still[i] else [OPEN] for i in range(self.k)]
        good = []
        for mode in itertools.product(*choices):
            a, normal, f = self.accelerations(x, mode)
            if np.isfinite(a).all() and self._goes_on(z, t, mode, x, still, a, normal, f):
                good.append((mode, a))
        if not good:
            raise Ambiguous(f"t = {t}: no mode goes on")
        if any(np.abs(a - good[0][1]).max() > 1e-7 * (1 + np.abs(a).max()) for _, a in good):
            raise Ambiguous(f"t = {t}: {len(good)} modes go on")
        return good[0][0]

    def _goes_on(self, z, t, mode, x, still, a, normal, f) -> bool:
        low, rates, slips = [], x.W @ a + x.w, x.T @ a + x.s
        for i in np.flatnonzero(still):
            kind, c = mode[i]
            low.append(normal[i] if kind else rates[i])
            if kind == 2:
                low += [self.mu[i] * normal[i] - f[i], self.mu[i] * normal[i] + f[i]]
            elif kind == 1 and c and abs(x.slips[i]) <= STILL:
                low.append(c * slips[i])
        low = np.array(low) / (1 + np.abs(a).max())
        if (low > 1e-7).all() or (low < -1e-7).any():
            return bool((low > 1e-7).all())
        run = solve_ivp(lambda t, z: self.flow(z, t, mode), (t, t + LATER), z, "DOP853", rtol=1e-13, atol=1e-15)
        return bool((self.watches(run.y[:, -1], run.t[-1], mode)[still] > -1e-12).all()) if run.success else False

    def blow(self, z, t, touching):
        """The state behind one blow, and its normal impulses."""
        x = self.terms(z, t)
        if self.scene.impacts == "sequential":
            touching = np.arange(self.k) == np.where(touching, x.rates, np.inf).argmin()

        def rough(i):
            return self.scene.slip is not None and self.mu[i] > 0

        choices = [
            ([STICKS, (1, 1), (1, -1), OPEN] if rough(i) else [SLIDES, OPEN]) if touching[i] else [OPEN]
            for i in range(self.k)
        ]
        found, small = [], 1e-10 * (1 + np.abs(x.rates).max())
        for mode in itertools.product(*choices):
            dv, normal, f = self.solve(x, mode, np.zeros(self.n), -(1 + self.e) * x.rates, -x.slips)
            after, slips = x.rates + x.W @ dv, x.slips + x.T @ dv
            kind = np.array([m[0] for m in mode])
            c = np.array([m[1] for m in mode])
            good = (
                np.isfinite(dv).all()
                and (normal >= -small).all()
                and (after + self.e * x.rates >= -small)[touching].all()
            )
            good = good and (np.abs(f) <= self.mu * normal + small)[kind == 2].all()
            if good and (c * slips >= -small)[kind == 1].all():
                found.append((dv, normal))
        if not found or any(np.abs(dv - found[0][0]).max() > 1e-7 for dv, _ in found):
            raise Ambiguous(f"t = {t}: {len(found)} blows")
        return np.concatenate([z[: self.n], z[self.n :] + found[0][0]]), found[0][1]

    def settle(self, z, t, touching):
        """Blows until nothing moves inwards, then the mode; bounces that are too short are held."""
        total, hit = np.zeros(self.k), np.zeros(self.k, bool)
        for _ in range(200):
            inwards = touching & (self.terms(z, t).rates < -STILL) & self.is_gap
            if not inwards.any():
                break
            z, impulse = self.blow(z, t, touching)
            total, hit = total + impulse, hit | inwards
        else:
            raise Ambiguous(f"t = {t}: blows without end")
        mode, rests = self.decide(z, t, touching), []
        x = self.terms(z, t)
        b = -(x.W @ self.accelerations(x, mode)[0] + x.w)
        for i in np.flatnonzero(hit & (x.rates > STILL) & (b > 0)):
            if 2 * x.rates[i] / b[i] < SHORTEST_FLIGHT:
                rests.append((t + 2 * x.rates[i] / (b[i] * (1 - self.e[i])), i))
        if rests:
            e = self.e
            self.e = np.where(np.isin(np.arange(self.k), [i for _, i in rests]), 0.0, e)
            # The bounces that are left rub too: one that slides goes on, one that does not sticks.
            held = [self._choices(i, x.slips[i])[0] if i in [j for _, j in rests] else OPEN for i in range(self.k)]
            dv, normal, _ = self.solve(x, held, np.zeros(self.n), -x.rates, -x.slips)
            z, self.e, total = np.concatenate([z[: self.n], z[self.n :] + dv]), e, total + normal
            mode = self.decide(z, t, touching)
        return z, mode, total, rests

    # ---- the motion -------------------------------------------------------------------------------------------------

    def run(self, q, v, T, p) -> Motion:
        """The motion from t = 0 to T."""
        self.p = np.asarray(p, float)
        self.mu, self.e = (
            np.asarray(f(self.p)) * np.ones(self.k) for f in (self.scene.friction, self.scene.restitution)
        )
        z, t, events, rests = np.concatenate([q, v]).astype(float), 0.0, [], []
        free = self.terms(z, t).free
        if (free[self.is_gap] < -STILL).any():
            raise Ambiguous("a start inside")
        z, mode, _, at_rest = self.settle(z, t, free <= STILL)
        rests += at_rest
        while t < T:
            t, z, contact = self._follow(z, t, T, mode)
            if contact is None:
                return Motion(z, events, rests)
            closed = np.array([kind > 0 for kind, _ in mode])
            before, free = z, self.terms(z, t).free
            sure = closed | (np.arange(self.k) == contact) | (free <= TOGETHER)
            touching = sure | (free <= STILL)
            z, mode, impulse, at_rest = self.settle(before, t, touching)
            if (touching != sure).any() and np.abs(self.settle(before, t, sure)[0] - z).max() > STILL:
                raise Ambiguous(f"t = {t}: rounding decides what else touches")
            events.append(Event(t, before, z, contact, impulse))
            rests += at_rest
            if len(events) > MOST_EVENTS:
                raise Ambiguous(f"t = {t}: too many events")
        return Motion(z, events, rests)

    def _follow(self, z, t, T, mode):
        """To the next fall of a watch, or to T: (t, z, contact)."""
        x = self.terms(z, t)
        b = np.abs(x.W @ self.accelerations(x, mode)[0] + x.w)
        flights = [2 * r / c for r, c, (kind, _) in zip(x.rates, b, mode, strict=True) if kind == 0 and r > 0 and c > 0]
        first = min([1e-4, T - t, *(flight / 20 for flight in flights if flight > 0)])

        def flow(t, z):
            return self.flow(z, t, mode)

        solver = DOP853(flow, t, z, T, rtol=1e-13, atol=1e-14, max_step=LONGEST, first_step=first)
        last = self.watches(z, t, mode)
        armed = last > ARMED
        while solver.status == "running":
            solver.step()
            if solver.status == "failed":
                raise Ambiguous(f"t = {solver.t}: DOP853 failed")
            dense, left = solver.dense_output(), solver.t_old
            for s in solver.t_old + NODES * (solver.t - solver.t_old):
                now = self.watches(dense(s), s, mode)
                if (now < -1e-7)[~armed].any():
                    raise Ambiguous(f"t = {s}: a watch that was zero is negative")
                falls = [(brentq(self._one(dense, mode, i, j), left, s, xtol=1e-15, rtol=1e-15), i)
                         for i, j in zip(*np.nonzero(armed & (now < 0)), strict=True)]  # fmt: skip
                if falls:
                    at, i = min(falls)
                    return at, dense(at), int(i)
                armed |= now > ARMED
                left = s
        return T, solver.y, None

    def _one(self, dense, mode, i, j):
        return lambda s: self.watches(dense(s), s, mode)[i, j]
