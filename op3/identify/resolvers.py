"""Interpolations that let configs refer to ranges in the catalogue and values in model files.

``${range:torque_constant}`` is the catalogue's range as ``interval(0.003, 0.009)``; ``${value:torque_constant}`` is the
value in the config's ``model``; ``${start:torque_constant}`` is this value clipped to the catalogue's range.
``${own:torque_constant,0.1,1.5}`` is the range ``interval(0.1, 1.5)`` if that model has the parameter, otherwise null,
so that it is not searched. If the model has values under conditions, these are searched instead of the shared value.
``${each_joint:}`` lists the parameters in the config's `per_joint`, which the sweeper searches once per joint.
`op3.identify.registration` registers them.
"""

from functools import lru_cache
from typing import Any

from omegaconf import DictConfig, OmegaConf

from op3.robot import DEFAULT, Robot, load_robot
from op3.rollout.read import robot_of
from op3.servo import Parameter, RobotModel, catalogue, parameter
from op3.servo.conditions import split_name
from op3.sim import model_for

MARGIN = 3.0
"""Motor and friction parameters are searched within this factor of the values in the robot's servo files."""


def chosen_robot(config: DictConfig) -> Robot:
    """The robot of a config: its `robot`, otherwise the robot of its `data`, otherwise the OP3."""
    if config.get("robot"):
        return load_robot(config.robot)
    if "data" in config and not OmegaConf.is_missing(config, "data"):
        data: Any = OmegaConf.to_container(config.data) if OmegaConf.is_config(config.data) else config.data
        return _robot_of(tuple(data) if isinstance(data, list) else data)
    return load_robot(DEFAULT)


@lru_cache(maxsize=8)
def _robot_of(data: Any) -> Robot:
    try:
        return robot_of(data)
    except ValueError:  # reading the logs reports this error
        return load_robot(DEFAULT)


def chosen_model(config: DictConfig) -> RobotModel:
    """The initial model of a config: its `model`, otherwise the robot's model."""
    return model_for(chosen_robot(config), config.get("model"))


def _bounds(name: str, config: DictConfig) -> tuple[float, float]:
    """The catalogue's range; for a model built from servo files, a range around their values."""
    known = parameter(name)
    if config.get("model") or chosen_robot(config).file.law:
        return known.low, known.high
    model = chosen_model(config)
    value = model.value(name) if name in model.parameters() else known.nominal
    if known.neutral is None and name in model.estimates:
        return value / MARGIN, value * MARGIN
    return min(known.low, value), min(max(known.high, MARGIN * value), known.most)


def _of_the_base(known: Parameter) -> bool:
    """Whether a parameter belongs to the base body."""
    return any(
        edit.target == "base_body" and edit.parameter == known.name
        for effect in catalogue().values()
        for edit in effect.edits
    )


def range_of(name: str, *, _root_: DictConfig) -> str | None:
    """The searched range of a parameter; None if these logs contain no information about it."""
    robot = chosen_robot(_root_)
    if (robot.file.fixed or robot.file.base is None) and _of_the_base(parameter(name)):
        return None  # mass and centre of mass of a fixed body are not observable
    low, high = _bounds(name, _root_)
    return f"interval({low!r}, {high!r})"


def value_of(name: str, *, _root_: DictConfig) -> float:
    """A parameter's value in the model."""
    model = chosen_model(_root_)
    # a parameter of a switched-off effect starts from its nominal value
    base, _ = split_name(name)
    return model.estimate(name).value if base in model.parameters() else parameter(base).nominal


def own_of(name: str, low: float, high: float, *, _root_: DictConfig) -> str | None:
    """This range if the model has the parameter, otherwise None."""
    model = chosen_model(_root_)
    base, condition = split_name(name)
    if base not in model.parameters():
        return None
    by = model.estimate(base).by
    searched = condition in by if by or condition else True
    return f"interval({float(low)!r}, {float(high)!r})" if searched else None


def each_joint_of(*, _root_: DictConfig) -> dict[str, list[str]]:
    """Parameters that are searched once for each joint."""
    joints, names = list(_root_.joints or chosen_robot(_root_).controlled), _root_.per_joint
    if isinstance(names, str):
        raise ValueError(f"per_joint must be a list: write per_joint=[{names}]")
    return {f"parameters.{name}": joints for name in names}


def start_of(name: str, *, _root_: DictConfig) -> float:
    """A parameter's value in the model, clipped to its range."""
    low, high = _bounds(name, _root_)
    return min(max(value_of(name, _root_=_root_), low), high)
