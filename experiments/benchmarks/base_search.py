"""Where the search for a base ends on cases of the hidden-effect bench, beside a start from the numbers that made them.

python experiments/benchmarks/base_search.py <folder of a bench's run> --cases 4 --seed 0

In minus two log evidence: positive where the base is ahead of that start, which only the bench knows.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml

from op3.diagnose import Diagnosis, split_logs
from op3.diagnose.base import Baseline, fit_base, gap_of, settle
from op3.diagnose.coordinates import other_forms
from op3.diagnose.reduction import Reduction
from op3.rollout import read_logs
from op3.servo import RobotModel
from op3.sim import load_model

NAMES = {"velocity_time_constant": "velocity_lag", "current_time_constant": "current_lag"}
"""What a world calls some of the base's numbers; the others have the same name."""


def from_truth(reduction: Reduction, base: Baseline, world: dict) -> Baseline:
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


def main() -> None:
    """Print one line for each case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="of a run of hidden_effects.py")
    parser.add_argument("--cases", type=int, help="the first so many, by name")
    parser.add_argument("--seed", type=int, default=0, help="of the search")
    given = parser.parse_args()
    for case in sorted((given.folder / "cases").iterdir())[: given.cases]:
        answer = yaml.safe_load((given.folder / "answers" / f"{case.name}.yaml").read_text(encoding="utf-8"))
        model = load_model(answer["base"])
        reduction = Diagnosis(model, split_logs(read_logs(case / "data"), seed=0)).reduction()
        began = time.process_time()
        base = fit_base(reduction, model, np.random.default_rng([given.seed, 11]))
        spent = time.process_time() - began
        ahead = gap_of(reduction, from_truth(reduction, base, answer["world"]), base)
        hidden = ", ".join(one["name"] for one in answer["effects"]) or "nothing"
        print(f"{case.name}  {hidden:<24} {ahead:+8.0f}  {spent:5.0f} s of processor time", flush=True)


if __name__ == "__main__":
    main()
