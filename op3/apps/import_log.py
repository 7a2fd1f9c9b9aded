"""Check a log of any format, and show how its columns are interpreted.

op3 import data=<log> [robot=<name or file>] [unwrap=true] [shift='{joint: rad}'] [split=true]

If no YAML exists beside the log, the command writes its interpretation there; correct it where needed. `read_log` and
every `data=` use this file. Exit code 1 if a log has an error.
"""

import sys
from pathlib import Path

from omegaconf import DictConfig

from op3.apps.command_result import CommandResult
from op3.apps.current_run import output_folder
from op3.apps.fields import plain
from op3.common.private import masked
from op3.common.settings import parse_yaml
from op3.common.writing import write_text
from op3.rollout import LogError, Rollout
from op3.rollout.health import ERROR, examine, merge_findings
from op3.rollout.importing import OPTIONS, read_side, side_path
from op3.rollout.proposal import as_yaml, propose
from op3.rollout.read import expand, read_episodes


def look(path: Path, cfg: DictConfig) -> bool:
    """Print the content of a log and the results of the checks; return whether the log can be used."""
    print(masked(f"{path}:"))
    proposed = None
    if not read_side(path).found:
        text = as_yaml(*propose(path, cfg.robot))
        proposed = parse_yaml(text, side_path(path), LogError)
        print(text)
        if cfg.write:
            try:
                write_text(side_path(path), text)
                print(f"written to {side_path(path)}; correct it there")
            except OSError as error:
                problem = f"{side_path(path)}: {(error.strerror or str(error)).lower()}"
                print(f"{problem}; copy the log to a folder in which its YAML can be written", file=sys.stderr)
    options = {name: plain(cfg[name]) for name in OPTIONS if name in cfg}
    try:
        logs = read_episodes(path, options, check=False, robot=cfg.robot, proposed=proposed)
    except LogError as error:
        print(error)
        return False
    return all([show(log, log.metadata.recording or path.name) for log in logs])


def show(log: Rollout, name: str) -> bool:
    """Print the channels of a recording and the table of problems."""
    names = ", ".join("/".join(key) if isinstance(key, tuple) else key for key in log.channels)
    print(f"{name}: {log.rows} rows, {log.duration:.2f} s, {log.metadata.rate:.4g} Hz")
    print(f"joints {', '.join(log.joints)}\nchannels {names}")
    findings = [*log.findings, *examine(log)]
    for finding in merge_findings(findings):
        print("\n".join(f"  {name}: {value}" for name, value in finding.row().items() if value), end="\n\n")
    if not findings:
        print("the checks found nothing wrong")
    return not any(finding.severity == ERROR for finding in findings)


def main(cfg: DictConfig) -> CommandResult:
    """Check every log in `data`."""
    data = plain(cfg.data)
    paths = [path for given in (data if isinstance(data, list) else [data]) for path in expand(given)]
    usable = [look(path, cfg) for path in paths]
    if not all(usable):
        print("at least one log cannot be used; correct the problems listed above", file=sys.stderr)
        raise SystemExit(1)
    return CommandResult(output_folder(), f"{len(paths)} log{'s' * (len(paths) != 1)} can be used.", files=())
