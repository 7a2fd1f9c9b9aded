"""Videos of states: drawn where a driver is, refused in words where none is, and never the end of the process."""

import sys

import av
import numpy as np
import pytest

from op3.report.frames import SIZE, RenderError, backends, draw_frames
from op3.report.video import film
from op3.robot import pose
from op3.scenes import build_scene


@pytest.fixture(scope="module")
def scene():
    built = build_scene("floor", "op3")
    return built, np.stack([built.initial_qpos(pose(name, "op3")) for name in ("stand", "squat_low")])


def test_states_are_drawn_one_by_one(scene):
    """Standing and crouching differ, where this machine can draw."""
    built, states = scene
    model = built.compile()
    samples = model.vis.quality.offsamples
    try:
        frames = draw_frames(model, states)
    except RenderError as error:
        pytest.skip(f"no driver draws here: {error}")
    assert frames.shape == (2, *SIZE, 3)
    assert frames.dtype == np.uint8
    assert (frames[0] != frames[1]).mean() > 0.01
    assert model.vis.quality.offsamples == samples
    stays = draw_frames(model, np.concatenate([states[:1], states[:1] + 0.05 * np.eye(model.nq)[0]]), follow=False)
    np.testing.assert_array_equal(stays[0], frames[0])
    assert (stays[1] != stays[0]).any()


def test_a_film_shows_the_robot(scene, tmp_path):
    """In grey and black alone a robot is not seen: simulations leave out the geoms that only pictures show."""
    said = []
    path = film(*scene, tmp_path / "film.mp4", 10.0, said.append)
    if path is None:
        pytest.skip(f"no driver draws here: {said}")
    built, states = scene
    bare = draw_frames(built.compile(visual=False), states[:1])[0]
    whole = draw_frames(built.compile(), states[:1])[0]
    assert len(np.unique(whole.reshape(-1, 3), axis=0)) > 10 * len(np.unique(bare.reshape(-1, 3), axis=0))
    with av.open(str(path)) as shown:
        (first, _) = (frame.to_ndarray(format="rgb24") for frame in shown.decode(video=0))
    assert first.shape == (*SIZE, 3)
    assert np.abs(first.astype(float) - whole).mean() < 6


@pytest.mark.skipif(sys.platform != "linux", reason="the names of backends are those of Linux")
def test_a_driver_that_fails_is_named_and_asked_again_without_harm(scene, tmp_path, monkeypatch):
    """Every transfer of a long run may try to draw; without a driver each says so, and the run goes on."""
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    said = []
    for _ in range(2):
        assert film(*scene, tmp_path / "film.mp4", 10.0, said.append) is None
    assert not (tmp_path / "film.mp4").exists()
    assert len(said) == 2
    for line in said:
        assert "cannot render here with glfw" in line
        assert "libegl1" in line


def test_without_a_screen_no_driver_that_needs_one_is_tried(monkeypatch):
    """A server draws through EGL without being told; what is set is taken as it is."""
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    assert backends() == ("egl", "osmesa")
    monkeypatch.setenv("DISPLAY", ":0")
    assert backends()[0] == "glfw"
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    assert backends() == ("osmesa",)
