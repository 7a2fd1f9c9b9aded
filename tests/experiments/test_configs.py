"""Configs of all commands, as the command line and as Python compose them."""

import pytest

from op3.apps.command_help import COMMANDS
from op3.apps.fields import Common
from op3.apps.job import composed, configured, override, overrides_of


@pytest.mark.parametrize("app", sorted(set(COMMANDS.values())))
def test_what_a_command_does_by_default_passes_the_checks_of_all(app):
    """A field whose name another command uses otherwise would refuse every run."""
    Common.of(composed(app, []))


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

    with configured("collect", overrides_of(motion="squat", repeats=2), tmp_path / "run") as cfg:
        assert (cfg.repeats, HydraConfig.get().runtime.output_dir) == (2, str(tmp_path / "run"))
        with pytest.raises(ValueError, match="repeats must be at least 1"), configured("collect", ["repeats=0"], None):
            pass
        assert HydraConfig.get().runtime.output_dir == str(tmp_path / "run")
    assert not HydraConfig.initialized()
