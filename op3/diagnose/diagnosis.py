"""The workflow: refit the base, screen, refit the shortlist, decide, add, show."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from op3.diagnose.ceiling import Ceiling, ceiling, where
from op3.diagnose.coordinates import (
    Coordinates,
    base_coordinates,
    other_forms,
    with_chain,
)
from op3.diagnose.counting import (
    beyond_doubt,
    of_another_kind,
    shown_by_windows,
    worth_a_candidate,
)
from op3.diagnose.decide import Decision, decide
from op3.diagnose.findings import Refitted, finding_of, with_finding
from op3.diagnose.fitting import (
    LEAST_GAIN,
    ROUNDS,
    WORTHWHILE,
    Engine,
    Fit,
    fit_base,
    linearise,
    with_point,
)
from op3.diagnose.free_run import engine_for
from op3.diagnose.gaps import contradicted, large_gap, leaves_a_joint, local_ceiling, stands_out, unresolved
from op3.diagnose.hypotheses import hypotheses, separating
from op3.diagnose.locate import locate
from op3.diagnose.packets import (
    as_lossy,
    loss_hypothesis,
    lost_packets,
    supposed_losses,
    without_losses,
)
from op3.diagnose.preflight import CAPPED, Caution, preflight
from op3.diagnose.reach import TorqueBox
from op3.diagnose.refits import Refits, best_of
from op3.diagnose.ripple import with_ripples
from op3.diagnose.screen import Screened, screen
from op3.diagnose.settle import Candidate, settle
from op3.diagnose.setups import setup_hypotheses
from op3.diagnose.shortlist import (
    credit,
    hides_another,
    promising,
    worth_a_round,
)
from op3.diagnose.show import show, shown_logs, with_ceiling
from op3.diagnose.soften import softened
from op3.diagnose.split import LogSplit
from op3.diagnose.thresholds import CEILING, DOUBLY_CHECKED, UNDECIDED
from op3.diagnose.verdict import Finding, Verdict
from op3.diagnose.windows import WindowResiduals
from op3.servo import RobotModel
from op3.servo.effects import PacketDrop
from op3.sim import model_hash

LEADING = 3
"""Effects that are looked for in single joints of a robot on its feet."""

SETTLED, MOVING = 4, 0.01
"""How often a base is gone on with from where its fit has stopped, and the share of the loss from which on it is."""

NEUTRAL = 0.05
"""Size below which an effect is none, as a share of the smallest that matters."""

CELLS = 20
"""Cells of residual torque that are kept."""

Progress = Callable[[str, float], None]


class Diagnosis:
    """Finds what a model lacks from the logs of a split.

    Args:
        model: effects that are on, and the values from which the refit starts.
        split: logs.
        seed: of every resampling.
        engine: gives residuals; by default windows for logs of a robot on the stand, free runs for others.
        progress: called with the stage and the share done.
        warn: called with what logs cannot tell, before anything is fitted.
        without: names of effects not to consider.
        cache: folder in which the refitted base is kept, so that an interrupted diagnosis goes on behind it.
    """

    def __init__(
        self,
        model: RobotModel,
        split: LogSplit,
        *,
        seed: int = 0,
        engine: Engine | None = None,
        progress: Progress | None = None,
        warn: Callable[[str], None] | None = None,
        without: Sequence[str] = (),
        cache: Path | None = None,
    ):
        self.given = model
        self.split = split
        self.seed = seed
        self._report = progress or (lambda stage, share: None)
        self._warn = warn or (lambda text: None)
        self.engine: Engine = engine or engine_for(split)
        self.refits = Refits(self.engine, split, self._report)
        self.fixed_base = split.fit[0].metadata.mount in ("stand", "pendulum")
        self.without = tuple(without)
        self.cache = cache
        self.cautions: tuple[Caution, ...] = ()
        self.base: Fit | None = None
        self.screened: list[Screened] = []
        self.refitted: list[Refitted] = []
        self._candidates: list[list[Candidate]] = []
        self._control = np.zeros(0)  # losses of the last no-op control, ``[block]``
        self._lossless = False  # whether the last screen has looked for lost packets and found none

    def refit_base(self, model: RobotModel, fitted: bool = False) -> Fit:
        """Refit the model's own parameters, with the measurement chain and the spread of its servos.

        Args:
            model: whose effects and values.
            fitted: whether the values come from a refit to these logs. Then few steps are enough, often one, which
                gives joints their spread back.
        """
        full = _full(model)
        coordinates = self._coordinates(full, [candidates[0].finding for candidates in self._candidates])
        forms = [full, *other_forms(full)]
        place = None if self.cache is None else self.cache / f"base-{self._key(full)}-{'one' if fitted else 'all'}.npz"
        if place is not None and place.is_file():
            with np.load(place) as kept:
                chosen = replace(coordinates, model=forms[int(kept["form"])])
                return linearise(self.engine, chosen, kept["point"])
        fit = fit_base(
            self.engine,
            coordinates,
            rounds=ROUNDS,
            start=coordinates.start if fitted else None,
            alternatives=forms[1:],
            worthwhile=WORTHWHILE if fitted else LEAST_GAIN,
            progress=lambda share: self._report("base", share),
        )
        fit = self._settled(fit)
        if place is not None:
            place.parent.mkdir(parents=True, exist_ok=True)
            np.savez(place, point=fit.point, form=[m is fit.coordinates.model for m in forms].index(True))
        return fit

    def _settled(self, fit: Fit) -> Fit:
        """The base where it no longer moves: what is left of its way would be credited to whatever is refitted beside.

        Free runs are simulated as often as their fit may be.
        """
        if not isinstance(self.engine, WindowResiduals):
            return fit
        for _ in range(SETTLED):
            further = self.refits.control_of(fit)
            if further.loss > (1.0 - MOVING) * fit.loss:
                break
            fit = linearise(self.engine, fit.coordinates, further.point)
        return fit

    def _coordinates(self, model: RobotModel, findings: Sequence[Finding]) -> Coordinates:
        """What a base refits of a model with findings; on its feet, where a simulation is dear, only what is shared."""
        named = [(one.parameter, self.engine.joints.index(one.joints[0])) for one in findings if not one.shared]
        coordinates = base_coordinates(model, self.engine.joints, fixed_base=self.fixed_base, named=named)
        if self.fixed_base:
            return coordinates
        return replace(coordinates, entries=tuple(e for e in coordinates.entries if len(e.joints or (0, 0)) > 1))

    def linearised(self) -> Fit:
        """The given model as it is, with the Jacobian of everything that a base would refit."""
        full = _full(self.given)
        coordinates = self._coordinates(full, ())
        return linearise(self.engine, coordinates, coordinates.start)

    def _key(self, model: RobotModel) -> str:
        """Sixteen hex digits of everything that decides where the base ends."""
        digest = hashlib.sha256(f"{model_hash(model)} {len(self.engine.is_fit)} {self.engine.is_fit.sum()}".encode())
        for logs in (self.split.fit, self.split.select):
            for log in logs:
                for channel in log.channels:
                    digest.update(np.ascontiguousarray(log.array(channel)).tobytes())
        return digest.hexdigest()[:16]

    def screen(self, base: Fit, planned: bool = False) -> list[Screened]:
        """Screen the catalogue.

        Args:
            base: what the effects are held against.
            planned: whether the logs were simulated by the model, so that losses of packets are to be supposed.
        """
        fitted = with_point(base.coordinates, base.point)
        candidates = hypotheses(fitted, self.engine.joints, fixed_base=self.fixed_base, without=self.without)
        candidates += setup_hypotheses(fitted, self.split.logs, self.without)
        self._lossless = False
        if any(h.effect is PacketDrop for h in candidates):
            # which packets got lost is read off the logs: nothing fits that drew its own
            candidates = [h for h in candidates if h.effect is not PacketDrop]
            if isinstance(self.engine, WindowResiduals):
                lost = supposed_losses(self.engine, base) if planned else loss_hypothesis(self.engine, base)
                candidates += [] if lost is None else [lost]
                self._lossless = lost is None
        if isinstance(self.engine, WindowResiduals) and not planned:
            candidates = with_ripples(candidates, self.engine, base)
        if self.fixed_base:
            return screen(self.engine, base, candidates, lambda share: self._report("screen", share))
        # on its feet a simulation is dear: single joints are asked of the leading effects alone
        alone = [h for h in candidates if h.joints is not None and len(h.joints) == 1]
        found = screen(self.engine, base, [h for h in candidates if h not in alone])
        leading = list(dict.fromkeys(s.hypothesis.effect for s in sorted(found, key=credit, reverse=True)))[:LEADING]
        found += screen(self.engine, base, [h for h in alone if h.effect in leading])
        return sorted(found, key=lambda s: -s.gain)

    def run(self, rounds: int = 1) -> Verdict:
        """Diagnose; with more rounds, go on from what was found until nothing more is.

        Linear algebra gets one thread: its matrices are small, and a second thread would wait, using a whole core.
        """
        with threadpool_limits(1):
            return self._run(rounds)

    def _run(self, rounds: int) -> Verdict:
        self.cautions = preflight(self.split, self.given)
        for caution in self.cautions:
            self._warn(caution.text)  # before the work, which may then not be worth it
        if any(caution.void for caution in self.cautions):
            return self._void()
        model, verdicts, self._candidates = self.given, [], []
        signs = True
        for number in range(rounds):
            verdict = self._round(model, first=number == 0, surely=signs)
            if verdict is None:
                break
            verdicts.append(verdict)
            if len(self._candidates) == number or number + 1 == rounds:
                break
            signs = self._signs_of_more(self._candidates[-1])
            # of an ambiguous or unknown verdict with the best: the next round may find the other
            model = self._candidates[-1][0].model
        while self._candidates and verdicts[len(self._candidates) - 1].verdict == "unknown":
            self._candidates.pop()  # what it leaves is as unknown as before
        begun = [i for i in range(len(self._candidates)) if verdicts[i].verdict == "unknown"]
        if begun and unresolved([candidates[0].contender for candidates in self._candidates]):
            del self._candidates[begun[0] :]  # nor have later rounds found what was missing there
        kept = len(self._candidates)
        unknown = [verdict for verdict in verdicts[kept:] if verdict.verdict == "unknown"]
        if unknown and contradicted([one[0].contender for one in self._candidates], unknown[0].details["apart"]):
            self._candidates, kept = [], 0
            verdicts = [replace(unknown[0], base=verdicts[0].base, model=verdicts[0].base)]
        beside = f"; beside that, {unknown[0].reason}" if kept and unknown else ""
        verdict = self._shown(self._together(verdicts[:kept]) if kept > 1 else verdicts[0])
        if kept > 1 and verdict.vetoed:
            first = self._shown(verdicts[0])  # it may be better alone
            verdict = verdict if first.vetoed else first
        verdict = self._doubly_checked(replace(verdict, reason=verdict.reason + beside))
        if verdict.verdict == "nothing_missing" and self._too_poor():
            # that is nothing to go by where nothing could have shown
            verdict = replace(verdict, verdict="unknown", weak=True)
        return self._with_ceiling(verdict)

    def _signs_of_more(self, found: Sequence[Candidate]) -> bool:
        """Whether what was found last leaves signs of something beside it; without them a screen has to show one."""
        unsure = len(found) > 1 or found[0].finding.confidence <= UNDECIDED
        if not isinstance(self.engine, WindowResiduals) or unsure:
            return True  # of two that are hard to tell apart the one may show beside the other
        leader = found[0].contender
        if hides_another(leader.effect):
            return True
        (fit,) = (r.fit for r in self.refitted if r.contender is leader)
        if large_gap(leader.left) or leaves_a_joint([one[0].contender for one in self._candidates]):
            return True  # whatever a screen around the first base foresees
        if any(self.refits.beats(other, leader, fit) for other in self.refitted):
            return True
        earlier = [one[0].contender for one in self._candidates[:-1]]
        if any(of_another_kind(other.contender, leader, self._control, earlier) for other in self.refitted):
            return True
        fitted = self.engine.is_fit
        if worth_a_round(self.screened, fit.residual[fitted], self.engine.blocks[fitted]):
            return True
        return self._lossless and self.loses_after_all(fit)

    def loses_after_all(self, leader: Fit) -> bool:
        """Whether packets seem lost beside a leader: the base may have been too wrong to tell."""
        assert isinstance(self.engine, WindowResiduals)
        assert self.base is not None
        self.engine.prepare(with_point(leader.coordinates, leader.point))  # which knows what is usual far better
        found = lost_packets(self.engine, leader)
        self.engine.prepare(with_point(self.base.coordinates, self.base.point))
        return found is not None

    def _void(self) -> Verdict:
        """Logs that contradict themselves: nothing is fitted to them, and nothing named."""
        shown = show(self.given, self.given, self.split, lambda share: self._report("show", share))
        return Verdict(
            verdict="unknown",
            effects=(),
            reason="the logs contradict themselves or the robot, so nothing was fitted to them",
            model=self.given,
            base=self.given,
            cannot_tell=tuple(caution.text for caution in self.cautions),
            gap=shown["gap"],
            loss=shown["loss"],
            details={"shown": shown, "joints": list(self.engine.joints)},
        )

    def _weak(self, findings: Sequence[Finding]) -> bool:
        """Whether the logs cannot carry these names."""
        return any(_speaks(caution, findings) for caution in self.cautions)

    def _too_poor(self) -> bool:
        """Whether the logs could not carry the name of an effect of all joints."""
        return any(caution.weakens(()) for caution in self.cautions)

    def _said(self, findings: Sequence[Finding]) -> tuple[Caution, ...]:
        """Cautions of all effects, and those of the effects that were found."""
        said = (caution for caution in self.cautions if not caution.assumed)
        return tuple(caution for caution in said if not caution.effects or _speaks(caution, findings))

    def _together(self, verdicts: Sequence[Verdict]) -> Verdict:
        """All that rounds have found: earlier names weighed again beside later ones."""
        rng = np.random.default_rng([self.seed, 17])
        settled = settle(
            self.engine, self.given, self._candidates, rng, lambda model, found: self._coordinates(_full(model), found)
        )
        said = [f"{effect.name} explains {effect.gain:.0%}" for effect in settled.effects if not effect.instead_of]
        reason = f"{', then '.join(said)} of the residual that was left"
        if settled.superfluous:
            reason += f"; beside what was named later, {', '.join(settled.superfluous)} is not needed"
        instead = {effect.instead_of for effect in settled.effects if effect.instead_of}
        return replace(
            verdicts[-1],
            verdict="ambiguous" if instead else "named",
            effects=settled.effects,
            reason=reason,
            base=verdicts[0].base,
            model=settled.model,
            separate_by=separating(one.name for one in settled.effects if one.instead_of or one.name in instead),
            details=verdicts[0].details,
        )

    def _shown(self, verdict: Verdict) -> Verdict:
        """The verdict with the gap before and after on the runs that show, which may veto it.

        Before they do, models on the way to it are tried, in the order in which free runs of the fitted logs like them,
        until one is not vetoed.
        """
        base, model, share = without_losses(verdict.base), without_losses(verdict.model), 1.0
        alone = [e for e in verdict.effects if len(e.joints) == 1 and not e.shared and not e.instead_of]
        faulty = [effect.joints[0] for effect in alone]
        shown = show(base, model, self.split, lambda share: self._report("show", share), faulty=faulty)
        # of packets that were counted tick by tick a free run tells nothing
        free = any(effect.name != PacketDrop.name and not effect.instead_of for effect in verdict.effects)
        vetoed = bool(shown["vetoed"]) and free and verdict.model is not verdict.base
        for between in softened(base, model, self.split.fit) if vetoed else ():
            again = show(base, between[0], self.split, known=shown["before"], faulty=faulty)
            if not again["vetoed"]:
                shown, vetoed, (model, share) = again, False, between
                break
        return replace(
            verdict,
            model=as_lossy(verdict.base if vetoed else model, verdict.model),
            share=share,
            gap=shown["gap"],
            loss=shown["loss"],
            vetoed=vetoed,
            details={**verdict.details, "shown": shown},
        )

    def _doubly_checked(self, verdict: Verdict) -> Verdict:
        """The verdict, or that nothing is missing where windows show little of it and free runs speak against it."""
        leaders = [candidates[0].contender for candidates in self._candidates]
        gains = [shown_by_windows(one) for one in leaders]
        clear = max(gains, default=1.0) >= DOUBLY_CHECKED or any(candidates[0].sure for candidates in self._candidates)
        clear |= any(large_gap(one.left) for one in leaders)
        if not verdict.vetoed or not verdict.effects or clear:
            return verdict
        names = " and ".join(dict.fromkeys(effect.name for effect in verdict.effects))
        reason = f"the best of the catalogue, {names}, explains {max(gains):.1%}, and free runs are no better with it"
        sound = replace(verdict, verdict="nothing_missing", effects=(), reason=reason, separate_by="", vetoed=False)
        return self._shown(replace(sound, model=verdict.base))

    def _with_ceiling(self, verdict: Verdict) -> Verdict:
        """The verdict with the gap that a black box leaves; only windows tell the torques that it learns."""
        if not isinstance(self.engine, WindowResiduals):
            return verdict
        base = without_losses(verdict.base)
        box = TorqueBox(self.engine, base, self.seed)
        push = box.torques(shown_logs(self.split)) if box else []
        return replace(verdict, gap=with_ceiling(verdict.gap, self.split, base, push, self.seed))

    def _round(self, model: RobotModel, first: bool, surely: bool) -> Verdict | None:
        """One round; none unless its screen is promising or it is to be carried through surely."""
        rng = np.random.default_rng([self.seed, 11])
        self.base = base = self.refit_base(model, fitted=not first)
        if first and isinstance(self.engine, WindowResiduals) and PacketDrop.name in model.effect_names:
            found = lost_packets(self.engine, base)
            if found is not None:
                self.engine.packets = found.packets
                self.base = base = self.refit_base(with_point(base.coordinates, base.point), fitted=True)
        self.screened = self.screen(base)
        if not surely and not promising(self.screened):
            return None
        controls, self.refitted = self.refits.shortlisted(base, self.screened)
        elsewhere = self._better_base(base, controls)
        if elsewhere is not None:
            self.base = base = self.refit_base(elsewhere, fitted=True)
            self.screened = self.screen(base)
            controls, self.refitted = self.refits.shortlisted(base, self.screened)
        control = best_of(controls)
        fitted = with_point(base.coordinates, base.point)
        windows = self.engine if isinstance(self.engine, WindowResiduals) else None
        located = locate(windows, base, self.seed) if windows else []
        box = ceiling(windows, base, control.residual, self.seed) if windows and first else None
        self._control = self.refits.losses(control)
        left = self.refits.left(control)
        decision = decide(
            [r.contender for r in self.refitted],
            self._control,
            rng,
            ceiling=None if box is None else local_ceiling(box.gain, box.by_joint),
            left=left,
            found=[candidates[0].contender for candidates in self._candidates],
        )
        decision = self._or_candidate(decision)
        members = [self.refitted[i] for i in decision.candidates]
        candidates = self._found(members, base, decision.shares[list(decision.candidates)])
        findings = tuple(one.finding for one in candidates) if decision.verdict != "unknown" else ()
        weak = self._weak([one.finding for one in candidates])
        if candidates and not weak:
            self._candidates.append(candidates)
        return Verdict(
            verdict="ambiguous" if weak and findings else decision.verdict,
            effects=findings,
            reason=self._reason(decision, control, box),
            model=candidates[0].model if findings and not weak else fitted,
            base=fitted,
            cannot_tell=tuple(caution.text for caution in self._said(findings)),
            assumed=tuple(caution.text for caution in self.cautions if caution.assumed),
            weak=weak and bool(findings),
            separate_by=separating(one.name for one in findings) if decision.verdict == "ambiguous" or weak else "",
            details={
                **self._details(decision),
                "apart": stands_out(left),
                "located": [cell.plain() for cell in located[:CELLS]],
                "ceiling": {}
                if box is None
                else {"gain": round(box.gain, 4), "inputs": where(box, self.engine.joints)},
            },
        )

    def _or_candidate(self, decision: Decision) -> Decision:
        """The decision, or what explains much in logs that cannot carry a name: too few pieces of them to count."""
        weak = self._too_poor()
        if decision.verdict != "nothing_missing" or decision.candidates or not weak or not self.refitted:
            return decision
        best = min(range(len(self.refitted)), key=lambda i: float(self.refitted[i].contender.losses.sum()))
        one = self.refitted[best].contender
        if not worth_a_candidate(one):
            return decision
        return replace(decision, verdict="ambiguous", candidates=(best,), reason=f"{decision.reason} of these few logs")

    def _better_base(self, base: Fit, controls: Sequence[Fit]) -> RobotModel | None:
        """The base where a refit has found it a better place without its effect; None where none has.

        The loss has many valleys. What explains more with an effect of next to no size explains it with the base.
        """
        neutral = [r.fit for r in self.refitted if abs(r.contender.size) < NEUTRAL * r.contender.smallest]
        best = best_of([*controls, *neutral])
        if best.loss > (1.0 - WORTHWHILE) * controls[0].loss:
            return None
        return with_point(base.coordinates, best.point[: len(base.coordinates)])

    def _found(self, members: Sequence[Refitted], base: Fit, shares: np.ndarray) -> list[Candidate]:
        """What a decision is about, best first, with stated confidences."""
        found: list[Candidate] = []
        most = UNDECIDED if len(members) > 1 else 1.0
        for refitted, share in zip(members, shares, strict=True):
            finding = self.finding_of(refitted, base, min(float(share), most))
            if found:
                finding = replace(finding, instead_of=found[0].finding.name)
            model = with_finding(refitted, finding, self.engine.joints)
            one = refitted.contender
            found.append(Candidate(finding, one, model, beyond_doubt(one, self._control)))
        if self._weak([one.finding for one in found]):
            capped = [replace(one.finding, confidence=min(one.finding.confidence, CAPPED)) for one in found]
            found = [replace(one, finding=finding) for one, finding in zip(found, capped, strict=True)]
        return found

    def _reason(self, decision: Decision, control: Fit, box: Ceiling | None) -> str:
        """The reason; of an unknown verdict also where the gap is and on what it depends."""
        if decision.verdict != "unknown":
            return decision.reason
        left = self.refits.left(control)
        place = f"; the gap is largest in {self.engine.joints[int(left.argmax())]}" if left.size else ""
        if box is not None and (local_ceiling(box.gain, box.by_joint) or 0.0) > CEILING:
            place += f"; a black box finds it {where(box, self.engine.joints)}"
        return decision.reason + place

    def refit_of(self, base: Fit, picked: Sequence[Screened]) -> list[Refitted]:
        """Refit some hypotheses beside a base."""
        return self.refits.each(base, self.refits.control_of(base), picked, self.screened)[1]

    def finding_of(self, refitted: Refitted, base: Fit, confidence: float) -> Finding:
        """What a refit has found, with its interval."""
        return finding_of(self.engine, self.given, refitted, base, confidence)

    def _details(self, decision: Decision) -> dict[str, Any]:
        joints = self.engine.joints
        best: dict[str, Screened] = {}
        for s in self.screened:
            best.setdefault(s.hypothesis.label(joints), s)
        refitted: dict[str, tuple[int, Refitted]] = {}
        for i, r in sorted(enumerate(self.refitted), key=lambda pair: -float(pair[1].contender.losses.sum())):
            refitted[r.contender.label] = (i, r)  # of two forms of an effect the better one stays
        ranking = [
            {
                "name": r.hypothesis.effect.name,
                "joints": [joints[j] for j in (r.hypothesis.joints or range(len(joints)))],
                "gain": round(r.contender.gain, 5),
                "fit_gain": round(r.contender.fit_gain, 5),
                "size": r.contender.size,
                "share": round(float(decision.shares[i]), 4),
                "score": round(r.screened.statistic, 3),
            }
            for i, r in sorted(refitted.values(), key=lambda pair: float(pair[1].contender.losses.sum()))
        ]
        ranking += [
            {
                "name": s.hypothesis.effect.name,
                "joints": [joints[j] for j in (s.hypothesis.joints or range(len(joints)))],
                "gain": round(s.gain, 5),
                "score": round(s.statistic, 3),
            }
            for label, s in best.items()
            if label not in refitted
        ]
        return {"ranking": ranking, "joints": list(joints)}


def _full(model: RobotModel) -> RobotModel:
    """A model with the chain of measurement that every robot has."""
    return with_chain(model) if "current_pd" in model.effect_names else model


def _speaks(caution: Caution, findings: Sequence[Finding]) -> bool:
    """Whether a caution speaks against one of these names."""
    return any(caution.weakens(() if f.shared else f.joints, f.name) for f in findings)
