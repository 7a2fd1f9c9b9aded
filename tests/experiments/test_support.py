"""What the experiment scripts share."""

import re
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

from op3.identify.resolvers import register as register_resolvers
from op3.identify.search_groups import register
from op3.identify.sweeper import sweep_or_report

ROOT = Path(__file__).resolve().parents[2]
EXPERIMENTS = ROOT / "experiments"
CHECKED = [path.stem for path in EXPERIMENTS.glob("*.py") if re.search(r"one_sentence\(.*cfg\)", path.read_text())]


@pytest.mark.parametrize("name", [name for name in sorted(CHECKED) if name != "support"])
def test_what_a_command_does_by_default_passes_the_checks_of_all(name, monkeypatch):
    """A field whose name another experiment uses otherwise would refuse every run."""
    monkeypatch.syspath_prepend(str(EXPERIMENTS))
    from support import Common

    register()
    register_resolvers()
    assert sweep_or_report  # its module makes the sweeper known to Hydra
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        Common.of(compose(name))
