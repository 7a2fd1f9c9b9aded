"""How names hang on the judge's tuned constants: each halved and doubled, on recorded cases of the bench.

python experiments/benchmarks/judge_constants.py <folder of cases> <folder of answers> <folder for constants.yaml>

Windows, base and columns are made once for each case; everything that a constant changes behind them is done anew, up
to the first name, without a refit. A case counts where its first name is right, or nothing is named and nothing hidden.
"""

import sys
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import torch
import yaml

from op3.diagnose import Diagnosis, Settings, split_logs
from op3.rollout import read_logs
from op3.sim import load_model
from op3.stand_in.score import truth_of

APART = ("windows", "leaders")
"""Constants that change what is simulated, or how much is tried."""


def variants() -> dict[str, Settings]:
    """The settings as they are, and with one constant halved or doubled."""
    found = {"as they are": Settings()}
    for field in fields(Settings):
        if field.name not in APART:
            for factor in (0.5, 2.0):
                value = np.multiply(getattr(Settings(), field.name), factor)
                scaled = tuple(value.tolist()) if value.ndim else type(getattr(Settings(), field.name))(value)
                found[f"{field.name} x {factor:g}"] = replace(Settings(), **{field.name: scaled})
    return found


def first_names(case: Path) -> dict[str, tuple[str, tuple[str, ...]] | None]:
    """Effect and joints that each variant names first; None where it names nothing."""
    about = yaml.safe_load((case / "case.yaml").read_text())
    diagnosis = Diagnosis(load_model(about["base"]), split_logs(read_logs(case / "data"), seed=0))
    first, names = diagnosis.first_stage(), {}
    search, joints = diagnosis.search, diagnosis.split.fit[0].joints
    assert search is not None
    for name, settings in variants().items():
        search.settings = search.reduction.settings = settings
        stage = search._stage(first.base, (), first.found, first.columns, None)
        leaders = search.leaders(stage, stage.judge.scores(stage.fit), stage.fit.state)
        one = stage.found[leaders[0].number] if leaders else None
        where = () if one is None or one.joints is None else tuple(sorted(joints[j] for j in one.joints))
        names[name] = None if one is None else (one.effect.name, where)
    return names


def main(cases: str, answers: str, run: str) -> None:
    """Judge every case under every variant, and write how many first names are right."""
    torch.set_num_threads(1)
    right: dict[str, list[bool]] = {}
    for case in sorted(path for path in Path(cases).iterdir() if (Path(answers) / f"{path.name}.yaml").is_file()):
        truth = truth_of(yaml.safe_load((Path(answers) / f"{case.name}.yaml").read_text()))
        expected = [(one.name, one.joints) for one in truth] or [None]
        for name, found in first_names(case).items():
            right.setdefault(name, []).append(found in expected)
        content = {name: {"right": sum(values), "of": len(values)} for name, values in right.items()}
        (Path(run) / "constants.yaml").write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")


if __name__ == "__main__":
    if len(sys.argv) != 4:
        raise SystemExit(__doc__)
    main(*sys.argv[1:])
