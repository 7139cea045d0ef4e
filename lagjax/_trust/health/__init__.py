"""`Health`: the accuracy of a trajectory, measured on the trajectory itself.

A motion satisfies laws, whatever solver integrated it. At every output are evaluated

    h − h₀ − ∫ P dt      with the power P = −∂L/∂t + Q·q̇ + λ·(G q̇), zero where nothing drives or slows the motion
    pᵢ − pᵢ₀             where neither L nor any force depends on qᵢ
    f, G q̇ + ∂f/∂t       of the constraints
    M                    its eigenvalues
    ∂(M, F, G)           by the state, the time and every parameter: whether it is finite

The first two are compared with what the tolerances allow. A step may put the error rtol|yᵢ| + atol into each component
of the state y = (q, q̇), and in a conserved quantity c such errors add up: after N steps c may be off by

    N maxₜ Σᵢ |∂c/∂yᵢ| (rtol|yᵢ| + atol),

times √(2n) `SLACK` for solvers that measure errors in root mean square, and round-off. Other errors, those of q above
all, may grow with the motion: there is no bound for them, only a second trajectory to compare with.

Between outputs the power is integrated along polynomials (`_measurements`). If the balance is off by more than a
hundredth of the energy, and the error of the work is as large, it counts as undecided. Source: Hairer, Nørsett &
Wanner, *Solving Ordinary Differential Equations I*, §II.4 (error per step), §II.6 (Hermite interpolation).

`_measurements` computes the fields of `Health` from states, by the laws of `_laws`; `_border_counts` counts the borders
that a motion crossed, `_global_error` compares with a second trajectory.
"""

import textwrap
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from lagjax._interface import RESULTS, Layout, advice, is_concrete, name_of, show_str
from lagjax._run import Members
from lagjax._scene import System
from lagjax._trust._diagnosis import diagnose, motion_end
from lagjax._trust.health._border_counts import BorderCounts, count_borders, is_piecewise
from lagjax._trust.health._global_error import global_error
from lagjax._trust.health._measurements import SLACK, SMALLEST, VISIBLE, Extreme, does_work, measure_trajectory

# The part of steps rejected beyond which the motion meets something that the step control does not get over.
UNSTEADY = 0.5


def examine(trajectory, reference=None) -> "Health":
    """Return the `Health` of a trajectory, with its global error if there is a reference; see `Trajectory.health`."""
    fields = measure_trajectory(trajectory)
    impacts = doubts = None
    if trajectory.impacts is not None:  # impacts and friction take energy: no balance of it is at hand
        shared = _shared_impacts(trajectory)
        impacts = trajectory.impacts.count, jnp.nansum(trajectory.impacts.energy_lost, axis=-1), *shared
        doubts = trajectory.contact_changes.doubts, trajectory.contact_changes.doubted
        fields["energy_allowed"] = jnp.full_like(jnp.asarray(fields["energy_allowed"]), jnp.inf)
    located, counts = _count_batch_borders(trajectory)
    changes = trajectory.transitions
    guards = changes and (changes.order_matters.any(-1), jnp.isfinite(changes.let_out).any(-1))
    return Health(
        result=trajectory.result,
        ok=jnp.asarray(trajectory.ok),
        t_end=jnp.asarray(trajectory.end.t),
        accepted_steps=jnp.asarray(trajectory.stats["num_accepted_steps"]),
        rejected_steps=jnp.asarray(trajectory.stats["num_rejected_steps"]),
        global_error=None if reference is None else global_error(trajectory, reference),
        borders=counts,
        borders_located=located,
        guards=guards,
        impacts=impacts,
        doubts=doubts,
        outputs=trajectory.ts.shape[-1],
        diagnosis=_first_diagnosis(trajectory),
        **fields,
    )


def _first_diagnosis(trajectory) -> str:
    """Return the diagnosis of the first member that failed; "" if none did, or inside a transformation."""
    concrete = all(is_concrete(leaf) for leaf in jax.tree.leaves(trajectory))
    if not isinstance(trajectory.system, System) or not concrete:
        return ""
    failed = np.argwhere(~np.asarray(trajectory.ok))
    if not len(failed):
        return ""
    members = Members(trajectory)
    which = tuple(failed[0].tolist())
    layout, row = members.layout, int(np.ravel_multi_index(which, members.batch)) if which else 0
    ended = motion_end(trajectory, layout, which, members.numbers_of(row).astype(layout.dtype))
    return diagnose(trajectory.system, layout, members.params_of(row), ended).strip()


def _shared_impacts(trajectory) -> tuple:
    """Return the number of impacts that several contacts took part in, and the time of the first one."""
    t, leaves = trajectory.impacts.t, jax.tree.leaves(trajectory.impacts.impulse)
    pushes = jnp.concatenate([jnp.reshape(x, (*t.shape, -1)) > 0 for x in leaves], axis=-1)
    shared = jnp.sum(pushes, axis=-1) > 1
    if trajectory.system.impacts == "sequential":  # one after the other, at one instant
        shared = jnp.concatenate([shared[..., :1], t[..., 1:] == t[..., :-1]], axis=-1)
    return jnp.sum(shared, axis=-1), jnp.nanmin(jnp.where(shared, t, jnp.nan), axis=-1)


def _count_batch_borders(trajectory) -> tuple[bool, BorderCounts | None]:
    """Return `count_borders` with the batch axes of the trajectory; None for a traced piecewise scene."""
    if all(is_concrete(leaf) for leaf in jax.tree.leaves(trajectory)):
        members = Members(trajectory)
        located, counts = count_borders(members)
        return located, counts and BorderCounts(*(jnp.asarray(np.reshape(x, members.batch)) for x in counts))
    system, piecewise = trajectory.system, []
    if not isinstance(system, System):
        return True, None

    def none(q, qdot, times_and_tolerances, params, mode):
        layout = Layout.from_state(*jax.tree.map(lambda leaf: leaf[0], (q, qdot)))
        piecewise.append(is_piecewise(system, layout, params))
        return jnp.zeros((), int)

    zero = trajectory.map_members(none)
    located = trajectory.engine == "MachineCode" or not piecewise[0]
    return located, None if piecewise[0] else BorderCounts(zero, zero, zero, jnp.full(zero.shape, jnp.nan))


class Health(eqx.Module):
    """The trust that a trajectory deserves; made by `Trajectory.health`. Print it, or read its fields.

    Every field has the batch axes of the trajectory, and is measured over the outputs that were reached. An `Extreme`
    is a pair of a `value` and the time `t` of the output that has it, NaN where nothing was reached.

    - `result`, `ok`, `accepted_steps`, `rejected_steps`: as in the trajectory.
    - `energy`: the largest |h − h₀ − W|, in units of energy, W the work done by forces, by an explicit time and by
      moving constraints. `energy_allowed`: the drift that tolerances and round-off may add up to. `work_error`: the
      uncertainty of W from the outputs alone, zero where nothing does work; an imbalance below it means nothing. Where
      a force of a piecewise scene does work, the balance of a motion that has met borders is not judged.
      `outputs_needed`: about how many outputs would decide whether the power is balanced; the present number where it
      suffices. Where a transition lies between two outputs, the energy it takes is left out, and so is the time from it
      to the next output.
    - `amplitude`: the largest change of a coordinate; infinite where nothing moves. `amplitude_needed`: the size below
      which atol allows errors of a ten-thousandth of it or more in every step; zero for fixed steps.
    - `momentum`, as `energy`: for each momentum that is conserved, pᵢ with ∂L/∂qᵢ = 0 and no force of any kind on it; a
      last axis for those in `momentum_names`, which is None where that is not known. `momentum_allowed`: as
      `energy_allowed`.
    - `constraint_distance`: for each of `constraint_names` (a last axis) the largest distance |f| / |∂f/∂q| of q from
      f = 0, zero for a velocity constraint; `constraint_rate`: the same for velocities, |Gq̇ + ∂f/∂t| / |G|.
      `constraint_allowed`: for these two (a last axis).
    - `smallest_eigenvalue` of M = ∂²L/∂q̇² (negative where M is indefinite); `condition`: the largest max|λ| / min|λ|;
      `scaled_condition`: the same after scaling M to a unit diagonal, which decides the accuracy of accelerations. All
      three are None in a large scene whose M is not diagonal. `scaled_condition_allowed`: where round-off in q̈ reaches
      `SLACK` rtol; infinite with constraints, which may make up for a singular M.
    - `gradients_finite`: whether all terms of the equations of motion have finite derivatives with respect to the
      state, the time and every parameter, at every output; `gradients_time`: the first time at which they do not.
    - `diagnosis`: why the first member that failed did not reach its end, in words; empty where all did, and under
      `jax.jit`.
    - `borders`: how often the motion `crossed` a border of a piecewise force or L, began to slide along one (`slid`, as
      dry friction does that sticks), and `grazed` one, first at the time `t` (NaN: never). There a change within the
      tolerance decides whether the border is crossed: derivatives that do not exist are NaN. None where that is not
      known: in a hybrid motion, under `jax.jit`, and where `borders_located` is False, because a solver of diffrax has
      stepped across the borders.
    - `guards`: in a hybrid motion, whether blows met at one instant that do not commute, and whether a guard was let
      out that was beyond zero where a mode began (`Transitions`); else None.
    - `impacts`: in a scene with contacts, how many there were and the energy that they took, how many of them several
      contacts shared, and when that first was (NaN: never); else None. Where contacts share an impact, the laws of
      impacts (`impacts=` of the System) differ. The balance of energy and momenta are not judged there.
    - `doubts`: in such a scene a pair, how many there were and when the first was (NaN: never), with a last axis for
      impacts that gained energy, for those that contacts share which close at one instant by themselves, and for slips
      that begin at a start at rest, or from rest in space: of the last two not all derivatives are there. Else None.
    - `global_error`: with a reference, the largest |yᵢ − reference| over the components of q and q̇, in units of the
      largest |yᵢ| along the path (and atol/rtol more, as in the tolerances); else None.
    """

    result: RESULTS
    ok: Bool[Array, "*batch"]
    t_end: Float[Array, "*batch"]
    accepted_steps: Int[Array, "*batch"]
    rejected_steps: Int[Array, "*batch"]
    energy: Extreme
    energy_allowed: Float[Array, "*batch"]
    work_error: Float[Array, "*batch"]
    outputs_needed: Float[Array, "*batch"]
    amplitude: Float[Array, "*batch"]
    amplitude_needed: Float[Array, "*batch"]
    momentum: Extreme  # each field (*batch, momenta)
    momentum_allowed: Float[Array, "*batch momenta"]
    constraint_distance: Extreme  # each field (*batch, m)
    constraint_rate: Extreme  # each field (*batch, m)
    constraint_allowed: Float[Array, "*batch 2"]
    smallest_eigenvalue: Extreme | None
    condition: Extreme | None
    scaled_condition: Extreme | None
    scaled_condition_allowed: Float[Array, "*batch"]
    gradients_finite: Bool[Array, "*batch"]
    gradients_time: Float[Array, "*batch"]
    global_error: Extreme | None
    borders: BorderCounts | None
    guards: tuple[Bool[Array, "*batch"], Bool[Array, "*batch"]] | None
    impacts: tuple[Int[Array, "*batch"], Float[Array, "*batch"], Int[Array, "*batch"], Float[Array, "*batch"]] | None
    doubts: tuple[Int[Array, "*batch 3"], Float[Array, "*batch 3"]] | None
    borders_located: bool = eqx.field(static=True)
    outputs: int = eqx.field(static=True)
    diagnosis: str = eqx.field(static=True)
    works: bool = eqx.field(static=True)
    momentum_names: tuple[str, ...] | None = eqx.field(static=True)
    constraint_names: tuple[str, ...] = eqx.field(static=True)

    @property
    def suspicious(self) -> Bool[Array, "*batch"]:
        """True if any of the `checks` is, for each member."""
        flags, xp = self._health_flags()
        return jnp.asarray(xp.any(xp.stack(list(flags.values())), axis=0))

    def checks(self) -> dict[str, Bool[Array, "*batch"]]:
        """The suspicions, by name: a Boolean for each member. A NaN at a state that was reached is."""
        return {name: jnp.asarray(flag) for name, flag in self._health_flags()[0].items()}

    @property
    def _energy_limit(self):
        """The imbalance of energy above which it is suspicious: the drift allowed, plus the error of the work."""
        return self.energy_allowed + SLACK * self.work_error

    def _health_flags(self) -> tuple[dict, Any]:
        """Return `checks`, and the library of its arrays: NumPy unless something is traced."""
        concrete = all(is_concrete(leaf) for leaf in jax.tree.leaves(self))
        xp = np if concrete else jnp
        of = jax.tree.map(np.asarray, self) if concrete else self
        tries = of.accepted_steps + of.rejected_steps
        with np.errstate(invalid="ignore"):
            flags = {
                "result": ~of.ok,
                "energy": _exceeds_limit(xp, of.energy, of._energy_limit) & ~(of.outputs_needed > of.outputs),
                "amplitude": of.amplitude < of.amplitude_needed,
                "momentum": _exceeds_limit(xp, of.momentum, of.momentum_allowed).any(axis=-1),
                "constraints": _exceeds_limit(xp, of.constraint_distance, of.constraint_allowed[..., :1]).any(axis=-1)
                | _exceeds_limit(xp, of.constraint_rate, of.constraint_allowed[..., 1:]).any(axis=-1),
                "gradients": ~of.gradients_finite,
                "steps": of.rejected_steps > xp.maximum(UNSTEADY * tries, 20),
            }
            if of.borders is not None:
                flags["grazed"] = of.borders.grazed > 0
                if of.works:  # what a force that jumps between two outputs does there is not known
                    flags["energy"] &= (of.borders.crossed == 0) & (of.borders.slid == 0)
            elif not of.borders_located:
                flags["borders"] = of.accepted_steps >= 0
            if of.guards is not None:
                flags["order"], flags["let_out"] = of.guards
            if of.doubts is not None:
                flags |= {name: of.doubts[0][..., k] > 0 for k, name in enumerate(_DOUBTS)}
            if of.scaled_condition is not None:
                flags["mass_matrix"] = _exceeds_limit(xp, of.scaled_condition, of.scaled_condition_allowed)
            if of.global_error is not None:
                flags["global_error"] = _exceeds_limit(xp, of.global_error, VISIBLE)
        return flags, xp

    def findings(self) -> tuple[str, ...]:
        """Sentences about what is suspicious or cannot be told, which say what to do; none where all is well."""
        flags = self._health_flags()[0]
        raised = {name: np.asarray(flags[name]) for name in _SENTENCES if name in flags and np.any(flags[name])}
        sides = "" if self.borders_located else "make it an event or a mode, or "
        sentences = {name: _SENTENCES[name].format(_member_share(members), sides) for name, members in raised.items()}
        for k, name in enumerate(_DOUBTS):
            if name in raised:
                assert self.doubts is not None
                counts, times = (np.asarray(x)[..., k] for x in self.doubts)
                sentences[name] = f"{sentences[name]} {counts.sum()} in all, the first at t = {np.nanmin(times):.6g}."
        if "result" in raised:
            codes, counts = np.unique(np.asarray(self.result._value)[~np.asarray(self.ok)], return_counts=True)
            name = name_of(codes[np.argmax(counts)])  # of most of the members that failed
            sentences["result"] += f" {name}: {advice(getattr(RESULTS, name))}"
            if self.diagnosis:
                of = f" Of the first of them: {self.diagnosis}" if self.ok.ndim else f" {self.diagnosis}"
                sentences["result"] += of.replace("\n", " ")
        if "amplitude" in raised:
            # The atol whose ratio to this motion is that of the present atol to a motion of order one.
            wanted = np.where(raised["amplitude"], np.asarray(self.amplitude * self.amplitude_needed), np.inf)
            sentences["amplitude"] += f"{np.min(wanted) / SMALLEST:.0e}."
        return (*sentences.values(), *self._explain_undecided())

    def _explain_undecided(self) -> tuple[str, ...]:
        """Return a sentence if there are too few outputs to decide whether the power is balanced; else ()."""
        outputs, needed = np.asarray(self.outputs), np.asarray(self.outputs_needed)
        undecided = needed > outputs
        if not undecided.any():
            return ()
        most = needed[undecided].max()
        advice = (
            f"Ask for at least about {most:.0f} outputs over the same time, evenly spread."
            if np.isfinite(most)
            else "The power is not finite or not smooth somewhere: give it in modes of a lagjax.Hybrid."
        )
        return (
            f"Power balance: cannot be told{_member_share(undecided)} from {outputs} outputs, between which the "
            f"work is not known to a hundredth of the energy. {advice}",
        )

    _repr_pretty_ = show_str

    def __str__(self) -> str:
        rows = [("result", self._result_rows()), ("steps", self._step_rows())]
        error = np.max(np.nan_to_num(np.asarray(self.work_error, float), nan=-np.inf))
        known = f"; the work between outputs is known to {error:.1e}" if self.works else ""
        law = "power balance" if self.works else "energy"
        if self.impacts is None:
            rows.append((law, f"off by {_find_worst(self.energy, self._energy_limit)}{known}"))
        else:
            count, lost, shared, t = (np.asarray(x) for x in self.impacts)
            took = f"{count.sum()}, which took an energy of {np.sum(lost):.3g} away"
            rows.append(("impacts", f"{took}; the balance of energy is not judged"))
            if shared.any():
                law = f"{shared.sum()} shared by several contacts, the first at t = {np.nanmin(t):.6g}: there another"
                rows.append(("", f"{law} law of impacts gives another motion"))
        if self.doubts is not None and (slips := np.asarray(self.doubts[0])[..., 2].sum()):
            rows.append(("", f"{slips} slips begin from rest: not all derivatives of what follows are there"))
        if self.momentum_names is None:
            rows.append(("momenta", "not known which are conserved: the scene has no scalar program"))
        if text := self._border_contacts():
            rows.append(("borders", text))
        rows += _worst_row("momenta", self.momentum_names or (), self.momentum, self.momentum_allowed)
        for k, (what, off) in enumerate((("q", self.constraint_distance), ("qdot", self.constraint_rate))):
            allowed = np.broadcast_to(np.asarray(self.constraint_allowed)[..., k, None], off.value.shape)
            rows += _worst_row(f"constraints, {what}", self.constraint_names, off, allowed)
        if self.smallest_eigenvalue is None or self.condition is None or self.scaled_condition is None:
            rows.append(("mass matrix", "eigenvalues are not computed: the scene is large"))
        else:
            smallest = Extreme(-np.asarray(self.smallest_eigenvalue.value), self.smallest_eigenvalue.t)
            rows += [
                ("mass matrix", f"smallest eigenvalue {_find_worst(smallest, sign=-1)}"),
                ("", f"condition {_find_worst(self.condition)}"),
                ("", f"scaled to a unit diagonal {_find_worst(self.scaled_condition, self.scaled_condition_allowed)}"),
            ]
        rows.append(("gradients", "finite" if np.all(self.gradients_finite) else "not finite"))
        if self.global_error is not None:
            rows.append(("global error", f"{_find_worst(self.global_error, VISIBLE)}, in units of the largest |y|"))
        verdict = self.findings() or ("nothing suspicious",)
        lines = [line for text in verdict for line in textwrap.wrap(text, 100)]
        rows += [("" if k else "verdict", line) for k, line in enumerate(lines)]
        return "\n".join(f"{name:17s} {text}" for name, text in rows)

    def _border_contacts(self) -> str:
        """Return the report's row on borders that the motion crossed, slid along or grazed; "" if none."""
        if self.borders is None:
            return "" if self.borders_located else "not located"
        crossed, slid, grazed = (np.asarray(x) for x in self.borders[:3])
        most = "" if crossed.ndim == 0 else "at most "
        parts = [f"{most}{crossed.max()} crossed"] if crossed.any() or slid.any() or grazed.any() else []
        parts += [f"{most}{slid.max()} slid along"] if slid.any() else []
        if grazed.any():
            parts.append(f"{most}{grazed.max()} grazed, the first at t = {np.nanmin(np.asarray(self.borders.t)):.6g}")
        return "; ".join(parts)

    def _result_rows(self) -> str:
        codes, counts = np.unique(np.asarray(self.result._value), return_counts=True)
        if self.ok.ndim == 0:
            return name_of(codes[0])
        listed = [f"{counts[k]} {name_of(codes[k])}" for k in np.argsort(-counts)]
        return f"of {self.ok.size} members " + ", ".join(listed)

    def _step_rows(self) -> str:
        accepted, rejected = (np.asarray(x).ravel() for x in (self.accepted_steps, self.rejected_steps))
        if self.ok.ndim == 0:
            return f"{accepted[0]} accepted, {rejected[0]} rejected"
        return f"{np.median(accepted):.0f} accepted, at most {accepted.max()}; at most {rejected.max()} rejected"


def _exceeds_limit(xp, extreme: Extreme, allowed):
    return ~xp.isnan(extreme.t) & ~(extreme.value <= allowed)


def _find_worst(extreme: Extreme, allowed=None, sign: int = 1) -> str:
    """Return the largest value of all members as text, where and when; `sign` is the sign of the values printed."""
    values, times = np.asarray(extreme.value, float), np.asarray(extreme.t, float)
    if np.isnan(times).all():
        return "nan: no output was reached"
    index = np.unravel_index(np.argmax(np.where(np.isnan(times), -np.inf, values)), values.shape)  # NaN before all
    text = f"{sign * values[index]:.1e} at t = {times[index]:.6g}" + (f" in member {_member(index)}" if index else "")
    if allowed is None or not np.isfinite(limit := np.broadcast_to(allowed, values.shape)[index]):
        return text
    return f"{text} ({limit:.1e} allowed)"


def _worst_row(label: str, names: tuple[str, ...], extreme: Extreme, allowed) -> list[tuple[str, str]]:
    """Return the report's row for the one of several named quantities that is largest relative to its limit."""
    if not names:
        return []
    allowed = np.asarray(allowed)
    with np.errstate(all="ignore"):
        part = (np.asarray(extreme.value) / allowed).reshape(-1, len(names))
    part = np.where(np.isnan(np.asarray(extreme.t)).reshape(part.shape), -np.inf, part)
    which = int(np.argmax(np.max(part, axis=0)))
    picked = Extreme(extreme.value[..., which], extreme.t[..., which])
    of = names[which] if len(names) == 1 else f"worst of {len(names)}: {names[which]}"
    return [(label, f"{of} off by {_find_worst(picked, allowed[..., which])}")]


def _member_share(flags: np.ndarray) -> str:
    if flags.ndim == 0:
        return ""
    return f" in {np.sum(flags)} of {flags.size} members, the first {_member(np.argwhere(flags)[0])}"


def _member(index) -> str:
    return str(int(index[0])) if len(index) == 1 else str(tuple(int(i) for i in index))


_DOUBTS = "gained_energy", "closed_together"  # in the order of `ContactChanges.doubts`
_SENTENCES = {
    "result": "The motion did not reach its end{0}.",
    "energy": (
        "Energy: off by more than accurate steps leave{0}. Something is not smooth within a step (a force that jumps, "
        "a contact), or the steps are too long: tighten rtol or shorten dt."
    ),
    "amplitude": (
        "Amplitude: the motion{0} is so small beside atol that the errors it allows add up to a hundredth of it within "
        "a hundred steps. Use units in which the motion is of order one, or pass atol="
    ),
    "momentum": "Momentum: what is conserved is off by more than accurate steps leave{0}: tighten rtol or shorten dt.",
    "constraints": "Constraints: the motion has left them{0}: tighten rtol or shorten dt.",
    "mass_matrix": (
        "Mass matrix: so near to singular{0} that round-off in the acceleration exceeds the tolerance. Use other "
        "coordinates or float64, or loosen rtol."
    ),
    "gradients": (
        "Gradients: derivatives of the acceleration are not finite{0}, and jax.grad of this motion would be NaN. Look "
        "for a norm or a square root at zero, or a branch of `where` that is not taken."
    ),
    "steps": (
        "Steps: most were rejected{0}. The motion meets something that is not smooth, or is stiff: {1}use an implicit "
        "solver."
    ),
    "grazed": (
        "Borders: one was grazed{0}, so that a change within the tolerance decides whether it is crossed. Derivatives "
        "of what comes after do not exist there, and are NaN where the acceleration jumps, second ones also where its "
        "slope does."
    ),
    "borders": (
        "Borders: this engine does not locate them, its steps go across what is pieced together in the scene{0}. A "
        "narrow piece may be missed, and there are no derivatives across a jump: `System.explain` says why the motion "
        "is not in machine code, where steps end at borders."
    ),
    "order": (
        "Transitions: blows meet at one instant, and another order of the list leads to another motion{0}. "
        "`trajectory.transitions.order_matters` says where. Say what happens to both at once in one transition."
    ),
    "let_out": (
        "Transitions: a guard was beyond zero where a mode began, and came back instead of a blow{0}. "
        "`trajectory.transitions.let_out` says which, and when. Begin on the other side of it."
    ),
    "gained_energy": (
        "Impacts: one gained energy{0}. Newton's law may, with friction or with several restitutions (Kane). Of one "
        "contact in a plane impacts='poisson' does not; of several none does with restitution=0."
    ),
    "closed_together": (
        "Contacts: several that share an impact closed at one instant by themselves{0}. Derivatives in directions that "
        "part them do not exist and are NaN; in reverse mode all are."
    ),
    "global_error": (
        "Global error: the motion parts from its reference by a hundredth of its size or more{0}. If its steps are "
        "accurate it is chaotic or unstable: tighten rtol, trust a shorter time, or speak of averages."
    ),
}
