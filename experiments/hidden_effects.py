"""Hide effects in robots, diagnose every robot from its logs alone, and count how often the names are correct.

python experiments/hidden_effects.py [bench=ci|laptop|op3|full] [set=development|test] [hydra.run.dir=<folder>]
python experiments/hidden_effects.py ranges=my_ranges.yaml  # other ranges of the robots
python experiments/hidden_effects.py diagnose=false         # only record the cases and seal the answers

The answers are sealed before the first diagnosis. The same command with the same hydra.run.dir continues after an
interruption.
"""

import hashlib
import sys
from pathlib import Path
from typing import Any

import numpy as np
from hidden_bench.bench import draw_mix, read_cost, run_all
from hidden_bench.naming_page import naming_page
from hidden_bench.score import BenchVerdict, random_name, read_verdict, score_case, summarise
from omegaconf import DictConfig, OmegaConf

from op3.apps.command_result import CommandResult
from op3.apps.current_run import command_of_run, output_folder
from op3.apps.job import goes_on
from op3.command_line import launch
from op3.report import run_provenance, write_result
from op3.stand_in import CATALOGUE, Case, make_case, open_answers
from op3.stand_in.cases import commit
from op3.stand_in.world import read_ranges

INTERRUPTED = goes_on("cases")


def run(cases: list[Case], folder: Path, answers: Path, command: Any, place: str, cfg: DictConfig) -> dict[str, Any]:
    """Run a command of the config on every case, with this interpreter as `python`; return verdict paths by case."""
    filled = [sys.executable if part == "python" else str(part) for part in command]
    options = {"timeout": cfg.timeout, "keep_data": cfg.keep_data, "place": place}
    return run_all(
        cases, folder / "cases", answers, filled, say=lambda line: print(f"{place}: {line}", flush=True), **options
    )


def scores(cases: list[Case], answers: dict[str, Any], found: dict[str, Any]) -> list[dict[str, Any]]:
    """Scores of a diagnosis: every case compared with its answer."""
    rows = []
    for case in cases:
        path = found[case.name]
        verdict = BenchVerdict(failed=True) if path is None else read_verdict(path, case.joints)
        rows.append(score_case(answers[case.name], verdict, {} if path is None else read_cost(path)))
    return rows


def report(
    cases: list[Case], answers: dict[str, Any], found: dict[str, dict[str, Any]], folder: Path, cfg: DictConfig
) -> CommandResult:
    """Score all diagnoses by label, and write result.yaml, scores.yaml and the page."""
    scored = {label: scores(cases, answers, verdicts) for label, verdicts in found.items()}
    rows = scored["diagnosis"]
    summaries = {label.replace("_", " "): summarise(each) for label, each in scored.items()}
    kinds = {row["robot"] for row in rows}
    if len(kinds) > 1:
        for kind in sorted(kinds):
            summaries[f"diagnosis {kind}"] = summarise([row for row in rows if row["robot"] == kind])
    rng = np.random.default_rng([cfg.first_seed, 50])
    blind = [score_case(answers[case.name], random_name(CATALOGUE, case.joints, rng)) for case in cases]
    summaries["random name"] = summarise(blind)
    commitment = hashlib.sha256((folder / "answers.sha256").read_bytes()).hexdigest()
    page = naming_page(rows, summaries, f"Hidden effects, {cfg.set} set, {len(rows)} cases", commitment)
    provenance = {**run_provenance(seed=cfg.first_seed), "command": command_of_run()}
    page.provenance(provenance)
    index = page.write(folder / "index.html")
    (folder / "scores.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(rows)), encoding="utf-8")
    result = {
        "set": cfg.set,
        "answers_sha256": commitment,
        **{label.replace(" ", "_"): summary for label, summary in summaries.items()},
        "provenance": provenance,
    }
    files = (index, write_result(folder / "result.yaml", result))
    return CommandResult(folder, page.headline, {"key_numbers": page.key_numbers}, files=files)


def main(cfg: DictConfig) -> CommandResult | None:
    """Draw the cases, seal their answers, record and diagnose them, open the answers, and score."""
    folder = output_folder()
    mix: Any = OmegaConf.to_container(cfg.mix, resolve=True)
    cases = draw_mix(mix, cfg.set, cfg.first_seed, read_ranges(cfg.ranges))[: cfg.limit]
    answers = Path(cfg.answers or folder / "answers")
    sealed = commit(cases, answers)
    (folder / "answers.sha256").write_bytes(sealed.read_bytes())
    commitment = hashlib.sha256(sealed.read_bytes()).hexdigest()
    print(f"{len(cases)} cases, answers sealed in {sealed}, SHA-256 {commitment}", flush=True)
    if not cfg.diagnose:
        for number, case in enumerate(cases, start=1):
            print(f"case {number}/{len(cases)}: {make_case(case, folder / 'cases', answers)}", flush=True)
        return None
    found = {"diagnosis": run(cases, folder, answers, cfg.command, "run", cfg)}
    opened = open_answers(answers, folder / "answers.sha256")
    for label, command in (cfg.baselines or {}).items():
        found[str(label)] = run(cases, folder, answers, command, str(label), cfg)
    return report(cases, opened, found, folder, cfg)


if __name__ == "__main__":
    launch("hidden_effects", __name__)
