"""Interpolations for configs, so that ranges and values are written once: in the catalogue and in model files.

``${range:torque_constant}`` is the catalogue's range as ``interval(0.003, 0.009)``; ``${value:torque_constant}`` is
the value in the model that the config's key ``model`` names; ``${start:torque_constant}`` is the same, moved into the
catalogue's range. `register` makes them known.
"""

from omegaconf import DictConfig, OmegaConf

from op3.servo import parameter
from op3.sim import load_model


def _range(name: str) -> str:
    known = parameter(name)
    return f"interval({known.low!r}, {known.high!r})"


def _value(name: str, *, _root_: DictConfig) -> float:
    model = load_model(_root_.model)
    # a group may name a parameter of an effect that this model has switched off: it starts from its nominal value
    return model.value(name) if name in model.parameters() else parameter(name).nominal


def _start(name: str, *, _root_: DictConfig) -> float:
    known = parameter(name)
    return min(max(_value(name, _root_=_root_), known.low), known.high)


def register() -> None:
    """Register the interpolations; again is harmless."""
    OmegaConf.register_new_resolver("range", _range, replace=True)
    OmegaConf.register_new_resolver("value", _value, replace=True)
    OmegaConf.register_new_resolver("start", _start, replace=True)
