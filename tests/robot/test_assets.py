"""Finding data files."""

from pathlib import Path

import pytest

from op3.common import assets
from op3.common.assets import asset_path


def test_checkout():
    """In a checkout the assets are at the top level."""
    assert asset_path("op3/op3.xml") == Path(__file__).resolve().parents[2] / "assets" / "op3" / "op3.xml"


def test_installed_wheel_comes_first(tmp_path, monkeypatch):
    """Files inside the package win over a folder that happens to be called assets beside it."""
    for folder in ("op3/_files/assets", "assets"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "model.xml").write_text(folder)
    monkeypatch.setattr(assets, "_CANDIDATES", (tmp_path / "op3/_files/assets", tmp_path / "assets"))
    assert asset_path("model.xml").read_text() == "op3/_files/assets"


def test_missing_asset():
    """A missing file is named together with the folders that were searched."""
    with pytest.raises(FileNotFoundError, match=r"no asset 'op3/op4.xml' in .*_files/assets or .*assets"):
        asset_path("op3/op4.xml")
