"""Packages that only some users need."""

import sys
from importlib import import_module

import numpy as np
import pytest

from op3.report.frames import RenderError
from op3.report.video import write_film


def test_without_pin_the_stand_in_says_what_to_install(monkeypatch):
    """One sentence, when it is first imported."""
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    monkeypatch.delitem(sys.modules, "op3.stand_in.bodies", raising=False)
    with pytest.raises(ValueError, match=r"need the package pin: pip install 'op3\[stand-in\]'"):
        import_module("op3.stand_in.bodies")


def test_without_av_films_are_left_out_and_the_reason_is_said(monkeypatch, tmp_path):
    """Nothing is left half-written."""
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(RenderError, match=r"needs the package av: pip install 'op3\[video\]'"):
        write_film([np.zeros((16, 16, 3), np.uint8)], tmp_path / "film.mp4", 10.0)
    assert not list(tmp_path.iterdir())
