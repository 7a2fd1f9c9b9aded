"""Returns of a policy in simulation and on the robot, and the paper's criteria of success."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import stdtrit

from op3.common.sample_intervals import wilson_interval

WALKERS = 0.8
"""Share of episodes that must walk to their end (paper: 8 of 10)."""

PAPERS_EPISODES = 10
"""Number of episodes by which the paper judges a transfer."""


@dataclass(frozen=True)
class Transfer:
    """Results of one policy in the simulation of its training and on the robot.

    Attributes:
        model: model that the policy was trained on.
        expected, actual: returns under R_eval in simulation and on the robot.
        upright: which of the robot's episodes had no fall, including the motion to the end pose.
        episodes: folder of the robot's logs.
        film, robot_film: videos of an episode in simulation and on the robot; not shown if None or missing.
        criterion: share of the expected mean return that the robot must reach.
        began_with: initial policy of the training, or a note that the policy was given.
        afterwards: number of episodes that ended well but fell or were stopped during the motion to the end pose.
        walked: which of the robot's episodes moved forwards without a fall, the paper's criterion for walking; None for
            other tasks.
    """

    policy: Path
    model: str
    expected: Sequence[float]
    actual: Sequence[float]
    upright: Sequence[bool]
    episodes: Path
    film: Path | None = None
    robot_film: Path | None = None
    criterion: float = 0.8
    walked: Sequence[bool] | None = None
    began_with: str = "nothing"
    afterwards: int = 0

    @property
    def falls(self) -> int:
        """Episodes that did not end upright."""
        return len(self.upright) - sum(self.upright)

    @property
    def achieved(self) -> str:
        """The quantity of the criterion, with its 95 % interval, and the number of falls."""
        span = f" ({self.span})" if self.span else ""
        if self.walked is not None:
            said = f"{sum(self.walked)} of {len(self.walked)} episodes walk until the end{span}"
        else:
            said = f"the robot reaches {100 * self.share:.0f} %{span} of the expected return"
        way = f", {self.afterwards} of them while moving to the end pose" if self.afterwards else ""
        return said + (f", and falls in {self.falls} of {len(self.upright)} episodes{way}" if self.falls else "")

    @property
    def share(self) -> float:
        """Mean return on the robot as a share of that in simulation."""
        return float(np.mean(self.actual) / np.mean(self.expected))

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the criterion's quantity: Wilson's interval for the share of walking episodes; Student's
        interval with the delta method for the share of the return; none for a single episode."""
        if self.walked is not None:
            return wilson_interval(sum(self.walked), len(self.walked))
        fewest = min(len(self.expected), len(self.actual))
        if fewest < 2:
            return -np.inf, np.inf
        parts = [np.var(one, ddof=1) / len(one) / np.mean(one) ** 2 for one in (self.expected, self.actual)]
        half = float(stdtrit(fewest - 1, 0.975) * abs(self.share) * np.sqrt(sum(parts)))
        return self.share - half, self.share + half

    @property
    def span(self) -> str:
        """The interval as text; empty if there is none."""
        low, high = self.interval
        return f"95 %: {100 * low:.0f} to {100 * high:.0f} %" if np.isfinite([low, high]).all() else ""

    @property
    def success(self) -> bool:
        """Whether the transfer meets the paper's criterion."""
        if self.walked is not None:
            return float(np.mean(self.walked)) >= WALKERS
        return self.share >= self.criterion

    @property
    def settled(self) -> bool:
        """Whether the interval is on one side of the criterion, so more episodes would hardly change the result."""
        low, high = self.interval
        limit = self.criterion if self.walked is None else WALKERS
        return low >= limit or high < limit

    @property
    def numbers(self) -> dict[str, Any]:
        """For ``result.yaml``."""
        walked = {} if self.walked is None else {"walked": float(np.mean(self.walked))}
        return {
            "expected": float(np.mean(self.expected)),
            "actual": float(np.mean(self.actual)),
            "share": self.share,
            "interval": [float(end) if np.isfinite(end) else None for end in self.interval],
            "fell_afterwards": self.afterwards,
            "episodes": len(self.actual),
            "upright": float(np.mean(self.upright)),
            "success": self.success,
            "training_began_with": self.began_with,
            **walked,
        }


@dataclass
class Learned:
    """Results of the rounds.

    Attributes:
        numbers: results of each round's re-identification, as in its ``result.yaml``.
        named: sentence of each round's diagnosis.
        remarks: further sentences for the reader.
        spared: whether the condition allows learning but the first transfer left nothing to learn.
    """

    numbers: dict[int, dict] = field(default_factory=dict)
    named: dict[int, str] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)
    spared: bool = False
