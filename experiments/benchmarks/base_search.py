"""Where the search for a base ends on cases of the hidden-effect bench, beside a start from the numbers that made them.

python experiments/benchmarks/base_search.py <folder of a bench's run> <cases at most> <seed>

In minus two log evidence: positive where the base is ahead of that start, which only the bench knows.
"""

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml

from op3.diagnose import Diagnosis, split_logs
from op3.diagnose.base import Base, fit_base, gap_of, settle
from op3.diagnose.coordinates import other_forms
from op3.diagnose.reduction import Reduction
from op3.rollout import read_logs
from op3.servo import RobotModel
from op3.sim import load_model

NAMES = {"velocity_time_constant": "velocity_lag", "current_time_constant": "current_lag"}
"""What a world calls some of the base's numbers; the others have the same name."""


def from_truth(reduction: Reduction, base: Base, world: dict) -> Base:
    """Where a start from a world's numbers and forms leads, with the priors of a base."""
    wanted = {"dte": ("form", "power"), "stribeck": ("fade", world["fade_form"])}

    def right(form: RobotModel) -> bool:
        return all(getattr(e, wanted[e.name][0]) == wanted[e.name][1] for e in form.effects if e.name in wanted)

    coordinates = base.coordinates
    forms = [coordinates.model, *other_forms(coordinates.model)]
    known = world | {"bristle_compliance": 1 / world["bristle_stiffness"]}
    point = coordinates.start.copy()
    for i, entry in enumerate(coordinates.entries):
        if entry.joints is None and entry.kind == "value":
            point[i] = known.get(NAMES.get(entry.parameter, entry.parameter), point[i])
    return settle(reduction, replace(coordinates, model=next(filter(right, forms))), point)


def main(folder: str, most: str, seed: str) -> None:
    """Print one line for each case."""
    for case in sorted((Path(folder) / "cases").iterdir())[: int(most)]:
        answer = yaml.safe_load((Path(folder) / "answers" / f"{case.name}.yaml").read_text(encoding="utf-8"))
        model = load_model(answer["base"])
        reduction = Diagnosis(model, split_logs(read_logs(case / "data"), seed=0)).reduction()
        began = time.process_time()
        base = fit_base(reduction, model, np.random.default_rng([int(seed), 11]))
        spent = time.process_time() - began
        ahead = gap_of(reduction, from_truth(reduction, base, answer["world"]), base)
        hidden = ", ".join(one["name"] for one in answer["effects"]) or "nothing"
        print(f"{case.name}  {hidden:<24} {ahead:+8.0f}  {spent:5.0f} s of processor time", flush=True)


if __name__ == "__main__":
    if len(sys.argv) != 4:
        raise SystemExit(__doc__)
    main(*sys.argv[1:])
