"""``model.yaml``: one file that describes a simulated robot completely."""

import hashlib
from collections.abc import Mapping
from math import isfinite
from pathlib import Path
from typing import Any

import yaml

from op3.common.assets import find_model
from op3.common.settings import read_yaml
from op3.common.writing import write_text
from op3.servo import Effect, Estimate, RobotModel, effect_class
from op3.servo.conditions import split_name

FORMAT = "op3-model/1"


def save_model(model: RobotModel, path: str | Path) -> Path:
    """Write a model atomically."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, yaml.safe_dump(to_dict(model), sort_keys=False))
    return path


def load_model(name_or_path: str | Path) -> RobotModel:
    """Read a model from a file, possibly BAM's JSON, or by a name in `model_names`.

    Raises:
        ValueError: if the file is not a model; the message names file, field and remedy.
        FileNotFoundError: if there is no such file.
    """
    path = find_model(name_or_path)
    if path.suffix in (".xml", ".urdf"):
        raise ValueError(f"{path} describes bodies, not a servo model: give a model.yaml, or BAM's parameters as .json")
    content = read_yaml(path)
    try:
        if isinstance(content, Mapping) and "actuator" in content and "format" not in content:
            from op3.sim.foreign_models import from_bam  # only imported if needed

            return from_bam(content)
        return from_dict(content)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def model_hash(model: RobotModel) -> str:
    """Twelve hex digits that identify a model's effects and values, without its provenance.

    Options with default values are ignored, so that a new option of an effect does not change the hash of old models.
    """
    content = to_dict(model)
    content.pop("provenance", None)
    for effect, named in zip(model.effects, content["effects"], strict=True):
        default = {name: getattr(type(effect), name, None) for name in effect.options()}
        body = named[effect.name]
        named[effect.name] = {key: v for key, v in body.items() if key not in default or v != default[key]}
    return hashlib.sha256(yaml.safe_dump(content, sort_keys=True).encode()).hexdigest()[:12]


def to_dict(model: RobotModel) -> dict[str, Any]:
    """The content of ``model.yaml``: plain dictionaries, lists, strings and numbers."""
    effects = []
    for effect in model.effects:
        body: dict[str, Any] = {name: getattr(effect, name) for name in effect.options()}
        body |= {known.name: _estimate_to_plain(model.estimate(known.name)) for known in effect.parameters}
        effects.append({effect.name: body})
    content: dict[str, Any] = {"format": FORMAT, "bus_voltage": model.bus_voltage, "effects": effects}
    return content | ({"provenance": dict(model.provenance)} if model.provenance else {})


def from_dict(content: Any) -> RobotModel:
    """The inverse of `to_dict`.

    Raises:
        ValueError: if a field is missing, unknown or of the wrong type; the message names it.
    """
    if not isinstance(content, Mapping) or content.get("format") != FORMAT:
        raise ValueError(f"field `format` must be {FORMAT!r}; this is not a model file of this version")
    listed = content.get("effects")
    if not isinstance(listed, list) or not listed:
        raise ValueError("field `effects` must be a list with one `- <effect>: {...}` each")
    unknown = set(content) - {"format", "bus_voltage", "effects", "provenance"}
    if unknown:
        raise ValueError(f"unknown field `{sorted(unknown)[0]}`; remove it")
    effects, estimates = [], {}
    for entry in listed:
        effects.append(_effect_from_plain(entry, estimates))
    return RobotModel(
        effects=tuple(effects),
        estimates=estimates,
        bus_voltage=_number("bus_voltage", content.get("bus_voltage", 11.1)),
        provenance=content.get("provenance") or {},
    )


def _effect_from_plain(entry: Any, estimates: dict[str, Estimate]) -> Effect:
    """The effect of an entry; its parameters are added to the estimates."""
    entry = {entry: None} if isinstance(entry, str) else entry
    if not isinstance(entry, Mapping) or len(entry) != 1:
        raise ValueError(f"an entry of `effects` must be one `<effect>: {{...}}`, got {entry!r}")
    ((name, body),) = entry.items()
    if body is not None and not isinstance(body, Mapping):
        raise ValueError(f"effect `{name}` must contain options and parameters by name, got {body!r}")
    kind, options = effect_class(str(name)), {}
    parameters = sorted(p.name for p in kind.parameters)
    for key, value in (body or {}).items():
        if key in parameters:
            estimates[key] = _estimate_from_plain(f"{name}.{key}", value)
        elif key in kind.options():
            options[key] = value
        else:
            raise ValueError(
                f"effect `{name}` has no field `{key}`; it has {', '.join([*kind.options(), *parameters])}"
            )
    return kind(**options)


def _estimate_to_plain(estimate: Estimate) -> Any:
    ends = {"value": estimate.value, "low": estimate.low, "high": estimate.high}
    plain: dict[str, Any] = {name: end for name, end in ends.items() if end is not None}
    if estimate.joints:
        plain["joints"] = {
            joint: _estimate_to_plain(Estimate(value, *estimate.intervals.get(joint, (None, None))))
            for joint, value in estimate.joints.items()
        }
    if estimate.by:
        plain["by"] = {str(condition): _estimate_to_plain(special) for condition, special in estimate.by.items()}
    return plain if len(plain) > 1 else estimate.value


def _estimate_from_plain(where: str, value: Any) -> Estimate:
    if not isinstance(value, Mapping):
        return Estimate(_number(where, value))
    unknown = set(value) - {"value", "low", "high", "joints", "by"}
    if unknown or "value" not in value:
        raise ValueError(f"`{where}` must be a number or hold value, low, high, joints, by; got {dict(value)!r}")
    joints = {
        str(joint): _estimate_from_plain(f"{where}.joints.{joint}", own)
        for joint, own in (value.get("joints") or {}).items()
    }
    for joint, own in joints.items():
        if own.joints or own.by or (own.low is None) != (own.high is None):
            raise ValueError(f"`{where}.joints.{joint}` must be a number or a mapping of value, low and high")
    special = {f"{where}@{condition}": v for condition, v in (value.get("by") or {}).items()}
    return Estimate(
        value=_number(where, value["value"]),
        **{end: _number(f"{where}.{end}", value[end]) for end in ("low", "high") if value.get(end) is not None},
        joints={joint: own.value for joint, own in joints.items()},
        intervals={j: (o.low, o.high) for j, o in joints.items() if o.low is not None and o.high is not None},
        by={c: _estimate_from_plain(name, v) for name, v in special.items() if (c := split_name(name)[1])},
    )


def _number(where: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
        raise ValueError(f"`{where}` must be a finite number, got {value!r}")
    return float(value)
