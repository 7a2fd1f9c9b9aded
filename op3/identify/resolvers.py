"""Interpolations for configs, so that ranges and values are written once: in the catalogue and in model files.

``${range:torque_constant}`` is the catalogue's range as ``interval(0.003, 0.009)``; ``${value:torque_constant}`` is
the value in the model that the config's key ``model`` names; ``${start:torque_constant}`` is the same, moved into the
catalogue's range. ``${own:torque_constant,0.1,1.5}`` is the range ``interval(0.1, 1.5)`` where that model has the
parameter, and null, which is not searched, where it has not; where the model has values under conditions, those are
searched and not the shared one. ``${each_joint:}`` is what the config's `per_joint` asks the sweeper to search once for
each joint. `register` makes them known.
"""

from omegaconf import DictConfig, OmegaConf

from op3.robot import CONTROLLED_JOINTS
from op3.servo import parameter
from op3.servo.conditions import split_name
from op3.sim import load_model


def _range(name: str) -> str:
    known = parameter(name)
    return f"interval({known.low!r}, {known.high!r})"


def _value(name: str, *, _root_: DictConfig) -> float:
    model = load_model(_root_.model)
    # a group may name a parameter of an effect that this model has switched off: it starts from its nominal value
    base, _ = split_name(name)
    return model.estimate(name).value if base in model.parameters() else parameter(base).nominal


def _own(name: str, low: float, high: float, *, _root_: DictConfig) -> str | None:
    model = load_model(_root_.model)
    base, condition = split_name(name)
    if base not in model.parameters():
        return None
    by = model.estimate(base).by
    searched = condition in by if by or condition else True
    return f"interval({float(low)!r}, {float(high)!r})" if searched else None


def _each_joint(*, _root_: DictConfig) -> dict[str, list[str]]:
    joints, names = list(_root_.joints or CONTROLLED_JOINTS), _root_.per_joint
    if isinstance(names, str):
        raise ValueError(f"per_joint must be a list: write per_joint=[{names}]")
    return {f"parameters.{name}": joints for name in names}


def _start(name: str, *, _root_: DictConfig) -> float:
    known = parameter(name)
    return min(max(_value(name, _root_=_root_), known.low), known.high)


def register() -> None:
    """Register the interpolations; again is harmless."""
    OmegaConf.register_new_resolver("range", _range, replace=True)
    OmegaConf.register_new_resolver("value", _value, replace=True)
    OmegaConf.register_new_resolver("start", _start, replace=True)
    OmegaConf.register_new_resolver("own", _own, replace=True)
    OmegaConf.register_new_resolver("each_joint", _each_joint, replace=True)
