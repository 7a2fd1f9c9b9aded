"""The story of a transfer from simulation to a robot, on one page."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from op3.report.page import Page
from op3.report.style import bars_figure, boxes_figure
from op3.report.tables import number

WALKERS = 0.8
"""Share of episodes that must walk for their whole time; paper, 8 of 10."""

PAPERS_EPISODES = 10
"""Episodes by which the paper judges a transfer."""


@dataclass(frozen=True)
class Transfer:
    """One policy, in the simulation that it was trained on and on the robot.

    Attributes:
        policy: the bundle.
        model: that it was trained on.
        expected: returns under R_eval in simulation.
        actual: returns on the robot.
        upright: which of the robot's episodes ended without a fall.
        episodes: folder of the robot's logs.
        film: animated picture of an episode in simulation; None or no such file: not shown.
        robot_film: the same of an episode on the robot.
        criterion: share of the expected mean return that the robot must reach.
        began_with: what its training began with, or that it was given.
        walked: which of the robot's episodes went forwards without a fall, by which the paper judges walking; None for
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

    @property
    def achieved(self) -> str:
        """What the criterion looks at, in words."""
        if self.walked is not None:
            return f"{sum(self.walked)} of {len(self.walked)} episodes walk to their end"
        return f"the robot reaches {100 * self.share:.0f} % of the return that simulation promised"

    @property
    def share(self) -> float:
        """Mean return on the robot as a share of that in simulation."""
        return float(np.mean(self.actual) / np.mean(self.expected))

    @property
    def success(self) -> bool:
        """Whether the transfer meets the paper's criterion."""
        if self.walked is not None:
            return float(np.mean(self.walked)) >= WALKERS
        return self.share >= self.criterion


def story(
    folder: Path,
    transfers: Sequence[Transfer],
    seconds: Mapping[str, float],
    *,
    condition: str,
    budget: str,
    provenance: Mapping[str, Any],
    what: str = "",
    spared: bool = False,
    learned: Mapping[int, Mapping[str, Any]] | None = None,
    named: Mapping[int, str] | None = None,
    remarks: Sequence[str] = (),
    processor_seconds: Mapping[str, float] | None = None,
) -> Page:
    """The page.

    Args:
        folder: of the run; links are relative to it.
        transfers: first attempt first.
        seconds: duration of every stage [s].
        condition: what was allowed.
        budget: of training and search.
        provenance: where the numbers come from, see `op3.report.run_provenance`.
        what: task and robot, in a sentence or two.
        spared: whether what the condition allows was not needed.
        learned: numbers of the re-identification by round, as its ``result.yaml`` has them.
        named: first sentence of the diagnosis by round.
        remarks: what else the reader should know, a sentence each.
        processor_seconds: time of all processors spent on every stage [s].
    """
    first, last = transfers[0], transfers[-1]
    page = Page("From simulation to the robot", f"{_lead(transfers, condition, spared)} {what}".strip())
    page.tile("first transfer", 100 * first.share, "%", "of the promised return")
    if len(transfers) > 1:
        page.tile("last transfer", 100 * last.share, "%", "of the promised return")
    page.tile("episodes upright", f"{sum(last.upright)} of {len(last.upright)}")
    if last.walked is not None:
        page.tile("episodes that walked to their end", f"{sum(last.walked)} of {len(last.walked)}")
    page.tile("time", sum(seconds.values()), "s", f"budget {budget}")
    _films(page, folder, transfers)
    _transfers(page, transfers, remarks)
    sentences, numbers = dict(named or {}), dict(learned or {})
    for i in range(1, len(transfers)):
        if i in sentences or i in numbers:
            page.section(f"Learned in round {i}")
        if i in sentences:
            page.text(f"Diagnosis of further motions in the stand: {sentences[i]}")
        if i in numbers:
            _lesson(page, numbers[i])
    page.section("Stages")
    stages = [[name, value, (processor_seconds or {}).get(name)] for name, value in seconds.items()]
    page.table(["stage", "time [s]", "processor time [s]"], stages, "What was run.")
    pages = {f"{name}/index.html": f"page of the stage {name.replace('_', ' ')}" for name in seconds}
    page.files({name: text for name, text in pages.items() if (folder / name).exists()})
    page.provenance(provenance)
    return page


def _transfers(page: Page, transfers: Sequence[Transfer], remarks: Sequence[str]) -> None:
    """How policies are judged, and what each was worth."""
    first = transfers[0]
    page.section("Transfers")
    judged = (
        f"the share of the promised mean return that the robot reaches; {100 * first.criterion:.0f} % count as success."
    )
    if first.walked is not None:
        judged = f"how many episodes walk forwards without a fall; {WALKERS * 10:.0f} of 10 count as success."
    page.text(
        f"Every policy is trained in simulation, plays its episodes there and on the robot, and is judged by {judged}"
    )
    few = len(first.actual)
    if few < PAPERS_EPISODES:
        page.text(f"Here it is judged by {few} episodes, where the paper judges ten; so few leave much to chance.")
    for remark in remarks:
        page.text(remark)
    columns = {
        "round": [*range(len(transfers))],
        "training began with": [one.began_with for one in transfers],
        "return promised [-]": [float(np.mean(one.expected)) for one in transfers],
        "return on the robot [-]": [float(np.mean(one.actual)) for one in transfers],
        "share [%]": [100 * one.share for one in transfers],
        "upright": [f"{sum(one.upright)} of {len(one.upright)}" for one in transfers],
        "success": [one.success for one in transfers],
    }
    page.table(list(columns), list(zip(*columns.values(), strict=True)), "Transfers.")
    boxes = {
        label: {f"round {i}": getattr(one, name) for i, one in enumerate(transfers)}
        for label, name in (("in simulation", "expected"), ("on the robot", "actual"))
    }
    figure = boxes_figure(boxes, "return under R_eval [-]")
    page.figure(figure, "Return of every episode, promised and on the robot.")


def _films(page: Page, folder: Path, transfers: Sequence[Transfer]) -> None:
    """The first transfer and the last, in simulation and on the robot."""
    films = []
    for i in sorted({0, len(transfers) - 1}):
        one = transfers[i]
        falls = len(one.upright) - sum(one.upright)
        worst = f"the worst episode, return {np.min(one.actual):.0f}; {falls} of {len(one.upright)} fall"
        for film, text in (
            (one.film, f"Round {i}, in simulation: mean return {np.mean(one.expected):.0f}."),
            (one.robot_film, f"Round {i}, on the robot: {worst}; {100 * one.share:.0f} % of the return promised."),
        ):
            if film is not None and film.exists():
                films.append((str(film.relative_to(folder)), text))
    if films:
        page.section("Films")
        page.films(films)
        page.text("Films of the robot are drawn from its encoders and IMU; the board is laid under its soles.")


def _lesson(page: Page, learned: Mapping[str, Any]) -> None:
    """What a round's re-identification found."""
    before, after = "before", "re-identified"
    page.text(
        "The same policy, in the simulation of the model that the search began with and in the re-identified one:"
        " distance of its returns to those on the robot, over the episodes searched with and over fresh ones, and the"
        f" loss of the excitation. Chance alone would leave a distance of {number(learned['fresh.noise'], 3)}."
    )
    if not learned.get("accepted", True):
        page.text("No candidate took the place of that model, so the policy was trained further on it.")
    keys = (("distance", "distance of returns [-]"), ("fresh", "the same, fresh episodes [-]"), ("excitation", "loss"))
    rows = [[text, learned[f"{key}.excitation_only"], learned[f"{key}.reidentified"]] for key, text in keys]
    page.table(["", before, after], rows, "Both objectives.")
    prefix = "normalised.reidentified."
    names = [key.removeprefix(prefix) for key in learned if key.startswith(prefix)]
    bars = {
        label: {name: learned[f"normalised.{key}.{name}"] for name in names}
        for label, key in ((after, "reidentified"), (before, "excitation_only"))
    }
    page.figure(bars_figure(bars, "share of the range [-]"), "Parameters normalised by Table I.")


def _lead(transfers: Sequence[Transfer], condition: str, spared: bool) -> str:
    first, last = transfers[0], transfers[-1]
    if len(transfers) == 1:
        outcome = "succeeds" if last.success else "fails"
        needed = ", which was not needed" if spared else ""
        return f"The first transfer {outcome}: {last.achieved}. Condition: {condition.replace('_', ' ')}{needed}."
    outcome = "succeeds" if last.success else "still fails"
    return (
        f"After learning from the failed transfer the policy {outcome}: {last.achieved}; at first, {first.achieved}."
        f" Condition: {condition.replace('_', ' ')}."
    )
