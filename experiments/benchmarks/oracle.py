"""How far the gap of a hidden-effect case can be closed: a diagnosis to which the answer is told.

python experiments/benchmarks/oracle.py <case>/data <base model> <answer.yaml> <folder for oracle.yaml>

The hidden effects are switched on where they are, their sizes and the base are fitted to the same runs as in a
diagnosis, and the gap is shown on the same unseen runs. A refitted base in `<folder>/.diagnosis` is taken over.
"""

import sys
from pathlib import Path

import torch
import yaml

from op3.diagnose import Diagnosis, split_logs
from op3.diagnose.oracle import oracle
from op3.rollout import read_logs
from op3.sim import load_model


def main(data: str, base: str, answer: str, run: str) -> None:
    """Tell the answer, and write what it is worth."""
    torch.set_num_threads(1)
    hidden = yaml.safe_load(Path(answer).read_text(encoding="utf-8"))["effects"]
    told = [(one["name"], () if one["shared"] else one["joints"]) for one in hidden]
    diagnosis = Diagnosis(load_model(base), split_logs(read_logs(data), seed=0), cache=Path(run) / ".diagnosis")
    content = oracle(diagnosis, told)
    (Path(run) / "oracle.yaml").write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")


if __name__ == "__main__":
    if len(sys.argv) != 5:
        raise SystemExit(__doc__)
    main(*sys.argv[1:])
