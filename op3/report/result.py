"""``result.yaml``: the numbers of a run as a flat, documented list of finite values."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from op3.common.private import scrub
from op3.common.wandb_settings import WandbSettings
from op3.common.writing import write_text
from op3.report.page import Page
from op3.report.run_logger import RunLogger
from op3.report.style import NAMES
from op3.servo import Estimate, catalogue

HEADER = """\
# The numbers of one run. Keys are dotted paths; units are SI unless a key names another.
# null: the number does not exist, for example without held-out logs.
"""


def write_result(path: str | Path, values: Mapping[str, Any], meanings: Mapping[str, str] | None = None) -> Path:
    """Write results atomically.

    Args:
        path: path of the file, usually ``result.yaml`` in the run's folder.
        values: numbers, texts, None, lists of them, nested mappings or dotted keys. A mapping with ``value`` (and
            ``low``, ``high``) and an `Estimate` stay one entry.
        meanings: meanings of further first parts of keys, written as comments.

    Raises:
        ValueError: if a number is not finite or a value is not plain data; the message names the key.
    """
    path = Path(path)
    known = {**NAMES["meanings"]["every"], **(meanings or {})}
    units = {p.name: f"[{p.unit}] {p.text}" for effect in catalogue().values() for p in effect.parameters}
    lines, group = [HEADER], None
    for key, value in flatten(values).items():
        first, last = key.split(".")[0], key.split(".")[-1].partition("@")[0]
        if first != group and first in known:
            lines.append(f"\n# {first}: {known[first]}\n")
        group = first
        note = f"  # {units[last]}" if first == "parameters" and last in units else ""
        lines.append(f"{_yaml(key)}: {_yaml(value)}{note}\n")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, "".join(lines))
    return path


def read_result(path: str | Path) -> dict[str, Any]:
    """Read results back, by dotted key."""
    return yaml.safe_load(Path(path).read_text(encoding="utf-8"))


@dataclass(frozen=True)
class RunFolder:
    """A run's folder with its provenance and its logging to wandb.

    Attributes:
        provenance: provenance of the run, see `op3.report.run_provenance`.
        config: settings, for wandb.
        wandb: settings of the logging.
        used: inputs of the run: kind (``log``, ``model``, ``policy``) and path, pattern or list of paths.
        made: outputs of the run, as for `used`.
    """

    path: Path
    provenance: Mapping[str, Any]
    config: Mapping[str, Any] | None = None
    wandb: WandbSettings = field(default_factory=lambda: WandbSettings(mode="disabled"))
    used: Sequence[tuple[str, Any]] = ()
    made: Sequence[tuple[str, Any]] = ()


def publish(
    page: Page,
    values: Mapping[str, Any],
    run: RunFolder,
    curve: Mapping[str, Sequence[float]] | None = None,
) -> dict[str, Any]:
    """Write ``index.html`` and ``result.yaml``, and log the numbers to wandb.

    Args:
        values: values of ``result.yaml``; the page's headline, key numbers and provenance are added.
        curve: numbers by step and name, for wandb; non-finite numbers are omitted.

    Returns:
        The values.
    """
    said = {"headline": page.headline, "key_numbers": page.key_numbers}
    values = {**said, **values, "provenance": dict(run.provenance)}
    page.provenance(run.provenance)
    write_result(run.path / "result.yaml", values, NAMES["meanings"].get(page.template))
    page.write(run.path / "index.html")
    if run.wandb.mode != "disabled":
        with RunLogger(run.path, config=run.config, wandb=run.wandb) as logger:
            logger.lineage(run.used, run.made)
            for name, numbers in (curve or {}).items():
                for step, number in enumerate(numbers):
                    if math.isfinite(number):
                        logger.log({name: number}, step=step)
            logger.summary({key: value for key, value in values.items() if isinstance(value, int | float | str)})
    return values


def finite(value: float) -> float | None:
    """A number of ``result.yaml``; None for the result of a diverged simulation."""
    return float(value) if math.isfinite(value) else None


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Results by dotted key, as plain data."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        key = prefix + name
        if isinstance(value, Estimate):
            joints = {"joints": dict(value.joints)} if value.joints else {}
            value = {"value": value.value, "low": value.low, "high": value.high, **joints}
        nested = isinstance(value, Mapping) and "value" not in value
        flat |= flatten(value, key + ".") if nested else {key: _plain(key, value)}
    return flat


def _plain(key: str, value: Any) -> Any:
    """Numbers of numpy and torch as Python numbers; raises an error for values that YAML readers cannot load."""
    if isinstance(value, Mapping):
        return {str(name): _plain(f"{key}.{name}", item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(f"{key}[{i}]", item) for i, item in enumerate(value)]
    if hasattr(value, "tolist") and not isinstance(value, str):
        return _plain(key, value.tolist())
    if isinstance(value, Path):
        return scrub(str(value))
    if value is None or isinstance(value, bool | int | str):
        return scrub(value)
    if isinstance(value, float):
        if not math.isfinite(value):
            raise ValueError(f"result {key} is {value}: write a finite number, or None")
        return value
    raise ValueError(f"result {key} is a {type(value).__name__}: write numbers, texts, None or lists of them")


class _Dumper(yaml.SafeDumper):
    """Writes texts that plain YAML would change, such as line breaks, in double quotes with escapes."""

    def represent_text(self, text: str) -> yaml.ScalarNode:
        return self.represent_scalar("tag:yaml.org,2002:str", text, style=None if text.isprintable() else '"')


_Dumper.add_representer(str, _Dumper.represent_text)


def _yaml(value: Any) -> str:
    """One key or value on one line."""
    options: dict[str, Any] = dict(default_flow_style=True, width=10**9, allow_unicode=True, sort_keys=False)
    return yaml.dump(value, Dumper=_Dumper, **options).strip().removesuffix("...").strip()
