"""Refits of hypotheses beside a base, against a control that gets the same effort and no effect."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from op3.diagnose.coordinates import Coordinate
from op3.diagnose.counting import better_beside, shows_at_home
from op3.diagnose.evidence import Contender, Own
from op3.diagnose.findings import Refitted, apart, size_at, smallest
from op3.diagnose.fitting import SHARES, Engine, Fit, likeliest, polish, refit
from op3.diagnose.hypotheses import Hypothesis
from op3.diagnose.locate import remaining
from op3.diagnose.packets import LossHypothesis
from op3.diagnose.ridges import delayed, exchanged, redrawn
from op3.diagnose.screen import Screened
from op3.diagnose.shortlist import EXCHANGED, confusable, shortlist, stands_alone
from op3.diagnose.split import LogSplit
from op3.diagnose.windows import WindowResiduals
from op3.servo.conditions import split_name
from op3.servo.effect import parameter
from op3.servo.effects import Latency, QuadraticDrag

POLISHED = 4
"""Leaders that are refitted once more with Jacobians of their own, as the control is."""

PROMISING = 0.02
"""Share of the loss that the best has to take off by then."""

AT_HOME = 2
"""Faults of single joints that are refitted once more besides, where they explain much of their joint alone."""

EXCHANGES = (0.004, 0.006)
"""Parts that are tried [s]; the loss there may be larger, as everything else has yet to give way."""

WHOLES = (1.0, 0.75, 2.5, 5.0)
"""Secants that a refit may begin with, whatever share of one the screen takes for the best."""

BOUND = 1e-3
"""A size this close to its bound, as a share of its range, is implausible."""


class Refits:
    """Refits beside a base.

    Args:
        engine: gives the residuals.
        split: logs, whose speeds are asked for where the engine has none.
        report: called with the stage and the share done.
    """

    def __init__(self, engine: Engine, split: LogSplit, report: Callable[[str, float], None]):
        self.engine, self.split, self._report = engine, split, report
        self._controlled: tuple[Fit, Fit] | None = None  # a base, and its no-op control

    def control_of(self, base: Fit) -> Fit:
        """The no-op control: a base refitted as a hypothesis is. Of free runs only where a leader is polished too."""
        if self._controlled is None or self._controlled[0] is not base:
            control = refit(self.engine, base, base.coordinates, base.point)
            windows = isinstance(self.engine, WindowResiduals)
            self._controlled = base, polish(self.engine, base, control) if windows else control
        return self._controlled[1]

    def shortlisted(self, base: Fit, screened: Sequence[Screened]) -> tuple[list[Fit], list[Refitted]]:
        """Refit the no-op control and the shortlist of a screen, see `each`."""
        windows = self.engine if isinstance(self.engine, WindowResiduals) else None
        home = stands_alone(windows.squares_by_joint(base.residual)) if windows else None
        picked = shortlist(screened, base.coordinates.suspects(base.point), home)
        return self.each(base, self.control_of(base), picked, screened)

    def each(
        self, base: Fit, control: Fit, picked: Sequence[Screened], screened: Sequence[Screened]
    ) -> tuple[list[Fit], list[Refitted]]:
        """Refit each hypothesis from the control, the most promising to the end, and the control likewise.

        The loss has many valleys, and an effect that is not there may lead the base into a better one. So the control
        also starts from where the base has gone beside the best hypothesis; what it explains then is not the effect's.
        Of 80 legs in which nothing was missing three got a name without that, none of the three with it.

        Args:
            base: with its Jacobian.
            control: see `control_of`.
            picked: what is refitted.
            screened: the whole screen, in which the confounders of the best are.

        Returns:
            Controls from where the base was, and beside the best if there is one; and the refits, against the better.
        """
        fits: list[Fit] = []
        for number, one in enumerate(picked):
            fits.append(self._refitted(base, control, one))
            self._report("refit", (number + 1) / (len(picked) + POLISHED))
        best = min(range(len(fits)), key=lambda i: fits[i].loss, default=None)
        if best is not None and fits[best].loss < (1.0 - PROMISING) * control.loss:
            picked = [*picked, *confusable(picked[best], screened, picked)]
            fits += [self._refitted(base, control, one) for one in picked[len(fits) :]]
        places = [(s.hypothesis.effect.name, s.hypothesis.joints) for s in picked]
        controls, leaders = [control], _leaders([fit.loss for fit in fits], control.loss, places)
        own = [self._own(s.hypothesis, fit, control) for s, fit in zip(picked, fits, strict=True)]
        at_home = [i for i, one in enumerate(own) if one is not None and i not in leaders and shows_at_home(one)]
        leaders += sorted(at_home, key=lambda i: fits[i].loss)[:AT_HOME]
        for number in leaders:
            fits[number] = polish(self.engine, base, fits[number])
        if leaders:
            beside = best_of([fits[number] for number in leaders]).point[: len(base.coordinates)]
            controls.append(polish(self.engine, base, refit(self.engine, base, base.coordinates, beside)))
            if not isinstance(self.engine, WindowResiduals):
                controls[0] = polish(self.engine, base, control)
        control = best_of(controls)
        if control is not controls[0]:  # a better place, from which the leaders go on too
            for number in leaders:
                start = np.concatenate([control.point, fits[number].point[len(base.coordinates) :]])
                again = refit(self.engine, base, fits[number].coordinates, start)
                fits[number] = best_of([fits[number], polish(self.engine, base, again)])
        fits = [
            s.hypothesis.counted(fit) if isinstance(s.hypothesis, LossHypothesis) else fit
            for s, fit in zip(picked, fits, strict=True)
        ]
        result = [
            Refitted(s.hypothesis, s, fit, self._contender(s.hypothesis, fit, control, base, s.direction))
            for s, fit in zip(picked, fits, strict=True)
        ]
        return controls, result

    def _refitted(self, base: Fit, control: Fit, screened: Screened) -> Fit:
        """Refit a hypothesis from the control, in the direction that the screen has found."""
        hypothesis = screened.hypothesis
        secant = hypothesis.secants[screened.secant]
        share = screened.share if abs(screened.share) > 0.3 else 0.5 * (np.sign(screened.share) or 1.0)
        coordinates, more = hypothesis.coordinates(base.coordinates, secant, share)
        start = np.concatenate([control.point, more])
        # an effect that is not local explains nothing on the way to its secant; its bounds may have cut that short
        new = coordinates.entries[len(base.coordinates) :]
        moved = [(s - e.prior) / secant[e.parameter] for s, e in zip(more, new, strict=True) if _moves(e, secant)]
        reached = next((abs(part) for part in moved if part), abs(share))
        shares = (*SHARES, *(whole / reached for whole in WHOLES))
        fit = refit(self.engine, base, coordinates, start, anchor=control, shares=shares)
        return self._across_the_ridge(hypothesis, base, control, fit)

    def _across_the_ridge(self, hypothesis: Hypothesis, base: Fit, control: Fit, fit: Fit) -> Fit:
        """The fit, or a better one from where a part of what the base has become is the effect's, see `ridges`."""
        effect, starts = hypothesis.effect.name, []
        if effect in EXCHANGED:
            starts = exchanged(fit.coordinates, control.point, EXCHANGED[effect], EXCHANGES)
        elif effect == QuadraticDrag.name and hypothesis.joints is None:
            starts = redrawn(fit.coordinates, control.point, self._speeds())
        elif effect == Latency.name and hypothesis.joints is None:
            starts = delayed(fit.coordinates, control.point)
        if not starts:
            return fit
        start = likeliest(self.engine, fit.coordinates, starts)
        across = refit(self.engine, base, fit.coordinates, start)
        if effect == Latency.name:  # so far from the base that its Jacobian does not lead down there
            across = polish(self.engine, base, across)
        return best_of([fit, across])

    def beats(self, other: Refitted, leader: Contender, fit: Fit) -> bool:
        """Whether another refit explains more than the leader's: of its own joint, or of those it leaves alone."""
        own, home = other.hypothesis.joints, leader.joints or ()
        joints = [j for j in range(len(self.engine.joints)) if j not in home] if own is None and home else own
        if not joints or own == leader.joints or (own is not None and len(own) > 1):
            return False
        return better_beside(self.explained_in(joints, other.fit, fit), alone=own is not None)

    def _contender(self, hypothesis: Hypothesis, fit: Fit, control: Fit, base: Fit, direction: np.ndarray) -> Contender:
        held = ~self.engine.is_fit

        def gain(where: np.ndarray) -> float:
            before = np.square(control.residual[where].astype(np.float64)).sum()
            return float(1 - np.square(fit.residual[where].astype(np.float64)).sum() / before)

        place = size_at(hypothesis, fit, base)
        entry = fit.coordinates.entries[place]
        reach = BOUND * (entry.high - entry.low)
        at = fit.point[place]
        return Contender(
            label=hypothesis.label(self.engine.joints),
            effect=hypothesis.effect.name,
            joints=hypothesis.joints,
            alias_class=hypothesis.effect.alias_class,
            gain=gain(held),
            fit_gain=gain(self.engine.is_fit),
            losses=self.losses(fit),
            size=apart(hypothesis, fit, float(at)),
            smallest=smallest(hypothesis, entry.parameter),
            implausible=bool(entry.high - at < reach or at - entry.low < reach),
            left=self.left(fit),
            direction=direction,
            numbers=len(fit.coordinates) - len(base.coordinates),
            own=self._own(hypothesis, fit, control),
            confounders=hypothesis.effect.confounders,
        )

    def _own(self, hypothesis: Hypothesis, fit: Fit, control: Fit) -> Own | None:
        """What a fault of one joint explains there; None for free runs, whose blocks are few."""
        if hypothesis.joints is None or len(hypothesis.joints) != 1 or not isinstance(self.engine, WindowResiduals):
            return None
        return self.explained_in(hypothesis.joints, fit, control)

    def explained_in(self, joints: Sequence[int], fit: Fit, control: Fit) -> Own:
        """What a fit explains in some joints."""
        assert isinstance(self.engine, WindowResiduals)
        before, after = (self.engine.squares_by_joint(one.residual)[:, joints].sum(1) for one in (control, fit))
        fitted = self.engine.is_fit
        gains = [1.0 - after[at].sum() / max(before[at].sum(), 1e-12) for at in (~fitted, fitted)]
        return Own(float(gains[0]), float(gains[1]), self._by_block(before), self._by_block(before - after))

    def losses(self, fit: Fit) -> np.ndarray:
        """Squares summed by block of a second, ``[block]``."""
        return self._by_block(np.square(fit.residual.astype(np.float64)).sum(1))

    def left(self, fit: Fit) -> np.ndarray:
        """Residual velocity by joint, in standard deviations of a reading; empty for free runs."""
        return remaining(self.engine, fit.residual) if isinstance(self.engine, WindowResiduals) else np.zeros(0)

    def _by_block(self, values: np.ndarray) -> np.ndarray:
        """Sums of what windows have by block, ``[block]``."""
        return np.bincount(np.unique(self.engine.blocks, return_inverse=True)[1], values)

    def _speeds(self) -> np.ndarray:
        """Velocities that the joints had [rad/s], any shape: those of the windows, or of the fitted runs."""
        if isinstance(self.engine, WindowResiduals):
            return self.engine.motion.velocity
        rates = [log.array("joint/velocity") for log in self.split.fit if "joint/velocity" in log]
        rates += [
            np.gradient(log.array("joint/position"), log.array("time")[:, 0], axis=0)
            for log in self.split.fit
            if "joint/velocity" not in log
        ]
        return np.concatenate([rate.ravel() for rate in rates])


def best_of(fits: Sequence[Fit]) -> Fit:
    """The fit with the smallest loss."""
    return min(fits, key=lambda fit: fit.loss)


def _leaders(losses: Sequence[float], control: float, places: Sequence[Any]) -> list[int]:
    """Whose refits are worth to be gone on with: none where none takes off enough, nor those far behind the best.

    Args:
        losses: of the refits.
        control: loss without any.
        places: effect and joints of each; of several refits in one place the best goes on.
    """
    order = sorted(range(len(losses)), key=lambda i: losses[i])
    order = [i for n, i in enumerate(order) if places[i] not in [places[j] for j in order[:n]]][:POLISHED]
    gains = [1.0 - losses[i] / control for i in order]
    return [i for i, gain in zip(order, gains, strict=True) if gain > max(PROMISING, 0.5 * gains[0])]


def _moves(entry: Coordinate, secant: Mapping[str, float]) -> bool:
    """Whether a secant says how much of a coordinate there is, and not where or how fast, or nothing."""
    return bool(secant.get(entry.parameter)) and parameter(split_name(entry.parameter)[0]).neutral is not None
