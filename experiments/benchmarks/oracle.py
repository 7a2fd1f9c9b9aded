"""What a hidden-effect case shows to a diagnosis to which the answer is told.

Log odds, the gain in held-out runs in standard errors, and how far the gap closes.

python experiments/benchmarks/oracle.py <case>/data <base model> <answer.yaml> <folder for oracle.yaml>

The hidden effects are switched on where they are, their sizes and the base are fitted to the same runs as in a
diagnosis, and the gap is shown on the same unseen runs. An effect whose odds are below the alarm even then, no search
can find in these logs with this judge.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import torch
import yaml

from op3.diagnose import Diagnosis, show, split_logs
from op3.diagnose.findings import NamingStage, Proposal, Search
from op3.rollout import read_logs
from op3.sim import load_model


def told(search: Search, stage: NamingStage, effect: str, joints: Sequence[str] | None) -> NamingStage:
    """The stage with an effect that is known to be there; as it is where the catalogue lacks it."""
    names = search.reduction.engine.joints
    place = effect, None if joints is None else tuple(sorted(names.index(joint) for joint in joints))
    odds = stage.judge.scores(stage.fit)
    mine = [i for i, one in enumerate(stage.found) if one.place == place]
    if not mine:
        return stage
    number = max(mine, key=lambda i: float(odds[i]))
    with_it, alone = (stage.judge.fit(named, stage.fit.state, rounds=2) for named in ([number], []))
    step = (with_it.mean[:-1] - alone.mean)[: len(stage.base.point)]
    return search.with_best(stage, [Proposal(number, step, float(with_it.mean[-1]), with_it.state)])


def main(data: str, base: str, answer: str, run: str) -> None:
    """Tell the answer, and write what it is worth."""
    torch.set_num_threads(1)
    hidden = yaml.safe_load(Path(answer).read_text(encoding="utf-8"))["effects"]
    diagnosis = Diagnosis(load_model(base), split_logs(read_logs(data), seed=0))
    first = last = diagnosis.first_stage()
    assert diagnosis.search is not None
    for one in hidden:
        last = told(diagnosis.search, last, one["name"], None if one["shared"] else one["joints"])
    shown = show(first.base.model, last.base.model, diagnosis.split)
    known = [
        {"name": one.candidate.effect.name, "log_odds": round(one.log_odds, 2), "z": round(one.gain.z, 2)}
        for one in last.named
    ]
    content = {"effects": known, "gap": shown["gap"], "loss": shown["loss"]}
    (Path(run) / "oracle.yaml").write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")


if __name__ == "__main__":
    if len(sys.argv) != 5:
        raise SystemExit(__doc__)
    main(*sys.argv[1:])
