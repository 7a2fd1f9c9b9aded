"""Hide an effect in a simulated robot, record its logs, and diagnose them, in two minutes.

op3 demo diagnose [hidden_effect=backlash] [severity=clear] [seed=3] [hidden_robot=arm]

The robot's physics are independent of op3's. A hash of the answer is written before the diagnosis begins, and the
answer is read only after it has ended.
"""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from threadpoolctl import threadpool_limits

from op3.apps.command_result import CommandResult
from op3.apps.compose import configured
from op3.apps.current_run import output_folder
from op3.apps.diagnose import main as diagnose
from op3.apps.progress import ProgressLine
from op3.common.plain_names import words
from op3.report.tables import in_thousandths, span
from op3.stand_in import KINDS, Case, draw_case, open_answers, record_case
from op3.stand_in.cases import commit
from op3.stand_in.suites import SETTINGS


def record(case: Case, folder: Path) -> Path:
    """Record the suite of the case's robot; returns the folder of the logs."""
    runs, say = SETTINGS[case.robot].rich(case.seed), ProgressLine()
    for number, log in enumerate(record_case(case, runs), start=1):
        log.save(folder / f"{number:02d}_{log.metadata.motion}", overwrite=True)
        say("recording", number / len(runs))
    return folder


def where(joints: list[str], shared: bool) -> str:
    """The joints as text."""
    return "all joints" if shared else " and ".join(map(words, joints))


def hidden(answer: Mapping[str, Any]) -> str:
    """The hidden effect of a sealed answer, as text."""
    texts = []
    for effect in answer["effects"]:
        kind = KINDS[effect["name"]]
        size = f"{words(kind.parameter or kind.meaning)} {kind.catalogue_size(effect['size']):.3g}"
        texts.append(f"{words(effect['name'])} in {where(effect['joints'], effect['shared'])} ({size})")
    return "; ".join(texts)


def named(finding: Mapping[str, Any]) -> str:
    """A finding as one line of text."""
    return (
        f"{words(finding['effect'])} in {where(finding['joints'], finding['shared'])}, probability"
        f" {finding['probability']:.2f} ({words(finding['parameter'])} {span((finding['size'], *finding['interval']))})"
    )


def ending(content: Mapping[str, Any], folder: Path) -> str:
    """The last lines: named effect, hidden effect, gap, files, and the next command."""
    gaps = []
    for channel, gap in content["gap"].items():
        (before, unit), (after, _) = (in_thousandths(gap[end], gap["unit"]) for end in ("before", "after"))
        gaps.append(f"{channel.split('/')[1]} {before:.3g} to {after:.3g} {unit}")
    findings = [named(finding) for finding in content["findings"]] or [
        "nothing; the diagnosis missed the hidden effect"
    ]
    added = [words(finding["effect"]) for finding in content["findings"]]
    lines = {
        "named": "\n          ".join(findings),
        "hidden": content["hidden"],
        "gap": f"free-run error of held-out runs, baseline fit to returned model: {'; '.join(gaps)}",
        "model": f"{folder / 'model.yaml'}" + (f", with {', '.join(added)} added" if added else ""),
        "page": str(folder / "index.html"),
        "next": f"op3 view {folder}",
    }
    return "\n".join(f"{name:<10}{text}" for name, text in lines.items())


def main(cfg: DictConfig) -> CommandResult:
    """Choose a hidden effect, seal the answer, record logs, diagnose them, and open the answer."""
    torch.set_num_threads(1)
    threadpool_limits(1)
    folder = output_folder()
    case = draw_case(cfg.seed, "single", cfg.severity, cfg.hidden_effect, robot=cfg.hidden_robot)
    sealed = commit([case], folder / "answers")
    digest = hashlib.sha256(sealed.read_bytes()).hexdigest()
    print(f"An effect is hidden in a simulated robot. SHA-256 of the sealed answer: {digest[:16]}", flush=True)
    data = record(case, folder / "data")
    windows = [] if cfg.windows is None else [f"windows={cfg.windows}"]
    given = {"data": data, "model": case.base, "seed": cfg.seed, "wandb": cfg.wandb.mode, "folder": folder}
    with configured("diagnose", **given, overrides=windows) as asked:
        found = diagnose(asked, lambda: hidden(open_answers(folder / "answers")[case.name]))
    return CommandResult(folder, ending(found.content, folder), files=())
