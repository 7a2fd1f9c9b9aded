"""Hide effects in legs, diagnose every leg from its logs alone, and count how often the name is right.

python experiments/hidden_effects.py [bench=ci|laptop|full] [set=development|test] [hydra.run.dir=<folder>]
python experiments/hidden_effects.py diagnose=false        # record the cases and seal the answers only

The answers are sealed before the first diagnosis. The same command with the same hydra.run.dir goes on where it
stopped.
"""

import hashlib
import sys
from pathlib import Path
from typing import Any

import hydra
import numpy as np
import yaml
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from support import one_sentence

from op3.report import finish, run_provenance, write_result
from op3.report.naming import naming_page
from op3.rollout import read_logs
from op3.stand_in import CATALOGUE, Case, make_case, open_answers
from op3.stand_in.bench import ORACLE_FILE, VERDICT_FILE, commit, draw_mix, run_all, run_beside, run_policy
from op3.stand_in.children import preload
from op3.stand_in.score import (
    MISSING,
    Verdict,
    by_robot,
    confusion,
    random_name,
    read_verdict,
    refit_only,
    score_case,
    score_ranking,
    summarise,
)
from op3.tasks.evaluation import evaluation_return


def resolved(command: Any) -> list[str]:
    """A command of the config, with this interpreter for `python`; empty if there is none."""
    return [sys.executable if part == "python" else str(part) for part in command or ()]


def told(cases: list[Case], folder: Path, answers: Path, cfg: DictConfig) -> dict[str, Any]:
    """The gap of every case with an effect of the catalogue under a model that knows it."""
    command, gaps = resolved(cfg.oracle), {}
    for case in cases:
        if command and case.kind in ("single", "pair"):
            options = (ORACLE_FILE, cfg.timeout, cfg.keep_data)
            found = run_beside(case, folder / "cases", answers, command, *options)
            gaps[case.name] = None if found is None else yaml.safe_load(found.read_text(encoding="utf-8"))
    return gaps


def baselines(cases: list[Case], folder: Path, answers: Path, cfg: DictConfig) -> dict[str, dict[str, Verdict]]:
    """Verdicts of other ways to diagnose the cases of a leg, by label and case."""
    found: dict[str, dict[str, Verdict]] = {}
    for label, command in (cfg.baselines or {}).items():
        name = str(label).replace("_", " ")
        found[name] = {}
        for case in cases:
            if case.robot == "leg":
                options = (f"{label}/{VERDICT_FILE}", cfg.timeout, cfg.keep_data)
                path = run_beside(case, folder / "cases", answers, resolved(command), *options)
                found[name][case.name] = Verdict(MISSING) if path is None else read_verdict(path)
    return found


def actual_returns(cases: list[Case], folder: Path, cfg: DictConfig) -> dict[str, float]:
    """Mean return of the policy in the hidden truth, of the cases of the whole robot in which it can be run."""
    command, returns = resolved(cfg.policy_command), {}
    for case in cases if command else ():
        episodes = run_policy(case, folder / "cases", command, cfg.timeout)
        if episodes is not None:
            returns[case.name] = float(np.mean([evaluation_return(log, cfg.task) for log in read_logs(episodes)]))
    return returns


def score(
    verdicts: dict[str, Path | None],
    answers: dict,
    gaps: dict,
    actual: dict[str, float],
    others: dict[str, dict[str, Verdict]],
    folder: Path,
    cfg: DictConfig,
    commitment: str,
) -> None:
    """Open the answers, score diagnosis and baselines, write result.yaml, scores.yaml and the page."""
    read = {name: Verdict(MISSING) if path is None else read_verdict(path) for name, path in verdicts.items()}
    every = [score_case(answers[name], verdict, gaps.get(name), actual.get(name)) for name, verdict in read.items()]
    rows, whole = by_robot(every)
    rng = np.random.default_rng([cfg.first_seed, 50])
    legs = [name for name in read if answers[name].get("robot") != "op3"]
    blind = [score_case(answers[name], random_name(answers[name], CATALOGUE, rng)) for name in legs]
    refit = [score_case(answers[name], refit_only()) for name in legs]
    summaries = {
        "diagnosis": summarise(rows),
        "random name": summarise(blind),
        "base refit only": summarise(refit),
    }
    by_score = {name: score_ranking(read[name]) for name in legs}
    if any(by_score.values()):
        ranked = [score_case(answers[name], verdict) for name, verdict in by_score.items() if verdict is not None]
        summaries["score ranking"] = summarise(ranked)
    for label, found in others.items():
        summaries[label] = summarise([score_case(answers[name], verdict) for name, verdict in found.items()])
    if whole:
        summaries["diagnosis, whole robot"] = summarise(whole)
    table = confusion(every)
    page = naming_page(every, summaries, table, f"Hidden effects, {cfg.set} set, {len(every)} cases", commitment)
    provenance = run_provenance(seed=cfg.first_seed)
    page.provenance(provenance)
    page.files({"scores.yaml": "every case", "result.yaml": "all numbers", "answers.sha256": "the sealed answers"})
    index = page.write(folder / "index.html")
    (folder / "scores.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(every)), encoding="utf-8")
    result = {
        "set": cfg.set,
        "answers_sha256": commitment,
        **{label.replace(",", "").replace(" ", "_"): summary for label, summary in summaries.items()},
        "confusion": {"truths": table[0], "claims": table[1], "counts": table[2]},
        "provenance": provenance,
    }
    finish(index, write_result(folder / "result.yaml", result))


@hydra.main(config_path="../conf", config_name="hidden_effects", version_base="1.3")
def main(cfg: DictConfig) -> None:
    """Draw, seal, record, diagnose, open, score."""
    with one_sentence():
        folder = Path(HydraConfig.get().runtime.output_dir)
        mix = OmegaConf.to_container(cfg.mix, resolve=True)
        assert isinstance(mix, dict)
        cases = draw_mix({str(key): value for key, value in mix.items()}, cfg.set, cfg.first_seed)[: cfg.limit]
        answers = Path(cfg.answers or folder / "answers")
        sealed = commit(cases, answers)
        (folder / "answers.sha256").write_bytes(sealed.read_bytes())
        commitment = hashlib.sha256(sealed.read_bytes()).hexdigest()
        print(f"{len(cases)} cases, answers sealed in {sealed}, SHA-256 {commitment}", flush=True)
        if not cfg.diagnose:
            for number, case in enumerate(cases, start=1):
                print(f"case {number}/{len(cases)}: {make_case(case, folder / 'cases', answers)}", flush=True)
            return
        command = resolved(cfg.command)
        preload("hydra", "op3.diagnose", "op3.policy", "op3.report.diagnosis")
        options = {"timeout": cfg.timeout, "keep_data": cfg.keep_data, "whole_robot": list(cfg.whole_robot)}
        verdicts = run_all(cases, folder / "cases", answers, command, **options)
        opened = open_answers(answers, folder / "answers.sha256")
        others = baselines(cases, folder, answers, cfg)
        gaps, actual = told(cases, folder, answers, cfg), actual_returns(cases, folder, cfg)
        score(verdicts, opened, gaps, actual, others, folder, cfg, commitment)


if __name__ == "__main__":
    main()
