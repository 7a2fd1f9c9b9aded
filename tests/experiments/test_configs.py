"""Configs of all commands, as the command line and as Python compose them."""

import re

import pytest

from op3.apps import COMMANDS
from op3.apps.compose import composed, configured, override
from op3.common.assets import config_file

VALUES = {"robot": "op3", "model": "paper"}


@pytest.mark.parametrize("app", sorted(set(COMMANDS.values())))
def test_shipped_settings_are_accepted(app, tmp_path):
    """No default of a command is refused by the checks, which go by the names of fields."""
    asked = re.findall(r"^(\w+): \?\?\?", config_file(app).read_text(encoding="utf-8"), re.MULTILINE)
    with configured(app, folder=tmp_path / "run", **{name: VALUES.get(name, tmp_path) for name in asked}) as cfg:
        assert cfg


@pytest.mark.parametrize(
    "value", ["a b", "it's", "[x]", "${y}", 3, 0.5, True, None, [1, "two"], {"mass": 0.3}, "", "7"]
)
def test_values_from_python_arrive_as_they_are(value):
    """Whatever a text holds, Hydra's grammar gives it back."""
    cfg = composed("predict", [override("data", "x"), override("+value", value)])
    assert cfg.value == value


def test_a_call_from_python_is_checked_and_leaves_the_outer_config(tmp_path):
    """The folder is the one given; a wrong field is refused; afterwards no config of the call is left."""
    from hydra.core.hydra_config import HydraConfig

    with configured("collect", motion="squat", repeats=2, folder=tmp_path / "run") as cfg:
        assert (cfg.repeats, HydraConfig.get().runtime.output_dir) == (2, str(tmp_path / "run"))
        with pytest.raises(ValueError, match="repeats must be at least 1"), configured("collect", repeats=0):
            pass
        assert HydraConfig.get().runtime.output_dir == str(tmp_path / "run")
    assert not HydraConfig.initialized()
